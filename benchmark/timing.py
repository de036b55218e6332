# SPDX-License-Identifier: Apache-2.0
"""
Time limits, and times measured side by side in processor time of this process.

Processor time does not contain that of other processes, and counts every thread.  Therefore the
benchmarks use one thread (`one_thread`).
"""

from __future__ import annotations

import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any


def one_thread() -> None:
    """Restart this script if its numerical libraries may use more than one thread."""
    wanted = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1', 'MKL_NUM_THREADS': '1'}
    if not wanted.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | wanted)


class TimeUpError(Exception):
    """A run has exceeded its time limit."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """
    Raise TimeUpError in the block after this time, at the next line of Python.

    The limit is of real time: a timer of processor time would reduce the resolution of that clock.
    """
    def stop(signum, frame):
        raise TimeUpError(f'not done after {seconds:g} s')
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def seconds_of(run: Callable[[], Any]) -> tuple[float, Any]:
    """Return the processor time [s] of a run, and what it returned."""
    begin = time.process_time()
    result = run()
    return time.process_time() - begin, result


def interleaved(runs: Mapping[object, Callable[[], object]], rounds: int) -> dict[object, float]:
    """
    Return the median time [s] of each run, one of each in every round.

    So a machine that is slower for a while affects all of them.
    """
    times: dict[object, list[float]] = {key: [] for key in runs}
    for _ in range(rounds):
        for key, run in runs.items():
            times[key].append(seconds_of(run)[0])
    return {key: statistics.median(values) for key, values in times.items()}
