# SPDX-License-Identifier: Apache-2.0
"""
Reading and recovering logs: torn, damaged, hostile ones, and those of others.

What was recovered is read by rosbags, mcap-ros2-support and mcap, none of them written here.
"""

import os
import random
import struct
import zlib

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from helpers.logs import (
    MESSAGES_PER_CHUNK,
    STRANGERS,
    flipped,
    records_of,
    run,
    seen_by_mcap,
    seen_by_rosbags,
    seen_by_us,
    write_bag,
    write_stranger,
)
from helpers.recordings import METADATA, POSE, TOPICS, write_rows
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, Message
from mcap.records import Metadata as MetadataRecord
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.recording.writer import record_bytes

ALL_KEPT, FAILED, SOME_LOST = 0, 1, 3


def check_with_all_readers(path, messages) -> None:
    """A recovered log of ours: the messages, for everyone, and what it says of the run."""
    assert seen_by_us(path) == seen_by_mcap(path) == seen_by_rosbags(path) == messages
    with open(path, 'rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert [message.pose.position.z if schema.name == POSE else message.data[0]
                for schema, *_, message in reader.iter_decoded_messages()] == [
                    *range(len(messages))]
    with LogReader(path) as reader:
        assert reader.whole and reader.metadata['spinning_top_sim'] == METADATA
        assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]


def test_every_cut_keeps_every_whole_chunk(tmp_path, log, no_sync):
    """The exit code says whether a message was in what is gone."""
    torn, output, seen = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap', {}
    edges = [0, *(place for record in records_of(log.content) for place in record[1:])]
    sizes = {cut for edge in edges for cut in (*range(edge - 3, edge + 4), edge + 10)
             if 0 <= cut <= len(log.content)}.union(range(0, len(log.content), 97))
    torn.write_bytes(log.content)
    for size in sorted(sizes, reverse=True):
        os.truncate(torn, size)
        whole_chunks = sum(end <= size for _, _, end in log.chunks)
        is_in_chunk = any(start < size < end for _, start, end in log.chunks)
        code, out, err = run(torn, '-o', output)
        if whole_chunks == 0:
            assert code == FAILED and not output.exists() and err.count('\n') == 1, (size, err)
            continue
        assert ('lost: ' in out) == (code == SOME_LOST) and err == '', (size, out)
        assert code == (SOME_LOST if is_in_chunk else ALL_KEPT), (size, out)
        with LogReader(torn) as reader:
            assert reader.torn == (not reader.whole) == (size < len(log.content))
        seen[output.read_bytes()] = whole_chunks
        output.unlink()
    assert set(seen.values()) == {1, 2, 3}
    for content, whole_chunks in seen.items():
        output.write_bytes(content)
        check_with_all_readers(output, log.messages[:whole_chunks * MESSAGES_PER_CHUNK])


# What is changed, beside begin and end of the second of three chunks; what is said; and which
# chunks are left.  A file system may leave zeros behind the tear after a power loss.
@pytest.mark.parametrize(('damage', 'says', 'left'), [
    (lambda log, begin, end: flipped(log, end - 6), 'lost: ', [0, 2]),
    (lambda log, begin, end: log[:begin] + bytes(3_000_000), 'lost: 3000000 bytes', [0]),
    # Another kind of record, with the right length; an index that has no end.
    (lambda log, begin, end: flipped(log, begin), 'checksum of the data section is wrong', [0, 2]),
    (lambda log, begin, end: flipped(log, end + 5) + bytes(2_000_000), 'lost: ', [0, 1]),
    (lambda log, begin, end: flipped(log, len(log) - 60), 'the summary at the end', [0, 1, 2])])
def test_what_is_damaged_is_left_out_and_told(tmp_path, log, damage, says, left):
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    path.write_bytes(damage(log.content, *log.chunks[1][1:]))
    code, out, _ = run(path, '-o', output)
    assert code == (SOME_LOST if len(left) < 3 else ALL_KEPT) and says in out
    kept = [one for chunk in left for one in log.messages[
        chunk * MESSAGES_PER_CHUNK:(chunk + 1) * MESSAGES_PER_CHUNK]]
    assert seen_by_us(path) == seen_by_mcap(output) == seen_by_rosbags(output) == kept
    with LogReader(path) as reader:
        assert (reader.torn, reader.changed) == (left != [0, 2], 'checksum' in says)


def test_a_log_that_changes_while_it_is_read_is_told(tmp_path, log):
    path = tmp_path / 'a.mcap'
    for size in (log.chunks[1][2] - 1, log.chunks[1][1]):
        path.write_bytes(log.content)
        with LogReader(path) as reader, pytest.raises(LogError, match='it has changed meanwhile'):
            os.truncate(path, size)
            list(reader.messages())


@pytest.mark.parametrize('torn', [False, True])
def test_messages_come_in_the_order_of_their_log_times(tmp_path, torn):
    """Within chunks and across them; equal times in file order.  They can be chosen."""
    order = random.Random(4)
    rows = [(number % 2, order.randrange(200), struct.pack('<I', number)) for number in range(600)]
    path = write_rows(tmp_path / 'run.mcap', TOPICS, rows, 50)
    if torn:        # within the indexes of the last chunk
        os.truncate(path, max(end for opcode, _, end in records_of(path.read_bytes())
                              if opcode == Opcode.MESSAGE_INDEX) - 1)
    stamps = [row[1] for row in rows]
    last = max(stamps[:50])     # of the first chunk
    with LogReader(path) as reader:
        assert reader.whole == (not torn) and reader.span == (min(stamps), max(stamps))
        for given, chosen in (
                ({}, lambda topic, stamp, data: True),
                ({'topics': [TOPICS[1].name], 'start': 70, 'end': 130},
                 lambda topic, stamp, data: topic and 70 <= stamp < 130),
                ({'start': last, 'end': last + 1}, lambda topic, stamp, data: stamp == last),
                ({'topics': []}, lambda *_: False)):
            assert [(message.log_time, message.data) for message in reader.messages(**given)] == [
                row[1:] for row in sorted(rows, key=lambda row: row[1]) if chosen(*row)]
        found = [one for one in reader.recorded() if isinstance(one, LogMessage)]
        assert [one.data for one in found] == [row[2] for row in rows]
        assert [one.sequence for one in found] == [number // 2 for number in range(600)]


HEADER = record_bytes(Header(profile='', library='a stranger'))
CHANNEL = record_bytes(Channel(id=1, topic='/a', message_encoding='x', metadata={}, schema_id=0))


def message(log_time: int, data: bytes, channel: int = 1) -> bytes:
    return record_bytes(Message(channel_id=channel, log_time=log_time, publish_time=log_time,
                                sequence=0, data=data))


def chunk_of(plain: bytes, compression: str = '', data: bytes | None = None,
             **changed: int) -> bytes:
    return record_bytes(Chunk(**{
        'compression': compression, 'data': plain if data is None else data,
        'uncompressed_size': len(plain), 'uncompressed_crc': zlib.crc32(plain),
        'message_start_time': 5, 'message_end_time': 5} | changed))


def padded(record: bytes, extra: bytes) -> bytes:
    opcode, length = struct.unpack_from('<BQ', record)
    return struct.pack('<BQ', opcode, length + len(extra)) + record[9:] + extra


def closed(folder, *records: bytes):
    """Write a file without summary, with the checksum of its data section."""
    content = MCAP0_MAGIC + HEADER + CHANNEL + b''.join(records)
    path = folder / 'a.mcap'
    path.write_bytes(b''.join([
        content, record_bytes(DataEnd(zlib.crc32(content))),
        record_bytes(Footer(summary_start=0, summary_offset_start=0, summary_crc=0)),
        MCAP0_MAGIC]))
    return path


def test_extra_fields_unknown_kinds_and_several_frames_are_no_damage_and_the_order_is_kept(
        tmp_path):
    """The specification lets records grow, and gives 0x80 and above to applications."""
    two = [message(5, b'2'), message(5, b'3')]
    frames = b''.join(map(zstandard.compress, two))
    no_schema = Channel(id=2, topic='/b', message_encoding='x', metadata={}, schema_id=9)
    path = closed(
        tmp_path, padded(struct.pack('<BQ', 0x80, 0), b'of an application'), message(5, b'1'),
        padded(chunk_of(b''.join(two), 'zstd', frames, uncompressed_crc=0), bytes(20)),
        *(padded(record_bytes(MetadataRecord('note', {'a': text})), b'\x06') for text in 'xb'),
        message(5, b'4'),
        padded(record_bytes(Attachment(1, 2, 'name', 'x/y', b'data')), b'behind'),
        record_bytes(no_schema), message(5, b'5', channel=2))
    with LogReader(path) as reader:
        assert reader.whole and not reader.damage
        assert reader.metadata == {'note': {'a': 'b'}}
    assert run(path, '-o', tmp_path / 'b.mcap')[0] == ALL_KEPT
    assert seen_by_us(path) == seen_by_mcap(tmp_path / 'b.mcap') == [
        *(('/a', 5, b'%d' % number) for number in range(1, 5)), ('/b', 5, b'5')]
    assert run(closed(tmp_path), '-o', tmp_path / 'c.mcap')[0] == ALL_KEPT, 'nothing is lost'


@pytest.mark.parametrize('kind', STRANGERS)
def test_a_strangers_file_is_read_and_recovered_and_what_stands_before_a_tear(
        tmp_path, kind, no_sync):
    path, output = tmp_path / 'stranger.mcap', tmp_path / 'whole.mcap'
    messages = write_stranger(path, STRANGERS[kind])
    assert run(path, '-o', output)[0] == ALL_KEPT
    assert seen_by_us(path) == seen_by_mcap(output) == messages
    with LogReader(output) as ours, open(output, 'rb') as file:
        assert ours.whole and [topic[:3] for topic in ours.topics] == [
            ('/json', 'thing', 'json'), ('/raw', '', 'octets')]
        reader = make_reader(file)
        assert reader.get_header() == Header(profile='', library='a stranger')
        (note,), (attachment,) = reader.iter_metadata(), reader.iter_attachments()
        assert (note.name, note.metadata) == ('note', {'a': 'ä', 'b': ''})
        assert attachment == Attachment(3, 4, 'calibration.bin', 'x/y', b'\x06' * 3000)
        read = [*reader.iter_messages()]
        assert read[0][1].metadata == {'unit': 'm'} and read[0][0].data == b'{"type": "object"}'
        assert [(message.publish_time, message.sequence) for *_, message in read] == [
            (stamp + 1000, (stamp - 1000) // 2) for _, stamp, _ in messages]
    content = path.read_bytes()
    ends = [end for opcode, _, end in records_of(content) if opcode in (
        Opcode.MESSAGE, Opcode.CHUNK)]
    for size in range(ends[0], len(content), 2501):
        path.write_bytes(content[:size])
        output.unlink()
        assert run(path, '-o', output)[0] != FAILED
        kept = seen_by_mcap(output)
        assert kept == messages[:len(kept)] and len(kept) >= sum(end <= size for end in ends)


FIRST, SECOND = message(5, b'first'), message(5, b'second' * 50)


@pytest.mark.parametrize('bad', [
    chunk_of(FIRST, 'zstd', zstandard.compress(FIRST + SECOND), uncompressed_crc=0),   # too much
    chunk_of(bytes(9 << 16), 'lz4', lz4.frame.compress(bytes(9 << 16))), chunk_of(FIRST, 'brotli'),
    chunk_of(FIRST, 'lz4', b'\x04"M\x18' + bytes(30)), chunk_of(message(5, b'', channel=7)),
    chunk_of(FIRST, 'lz4', lz4.frame.compress(FIRST)[:-9]), chunk_of(FIRST, uncompressed_crc=7),
    chunk_of(FIRST, 'zstd', b'noise'), chunk_of(FIRST[:-1]), chunk_of(message(5, bytes(5000))),
    record_bytes(MetadataRecord('big', {'k': 'v' * 5000}))])
def test_what_is_damaged_or_too_large_is_left_out_alone(tmp_path, bad):
    path = closed(tmp_path, bad, chunk_of(message(4, b'a')), bad, chunk_of(message(6, b'c')))
    with LogReader(path, max_bytes=4000) as reader:
        assert [one.data for one in reader.messages()] == [b'a', b'c']
        assert reader.lost_bytes == 2 * len(bad)


def test_a_small_file_whose_chunks_unpack_to_all_memory_is_refused(tmp_path):
    bomb = message(5, b'') + 100 * message(9, bytes(300))      # half of it besides the data
    path = closed(tmp_path, *[chunk_of(bomb, 'zstd', zstandard.compress(bomb))] * 9)
    with LogReader(path, max_bytes=1 << 20) as reader:
        assert len([*reader.messages()]) == 909
    with LogReader(path, max_bytes=1 << 18) as reader, pytest.raises(
            LogError, match='more than 262144 bytes of them are not held'):
        list(reader.messages())


ONE_BY_ONE = 'rosbag2 has compressed its messages one by one'


@pytest.mark.parametrize(('make', 'reason'), [
    (lambda path: path.write_bytes(b''), 'it is empty'),
    (lambda path: path.write_bytes(b'SQLite format 3\x00' + bytes(100)), 'it is no MCAP file'),
    (lambda path: None, 'No such file or directory'), (os.mkfifo, 'it is no regular file'),
    (os.mkdir, 'a folder must have one .mcap file, not 0'),
    (lambda path: write_bag(path, split=3, lost=1), 'a folder must have one .mcap file, not 3'),
    (lambda path: write_bag(path, 'FILE'), 'it is compressed as a whole, unpack it by zstd -d'),
    # The mode is told by a record in the file, or by metadata.yaml beside it.
    (lambda path: write_bag(path, 'MESSAGE'), ONE_BY_ONE),
    (lambda path: write_bag(path, 'MESSAGE', record=False), ONE_BY_ONE)])
def test_what_is_no_log_or_compressed_is_refused(tmp_path, make, reason):
    path = tmp_path / 'run.mcap'
    make(path)
    code, out, err = run(path, '-o', tmp_path / 'whole.mcap')
    assert (code, out, err.count('\n')) == (FAILED, '', 1)
    assert err.startswith(f'spinning-top recover: cannot read {path}') and reason in err


def test_what_cannot_be_written_is_named_and_nothing_is_overwritten(tmp_path, log):
    path, head, new = (tmp_path / f'{name}.mcap' for name in ('run', 'head', 'new'))
    path.write_bytes(log.content)
    head.write_bytes(log.content[:log.chunks[0][1]])
    for source, output, reason in (
            (path, head, f'cannot write {head}: File exists, and nothing is overwritten: '
                         'choose a new name'),
            (path, tmp_path / 'no/a', f'cannot write {tmp_path}/no/a: No such file or directory'),
            (head, new, f'nothing to save in {head}: there is no whole message in it')):
        assert run(source, '-o', output) == (FAILED, '', f'spinning-top recover: {reason}\n')
    assert head.read_bytes() == log.content[:log.chunks[0][1]] and not new.exists()
