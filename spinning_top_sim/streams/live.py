# SPDX-License-Identifier: Apache-2.0
"""
A simulation that sends its messages in time.

Messages up to `now_ns` are sent.  The channels of one grid are computed together, a short time
ahead, and wait as rows.  An event, another rate or another listener drops what waits.
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.channel import Channel, Rows
from spinning_top_sim.streams.events import MOTIONS, Event
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NEVER_NS, Times

MOST_SAMPLES, MOST_BYTES = 256, 4 << 20     # of a channel that are computed together
# What is computed at once: little behind an event, as the next one may come soon.
FIRST_SPAN_NS, LONGEST_SPAN_NS = 20_000_000, 300_000_000
FIRST_STRIDE_NS = 1_000     # of the motion, whose pace is not known before it is tried
GROWTH = 16.0               # a span is at most this many times the one before
PIECE_SECONDS = 1e-2        # of computing between two calls of give_way, half of it for the solver
BLOCKED_SECONDS = 1.0       # a reader that stalls holds every call for 0.1 s: it gets a rest

# Messages of a topic for a log: its number there, stamps (n,) [ns], messages (n, size).
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
    # What waits to be sent: times [ns] and messages.
    _t_ns: Times = field(default_factory=lambda: np.empty(0, np.int64))
    _rows: Rows = field(default_factory=lambda: np.empty((0, 0), np.uint8))
    _blocked_until: float = 0.0     # on the clock

    @property
    def is_used(self) -> bool:
        """Whether anybody takes the messages: else they are not computed."""
        return self.publish is not None or self.log_index is not None

    def add(self, t_ns: Times, rows: Rows) -> None:
        """Put messages behind those that wait."""
        if len(self._t_ns):
            t_ns, rows = np.concatenate((self._t_ns, t_ns)), np.concatenate((self._rows, rows))
        self._t_ns, self._rows = t_ns, rows

    def is_due(self, until_ns: int) -> bool:
        return len(self._t_ns) > 0 and bool(self._t_ns[0] <= until_ns)

    def take(self, until_ns: int) -> tuple[Times, Rows]:
        """Return what waits up to a time, which waits no longer."""
        count = int(self._t_ns.searchsorted(until_ns, 'right'))
        taken = self._t_ns[:count], self._rows[:count]
        self._t_ns, self._rows = self._t_ns[count:], self._rows[count:]
        return taken

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
class _Group:
    """Outputs of one grid, computed together; without outputs: the motion itself."""

    outputs: Mapping[Channel, Output]
    computed_ns: int
    span_ns: int = 0        # that can be computed in the time that a call may take

    @property
    def piece_ns(self) -> int:
        """How much is computed at once [ns]."""
        return min([max(self.span_ns, FIRST_SPAN_NS if self.outputs else FIRST_STRIDE_NS), *(
            max(1, min(MOST_SAMPLES, MOST_BYTES // len(one.encoder))) * one.period_ns
            for one in self.outputs)])


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
        self._motion = _Group({}, self.now_ns)
        self._groups: list[_Group] = []             # of what is used
        self._used: list[tuple[int, Output]] = []   # with their numbers

    def log_to(self, write: Callable[[Sequence[LogRows]], object] | None,
               channels: Sequence[Channel] = ()) -> None:
        """Record these channels, numbered in this order, and no others after `now_ns`."""
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
            self._motion = _Group({}, self.now_ns)
        self.refresh()
        return event

    def refresh(self) -> None:
        """Compute anew what waits: the motion, or who takes the messages, has changed."""
        self._used = [(number, output) for number, output in enumerate(self.outputs)
                      if output.is_used]
        grids: dict[tuple[int, int], dict[Channel, Output]] = {}
        for _, output in self._used:
            output.take(NEVER_NS)
            grids.setdefault(output.channel.grid, {})[output.channel] = output
        self._groups = [_Group(outputs, self.now_ns) for outputs in grids.values()]

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
        give_way : asked between pieces of work; True ends the call early

        Raises IntegrationError if the motion does not go on; what comes before is sent.
        """
        while self.now_ns < due_ns:
            if self._ready_ns < due_ns:
                # No further than is computed next: a solver keeps a limited number of steps.
                self._go_on(self._groups, min([due_ns, *(
                    one.computed_ns + one.piece_ns for one in self._groups)]), PIECE_SECONDS)
            self._send(min(due_ns, self._ready_ns), publish_from_ns)
            if self.now_ns < due_ns and give_way():
                return False
        return True

    @property
    def _ready_ns(self) -> int:
        """Time up to which all messages are sent or wait [ns]."""
        return min((group.computed_ns for group in self._groups), default=self._motion.computed_ns)

    def look_ahead(self, until_ns: int, seconds: float) -> None:
        """Compute some of what is due up to a time, for one grid; it may take so long."""
        behind = min(self._groups, key=attrgetter('computed_ns'), default=self._motion)
        if behind is not self._motion and behind.computed_ns < until_ns:
            span_ns = min(behind.piece_ns, LONGEST_SPAN_NS)
            with contextlib.suppress(IntegrationError):     # `send` meets it in time
                self._go_on([behind], behind.computed_ns + span_ns, seconds)

    def _go_on(self, groups: Sequence[_Group], goal_ns: int, seconds: float) -> None:
        """Compute groups up to a time, or a part; raise where all is sent that the motion has."""
        try:
            self._compute(self._motion, goal_ns, 0.5 * seconds)
        except IntegrationError:
            if self.now_ns >= self._motion.computed_ns:
                raise
        for group in groups:
            self._compute(group, min(goal_ns, self._motion.computed_ns), seconds)
        self.forget()

    def _compute(self, group: _Group, until_ns: int, seconds: float) -> None:
        """Compute the messages of a group up to a time, or for about so long."""
        now = begin = self._clock()
        while group.computed_ns < until_ns and now < begin + seconds:
            goal_ns = min(until_ns, group.computed_ns + group.piece_ns)
            block = self.block([*group.outputs], group.computed_ns, goal_ns)
            for channel, t_ns, rows in block.messages:
                group.outputs[channel].add(t_ns, rows)
            done_ns, called = block.until_ns - group.computed_ns, now
            group.computed_ns, now = block.until_ns, self._clock()
            room = 0.5 * seconds / max(now - called, 1e-6)
            group.span_ns = max(int(done_ns * min(room, GROWTH)),
                                0 if room < 1.0 else group.span_ns)

    def _send(self, until_ns: int, publish_from_ns: int) -> None:
        """Send what waits up to a time, to the log before others."""
        logged: list[LogRows] = []
        due: list[tuple[int, int, NDArray[np.uint8]]] = []
        for number, output in self._used:
            if not output.is_due(until_ns):
                continue
            t_ns, rows = output.take(until_ns)
            if output.log_index is not None:
                logged.append((output.log_index, self.epoch_ns + t_ns, rows))
            if output.publish is not None:
                late = int(t_ns.searchsorted(publish_from_ns))
                output.skipped += late
                due += zip(t_ns[late:].tolist(), repeat(number), rows[late:])
        if logged:
            self._write(logged)
        self.now_ns = until_ns
        due.sort(key=itemgetter(0, 1))
        for _, number, row in due:
            self.outputs[number].send(row.tobytes())
