# SPDX-License-Identifier: Apache-2.0
"""
Parses MCAP records whose bytes may be wrong: a record is what it says it is, or DamagedError.

mcap's record classes take what is truncated or inconsistent for shorter strings and smaller
numbers.  Here every length inside a record must fit.  Bytes behind the known fields are allowed:
later versions of the format may add fields (MCAP specification, "Records").
"""

from __future__ import annotations

import functools
import struct
import sys
import zlib
from array import array
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import mcap.records
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Schema

from spinning_top_sim.recording.chunks import MESSAGE, MESSAGE_FIELDS, Entries
from spinning_top_sim.recording.mcap_writer import record_bytes

MAX_BYTES = 256 << 20               # of one record or one uncompressed chunk in memory
HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows

_BLOCK = 1 << 20    # bytes decompressed at a time
_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # compares faster
_FIELDS = struct.Struct('<HIQQ')    # of a message: channel, sequence, log and publish time
# mcap's class of each kind that is parsed as a whole: that of CHUNK_INDEX is ChunkIndex.
_CLASSES: dict[int, type[McapRecord]] = {
    opcode: getattr(mcap.records, opcode.name.title().replace('_', ''))
    for opcode in Opcode if opcode not in (Opcode.MESSAGE, Opcode.ATTACHMENT)}


class DamagedError(Exception):
    """A record is not what it says it is; the text says why."""


class TooLargeError(DamagedError):
    """A record may be right but is larger than what is read into memory."""

    def __init__(self, size: int, max_bytes: int) -> None:
        super().__init__(f'its {size} bytes are more than max_bytes = {max_bytes}')


class StoredMessage(NamedTuple):
    """A message, with the place of its data in the bytes that hold it; times in ns."""

    log_time: int
    channel_id: int
    sequence: int
    publish_time: int
    start: int
    end: int


@dataclass
class ChunkContents:
    """The content of a chunk whose checksum is right, or of messages outside of chunks."""

    plain: bytes    # uncompressed
    messages: list[StoredMessage] = field(default_factory=list)     # in the order of the file
    declared: list[Schema | Channel] = field(default_factory=list)

    @functools.cached_property
    def entries(self) -> Entries:
        """The message index entries that belong to the chunk."""
        found: dict[int, array[int]] = {}
        for log_time, channel_id, _, _, start, _ in self.messages:
            numbers = found.get(channel_id)
            if numbers is None:
                numbers = found[channel_id] = array('Q')
            numbers.append(log_time)
            numbers.append(start - MESSAGE.size)
        return found


class StrictStream(ReadDataStream):
    """A stream of one record's content that gives what is asked for or raises EndOfFile."""

    def __init__(self, content: bytes) -> None:
        super().__init__(BytesIO(content))

    def read(self, length: int) -> bytes:
        """Return exactly `length` bytes."""
        data: bytes = super().read(min(length, sys.maxsize))
        if len(data) != length:
            raise EndOfFile()
        return data


def name_of(opcode: int) -> str:
    """Return what a kind of record is called in reports."""
    if opcode in _CLASSES or opcode in (Opcode.MESSAGE, Opcode.ATTACHMENT):
        return Opcode(opcode).name.lower().replace('_', ' ')
    return f'record of unknown kind {opcode:#04x}'


def parse(opcode: int, content: bytes) -> tuple[McapRecord, int]:
    """
    Return the record with this content, and how many bytes stand behind its known fields.

    Raises DamagedError, also for messages and attachments.
    """
    if opcode not in _CLASSES:
        raise DamagedError('there is no such kind of record')
    stream = StrictStream(content)
    try:
        record: McapRecord = _CLASSES[opcode].read(stream)  # type: ignore[attr-defined]
    except McapError:
        raise DamagedError('a length inside of it leads beyond its end') from None
    except UnicodeDecodeError:
        raise DamagedError('a text in it is no UTF-8') from None
    # mcap may run over the end of a map.  A chunk has none, and writing it would copy its data.
    if opcode != Opcode.CHUNK and not content.startswith(record_bytes(record)[HEAD.size:]):
        raise DamagedError('its length is not that of its content')
    return record, len(content) - stream.count


def open_chunk(chunk: Chunk, max_bytes: int) -> ChunkContents:
    """
    Decompress and check a chunk; raises DamagedError.

    A chunk without checksum (0) is right when it decompresses and breaks up into records.
    """
    plain = _decompress(chunk, max_bytes)
    if len(plain) != chunk.uncompressed_size:
        raise DamagedError('it has not the size that it says it has')
    if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
        raise DamagedError('its checksum is wrong')
    return break_up(plain)


def break_up(plain: bytes) -> ChunkContents:
    """Return the messages and declarations among records that stand one after the other."""
    contents = ChunkContents(plain)
    size = len(plain)
    offset = 0
    while offset < size:
        if size - offset < HEAD.size:
            raise DamagedError('a record in it is truncated')
        opcode, length = HEAD.unpack_from(plain, offset)
        start = offset + HEAD.size
        offset = start + length
        if offset > size:
            raise DamagedError('a record in it leads beyond its end')
        if opcode == _MESSAGE_OPCODE:
            if length < MESSAGE_FIELDS:
                raise DamagedError('a message is shorter than a message can be')
            channel_id, sequence, log_time, publish_time = _FIELDS.unpack_from(plain, start)
            contents.messages.append(StoredMessage(
                log_time, channel_id, sequence, publish_time, start + MESSAGE_FIELDS, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record, _ = parse(opcode, plain[start:offset])
            assert isinstance(record, Schema | Channel)
            contents.declared.append(record)
    return contents


def _decompress(chunk: Chunk, max_bytes: int) -> bytes:
    """Return the uncompressed bytes of all frames, but never many more than the chunk states."""
    if chunk.uncompressed_size > max_bytes:
        raise TooLargeError(chunk.uncompressed_size, max_bytes)
    if chunk.compression == '':
        return chunk.data
    stream: BinaryIO
    if chunk.compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == 'lz4':
        stream = lz4.frame.open(BytesIO(chunk.data))
    else:
        raise DamagedError(f'its compression {chunk.compression[:20]!r} is unknown')
    plain = bytearray()
    try:
        while len(plain) <= chunk.uncompressed_size and (block := stream.read(_BLOCK)):
            plain += block
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError):
        raise DamagedError('it cannot be decompressed') from None
    return bytes(plain)
