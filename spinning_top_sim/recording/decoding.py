# SPDX-License-Identifier: Apache-2.0
"""
Decodes MCAP records with mcap's classes, whatever the bytes are.

mcap's classes take a truncated field for a shorter one, and unpack a chunk to any size: here every
read is complete, and sizes have limits.
"""

import struct
import zlib
from array import array
from collections.abc import Mapping
from io import SEEK_END, BufferedReader, BytesIO, FileIO
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from spinning_top_sim.recording.errors import LogError

MAX_SMALL = 16 << 20                # of schemas, channels and metadata, which take ten times that
HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows
MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
# What is raised for bytes that are not as they should be.
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)

_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # compares faster


class LogMessage(NamedTuple):
    """A message of a log."""

    topic: str
    log_time: int       # [ns]
    publish_time: int   # [ns]
    sequence: int       # number in its channel
    data: bytes         # the serialized message
    channel_id: int


class Messages(NamedTuple):
    """The content of a chunk, or adjacent messages outside of chunks."""

    plain: bytes                            # the uncompressed records
    # By channel id log times and offsets in `plain` (n, 2), as in message indexes.
    entries: dict[int, NDArray[np.uint64]]
    declared: list[McapRecord]              # schemas and channels

    def message(self, topics: Mapping[int, str], offset: int) -> LogMessage:
        """Return the message at a place; `topics` are names by channel id."""
        _, length, channel_id, sequence, log_time, publish_time = MESSAGE.unpack_from(
            self.plain, offset)
        return LogMessage(topics[channel_id], log_time, publish_time, sequence,
                          self.plain[offset + MESSAGE.size:offset + HEAD.size + length],
                          channel_id)


class CompleteReads(BufferedReader):
    """
    A file up to the size that it has now, or bytes.

    A read is complete or raises EndOfFile; LogError if the disk fails.
    """

    def __init__(self, raw: FileIO | BytesIO) -> None:
        super().__init__(raw)
        self.size = self.seek(0, SEEK_END)
        self.seek(0)

    def read(self, size: int | None = -1) -> bytes:
        wanted = self.size if size is None or size < 0 else size
        try:
            data = super().read(min(wanted, self.size - self.tell()))
        except OSError as error:
            raise LogError(f'cannot read {self.name}: {error.strerror}') from error
        if len(data) < wanted:
            raise EndOfFile
        return data

    def at(self, offset: int, end: int) -> bytes:
        """Return the bytes there.  EndOfFile if there are fewer."""
        if not 0 <= offset <= end <= self.size:
            raise EndOfFile
        self.seek(offset)
        return self.read(end - offset)


def open_chunk(chunk: Chunk, max_bytes: int) -> Messages:
    """Return the content of a chunk whose checksum, if it has one, is right; UNREADABLE."""
    size = chunk.uncompressed_size
    if size > max_bytes:
        raise McapError(f'it unpacks to {size} bytes, more than the {max_bytes} that are read')
    plain = decompress(chunk.data, chunk.compression, size)
    if len(plain) != size:
        raise McapError('it has not the size that it says it has')
    if chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc:
        raise McapError('its checksum is wrong')
    return find_messages(plain)


def find_messages(plain: bytes) -> Messages:
    """Return the messages and declarations in records that follow one another; UNREADABLE."""
    entries: dict[int, array[int]] = {}     # millions of tiny messages fit into a chunk
    declared: list[McapRecord] = []
    declared_bytes = offset = 0
    while offset < len(plain):
        opcode, length = HEAD.unpack_from(plain, offset)
        end = offset + HEAD.size + length
        if end > len(plain) or (opcode == _MESSAGE_OPCODE and end < offset + MESSAGE.size):
            raise McapError('the length of a record in it is wrong')
        if opcode == _MESSAGE_OPCODE:
            _, _, channel_id, _, log_time, _ = MESSAGE.unpack_from(plain, offset)
            if channel_id not in entries:
                entries[channel_id] = array('Q')
            entries[channel_id].extend((log_time, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            declared_bytes += length
            if declared_bytes > MAX_SMALL:
                raise McapError('its schemas and channels are too large')
            declared.append(parse(plain[offset:end]))
        offset = end
    return Messages(plain, {number: np.frombuffer(numbers, np.uint64).reshape(-1, 2)
                            for number, numbers in entries.items()}, declared)


def parse(raw: bytes) -> McapRecord:
    """Return a record of a known kind from all of its bytes; UNREADABLE."""
    stream = CompleteReads(BytesIO(raw))
    record = next(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
    if stream.tell() != len(raw):
        raise McapError('a length in it is wrong')
    return record


def decompress(data: bytes, compression: str, most: int) -> bytes:
    """Return the uncompressed bytes of all frames, or the first `most` + 1; UNREADABLE."""
    stream: BinaryIO = BytesIO(data)
    if compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
    elif compression == 'lz4':
        stream = lz4.frame.open(stream)
    elif compression:
        raise McapError(f'its compression {compression[:20]!r} is none of zstd, lz4')
    try:
        return stream.read(most + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        raise McapError('it cannot be decompressed') from None
