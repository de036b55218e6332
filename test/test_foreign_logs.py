# SPDX-License-Identifier: Apache-2.0
"""Logs that other programs wrote: what is read, and what is recovered of torn ones."""

import struct

import pytest
from helpers.formats import HEADER, RAW_CHANNEL, chunk_of, closed, message, recover
from helpers.logs import (
    ALL_KEPT,
    FAILED,
    SOME_LOST,
    STRANGERS,
    records_of,
    run,
    seen_by_mcap,
    seen_by_us,
    write_anew,
    write_stranger,
)
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Header

from spinning_top_sim.recording.reader import LogReader


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
    path = tmp_path / 'a.mcap'
    path.write_bytes(closed(HEADER, RAW_CHANNEL, message(5, b'a'), chunk_of(
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
