# SPDX-License-Identifier: Apache-2.0
"""A run: parameters, motion and events, and the one place where its messages are computed."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from spinning_top_sim.physics.states import States
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.channel import Channel, Messages, Samples
from spinning_top_sim.streams.events import CHANGES, MOTIONS, Event
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import all_channels
from spinning_top_sim.streams.trajectory import Trajectory
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, NEVER_NS, check_stamp, period_ns

BLOCK_BYTES = 1_500_000                     # of a block offline
LONGEST_BLOCK_NS = 100 * NANOSECONDS        # for the sake of progress
MOST_BLOCKS = 20_000                        # of a run; then they are longer


class Block(NamedTuple):
    """The messages of some channels up to a time [ns], of each that has any."""

    until_ns: int
    messages: Sequence[Messages]


class Simulation:
    """
    One top in motion.  Times are integer nanoseconds since the start.

    values_at_start : checked parameters of the run, as it started
    values_in_effect : these, with the changes that take effect at once
    trajectory : the motion
    imu, channels : the sensor and all streams, with their present rates
    sent_ns : every sample up to here is sent, or yielded (-1: not even that of t = 0); may be set
    history : `Event.text` of each event since the last reset; drives that are repeated are one
    epoch_ns : stamp of t = 0 [ns]

    Raises ValueError where there is no motion from the start state.
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        self._restart(values, epoch_ns)

    def _restart(self, values: Mapping[str, Any], epoch_ns: int) -> None:
        # Whatever may be refused comes first, before anything changes.
        for stamp_ns in (epoch_ns, epoch_ns + round(values['duration'] * NANOSECONDS)):
            check_stamp(stamp_ns)
        motion = Trajectory(
            parameters.top_of(values), parameters.start_state(values),
            parameters.pivot_path(values),
            {name: values[f'solver.{name}'] for name in ('method', 'equations', 'rtol', 'atol')},
            most_acceleration=values['pivot.max_acceleration'])
        imu = Imu(values, period_ns(values['imu.rate']))
        self.channels = all_channels(values, imu)
        self.trajectory, self.imu, self.epoch_ns = motion, imu, epoch_ns
        self.values_at_start, self.values_in_effect = dict(values), dict(values)
        self.history: list[str] = []
        self._last: Event | None = None     # the event of the last text
        self.sent_ns = -1
        # The trace of the markers and late fixes look back at the pivot, across events; only
        # readings look back at states, by `Imu.memory_ns`.
        self._keep_ns = max(round(values[name] * NANOSECONDS) for name in (
            'markers.trace_length', 'gnss.latency'))

    @property
    def now_ns(self) -> int:
        """The simulated time [ns], >= 0: up to here samples are sent."""
        return max(self.sent_ns, 0)

    def apply(self, kind: str, **details: Any) -> Event:
        """
        Apply an event now, and return it.

        kind, details : one of CHANGES, and what docs/logs.md says of it; `drive_details` has
            those of a drive

        Raises ValueError naming what is off; the run goes on unchanged.
        """
        sent_ns = self.sent_ns
        if kind == 'reset':
            self._restart(details['parameters'], details['epoch_ns'])
            return Event(kind, 0, sent_ns, details)
        event = Event(kind, self.now_ns, sent_ns, details)
        if kind in MOTIONS:
            self.trajectory = self.trajectory.then(event)
            self.sent_ns = event.t_ns
        elif kind == 'parameters':
            values = self.values_in_effect
            values |= {name: details[name] for name in parameters.AT_ONCE & details.keys()}
            self.imu = self.imu.at_period(period_ns(values['imu.rate']), self.now_ns)
            self.channels = all_channels(values, self.imu)
        elif kind == 'epoch':
            check_stamp(details['epoch_ns'])
            self.epoch_ns = details['epoch_ns']
        else:
            raise ValueError(f'event {kind!r}: must be one of {", ".join(CHANGES)}')
        if self._last and event.repeats(self._last):    # it lasts longer
            self.history.pop()
            self._last = replace(self._last, details=details)
        else:
            self._last = event
        self.history.append(self._last.text)
        return event

    def drive_details(self, velocity: Sequence[float]) -> dict[str, Any] | None:
        """Return details of a drive to a velocity in the world [m/s]; None: it stays at rest."""
        x, y, z = target = [float(part) for part in velocity]
        if not all(abs(part) <= parameters.FASTEST for part in target):
            raise ValueError(f'linear = {target!r} m/s: each must be finite and within '
                             f'{parameters.FASTEST:g} m/s')
        if self.trajectory.pivot is None and not any(target):
            return None
        timeout = self.values_at_start['pivot.cmd_timeout']     # 0: for ever
        stop_ns = self.now_ns + round(timeout * NANOSECONDS) if timeout else NEVER_NS
        return {'x': x, 'y': y, 'z': z, 'stop_ns': stop_ns}

    def state(self) -> States:
        """Return the state (n = 1) in which the motion goes on after `sent_ns`."""
        return self.trajectory.after(self.now_ns).states(np.array([self.now_ns]))

    def reach(self, after_ns: int, until_ns: int) -> int:
        """
        Return the last time after one, up to another, that motion and stamps reach.

        Raises IntegrationError if they do not go on at all.
        """
        last_ns = LAST_STAMP_NS - self.epoch_ns
        if last_ns <= after_ns:
            raise IntegrationError(f'the stamp {(self.epoch_ns + until_ns) / NANOSECONDS:.12g} s: '
                                   f'must be < {2 ** 31} s, in January 2038', reached_ns=last_ns)
        until_ns = min(until_ns, last_ns)
        try:
            self.trajectory.evaluate(np.array([until_ns]))
        except IntegrationError as error:
            if error.reached_ns <= after_ns:
                raise
            return error.reached_ns
        return until_ns

    def messages(self, channels: Iterable[Channel], after_ns: int, until_ns: int,
                 ) -> list[Messages]:
        """
        Return the messages that are due after one time and up to another, of which it is known
        that the motion reaches it.

        A message depends on the parameters, the events and its own time alone, never on those
        that it is computed with.
        """
        samples: dict[tuple[int, int], Samples] = {}
        found: list[Messages] = []
        for channel in channels:
            if channel.grid not in samples:
                samples[channel.grid] = Samples(
                    self.trajectory, self.imu, channel.times(after_ns, until_ns), self.epoch_ns)
            if samples[channel.grid].times:
                t_ns, rows = channel.encode(samples[channel.grid])
                if len(t_ns):           # a sensor may lose all samples
                    found.append((channel, t_ns, rows))
        return found

    def play(self, channels: Sequence[Channel], until_ns: int) -> Iterator[Block]:
        """
        Move on to `until_ns`; yield the messages of these channels on the way, block by block.

        Raises IntegrationError behind the last block if the motion does not go on.
        """
        per_ns = sum(len(channel.template) / channel.period_ns for channel in channels)
        span_ns = max(1, int(BLOCK_BYTES / max(per_ns, BLOCK_BYTES / LONGEST_BLOCK_NS)),
                      (until_ns - self.sent_ns) // MOST_BLOCKS)
        while self.sent_ns < until_ns:
            end_ns = self.reach(self.sent_ns, min(until_ns, self.sent_ns + span_ns))
            messages = self.messages(channels, self.sent_ns, end_ns)
            self.sent_ns = end_ns
            yield Block(end_ns, messages)
            self.forget()

    def forget(self) -> None:
        """Forget what no sample after `sent_ns` needs."""
        memory_ns = self.imu.memory_ns
        self.trajectory.forget(self.sent_ns - max(self._keep_ns, memory_ns),
                               self.sent_ns - memory_ns)
