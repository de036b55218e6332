# SPDX-License-Identifier: Apache-2.0
"""
Reading and recovering logs that are torn or flipped.

What was recovered is read by rosbags, mcap-ros2-support and mcap, none of them written here; so
are the places of records in a file.  Children are killed for good after a timeout.
"""

import os
import random
import struct

import pytest
from helpers.logs import (
    ALL_KEPT,
    CHUNKS,
    FAILED,
    MESSAGES_PER_CHUNK,
    POINT,
    SOME_LOST,
    TOPICS,
    flipped,
    places,
    run,
    seen_by_mcap,
    seen_by_rosbags,
    seen_by_us,
    torn,
    write_anew,
    write_log,
)
from helpers.recordings import METADATA, write_rows
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from spinning_top_sim.recording.reader import LogReader


def check_with_all_readers(path, messages) -> None:
    """A recovered log of ours: the messages, for everyone, and what it says of the run."""
    assert seen_by_us(path) == seen_by_mcap(path) == seen_by_rosbags(path) == messages
    with open(path, 'rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        values = [message.x if schema.name == POINT else message.data
                  for schema, _, _, message in reader.iter_decoded_messages()]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert values == [float(number) for number in range(len(messages))]
    assert metadata['spinning_top_sim'] == METADATA
    assert f'message_count: {len(messages)}\n' in metadata['rosbag2']['serialized_metadata']
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.metadata == metadata
        assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]


def cuts(log):
    """Return for sizes of a torn log its whole chunks, and the exit code of `recover`."""
    ends = [end for _, _, end in log.chunks]
    index_ends = [start for _, start, _ in log.chunks[1:]]
    # Around the ends of chunks and indexes after each byte; elsewhere not.
    edges = [0, *ends, *index_ends, len(log.content)]
    sizes = {cut for edge in edges for cut in range(edge - 10, edge + 11)
             if 0 <= cut <= len(log.content)}.union(range(0, len(log.content), 97))
    for size in sorted(sizes, reverse=True):
        whole = sum(end <= size for end in ends)
        yield size, whole, (
            FAILED if whole == 0 else
            ALL_KEPT if whole == CHUNKS or size <= index_ends[whole - 1] else SOME_LOST)


def test_every_cut_keeps_every_whole_chunk(tmp_path, log, no_sync):
    """The exit code says whether a message was in what is gone."""
    torn, output = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap'
    seen = {}
    torn.write_bytes(log.content)
    for size, whole_chunks, expected in cuts(log):
        os.truncate(torn, size)
        code, out, err = run(torn, '-o', output)
        assert code == expected, (size, out, err)
        assert err.count('\n') == (code == FAILED), (size, err)
        assert output.exists() == (code != FAILED), size
        assert ('lost: ' in out) == (code == SOME_LOST), (size, out)
        if size >= log.chunks[0][1]:
            with LogReader(torn) as reader:
                assert reader.damage.truncated == (size < len(log.content))
                assert reader.metadata['spinning_top_sim'] == METADATA
                assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]
        if output.exists():
            seen.setdefault(whole_chunks, set()).add(output.read_bytes())
            output.unlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['torn.mcap']
    assert sorted(seen) == [1, 2, 3]
    for whole_chunks, contents in seen.items():
        (content,) = contents
        output.write_bytes(content)
        check_with_all_readers(output, log.messages[:whole_chunks * MESSAGES_PER_CHUNK])


def kind_at(log, position):
    return next((Opcode(opcode) for opcode, start, end in log.records
                 if start <= position < end), None)


def test_a_flipped_bit_is_never_passed_over(tmp_path, log, no_sync):
    """
    Anywhere in a whole file: it is said, and what is kept is what was there.

    Every byte is under some checksum or has one value only, so nothing may go unnoticed.
    """
    random_bits = random.Random(1)
    broken, output = tmp_path / 'broken.mcap', tmp_path / 'out' / 'broken.mcap'
    output.parent.mkdir()
    broken.write_bytes(log.content)
    assert run(broken, '-o', output)[0] == ALL_KEPT
    original = output.read_bytes()
    output.unlink()
    codes = {}
    for position in places(log):
        write_anew(broken, flipped(log.content, position, random_bits.randrange(8)))
        code, out, err = run(broken, '-o', output)
        assert code in (ALL_KEPT, SOME_LOST), (position, err)
        assert 'found: ' in out or 'lost: ' in out, (position, out)
        codes.setdefault(kind_at(log, position), set()).add(code)
        content = output.read_bytes()
        output.unlink()
        output.write_bytes(content)
        if code == ALL_KEPT:
            assert content == original or seen_by_us(output) == log.messages, position
            output.unlink()
            continue
        touched = [start <= position < end for _, start, end in log.chunks]
        kept = [message for number, message in enumerate(log.messages)
                if not touched[number // MESSAGES_PER_CHUNK]]
        # A compressed chunk may be another one and yet give the same bytes, by its checksum.
        assert seen_by_us(output) in (kept, log.messages), position
        output.unlink()
    # What stands twice in a file, or follows from the rest, is made right again.
    for kind in (None, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX,
                 Opcode.SUMMARY_OFFSET, Opcode.FOOTER):
        assert codes[kind] == {ALL_KEPT}, kind
    assert codes[Opcode.CHUNK] == {ALL_KEPT, SOME_LOST}  # kept with wrong times in the head
    assert SOME_LOST in codes[Opcode.METADATA]


def start_of(log, opcode, number=0):
    return [start for kind, start, _ in log.records if kind == opcode][number]


def longer(log):
    """Return the log with a channel whose length takes in the records up to the second chunk."""
    start = start_of(log, Opcode.CHANNEL, 1)
    length = struct.pack('<Q', log.chunks[1][1] - start - 9)
    return log.content[:start + 1] + length + log.content[start + 9:]


# What is done to the bytes; the chunks that are kept, or the topic that is; the exit code; what
# is said.
DAMAGE = {
    'zeros behind the tear, as file systems leave them after a power loss': (
        lambda log: log.content[:log.chunks[2][1]] + bytes(3_000_000),
        (0, 1), SOME_LOST, 'lost: 3000000 bytes'),
    'a message index that lacks a byte': (
        lambda log: log.content[:log.chunks[0][2] + 20] + log.content[log.chunks[0][2] + 21:],
        (0, 1, 2), SOME_LOST, 'found: message index at byte'),
    'a chunk that became a record of an application, before its index': (
        lambda log: flipped(torn(log), log.chunks[1][1], 7),
        (0, 2), SOME_LOST, 'lost: 290 bytes, at least 12 messages'),
    'a header with a wild length, before all schemas and channels': (
        lambda log: flipped(torn(log), start_of(log, Opcode.HEADER) + 1 + 5, 0),
        (0, 1, 2), SOME_LOST, 'lost: header at byte 8'),
    'a schema that is lost': (
        lambda log: flipped(torn(log), start_of(log, Opcode.SCHEMA) + 9 + 3, 6),
        '/top/number', SOME_LOST, 'lost: 24 messages: no whole record'),
    'a channel that became a message of a channel that exists': (
        lambda log: flipped(log.content, start_of(log, Opcode.CHANNEL, 1), 0),
        (0, 1, 2), SOME_LOST, 'lost: message at byte'),
    'a channel that takes in the chunk behind it': (
        longer, (0, 1, 2), ALL_KEPT, 'found: channel at byte'),
    'a chunk with a wrong checksum in the place of another': (
        lambda log: torn(log, log.content[:log.chunks[0][1]] + bytes(50) + flipped(
            log.content, log.chunks[1][2] - 6, 0)[log.chunks[1][1]:log.chunks[1][2]]
            + log.content[log.chunks[2][1]:]),
        (2,), SOME_LOST, 'bytes, an unknown number of messages'),
}


@pytest.mark.parametrize('case', DAMAGE)
def test_what_can_be_decoded_is_kept_and_the_rest_is_told(tmp_path, log, case):
    damage, kept, code, says = DAMAGE[case]
    path, output = tmp_path / 'a.mcap', tmp_path / 'whole.mcap'
    path.write_bytes(damage(log))
    wanted = [message for number, message in enumerate(log.messages)
              if (message[0] == kept if isinstance(kept, str)
                  else number // MESSAGES_PER_CHUNK in kept)]
    assert seen_by_us(path) == wanted
    found, out, err = run(path, '-o', output)
    assert (found, err) == (code, ''), out
    assert says.replace('290', str(log.chunks[1][2] - log.chunks[1][1])) in out or (
        'at least' in says and says[says.index('at least'):] in out), out
    assert seen_by_us(output) == seen_by_mcap(output) == seen_by_rosbags(output) == wanted
    if kept == (0, 1, 2):
        check_with_all_readers(output, wanted)


@pytest.mark.parametrize('compression', ['zstd', 'none'])
def test_recovering_a_whole_file_changes_nothing(tmp_path, compression):
    path = tmp_path / 'run.mcap'
    messages = write_log(path, compression=compression)
    (tmp_path / 'out').mkdir()
    code, out, err = run(path, '-o', tmp_path / 'out' / 'run.mcap')
    assert (code, err) == (ALL_KEPT, '')
    assert out.startswith(f'kept all: {len(messages)} messages in {CHUNKS} chunks')
    assert (tmp_path / 'out' / 'run.mcap').read_bytes() == path.read_bytes()
    with LogReader(path) as reader:
        assert reader.whole
        assert reader.damage.lossless
        assert not reader.damage.lines()


@pytest.mark.parametrize('torn', [False, True])
def test_messages_come_in_the_order_of_their_log_times(tmp_path, torn):
    """Within chunks and across them; equal times in file order."""
    order = random.Random(4)
    stamps = [order.randrange(200) for _ in range(600)]
    path = write_rows(tmp_path / 'run.mcap', TOPICS[1:2], [
        (0, stamp, struct.pack('<I', number)) for number, stamp in enumerate(stamps)], 50)
    if torn:
        path.write_bytes(path.read_bytes()[:-100])
    with LogReader(path) as reader:
        assert reader.whole == (not torn)
        read = [(message.log_time, struct.unpack('<I', message.data)[0])
                for message in reader.messages()]
    assert read == sorted((stamp, number) for number, stamp in enumerate(stamps))
