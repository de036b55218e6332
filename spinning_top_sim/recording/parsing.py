# SPDX-License-Identifier: Apache-2.0
"""
Parses MCAP records whose bytes may be wrong: mcap's record classes, and DamagedError.

mcap's classes take a truncated field for a shorter one.  Here every length must fit the record.
Bytes behind the known fields are allowed, because later versions of the format may add fields.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, McapRecord
from mcap.stream_reader import StreamReader

from spinning_top_sim.recording.chunks import ENTRY_SIZE, INDEX_HEAD, MESSAGE, record_bytes

MAX_BYTES = 256 << 20               # of one record or one uncompressed chunk in memory
MAX_DECLARED = 16 << 20             # of schemas, channels or metadata, which take ten times that
HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows

_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # compares faster


class DamagedError(Exception):
    """A record cannot be decoded; the text says why."""


class LogMessage(NamedTuple):
    """
    A message of a log.

    Parameters
    ----------
    topic : str
        Name of the topic.
    log_time, publish_time : int
        Times of the record [ns].
    sequence : int
        Number in its channel.
    data : bytes
        The serialized message.
    channel_id : int
        Number of its channel.
    """

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes
    channel_id: int


@dataclass
class Messages:
    """The messages of a chunk, or adjacent ones outside of chunks."""

    plain: bytes    # the uncompressed records
    # As in message indexes: millions of tiny messages fit into a chunk.
    entries: dict[int, array[int]] = field(default_factory=dict)
    declared: list[McapRecord] = field(default_factory=list)    # schemas and channels

    def in_order(self, topics: Mapping[int, str], *, by_time: bool = False,
                 ) -> Iterator[LogMessage]:
        """
        Yield the messages in file order, or by log time and equal ones in file order.

        topics : names by channel id; messages of other channels are left out
        """
        entries = [np.frombuffer(numbers, np.uint64).reshape(-1, 2)
                   for channel_id, numbers in self.entries.items() if channel_id in topics]
        if not entries:
            return
        times, offsets = np.concatenate(entries).T
        for place in np.lexsort((offsets, times) if by_time else (offsets,)):
            offset = int(offsets[place])
            _, length, channel_id, sequence, log_time, publish_time = MESSAGE.unpack_from(
                self.plain, offset)
            yield LogMessage(
                topics[channel_id], log_time, publish_time, sequence,
                self.plain[offset + MESSAGE.size:offset + HEAD.size + length], channel_id)


class _Record(BytesIO):
    """The bytes of a record; reading beyond its end raises EndOfFile."""

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        if len(data) != size:
            raise EndOfFile
        return data


def check_size(size: int, limit: int) -> None:
    """Raise DamagedError for more bytes than are read into memory."""
    if size > limit:
        raise DamagedError(f'its {size} bytes are more than the {limit} that are read')


def parse(raw: bytes) -> McapRecord:
    """Return a record of a known kind from all of its bytes; raises DamagedError."""
    if raw[0] not in (Opcode.CHUNK, Opcode.ATTACHMENT):
        check_size(len(raw), MAX_DECLARED)
    try:
        record = next(StreamReader(_Record(raw), skip_magic=True, emit_chunks=True).records)
    except (McapError, OverflowError, UnicodeDecodeError):
        raise DamagedError('a length or a text in it is wrong') from None
    # mcap reads a map beyond its end.
    if not isinstance(record, Chunk | Attachment) and not raw.startswith(
            record_bytes(record)[HEAD.size:], HEAD.size):
        raise DamagedError('a length in it is wrong')
    return record


def size_of(record: McapRecord) -> int:
    """Return the size of a record without fields of later versions [bytes]."""
    if isinstance(record, Chunk | Attachment):      # whose data are not copied
        return len(record_bytes(replace(record, data=b''))) + len(record.data)
    return len(record_bytes(record))


def index_entries(raw: bytes) -> int:
    """Return the number of entries of a message index; raises DamagedError."""
    entries, rest = divmod(int.from_bytes(raw[INDEX_HEAD.size - 4:INDEX_HEAD.size], 'little'),
                           ENTRY_SIZE)
    if rest or INDEX_HEAD.size + entries * ENTRY_SIZE > len(raw):
        raise DamagedError('a length in it is wrong')
    return entries


def open_chunk(chunk: Chunk, max_bytes: int) -> Messages:
    """Return the content of a chunk whose checksum, if it has one, is right; DamagedError."""
    plain = _decompress(chunk, max_bytes)
    if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
        raise DamagedError('its checksum is wrong')
    return find_messages(plain)


def find_messages(plain: bytes) -> Messages:
    """Return the messages and declarations in records that follow one another; DamagedError."""
    found = Messages(plain)
    declared_bytes = offset = 0
    size = len(plain)
    while offset < size:
        if size - offset < HEAD.size:
            raise DamagedError('a record in it is truncated')
        opcode, length = HEAD.unpack_from(plain, offset)
        end = offset + HEAD.size + length
        if end > size or (opcode == _MESSAGE_OPCODE and end < offset + MESSAGE.size):
            raise DamagedError('the length of a record in it is wrong')
        if opcode == _MESSAGE_OPCODE:
            _, _, channel_id, _, log_time, _ = MESSAGE.unpack_from(plain, offset)
            if channel_id not in found.entries:
                found.entries[channel_id] = array('Q')
            found.entries[channel_id].extend((log_time, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declared_bytes += length
            check_size(declared_bytes, MAX_DECLARED)
            found.declared.append(parse(plain[offset:end]))
        offset = end
    return found


def _decompress(chunk: Chunk, max_bytes: int) -> bytes:
    """Return the uncompressed bytes of all frames; never takes more than the chunk states."""
    size = chunk.uncompressed_size
    check_size(size, max_bytes)
    stream: BinaryIO = BytesIO(chunk.data)
    if chunk.compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == 'lz4':
        stream = lz4.frame.open(stream)
    elif chunk.compression:
        raise DamagedError(f'its compression {chunk.compression[:20]!r} is unknown')
    try:
        plain = stream.read(size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError):
        raise DamagedError('it cannot be decompressed') from None
    if len(plain) != size:
        raise DamagedError('it has not the size that it says it has')
    return plain
