# SPDX-License-Identifier: Apache-2.0
"""`recover` as a command: exit codes, refusals, full and failing disks, signals, memory."""

import os
import random
import signal
import tracemalloc

import pytest
from helpers.logs import ALL_KEPT, FAILED, SOME_LOST, TOPICS, run
from helpers.recordings import write_rows
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.log_file import LogFile
from spinning_top_sim.recording.mcap_writer import McapWriter
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recovery import recover


def test_messages_can_be_chosen(log, tmp_path):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    (tmp_path / 'torn.mcap').write_bytes(log.content[:log.chunks[-1][2]])
    start, end = log.messages[9][1], log.messages[30][1]    # both of the topic that is chosen
    for name in ('run.mcap', 'torn.mcap'):
        with LogReader(tmp_path / name) as reader:
            chosen = list(reader.messages(topics=['/top/number'], start=start, end=end))
            assert [(message.topic, message.log_time, message.data) for message in chosen] == [
                message for message in log.messages[9:30] if message[0] == '/top/number']
            assert [message.sequence for message in chosen] == list(range(3, 10))
            assert not list(reader.messages(topics=[]))
            assert not list(reader.messages(start=end, end=start))


def test_exit_codes(tmp_path, log):
    torn, head = tmp_path / 'torn.mcap', tmp_path / 'head.mcap'
    torn.write_bytes(log.content[:log.chunks[2][2] - 1])
    head.write_bytes(log.content[:log.chunks[0][1]])
    code, out, err = run(torn, '--output', tmp_path / 'out.mcap')
    assert (code, err) == (SOME_LOST, '')
    _, start, end = log.chunks[2]
    assert f'lost: {end - 1 - start} bytes, an unknown number of messages\n' in out
    assert f'lost: chunk at byte {start} (' in out and 'kept: 24 messages in 2 chunks' in out
    assert run(head) == (
        FAILED, '', 'spinning-top recover: '
                    f'nothing to save in {head}: there is no whole message in it\n')
    with pytest.raises(SystemExit, match='2'):
        run()


def test_a_recovery_tells_what_it_has_written(tmp_path, log):
    path, output, told = tmp_path / 'run.mcap', tmp_path / 'whole.mcap', []
    path.write_bytes(log.content)
    with LogReader(path) as reader:
        done = recover(reader, output, told.append)
    assert (done.size, done.messages, done.chunk_count) == (
        output.stat().st_size, len(log.messages), len(log.chunks))
    assert told == sorted(told) and told[-1] == len(log.content) and len(told) > len(log.chunks)


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
            with LogReader(path) as reader:
                assert sum(1 for _ in reader.messages()) == chunks
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] - peaks[0] < 1_000_000


def test_nothing_is_overwritten(tmp_path, log):
    path, other = tmp_path / 'run.mcap', tmp_path / 'other.mcap'
    path.write_bytes(log.content)
    other.write_text('precious')
    (tmp_path / 'link.mcap').symlink_to(tmp_path / 'nowhere')
    for output in (path, other, tmp_path / 'link.mcap'):
        code, out, err = run(path, '-o', output)
        assert (code, out) == (FAILED, '')
        assert err == (
            'spinning-top recover: '
            f'cannot write {output}: it exists, and nothing is overwritten\n')
    assert path.read_bytes() == log.content
    assert other.read_text() == 'precious'
    assert len(list(tmp_path.iterdir())) == 3


def test_an_output_that_cannot_be_made_is_named(tmp_path, log):
    path = tmp_path / 'run.mcap'
    path.write_bytes(log.content)
    code, _, err = run(path, '-o', tmp_path / 'none' / 'whole.mcap')
    assert code == FAILED
    assert err == ('spinning-top recover: '
                   f'cannot write {tmp_path}/none/whole.mcap: there is no directory '
                   f'{tmp_path}/none\n')
    code, _, err = run(path, '-o', path / 'whole.mcap')
    assert code == FAILED
    assert 'Not a directory' in err
    assert run(path, '-o', '/proc/whole.mcap')[2] == (
        'spinning-top recover: cannot write /proc/whole.mcap: no files can be made in /proc\n')


@pytest.mark.parametrize(('content', 'reason'), [
    (b'', 'it is empty'),
    (MCAP0_MAGIC[:5], 'it is no MCAP file'),
    (b'SQLite format 3\x00' + bytes(100), 'it is no MCAP file'),
    (b'\n', 'it is no MCAP file'),
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


def test_a_disk_that_fails_while_it_is_read_is_an_error(tmp_path, log, monkeypatch):
    path, read = tmp_path / 'run.mcap', LogFile.read
    path.write_bytes(log.content[:log.chunks[-1][2]] + bytes(40))

    def fail(self, offset, length):
        if offset < log.chunks[1][1]:
            return read(self, offset, length)
        with self._access():
            raise OSError(5, os.strerror(5))

    monkeypatch.setattr(LogFile, 'read', fail)
    assert run(path) == (FAILED, '', f'spinning-top recover: cannot read {path}: '
                                     'Input/output error\n')
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_leaves_nothing_behind(tmp_path, log, monkeypatch):
    (tmp_path / 'run.mcap').write_bytes(log.content)
    monkeypatch.setattr(McapWriter, 'finish', lambda *_, **__: signal.raise_signal(signal.SIGINT))
    assert run(tmp_path / 'run.mcap')[0] == 130
    assert [path.name for path in tmp_path.iterdir()] == ['run.mcap']
