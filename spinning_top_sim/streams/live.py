# SPDX-License-Identifier: Apache-2.0
"""
A simulation that sends its messages in time.

The channels of one grid are computed together, a short time ahead.  What is computed waits, as
rows for the log, in one queue for subscribers.  An event, another rate or listener drops it.
"""

import contextlib
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from operator import attrgetter
from typing import Any

import numpy as np

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.channel import Channel, Rows
from spinning_top_sim.streams.events import MOTIONS, RESTARTS, Event
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NEVER_NS, Times

# What is computed at once: little behind an event, as the next one may come soon.
LEAST_SPAN_NS, FIRST_SPAN_NS, LONGEST_SPAN_NS = 100_000, 20_000_000, 300_000_000
FIRST_STRIDE_NS = 1_000     # of the motion, whose pace is not known before it is tried
PIECE_SECONDS = 1e-2        # of computing between two calls of give_way, half of it for the solver
BLOCKED_SECONDS = 1.0       # a reader that stalls holds every call for 0.1 s: it gets a rest

# Messages of a topic for a log: its number there, log times (n,) [ns], messages (n, size).
LogRows = tuple[int, Times, Rows]


@dataclass(eq=False)
class Output:
    """
    Where the messages of a channel go.

    publish : takes each message in time, and may raise; None while there are no subscribers
    log_index : number of the topic in the log, None if it is not recorded
    clock : returns steady time [s]
    sent, skipped, failed : messages that were published, that were too late for that, and that
        `publish` refused
    """

    channel: Channel
    publish: Callable[[bytes], object] | None = None
    log_index: int | None = None
    clock: Callable[[], float] = time.monotonic
    sent: int = 0
    skipped: int = 0
    failed: int = 0
    # For the log: log times [ns], as array and list, and rows; so many are sent, others wait.
    _log_times: Times = field(default_factory=lambda: np.empty(0, np.int64))
    _times: list[int] = field(default_factory=list)
    _rows: Rows = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    _taken: int = 0
    _blocked_until: float = 0.0     # on the clock

    @property
    def is_used(self) -> bool:
        """Whether anybody takes the messages: else they are not computed."""
        return self.publish is not None or self.log_index is not None

    def add(self, log_times: Times, rows: Rows) -> None:
        """Put messages behind those that wait for the log."""
        if self._taken < len(self._times):
            log_times = np.concatenate((self._log_times[self._taken:], log_times))
            rows = np.concatenate((self._rows[self._taken:], rows))
        self._log_times, self._times, self._rows = log_times, log_times.tolist(), rows
        self._taken = 0

    def take(self, until_ns: int) -> tuple[Times, Rows]:
        """Return what waits for the log up to a log time [ns], and waits no longer."""
        begin, self._taken = self._taken, bisect_right(self._times, until_ns, self._taken)
        return self._log_times[begin:self._taken], self._rows[begin:self._taken]

    def send(self, message: bytes) -> None:
        """Publish a message; what the middleware refuses is counted."""
        assert self.publish is not None
        if self.clock() >= self._blocked_until:
            try:
                self.publish(message)
            except Exception:       # rclpy raises RCLError, which it does not export
                self._blocked_until = self.clock() + BLOCKED_SECONDS
            else:
                self.sent += 1
                return
        self.failed += 1


@dataclass(eq=False)
class _Progress:
    """How far the motion is computed, or the messages of the `outputs` of one grid."""

    computed_ns: int
    span_ns: int            # that is computed at once
    outputs: Mapping[Channel, Output] = field(default_factory=dict)


class LiveSimulation(Simulation):
    """
    A simulation with an output for each channel.

    outputs : of each channel, in the order in which the messages of one time are sent
    clock : returns steady time [s]
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(values, epoch_ns)
        self.outputs = [Output(channel, clock=clock) for channel in self.channels]
        self._clock = clock
        self._write: Callable[[Sequence[LogRows]], object] = lambda rows: None
        self._motion = _Progress(self.sent_ns, FIRST_STRIDE_NS)
        self.refresh()

    def log_to(self, write: Callable[[Sequence[LogRows]], object] | None,
               channels: Sequence[Channel] = ()) -> None:
        """Record these channels, numbered in this order, and no others after `sent_ns`."""
        self._write = write or self._write
        numbers = {channel: number for number, channel in enumerate(channels)}
        for output in self.outputs:
            output.log_index = numbers.get(output.channel)
        self.refresh()

    def apply(self, kind: str, **details: Any) -> Event:
        if self.sent_ns < 0 and kind in MOTIONS:    # the sample of t = 0 comes before them
            self.send(0)
        event = super().apply(kind, **details)
        for output, channel in zip(self.outputs, self.channels, strict=True):
            output.channel = channel
        if kind in RESTARTS:
            self._motion = _Progress(self.sent_ns, FIRST_STRIDE_NS)
        self.refresh()
        return event

    def refresh(self) -> None:
        """Compute anew what waits: the motion, or who takes the messages, has changed."""
        # For subscribers: log times [ns], numbers of outputs, messages.
        self._waiting: deque[tuple[int, int, bytes]] = deque()
        outputs_of: dict[tuple[int, int], dict[Channel, Output]] = {}
        for output in self.outputs:
            output.take(NEVER_NS)
            if output.is_used:
                outputs_of.setdefault(output.channel.grid, {})[output.channel] = output
        # Without takers the motion alone goes on, as a grid without outputs.
        self._grids = [_Progress(self.sent_ns, FIRST_SPAN_NS, outputs)
                       for outputs in outputs_of.values()] or [self._motion]
        self._ready_ns = self.sent_ns       # up to here all messages are sent or wait

    def send(self, due_ns: int, publish_from_ns: int = 0,
             give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every message due up to a time; return whether that was reached.

        publish_from_ns : earlier messages are too late to be published; they are recorded
        give_way : asked between pieces of work; True ends the call early

        Raises IntegrationError if the motion does not go on; what comes before is sent.
        """
        while self.sent_ns < due_ns:
            if self._ready_ns < due_ns:
                # No further than is computed next: a solver keeps a limited number of steps.
                self._go_on(self._grids, min([due_ns, *(
                    one.computed_ns + one.span_ns for one in self._grids)]), PIECE_SECONDS)
            self._send(min(due_ns, self._ready_ns), publish_from_ns)
            if self.sent_ns < due_ns and give_way():
                return False
        return True

    def look_ahead(self, until_ns: int, seconds: float) -> None:
        """Compute some of what is due up to a time, for one grid; it may take so long."""
        if self._ready_ns < until_ns:
            behind = min(self._grids, key=attrgetter('computed_ns'))
            span_ns = min(behind.span_ns, LONGEST_SPAN_NS)
            with contextlib.suppress(IntegrationError):     # `send` meets it in time
                self._go_on([behind], behind.computed_ns + span_ns, seconds)

    def _go_on(self, grids: Sequence[_Progress], goal_ns: int, seconds: float) -> None:
        """Compute grids up to a time, or a part; raise where all is sent that the motion has."""
        try:
            self._compute(self._motion, goal_ns, 0.5 * seconds)
        except IntegrationError:
            if self.sent_ns >= self._motion.computed_ns:
                raise
        for grid in grids:
            self._compute(grid, min(goal_ns, self._motion.computed_ns), seconds)
        self._waiting = deque(sorted(self._waiting))
        self._ready_ns = min(grid.computed_ns for grid in self._grids)
        self.forget()

    def _compute(self, part: _Progress, until_ns: int, seconds: float) -> None:
        """Compute the motion or the messages of a grid up to a time, or for about so long."""
        now = begin = self._clock()
        while part.computed_ns < until_ns and now < begin + seconds:
            goal_ns = min(until_ns, part.computed_ns + part.span_ns)
            if part is self._motion:
                goal_ns = self.reach(part.computed_ns, goal_ns)
            for channel, t_ns, rows in self.messages(part.outputs, part.computed_ns, goal_ns):
                self._add(part.outputs[channel], self.epoch_ns + t_ns, rows)
            done_ns, called = goal_ns - part.computed_ns, now
            part.computed_ns, now = goal_ns, self._clock()
            # Where it took too long, the next piece is a half of it, else up to twice as long.
            part.span_ns = (max(LEAST_SPAN_NS, done_ns // 2) if now - called > 0.5 * seconds
                            else max(part.span_ns, 2 * done_ns))

    def _add(self, output: Output, log_times: Times, rows: Rows) -> None:
        """Let messages of an output wait."""
        if output.log_index is not None:
            output.add(log_times, rows)
        if output.publish is not None:
            messages = rows.view(f'V{rows.shape[1]}')[:, 0].tolist()    # bytes, all at once
            self._waiting.extend(zip(
                log_times.tolist(), repeat(self.outputs.index(output)), messages))

    def _send(self, until_ns: int, publish_from_ns: int) -> None:
        """Send what waits up to a time, to the log before others."""
        end_ns, late_ns = self.epoch_ns + until_ns, self.epoch_ns + publish_from_ns
        logged: list[LogRows] = []
        for output in self.outputs:
            if output.log_index is not None:
                log_times, rows = output.take(end_ns)
                if len(rows):
                    logged.append((output.log_index, log_times, rows))
        if logged:
            self._write(logged)
        self.sent_ns = until_ns
        waiting = self._waiting
        while waiting and waiting[0][0] <= end_ns:
            log_time, number, message = waiting.popleft()
            if log_time < late_ns:
                self.outputs[number].skipped += 1
            else:
                self.outputs[number].send(message)
