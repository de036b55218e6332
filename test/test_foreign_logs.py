# SPDX-License-Identifier: Apache-2.0
"""Logs that other programs wrote: what is read, and what is recovered of torn ones."""

import struct
import zlib

import pytest
from helpers.logs import (
    ALL_KEPT,
    FAILED,
    SOME_LOST,
    STRANGERS,
    records_of,
    run,
    seen_by_mcap,
    seen_by_us,
    small_log,
    without_sync,
    write_anew,
    write_stranger,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Message
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.mcap_writer import record_bytes
from spinning_top_sim.recording.reader import LogReader


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    return small_log(tmp_path_factory.mktemp('log') / 'run.mcap')


@pytest.fixture
def no_sync(monkeypatch):
    without_sync(monkeypatch)


def place_of(content: bytes, wanted: int) -> tuple[int, int]:
    """Return start and end of the only record of a kind."""
    (place,) = [(start, end) for opcode, start, end in records_of(content) if opcode == wanted]
    return place


def longer(record: bytes, number: int) -> bytes:
    """Return a record whose length is a number of bytes more than it has."""
    (length,) = struct.unpack_from('<Q', record, 1)
    return record[:1] + struct.pack('<Q', length + number) + record[9:]


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


@pytest.mark.parametrize('kind', ['plain', 'unchunked'])
def test_a_torn_file_of_a_stranger_keeps_what_stands_before_the_tear(tmp_path, kind, no_sync):
    path, torn, output = (tmp_path / name for name in ('a.mcap', 'torn.mcap', 'whole.mcap'))
    messages = write_stranger(path, STRANGERS[kind], count=60)
    content = path.read_bytes()
    records = records_of(content)
    ends = [end for opcode, _, end in records if opcode in (Opcode.CHUNK, Opcode.MESSAGE)]
    firsts = [first_message(content[start:end], messages)
              for opcode, start, end in records if opcode == Opcode.CHUNK]
    firsts = [*firsts[1:], len(messages)] if firsts else range(1, len(messages) + 1)
    for size in range(8, len(content), 101):
        write_anew(torn, content[:size])
        whole = sum(end <= size for end in ends)
        kept = firsts[whole - 1] if whole else 0
        code, _, err = run(torn, '-o', output)
        assert (code == FAILED) == (kept == 0), (size, err)
        if kept:
            assert seen_by_us(output) == seen_by_mcap(output) == messages[:kept], size
            output.unlink()


def first_message(chunk: bytes, messages) -> int:
    """Return the number of the message that a chunk of `write_stranger` begins with."""
    start_time, = struct.unpack_from('<Q', chunk, 9)
    return start_time - messages[0][1]


def test_messages_in_and_out_of_chunks_keep_their_order(tmp_path):
    """All have one stamp, so that only their places in the file order them."""
    def message(data: bytes) -> bytes:
        return record_bytes(Message(channel_id=1, log_time=5, publish_time=5, sequence=0,
                                    data=data))

    plain = message(b'b') + message(b'c')
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    path.write_bytes(b''.join([
        MCAP0_MAGIC, record_bytes(Header(profile='', library='a stranger')),
        record_bytes(Channel(id=1, topic='/raw', message_encoding='x', metadata={}, schema_id=0)),
        message(b'a'),
        record_bytes(Chunk(compression='', data=plain, uncompressed_size=len(plain),
                           uncompressed_crc=zlib.crc32(plain), message_start_time=5,
                           message_end_time=5)),
        message(b'd'), record_bytes(DataEnd(0)),
        record_bytes(Footer(summary_start=0, summary_offset_start=0, summary_crc=0)),
        MCAP0_MAGIC]))
    assert run(path, '-o', output)[0] == ALL_KEPT
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
    places = [(start, end) for opcode, start, end in records_of(content)
              if opcode == Opcode.MESSAGE]
    data_end, _ = place_of(content, Opcode.DATA_END)
    start, end = places[6]
    path.write_bytes(content[:start] + longer(content[start:end], number) + content[end:data_end])
    code, out, _ = run(path, '-o', output)
    assert code == SOME_LOST
    assert f'message at byte {start} ' in out
    # Without chunks and summary nothing proves where another message begins.
    assert seen_by_us(output) == seen_by_mcap(output) == messages[:6]
