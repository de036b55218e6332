# SPDX-License-Identifier: Apache-2.0
"""Sends recorded messages at their times, without ROS."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from typing import Any

from spinning_top_sim.streams.parameter import Effect, Parameter, Range

Message = tuple[int, Callable[[Any], object], Any]      # log time [ns], how to send it, and it

RATE = Parameter('rate', 'Recorded over real time', 1.0, Range(1e-6, 1e9), effect=Effect.NOW)
LATE_NS = 10_000_000            # a message that is sent later than this is counted
BUDGET_NS = 20_000_000          # services wait for messages that are due at most so long


class Playback:
    """
    Log time that runs with steady time, and messages that are sent when it comes to them.

    begin_ns : log time before anything is played
    steady : returns steady time [ns]
    sent, late, failed : how many messages were sent, late, and could not be sent
    """

    def __init__(self, begin_ns: int, steady: Callable[[], int] = time.monotonic_ns) -> None:
        self.sent = self.late = self.failed = 0
        self.rate, self.paused = 1.0, False
        self._steady = steady
        self._log_ns = self._next_ns = begin_ns     # at `_since_ns`, and of the next message
        self._since_ns = steady()

    @property
    def now_ns(self) -> int:
        """The log time up to which all messages are sent."""
        passed_ns = 0 if self.paused else max(self._steady() - self._since_ns, 0) * self.rate
        return self._log_ns + int(min(passed_ns, self._next_ns - self._log_ns))

    def go_on(self, rate: float, paused: bool) -> None:
        """Go on from here at another rate, or pause; nothing is caught up."""
        self._log_ns, self._since_ns = self.now_ns, max(self._steady(), self._since_ns)
        self.rate, self.paused = rate, paused

    def play(self, begin_ns: int, messages: Iterator[Message], wait_ns: int = 0,
             ) -> Iterator[float]:
        """
        Let log time be `begin_ns` after a wait; return an iterator that sends these messages.

        It yields how long to wait before it is asked again [ns].

        messages : in the order of their times, which are not before `begin_ns`
        """
        first = [*islice(messages, 1)]      # reading it takes a while
        self._log_ns = self._next_ns = begin_ns
        self._since_ns = self._steady() + wait_ns
        return self._send(chain(first, messages))

    def _send(self, messages: Iterable[Message]) -> Iterator[float]:
        stop_ns = self._steady() + BUDGET_NS
        for self._next_ns, send, message in messages:
            while (left_ns := self._left_ns()) > 0 or self._steady() > stop_ns:
                yield max(left_ns, 0.0)
                stop_ns = self._steady() + BUDGET_NS
            try:
                send(message)
                self.sent += 1
            except Exception:       # as with a reader that keeps all and has stopped reading
                self.failed += 1
            self.late += left_ns < -LATE_NS

    def _left_ns(self) -> float:
        return math.inf if self.paused else (
            self._since_ns + (self._next_ns - self._log_ns) / self.rate - self._steady())
