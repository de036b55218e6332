# SPDX-License-Identifier: Apache-2.0
"""
A simulation that sends its messages in time.

Messages up to `now_ns` are sent.  The channels of one grid are computed together, a short time
ahead, and wait as rows.  An event, another rate or another listener drops what waits.
"""

import contextlib
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.channel import Channel, Rows, Stamps
from spinning_top_sim.streams.events import MOTIONS, Event
from spinning_top_sim.streams.play import Simulation

MOST_SAMPLES, MOST_BYTES = 256, 4 << 20     # of a channel that are computed together
# How far ahead is computed: little behind an event, as the next one may come soon.
FIRST_SPAN_NS, LONGEST_SPAN_NS = 20_000_000, 300_000_000
# The solver goes on in strides; the first one is tiny, as the pace of a motion is not known
# before it is tried.  Each is at most so many times as long as the one before.
FIRST_STRIDE_NS, GROWTH = 1_000, 16.0
PIECE_SECONDS = 5e-3        # of work, between two questions whether to give way
BLOCKED_SECONDS = 1.0       # a reader that stalls holds every call for 0.1 s: it gets a rest

# Messages of a topic for a log: its number there, stamps (n,) [ns], messages (n, size).
LogRows = tuple[int, Stamps, Rows]


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
    # What waits to be sent: times [ns], messages as rows and as bytes, and how many are sent.
    _t_ns: Stamps = field(default_factory=lambda: np.empty(0, np.int64))
    _times: list[int] = field(default_factory=list)
    _rows: Rows = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    _data: bytes = b''
    _cursor: int = 0
    _blocked_until: float = 0.0     # on the clock

    @property
    def is_used(self) -> bool:
        """Whether anybody takes the messages: else they are not computed."""
        return self.publish is not None or self.log_index is not None

    def clear(self) -> None:
        self._times, self._cursor = [], 0

    def add(self, t_ns: Stamps, rows: Rows) -> None:
        """Put messages behind those that wait."""
        if self._cursor < len(self._times):
            t_ns = np.concatenate((self._t_ns[self._cursor:], t_ns))
            rows = np.concatenate((self._rows[self._cursor:], rows))
        self._t_ns, self._times, self._rows = t_ns, t_ns.tolist(), rows
        self._data, self._cursor = rows.tobytes(), 0

    def take(self, until_ns: int, epoch_ns: int, publish_from_ns: int,
             ) -> tuple[list[tuple[int, bytes]], LogRows | None]:
        """Return what waits up to a time: to publish, with the times [ns]; and for the log."""
        begin = self._cursor
        end = self._cursor = bisect_right(self._times, until_ns, begin)
        if begin == end:
            return [], None
        logged = None if self.log_index is None else (
            self.log_index, epoch_ns + self._t_ns[begin:end], self._rows[begin:end])
        if self.publish is None:
            return [], logged
        first = bisect_right(self._times, publish_from_ns - 1, begin, end)
        self.skipped += first - begin
        size = len(self.channel.encoder)
        return [(self._times[k], self._data[k * size:(k + 1) * size])
                for k in range(first, end)], logged

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


class LiveSimulation(Simulation):
    """
    A simulation with an output for each channel.

    What is sent does not depend on when it is computed, or on how often `send` is called.

    outputs : of each channel, in the order in which the messages of one time are sent
    clock : returns steady time [s]
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(values, epoch_ns)
        self.outputs = [Output(channel, clock=clock) for channel in self.channels]
        self._clock = clock
        self._write: Callable[[Sequence[LogRows]], object] = lambda rows: None
        self._used: list[tuple[int, Output]] = []   # outputs in use, with their numbers
        self._groups: list[_Group] = []             # of these
        self._span_ns = FIRST_SPAN_NS               # of what is computed ahead
        self._stride_ns = FIRST_STRIDE_NS           # of the solver
        self._reached_ns = -1                       # how far the motion has gone

    def log_to(self, write: Callable[[Sequence[LogRows]], object] | None,
               channels: Sequence[Channel] = ()) -> None:
        """
        Record these channels after `now_ns`, and no others.

        write : takes their messages; the position of a channel is its number in the log
        """
        self._write = write or self._write
        for output in self.outputs:
            output.log_index = (channels.index(output.channel) if output.channel in channels
                                else None)
        self.refresh()

    def apply(self, kind: str, **details: Any) -> Event:
        if self.now_ns < 0 and kind in MOTIONS:     # the sample of t = 0 comes before them
            self.send(0)
        event = super().apply(kind, **details)
        for output, channel in zip(self.outputs, self.channels, strict=True):
            output.channel = channel
        if event.begins_motion or kind == 'reset':
            self._stride_ns, self._reached_ns = FIRST_STRIDE_NS, self.now_ns
        self.refresh()
        return event

    def refresh(self) -> None:
        """Compute anew what waits: the motion, or who takes the messages, has changed."""
        self._used = [(number, output) for number, output in enumerate(self.outputs)
                      if output.is_used]
        grid = attrgetter('channel.grid')
        self._groups = [_Group(list(group), self.now_ns) for _, group in groupby(
            sorted((output for _, output in self._used), key=grid), grid)]
        self._span_ns = FIRST_SPAN_NS

    @property
    def lowest_imu_rate(self) -> float:
        """The lowest `imu.rate` [Hz] with which means and increments in use can go on."""
        uses = self.imu.takes_means or any(
            output.channel.name == 'increments' and output.is_used for output in self.outputs)
        return parameters.LOWEST_RATE_OF_INTERVALS if uses else 0.0

    def send(self, due_ns: int, publish_from_ns: int = 0,
             give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every message due up to a time; return whether that was reached.

        publish_from_ns : earlier messages are too late to be published; they are recorded
        give_way : asked between pieces of work; True ends the call early, and the next one goes
            on there

        Raises IntegrationError if the motion does not go on; what comes before is sent.
        """
        while self.now_ns < due_ns:
            if self._ready_ns < due_ns:
                self._prepare(due_ns)
            self._send(min(due_ns, self._ready_ns), publish_from_ns)
            if self.now_ns < due_ns and give_way():
                return False
        return True

    @property
    def _ready_ns(self) -> int:
        """Time up to which all messages are sent or wait [ns]."""
        return min((group.computed_ns for group in self._groups), default=self._reached_ns)

    def _prepare(self, due_ns: int) -> None:
        """Compute what is due, or a part of it; raise where all is sent that the motion has."""
        # No further than what is computed next: a solver keeps a limited number of steps.
        goal_ns = min([due_ns, *(group.furthest_ns for group in self._groups)])
        try:
            self._go_ahead(goal_ns, PIECE_SECONDS)
        except IntegrationError:
            if self.now_ns >= self._reached_ns:
                raise
        until_ns = min(goal_ns, self._reached_ns)
        for group in self._groups:
            self._compute(group, until_ns)

    def look_ahead(self, until_ns: int, seconds: float) -> None:
        """
        Compute some of what is due up to a time, for one grid.

        seconds : time that this may take; what is computed at once is chosen so that it does
        """
        behind = min(self._groups, key=lambda group: group.computed_ns, default=None)
        if behind is None or behind.computed_ns >= until_ns:
            return
        begin = self._clock()
        goal_ns = min(behind.computed_ns + self._span_ns, behind.furthest_ns)
        with contextlib.suppress(IntegrationError):     # `send` meets it when the time has come
            self._go_ahead(goal_ns, 0.5 * seconds)
            self._compute(behind, min(goal_ns, self._reached_ns))
        taken = self._clock() - begin
        if taken < 0.5 * seconds:
            self._span_ns = min(2 * self._span_ns, LONGEST_SPAN_NS)
        elif taken > 0.8 * seconds:
            self._span_ns = max(self._span_ns // 2, FIRST_SPAN_NS)

    def _go_ahead(self, until_ns: int, seconds: float) -> None:
        """Let the solver go on up to a time, or for about so long."""
        now = begin = self._clock()
        while self._reached_ns < until_ns and now < begin + seconds:
            goal_ns = min(until_ns, self._reached_ns + self._stride_ns)
            stride_ns, called = goal_ns - self._reached_ns, now
            self._reached_ns = self.reach(self._reached_ns, goal_ns)
            now = self._clock()
            self._stride_ns = max(1, int(stride_ns * min(
                GROWTH, 0.5 * seconds / max(now - called, 1e-6))))
        self.forget()

    def _compute(self, group: '_Group', until_ns: int) -> None:
        """Compute the messages of a grid up to a time that the motion has reached."""
        if group.computed_ns < until_ns:
            by_channel = {output.channel: output for output in group.outputs}
            block = self.block([*by_channel], group.computed_ns, until_ns)
            for channel, t_ns, rows in block.messages:
                by_channel[channel].add(t_ns, rows)
            group.computed_ns = block.until_ns

    def _send(self, until_ns: int, publish_from_ns: int) -> None:
        """Send what waits up to a time, to the log before others."""
        logged: list[LogRows] = []
        due: list[tuple[int, int, bytes]] = []
        for number, output in self._used:
            messages, rows = output.take(until_ns, self.epoch_ns, publish_from_ns)
            if rows is not None:
                logged.append(rows)
            for t_ns, data in messages:
                due.append((t_ns, number, data))
        if logged:
            self._write(logged)
        self.now_ns = until_ns
        due.sort(key=itemgetter(0, 1))
        for _, number, data in due:
            self.outputs[number].send(data)


@dataclass(eq=False)
class _Group:
    """The outputs in use of one grid, whose messages are computed together up to `computed_ns`."""

    outputs: list[Output]
    computed_ns: int

    def __post_init__(self) -> None:
        for output in self.outputs:
            output.clear()

    @property
    def furthest_ns(self) -> int:
        """How far MOST_SAMPLES behind those that are computed reach [ns]."""
        channels = [output.channel for output in self.outputs]
        largest = max(len(channel.encoder) for channel in channels)
        return (self.computed_ns
                + max(1, min(MOST_SAMPLES, MOST_BYTES // largest)) * channels[0].period_ns)
