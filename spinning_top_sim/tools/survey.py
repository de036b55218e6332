# SPDX-License-Identifier: Apache-2.0
"""
Finds out what is in a log, and how accurate that is.

The public attributes of the classes are the keys of `inspect --json`; docs/logs.md says what they
are.
"""

import itertools
import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.streams import events
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, Times
from spinning_top_sim.tools import analysis, recorded_run
from spinning_top_sim.tools.analysis import Measured, SampledStates
from spinning_top_sim.tools.recorded_run import LAST_LOG_TIME_NS, RunDescription
from spinning_top_sim.tools.verify import Comparison

MOST_EXACT = 1000           # motions that are compared with the exact one: 10 ms each
# Streams that a motion can be measured from, the most accurate first.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation; a higher rate adds no accuracy


@dataclass
class Topic:
    """The findings about a topic."""

    type: str
    count: int = 0
    rate: float | None = None                       # [Hz]
    longest_gap_ns: tuple[int, int] | None = None   # from one message to the next


class Motion:
    """
    A motion of the top, which begins where a simulation is.

    topics : of the log, by stream
    with_exact : whether it is compared with the exact solution, if there is one
    """

    def __init__(self, cause: str, simulation: Simulation, topics: Mapping[str, str], *,
                 with_exact: bool) -> None:
        self.cause = cause
        self.begin_ns = self.end_ns = simulation.epoch_ns + simulation.sent_ns
        piece = simulation.trajectory.after(simulation.now_ns)
        self.l3, self.lz, self.energy = piece.l3, piece.lz, piece.energy
        self.exact = piece.describe() if with_exact else None
        # The source has the most samples in a nutation, up to those that suffice.
        period_ns = ((self.exact and self.exact.nutation_period) or math.inf) * NANOSECONDS
        self._channel = max(
            (channel for name in SOURCES for channel in simulation.channels
             if channel.topic == name and name in topics), default=None,
            key=lambda channel: min(period_ns / channel.period_ns, ENOUGH_SAMPLES))
        self.source = topics[self._channel.topic] if self._channel else None
        self.measured: Measured | None = None
        self.drifts: dict[str, float] = {}
        self.orientation_error: float | None = None
        self._piece, self._imu, self._epoch_ns = piece, simulation.imu, simulation.epoch_ns
        self._samples: list[tuple[Times, NDArray[np.float64]]] = []

    def keep(self, messages: list[LogMessage]) -> None:
        """Keep the samples in messages of the source."""
        assert self._channel is not None
        template = self._channel.template
        fitting = [one for one in messages if len(one.data) == len(template)]
        self._samples.append(analysis.attitudes_of(
            self._channel.topic, self._imu, _stamps(fitting),
            template.decode(b''.join(one.data for one in fitting))))

    def measure(self, begin_ns: int) -> SampledStates | None:
        """
        Compare the samples with the motion; measure and return the longest part at one rate.

        Times are those since a log time.  Returns None for fewer than two samples.
        """
        if sum(len(stamps_ns) for stamps_ns, _ in self._samples) < 2:
            return None
        piece, (stamps_ns, rows) = self._piece, (
            np.concatenate(parts, axis=-1) for parts in zip(*self._samples, strict=True))
        self._samples = []
        states = SampledStates(piece.top, stamps_ns / NANOSECONDS, rows)
        if piece.rests and not np.isnan(states.l3).all():   # else it has other constants
            self.drifts = {name: _largest(relative_drift(
                getattr(states, name), getattr(piece, name))) for name in ('energy', 'l3', 'lz')}
        if self.exact is not None and piece.exact:
            # Log times of the run; those of a log that was changed may lie anywhere.
            truth = piece.exact.states(np.clip(
                stamps_ns - self._epoch_ns, piece.start_ns, LAST_STAMP_NS))
            self.orientation_error = _largest(angle_between(
                states.rows_quaternion, truth.rows_quaternion))
        part = analysis.longest_run(stamps_ns)
        states = SampledStates(piece.top, (stamps_ns[part] - begin_ns) / NANOSECONDS,
                               rows[:, part])
        self.measured = analysis.measure(
            states, self.exact.nutation_period if self.exact else None)
        return states


class Survey:
    """The findings about a log, and about its run if it has one.  Raises LogError."""

    def __init__(self, reader: LogReader, run: RunDescription | None) -> None:
        self.file, self.whole = str(reader.path), reader.whole
        self.damage: dict[str, Any] = {
            'torn': reader.torn, 'lost_bytes': reader.lost_bytes, 'changed': reader.changed,
            'report': reader.damage}
        self.begin_ns, self.end_ns = reader.span
        self.last_ns = 0        # log time of the last sample [ns]
        self.topics = {topic.name: Topic(topic.type_name) for topic in reader.topics}
        self.run = run
        self.motions: list[Motion] = []
        self.notes: list[str] = []
        self.verify: Comparison | None = None
        self._shown: list[SampledStates] = []
        with np.errstate(all='ignore'):         # a log may hold any numbers
            if run is not None:
                self._follow(run)
            self._read(reader)
            for motion in self.motions:
                try:
                    states = motion.measure(self.begin_ns)
                except MALFORMED as error:
                    self.notes.append(f'{motion.source} cannot be measured: {reason_of(error)}')
                else:
                    self._shown += [states] if states else []

    @property
    def shown(self) -> list[SampledStates]:
        """The samples of each motion that was measured."""
        return self._shown

    def _follow(self, run: RunDescription) -> None:
        """Compute the motions of a run."""
        motions, epoch_ns = self.motions, run.epoch_ns
        try:
            for simulation, done in recorded_run.rerun(run, self.end_ns):
                # The velocities of the pivot belong to one motion.
                if isinstance(done, Block) or done.event.kind == 'parameters' or (
                        done.event.kind == 'drive' and motions[-1].cause == 'drive'):
                    continue
                if motions:
                    motions[-1].end_ns = epoch_ns + done.event.sent_ns
                epoch_ns = simulation.epoch_ns
                motions.append(Motion(done.event.kind, simulation, run.topics,
                                      with_exact=len(motions) < MOST_EXACT))
        except MALFORMED as error:
            self.notes.append(f'the run cannot be followed beyond here: {reason_of(error)}')
        if len(motions) > MOST_EXACT:
            self.notes.append(f'only the first {MOST_EXACT} motions are compared with the exact '
                              'one')

    def _read(self, reader: LogReader) -> None:
        """Count the messages, and keep the samples of the sources with their motions."""
        ends_ns = [motion.end_ns for motion in self.motions[:-1]]
        sources = {motion.source for motion in self.motions}
        sampled = {topic for stream, topic in (self.run.topics if self.run else {}).items()
                   if stream not in events.TOPICS}
        blocks_ns = {topic: [np.empty(0, np.int64)] for topic in self.topics}
        for topic, messages in reader.groups():
            blocks_ns[topic].append(_stamps(messages))
            for number, part in itertools.groupby(
                    messages if topic in sources else (),
                    lambda message: bisect_left(ends_ns, message.log_time)):
                if topic == self.motions[number].source:
                    self.motions[number].keep(list(part))
        for name, found in self.topics.items():
            stamps_ns = np.concatenate(blocks_ns[name])
            found.count = len(stamps_ns)
            if found.count > 1:
                longest, length_ns = int(np.argmax(np.diff(stamps_ns))), int(np.ptp(stamps_ns))
                found.longest_gap_ns = int(stamps_ns[longest]), int(stamps_ns[longest + 1])
                found.rate = (found.count - 1) / length_ns * NANOSECONDS if length_ns else None
            if found.count and name in sampled:
                self.last_ns = max(self.last_ns, int(stamps_ns[-1]))
        if self.motions:        # the last event may be later than the last sample
            self.motions[-1].end_ns = max(self.motions[-1].begin_ns, self.last_ns)


def _stamps(messages: list[LogMessage]) -> Times:
    return np.array([min(one.log_time, LAST_LOG_TIME_NS) for one in messages], np.int64)


def _largest(values: NDArray[np.float64]) -> float:
    """Return the largest absolute value of those that are finite, 0 without any."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
