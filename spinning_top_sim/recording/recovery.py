# SPDX-License-Identifier: Apache-2.0
"""Writes what can be read of a damaged log into a new, indexed one."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema

from spinning_top_sim.recording.errors import LogError, why_not_written
from spinning_top_sim.recording.reader import LogReader, Part
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.writer import McapWriter, time_span


def recover(reader: LogReader, output: Path,
            progress: Callable[[float], object] = lambda done: None) -> McapWriter:
    """
    Write everything that can be read of a log into a new file; return what has written it.

    output : must not exist; is removed again where the recovery fails
    progress : is called with the bytes that are done, of `reader.size`

    Chunks of messages are copied as they are, other messages are put into new chunks; message
    indexes, statistics, summary and the `rosbag2` record are made anew.
    Raises LogError, also if a file that was not closed holds no whole message.
    """
    try:
        writer = McapWriter(output, header=Header(reader.profile, reader.library),
                            compression='zstd')
        with writer.discarded_on_failure():
            for part in reader.parts():
                progress(part.offset)
                _copy(part, reader, writer)
            _declare(filter(reader.is_declared, reader.channels), reader, writer)
            if not writer.messages and not reader.whole:
                raise LogError(f'nothing to save in {reader.path}: there is no whole message in '
                               'it')
            is_bag = reader.profile == 'ros2' or BAG_METADATA in reader.metadata
            writer.finish(reader.compression if is_bag else None)
    except OSError as error:
        raise LogError(f'cannot write {output}: {why_not_written(output, error)}') from error
    progress(reader.size)
    return writer


def _copy(part: Part, reader: LogReader, writer: McapWriter) -> None:
    chunk, messages = part.record, part.messages
    for record in messages.declared:
        if isinstance(record, Schema | Channel | Attachment) or (
                isinstance(record, Metadata) and record.name != BAG_METADATA):
            writer.write(record)
    _declare(messages.entries, reader, writer)
    if messages.entries and isinstance(chunk, Chunk):
        start_ns, end_ns = time_span(messages.entries)
        writer.write_chunk(replace(
            chunk, message_start_time=start_ns, message_end_time=end_ns), messages.entries)
    elif messages.entries:
        writer.write_messages(messages.plain, messages.entries)


def _declare(channel_ids: Iterable[int], reader: LogReader, writer: McapWriter) -> None:
    """Write these channels; a summary tells those whose records are damaged."""
    for number in channel_ids:
        channel = reader.channels[number]
        if channel.schema_id:
            writer.write(reader.schemas[channel.schema_id])
        writer.write(channel)
