# SPDX-License-Identifier: Apache-2.0
"""Sends recorded messages at their times, without ROS."""

import math
import time
from collections.abc import Callable, Iterator

Message = tuple[int, Callable[[bytes], object], bytes]      # time [ns], its publish function, CDR

SLOWEST, FASTEST = 1e-6, 1e9    # rates of a playback: recorded time over real time
RATES = f'a number in [{SLOWEST:g}, {FASTEST:g}]'
LATE_NS = 10_000_000            # a message that is sent later than this is counted
BUDGET_NS = 20_000_000          # one call sends at most so long


class Playback:
    """Sends messages at their times, late ones at once; has a rate and can be paused."""

    def __init__(self, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self.sent = self.late = self.failed = 0
        self.rate, self.paused = 1.0, False
        self._steady = steady
        self._messages: Iterator[Message] = iter(())
        self._next: Message | None = None
        self._log_ns = self._from_ns = 0    # time of the log, and steady time of the same moment

    def begin(self, begin_ns: int, messages: Iterator[Message], wait_ns: int = 0) -> None:
        """Play these messages, in the order of their times; `begin_ns` comes after a wait."""
        self._messages, self._next = messages, next(messages, None)     # this takes a while
        self._log_ns, self._from_ns = begin_ns, self._steady() + wait_ns

    def now(self) -> int:
        """Return the time of the log up to which all messages are sent [ns]."""
        if self.paused:
            return self._log_ns
        passed = max(self._steady() - self._from_ns, 0) * self.rate
        now_ns = self._log_ns + int(min(passed, 2.0 ** 63))
        return min(now_ns, self._next[0]) if self._next else now_ns

    def tick(self) -> float | None:
        """Send what is due; return the time until more is due [ns], None if all is sent."""
        stop_ns = self._steady() + BUDGET_NS
        while self._next:
            at_ns, send, data = self._next
            now_ns = self._steady()
            left_ns = (math.inf if self.paused else
                       self._from_ns + (at_ns - self._log_ns) / self.rate - now_ns)
            if left_ns > 0 or now_ns > stop_ns:
                return max(left_ns, 0.0)
            try:
                send(data)
                self.sent += 1
            except Exception:       # as with a reader that keeps all and has stopped reading
                self.failed += 1
            self.late += left_ns < -LATE_NS
            self._next = next(self._messages, None)
        return None

    def pause(self, paused: bool) -> None:
        """Pause, or go on without catching up."""
        self._go_on_from_sent()
        self.paused = paused

    def set_rate(self, rate: float) -> None:
        self._go_on_from_sent()
        self.rate = rate

    def _go_on_from_sent(self) -> None:
        self._log_ns, self._from_ns = self.now(), max(self._steady(), self._from_ns)
