# SPDX-License-Identifier: Apache-2.0
"""Finds out what is in a log, and how accurate that is."""

import itertools
import math
from bisect import bisect_left
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.recording.errors import MALFORMED, Damage, reason_of
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.streams import events
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.play import Block
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


@dataclass
class Motion:
    """A motion of the top, from its cause to the next one."""

    cause: str
    begin_ns: int                         # log times [ns]
    end_ns: int
    l3: float
    lz: float
    energy: float
    exact: Description | None             # None if the closed form cannot represent it
    source: str | None                    # topic that it is measured from
    measured: Measured | None = None      # the numbers of `exact`, from the samples
    # The largest ones, relative if not from 0; empty or None where nothing is known
    drifts: dict[str, float] = field(default_factory=dict)
    orientation_error: float | None = None          # [rad]


class _Course(NamedTuple):
    """What the samples of a motion are compared with, and these."""

    motion: Motion
    epoch_ns: int                         # stamp of t = 0 [ns]
    channel: Channel | None               # of the source
    imu: Imu
    piece: Piece                          # the constants and the exact solution
    # Log times (n,) [ns] and samples (WIDTH, n)
    samples: list[tuple[Times, NDArray[np.float64]]]

    def keep(self, messages: list[LogMessage]) -> None:
        """Keep the samples in messages of the source."""
        assert self.channel is not None
        template = self.channel.template
        fitting = [one for one in messages if len(one.data) == len(template)]
        self.samples.append(analysis.attitudes_of(
            self.channel.topic, self.imu, _stamps(fitting),
            template.decode(b''.join(one.data for one in fitting))))


@dataclass(init=False)
class Survey:
    """
    The findings about a log, and about its run if it has one.  Raises LogError.

    Its fields are the keys of `inspect --json`, as docs/logs.md has them.

    last_ns : log time of the last sample [ns]
    shown : samples of the motions that were measured
    """

    file: str
    whole: bool
    damage: Damage
    begin_ns: int
    end_ns: int
    topics: dict[str, Topic]
    run: RunDescription | None
    motions: list[Motion]
    notes: list[str]
    verify: Comparison | None

    def __init__(self, reader: LogReader, run: RunDescription | None) -> None:
        self.file, self.whole, self.damage = str(reader.path), reader.whole, reader.damage
        self.begin_ns, self.end_ns = reader.span
        self.topics = {topic.name: Topic(topic.type_name) for topic in reader.topics}
        self.run, self.verify, self.motions, self.notes, self.last_ns = run, None, [], [], 0
        self.shown: list[SampledStates] = []
        self._courses: list[_Course] = []
        with np.errstate(all='ignore'):         # a log may hold any numbers
            if run is not None:
                self._follow(run)
            self._read(reader)
            for course in self._courses:
                self._measure(course)

    def _follow(self, run: RunDescription) -> None:
        """Compute the motions of a run."""
        motions = self.motions
        try:
            for simulation, done in recorded_run.rerun(run, self.end_ns):
                # The velocities of the pivot belong to one motion.
                if isinstance(done, Block) or done.event.kind == 'parameters' or (
                        done.event.kind == 'drive' and motions[-1].cause == 'drive'):
                    continue
                if motions:
                    motions[-1].end_ns = self._courses[-1].epoch_ns + done.event.sent_ns
                piece = simulation.trajectory.after(max(simulation.now_ns, 0))
                exact = piece.describe() if len(motions) < MOST_EXACT else None
                channel = _source(run, simulation.channels, exact)
                begin_ns = simulation.epoch_ns + simulation.now_ns
                motions.append(Motion(
                    done.event.kind, begin_ns, begin_ns, piece.l3, piece.lz, piece.energy, exact,
                    run.topics[channel.topic] if channel else None))
                self._courses.append(_Course(motions[-1], simulation.epoch_ns, channel,
                                             simulation.imu, piece, []))
        except MALFORMED as error:
            self.notes.append(f'the run cannot be followed beyond here: {reason_of(error)}')
        if len(motions) > MOST_EXACT:
            self.notes.append(f'only the first {MOST_EXACT} motions are compared with the exact '
                              'one')

    def _read(self, reader: LogReader) -> None:
        """Count the messages, and keep the samples of the source with their motions."""
        ends_ns = [motion.end_ns for motion in self.motions[:-1]]
        sampled = {topic for stream, topic in (self.run.topics if self.run else {}).items()
                   if stream not in events.TOPICS}
        blocks_ns = {topic: [np.empty(0, np.int64)] for topic in self.topics}
        for topic, messages in reader.groups():
            blocks_ns[topic].append(_stamps(messages))
            for number, part in itertools.groupby(
                    messages if topic in {motion.source for motion in self.motions} else (),
                    lambda message: bisect_left(ends_ns, message.log_time)):
                if topic == self.motions[number].source:
                    self._courses[number].keep(list(part))
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

    def _measure(self, course: _Course) -> None:
        """Compare the samples of a motion with it, and measure the longest part at one rate."""
        motion, epoch_ns, _, _, piece, samples = course
        if sum(len(stamps_ns) for stamps_ns, _ in samples) < 2:
            return
        stamps_ns, rows = (np.concatenate(parts, axis=-1) for parts in zip(*samples, strict=True))
        samples.clear()
        states = SampledStates(piece.top, stamps_ns / NANOSECONDS, rows)
        if piece.rests and not np.isnan(states.l3).all():   # else it has other constants
            motion.drifts = {name: _largest(relative_drift(
                getattr(states, name), getattr(piece, name))) for name in ('energy', 'l3', 'lz')}
        if motion.exact is not None and piece.exact:
            # Log times of the run; those of a log that was changed may lie anywhere.
            truth = piece.exact.states(np.clip(stamps_ns - epoch_ns, piece.start_ns,
                                               LAST_STAMP_NS))
            motion.orientation_error = _largest(angle_between(
                states.rows_quaternion, truth.rows_quaternion))
        part = analysis.longest_run(stamps_ns)
        states = SampledStates(piece.top, (stamps_ns[part] - self.begin_ns) / NANOSECONDS,
                               rows[:, part])
        try:
            motion.measured = analysis.measure(
                states, motion.exact.nutation_period if motion.exact else None)
        except MALFORMED as error:
            self.notes.append(f'{motion.source} cannot be measured: {reason_of(error)}')
        else:
            self.shown.append(states)


def _source(run: RunDescription, channels: list[Channel],
            exact: Description | None) -> Channel | None:
    """Return the channel with the most samples in a nutation, up to those that suffice."""
    period_ns = ((exact and exact.nutation_period) or math.inf) * NANOSECONDS
    return max((channel for name in SOURCES if name in run.topics for channel in channels
                if channel.topic == name), default=None,
               key=lambda channel: min(period_ns / channel.period_ns, ENOUGH_SAMPLES))


def _stamps(messages: list[LogMessage]) -> Times:
    return np.array([min(one.log_time, LAST_LOG_TIME_NS) for one in messages], np.int64)


def _largest(values: NDArray[np.float64]) -> float:
    """Return the largest absolute value of those that are finite, 0 without any."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
