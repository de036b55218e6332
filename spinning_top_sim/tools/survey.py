# SPDX-License-Identifier: Apache-2.0
"""Finds out what is in a log, and how accurate that is."""

import itertools
import math
from bisect import bisect_left
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.play import Block
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, Times, ns_array
from spinning_top_sim.tools import analysis, recorded_run
from spinning_top_sim.tools.analysis import Measured, SampledStates
from spinning_top_sim.tools.recorded_run import LAST_LOG_TIME_NS, RunDescription

MOST_GAPS = 10              # that are listed
MOST_EXACT = 1000           # motions that are compared with the exact one: 10 ms each
# Streams that a motion can be measured from, the most accurate first.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'imu/data', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation; a higher rate adds no accuracy


@dataclass
class Topic:
    """The findings about a topic, with the keys of docs/logs.md."""

    type: str
    stream: str | None = None
    count: int = 0
    rate: float | None = None             # [Hz]
    grid_rate: float | None = None
    missing: int | None = None
    gaps_ns: list[tuple[int, int]] = field(default_factory=list)


class Section(NamedTuple):
    """A part of a run in which all rates stay the same."""

    epoch_ns: int                         # stamp of t = 0 [ns]
    after_ns: int                         # simulated time before the first samples [ns]
    channels: dict[str, Channel]          # by topic of the log
    imu: Imu


@dataclass
class Motion:
    """A motion of the top, from its cause to the next one."""

    cause: str                            # start, command, state, drive or reset
    begin_ns: int                         # log times [ns]
    end_ns: int
    section: Section                      # the first one
    piece: Piece                          # its constants and its exact solution
    exact: Description | None             # None if the closed form cannot represent it
    source: str | None                    # topic that it is measured from
    # Log times (n,) [ns] and samples (WIDTH, n) of the source
    samples: list[tuple[Times, NDArray[np.float64]]] = field(default_factory=list)
    measured: Measured | None = None      # the numbers of `exact`, from the samples


class Survey:
    """
    The findings about a log, and about its run if it has one.  Raises LogError.

    end_ns : log time up to which samples were recorded [ns]
    topics, motions : in the order of the log
    drifts : by topic, the largest drifts of energy, l3 and lz since the begin of the motion,
        relative if not from 0
    errors : by topic, the largest error of an attitude [rad]
    shown : samples of the motions that were measured
    notes : what could not be done
    """

    def __init__(self, reader: LogReader, run: RunDescription | None) -> None:
        self.begin_ns, self.end_ns = reader.span
        self.topics = {topic.name: Topic(topic.type_name) for topic in reader.topics}
        self.motions: list[Motion] = []
        self.drifts: dict[str, dict[str, float]] = {}
        self.errors: dict[str, float] = {}
        self.shown: list[SampledStates] = []
        self.notes: list[str] = []
        self._due: defaultdict[str, list[Times]] = defaultdict(list)    # log times [ns]
        self._samples: Counter[str] = Counter()     # that were due, in all
        with np.errstate(all='ignore'):         # a log may hold any numbers
            if run is not None:
                self._follow(run)
            stamps_ns = self._read(reader)
            if self.motions:        # the last event may be later than the last sample
                last = self.motions[-1]
                self.end_ns = last.end_ns = max(last.begin_ns, 0, *(
                    int(stamps_ns[topic].max(initial=0)) for topic in last.section.channels))
            for name, topic in self.topics.items():
                self._count(topic, stamps_ns[name], self._due[name])
            for motion in self.motions:
                self._measure(motion)

    def _follow(self, run: RunDescription) -> None:
        """Compute the motions of a run, and when messages were due."""
        for name, topic in run.topics.items():
            self.topics[topic].stream = name
        motions, section = self.motions, None
        try:
            for simulation, done in recorded_run.rerun(run, self.end_ns):
                if isinstance(done, Block):
                    continue
                event = done.event
                if section is not None:
                    motions[-1].end_ns = section.epoch_ns + event.sent_ns
                    self._expect(run, section, event.sent_ns)
                section = Section(simulation.epoch_ns, simulation.now_ns, {
                    run.topics[channel.topic]: channel for channel in simulation.channels
                    if channel.topic in run.topics}, simulation.imu)
                # The velocities of the pivot belong to one motion.
                if event.begins_report and not (
                        event.kind == 'drive' and motions and motions[-1].cause == 'drive'):
                    begin_ns = section.epoch_ns + section.after_ns
                    piece = simulation.trajectory.after(max(simulation.now_ns, 0))
                    exact = piece.describe() if len(motions) < MOST_EXACT else None
                    motions.append(Motion(event.kind, begin_ns, begin_ns, section, piece, exact,
                                          _source(run, section, exact)))
        except MALFORMED as error:
            self.notes.append(f'the run cannot be followed beyond here: {reason_of(error)}')
        if section is not None:
            self._expect(run, section, self.end_ns - section.epoch_ns)
        if len(motions) > MOST_EXACT:
            self.notes.append(f'only the first {MOST_EXACT} motions are compared with the exact '
                              'one')

    def _expect(self, run: RunDescription, section: Section, end_ns: int) -> None:
        """Note when the messages of a section up to a simulated time were due."""
        for name, channel in section.channels.items():
            self.topics[name].grid_rate = NANOSECONDS / channel.period_ns
            times = channel.times(max(section.after_ns, -1), end_ns)
            before, most = self._samples[name], recorded_run.most_samples(run)
            self._samples[name] += len(times)
            if self._samples[name] <= most:
                self._due[name].append(section.epoch_ns + np.unique(channel.due(ns_array(times))))
            elif before <= most:
                self._due[name].clear()
                self.notes.append(f'{name}: what is missing is not counted: the log lacks most of '
                                  f'{self._samples[name]} samples')

    def _read(self, reader: LogReader) -> dict[str, Times]:
        """Compare all messages with their motions; return the log times of each topic [ns]."""
        ends_ns = [motion.end_ns for motion in self.motions[:-1]]
        blocks_ns = {topic: [np.empty(0, np.int64)] for topic in self.topics}
        for topic, messages in reader.groups():
            blocks_ns[topic].append(_stamps(messages))
            if self.motions and self.topics[topic].stream is not None:
                for number, part in itertools.groupby(
                        messages, lambda message: bisect_left(ends_ns, message.log_time)):
                    self._compare(self.motions[number], topic, list(part))
        return {topic: np.concatenate(parts) for topic, parts in blocks_ns.items()}

    def _compare(self, motion: Motion, topic: str, messages: list[LogMessage]) -> None:
        """Compare messages with their motion, and keep those that it is measured from."""
        section, piece = motion.section, motion.piece
        channel = section.channels[topic]
        fitting = [one for one in messages if len(one.data) == len(channel.template)]
        attitudes = analysis.attitudes_of(
            channel.topic, section.imu, _stamps(fitting),
            channel.template.decode(b''.join(one.data for one in fitting)))
        if attitudes is None:
            return
        if topic == motion.source:
            motion.samples.append(attitudes)
        if not piece.rests:         # there are other constants in each of its pieces
            return
        # Log times of the run; those of a log that was changed may lie anywhere.
        times_ns = np.clip(attitudes[0] - section.epoch_ns, piece.start_ns, LAST_STAMP_NS)
        states = SampledStates(piece.top, times_ns / NANOSECONDS, attitudes[1])
        if not np.isnan(states.l3).all() and channel.topic != 'imu/data':       # which is noisy
            drifts = self.drifts.setdefault(topic, {'energy': 0.0, 'l3': 0.0, 'lz': 0.0})
            for name, largest in drifts.items():
                drifts[name] = max(largest, _largest(
                    relative_drift(getattr(states, name), getattr(piece, name))))
        if motion.exact is not None and piece.exact:
            truth = piece.exact.states(times_ns)
            error = _largest(angle_between(states.rows_quaternion, truth.rows_quaternion))
            self.errors[topic] = max(self.errors.get(topic, 0.0), error)

    def _count(self, topic: Topic, stamps_ns: Times, due: list[Times]) -> None:
        """Count messages, and those that were due and are missing."""
        topic.count = len(stamps_ns)
        if topic.count > 1 and (duration_ns := int(stamps_ns[-1] - stamps_ns[0])):
            topic.rate = (topic.count - 1) / duration_ns * NANOSECONDS
        if due:
            due_ns = np.concatenate(due)
            due_ns = due_ns[due_ns <= self.end_ns]
            missing = ~np.isin(due_ns, stamps_ns)
            topic.missing = int(np.sum(missing))
            edges = np.flatnonzero(np.diff(missing, prepend=False, append=False))
            topic.gaps_ns = [(int(due_ns[begin]), int(due_ns[end - 1])) for begin, end in zip(
                edges[::2], edges[1::2], strict=True)][:MOST_GAPS]

    def _measure(self, motion: Motion) -> None:
        """Measure a motion from the longest part of its samples that has one rate."""
        if sum(len(stamps_ns) for stamps_ns, _ in motion.samples) < 2:
            return
        stamps_ns, rows = (np.concatenate(parts, axis=-1)
                           for parts in zip(*motion.samples, strict=True))
        motion.samples, part = [], analysis.longest_run(stamps_ns)
        states = SampledStates(motion.piece.top, (stamps_ns[part] - self.begin_ns) / NANOSECONDS,
                               rows[:, part])
        try:
            motion.measured = analysis.measure(
                states, motion.exact.nutation_period if motion.exact else None)
        except MALFORMED as error:
            self.notes.append(f'{motion.source} cannot be measured: {reason_of(error)}')
        else:
            self.shown.append(states)


def _source(run: RunDescription, section: Section, exact: Description | None) -> str | None:
    """Return the topic that a motion is measured from, as docs/logs.md says."""
    period_ns = ((exact and exact.nutation_period) or math.inf) * NANOSECONDS
    return max((run.topics[name] for name in SOURCES if name in run.topics), default=None,
               key=lambda name: min(period_ns / section.channels[name].period_ns, ENOUGH_SAMPLES))


def _stamps(messages: list[LogMessage]) -> Times:
    return np.array([min(one.log_time, LAST_LOG_TIME_NS) for one in messages], np.int64)


def _largest(values: NDArray[np.float64]) -> float:
    """Return the largest absolute value of those that are finite, 0 without any."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))
