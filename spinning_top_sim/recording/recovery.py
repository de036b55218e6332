# SPDX-License-Identifier: Apache-2.0
"""Writes what can be decoded of a damaged log into a new, indexed one."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Chunk, Header, Metadata

from spinning_top_sim.recording.errors import LogError, why_not_written
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import single
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.scan import Part, Scan
from spinning_top_sim.recording.writer import McapWriter


def recover(reader: LogReader, output: str | os.PathLike[str],
            progress: Callable[[float], object] = lambda done: None) -> McapWriter:
    """
    Write everything that can be decoded of a log into a new file; return what has written it.

    output : must not exist; is removed again where the recovery fails
    progress : is called with what is done, of `reader.size`; the scan is the first half

    Chunks of messages are copied as they are, other messages are put into new chunks; message
    indexes, statistics, summary and the `rosbag2` record are made anew.
    Raises LogError, also if a file that was not closed holds no whole message.
    """
    output = Path(output)
    try:
        writer = McapWriter(output, header=Header(reader.profile, reader.library),
                            compression='zstd')
        with writer.discarded_on_failure():
            scan = reader.scan(lambda offset: progress(offset / 2))
            declared = False
            for part in scan.index.parts:
                progress((reader.size + part.offset) / 2)
                if part.channel_ids:
                    if not declared:    # channels stand before the messages, metadata as it stood
                        _declare(scan, writer)
                    declared = True
                    _copy_messages(reader, part, writer)
                else:
                    _copy_record(reader, part, writer)
            writer.flush()
            if not declared:
                _declare(scan, writer)
            if not writer.messages and not reader.whole:
                raise LogError(f'nothing to save in {reader.path}: there is no whole message in '
                               'it')
            writer.finish(bag=reader.profile == 'ros2' or BAG_METADATA in scan.index.metadata)
    except OSError as error:
        raise LogError(f'cannot write {output}: {why_not_written(output, error)}') from error
    progress(reader.size)
    return writer


def _declare(scan: Scan, writer: McapWriter) -> None:
    """Write all schemas and channels, but for channels without their schema."""
    for schema in scan.index.schemas.values():
        writer.write(schema)
    for number, channel in scan.index.channels.items():
        if number in scan.index.topics:
            writer.write(channel)


def _copy_messages(reader: LogReader, part: Part, writer: McapWriter) -> None:
    messages = reader.open_part(part)
    topics = reader.scan().index.topics
    if part.opcode == Opcode.CHUNK and not messages.declared and part.channel_ids <= set(topics):
        chunk = reader.file.record(part.offset, part.end)
        assert isinstance(chunk, Chunk)
        chunk.message_start_time, chunk.message_end_time = part.start_ns, part.end_ns
        writer.flush()                  # what came before stays before
        writer.write_chunk(chunk, {number: np.frombuffer(numbers, np.uint64).reshape(-1, 2)
                                   for number, numbers in messages.entries.items()})
        return
    for message in messages.in_order(topics):
        writer.add(*single(message.channel_id - 1, message.log_time, message.data))


def _copy_record(reader: LogReader, part: Part, writer: McapWriter) -> None:
    record = reader.file.record(part.offset, part.end)
    if not (isinstance(record, Metadata) and record.name == BAG_METADATA):
        writer.write(record, reader.file.raw(part.offset, part.end))
