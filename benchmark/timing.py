# SPDX-License-Identifier: Apache-2.0
"""Time limits, and times measured side by side."""

from __future__ import annotations

import signal
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


class TimeUpError(Exception):
    """A run took longer than it was given."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeUpError in the block after so long: at the next line of Python that runs in it."""
    def stop(signum, frame):
        raise TimeUpError(f'not done after {seconds:g} s')
    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def interleaved(runs: Mapping[object, Callable[[], object]], rounds: int) -> dict[object, float]:
    """
    Return the median time [s] of each run, one of each in every round.

    So a machine that is slower for a while is slower for all of them.
    """
    times: dict[object, list[float]] = {key: [] for key in runs}
    for _ in range(rounds):
        for key, run in runs.items():
            begin = time.perf_counter()
            run()
            times[key].append(time.perf_counter() - begin)
    return {key: statistics.median(values) for key, values in times.items()}
