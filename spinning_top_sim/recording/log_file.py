# SPDX-License-Identifier: Apache-2.0
"""An MCAP file that may be damaged: its bytes, and its summary."""

import contextlib
import os
import stat
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap import records
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.chunks import ENTRY_SIZE, INDEX_HEAD
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.parsing import HEAD, MAX_DECLARED, DamagedError, check_size, parse

MAGIC_SIZE = len(MCAP0_MAGIC)

_FOOTER_SIZE = HEAD.size + 8 + 8 + 4
_BLOCK = 1 << 16


class LogFile:
    """A file up to the size that it has now; raises LogError where it cannot be read."""

    def __init__(self, path: Path, max_bytes: int) -> None:
        """Open it; `max_bytes` is the size of the largest record that is read."""
        self._path = path
        self.max_bytes = max_bytes
        with self._access():
            # Opening a pipe would block.
            if not stat.S_ISREG(os.stat(path).st_mode):
                raise LogError(f'cannot read {path}: it is no regular file')
            self._file = open(path, 'rb')  # noqa: SIM115
            self.size = os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        """Close it."""
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return the bytes there, fewer where the file ends."""
        length = min(length, self.size - offset)
        if length <= 0:
            return b''
        with self._access():
            self._file.seek(offset)
            return self._file.read(length)

    def crc(self, end: int) -> int:
        """Return the CRC-32 of the bytes before `end`."""
        crc = 0
        for offset in range(0, end, _BLOCK):
            crc = zlib.crc32(self.read(offset, min(_BLOCK, end - offset)), crc)
        return crc

    def head(self, offset: int, limit: int) -> tuple[int, int]:
        """Return opcode and end of the record there; DamagedError if it ends behind `limit`."""
        head = self.read(offset, HEAD.size)
        if len(head) == HEAD.size and head[0] != 0:
            opcode, length = HEAD.unpack(head)
            if offset + HEAD.size + length <= limit:
                return opcode, offset + HEAD.size + length
        raise DamagedError('no record ends in the file that begins there')

    def raw(self, offset: int, end: int) -> bytes:
        """Return the bytes of a record; DamagedError if it is larger than `max_bytes`."""
        check_size(end - offset - HEAD.size, self.max_bytes)
        return self.read(offset, end - offset)

    def record(self, offset: int, limit: int) -> records.McapRecord:
        """Return the record there; DamagedError if it is none, or as of `head` and `raw`."""
        _, end = self.head(offset, limit)
        return parse(self.raw(offset, end))

    @contextlib.contextmanager
    def _access(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f'cannot read {self._path}: {error.strerror or error}') from error


@dataclass
class Summary:
    """The summary section of a file; empty if it is damaged or missing."""

    data_limit: int         # no record of the data section ends behind this offset
    closed: bool = False    # the file ends with a footer and the closing magic
    problem: str = ''       # why there is no summary, '' also if the file was written without one
    schemas: dict[int, records.Schema] = field(default_factory=dict)        # by id
    channels: dict[int, records.Channel] = field(default_factory=dict)      # by id
    statistics: records.Statistics | None = None
    chunks: dict[int, records.ChunkIndex] = field(default_factory=dict)     # by offset
    metadata: list[records.MetadataIndex] = field(default_factory=list)

    @property
    def indexes_all_messages(self) -> bool:
        """Whether the chunk indexes lead to as many messages as the statistics count."""
        # That is how many entries fit into the message indexes.
        return self.statistics is not None and self.statistics.message_count == sum(
            (index.message_index_length - INDEX_HEAD.size * len(index.message_index_offsets))
            // ENTRY_SIZE for index in self.chunks.values())

    @property
    def is_complete(self) -> bool:
        """Whether it leads to all messages and metadata, and tells all channels."""
        return (
            self.statistics is not None and self.indexes_all_messages
            and len(self.metadata) == self.statistics.metadata_count
            and sum(index.length for index in self.metadata) <= MAX_DECLARED
            and set(self.channels).union(
                *(index.message_index_offsets for index in self.chunks.values()))
            <= known_topics(self.schemas, self.channels).keys())


def known_topics(schemas: dict[int, records.Schema],
                 channels: dict[int, records.Channel]) -> dict[int, str]:
    """Return the topics, by channel id, of channels whose schema is there, or that have none."""
    return {number: channel.topic for number, channel in channels.items()
            if channel.schema_id == 0 or channel.schema_id in schemas}


def read_summary(file: LogFile) -> Summary:
    """Return the summary, or an empty one that says why there is none."""
    footer_offset = file.size - MAGIC_SIZE - _FOOTER_SIZE
    if file.read(file.size - MAGIC_SIZE, MAGIC_SIZE) != MCAP0_MAGIC or footer_offset < MAGIC_SIZE:
        return Summary(file.size, problem='the file does not end as an MCAP file ends')
    try:
        footer = file.record(footer_offset, file.size - MAGIC_SIZE)
        if not isinstance(footer, records.Footer):
            raise DamagedError('the footer is damaged')
        start = footer.summary_start or footer_offset
        if not MAGIC_SIZE <= start <= footer_offset:
            raise DamagedError('the footer does not lead to it')
        summary = Summary(start, closed=True)
        if file.size - start <= min(MAX_DECLARED, file.max_bytes):   # else a scan does
            _read_section(file.read(start, file.size - start), footer, summary)
        return summary
    except DamagedError as damage:
        return Summary(file.size, closed=True, problem=f'the summary is not used: {damage}')


def _read_section(section: bytes, footer: records.Footer, summary: Summary) -> None:
    if footer.summary_crc not in (0, zlib.crc32(section[:-MAGIC_SIZE - 4])):
        raise DamagedError('its checksum is wrong')
    try:
        for record in StreamReader(BytesIO(section), skip_magic=True, emit_chunks=True).records:
            if isinstance(record, records.Schema):
                summary.schemas[record.id] = record
            elif isinstance(record, records.Channel):
                summary.channels[record.id] = record
            elif isinstance(record, records.Statistics):
                summary.statistics = record
            elif isinstance(record, records.ChunkIndex):
                summary.chunks[record.chunk_start_offset] = record
            elif isinstance(record, records.MetadataIndex):
                summary.metadata.append(record)
    except (McapError, struct.error, OverflowError, UnicodeDecodeError):
        raise DamagedError('a record in it is damaged') from None
