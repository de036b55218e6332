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
    """Yield the messages of a round, `span_ns` long, or those of round after round."""
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

    def __init__(self, messages: Iterable[Message]) -> None:
        # Behind the batches comes the error, or None.
        self._batches: queue.Queue[list[Message] | Exception | None] = queue.Queue(BATCHES)
        self._stopped = False
        self._thread = threading.Thread(target=self._read, args=(messages,), name='read ahead',
                                        daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Message]:
        while isinstance(batch := self._batches.get(), list):
            yield from batch
        if batch is not None:
            raise batch

    def stop(self) -> None:
        """End both the reading and the iterating."""
        self._stopped = True
        # The thread that reads may wait for room, and the one that iterates for a batch.
        with contextlib.suppress(queue.Empty):
            while True:
                self._batches.get_nowait()
        self._batches.put(None)
        self._thread.join(1.0)

    def _read(self, messages: Iterable[Message]) -> None:
        batch: list[Message] = []
        end, size = None, 0
        try:
            for message in messages:
                if self._stopped:
                    return
                batch.append(message)
                size += len(message[2])
                if size >= BATCH_BYTES or len(batch) >= BATCH_MESSAGES:
                    self._batches.put(batch)
                    batch, size = [], 0
        except Exception as error:
            end = error
        self._batches.put(batch)
        self._batches.put(end)


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
        self._send, self._source = send, source
        self._clock = SimulatedClock(source, 1.0)
        self._clock.set(begin_ns, running=False)
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
                    self._clock.set(self._sent_until, not self.paused)
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
            self.paused = paused
            self._clock.set(self._clock.now(), not paused)
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
