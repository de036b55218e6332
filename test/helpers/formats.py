# SPDX-License-Identifier: Apache-2.0
"""Records of MCAP files, built one by one."""

import struct
import zlib
from pathlib import Path

import zstandard
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message, Schema
from mcap.writer import MCAP0_MAGIC

from helpers.logs import ALL_KEPT, run
from spinning_top_sim.recording.writer import record_bytes

HEADER = record_bytes(Header(profile='', library='a stranger'))
SCHEMA = record_bytes(Schema(id=1, name='thing', encoding='jsonschema', data=b'{}'))
CHANNEL = record_bytes(Channel(id=1, topic='/a', message_encoding='json', metadata={'k': 'v'},
                               schema_id=1))
RAW_CHANNEL = record_bytes(Channel(id=1, topic='/a', message_encoding='x', metadata={},
                                   schema_id=0))


def message(log_time: int, data: bytes, channel: int = 1) -> bytes:
    return record_bytes(Message(channel_id=channel, log_time=log_time, publish_time=log_time,
                                sequence=0, data=data))


def chunk_of(plain: bytes, start: int = 5, end: int = 5, compression: str = '',
             data: bytes | None = None) -> bytes:
    return record_bytes(Chunk(
        compression=compression, data=plain if data is None else data,
        uncompressed_size=len(plain), uncompressed_crc=zlib.crc32(plain),
        message_start_time=start, message_end_time=end))


def written(folder: Path, content: bytes) -> Path:
    path = folder / 'a.mcap'
    path.write_bytes(content)
    return path


def padded(record: bytes, extra: bytes) -> bytes:
    opcode, length = struct.unpack_from('<BQ', record)
    return struct.pack('<BQ', opcode, length + len(extra)) + record[9:] + extra


def unknown_kind(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def closed(*records: bytes, data_end_extra: bytes = b'') -> bytes:
    """Return a file without summary, with the checksum of its data section."""
    content = MCAP0_MAGIC + b''.join(records)
    return b''.join([
        content, padded(record_bytes(DataEnd(zlib.crc32(content))), data_end_extra),
        record_bytes(Footer(summary_start=0, summary_offset_start=0, summary_crc=0)), MCAP0_MAGIC])


def recover(path: Path, expected: int = ALL_KEPT) -> Path:
    output = path.with_name('whole.mcap')
    code, out, err = run(path, '-o', output)
    assert code == expected, (out, err)
    return output


def zstd_chunk(plain: bytes, end: int = 5) -> bytes:
    return chunk_of(plain, 5, end, 'zstd', zstandard.compress(plain))
