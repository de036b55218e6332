# SPDX-License-Identifier: Apache-2.0
"""Which simulated time it should be by now, and a thread that asks at absolute deadlines."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class SimulatedClock:
    """
    Maps a running clock to simulated time, so that a late look loses nothing.

    source: returns nanoseconds of the clock to follow (steady, or ROS time);  scale: simulated
    over real time.  Does not run before `start`.
    """

    def __init__(self, source: Callable[[], int], scale: float) -> None:
        self._source, self._scale = source, scale
        self._from_source: int | None = None
        self._from_simulated = 0

    @property
    def running(self) -> bool:
        """Whether time passes."""
        return self._from_source is not None

    def start(self, simulated_ns: int) -> None:
        """Run from this simulated time on."""
        self._from_source, self._from_simulated = self._source(), simulated_ns

    def stop(self, at_ns: int | None = None) -> None:
        """Stand still: a pause, here or at this simulated time."""
        self._from_simulated = self.now() if at_ns is None else at_ns
        self._from_source = None

    def now(self) -> int:
        """Return the simulated time that is due [ns]."""
        if self._from_source is None:
            return self._from_simulated
        elapsed = self._source() - self._from_source
        return self._from_simulated + int(elapsed * self._scale)

    def when(self, simulated_ns: int) -> int | None:
        """Return at what time of the source it will be this simulated time; None: it stands."""
        if self._from_source is None:
            return None
        return self._from_source + round((simulated_ns - self._from_simulated) / self._scale)

    def set_scale(self, scale: float) -> None:
        """Go on from now at another speed."""
        now = self.now()
        self._scale = scale
        self._from_simulated = now
        if self.running:
            self.start(now)


class Onward:
    """
    The readings of a clock less the steps back that it takes: a log that is played anew.

    source: returns nanoseconds;  stepped_back_ns: by how much it has gone back, all together
    """

    def __init__(self, source: Callable[[], int]) -> None:
        self._source = source
        self._newest: int | None = None
        self.stepped_back_ns = 0

    def __call__(self) -> int:
        reading = self._source()
        if self._newest is not None and reading < self._newest:
            self.stepped_back_ns += self._newest - reading
        self._newest = reading
        return reading + self.stepped_back_ns


class DeadlineThread(threading.Thread):
    """
    Calls `tick` at absolute deadlines, rate times a second, until it is stopped.

    tick: returns whether `spare` shall be called before the next one

    A sleeping thread wakes up at half the processor time of a wait set with services and
    subscriptions (`python benchmark/wake_up.py`): worth it from 500 Hz on.  Who comes late ticks
    at once, and deadlines that have passed meanwhile are skipped, not made up for; the grid of
    deadlines stays.
    """

    # Looked at this often while waiting for a far deadline, so that `stop` is quick.
    LONGEST_SLEEP = 0.05
    # `spare` is called after this share of the period: whom the tick has woken is often put on
    # the same core, because its waker will sleep soon, and waits for that.  At high rates there is
    # no time for it.
    NAP = 0.15
    SHORTEST_NAP = 1e-4

    def __init__(self, tick: Callable[[], object], rate: float,
                 spare: Callable[[], None] = lambda: None, *, name: str = 'simulation') -> None:
        super().__init__(name=name, daemon=True)
        self._tick, self._spare = tick, spare
        self._stopped = False
        self._grid = time.monotonic(), 1.0 / rate

    def set_rate(self, rate: float) -> None:
        """Change the rate [Hz] from the next deadline on."""
        self._grid = self._grid[0], 1.0 / rate

    def align(self, origin: float) -> None:
        """Have deadlines at whole periods from this time on the monotonic clock [s]."""
        self._grid = origin, self._grid[1]

    def run(self) -> None:
        grid: tuple[float, float] | None = None
        newest = 0
        while not self._stopped:
            before, grid = grid, self._grid     # which another thread may change at any time
            origin, period = grid
            passed = int((time.monotonic() - origin) // period)     # the deadline before now
            if grid is not before:
                newest = passed
            if passed <= newest:
                newest += 1
                deadline = origin + newest * period
                while (left := deadline - time.monotonic()) > 0.0 and not self._stopped:
                    time.sleep(min(left, self.LONGEST_SLEEP))
            else:
                newest = passed
            if not self._stopped and self._tick():
                nap = min(self.NAP * period, self.LONGEST_SLEEP)
                if nap >= self.SHORTEST_NAP:
                    time.sleep(nap)
                self._spare()

    def stop(self) -> None:
        """Ask the thread to end, and wait for it."""
        self._stopped = True
        if self is not threading.current_thread():
            self.join(5.0)
