# SPDX-License-Identifier: Apache-2.0
"""
What the MCAP specification allows, and files that are made to harm a reader.

The files are built record by record with mcap's record classes.
"""

import os
import struct
import subprocess
import sys
import textwrap
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from helpers.mutations import repair
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.writer import MCAP0_MAGIC
from test_recover import (
    ALL_KEPT,
    ROOT,
    SOME_LOST,
    TOPICS,
    records_of,
    run,
    seen_by_mcap,
    seen_by_us,
    write_log,
    write_stranger,
)

from spinning_top_sim.recording import reader as reader_module
from spinning_top_sim.recording import scan
from spinning_top_sim.recording.log_file import LogFile
from spinning_top_sim.recording.mcap_writer import record_bytes
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.writer import create_file

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


# Allowed

def test_extra_fields_and_unknown_kinds_are_no_damage(tmp_path):
    """The specification lets records grow, and gives 0x80 and above to applications."""
    path = tmp_path / 'a.mcap'
    attachment = padded(record_bytes(Attachment(1, 2, 'name', 'x/y', b'data')), b'behind')
    path.write_bytes(closed(
        padded(HEADER, b'new'), padded(SCHEMA, b'\x01\x02\x03'), padded(CHANNEL, b'more'),
        unknown_kind(0x80, b'of an application'), unknown_kind(0x10, b'of the future'),
        padded(chunk_of(message(5, b'1') + message(7, b'2'), 5, 7), b'\x00' * 20),
        padded(record_bytes(MessageIndex(1, [(5, 0), (7, 32)])), b'??'),
        padded(record_bytes(Metadata('note', {'a': 'b'})), b'\x06'), attachment,
        unknown_kind(0xff, b''), data_end_extra=b'!'))
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.damage.lines() == []
        assert reader.metadata == {'note': {'a': 'b'}}
        (topic,) = reader.topics
        assert (topic.name, topic.type_name, topic.metadata) == ('/a', 'thing', {'k': 'v'})
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == [('/a', 5, b'1'), ('/a', 7, b'2')]
    assert seen_by_mcap(output) == seen_by_us(output)
    assert attachment in output.read_bytes()
    with LogReader(output) as reader:
        assert reader.damage.lines() == []


def test_extra_fields_inside_of_a_chunk_are_ignored_and_not_copied(tmp_path):
    """The reader of mcap itself does not skip them there."""
    path = tmp_path / 'a.mcap'
    plain = padded(SCHEMA, b'more') + padded(CHANNEL, b'more') + message(5, b'1')
    path.write_bytes(closed(HEADER, chunk_of(plain)))
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == seen_by_mcap(output) == [('/a', 5, b'1')]


@pytest.mark.parametrize('records', [[HEADER], [HEADER, SCHEMA, CHANNEL]])
def test_a_closed_file_without_summary_and_messages_is_whole(tmp_path, records):
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(*records))
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.damage.lines() == []
    assert seen_by_mcap(recover(path)) == []


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_of_several_frames_is_read_to_its_end(tmp_path, compression):
    compress = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression]
    first, second = message(5, b'first'), message(6, b'second' * 50)
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(HEADER, RAW_CHANNEL, chunk_of(
        first + second, 5, 6, compression, compress(first) + compress(second))))
    assert [data for _, _, data in seen_by_us(path)] == [b'first', b'second' * 50]
    with LogReader(path) as reader:
        assert reader.damage.lossless


def test_a_chunk_that_holds_more_than_it_says_is_not_believed(tmp_path):
    """It has no checksum; only its size shows that it is damaged."""
    plain = message(5, b'first') + message(6, b'second')
    chunk = Chunk(compression='zstd', data=zstandard.compress(plain), uncompressed_crc=0,
                  uncompressed_size=len(message(5, b'first')), message_start_time=5,
                  message_end_time=6)
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(HEADER, RAW_CHANNEL, record_bytes(chunk)))
    with LogReader(path) as reader:
        assert not list(reader.messages()) and reader.damage.lost_chunks == 1


def test_a_whole_log_is_read_by_its_indexes(tmp_path, monkeypatch):
    """A scan of it would read everything before the first message."""
    path = tmp_path / 'a.mcap'
    write_stranger(path, {})

    def refuse(*_, **__):
        raise AssertionError('not needed')
    monkeypatch.setattr(reader_module, 'Scan', refuse)
    assert seen_by_us(path)


@pytest.mark.parametrize('has_summary', [True, False])
@pytest.mark.parametrize(('stamps', 'begin'), [
    ((0, 7), 0), ((7, 10 ** 18), 7), ((), 0), ((0, 0, 10 ** 18 + 1, 10 ** 18 + 5), 10 ** 18 + 1)])
def test_a_message_at_time_0_belongs_to_the_span_but_beside_dates(
        tmp_path, stamps, begin, has_summary):
    path = tmp_path / 'a.mcap'
    file = create_file(path, TOPICS, {}, compression='none')
    for number, stamp in enumerate(stamps):
        file.append(0, stamp, b'')
        if number % 2 == 0:
            file.write_chunk()
    file.write_chunk()
    file.finish()
    if not has_summary:
        path.write_bytes(path.read_bytes()[:-50])
    with LogReader(path) as reader:
        assert reader.whole == has_summary
        assert reader.span == (begin, max(stamps, default=0))
        assert [message.log_time for message in reader.messages()] == list(stamps)


def test_a_summary_that_is_too_large_to_be_parsed_is_no_damage(tmp_path):
    path = tmp_path / 'a.mcap'
    file = create_file(path, TOPICS, {}, compression='none')
    for stamp in range(1, 201):
        file.append(0, stamp, b'')
        file.write_chunk()
    file.finish()
    with LogReader(path, max_bytes=10_000) as reader:
        assert reader.whole and reader.damage.lines() == []
        assert [message.log_time for message in reader.messages()] == list(range(1, 201))


# Damage

@pytest.mark.parametrize(('place', 'wrong'), [
    (0, 1), (1, 1 << 63), (2, 1021), (2, 1 << 63), (3, 0), (3, (1 << 64) - 1)])
def test_a_chunk_index_that_lies_costs_nothing(tmp_path, place, wrong):
    """Its times, its place, or its length; the checksum of the summary is right."""
    path = tmp_path / 'a.mcap'
    messages = write_stranger(path, {})
    content = bytearray(path.read_bytes())
    indexes = [start for opcode, start, _ in records_of(content) if opcode == Opcode.CHUNK_INDEX]
    for number, index in enumerate(indexes[1:]):
        struct.pack_into('<Q', content, index + 9 + 8 * place, abs(wrong - number))
    repair(content)
    path.write_bytes(content)
    assert seen_by_us(path) == messages
    assert seen_by_mcap(recover(path)) == messages


@pytest.mark.parametrize('bit', [0, 3, 7])
def test_a_record_of_another_kind_costs_no_other_chunk(tmp_path, bit):
    """In a truncated file of a stranger: no kind may pass for the end of the data."""
    path = tmp_path / 'a.mcap'
    messages = write_stranger(path, {})
    content = path.read_bytes()
    records = records_of(content)
    last = max(end for opcode, _, end in records if opcode == Opcode.MESSAGE_INDEX)
    chunks = [start for opcode, start, _ in records if opcode == Opcode.CHUNK]
    first = [struct.unpack_from('<Q', content, start + 9)[0] for start in chunks]
    first.append(messages[-1][1] + 1)
    for opcode, start, _ in records:
        if start >= last or start == chunks[0]:     # that chunk has the channels
            continue
        changed = bytearray(content[:last])
        changed[start] ^= 1 << bit
        path.write_bytes(changed)
        lost = range(0)
        if opcode == Opcode.CHUNK:
            number = chunks.index(start)
            lost = range(first[number], first[number + 1])
        read = seen_by_us(path)
        assert [message for message in read if message[1] not in lost] == [
            message for message in messages if message[1] not in lost], (opcode, start)


@pytest.mark.parametrize('truncated', [False, True])
def test_a_summary_behind_a_damaged_end_of_the_data_is_no_data(tmp_path, truncated):
    """Nothing else tells where it begins if the file is truncated, or it is damaged itself."""
    path = tmp_path / 'a.mcap'
    messages = write_stranger(path, {})
    content = bytearray(path.read_bytes())
    records = records_of(content)
    end = next(start for opcode, start, _ in records if opcode == Opcode.DATA_END)
    content[end + 1] ^= 1
    if truncated:
        del content[-10:]
    else:
        index = next(start for opcode, start, _ in records if opcode == Opcode.ATTACHMENT_INDEX)
        content[index + 4] ^= 1
    path.write_bytes(content)
    output = recover(path, SOME_LOST)
    assert seen_by_us(path) == seen_by_mcap(output) == messages
    with open(output, 'rb') as file:
        assert len(list(make_reader(file).iter_attachments())) == 1


@pytest.mark.parametrize('zeros', [9, (1 << 16) - 5])
def test_the_search_finds_every_kind_of_record(tmp_path, zeros):
    """Also across two blocks, and behind a chunk of a wild size; truncated metadata are lost."""
    path = tmp_path / 'a.mcap'
    note = record_bytes(Metadata('note', {'a': 'b'}))
    wild = bytearray(zstd_chunk(message(5, b'x')))
    struct.pack_into('<Q', wild, 9 + 16, 1 << 62)
    parts = (bytes(wild), SCHEMA, CHANNEL, note, chunk_of(message(5, b'1')),
             zstd_chunk(message(6, b'2')) + note[:-1])
    path.write_bytes(MCAP0_MAGIC + HEADER + b''.join(bytes(zeros) + part for part in parts))
    with LogReader(path) as reader:
        assert [message.data for message in reader.messages()] == [b'1', b'2']
        assert (reader.metadata, reader.topics[0].type_name) == ({'note': {'a': 'b'}}, 'thing')
        assert reader.damage.lost_bytes == 6 * zeros + len(wild) + len(note) - 1


def test_a_channel_without_its_schema_is_not_written(tmp_path):
    """Readers refuse the whole file for it; schema 0 means that there is none."""
    path = tmp_path / 'a.mcap'
    raw = record_bytes(Channel(id=2, topic='/raw', message_encoding='x', metadata={},
                               schema_id=0))
    path.write_bytes(closed(HEADER, CHANNEL, raw, chunk_of(
        message(5, b'lost') + message(5, b'kept', channel=2))))
    output = recover(path, SOME_LOST)
    assert seen_by_mcap(output) == [('/raw', 5, b'kept')]
    with open(output, 'rb') as file:
        assert [channel.topic for channel in make_reader(file).get_summary().channels.values()
                ] == ['/raw']


@pytest.mark.parametrize('wrong', [
    Channel(id=1, topic='/a', message_encoding='json', metadata={}, schema_id=9),
    Channel(id=1, topic='/b', message_encoding='json', metadata={}, schema_id=1),
    Channel(id=3, topic='/c', message_encoding='json', metadata={}, schema_id=9),
    Schema(id=1, name='other', encoding='jsonschema', data=b'')])
def test_a_chunk_with_wrong_declarations_is_not_copied(tmp_path, wrong):
    """A reader that goes from the beginning to the end would believe the last one."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(HEADER, SCHEMA, CHANNEL, chunk_of(
        message(4, b'1'), 4, 4), chunk_of(record_bytes(wrong) + message(5, b'2'))))
    output = recover(path)
    with open(output, 'rb') as file:
        read = [(schema.name, channel.topic, message.data) for schema, channel, message
                in NonSeekingReader(file, validate_crcs=True).iter_messages()]
    assert read == [('thing', '/a', b'1'), ('thing', '/a', b'2')]
    with LogReader(output) as reader:
        assert reader.damage.lines() == []


def test_a_channel_that_stands_behind_its_messages_is_enough(tmp_path):
    """As when the first one is damaged, and so is the summary that repeats it."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(MCAP0_MAGIC + HEADER + chunk_of(message(5, b'x')) + RAW_CHANNEL)
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == seen_by_mcap(output) == [('/a', 5, b'x')]
    with LogReader(path) as reader:
        assert reader.damage.lossless


# Bounded memory and time

@pytest.mark.parametrize(('stated_size', 'report'), [
    (100, 'lost: chunk at byte 34'),
    (1 << 62, f'lost: chunk at byte 34 ({{}} bytes): its {1 << 62} bytes are more than the '
              f'{256 << 20} that are read')])
def test_a_chunk_that_would_fill_the_memory_does_not(tmp_path, stated_size, report):
    bomb = record_bytes(Chunk(
        compression='zstd', data=zstandard.ZstdCompressor().compress(bytes(300_000_000)),
        uncompressed_size=stated_size, uncompressed_crc=1, message_start_time=1,
        message_end_time=2))
    path = tmp_path / 'bomb.mcap'
    header = record_bytes(Header(profile='', library=''))
    path.write_bytes(closed(header, bomb))
    tracemalloc.start()
    try:
        with LogReader(path) as reader:
            assert not list(reader.messages())
            assert [loss.what for loss in reader.damage.losses] == ['chunk']
            lines = reader.damage.lines()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 10_000_000
    report = report.format(len(bomb)).replace('byte 34', f'byte {8 + len(header)}')
    assert any(line.startswith(report) for line in lines), lines


@pytest.mark.parametrize('kind', ['chunk', 'metadata'])
def test_a_record_above_the_ceiling_is_refused_alone(tmp_path, kind):
    path = tmp_path / 'a.mcap'
    big = (chunk_of(message(5, bytes(5000))) if kind == 'chunk'
           else record_bytes(Metadata('big', {'k': 'v' * 5000})))
    path.write_bytes(closed(HEADER, RAW_CHANNEL, chunk_of(message(4, b'a'), 4, 4), big,
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


CEILING_MB = 1000       # of the process: about three times max_bytes, and the interpreter


def zstd_chunk(plain: bytes, end: int = 5) -> bytes:
    return chunk_of(plain, 5, end, 'zstd', zstandard.compress(plain))


def tiny_messages() -> bytes:
    return zstd_chunk(message(5, b'') * 300_000)


def long_names() -> bytes:
    return b''.join(zstd_chunk(b''.join(
        record_bytes(Channel(id=number, topic='/' + 'x' * 15_000_000, message_encoding='x',
                             metadata={}, schema_id=0))
        for number in numbers) + message(5, b'')) for numbers in ((2,), (3, 4), (5,), (6,)))


def many_keys() -> bytes:
    channel = record_bytes(Channel(id=2, topic='/b', message_encoding='x', metadata={},
                                   schema_id=0))
    entries = b''.join(b'\x07\0\0\0%07d\0\0\0\0' % number for number in range(1_200_000))
    content = channel[9:-4] + struct.pack('<I', len(entries)) + entries
    return zstd_chunk(unknown_kind(Opcode.CHANNEL, content))


def overlapping() -> bytes:
    return zstd_chunk(message(5, b'') + message(6, bytes(200_000_000)) + message(9, b''), 9) * 3


@pytest.mark.parametrize(('bomb', 'report'), [
    (tiny_messages, '300000'), (long_names, 'lost: chunk'), (many_keys, 'lost: chunk'),
    (overlapping, 'overlap in time')])
def test_memory_has_a_ceiling(tmp_path, bomb, report):
    """Small files that unpack to much."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(HEADER, RAW_CHANNEL, bomb()))
    assert path.stat().st_size < 3_000_000
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(f"""
            import resource
            from spinning_top_sim.recording.reader import LogReader
            from spinning_top_sim.recording.errors import LogError
            from spinning_top_sim.tools.recover import main
            with LogReader({str(path)!r}) as reader:
                try:
                    print(sum(1 for _ in reader.messages()))
                except LogError as error:
                    print(error)
                print(*reader.damage.lines(), sep='\\n')
            main([{str(path)!r}])
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10)
            """)],
        # Not measured by coverage, which takes memory of its own.
        env={name: value for name, value in os.environ.items() if 'COVERAGE' not in name}
        | {'PYTHONPATH': str(ROOT)}, capture_output=True, text=True, timeout=300,
        check=True)
    assert report in done.stdout
    assert int(done.stdout.splitlines()[-1]) < CEILING_MB


def test_a_search_unpacks_a_limited_amount(tmp_path, monkeypatch):
    """Chunks that are small and unpack to much, each with a wrong checksum."""
    unpacked = []
    ordinary = scan.open_chunk
    monkeypatch.setattr(scan, 'open_chunk', lambda chunk, max_bytes: (
        unpacked.append(chunk.uncompressed_size), ordinary(chunk, max_bytes))[1])
    plain = bytearray(zstd_chunk(message(5, bytes(1_000_000))))
    plain[9 + 24] ^= 1
    path = tmp_path / 'a.mcap'
    path.write_bytes(MCAP0_MAGIC + HEADER + b'\x00' + bytes(plain) * 300)
    max_bytes = 2_000_000
    with LogReader(path, max_bytes) as reader:
        assert reader.damage.lost_bytes == path.stat().st_size - len(MCAP0_MAGIC + HEADER)
    assert len(unpacked) > 1
    assert sum(unpacked) < 5 * (path.stat().st_size + max_bytes)


@pytest.mark.parametrize('kind', [
    Opcode.CHUNK, Opcode.METADATA, 0x90])
def test_a_record_of_many_gigabytes_is_not_read(tmp_path, kind):
    """It is a hole in the file: to read it, or to copy it, would take minutes and the disk."""
    path, size = tmp_path / 'a.mcap', 100 << 30
    start = MCAP0_MAGIC + HEADER + RAW_CHANNEL + chunk_of(message(4, b'a'), 4, 4)
    end = closed(chunk_of(message(6, b'c'), 6, 6))[len(MCAP0_MAGIC):]
    with path.open('wb') as file:
        file.write(start + struct.pack('<BQ', kind, size))
        file.seek(size, os.SEEK_CUR)
        file.write(end)
    output = recover(path, SOME_LOST)
    assert [data for _, _, data in seen_by_us(output)] == [b'a', b'c']
    with LogReader(path) as reader:
        (loss,) = reader.damage.losses
        assert loss.bytes == 9 + size


# The output

def test_the_output_has_the_mode_of_the_log(tmp_path):
    path = tmp_path / 'a.mcap'
    write_log(path)
    path.chmod(0o400)
    assert recover(path).stat().st_mode & 0o777 == 0o400
