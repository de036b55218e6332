# SPDX-License-Identifier: Apache-2.0
"""Files that are made to harm a reader: memory, time and sizes have ceilings."""

import os
import struct
import subprocess
import sys
import textwrap

import pytest
import zstandard
from helpers.formats import (
    CHANNEL,
    HEADER,
    RAW_CHANNEL,
    SCHEMA,
    chunk_of,
    closed,
    message,
    recover,
    written,
    zstd_chunk,
)
from helpers.logs import seen_by_us
from helpers.reference import ROOT
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import parsing
from spinning_top_sim.recording.chunks import record_bytes
from spinning_top_sim.recording.log_file import LogFile
from spinning_top_sim.recording.reader import LogReader


def test_a_chunk_that_holds_more_than_it_says_is_not_believed(tmp_path):
    """It has no checksum; only its size shows that it is damaged."""
    plain = message(5, b'first') + message(6, b'second')
    chunk = Chunk(compression='zstd', data=zstandard.compress(plain), uncompressed_crc=0,
                  uncompressed_size=len(message(5, b'first')), message_start_time=5,
                  message_end_time=6)
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, record_bytes(chunk)))
    with LogReader(path) as reader:
        assert not list(reader.messages()) and reader.damage.lost_chunks == 1


@pytest.mark.parametrize('wrong', [
    Channel(id=1, topic='/a', message_encoding='json', metadata={}, schema_id=9),
    Channel(id=1, topic='/b', message_encoding='json', metadata={}, schema_id=1),
    Channel(id=3, topic='/c', message_encoding='json', metadata={}, schema_id=9),
    Schema(id=1, name='other', encoding='jsonschema', data=b'')])
def test_a_chunk_with_wrong_declarations_is_not_copied(tmp_path, wrong):
    """A reader that goes from the beginning to the end would believe the last one."""
    path = written(tmp_path, closed(HEADER, SCHEMA, CHANNEL, chunk_of(
        message(4, b'1'), 4, 4), chunk_of(record_bytes(wrong) + message(5, b'2'))))
    output = recover(path)
    with open(output, 'rb') as file:
        read = [(schema.name, channel.topic, message.data) for schema, channel, message
                in NonSeekingReader(file, validate_crcs=True).iter_messages()]
    assert read == [('thing', '/a', b'1'), ('thing', '/a', b'2')]
    with LogReader(output) as reader:
        assert reader.damage.lines() == []


@pytest.mark.parametrize('kind', ['chunk', 'metadata'])
def test_a_record_above_the_ceiling_is_refused_alone(tmp_path, kind):
    big = (chunk_of(message(5, bytes(5000))) if kind == 'chunk'
           else record_bytes(Metadata('big', {'k': 'v' * 5000})))
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, chunk_of(message(4, b'a'), 4, 4), big,
                                    chunk_of(message(6, b'c'), 6, 6)))
    with LogReader(path, max_bytes=4000) as reader:
        assert [message.data for message in reader.messages()] == [b'a', b'c']
        (loss,) = reader.damage.losses
        assert (loss.what, loss.bytes) == (kind, len(big))
    with LogReader(path) as reader:
        assert len(list(reader.messages())) == (3 if kind == 'chunk' else 2)
        assert reader.damage.lossless


def test_the_search_behind_damage_takes_linear_time(tmp_path, monkeypatch):
    """A file of heads of chunks that all seem to reach to its end."""
    size = 300_000
    head = struct.calcsize('<BQQQQIIQ')
    content = bytearray()
    while len(content) + head < size:
        rest = size - len(content) - head
        content += struct.pack('<BQQQQIIQ', Opcode.CHUNK, head - 9 + rest, 1, 2, rest, 1, 0, rest)
    content += bytes(size - len(content))
    path = tmp_path / 'a.mcap'
    last = chunk_of(message(5, b'x'))
    path.write_bytes(MCAP0_MAGIC + HEADER + b'\x00' + content)
    bytes_read = 0
    read = LogFile.read

    def counting(self, offset, length):
        nonlocal bytes_read
        found = read(self, offset, length)
        bytes_read += len(found)
        return found

    monkeypatch.setattr(LogFile, 'read', counting)
    with LogReader(path) as reader:
        assert reader.damage.lost_bytes == size + 1
    assert bytes_read < 20 * size
    # A true chunk behind a few of them is still found.
    path.write_bytes(MCAP0_MAGIC + HEADER + RAW_CHANNEL + b'\x00' + content[:3 * head] + last)
    assert seen_by_us(path) == [('/a', 5, b'x')]


# Of what is read into memory, and of the process.
MAX_BYTES, CEILING_MB = 32 << 20, 400


def tiny_messages() -> bytes:
    return zstd_chunk(message(5, b'') * 300_000)


def long_names() -> bytes:
    return b''.join(zstd_chunk(b''.join(
        record_bytes(Channel(id=number, topic='/' + 'x' * 15_000_000, message_encoding='x',
                             metadata={}, schema_id=0))
        for number in numbers) + message(5, b'')) for numbers in ((2,), (3, 4), (5,), (6,)))


def overlapping() -> bytes:
    return zstd_chunk(message(5, b'') + message(6, bytes(25_000_000)) + message(9, b''), 9) * 3


def test_memory_has_a_ceiling(tmp_path):
    """Small files that unpack to much, read one after the other in one process."""
    bombs = {tiny_messages: '300000', long_names: 'lost: chunk', overlapping: 'overlap in time'}
    paths = []
    for bomb in bombs:
        paths.append(tmp_path / f'{bomb.__name__}.mcap')
        paths[-1].write_bytes(closed(HEADER, RAW_CHANNEL, bomb()))
        assert paths[-1].stat().st_size < 3_000_000
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(f"""
            import re, sys
            from spinning_top_sim.recording import parsing
            parsing.MAX_BYTES = {MAX_BYTES}
            from spinning_top_sim.recording.reader import LogReader
            from spinning_top_sim.recording.errors import LogError
            from spinning_top_sim.tools.recover import main
            for path in sys.argv[1:]:
                with LogReader(path) as reader:
                    try:
                        print(sum(1 for _ in reader.messages()))
                    except LogError as error:
                        print(error)
                    print(*reader.damage.lines(), sep='\\n')
                main([path])
                print('====')
            # Not ru_maxrss, which begins with that of the process that started this one.
            status = open('/proc/self/status').read()
            print(int(re.search(r'VmHWM:\\s*(\\d+)', status)[1]) >> 10)
            """), *paths],
        # Not measured by coverage, which takes memory of its own.
        env={name: value for name, value in os.environ.items() if 'COVERAGE' not in name}
        | {'PYTHONPATH': str(ROOT)}, capture_output=True, text=True, timeout=300,
        check=True)
    *said, most = done.stdout.split('====\n')
    for report, text in zip(bombs.values(), said, strict=True):
        assert report in text
    assert int(most) < CEILING_MB


def test_a_search_unpacks_a_limited_amount(tmp_path, monkeypatch):
    """Chunks that are small and unpack to much, each with a wrong checksum."""
    unpacked = []
    ordinary = parsing.open_chunk
    monkeypatch.setattr(parsing, 'open_chunk', lambda chunk, max_bytes: (
        unpacked.append(chunk.uncompressed_size), ordinary(chunk, max_bytes))[1])
    plain = bytearray(zstd_chunk(message(5, bytes(1_000_000))))
    plain[9 + 24] ^= 1
    path = written(tmp_path, MCAP0_MAGIC + HEADER + b'\x00' + bytes(plain) * 300)
    max_bytes = 2_000_000
    with LogReader(path, max_bytes) as reader:
        assert reader.damage.lost_bytes == path.stat().st_size - len(MCAP0_MAGIC + HEADER)
    assert len(unpacked) > 1
    assert sum(unpacked) < 5 * (path.stat().st_size + max_bytes)
