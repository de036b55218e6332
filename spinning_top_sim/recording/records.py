# SPDX-License-Identifier: Apache-2.0
"""
Parses MCAP records whose bytes may be wrong: a record is what it says it is, or DamagedError.

mcap's record classes take what is truncated or inconsistent for shorter strings and smaller
numbers.  Here every length inside a record must fit.  Bytes behind the known fields are allowed:
later versions of the format may add fields (MCAP specification, "Records").
"""

from __future__ import annotations

import struct
import sys
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import mcap.records
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema

from spinning_top_sim.recording.chunks import ENTRY_SIZE, INDEX_HEAD, MESSAGE, MESSAGE_FIELDS
from spinning_top_sim.recording.mcap_writer import record_bytes

MAX_BYTES = 256 << 20               # of one record or one uncompressed chunk in memory
MAX_DECLARED = 16 << 20             # of schemas, channels or metadata, which take ten times that
HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows

_BLOCK = 1 << 20    # bytes decompressed at a time
_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # compares faster
# mcap's class of each kind that is parsed as a whole: that of CHUNK_INDEX is ChunkIndex.
_CLASSES: dict[int, type[McapRecord]] = {
    opcode: getattr(mcap.records, opcode.name.title().replace('_', '')) for opcode in Opcode
    if opcode not in (Opcode.MESSAGE, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT)}


class DamagedError(Exception):
    """A record is not what it says it is; the text says why."""


class TooLargeError(DamagedError):
    """A record may be right but is larger than what is read into memory."""


@dataclass
class ChunkContents:
    """The content of a chunk whose checksum is right, or of messages outside of chunks."""

    plain: bytes | bytearray    # uncompressed
    # As in message indexes: millions of tiny messages fit into a chunk.
    entries: dict[int, array[int]] = field(default_factory=dict)
    declared: list[Schema | Channel] = field(default_factory=list)
    right: bool = True      # may be copied as a whole

    def messages(self, *, by_time: bool = False) -> Iterator[Message]:
        """Yield the messages in file order, or by log time and equal ones in file order."""
        plain = memoryview(self.plain)
        places = sorted(by_time * time << 64 | offset for numbers in self.entries.values()
                        for time, offset in zip(numbers[::2], numbers[1::2], strict=True))
        for place in places:
            offset = place & (1 << 64) - 1
            _, length, channel_id, sequence, log_time, publish_time = MESSAGE.unpack_from(
                plain, offset)
            yield Message(
                channel_id=channel_id, sequence=sequence, log_time=log_time,
                publish_time=publish_time,
                data=plain[offset + MESSAGE.size:offset + HEAD.size + length].tobytes())


class StrictStream(ReadDataStream):
    """Reading beyond the end raises EndOfFile."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(min(length, sys.maxsize))
        if len(data) != length:
            raise EndOfFile()
        return data


def check_size(size: int, max_bytes: int) -> None:
    """Raise TooLargeError for what is not read into memory."""
    if size > max_bytes:
        raise TooLargeError(f'its {size} bytes are more than max_bytes = {max_bytes}')


def check_declared(size: int) -> None:
    """Raise TooLargeError for too many bytes of schemas, channels and metadata."""
    if size > MAX_DECLARED:
        raise TooLargeError(f'{size} bytes of schemas, channels or metadata are more than '
                            f'the {MAX_DECLARED} that are read')


def name_of(opcode: int) -> str:
    """Return what a kind of record is called in reports."""
    if opcode in set(Opcode):
        return Opcode(opcode).name.lower().replace('_', ' ')
    return f'record of unknown kind {opcode:#04x}'


def parse(raw: bytes) -> tuple[McapRecord, int]:
    """
    Return the record, and how many bytes stand behind its known fields.

    Raises DamagedError, also for messages, message indexes and attachments.
    """
    record_class = _CLASSES.get(raw[0])
    if record_class is None:
        raise DamagedError('there is no such kind of record')
    if record_class is not Chunk:
        check_declared(len(raw))
    stream = StrictStream(BytesIO(raw))
    try:
        stream.read(HEAD.size)
        record: McapRecord = record_class.read(stream)  # type: ignore[attr-defined]
    except McapError:
        raise DamagedError('a length inside of it leads beyond its end') from None
    except UnicodeDecodeError:
        raise DamagedError('a text in it is no UTF-8') from None
    # mcap may run over the end of a map.  A chunk has none, and writing it would copy its data.
    if not isinstance(record, Chunk) and not raw.startswith(
            record_bytes(record)[HEAD.size:], HEAD.size):
        raise DamagedError('its length is not that of its content')
    return record, len(raw) - stream.count


def parse_message_index(raw: bytes) -> tuple[int, array[int], int]:
    """Return the channel of a message index, its entries, and how many bytes stand behind them."""
    extra = len(raw) - INDEX_HEAD.size
    if extra >= 0:
        _, _, channel_id, size = INDEX_HEAD.unpack_from(raw)
        extra -= size
    if extra < 0 or size % ENTRY_SIZE:
        raise DamagedError('its length is not that of its content')
    return channel_id, array('Q', raw[INDEX_HEAD.size:INDEX_HEAD.size + size]), extra


def open_chunk(chunk: Chunk, max_bytes: int) -> ChunkContents:
    """Decompress and check a chunk, whose checksum is 0 if it has none; raises DamagedError."""
    plain = _decompress(chunk, max_bytes)
    if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
        raise DamagedError('its checksum is wrong')
    return break_up(plain)


def break_up(plain: bytes | bytearray) -> ChunkContents:
    """Return the messages and declarations among records that stand one after the other."""
    contents = ChunkContents(plain)
    declared_bytes = offset = 0
    size = len(plain)
    while offset < size:
        if size - offset < HEAD.size:
            raise DamagedError('a record in it is truncated')
        opcode, length = HEAD.unpack_from(plain, offset)
        end = offset + HEAD.size + length
        if end > size:
            raise DamagedError('a record in it leads beyond its end')
        if opcode == _MESSAGE_OPCODE:
            if length < MESSAGE_FIELDS:
                raise DamagedError('a message is shorter than a message can be')
            _, _, channel_id, _, log_time, _ = MESSAGE.unpack_from(plain, offset)
            if channel_id not in contents.entries:
                contents.entries[channel_id] = array('Q')
            contents.entries[channel_id].extend((log_time, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declared_bytes += length
            check_declared(declared_bytes)
            record, extra = parse(bytes(plain[offset:end]))
            contents.right &= not extra         # mcap's reader does not skip what it does not know
            assert isinstance(record, Schema | Channel)
            contents.declared.append(record)
        offset = end
    return contents


def _decompress(chunk: Chunk, max_bytes: int) -> bytes | bytearray:
    """Return the uncompressed bytes of all frames, never more than the chunk states."""
    size = chunk.uncompressed_size
    check_size(size, max_bytes)
    stream: BinaryIO = BytesIO(chunk.data)
    if chunk.compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == 'lz4':
        stream = lz4.frame.open(stream)
    elif chunk.compression:
        raise DamagedError(f'its compression {chunk.compression[:20]!r} is unknown')
    plain = bytearray()
    try:
        while len(plain) < size and (block := stream.read(min(_BLOCK, size - len(plain)))):
            plain += block
        if len(plain) < size or stream.read(1):
            raise DamagedError('it has not the size that it says it has')
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError):
        raise DamagedError('it cannot be decompressed') from None
    return plain
