# SPDX-License-Identifier: Apache-2.0
"""Recorded messages with their recorded spacing: reading ahead, rounds, and when to send."""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator

from spinning_top_sim.nodes.pacing import FairLock, SimulatedClock

Message = tuple[int, int, bytes]    # time [ns], which publisher, CDR

# Between the last message of a round and the first of the next; also what a log of a single
# moment is repeated at.
ROUND_GAP_NS = 10_000_000
# A message sent later than this is counted.
LATE_NS = 10_000_000

BATCH_BYTES = 256_000
BATCH_MESSAGES = 512
BATCHES = 16


def rounds(read: Callable[[], Iterable[Message]], span_ns: int, loop: bool) -> Iterator[Message]:
    """
    Yield the messages once, or again and again with times that go on.

    Parameters
    ----------
    read
        Returns the messages of one round.
    span_ns
        Length of a round [ns]; the next one begins ROUND_GAP_NS later.
    loop
        Whether there is a next round.

    """
    shift = 0
    while True:
        empty = True
        for at_ns, index, data in read():
            empty = False
            yield at_ns + shift, index, data
        if empty or not loop:
            return
        shift += span_ns + ROUND_GAP_NS


class ReadAhead:
    """
    Iterates over messages that a thread reads ahead, a bounded number of them.

    Reading takes a while whenever a chunk begins, so the thread that waits for deadlines does not
    read.  An error of the reading is raised after the messages before it.
    """

    _END = object()

    def __init__(self, messages: Iterable[Message]) -> None:
        self._messages = messages
        self._batches: queue.Queue = queue.Queue(BATCHES)
        self._stopped = False
        self._thread = threading.Thread(target=self._read, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Message]:
        while not self._stopped:
            batch = self._batches.get()
            if batch is self._END:
                return
            if isinstance(batch, Exception):
                raise batch
            yield from batch

    def stop(self) -> None:
        """End both the reading and the iterating."""
        self._stopped = True
        # The thread that reads may wait for room, and the one that iterates for a batch.
        with contextlib.suppress(queue.Empty):
            while True:
                self._batches.get_nowait()
        with contextlib.suppress(queue.Full):
            self._batches.put_nowait(self._END)
        if self._thread is not threading.current_thread():
            self._thread.join(1.0)

    def _read(self) -> None:
        batch: list[Message] = []
        size = 0
        last: object = self._END
        try:
            for message in self._messages:
                batch.append(message)
                size += len(message[2])
                if size >= BATCH_BYTES or len(batch) >= BATCH_MESSAGES:
                    self._batches.put(batch)
                    batch, size = [], 0
                if self._stopped:
                    return
        except Exception as error:
            last = error
        self._batches.put(batch)
        self._batches.put(last)


class Playback:
    """
    Sends messages at their times, by a clock that can be paused and change its rate.

    Each deadline is computed from the clock, never from the one before, so nothing drifts.  A
    late message is sent at once and counted, not dropped.

    Parameters
    ----------
    messages
        In the order of their times.
    begin_ns, rate
        Time at which the clock starts [ns], and its speed.
    send
        Takes the index of a publisher, and CDR.
    source, sleep
        Returns steady time [ns]; waits at most so many seconds (None: until woken).

    Attributes
    ----------
    sent, late : int
        Counts of messages.
    paused : bool

    """

    def __init__(self, messages: Iterable[Message], begin_ns: int, rate: float,
                 send: Callable[[int, bytes], None], *, paused: bool = False,
                 source: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float | None], None] | None = None) -> None:
        self._messages, self._send, self._source = messages, send, source
        self._clock = SimulatedClock(source, rate)
        self._clock.stop(begin_ns)
        self._begun = False
        self._stopped = False
        self._known_until = begin_ns        # all messages before this time are sent
        self._wake = threading.Event()
        self._sleep = sleep or self._sleep_until_told
        self._lock = FairLock()             # the clock, and sending
        self.paused = paused
        self.sent = self.late = 0

    def run(self) -> None:
        """Play to the end, or until stopped."""
        messages = iter(self._messages)
        first = list(itertools.islice(messages, 1))     # read before the clock starts
        with self._control():
            self._begun = True
            self._run_clock()
        for at_ns, index, data in itertools.chain(first, messages):
            self._known_until = at_ns
            if not self._send_when_due(at_ns, index, data):
                return

    def now(self) -> int:
        """Return the time up to which all messages are sent [ns]."""
        with self._control():
            return min(self._clock.now(), self._known_until)

    def pause(self, paused: bool) -> None:
        """Pause, or go on without catching up; once paused, no message is sent any more."""
        with self._control():
            self.paused = paused
            self._run_clock()

    def set_rate(self, rate: float) -> None:
        """Go on at another rate."""
        with self._control():
            self._clock.set_scale(rate)

    def stop(self) -> None:
        """Make `run` return, soon."""
        with self._control():
            self._stopped = True

    def rest(self, seconds: float) -> bool:
        """Wait before or after playing; return False once stopped."""
        self._sleep(seconds)
        return not self._stopped

    def _run_clock(self) -> None:
        runs = self._begun and not self.paused
        if runs and not self._clock.running:
            self._clock.start(self._clock.now())
        elif not runs:
            self._clock.stop()

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

    @contextlib.contextmanager
    def _control(self) -> Iterator[None]:
        with self._lock:
            yield
        self._wake.set()

    def _sleep_until_told(self, seconds: float | None) -> None:
        self._wake.wait(None if seconds is None else min(seconds, threading.TIMEOUT_MAX))
        self._wake.clear()
