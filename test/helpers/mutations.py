# SPDX-License-Identifier: Apache-2.0
"""
Mutated MCAP logs: what a disk, a truncated copy or an attacker may make of a file.

`mutate` also repairs checksums, so that readers get beyond them, and changes the records inside
of chunks.  The records are found by their lengths alone; nothing of this package is used.
"""

import random
import struct
import zlib

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MAGIC_SIZE = 8
HEAD = struct.Struct('<BQ')         # opcode, length
FOOTER, CHUNK, DATA_END = 0x02, 0x06, 0x0f
DATA_END_SIZE, FOOTER_SIZE = 13, 29
CHUNK_FIELDS = struct.Struct('<QQQI')   # times, uncompressed size and checksum
NUMBERS = (0, 1, 2, 15, 0x7f, 0x80, 0xff, 0xffff, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 62,
           (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return a mutation of a log that depends on these random numbers alone."""
    changed = bytearray(data)
    if rng.random() < 0.4:
        _mutate_in_chunk(changed, rng)
    else:
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            rng.choice(_CHANGES)(changed, records(changed), rng)
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


# Each changes the records of a file, or those of a chunk; `places` are theirs.

def _flip_bit(data, places, rng):
    begin, end = _place(data, places, rng)
    if begin < end:
        data[rng.randrange(begin, end)] ^= 1 << rng.randrange(8)


def _overwrite(data, places, rng):
    begin, end = _place(data, places, rng)
    size = rng.choice((1, 2, 4, 8, 64))
    at = rng.randrange(begin, end + 1)
    data[at:at + size] = rng.choice((rng.randbytes(size), bytes(size), b'\xff' * size))


def _set_number(data, places, rng):
    """Lengths, counts, offsets, stamps and ids are all somewhere in the first fields."""
    begin, end = _place(data, places, rng)
    size = rng.choice((1, 2, 4, 8))
    at = begin + rng.randrange(48)
    number = rng.choice((*NUMBERS, len(data), rng.randrange(len(data) + 1)))
    if at + size <= end:
        data[at:at + size] = (number & (1 << 8 * size) - 1).to_bytes(size, 'little')


def _set_length(data, places, rng):
    begin, end = _place(data, places, rng)
    if end - begin >= HEAD.size:
        length = end - begin - HEAD.size + rng.choice((-9, -2, -1, 1, 2, 8, 9, 1000))
        struct.pack_into('<Q', data, begin + 1, rng.choice((max(0, length), *NUMBERS)))


def _set_kind(data, places, rng):
    begin, end = _place(data, places, rng)
    if begin < end:
        data[begin] = rng.choice((rng.randrange(16), rng.randrange(256)))


def _remove(data, places, rng):
    begin, end = _place(data, places, rng)
    if rng.random() < 0.5:
        begin = rng.randrange(begin, end + 1)
        end = min(len(data), begin + rng.choice((1, 2, 9, 100)))
    del data[begin:end]


def _copy(data, places, rng):
    """Repeat a record, or put it where another one is."""
    begin, end = _place(data, places, rng)
    to, _ = _place(data, places, rng)
    record = bytes(data[begin:end])
    data[to:to if rng.random() < 0.5 else to + len(record)] = record * rng.choice((1, 1, 2, 20))


def _pad(data, places, rng):
    """Let a record have more fields, with its length; or insert bytes between two."""
    begin, end = _place(data, places, rng)
    extra = rng.choice((rng.randbytes, bytes))(rng.choice((1, 4, 9, 300)))
    if rng.random() < 0.7 and end - begin >= HEAD.size:
        struct.pack_into('<Q', data, begin + 1, end - begin - HEAD.size + len(extra))
    data[end:end] = extra


_CHANGES = (_flip_bit, _flip_bit, _overwrite, _set_number, _set_number, _set_length, _set_kind,
            _remove, _copy, _pad)


def _place(data, places, rng) -> tuple[int, int]:
    """Choose a record, seldom the whole."""
    return rng.choice(places) if places and rng.random() < 0.95 else (0, len(data))


def _mutate_in_chunk(data: bytearray, rng) -> None:
    """Change records inside of a chunk, or what the chunk says of itself."""
    chunks = [place for place in records(data) if data[place[0]] == CHUNK]
    if not chunks:
        return
    begin, end = rng.choice(chunks)
    start_time, end_time, size, _ = CHUNK_FIELDS.unpack_from(data, begin + HEAD.size)
    at = begin + HEAD.size + CHUNK_FIELDS.size
    compression = bytes(data[at + 4:at + 4 + int.from_bytes(data[at:at + 4], 'little')])
    packed = bytes(data[at + 4 + len(compression) + 8:end])
    if compression == b'zstd':
        content = bytearray(zstandard.decompress(packed, max_output_size=size))
    elif compression == b'lz4':
        content = bytearray(lz4.frame.decompress(packed))
    else:
        content = bytearray(packed)
    for _ in range(rng.choice((1, 1, 3))):
        rng.choice(_CHANGES)(content, records(content, 0), rng)
    size = len(content) if rng.random() < 0.8 else rng.choice(NUMBERS)
    crc = zlib.crc32(content) if rng.random() < 0.8 else rng.choice((0, 1))
    if rng.random() < 0.1:
        compression = rng.choice((b'', b'zstd', b'lz4', b'\xff'))
    if compression == b'zstd':
        packed = zstandard.compress(content)
    elif compression == b'lz4':
        packed = lz4.frame.compress(bytes(content))
    else:
        packed = bytes(content)
    body = b''.join([
        CHUNK_FIELDS.pack(start_time, end_time, size, crc), struct.pack('<I', len(compression)),
        compression, struct.pack('<Q', len(packed)), packed])
    _replace_record(data, begin, end, HEAD.pack(CHUNK, len(body)) + body)


def _replace_record(data: bytearray, begin: int, end: int, record: bytes) -> None:
    """Put a record of another length, and let the footer still lead to the summary."""
    data[begin:end] = record
    for start, stop in records(data):
        if data[start] == FOOTER and stop - start == FOOTER_SIZE:
            summary, offsets = struct.unpack_from('<QQ', data, start + HEAD.size)
            shift = len(record) - (end - begin)
            struct.pack_into('<QQ', data, start + HEAD.size,
                             summary and (summary + shift) % (1 << 64),
                             offsets and (offsets + shift) % (1 << 64))
