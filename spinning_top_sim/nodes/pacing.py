# SPDX-License-Identifier: Apache-2.0
"""When ticks are due, without ROS: a clock, a fair lock and a thread."""

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
        self._from_source = self._source() if running else None
        self._from_simulated = simulated_ns

    def set_scale(self, scale: float) -> None:
        self.set(self.now(), self._from_source is not None)
        self._scale = scale

    def now(self) -> int:
        if self._from_source is None:
            return self._from_simulated
        return self._from_simulated + int((self._source() - self._from_source) * self._scale)

    def when(self, simulated_ns: int) -> int | None:
        """Return the source's time of a simulated time [ns]; None while the clock stands."""
        begin = self._from_source
        return None if begin is None else (
            begin + round((simulated_ns - self._from_simulated) / self._scale))


class FairLock:
    """A lock that a thread cannot take again before a thread that waits for it."""

    def __init__(self) -> None:
        self._lock, self._next = threading.Lock(), threading.Lock()

    def __enter__(self) -> None:
        with self._next:        # one thread waits for `_lock`, the others for `_next`
            self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class DeadlineThread(threading.Thread):
    """
    Calls `tick` at absolute deadlines until it is stopped; if that returns True, calls `idle`.

    A late tick comes at once, and deadlines that have passed are skipped.

    grid : returns a deadline on the monotonic clock and the time between two, under a second [s]
    failed : takes an error that a call raises; the thread goes on
    """

    # Share of the period to sleep between `tick` and `idle`.  A tick wakes threads that send; they
    # often run on the same core and would wait for `idle`.
    NAP = 0.15
    SHORTEST_NAP = 1e-4     # [s]
    AFTER_FAILURE_S = 0.05

    def __init__(self, tick: Callable[[], object], idle: Callable[[], object],
                 grid: Callable[[], tuple[float, float]],
                 failed: Callable[[Exception], object]) -> None:
        super().__init__(name='simulation', daemon=True)
        self._tick, self._idle, self._grid, self._failed = tick, idle, grid, failed
        self._stopped = False

    def run(self) -> None:
        grid, newest = None, 0          # `newest`: number of the last deadline that had a tick
        while not self._stopped:
            try:
                before, grid = grid, self._grid()
                origin, period = grid
                passed = int((time.monotonic() - origin) // period)
                newest = max(passed, newest + 1) if grid == before else passed + 1
                left = origin + newest * period - time.monotonic()
                if left > 0.0:
                    time.sleep(left)
                if not self._stopped and self._tick():
                    if self.NAP * period >= self.SHORTEST_NAP:
                        time.sleep(self.NAP * period)
                    self._idle()
            except Exception as error:
                self._failed(error)
                time.sleep(self.AFTER_FAILURE_S)

    def stop(self) -> None:
        self._stopped = True
        if self.is_alive():
            self.join(5.0)
