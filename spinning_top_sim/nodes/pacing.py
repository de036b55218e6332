# SPDX-License-Identifier: Apache-2.0
"""When ticks and recorded messages are due, without ROS: a clock, a fair lock, threads."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

Message = tuple[int, Callable[[bytes], object], bytes]      # time [ns], its publish function, CDR

SLOWEST, FASTEST = 1e-6, 1e9    # rates of a playback: recorded time over real time
RATES = f'a number in [{SLOWEST:g}, {FASTEST:g}]'
ROUND_GAP_NS = 10_000_000       # from the end of a round to the first message of the next
LATE_NS = 10_000_000            # a message that is sent later than this is counted
BATCH_BYTES, BATCH_MESSAGES, BATCHES = 256_000, 512, 16     # read ahead


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


def read_ahead(messages: Iterator[Message]) -> Generator[Message]:
    """Yield messages that a thread reads ahead; raise its error in their place."""
    def batch() -> list[Message]:
        found: list[Message] = []
        size = 0
        while size < BATCH_BYTES and len(found) < BATCH_MESSAGES:
            if (message := next(messages, None)) is None:
                break
            found.append(message)
            size += len(message[2])
        return found

    with ThreadPoolExecutor(1) as reader:
        ahead = deque(reader.submit(batch) for _ in range(BATCHES))
        try:
            while found := ahead.popleft().result():
                ahead.append(reader.submit(batch))
                yield from found
        finally:
            reader.shutdown(wait=False, cancel_futures=True)


class Playback:
    """Sends messages at their times, late ones at once; has a rate and can be paused."""

    def __init__(self, begin_ns: int, paused: bool = False) -> None:
        self._clock = SimulatedClock(time.monotonic_ns, 1.0)
        self._clock.set(begin_ns, running=False)
        self._sent_until = begin_ns         # all messages before this time are sent
        self._stopped = False
        self._changed = threading.Event()   # wakes the thread that plays
        self._lock = FairLock()             # held while sending, and for the clock
        self.paused = paused
        self.sent = self.late = 0

    def run(self, messages: Iterable[Message]) -> None:
        """Play messages in the order of their times, to the end or until stopped."""
        for at_ns, send, data in messages:
            if not self.sent:           # reading the first message takes a while
                with self._lock:
                    self._clock.set(self._sent_until, not self.paused)
            self._sent_until = at_ns
            while (left_ns := self._send_if_due(at_ns, send, data)) > 0:
                self._changed.wait(min(left_ns / 1e9, threading.TIMEOUT_MAX))
                self._changed.clear()
            if self._stopped:
                return

    def _send_if_due(self, at_ns: int, send: Callable[[bytes], object], data: bytes) -> float:
        """Send a message if it is due; return the time left [ns], <= 0 if sent or stopped."""
        with self._lock:
            if self._stopped:
                return 0.0
            due_ns = self._clock.when(at_ns)
            left_ns = math.inf if due_ns is None else due_ns - time.monotonic_ns()
            if left_ns <= 0:
                send(data)
                self.sent += 1
                self.late += left_ns < -LATE_NS
            return left_ns

    def now(self) -> int:
        """Return the time up to which all messages are sent [ns]."""
        with self._lock:
            return min(self._clock.now(), self._sent_until)

    def pause(self, paused: bool) -> None:
        """Pause, or go on without catching up.  No message is sent once this has paused."""
        with self._lock:
            self.paused = paused
            self._go_on_from_sent(not paused)
        self._changed.set()

    def set_rate(self, rate: float) -> None:
        with self._lock:
            self._go_on_from_sent(self._clock.when(0) is not None)
            self._clock.set_scale(rate)
        self._changed.set()

    def _go_on_from_sent(self, running: bool) -> None:
        # The clock is ahead if sending is too slow.
        self._clock.set(min(self._clock.now(), self._sent_until), running)

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
        self._changed.set()
