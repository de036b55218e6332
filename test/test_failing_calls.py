# SPDX-License-Identifier: Apache-2.0
"""Each system call that writes a file fails in turn: nothing is lost that was promised."""

import errno
import random
import resource

import numpy as np
import pytest
from helpers.failing_calls import Calls
from helpers.inspected import log_of
from helpers.logs import run, seen_by_us
from helpers.machine import Machine
from helpers.recordings import METADATA, TOPICS, pose_cdr

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.recorder import Recorder
from spinning_top_sim.tools import inspect, simulate

FAILURES = (errno.ENOSPC, errno.EIO, errno.EINTR, None)


def each_failing(act, check, more=()):
    """Let each call fail in each way; `check` takes what comes of it, and what has failed."""
    with Calls() as calls:
        ordinary = act('ordinary')
    check(ordinary, None)
    assert calls.names
    for number, name in enumerate(calls.names, start=1):
        for error in (*more, *(FAILURES if 'write' in name else FAILURES[:-1])):
            with Calls(number, error):
                found = act(f'{number}_{error}')
            check(found, f'{name}, call {number}, fails with {error}')
    return calls.names


def test_of_a_recording(tmp_path):
    def act(name):
        machine, path = Machine(random.Random(1)), tmp_path / f'{name}.mcap'

        def live():
            nonlocal recorder
            recorder = Recorder(str(path), TOPICS, METADATA.copy, max_loss=0.1, min_free_bytes=0,
                                threads=machine, clock=machine.clock)
            for stamps in np.arange(100).reshape(10, 10):
                data = b''.join(map(pose_cdr, stamps))
                recorder.write([(0, stamps, np.frombuffer(data, np.uint8).reshape(10, -1))])
                machine.sleep(20_000_000)
            recorder.close()

        recorder = None
        machine.run(live)
        return recorder, path

    def check(found, failure):
        recorder, path = found
        written = recorder.written[0]
        assert written + recorder.missing == 100, failure
        if recorder.path is None:
            assert not path.exists() and failure, failure
            return
        kept = [stamp for _, stamp, _ in seen_by_us(path)]
        assert kept == list(range(written)), failure
        if recorder.error is None:      # it fails to close, or writes less at first
            with LogReader(path) as reader:
                assert reader.whole and len(kept) == 100, failure
            assert not failure or failure.startswith('close') or failure.endswith('None'), failure
        else:
            assert str(path) in recorder.error, failure

    each_failing(act, check)


@pytest.mark.parametrize('kind', ['recovery', 'tum', 'csv', 'parquet', 'mcap'])
def test_of_a_file_that_is_whole_or_not_there(tmp_path, kind):
    """
    After each failure the command says so in a line that names the file, and leaves none.

    A log of `simulate` keeps what was computed before.
    """
    if kind == 'parquet':
        pytest.importorskip('pyarrow')
    log = tmp_path / 'run.mcap'
    if kind in ('recovery', 'tum'):
        log_of(log, '--duration', 0.1)
    if kind == 'recovery':
        log.write_bytes(log.read_bytes()[:-3000])

    def act(name):
        path = tmp_path / f'{name}.{"mcap" if kind == "recovery" else kind}'
        if kind == 'recovery':
            return path, *run(log, '-o', path)
        if kind == 'tum':
            return path, *run(log, '--export', f'tum:{path}', tool=inspect)
        return path, *run('--duration', 0.1, '--command', '0.05:1.7:1.4', '--quiet', '-p',
                          'record.streams:=[pose]', '-o', path, tool=simulate)

    expected, code, *_ = act('expected')
    assert code == 0
    messages = seen_by_us(expected) if kind == 'mcap' else []

    def check(found, failure):
        path, code, _, said = found
        kept = seen_by_us(path) if kind == 'mcap' and path.exists() else []
        is_whole = path.exists() and (
            kept == messages if messages else path.read_bytes() == expected.read_bytes())
        if code == 0:
            assert is_whole, failure
        else:
            is_interrupted = 'Interrupt' in failure
            assert code == (130 if is_interrupted else 1), (failure, said)
            assert said.count('\n') == 1 and (is_interrupted or path.name in said), (failure, said)
            # A failure may come too late to matter.
            assert not path.exists() or is_whole or (
                kept == messages[:len(kept)] if messages else
                'unlink' in failure and not path.stat().st_size), failure

    is_log = kind in ('recovery', 'mcap')
    names = each_failing(act, check, more=[KeyboardInterrupt] if is_log else ())
    assert ('fsync' in names) == is_log, 'a log is on the disk'


def test_of_a_part_of_an_ensemble(tmp_path):
    ensemble_runs = pytest.importorskip('spinning_top_sim.tools.ensemble_runs')
    (tmp_path / 'spec.yaml').write_text('{runs: 1, duration: 0.1, streams: [pose]}')
    specification, parts = ensemble_runs.read(tmp_path / 'spec.yaml')

    def computed(folder):
        folder.mkdir(exist_ok=True)
        return ensemble_runs.compute_part(specification, folder, *parts)

    def content(folder):
        return [path.read_bytes() for path in folder.glob('part-*')]

    assert computed(tmp_path / 'expected') == []
    (expected,) = content(tmp_path / 'expected')

    def act(name):
        folder = tmp_path / f'part_{name}'
        try:
            return computed(folder), folder
        except OSError:
            return None, folder

    def check(found, failure):
        failed, folder = found
        assert content(folder) == [expected] if failed is not None else failure, failure
        assert computed(folder) == [] and content(folder) == [expected], failure

    each_failing(act, check)
    # Arrow writes without Python: a disk that is full after so many bytes.
    for most in range(0, len(expected), len(expected) // 5):
        folder, limits = tmp_path / f'full_{most}', resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
        try:
            with pytest.raises(OSError, match='File too large'):
                computed(folder)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert content(folder) == []
        assert computed(folder) == [] and content(folder) == [expected]
