# SPDX-License-Identifier: Apache-2.0
"""
Mutated MCAP logs: what a disk, a truncated copy or an attacker may make of a file.

`mutate` also repairs checksums, so that readers get beyond them, and changes the records inside
of chunks.  The records are found by their lengths alone; nothing of this package is used.
"""

import random
import struct
import zlib
from io import BytesIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import Chunk

MAGIC_SIZE = 8
HEAD = struct.Struct('<BQ')         # opcode, length
FOOTER, CHUNK, DATA_END = 0x02, 0x06, 0x0f
DATA_END_SIZE, FOOTER_SIZE = 13, 29
CODECS = {'zstd': (zstandard.decompress, zstandard.compress),
          'lz4': (lz4.frame.decompress, lz4.frame.compress)}
NUMBERS = (0, 1, 2, 15, 0x7f, 0x80, 0xff, 0xffff, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 62,
           (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a mutation of a log that depends on these random numbers alone."""
    changed = bytearray(data)
    chunks = [place for place in records(changed) if changed[place[0]] == CHUNK]
    if chunks and rng.random() < 0.4:
        _mutate_in_chunk(changed, *rng.choice(chunks), rng)
    else:
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            _change(changed, records(changed), rng)
    if rng.random() < 0.5:
        repair(changed)
    if rng.random() < 0.15:
        del changed[rng.randrange(len(changed) + 1):]
    return bytes(changed)


def records(data: bytes | bytearray, offset: int = MAGIC_SIZE) -> list[tuple[int, int]]:
    """Return begin and end of each record, as far as their lengths lead."""
    found = []
    while offset + HEAD.size <= len(data):
        end = offset + HEAD.size + HEAD.unpack_from(data, offset)[1]
        if end > len(data):
            break
        found.append((offset, end))
        offset = end
    return found


def repair(data: bytearray) -> None:
    """Make the checksums of the data section and of the summary right, where these are."""
    for begin, end in records(data):
        if data[begin] == DATA_END and end - begin == DATA_END_SIZE:
            struct.pack_into('<I', data, begin + HEAD.size, zlib.crc32(data[:begin]))
        if data[begin] == FOOTER and end - begin == FOOTER_SIZE:
            start, = struct.unpack_from('<Q', data, begin + HEAD.size)
            if 0 < start <= begin:
                struct.pack_into('<I', data, end - 4, zlib.crc32(data[start:end - 4]))


def _change(data: bytearray, places: list[tuple[int, int]], rng: random.Random) -> None:
    """Change a record of a file or of a chunk, seldom the whole: bits, numbers, bytes, places."""
    begin, end = rng.choice(places) if places and rng.random() < 0.95 else (0, len(data))
    at = rng.randrange(begin, end + 1)
    kind = rng.choice(('bit', 'number', 'number', 'remove', 'copy'))
    if kind == 'bit' and at < end:
        data[at] ^= 1 << rng.randrange(8)
    elif kind == 'number':      # opcodes, lengths, counts, stamps, ids are all in the first fields
        size, at = rng.choice((1, 2, 4, 8)), begin + rng.randrange(48)
        number = rng.choice((*NUMBERS, end - begin - 8, len(data), rng.randrange(len(data) + 1)))
        if at + size <= end:
            data[at:at + size] = (number & (1 << 8 * size) - 1).to_bytes(size, 'little')
    elif kind == 'remove':
        del data[begin if rng.random() < 0.5 else at:end]
    elif kind == 'copy':
        data[at:at] = bytes(data[begin:end]) * rng.choice((1, 1, 2, 20))


def _mutate_in_chunk(data: bytearray, begin: int, end: int, rng: random.Random) -> None:
    """Change records inside of a chunk, whose checksum is mostly right then."""
    chunk = Chunk.read(ReadDataStream(BytesIO(data[begin + HEAD.size:end])))
    unpack, pack = CODECS.get(chunk.compression, (bytes, bytes))
    content = bytearray(unpack(chunk.data))
    for _ in range(rng.choice((1, 1, 3))):
        _change(content, records(content, 0), rng)
    chunk.uncompressed_size = len(content) if rng.random() < 0.8 else rng.choice(NUMBERS)
    chunk.uncompressed_crc = zlib.crc32(content) if rng.random() < 0.8 else rng.choice((0, 1))
    chunk.data, builder = pack(bytes(content)), RecordBuilder()
    chunk.write(builder)
    data[begin:end] = builder.end()
