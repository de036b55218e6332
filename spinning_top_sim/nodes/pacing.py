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

    def set(self, simulated_ns: int, running: bool) -> None:
        """Run from this simulated time on, or stand there."""
        self._from_source = self._source() if running else None
        self._from_simulated = simulated_ns

    def set_scale(self, scale: float) -> None:
        """Go on from the present time at another speed."""
        self.set(self.now(), self.running)
        self._scale = scale

    @property
    def running(self) -> bool:
        """Whether time passes."""
        return self._from_source is not None

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


class FairLock:
    """
    A lock that threads get in turn.

    An ordinary one stays with a thread that takes it again and again, as an overloaded tick does.
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

    A late tick comes at once, deadlines that have passed are skipped, and their grid stays.  A
    sleeping thread costs less processor time than an rclpy timer (`benchmark/wake_up.py`).

    grid : returns a deadline on the monotonic clock and the time between two [s]
    failed : takes any error of these; the thread goes on
    """

    LONGEST_SLEEP = 0.05    # [s], so that `stop` is quick
    # `idle` is called after this share of the period: a thread woken by the tick is often put on
    # the same core, because its waker will sleep soon.  At high rates there is no time for that.
    NAP = 0.15
    SHORTEST_NAP = 1e-4

    def __init__(self, tick: Callable[[], object], idle: Callable[[], object],
                 grid: Callable[[], tuple[float, float]],
                 failed: Callable[[Exception], object]) -> None:
        super().__init__(name='simulation', daemon=True)
        self._tick, self._idle, self._grid, self._failed = tick, idle, grid, failed
        self._stopped = False
        self._newest = 0                # number of the deadline of the newest tick
        self._newest_grid: tuple[float, float] | None = None

    def run(self) -> None:
        while not self._stopped:
            try:
                self._wait_and_tick()
            except Exception as error:
                self._failed(error)
                time.sleep(self.LONGEST_SLEEP)

    def _wait_and_tick(self) -> None:
        before, self._newest_grid = self._newest_grid, self._grid()
        origin, period = self._newest_grid
        passed = int((time.monotonic() - origin) // period)
        self._newest = (max(passed, self._newest + 1) if self._newest_grid == before
                        else passed + 1)
        deadline = origin + self._newest * period
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
