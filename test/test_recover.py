# SPDX-License-Identifier: Apache-2.0
"""
Reading and recovering logs that are torn or flipped; `recover` as a command.

What was recovered is read by rosbags, mcap-ros2-support and mcap, none of them written here.
"""

import io
import os
import random
import signal
import struct
import tracemalloc

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
    run,
    seen_by_mcap,
    seen_by_rosbags,
    seen_by_us,
    write_anew,
    write_log,
)
from helpers.mutations import mutate
from helpers.recordings import METADATA, write_rows
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory

from spinning_top_sim.recording import reader as reader_module
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.writer import McapWriter


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
        assert reader.whole and reader.damage.lines() == []
        assert reader.metadata == metadata
        assert [topic.name for topic in reader.topics] == [topic.name for topic in TOPICS]


def cuts(log):
    """Return for sizes of a torn log its whole chunks, and whether `recover` says what is lost."""
    ends = [end for _, _, end in log.chunks]
    begins = [start for _, start, _ in log.chunks[1:]]
    last_index = max(end for opcode, _, end in log.records if opcode == Opcode.MESSAGE_INDEX)
    # Around the ends of chunks and indexes after each byte; elsewhere not.
    edges = [0, *ends, *begins, len(log.content)]
    sizes = {cut for edge in edges for cut in range(edge - 10, edge + 11)
             if 0 <= cut <= len(log.content)}.union(range(0, len(log.content), 97))
    for size in sorted(sizes, reverse=True):
        whole = sum(end <= size for end in ends)
        in_chunk = any(start < size < end for _, start, end in log.chunks)
        yield size, whole, in_chunk, size <= last_index


def test_every_cut_keeps_every_whole_chunk(tmp_path, log, no_sync):
    """The exit code says whether a message was in what is gone."""
    torn, output = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap'
    seen = {}
    torn.write_bytes(log.content)
    for size, whole_chunks, in_chunk, in_messages in cuts(log):
        os.truncate(torn, size)
        code, out, err = run(torn, '-o', output)
        if whole_chunks == 0:
            assert code == FAILED and not output.exists() and err.count('\n') == 1, (size, err)
            continue
        if in_chunk or in_messages:
            assert code == (SOME_LOST if in_chunk else ALL_KEPT), (size, out)
        assert ('lost: ' in out) == (code == SOME_LOST) and err == '', (size, out)
        with LogReader(torn) as reader:
            assert reader.damage.torn == (not reader.whole) == (size < len(log.content))
        seen.setdefault(whole_chunks, set()).add(output.read_bytes())
        output.unlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['torn.mcap']
    assert sorted(seen) == [1, 2, 3]
    for whole_chunks, contents in seen.items():
        (content,) = contents
        write_anew(output, content)
        check_with_all_readers(output, log.messages[:whole_chunks * MESSAGES_PER_CHUNK])


def test_a_flipped_bit_is_never_passed_over(tmp_path, log, no_sync):
    """Anywhere in a whole file: it is said, and what is kept is what was there, in order."""
    choice = random.Random(1)
    broken, output = tmp_path / 'broken.mcap', tmp_path / 'out' / 'broken.mcap'
    output.parent.mkdir()
    for _, start, end in log.records:
        for position in {*range(start, min(start + 9, end)), *choice.choices(range(start, end),
                                                                            k=8)}:
            write_anew(broken, flipped(log.content, position, choice.randrange(8)))
            code, out, err = run(broken, '-o', output)
            if code == FAILED:
                assert start < log.chunks[0][1] and err.count('\n') == 1, (position, err)
                continue
            assert 'found: ' in out and ('lost: ' in out) == (code == SOME_LOST), (position, out)
            found = iter(log.messages)
            assert all(message in found for message in seen_by_us(output)), position
            output.unlink()


def test_a_damaged_chunk_is_left_out_and_zeros_end_the_log(tmp_path, log):
    """A file system may leave zeros behind the tear after a power loss."""
    output = tmp_path / 'whole.mcap'
    _, start, end = log.chunks[1]
    path = write_anew(tmp_path / 'a.mcap', flipped(log.content, end - 6))
    kept = log.messages[:MESSAGES_PER_CHUNK] + log.messages[2 * MESSAGES_PER_CHUNK:]
    code, out, _ = run(path, '-o', output)
    assert code == SOME_LOST and f'lost: {end - start} bytes\n' in out
    assert seen_by_us(path) == seen_by_mcap(output) == seen_by_rosbags(output) == kept
    with LogReader(path) as reader:
        assert reader.whole and len([*reader.messages()]) == len(kept) and reader.left_out == 1
    output.unlink()
    write_anew(path, log.content[:start] + bytes(3_000_000))
    code, out, _ = run(path, '-o', output)
    assert code == SOME_LOST and 'lost: 3000000 bytes\n' in out
    check_with_all_readers(output, log.messages[:MESSAGES_PER_CHUNK])


def test_any_damage_ends_in_a_line_and_what_is_recovered_is_whole(tmp_path, log, no_sync):
    path, output, again = (tmp_path / name for name in ('a.mcap', 'b.mcap', 'c.mcap'))
    for seed in range(150):
        write_anew(path, mutate(log.content, random.Random(seed)))
        code, out, err = run(path, '-o', output)
        assert (code, err.count('\n')) in ((FAILED, 1), (ALL_KEPT, 0), (SOME_LOST, 0)), (seed, err)
        if code != FAILED:
            assert sorted(seen_by_us(output)) == sorted(seen_by_mcap(output)), seed
            assert run(output, '-o', again)[0] == ALL_KEPT, seed
            output.unlink()
            again.unlink()


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
def test_recovering_a_whole_file_changes_nothing(tmp_path, compression):
    path = tmp_path / 'run.mcap'
    messages = write_log(path, compression)
    (tmp_path / 'out').mkdir()
    code, out, err = run(path, '-o', tmp_path / 'out' / 'run.mcap')
    assert (code, err) == (ALL_KEPT, '')
    assert out.startswith(f'kept all: {len(messages)} messages in {CHUNKS} chunks')
    assert (tmp_path / 'out' / 'run.mcap').read_bytes() == path.read_bytes()


@pytest.mark.parametrize('torn', [False, True])
def test_messages_come_in_the_order_of_their_log_times(tmp_path, torn):
    """Within chunks and across them; equal times in file order.  They can be chosen."""
    order = random.Random(4)
    stamps = [order.randrange(200) for _ in range(600)]
    path = write_rows(tmp_path / 'run.mcap', TOPICS, [
        (number % 2, stamp, struct.pack('<I', number)) for number, stamp in enumerate(stamps)], 50)
    if torn:
        path.write_bytes(path.read_bytes()[:-100])
    wanted = sorted((stamp, number) for number, stamp in enumerate(stamps))
    with LogReader(path) as reader:
        assert reader.whole == (not torn) and reader.span == (min(stamps), max(stamps))
        for given, chosen in (
                ({}, lambda stamp, number: True),
                ({'topics': ['/top/number'], 'start': 70, 'end': 130},
                 lambda stamp, number: number % 2 and 70 <= stamp < 130),
                ({'topics': []}, lambda stamp, number: False)):
            assert [(message.log_time, struct.unpack('<I', message.data)[0])
                    for message in reader.messages(**given)] == [
                        one for one in wanted if chosen(*one)]
        assert all(message.sequence == struct.unpack('<I', message.data)[0] // 2
                   for message in reader.messages())


def test_memory_does_not_grow_with_the_file(tmp_path):
    """Twenty times as many chunks: no more than their index, less than a fifth of the file."""
    peaks = []
    for chunks in (10, 200):
        path = write_rows(tmp_path / f'{chunks}.mcap', TOPICS[1:2], (
            (0, number, random.Random(number).randbytes(50_000)) for number in range(chunks)), 1)
        path.write_bytes(path.read_bytes()[:-100])
        tracemalloc.start()
        try:
            assert run(path)[0] == ALL_KEPT
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] - peaks[0] < 1_000_000


# ------------------------------------------------------------------------------- the command

def test_what_cannot_be_written_is_named_and_nothing_is_overwritten(tmp_path, log):
    path = write_anew(tmp_path / 'run.mcap', log.content)
    head = write_anew(tmp_path / 'head.mcap', log.content[:log.chunks[0][1]])
    (tmp_path / 'link.mcap').symlink_to(tmp_path / 'nowhere')
    for output in (path, head, tmp_path / 'link.mcap'):
        assert run(path, '-o', output) == (FAILED, '', 'spinning-top recover: cannot write '
                                           f'{output}: it exists, and nothing is overwritten\n')
    none = tmp_path / 'none'
    assert run(path, '-o', none / 'whole.mcap')[::2] == (FAILED, 'spinning-top recover: cannot '
                                                         f'write {none}/whole.mcap: there is no '
                                                         f'directory {none}\n')
    assert run(head) == (FAILED, '', 'spinning-top recover: '
                                     f'nothing to save in {head}: there is no whole message in '
                                     'it\n')
    assert path.read_bytes() == log.content and len(list(tmp_path.iterdir())) == 3
    with pytest.raises(SystemExit, match='2'):
        run()


@pytest.mark.parametrize(('content', 'reason'), [
    (b'', 'it is empty'),
    (MCAP0_MAGIC[:5], 'it is no MCAP file'),
    (b'SQLite format 3\x00' + bytes(100), 'it is no MCAP file'),
    (MCAP0_MAGIC + bytes(100), 'it is no MCAP file'),
    (None, 'No such file or directory'),
    (os.mkdir, 'a folder must hold one .mcap file; in it: none'),
    (os.mkfifo, 'it is no regular file'),
])
def test_what_is_no_log_is_refused(tmp_path, content, reason):
    path = tmp_path / 'file.mcap'
    if content is not None:
        (content if callable(content) else lambda file: file.write_bytes(content))(path)
    with pytest.raises(LogError) as caught:
        LogReader(path)
    assert str(caught.value) == f'cannot read {path}: {reason}'
    assert run(path) == (FAILED, '', f'spinning-top recover: {caught.value}\n')


@pytest.mark.parametrize('fault', ['disk', 'interrupt'])
def test_a_recovery_that_fails_leaves_nothing_behind(tmp_path, log, monkeypatch, fault):
    path = write_anew(tmp_path / 'run.mcap', log.content)
    if fault == 'disk':
        class Failing(io.FileIO):
            def readinto(self, buffer):
                if self.tell() > log.chunks[1][1]:
                    raise OSError(5, os.strerror(5))
                return super().readinto(memoryview(buffer)[:100])

        monkeypatch.setattr(reader_module, 'FileIO', Failing)
    else:
        monkeypatch.setattr(McapWriter, 'finish',
                            lambda *_, **__: signal.raise_signal(signal.SIGINT))
    code, _, err = run(path)
    assert code == (FAILED if fault == 'disk' else 130)
    assert fault != 'disk' or err == (f'spinning-top recover: cannot read {path}: Input/output '
                                      'error\n')
    assert list(tmp_path.iterdir()) == [path]
