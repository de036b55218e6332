# SPDX-License-Identifier: Apache-2.0
"""The recorder on a slow, full or failing disk: a bounded loss, told with its reason."""

import os
import random
import re
import shutil
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import closing
from operator import ge
from types import SimpleNamespace

import pytest
from helpers import recordings
from helpers.recordings import (
    METADATA,
    TOPICS,
    complete_messages,
    opened,
    pose_cdr,
    rows_of,
    write,
)
from helpers.reference import ROOT
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from spinning_top_sim.recording import recorder as recorder_module
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import Recorder, single
from spinning_top_sim.recording.writer import McapWriter, log_head

PATIENCE_S = 20.0  # for what happens at once on an idle machine


def numbers_in(path):
    """Return the stamps of a log whose messages are stamped 0, 1, 2, ..."""
    return [message.log_time for _, _, message in complete_messages(path)]


def is_indexed(path):
    """Return whether a file has its summary; ordinary readers refuse it without."""
    with LogReader(path) as reader:
        return reader.whole


def eventually(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, 'did not happen in time'
        time.sleep(0.005)


def refuse_to_sync(descriptor):
    raise OSError(5, os.strerror(5))


@pytest.mark.parametrize(('least', 'reason'), [
    (10 ** 30, r'\d+ bytes are free .* 10{30}'), (0, 'Input/output error')])
def test_too_little_space_or_a_head_that_cannot_be_written_leaves_no_file(
        tmp_path, monkeypatch, least, reason):
    monkeypatch.setattr(os, 'fsync', refuse_to_sync)
    recorder = opened(Recorder(f'{tmp_path}/run.mcap', TOPICS, METADATA, min_free_bytes=least))
    write(recorder, 0, 1, b'')
    assert recorder.state == 'failed' and recorder.path is None
    assert re.fullmatch(rf'cannot write {tmp_path}/run\.mcap: {reason}', recorder.error)
    summary = recorder.close()
    assert (summary.path, summary.lost, summary.messages) == (None, 1, 0)
    assert summary.error == recorder.error and not list(tmp_path.iterdir())


def test_a_file_has_its_name_or_a_date_and_none_is_overwritten(tmp_path, monkeypatch):
    """In a folder, which a name with a slash makes, the first free name is taken."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'old').mkdir()
    monkeypatch.setattr(time, 'strftime', lambda _: 'spinning_top_now')
    for uri, path in (('run.mcap', 'run.mcap'), ('new/er/', 'new/er/spinning_top_now.mcap'),
                      ('old', 'old/spinning_top_now.mcap'), ('', 'spinning_top_now.mcap'),
                      ('', 'spinning_top_now_2.mcap'), ('', 'spinning_top_now_3.mcap')):
        summary = Recorder(uri, TOPICS, METADATA, min_free_bytes=0).close()
        assert summary.path == tmp_path / path and is_indexed(summary.path)
    content = (tmp_path / 'run.mcap').read_bytes()
    for uri, reason in (('run.mcap', 'it exists, and nothing is overwritten'),
                        ('none/a.mcap', f'there is no directory {tmp_path}/none')):
        recorder = opened(Recorder(uri, TOPICS, METADATA, min_free_bytes=0))
        assert recorder.error == f'cannot write {tmp_path}/{uri}: {reason}'
    assert 'run.mcap' in opened(Recorder('run.mcap/', TOPICS, METADATA)).error
    recorder = opened(Recorder('twice.mcap', [TOPICS[0], TOPICS[0]], {}))
    assert recorder.error == "topic '/top/pose' is listed twice: once is allowed"
    assert (tmp_path / 'run.mcap').read_bytes() == content


def test_what_is_handed_over_before_the_file_is_open_waits_and_is_kept(tmp_path, monkeypatch):
    """The opening hangs with the disk; nothing of it is felt."""
    disk_is_back, fsync = threading.Event(), os.fsync
    monkeypatch.setattr(os, 'fsync', lambda fd: (disk_is_back.wait(PATIENCE_S), fsync(fd)))
    recorder = Recorder(f'{tmp_path}/run.mcap', TOPICS, METADATA, max_loss=0.01, min_free_bytes=0)
    for number in range(10):
        write(recorder, 0, number, pose_cdr(number))
    eventually(lambda: recorder.warning)
    assert (recorder.state, recorder.path, recorder.counters.queued) == ('opening', None, 10)
    assert 'could not be closed' in recorder.close(0.01).error
    disk_is_back.set()
    assert recorder.close().error is None and recorder.state == 'closed'
    assert numbers_in(recorder.path) == list(range(10))


def test_what_is_not_installed_is_named_in_a_line(tmp_path):
    """The simulation needs neither mcap nor rosbags until it records."""
    code = ("import sys; sys.modules.update(dict.fromkeys(('mcap', 'rosbags')))\n"
            'from spinning_top_sim.recording.recorder import Recorder\n'
            "recorder = Recorder(sys.argv[1], [], {})\n"
            'print(recorder.close().error)')
    done = subprocess.run([sys.executable, '-c', code, tmp_path / 'run.mcap'], text=True,
                          env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True,
                          timeout=60, check=True)
    assert re.match(r'a recording needs mcap, which is not installed: \S+ -m pip install .*mcap',
                    done.stdout) and done.stdout.count('\n') == 1


def test_a_file_and_its_name_are_on_the_disk_when_it_is_closed(tmp_path, monkeypatch):
    """First the content, then the directory: a name without content would be a broken log."""
    synced = []
    monkeypatch.setattr(os, 'fsync', lambda fd: synced.append(os.readlink(f'/proc/self/fd/{fd}')))
    path = tmp_path / 'run.mcap'
    file = McapWriter(path, log_head(TOPICS, METADATA), compression='zstd')
    assert synced == [str(path), str(tmp_path)]
    synced.clear()
    file.add(*single(0, 1, pose_cdr(1)))
    file.finish()
    assert synced == [str(path), str(tmp_path)]


def test_a_write_that_fails_or_is_interrupted_shifts_nothing(tmp_path, monkeypatch):
    """An error, which is told, also by `finish`, costs its chunk; an interrupt nothing."""
    file = McapWriter(tmp_path / 'a.mcap', log_head(TOPICS, METADATA), compression='none')
    pwrite, faults = os.pwrite, [OSError(28, os.strerror(28)), KeyboardInterrupt()]

    def fail(descriptor, data, offset):
        if faults and offset > file.size:
            raise faults.pop(0)
        return pwrite(descriptor, data[:len(data) // 2 + 1], offset)

    file.add(*rows_of(0, 100))
    file.flush()
    monkeypatch.setattr(os, 'pwrite', fail)
    for begin, fault in ((100, OSError), (200, KeyboardInterrupt)):
        file.add(*rows_of(begin, begin + 100))
        with pytest.raises(fault):
            file.flush()
        assert file.size == (tmp_path / 'a.mcap').stat().st_size
    file.finish()
    with (tmp_path / 'a.mcap').open('rb') as stream:
        list(StreamReader(stream, validate_crcs=True).records)
        stream.seek(0)
        read = make_reader(stream, validate_crcs=True).iter_messages()
        assert [one.log_time for *_, one in read] == [*range(100), *range(200, 300)]
    file = McapWriter(tmp_path / 'b.mcap', log_head(TOPICS, METADATA), compression='zstd')
    file.add(*rows_of(0, 100))
    faults.append(OSError(28, os.strerror(28)))
    with pytest.raises(OSError, match=r'No space left on device: .*b\.mcap'):
        file.finish()


def test_a_full_queue_says_so_and_loses_nothing(tmp_path, monkeypatch):
    blocked, disk_is_back = threading.Event(), threading.Event()
    add = McapWriter.add

    def add_slowly(self, *rows):
        blocked.set()
        disk_is_back.wait(PATIENCE_S)
        return add(self, *rows)

    monkeypatch.setattr(McapWriter, 'add', add_slowly)
    monkeypatch.setattr(recorder_module, 'QUEUE_BYTES', 10_000)
    recorder = Recorder(f'{tmp_path}/run.mcap', TOPICS, METADATA, max_loss=0.01, min_free_bytes=0)
    write(recorder, 0, 0, pose_cdr(0))
    assert blocked.wait(PATIENCE_S)  # with the first message, out of the queue
    written = 1
    while recorder.room:
        write(recorder, 0, written, pose_cdr(written))
        written += 1
    assert 10 < written < 100
    assert not recorder.wait_for_room(0.01)
    write(recorder, 0, written, pose_cdr(written))  # a burst may go on
    disk_is_back.set()
    assert recorder.wait_for_room(PATIENCE_S)
    summary = recorder.close()
    assert (summary.lost, summary.error) == (0, None)
    assert numbers_in(summary.path) == list(range(written + 1))


@pytest.mark.parametrize('ending', ['pass', 'os.kill(os.getpid(), signal.SIGINT)'])
def test_an_interpreter_that_ends_without_closing_leaves_a_whole_file(tmp_path, ending):
    code = f"""
        import os, signal, sys
        from spinning_top_sim.recording.rosbag2 import RecordedTopic
        from spinning_top_sim.recording.recorder import Recorder, single
        topics = [RecordedTopic('/a', {recordings.ARRAY!r})]
        recorder = Recorder(sys.argv[1], topics, {{}}, min_free_bytes=0, max_loss=60.0)
        for number in range(100):
            recorder.write([single(0, number, bytes(8))])
        {ending}
        """
    subprocess.run([sys.executable, '-c', textwrap.dedent(code), tmp_path / 'run.mcap'],
                   env=os.environ | {'PYTHONPATH': str(ROOT)}, capture_output=True, timeout=60,
                   check=False)
    with Reader(tmp_path / 'run.mcap') as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == list(range(100))


@pytest.mark.parametrize(('fsync_s', 'pwrite_s'), [(0.0, 0.1), (0.4, 0.0)])
def test_what_is_handed_over_is_on_the_disk_within_max_loss(
        tmp_path, monkeypatch, fsync_s, pwrite_s):
    """On a simulated clock, which waiting and a slow disk advance; messages come all the time."""
    max_loss, step_s = 1.0, 0.01
    now, on_disk, flushes, waits, shown = 0.0, 0, 0, [], []
    handed_over = []    # times

    class Event(threading.Event):
        def wait(self, timeout=None):
            advance(timeout)

    class Thread:
        """The thread that records is this one, and what it starts is done at once."""

        join = is_alive = lambda *_: None

        def __init__(self, target, args=(), **_):
            self.start = (lambda: target(*args)) if args else (lambda: None)

    def advance(duration):
        nonlocal now
        if not recorder._accepting:
            return
        for _ in range(max(1, round(duration / step_s))):
            now += step_s
            write(recorder, 0, len(handed_over), b'')
            handed_over.append(now)
            waits.append(now - handed_over[on_disk])
            shown.append(recorder.possible_loss)
        if now > 20.0:
            recorder._accepting = False

    def fsync(_):
        nonlocal on_disk, flushes
        written = recorder.counters.messages
        advance(fsync_s)
        on_disk = written
        flushes += 1

    recorder = Recorder(f'{tmp_path}/run.mcap', TOPICS, METADATA, max_loss=max_loss,
                        min_free_bytes=0, clock=lambda: now,
                        threads=SimpleNamespace(Event=Event, Thread=Thread))
    pwrite, open_file = os.pwrite, recorder._open

    def open_at_once():
        file = open_file()
        monkeypatch.setattr(os, 'fsync', fsync)
        monkeypatch.setattr(os, 'pwrite', lambda *of: (advance(pwrite_s), pwrite(*of))[1])
        return file

    monkeypatch.setattr(recorder, '_open', open_at_once)
    recorder._run()
    summary = recorder.close()
    assert (summary.error, summary.lost) == (None, 0)
    assert flushes > 30
    assert len(waits) > 1900 and 0.9 * max_loss / 2 < max(waits) <= max_loss
    assert all(map(ge, shown, (wait - 1.5 * step_s for wait in waits)))


@pytest.fixture
def slow_disk(monkeypatch):
    """Have every fsync wait from now on until the event is set."""
    disk_is_back, fsync = threading.Event(), os.fsync
    monkeypatch.setattr(os, 'fsync', lambda fd: (disk_is_back.wait(PATIENCE_S), fsync(fd)))
    return disk_is_back


def test_recording_goes_on_while_the_disk_is_slow_and_says_what_may_be_lost(tmp_path, slow_disk):
    path = tmp_path / 'run.mcap'
    slow_disk.set()
    with closing(opened(Recorder(str(path), TOPICS, METADATA, max_loss=0.05,
                                 min_free_bytes=0))) as recorder:
        assert (recorder.warning, recorder.possible_loss) == (None, 0.0)
        slow_disk.clear()
        for number in range(3):
            write(recorder, 0, number, pose_cdr(number))
            eventually(lambda n=number: numbers_in(path) == list(range(n + 1)))
        eventually(lambda: recorder.warning)
        assert recorder.possible_loss > 0.05
        assert re.fullmatch(rf'the disk of {path} is slow: a power loss would take the last '
                            r'\d+\.\d s, more than max_loss = 0\.05 s', recorder.warning)
        assert recorder.state == 'recording'
        slow_disk.set()
        eventually(lambda: recorder.possible_loss == 0.0)
        assert recorder.warning is None
    assert numbers_in(path) == [0, 1, 2]


@pytest.mark.parametrize('fails', [False, True])
def test_a_sync_that_hangs_does_not_hang_the_end_and_its_failure_is_told(
        tmp_path, slow_disk, monkeypatch, fails):
    slow_disk.set()
    recorder = opened(Recorder(f'{tmp_path}/run.mcap', TOPICS, METADATA, max_loss=0.02,
                               min_free_bytes=0))
    slow_disk.clear()
    fsync, begun = os.fsync, threading.Event()

    def sync(descriptor):
        begun.set()
        fsync(descriptor)
        if fails and threading.current_thread().name == 'recorder sync':
            raise OSError(5, os.strerror(5))

    monkeypatch.setattr(os, 'fsync', sync)
    write(recorder, 0, 1, pose_cdr(1))
    assert begun.wait(PATIENCE_S)
    assert 'could not be closed within 0.05 s' in (recorder.close(timeout=0.05).error or '')
    slow_disk.set()
    summary = recorder.close(timeout=PATIENCE_S)
    assert is_indexed(summary.path) and summary.messages == 1
    assert summary.error == (
        f'recording to {summary.path} stopped: Input/output error' if fails else None)


@pytest.fixture
def disk(monkeypatch):
    """A disk on which a file has at most `disk.size` bytes: `disk.room` after a second chunk."""
    disk, pwrite, chunks = SimpleNamespace(size=1 << 30, room=1 << 30), os.pwrite, []

    def write(descriptor, data, offset):
        chunks.extend([offset] * (len(data) > 150_000))     # no index
        disk.size = min([disk.size, *(begin + disk.room for begin in chunks[1:2])])
        if offset >= disk.size:
            raise OSError(28, os.strerror(28))
        return pwrite(descriptor, data[:disk.size - offset], offset)

    monkeypatch.setattr(os, 'pwrite', write)
    return disk


@pytest.mark.parametrize(('room', 'max_loss'), [(100_000, 100.0), (100, 0.02)])
def test_a_full_disk_stops_the_recording_and_costs_what_is_not_written(
        tmp_path, disk, monkeypatch, room, max_loss):
    """A torn chunk is cut off, and where it stood there is room for the summary; or only that."""
    monkeypatch.setattr(recorder_module, 'QUEUE_BYTES', 400_000)
    path, rng = tmp_path / 'run.mcap', random.Random(3)
    at_end = max_loss < 1.0
    recorder = opened(Recorder(str(path), TOPICS, METADATA, min_free_bytes=0, max_loss=max_loss))
    disk.room = disk.size if at_end else room
    for number in range(5000):      # many times half of the queue: chunks of up to 1 MB
        write(recorder, 0, number, rng.randbytes(1000))
    if at_end:
        eventually(lambda: recorder.counters.messages == 5000)
        disk.size = recorder.counters.bytes + room
    summary = recorder.close()
    write(recorder, 0, 0, b'after the end')
    kept = summary.messages
    assert recorder.error == f'recording to {path} stopped: No space left on device'
    assert recorder.state == 'failed' and summary.error == recorder.error and recorder.room
    assert kept == 5000 if at_end else 100 < kept < 4000
    assert recorder.counters.lost == 5001 - kept
    assert is_indexed(path) != at_end
    assert numbers_in(path) == list(range(kept)) and summary.bytes == path.stat().st_size


FAULTS = {
    'the file was deleted': lambda path, patch: path.unlink(),
    'the file was deleted ': lambda path, patch: shutil.rmtree(path.parent),
    'Input/output error': lambda path, patch: patch.setattr(os, 'fsync', refuse_to_sync),
    '0 bytes are free on the disk, fewer than min_free_bytes = 1': lambda path, patch: (
        patch.setattr(os, 'fstatvfs', lambda _: SimpleNamespace(f_bavail=0, f_frsize=4096))),
}


@pytest.mark.parametrize('reason', FAULTS)
def test_a_fault_stops_the_recording_with_its_reason(tmp_path, monkeypatch, reason):
    path = tmp_path / 'logs' / 'run.mcap'
    path.parent.mkdir()
    recorder = opened(Recorder(str(path), TOPICS, METADATA, max_loss=0.02, min_free_bytes=1))
    write(recorder, 0, 0, pose_cdr(0))
    FAULTS[reason](path, monkeypatch)
    write(recorder, 0, 1, pose_cdr(1))
    eventually(lambda: recorder.state == 'failed')
    write(recorder, 0, 2, b'late')
    summary = recorder.close()
    assert recorder.error == summary.error == f'recording to {path} stopped: {reason.strip()}'
    assert recorder.room and summary.messages + summary.lost == 3 and summary.lost >= 1
    if path.exists():
        assert is_indexed(path) and numbers_in(path) == list(range(summary.messages))


def test_a_message_that_cannot_be_packed_is_no_exception_for_the_simulation(tmp_path):
    recorder = Recorder(f'{tmp_path}/b.mcap', TOPICS, METADATA, min_free_bytes=0)
    write(recorder, len(TOPICS), 0, b'')
    summary = recorder.close()
    assert recorder.state == 'failed' and 'stopped: IndexError:' in (summary.error or '')
    assert (is_indexed(summary.path), summary.lost) == (True, 1)
