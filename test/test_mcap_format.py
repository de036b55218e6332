# SPDX-License-Identifier: Apache-2.0
"""
What the MCAP specification allows, and what is recovered of torn logs of other programs.

The files are built record by record with mcap's record classes, or by mcap's writer.
"""

import struct

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
    write_stranger,
)
from helpers.mutations import repair
from helpers.recordings import write_rows
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Header, MessageIndex, Metadata
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import reader as reader_module
from spinning_top_sim.recording.chunks import record_bytes
from spinning_top_sim.recording.reader import LogReader


def test_extra_fields_and_unknown_kinds_are_no_damage(tmp_path):
    """The specification lets records grow, and gives 0x80 and above to applications."""
    attachment = padded(record_bytes(Attachment(1, 2, 'name', 'x/y', b'data')), b'behind')
    path = written(tmp_path, closed(
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
    plain = padded(SCHEMA, b'more') + padded(CHANNEL, b'more') + message(5, b'1')
    path = written(tmp_path, closed(HEADER, chunk_of(plain)))
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == seen_by_mcap(output) == [('/a', 5, b'1')]


@pytest.mark.parametrize('records', [[HEADER], [HEADER, SCHEMA, CHANNEL]])
def test_a_closed_file_without_summary_and_messages_is_whole(tmp_path, records):
    path = written(tmp_path, closed(*records))
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.damage.lines() == []
    assert seen_by_mcap(recover(path)) == []


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_chunk_of_several_frames_is_read_to_its_end(tmp_path, compression):
    compress = {'zstd': zstandard.compress, 'lz4': lz4.frame.compress}[compression]
    first, second = message(5, b'first'), message(6, b'second' * 50)
    path = written(tmp_path, closed(HEADER, RAW_CHANNEL, chunk_of(
        first + second, 5, 6, compression, compress(first) + compress(second))))
    assert [data for _, _, data in seen_by_us(path)] == [b'first', b'second' * 50]
    with LogReader(path) as reader:
        assert reader.damage.lossless


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
    write_rows(path, TOPICS, [(0, stamp, b'') for stamp in stamps], per_chunk=2)
    if not has_summary:
        path.write_bytes(path.read_bytes()[:-50])
    with LogReader(path) as reader:
        assert reader.whole == has_summary
        assert reader.span == (begin, max(stamps, default=0))
        assert [message.log_time for message in reader.messages()] == list(stamps)


def test_a_summary_that_is_too_large_to_be_parsed_is_no_damage(tmp_path):
    path = write_rows(tmp_path / 'a.mcap', TOPICS, [(0, stamp, b'') for stamp in range(1, 201)],
                      per_chunk=1)
    with LogReader(path, max_bytes=10_000) as reader:
        assert reader.whole and reader.damage.lines() == []
        assert [message.log_time for message in reader.messages()] == list(range(1, 201))


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
    note = record_bytes(Metadata('note', {'a': 'b'}))
    wild = bytearray(zstd_chunk(message(5, b'x')))
    struct.pack_into('<Q', wild, 9 + 16, 1 << 62)
    parts = (bytes(wild), SCHEMA, CHANNEL, note, chunk_of(message(5, b'1')),
             zstd_chunk(message(6, b'2')) + note[:-1])
    path = written(tmp_path, MCAP0_MAGIC + HEADER + b''.join(
        bytes(zeros) + part for part in parts))
    with LogReader(path) as reader:
        assert [message.data for message in reader.messages()] == [b'1', b'2']
        assert (reader.metadata, reader.topics[0].type_name) == ({'note': {'a': 'b'}}, 'thing')
        assert reader.damage.lost_bytes == 6 * zeros + len(wild) + len(note) - 1


def test_a_channel_that_stands_behind_its_messages_is_enough(tmp_path):
    """As when the first one is damaged, and so is the summary that repeats it."""
    path = written(tmp_path, MCAP0_MAGIC + HEADER + chunk_of(message(5, b'x')) + RAW_CHANNEL)
    output = recover(path)
    assert seen_by_us(path) == seen_by_us(output) == seen_by_mcap(output) == [('/a', 5, b'x')]
    with LogReader(path) as reader:
        assert reader.damage.lossless


@pytest.mark.parametrize('kind', STRANGERS)
def test_a_strangers_file_is_read_and_recovered(tmp_path, kind):
    path, output = tmp_path / 'stranger.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS[kind])
    assert seen_by_us(path) == messages
    with LogReader(path) as reader:
        assert reader.damage.lossless
        assert not reader.damage.truncated
        assert not reader.damage.missing_messages
        assert reader.metadata == {'note': {'a': 'ä', 'b': ''}}
        assert [(topic.name, topic.type_name, topic.encoding) for topic in reader.topics] == [
            ('/json', 'thing', 'json'), ('/raw', '', 'octets')]
        assert reader.topics[0].metadata == {'unit': 'm'}
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
    with LogReader(output) as reader:
        assert reader.whole


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


@pytest.mark.parametrize('number', [-2, 8])
def test_a_message_of_another_length_is_not_believed(tmp_path, number):
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS['unchunked'], count=20)
    content = path.read_bytes()
    start, end = [(start, end) for opcode, start, end in records_of(content)
                  if opcode == Opcode.MESSAGE][6]
    length = struct.pack('<Q', end - start - 9 + number)
    path.write_bytes(content[:start + 1] + length + content[start + 9:])
    code, out, _ = run(path, '-o', output)
    assert code == SOME_LOST
    assert f'message at byte {start} ' in out
    # Without chunks and summary nothing proves where another message begins.
    assert seen_by_us(output) == seen_by_mcap(output) == messages[:6]
