# SPDX-License-Identifier: Apache-2.0
"""
Runs a part of the stress tests seed by seed, in worker processes with ceilings.

A part is a module here with

    check(seed, folder)  raises for whatever is wrong; returns what came of it, in a word or two
    PATIENCE_S           a seed that takes longer is killed, and is a failure
    MEMORY_MB            address space that a worker may take beyond its modules

A traceback, a hang, a death or memory above the ceiling is a failure of its seed.  Where a worker
hangs or dies is in its standard error.
"""

import collections
import faulthandler
import importlib
import itertools
import multiprocessing
import os
import resource
import tempfile
import threading
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path

STARTING_S = 120.0          # patience for imports
MOST_FAILURES = 20          # then enough is known
PARTS = ('world', 'logs', 'grade', 'wrong')


@dataclass
class Result:
    """What came of the seeds of a part."""

    seeds: int = 0
    outcomes: collections.Counter = field(default_factory=collections.Counter)
    failures: list = field(default_factory=list)


class Worker:
    """A process that checks one seed after another; made anew after a death."""

    def __init__(self, module):
        self._module, self._process = module, None

    def check(self, seed):
        """Return (what came of it, None) or (None, what is wrong)."""
        if self._process is None:
            context = multiprocessing.get_context('spawn')
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=serve, args=(self._module, theirs))
            self._process.start()
            theirs.close()
            assert self._pipe.poll(STARTING_S)
            self._patience = self._pipe.recv()
        self._pipe.send(seed)
        try:
            if self._pipe.poll(self._patience):
                return self._pipe.recv()
            why = f'not done after {self._patience:g} s: killed'
        except EOFError:
            self._process.join()
            why = f'died with code {self._process.exitcode}'
        self.close()
        return None, why

    def close(self):
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
            self._process = None


def serve(module, pipe):
    """Be a worker: take seeds from a pipe, and answer."""
    os.environ.update(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
    part = importlib.import_module(module)
    mapped = 4096 * int(Path('/proc/self/statm').read_text().split()[0])
    limit = mapped + part.MEMORY_MB * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    faulthandler.enable()
    pipe.send(part.PATIENCE_S)
    while True:
        seed = pipe.recv()
        faulthandler.dump_traceback_later(0.95 * part.PATIENCE_S)
        try:
            with tempfile.TemporaryDirectory(prefix='stress_') as folder:
                answer = part.check(seed, Path(folder)), None
        except BaseException:               # whatever it is, it is the finding
            answer = None, traceback.format_exc()
        faulthandler.cancel_dump_traceback_later()
        pipe.send(answer)


def run(part, first, count, seconds, processes, tell):
    """Check seeds from `first` on, so many, or as long as there is time; return the Result."""
    result, lock = Result(), threading.Lock()
    seeds = itertools.count(first) if count is None else iter(range(first, first + count))
    end = None if seconds is None else time.monotonic() + seconds

    def work():
        worker = Worker(f'stress.{part}')
        try:
            while end is None or time.monotonic() < end:
                with lock:
                    seed = next(seeds, None)
                if seed is None or len(result.failures) >= MOST_FAILURES:
                    break
                outcome, failure = worker.check(seed)
                with lock:
                    result.seeds += 1
                    result.outcomes[outcome or 'FAILED'] += 1
                    if failure is not None:
                        result.failures.append(
                            f'{part}: seed {seed}: {failure}\nTo repeat it:  '
                            f'python test/stress {part} --first {seed} --count 1')
                    tell(result, failure)
        finally:
            worker.close()

    threads = [threading.Thread(target=work) for _ in range(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return result
