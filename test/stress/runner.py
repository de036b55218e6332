# SPDX-License-Identifier: Apache-2.0
"""
Runs a part of the stress tests seed by seed, in worker processes with ceilings.

A part is a module here with

    check(seed, folder)  raises for whatever is wrong; returns what came of it, in a word or two
    PATIENCE_S           a seed that takes longer is killed, and is a failure
    MEMORY_MB            address space that a worker may take beyond its modules

A traceback, a hang, a death or memory above the ceiling is a failure of its seed.
"""

import collections
import contextlib
import faulthandler
import importlib
import itertools
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
STARTING_S = 120.0          # patience for imports
MOST_FAILURES = 20          # then enough is known
PARTS = ('logs', 'nodes', 'sensor', 'exam', 'wrong', 'grade')


def module_of(part):
    """Return the module of a part; STRESS_MODULE in the environment is another one for all."""
    return importlib.import_module(os.environ.get('STRESS_MODULE', f'stress.{part}'))


def repeat_command(part, seed):
    return f'python test/stress {part} --first {seed} --count 1'


@dataclass
class Result:
    """What came of the seeds of a part."""

    seeds: int = 0
    outcomes: collections.Counter = field(default_factory=collections.Counter)
    failures: list = field(default_factory=list)
    peak_mb: float = 0.0            # of a worker: the largest resident set


class Worker:
    """A process that checks one seed after another; made anew after a death."""

    def __init__(self, part, folder):
        self._part, self._folder = part, folder
        self._patience = module_of(part).PATIENCE_S
        self._process = None

    def _start(self):
        environment = {**os.environ, 'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'}
        self._errors = (self._folder / 'errors').open('wb')
        self._process = subprocess.Popen(
            [sys.executable, str(HERE), '--worker', self._part, str(self._folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, env=environment,
            start_new_session=True)

    def check(self, seed):
        """Return (what came of it, None) or (None, what is wrong), and the peak memory [MB]."""
        if self._process is None or self._process.poll() is not None:
            self._start()
            assert self._answer(STARTING_S) == {'ready': True}, self._said()
        self._process.stdin.write(f'{seed}\n'.encode())
        self._process.stdin.flush()
        answer = self._answer(self._patience)
        if answer is None:
            return None, f'not done after {self._patience:g} s: killed\n{self._said()}', 0.0
        if not answer:
            self._process.wait()
            return None, f'died with code {self._process.returncode}\n{self._said()}', 0.0
        return answer['outcome'], answer['failure'], answer['peak_mb']

    def _answer(self, seconds):
        """Return the next answer; {} from a process that died, None from one that was killed."""
        if not select.select([self._process.stdout], [], [], seconds)[0]:
            self._process.send_signal(signal.SIGUSR1)       # it prints where it is
            time.sleep(0.5)
            self.close()
            return None
        line = self._process.stdout.readline()
        return json.loads(line) if line else {}

    def _said(self):
        return (self._folder / 'errors').read_text(errors='replace')[-20000:]

    def close(self):
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process.stdin.close()
            self._process.stdout.close()
            self._errors.close()


def run(part, first=0, count=None, seconds=None, processes=1, tell=None):
    """Check seeds from `first` on, so many, or as long as there is time; return the Result."""
    result, lock = Result(), threading.Lock()
    seeds = itertools.count(first) if count is None else iter(range(first, first + count))
    end = None if seconds is None else time.monotonic() + seconds

    def work(folder):
        worker = Worker(part, folder)
        try:
            while end is None or time.monotonic() < end:
                with lock:
                    seed = next(seeds, None)
                if seed is None or len(result.failures) >= MOST_FAILURES:
                    break
                outcome, failure, peak_mb = worker.check(seed)
                with lock:
                    result.seeds += 1
                    result.peak_mb = max(result.peak_mb, peak_mb)
                    result.outcomes[outcome or 'FAILED'] += 1
                    if failure is not None:
                        result.failures.append(
                            f'{part}: seed {seed}: {failure}\nTo repeat it:  '
                            f'{repeat_command(part, seed)}')
                    if tell is not None:
                        tell(result, failure)
        finally:
            worker.close()

    with tempfile.TemporaryDirectory(prefix=f'stress_{part}_') as temporary:
        folders = [Path(temporary, str(number)) for number in range(processes)]
        for folder in folders:
            folder.mkdir()
        threads = [threading.Thread(target=work, args=(folder,)) for folder in folders[1:]]
        for thread in threads:
            thread.start()
        work(folders[0])
        for thread in threads:
            thread.join()
    return result


def serve(part, folder):
    """Be a worker: take seeds from the standard input, and answer on the standard output."""
    answers = os.fdopen(os.dup(1), 'w', buffering=1)
    os.dup2(2, 1)               # whatever is printed meanwhile
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1)
    module = module_of(part)
    limit = _status('VmSize') + module.MEMORY_MB * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    print(json.dumps({'ready': True}), file=answers)
    for line in sys.stdin:
        own = Path(folder, 'case')
        shutil.rmtree(own, ignore_errors=True)
        own.mkdir()
        outcome = failure = None
        try:
            outcome = module.check(int(line), own)
        except BaseException:               # whatever it is, it is the finding
            failure = traceback.format_exc()
        print(json.dumps({'outcome': outcome, 'failure': failure,
                          'peak_mb': _status('VmHWM') / 1e6}), file=answers)


def _status(name):
    """Return a number of bytes that the kernel tells of this process."""
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith(f'{name}:'):
            return 1024 * int(line.split()[1])
    raise AssertionError(f'no {name}')
