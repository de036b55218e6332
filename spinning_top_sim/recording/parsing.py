# SPDX-License-Identifier: Apache-2.0
"""Parses records and chunks whose bytes may be wrong: that raises one of UNREADABLE."""

import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.exceptions import McapError
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader

HEAD = struct.Struct('<BQ')     # of every record: opcode, length of what follows
MESSAGE_FIELDS = 2 + 4 + 8 + 8  # bytes of a message before its data
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)


def records_in(raw: bytes) -> Iterator[McapRecord]:
    """Iterate over the records in bytes; UNREADABLE."""
    return StreamReader(BytesIO(raw), skip_magic=True, emit_chunks=True).records


@lru_cache
def message_layout(length: int) -> struct.Struct:
    """Return the layout of a message record of this length; struct.error if it is too small."""
    return struct.Struct(f'<BQHIQQ{length - MESSAGE_FIELDS}s')


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


def unpacked(raw: bytes, max_bytes: int) -> bytes:
    """Return the records in a chunk, which mcap would unpack to any size; UNREADABLE."""
    chunk = next(records_in(raw))
    assert isinstance(chunk, Chunk)
    if chunk.uncompressed_size > max_bytes:
        raise McapError(f'it unpacks to more than {max_bytes} bytes')
    plain = decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
    if len(plain) != chunk.uncompressed_size:
        raise McapError('it has not the size that it says it has')
    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):
        raise McapError('its checksum is wrong')
    return plain
