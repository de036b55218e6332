# SPDX-License-Identifier: Apache-2.0
"""When a recorded message is due, and a thread that reads the messages before they are."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator

from spinning_top_sim.nodes.pacing import FairLock, SimulatedClock

Message = tuple[int, int, bytes]    # time [ns], which publisher, CDR

# Between the last message of a round and the first of the next; also the period of a log whose
# messages have all the same time.
ROUND_GAP_NS = 10_000_000
# A message sent later than this is counted.
LATE_NS = 10_000_000

BATCH_BYTES = 256_000
BATCH_MESSAGES = 512
BATCHES = 16


def rounds(read: Callable[[], Iterable[Message]], span_ns: int, loop: bool) -> Iterator[Message]:
    """
    Yield the messages once, or again and again with times that go on.

    read : returns the messages of one round
    span_ns : length of a round [ns]; the next one begins ROUND_GAP_NS later
    """
    shift = 0
    while True:
        at_ns = None
        for at_ns, index, data in read():
            yield at_ns + shift, index, data
        if at_ns is None or not loop:
            return
        shift += span_ns + ROUND_GAP_NS


class ReadAhead:
    """
    Iterates over messages that a thread reads ahead, a bounded number of them.

    The thread that sends does not read, because every new chunk takes a while.  An error of the
    reading is raised after the messages before it.
    """

    def __init__(self, messages: Iterator[Message]) -> None:
        self._messages = messages
        self._batches: queue.Queue[list[Message]] = queue.Queue(BATCHES)    # an empty one: the end
        self._error: Exception | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._read, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Message]:
        while batch := self._batches.get():
            yield from batch
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End both the reading and the iterating."""
        self._stopped = True
        # The thread that reads may wait for room, and the one that iterates for a batch.
        with contextlib.suppress(queue.Empty):
            while True:
                self._batches.get_nowait()
        self._batches.put([])
        self._thread.join(1.0)

    def _read(self) -> None:
        batch = None
        while batch != [] and not self._stopped:
            batch = self._next_batch()
            self._batches.put(batch)

    def _next_batch(self) -> list[Message]:
        """Return the next messages: none at the end, which is also where an error leads to."""
        batch: list[Message] = []
        size = 0
        try:
            for message in self._messages:
                batch.append(message)
                size += len(message[2])
                if size >= BATCH_BYTES or len(batch) >= BATCH_MESSAGES or self._stopped:
                    break
        except Exception as error:
            self._error = error
            self._messages = iter(())
        return batch


class Playback:
    """
    Sends messages at their times, by a clock that can be paused and change its rate.

    Each deadline is computed from the clock, never from the one before, so nothing drifts.  A
    late message is sent at once and counted, not dropped.

    begin_ns : time at which the clock starts [ns]
    send : takes the index of a publisher, and CDR
    source, sleep : returns steady time [ns]; waits at most so many seconds (None: until woken)
    """

    def __init__(self, begin_ns: int, send: Callable[[int, bytes], None], *, paused: bool = False,
                 source: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float | None], object] | None = None) -> None:
        self._begin_ns, self._send, self._source = begin_ns, send, source
        self._clock = SimulatedClock(source, 1.0)
        self._clock.stop(begin_ns)
        self._sent_until = begin_ns         # all messages before this time are sent
        self._stopped = False
        self._wake = threading.Event()
        self._sleep = sleep or self._sleep_until_woken
        self._lock = FairLock()             # the clock, and sending
        self.paused = paused
        self.sent = self.late = 0

    def run(self, messages: Iterable[Message]) -> None:
        """Play messages in the order of their times, to the end or until stopped."""
        for at_ns, index, data in messages:
            if not self.sent:           # reading the first message may have taken a while
                with self._lock:
                    self._set_clock(self._begin_ns, self.paused)
            self._sent_until = at_ns
            if not self._send_when_due(at_ns, index, data):
                return

    def now(self) -> int:
        """Return the time up to which all messages are sent [ns]."""
        with self._lock:
            return min(self._clock.now(), self._sent_until)

    def pause(self, paused: bool) -> None:
        """Pause, or go on without catching up; once paused, no message is sent any more."""
        with self._lock:
            self._set_clock(self._clock.now(), paused)
        self._wake.set()

    def set_rate(self, rate: float) -> None:
        """Go on at another rate."""
        with self._lock:
            self._clock.set_scale(rate)
        self._wake.set()

    def stop(self) -> None:
        """Make `run` return, soon."""
        with self._lock:
            self._stopped = True
        self._wake.set()

    def _set_clock(self, at_ns: int, paused: bool) -> None:
        self.paused = paused
        self._clock.stop(at_ns)
        if not paused:
            self._clock.start(at_ns)

    def _send_when_due(self, at_ns: int, index: int, data: bytes) -> bool:
        """Send a message when its time has come; return False when stopped before."""
        while True:
            with self._lock:
                if self._stopped:
                    return False
                due = self._clock.when(at_ns)
                left = None if due is None else due - self._source()
                if left is not None and left <= 0:
                    self._send(index, data)
                    self.sent += 1
                    self.late += left < -LATE_NS
                    return True
            self._sleep(None if left is None else left / 1e9)

    def _sleep_until_woken(self, seconds: float | None) -> None:
        self._wake.wait(None if seconds is None else min(seconds, threading.TIMEOUT_MAX))
        self._wake.clear()
