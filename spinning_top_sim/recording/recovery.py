# SPDX-License-Identifier: Apache-2.0
"""Writes what can be read of a damaged log into a new, indexed one."""

import itertools
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Header, Metadata
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import LogError, why_not_written
from spinning_top_sim.recording.parsing import MESSAGE_FIELDS, message_layout
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.recording.rosbag2 import BAG_METADATA
from spinning_top_sim.recording.writer import CHUNK_BYTES, McapWriter


def recover(reader: LogReader, output: Path, progress: Callable[[float], object]) -> int:
    """
    Write everything that can be read of a log into a new file; return the number of messages.

    output : must not exist; is removed again where the recovery fails
    progress : is called with the bytes that are done, of `reader.size`

    Chunks, indexes, statistics, summary and the `rosbag2` record are made anew.
    Raises RecordingError or LogError, also if a torn file holds no whole message.
    """
    torn = reader.damage.torn       # now that all is read, all channels are known
    # In MCAP the schema id 0 means: no schema.
    schemas = {number: schema for number, schema in reader.schemas.items() if number}
    channels = [channel if channel.schema_id in schemas else replace(channel, schema_id=0)
                for _, channel in sorted(reader.channels.items())]
    file = McapWriter(output, [Header(reader.profile, reader.library), *schemas.values(),
                               *channels], compression='zstd')
    try:
        _copy(reader, file, progress)
        if torn and not file.message_counts:
            raise LogError(f'nothing to save in {reader.path}: there is no whole message in it')
        file.finish(bag=reader.profile == 'ros2' or BAG_METADATA in reader.metadata,
                    compression=reader.compression)
    except BaseException as error:
        file.discard()
        if isinstance(error, OSError):
            raise LogError(f'cannot write {output}: {why_not_written(output, error)}') from error
        raise
    return file.message_counts.total()


def _copy(reader: LogReader, file: McapWriter, progress: Callable[[float], object]) -> None:
    waiting: list[LogMessage] = []
    size = 0
    for offset, messages, others in itertools.chain(reader.parts(), [(reader.size, [], [])]):
        progress(offset)
        if waiting and (others or size > CHUNK_BYTES or offset == reader.size):
            file.write_chunk(*_chunk(waiting))
            waiting, size = [], 0
        waiting += messages
        size += sum(len(one.data) for one in messages)
        for one in others:
            if isinstance(one, Attachment) or (
                    isinstance(one, Metadata) and one.name != BAG_METADATA):
                file.write(one)


def _chunk(messages: Sequence[LogMessage]) -> tuple[bytes, dict[int, NDArray[np.uint64]]]:
    """Return messages in their order as `McapWriter.write_chunk` takes them."""
    index: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
    records, offset = [], 0
    for _, log_time, publish_time, sequence, data, channel in messages:
        length = MESSAGE_FIELDS + len(data)
        records.append(message_layout(length).pack(
            Opcode.MESSAGE, length, channel, sequence, log_time, publish_time, data))
        index[channel].append((log_time, offset))
        offset += len(records[-1])
    return b''.join(records), {
        channel: np.array(entries, np.uint64) for channel, entries in sorted(index.items())}
