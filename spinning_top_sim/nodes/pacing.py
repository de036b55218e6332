# SPDX-License-Identifier: Apache-2.0
"""Clocks, a fair lock, and the thread that calls a function at absolute deadlines."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class SimulatedClock:
    """Maps a source clock [ns] to simulated time [ns]: `scale` times as fast, with pauses."""

    def __init__(self, source: Callable[[], int], scale: float) -> None:
        self._source, self._scale = source, scale
        self._from_source: int | None = None        # None: the clock stands
        self._from_simulated = 0

    @property
    def running(self) -> bool:
        """Whether time passes."""
        return self._from_source is not None

    def set_scale(self, scale: float) -> None:
        """Go on from the present time at another speed."""
        if self.running:
            self.start(self.now())
        self._scale = scale

    def start(self, simulated_ns: int) -> None:
        """Run from this simulated time on."""
        self._from_source, self._from_simulated = self._source(), simulated_ns

    def stop(self, at_ns: int | None = None) -> None:
        """Stand at this simulated time, or at the present one."""
        self._from_simulated = self.now() if at_ns is None else at_ns
        self._from_source = None

    def now(self) -> int:
        """Return the simulated time [ns]."""
        if self._from_source is None:
            return self._from_simulated
        return self._from_simulated + int((self._source() - self._from_source) * self._scale)

    def when(self, simulated_ns: int) -> int | None:
        """Return the source's time of a simulated time [ns]; None while the clock stands."""
        if self._from_source is None:
            return None
        return self._from_source + round((simulated_ns - self._from_simulated) / self._scale)


class MonotonicClock:
    """Follows a clock without its steps back, as of a log in a loop, and tells of these [ns]."""

    def __init__(self, source: Callable[[], int], tell: Callable[[int], object]) -> None:
        self._source, self._tell = source, tell
        self._newest_ns = self._stepped_back_ns = 0

    def __call__(self) -> int:
        back_ns, self._newest_ns = self._newest_ns, self._source()
        back_ns -= self._newest_ns
        if back_ns > 0:
            self._stepped_back_ns += back_ns
            self._tell(back_ns)
        return self._newest_ns + self._stepped_back_ns


class FairLock:
    """
    A lock that threads get in turn.

    An ordinary lock stays with a thread that takes it again and again, as ticks do on a machine
    that is overloaded: those who wait for it do not wake up in time.
    """

    def __init__(self) -> None:
        self._lock, self._next = threading.Lock(), threading.Lock()

    def __enter__(self) -> None:
        with self._next:        # held by the thread that is next
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class DeadlineThread(threading.Thread):
    """
    Calls `tick` at absolute deadlines until it is stopped, and `idle` behind it where it asks so.

    A tick that comes late comes at once.  Deadlines that have passed meanwhile are skipped, and
    the grid of deadlines stays.  A sleeping thread wakes up at less processor time than an rclpy
    timer (`python benchmark/wake_up.py`).
    """

    # Longest sleep [s], so that `stop` is quick.
    LONGEST_SLEEP = 0.05
    # `idle` is called after this share of the period: a thread woken by the tick is often put on
    # the same core, because its waker will sleep soon.  At high rates there is no time for that.
    NAP = 0.15
    SHORTEST_NAP = 1e-4

    def __init__(self, tick: Callable[[], object], rate: float,
                 idle: Callable[[], object]) -> None:
        super().__init__(name='simulation', daemon=True)
        self._tick, self._idle = tick, idle
        self._stopped = False
        # Origin and period [s].  Another thread may replace it at any time.
        self._grid = time.monotonic(), 1.0 / rate

    def set_rate(self, rate: float) -> None:
        """Change the rate [Hz] from the next deadline on."""
        self._grid = self._grid[0], 1.0 / rate

    def align(self, origin: float) -> None:
        """Put deadlines at whole periods from this time of the monotonic clock [s]."""
        self._grid = origin, self._grid[1]

    def run(self) -> None:
        grid: tuple[float, float] | None = None
        newest = 0              # number of the deadline of the newest tick
        while not self._stopped:
            before, grid = grid, self._grid
            origin, period = grid
            passed = int((time.monotonic() - origin) // period)
            newest = passed + 1 if grid is not before else max(passed, newest + 1)
            deadline = origin + newest * period
            while (left := deadline - time.monotonic()) > 0.0 and not self._stopped:
                time.sleep(min(left, self.LONGEST_SLEEP))
            if not self._stopped and self._tick():
                nap = min(self.NAP * period, self.LONGEST_SLEEP)
                if nap >= self.SHORTEST_NAP:
                    time.sleep(nap)
                self._idle()

    def stop(self) -> None:
        """Ask the thread to end, and wait for it."""
        self._stopped = True
        if self.is_alive():
            self.join(5.0)
