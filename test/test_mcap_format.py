# SPDX-License-Identifier: Apache-2.0
"""
Logs of others: what the MCAP specification and rosbag2 allow, and files made to harm a reader.

The files are built record by record with mcap's record classes, or by mcap's writer.
"""

import os
import re
import shlex
import struct
import subprocess
import sys
import textwrap

import lz4.frame  # type: ignore[import-untyped]
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
    padded,
    recover,
    unknown_kind,
    written,
    zstd_chunk,
)
from helpers.logs import (
    ALL_KEPT,
    FAILED,
    SOME_LOST,
    STRANGERS,
    TOPICS,
    records_of,
    run,
    seen_by_mcap,
    seen_by_us,
    write_anew,
    write_bag,
    write_stranger,
)
from helpers.mutations import repair
from helpers.recordings import write_rows
from helpers.reference import ROOT
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Attachment, Channel, Chunk, Header, MessageIndex, Metadata, Schema
from rosbags.highlevel import AnyReader

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.writer import record_bytes


def test_extra_fields_and_unknown_kinds_are_no_damage(tmp_path):
    """The specification lets records grow, and gives 0x80 and above to applications."""
    path = written(tmp_path, closed(
        padded(HEADER, b'new'), padded(SCHEMA, b'\x01\x02\x03'), padded(CHANNEL, b'more'),
        unknown_kind(0x80, b'of an application'), unknown_kind(0x10, b'of the future'),
        padded(chunk_of(message(5, b'1') + message(7, b'2'), 5, 7), b'\x00' * 20),
        padded(record_bytes(MessageIndex(1, [(5, 0), (7, 32)])), b'??'),
        padded(record_bytes(Metadata('note', {'a': 'b'})), b'\x06'),
        padded(record_bytes(Attachment(1, 2, 'name', 'x/y', b'data')), b'behind'),
        unknown_kind(0xff, b''), data_end_extra=b'!'))
    with LogReader(path) as reader:
        assert reader.whole and reader.damage.lines() == []
        assert reader.metadata == {'note': {'a': 'b'}}
        (topic,) = reader.topics
        assert (topic.name, topic.type_name) == ('/a', 'thing')
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == [('/a', 5, b'1'), ('/a', 7, b'2')]
    assert seen_by_mcap(output) == seen_by_us(output)
    with open(output, 'rb') as file:
        assert [one.data for one in make_reader(file).iter_attachments()] == [b'data']


@pytest.mark.parametrize('records', [[HEADER], [HEADER, SCHEMA, CHANNEL]])
def test_a_closed_file_without_summary_and_messages_is_whole(tmp_path, records):
    path = written(tmp_path, closed(*records))
    with LogReader(path) as reader:
        assert reader.whole and reader.damage.lines() == [] and reader.span == (0, 0)
    assert seen_by_mcap(recover(path)) == []


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_of_several_frames_is_read_to_its_end(tmp_path, compression):
    compress = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression]
    first, second = message(5, b'first'), message(6, b'second' * 50)
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, chunk_of(
        first + second, 5, 6, compression, compress(first) + compress(second))))
    assert [data for _, _, data in seen_by_us(path)] == [b'first', b'second' * 50]


@pytest.mark.parametrize('has_summary', [True, False])
@pytest.mark.parametrize(('stamps', 'begin'), [
    ((0, 7), 0), ((7, 10 ** 18), 7), ((), 0), ((0, 0, 10 ** 18 + 1, 10 ** 18 + 5), 10 ** 18 + 1)])
def test_a_message_at_time_0_belongs_to_the_span_but_beside_dates(
        tmp_path, stamps, begin, has_summary):
    path = tmp_path / 'a.mcap'
    write_rows(path, TOPICS, [(0, stamp, b'') for stamp in stamps], per_chunk=2)
    if not has_summary:
        path.write_bytes(path.read_bytes()[:-50])
    with LogReader(path) as reader:
        assert reader.whole == has_summary
        assert reader.span == (begin, max(stamps, default=0))
        assert [message.log_time for message in reader.messages()] == list(stamps)


@pytest.mark.parametrize('kind', STRANGERS)
def test_a_strangers_file_is_read_and_recovered(tmp_path, kind):
    path, output = tmp_path / 'stranger.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS[kind])
    assert seen_by_us(path) == messages
    with LogReader(path) as reader:
        assert reader.whole and reader.damage.lines() == []
        assert reader.metadata == {'note': {'a': 'ä', 'b': ''}}
        assert [(topic.name, topic.type_name, topic.encoding) for topic in reader.topics] == [
            ('/json', 'thing', 'json'), ('/raw', '', 'octets')]
        assert reader.compression == ('', '')
    code, out, err = run(path, '-o', output)
    assert code == ALL_KEPT, (out, err)
    assert seen_by_us(output) == seen_by_mcap(output) == messages
    with open(output, 'rb') as file:
        reader = make_reader(file)
        assert reader.get_header() == Header(profile='', library='a stranger')
        assert [(record.name, record.metadata) for record in reader.iter_metadata()] == [
            ('note', {'a': 'ä', 'b': ''})]
        (attachment,) = reader.iter_attachments()
        assert [message.publish_time for _, _, message in reader.iter_messages()] == [
            stamp + 1000 for _, stamp, _ in messages]
    assert (attachment.name, attachment.media_type, attachment.data) == (
        'calibration.bin', 'x/y', b'\x06' * 3000)


def test_a_torn_file_of_a_stranger_keeps_what_stands_before_the_tear(tmp_path, no_sync):
    path, torn, output = (tmp_path / name for name in ('a.mcap', 'torn.mcap', 'whole.mcap'))
    messages = write_stranger(path, STRANGERS['unchunked'], count=60)
    content = path.read_bytes()
    ends = [end for opcode, _, end in records_of(content) if opcode == Opcode.MESSAGE]
    for size in range(8, len(content), 101):
        write_anew(torn, content[:size])
        kept = sum(end <= size for end in ends)
        code, _, err = run(torn, '-o', output)
        assert (code == FAILED) == (kept == 0), (size, err)
        if kept:
            assert seen_by_us(output) == seen_by_mcap(output) == messages[:kept], size
            output.unlink()


def test_messages_in_and_out_of_chunks_keep_their_order(tmp_path):
    """All have one stamp, so that only their places in the file order them."""
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, message(5, b'a'), chunk_of(
        message(5, b'b') + message(5, b'c')), message(5, b'd')))
    output = recover(path)
    for file in (path, output):
        assert [data for _, _, data in seen_by_us(file)] == [b'a', b'b', b'c', b'd']
    with open(output, 'rb') as file:
        assert [message.data for _, _, message in make_reader(file).iter_messages(
            log_time_order=False)] == [b'a', b'b', b'c', b'd']


# ------------------------------------------------------------------------------------ rosbag2

@pytest.mark.parametrize('form', ['zstd', 'lz4'])
@pytest.mark.parametrize('told_by', ['record', 'metadata.yaml'])
def test_messages_that_rosbag2_compressed_are_decompressed_and_recover_keeps_the_mode(
        tmp_path, form, told_by):
    compress = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[form]
    messages = write_bag(tmp_path / 'bag', 'MESSAGE', form, compress, record=told_by == 'record')
    (tmp_path / 'new').mkdir()
    output = tmp_path / 'new' / 'new.mcap'
    assert run(tmp_path / 'bag', '-o', output)[0] == ALL_KEPT
    for place in (tmp_path / 'bag', output):
        with LogReader(place) as reader:
            assert reader.compression == ('MESSAGE', form)
            assert [one.data for one in reader.messages()] == messages
    if form == 'zstd':      # rosbags knows no other
        text = reader.metadata['rosbag2']['serialized_metadata'].replace('\n', '\n  ')
        (tmp_path / 'new' / 'metadata.yaml').write_text(f'rosbag2_bagfile_information:\n  {text}')
        with AnyReader([tmp_path / 'new']) as bag:
            assert [bytes(data) for _, _, data in bag.messages()] == messages


@pytest.mark.parametrize(('form', 'compress', 'reason'), [
    ('zstd', lambda data: data, 'cannot be decompressed'),
    ('snappy', zstandard.compress, "compression 'snappy' is none of zstd, lz4")])
def test_messages_that_cannot_be_decompressed_are_named(tmp_path, form, compress, reason):
    write_bag(tmp_path / 'bag', 'MESSAGE', form, compress)
    with LogReader(tmp_path / 'bag') as reader, pytest.raises(
            LogError, match=rf'bag_0\.mcap: a message of /said: its? .*{reason}'):
        list(reader.messages())


@pytest.mark.parametrize(('form', 'compress', 'split'), [
    ('zstd', zstandard.compress, 1), ('lz4', lz4.frame.compress, 1), ('zstd', None, 3)])
def test_a_file_that_is_compressed_and_a_split_bag_are_refused(tmp_path, form, compress, split):
    write_bag(tmp_path / 'bag', 'FILE' if compress else '', form, compress, split)
    with pytest.raises(LogError) as caught:
        LogReader(tmp_path / 'bag')
    if split > 1:
        assert str(caught.value).endswith('in it: bag_0.mcap, bag_1.mcap, bag_2.mcap')
        return
    file = tmp_path / 'bag' / f'bag_0.mcap.{form}'
    assert f'cannot read {file}: it is compressed as a whole' in str(caught.value)
    command, *arguments = shlex.split(str(caught.value).partition('unpack it by ')[2])
    assert (command, arguments[1], arguments[-1]) == (form, str(file), f'{file.parent}/bag_0.mcap')


# ------------------------------------------------------------------------------------- hostile

def test_a_chunk_that_holds_more_than_it_says_is_not_believed(tmp_path):
    """It has no checksum; only its size shows that it is damaged."""
    plain = message(5, b'first') + message(6, b'second')
    chunk = Chunk(compression='zstd', data=zstandard.compress(plain), uncompressed_crc=0,
                  uncompressed_size=len(message(5, b'first')), message_start_time=5,
                  message_end_time=6)
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, record_bytes(chunk)))
    with LogReader(path) as reader:
        assert not list(reader.messages()) and reader.damage.lost_bytes == len(record_bytes(chunk))


@pytest.mark.parametrize('wrong', [
    Channel(id=1, topic='/a', message_encoding='json', metadata={}, schema_id=9),
    Channel(id=1, topic='/b', message_encoding='json', metadata={}, schema_id=1),
    Schema(id=1, name='other', encoding='jsonschema', data=b''), None])
def test_a_chunk_that_declares_wrongly_or_not_at_all_is_left_out(tmp_path, wrong):
    """A reader that goes from the beginning to the end would believe the last one."""
    bad = record_bytes(wrong) + message(5, b'2') if wrong else message(5, b'2', channel=7)
    path = written(tmp_path, closed(HEADER, SCHEMA, CHANNEL, chunk_of(
        message(4, b'1'), 4, 4), chunk_of(bad), chunk_of(message(6, b'3'), 6, 6)))
    output = recover(path, SOME_LOST)
    with open(output, 'rb') as file:
        read = [(schema.name, channel.topic, message.data) for schema, channel, message
                in NonSeekingReader(file, validate_crcs=True).iter_messages()]
    assert read == [('thing', '/a', b'1'), ('thing', '/a', b'3')]


@pytest.mark.parametrize('kind', ['chunk', 'metadata'])
def test_a_record_above_the_ceiling_is_refused_alone(tmp_path, kind):
    big = (chunk_of(message(5, bytes(5000))) if kind == 'chunk'
           else record_bytes(Metadata('big', {'k': 'v' * 5000})))
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, chunk_of(message(4, b'a'), 4, 4), big,
                                    chunk_of(message(6, b'c'), 6, 6)))
    with LogReader(path, max_bytes=4000) as reader:
        assert [message.data for message in reader.messages()] == [b'a', b'c']
        assert reader.damage.lost_bytes == len(big)
        assert 'more than 4000 bytes' in reader.damage.reasons[0]
    with LogReader(path) as reader:
        assert len(list(reader.messages())) == (3 if kind == 'chunk' else 2)
        assert not reader.damage.lines()


@pytest.mark.parametrize(('place', 'wrong'), [
    (2, 1021), (2, 1 << 63), (3, 0), (3, (1 << 64) - 1)])
def test_a_chunk_index_that_lies_costs_its_chunks_at_most(tmp_path, place, wrong):
    """Its place, or its length; the checksum of the summary is right."""
    path = tmp_path / 'a.mcap'
    messages = write_stranger(path, {})
    content = bytearray(path.read_bytes())
    _, *indexes = [start for opcode, start, _ in records_of(content)
                   if opcode == Opcode.CHUNK_INDEX]
    for index in indexes:
        struct.pack_into('<Q', content, index + 9 + 8 * place, wrong)
    repair(content)
    path.write_bytes(content)
    with LogReader(path) as reader:
        assert [*reader.messages()] and reader.left_out == len(indexes)
    assert seen_by_mcap(recover(path)) == messages


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


def zeros() -> bytes:
    return bytes(2_900_000)


def test_memory_and_time_have_a_ceiling(tmp_path):
    """Small files that unpack to much, read one after the other in one process."""
    bombs = {tiny_messages: '300000', long_names: 'more than', overlapping: 'overlap in time',
             zeros: 'lost: 29'}
    paths = []
    for bomb in bombs:
        paths.append(tmp_path / f'{bomb.__name__}.mcap')
        paths[-1].write_bytes(closed(HEADER, RAW_CHANNEL, bomb()))
        assert paths[-1].stat().st_size < 3_000_000
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(f"""
            import re, sys
            from spinning_top_sim.recording.reader import LogReader
            from spinning_top_sim.recording.errors import LogError
            for path in sys.argv[1:]:
                with LogReader(path, {MAX_BYTES}) as reader:
                    try:
                        print(sum(1 for _ in reader.messages()))
                    except LogError as error:
                        print(error)
                    print(*reader.damage.lines(), sep='\\n')
                print('====')
            # Not ru_maxrss, which begins with that of the process that started this one.
            status = open('/proc/self/status').read()
            print(int(re.search(r'VmHWM:\\s*(\\d+)', status)[1]) >> 10)
            """), *paths],
        # Not measured by coverage, which takes memory of its own.
        env={name: value for name, value in os.environ.items() if 'COVERAGE' not in name}
        | {'PYTHONPATH': str(ROOT)}, capture_output=True, text=True, timeout=60, check=True)
    *said, most = done.stdout.split('====\n')
    for report, text in zip(bombs.values(), said, strict=True):
        assert re.search(report, text), text
    assert int(most) < CEILING_MB
