# SPDX-License-Identifier: Apache-2.0
"""Writes what can be read of a damaged log into a new, indexed one, by mcap's writer."""

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from mcap.records import Attachment, Metadata
from mcap.writer import Writer

from spinning_top_sim.recording.errors import LogError, why_not_written
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.recording.rosbag2 import BAG_METADATA, bag_metadata


def recover(reader: LogReader, output: Path,
            progress: Callable[[float], object]) -> int:
    """
    Write everything that can be read of a log into a new file; return the number of messages.

    output : must not exist; is removed again where the recovery fails
    progress : is called with the bytes that are done, of `reader.size`

    Chunks, indexes, statistics, summary and the `rosbag2` record are made anew.
    Raises LogError, also if a file that was not closed holds no whole message.
    """
    try:
        with open(output, 'xb') as file:
            try:
                messages = _copy(reader, Writer(file), output.name, progress)
                file.flush()
                os.fsync(file.fileno())
            except BaseException:
                output.unlink()
                raise
    except OSError as error:
        raise LogError(f'cannot write {output}: {why_not_written(output, error)}') from error
    return messages


def _copy(reader: LogReader, writer: Writer, name: str,
          progress: Callable[[float], object]) -> int:
    damage, counts = reader.damage, Counter[int]()
    writer.start(reader.profile, reader.library)
    # New ids by old ones; now that all is read, all are known.
    schemas = {number: writer.register_schema(schema.name, schema.encoding, schema.data)
               for number, schema in reader.schemas.items()}
    channels = {number: writer.register_channel(
        channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0),
        channel.metadata) for number, channel in reader.channels.items()}
    for offset, records in reader.parts():
        progress(offset)
        for one in records:
            if isinstance(one, LogMessage):
                counts[one.channel_id] += 1
                writer.add_message(channels[one.channel_id], one.log_time, one.data,
                                   one.publish_time, one.sequence)
            elif isinstance(one, Attachment):
                writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type,
                                      one.data)
            elif isinstance(one, Metadata) and one.name != BAG_METADATA:
                writer.add_metadata(one.name, one.metadata)
    if damage.torn and not counts:
        raise LogError(f'nothing to save in {reader.path}: there is no whole message in it')
    if reader.profile == 'ros2' or BAG_METADATA in reader.metadata:
        writer.add_metadata(BAG_METADATA, bag_metadata(
            [(reader.channels[topic.channel_id], topic.type_name, counts[topic.channel_id])
             for topic in reader.topics], name, *reader.span, reader.compression))
    writer.finish()
    return counts.total()
