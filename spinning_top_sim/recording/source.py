# SPDX-License-Identifier: Apache-2.0
"""An MCAP file that may be damaged: its bytes, where records begin in it, and its summary."""

import contextlib
import functools
import os
import re
import stat
import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import mcap.records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import records
from spinning_top_sim.recording.chunks import ENTRY_SIZE, INDEX_HEAD, MESSAGE_FIELDS
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.records import HEAD, DamagedError, TooLargeError

MAGIC_SIZE = len(MCAP0_MAGIC)

_Record = TypeVar('_Record', bound=mcap.records.McapRecord)
_FOOTER_SIZE = HEAD.size + 8 + 8 + 4
_BLOCK = 1 << 16    # bytes read at a time where a record is not needed whole

# What may begin a chunk, a schema, a channel or metadata: opcode and a length below 2^40.
# Single messages are not looked for: nothing in them tells them from chance.
_CANDIDATE = re.compile(rb'[\x03\x04\x06\x0c](?=.{5}\x00\x00\x00)', re.DOTALL)
# Where the length of the first text is in the content; a chunk's is followed by that of the data.
_NAME_OFFSETS: dict[int, int] = {
    Opcode.SCHEMA: 2, Opcode.CHANNEL: 4, Opcode.METADATA: 0, Opcode.CHUNK: 28}
_LOOK_BYTES = 64                # of the content, enough for a chunk's fields before its data
_MAX_NAME = 1 << 12
_MAX_EXTRA = 1 << 10
LARGEST_SUMMARY = 1 << 25       # that is parsed [bytes]
_MAX_EFFORT = 4                 # bytes of candidates read, as a multiple of the file's size


class McapSource:
    """
    Random access to a file, up to the size that it has now; raises LogError where that fails.

    Methods that read a record take its first byte and its end; they raise DamagedError if it is
    inconsistent.
    """

    def __init__(self, path: Path, max_bytes: int) -> None:
        self._path = path
        self.max_bytes = max_bytes
        with self._access():
            # Opening a pipe would block.
            if not stat.S_ISREG(os.stat(path).st_mode):
                raise LogError(f'cannot read {path}: it is no regular file')
            self._file = open(path, 'rb')  # noqa: SIM115
            status = os.fstat(self._file.fileno())
        self.size = status.st_size
        self.mode = stat.S_IMODE(status.st_mode)    # permission bits

    def close(self) -> None:
        self._file.close()

    @contextlib.contextmanager
    def _access(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f'cannot read {self._path}: {error.strerror or error}') from error

    def read(self, offset: int, length: int) -> bytes:
        """Return the bytes there, fewer where the file ends."""
        length = min(length, self.size - offset)
        if length <= 0:
            return b''
        with self._access():
            self._file.seek(offset)
            return self._file.read(length)

    def blocks(self, offset: int, end: int) -> Iterator[bytes]:
        """Yield a stretch of the file in blocks."""
        while block := self.read(offset, min(_BLOCK, end - offset)):
            offset += len(block)
            yield block

    def crc(self, offset: int, end: int) -> int:
        """Return the checksum of a stretch of the file."""
        return functools.reduce(
            lambda crc, block: zlib.crc32(block, crc), self.blocks(offset, end), 0)

    def head(self, offset: int, limit: int) -> tuple[int, int]:
        """Return opcode and end of the record there, which ends by `limit`."""
        head = self.read(offset, HEAD.size)
        if len(head) == HEAD.size and head[0] != 0:
            opcode, length = HEAD.unpack(head)
            if offset + HEAD.size + length <= limit:
                return opcode, offset + HEAD.size + length
        raise DamagedError('no record can be read there')

    def raw(self, offset: int, end: int) -> bytes:
        """Return the bytes of a record; raises TooLargeError."""
        records.check_size(end - offset - HEAD.size, self.max_bytes)
        return self.read(offset, end - offset)

    def record(self, offset: int, limit: int, kind: type[_Record]) -> _Record | None:
        """Return the record there if it is whole and of that class, else None."""
        with contextlib.suppress(DamagedError):
            _, end = self.head(offset, limit)
            record, _ = records.parse(self.raw(offset, end))
            if isinstance(record, kind):
                return record
        return None

    def attachment(self, offset: int, end: int) -> tuple[mcap.records.AttachmentIndex, int]:
        """Return the index of the attachment there, and the offset of its checksum."""
        # No name and media type need more than a block.
        stream = records.StrictStream(BytesIO(self.read(offset, min(end - offset, _BLOCK))))
        try:
            stream.read(HEAD.size)
            index = mcap.records.AttachmentIndex(
                offset=offset, length=end - offset, log_time=stream.read8(),
                create_time=stream.read8(), name=stream.read_prefixed_string(),
                media_type=stream.read_prefixed_string(), data_size=stream.read8())
        except (McapError, UnicodeDecodeError):
            raise DamagedError('its name or its type cannot be read') from None
        crc_offset = offset + stream.count + index.data_size
        if crc_offset + 4 > end:
            raise DamagedError('its length is not that of its content')
        return index, crc_offset


class RecordFinder:
    """Finds records that prove themselves by their inner lengths, chunks by their checksum too."""

    def __init__(self, source: McapSource, limit: int) -> None:
        self._source = source
        self._limit = limit     # where the data section ends
        # Bytes of candidates to be read and to be uncompressed, so that the time is limited.
        self._effort = _MAX_EFFORT * source.size
        self._unpacking = _MAX_EFFORT * (source.size + source.max_bytes)

    def is_record(self, offset: int) -> bool:
        """Return whether a record of a known kind begins there, or the data section ends."""
        try:
            opcode, end = self._source.head(offset, self._limit)
            while opcode > Opcode.DATA_END:
                offset = end
                opcode, end = self._source.head(offset, self._limit)
            if opcode == Opcode.MESSAGE:
                return end - offset >= HEAD.size + MESSAGE_FIELDS
            if opcode in _NAME_OFFSETS:
                return self._is_proven(opcode, offset, end)
            if opcode == Opcode.ATTACHMENT:
                self._source.attachment(offset, end)
            elif opcode == Opcode.MESSAGE_INDEX:
                records.parse_message_index(self._source.raw(offset, end))
            else:
                records.parse(self._source.raw(offset, end))
        except TooLargeError:
            return opcode == Opcode.CHUNK
        except DamagedError:
            return offset == self._limit
        return True

    def find(self, offset: int, before: int | None = None) -> int:
        """Return where the next chunk, schema, channel or metadata begins, or `before`."""
        limit = self._limit if before is None else min(before, self._limit)
        while offset < limit:
            block = self._source.read(offset, _BLOCK + HEAD.size)
            for match in _CANDIDATE.finditer(block, 0, _BLOCK + HEAD.size - 1):
                place = offset + match.start()
                if place >= limit:
                    break
                if self.is_record(place):
                    return place
            offset += _BLOCK
        return limit

    def _is_proven(self, opcode: int, offset: int, end: int) -> bool:
        """Return whether it is a chunk, schema, channel or metadata; raises DamagedError."""
        # First what needs no more than a look: most candidates are none.
        start = offset + HEAD.size
        if not _looks_right(opcode, end - start, self._source.read(start, _LOOK_BYTES)):
            return False
        self._effort -= end - start
        if self._effort < 0:
            return False
        record, _ = records.parse(self._source.raw(offset, end))
        if not isinstance(record, mcap.records.Chunk):
            return True
        self._unpacking -= record.uncompressed_size
        if self._unpacking < 0:
            return False
        contents = records.open_chunk(record, self._source.max_bytes)
        return bool(contents.entries or contents.declared)      # zeros look like an empty chunk


def _looks_right(opcode: int, length: int, start: bytes) -> bool:
    """Return whether a chunk, schema, channel or metadata of this length may start so."""
    name_start = _NAME_OFFSETS[opcode] + 4
    name_size = int.from_bytes(start[name_start - 4:name_start], 'little')
    if opcode == Opcode.CHUNK:
        data_start = name_start + name_size + 8
        data_size = int.from_bytes(start[data_start - 8:data_start], 'little')
        return 0 <= length - data_start - data_size <= _MAX_EXTRA
    return 0 < name_size < _MAX_NAME and length <= records.MAX_DECLARED


@dataclass
class Summary:
    """The summary section of a file; empty if it is damaged or missing."""

    data_limit: int         # no record of the data section ends behind this offset
    closed: bool = False    # the file ends with a footer and the closing magic
    problem: str = ''       # why there is no summary, '' also if the file was written without one
    # By id.  Scans add what the data section declares, so that a second scan knows it from the
    # beginning.
    schemas: dict[int, mcap.records.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.records.Channel] = field(default_factory=dict)
    declared_bytes: int = 0     # of schemas and channels
    statistics: mcap.records.Statistics | None = None
    chunks: dict[int, mcap.records.ChunkIndex] = field(default_factory=dict)  # by offset
    metadata: list[mcap.records.MetadataIndex] = field(default_factory=list)
    attachments: list[mcap.records.AttachmentIndex] = field(default_factory=list)

    def knows(self, channel_id: int) -> bool:
        """Return whether the channel and its schema, if it has one, are known."""
        channel = self.channels.get(channel_id)
        return channel is not None and (
            channel.schema_id == 0 or channel.schema_id in self.schemas)

    @property
    def indexes_all_chunks(self) -> bool:
        return self.statistics is not None and self.statistics.chunk_count == len(self.chunks)

    @property
    def indexes_all_messages(self) -> bool:
        """Whether the chunk indexes lead to as many messages as the statistics count."""
        return self.statistics is not None and self.statistics.message_count == sum(
            map(messages_in, self.chunks.values()))

    @property
    def is_complete(self) -> bool:
        """Whether it leads to all messages and metadata, and tells all channels."""
        return (
            self.statistics is not None and self.indexes_all_messages
            and len(self.metadata) == self.statistics.metadata_count
            and len(self.channels) == self.statistics.channel_count
            and all(map(self.knows, set(self.channels).union(
                *(index.message_index_offsets for index in self.chunks.values())))))

    @property
    def places(self) -> list[tuple[int, int, int]]:
        """Offsets of the indexed records, with their opcodes and lengths."""
        return [
            *((index.chunk_start_offset, Opcode.CHUNK, index.chunk_length)
              for index in self.chunks.values()),
            *((index.offset, Opcode.METADATA, index.length) for index in self.metadata),
            *((index.offset, Opcode.ATTACHMENT, index.length) for index in self.attachments)]


def messages_in(index: mcap.records.ChunkIndex) -> int:
    """Return how many messages of a chunk its message indexes have, by their length."""
    return (index.message_index_length
            - INDEX_HEAD.size * len(index.message_index_offsets)) // ENTRY_SIZE


def read_summary(source: McapSource) -> Summary:
    """Return the summary, or an empty one that says why there is none."""
    magic_offset = source.size - MAGIC_SIZE
    footer_offset = magic_offset - _FOOTER_SIZE
    if footer_offset < MAGIC_SIZE or source.read(magic_offset, MAGIC_SIZE) != MCAP0_MAGIC:
        return Summary(source.size, problem='the file does not end as an MCAP file ends')
    footer = source.record(footer_offset, magic_offset, mcap.records.Footer)
    if footer is None:
        return Summary(source.size, problem='the footer is damaged')
    start, size = footer.summary_start, source.size - footer.summary_start
    if start == 0:
        return Summary(footer_offset, closed=True)
    try:
        if not MAGIC_SIZE <= start <= footer_offset:
            raise DamagedError('the footer does not lead to it')
        if footer.summary_crc not in (0, source.crc(start, magic_offset - 4)):
            raise DamagedError('its checksum is wrong')
        if size > min(LARGEST_SUMMARY, source.max_bytes):       # a scan finds the same
            return Summary(start, closed=True)
        return _read_section(source, start, footer_offset)
    except DamagedError as damage:
        return Summary(source.size, closed=True, problem=f'the summary is not used: {damage}')


def _read_section(source: McapSource, start: int, end: int) -> Summary:
    """Return the summary between two offsets; raises DamagedError if it does not fit the file."""
    found: dict[type, list[Any]] = defaultdict(list)
    declared_bytes = 0
    offset = start
    while offset < end:
        opcode, record_end = source.head(offset, end)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declared_bytes += record_end - offset
            records.check_declared(declared_bytes)
        if opcode <= Opcode.DATA_END:
            record, _ = records.parse(source.raw(offset, record_end))
            found[type(record)].append(record)
        offset = record_end
    summary = Summary(
        start, closed=True, declared_bytes=declared_bytes,
        schemas={schema.id: schema for schema in found[mcap.records.Schema]},
        channels={channel.id: channel for channel in found[mcap.records.Channel]},
        statistics=next(reversed(found[mcap.records.Statistics]), None),
        chunks={index.chunk_start_offset: index for index in found[mcap.records.ChunkIndex]},
        metadata=found[mcap.records.MetadataIndex],
        attachments=found[mcap.records.AttachmentIndex])
    if any(index.chunk_start_offset + index.chunk_length > start
           for index in summary.chunks.values()):
        raise DamagedError('it places a chunk outside of the data section')
    if summary.statistics is not None and summary.chunks and not summary.indexes_all_chunks:
        raise DamagedError('its statistics and its indexes count different numbers of chunks')
    return summary
