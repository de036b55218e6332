# SPDX-License-Identifier: Apache-2.0
"""Writes what can be read of a damaged log into a new, indexed one, by mcap's own writer."""

import os
from pathlib import Path

from mcap.records import Metadata
from mcap.writer import Writer

from spinning_top_sim.files import new_file
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader


def recover(reader: LogReader, output: Path) -> int:
    """
    Write everything that can be read of a log into a new file; return the number of messages.

    output : must not exist; is removed again where the recovery fails

    Chunks, indexes and summary are made anew.
    Raises LogError or OSError, also if a torn file holds no whole message.
    """
    count = 0
    with new_file(output, 'xb') as file:
        writer = Writer(file)
        writer.start(reader.profile, reader.library)
        schemas = {number: writer.register_schema(one.name, one.encoding, one.data)
                   for number, one in reader.schemas.items()}
        # In MCAP the schema id 0 means: no schema.
        channels = {number: writer.register_channel(
            one.topic, one.message_encoding, schemas.get(one.schema_id, 0), one.metadata)
            for number, one in reader.channels.items()}
        for record in reader.attached():
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            else:
                writer.add_attachment(record.create_time, record.log_time, record.name,
                                      record.media_type, record.data)
        for message in reader.in_file_order():
            writer.add_message(channels[message.channel_id], message.log_time, message.data,
                               message.publish_time, message.sequence)
            count += 1
        if reader.damage.torn and not count:
            raise LogError(f'nothing to save in {reader.path}: there is no whole message in it')
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return count
