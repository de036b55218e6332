# SPDX-License-Identifier: Apache-2.0
"""Sends recorded messages at their times, without ROS."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor

from spinning_top_sim.nodes.pacing import FairLock, SimulatedClock

Message = tuple[int, Callable[[bytes], object], bytes]      # time [ns], its publish function, CDR

SLOWEST, FASTEST = 1e-6, 1e9    # rates of a playback: recorded time over real time
RATES = f'a number in [{SLOWEST:g}, {FASTEST:g}]'
ROUND_GAP_NS = 10_000_000       # from the end of a round to the first message of the next
LATE_NS = 10_000_000            # a message that is sent later than this is counted
BATCH_BYTES, BATCH_MESSAGES, BATCHES = 256_000, 512, 16     # read ahead


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
