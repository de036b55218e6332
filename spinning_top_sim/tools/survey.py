# SPDX-License-Identifier: Apache-2.0
"""
Finds out what is in a log, and how accurate that is.

`survey` computes the motions of the run, compares each message with the motion that it belongs to,
counts the samples of each topic, and measures each motion from the samples of one topic.
"""

import itertools
import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.recording.errors import MALFORMED, Damage, reason_of
from spinning_top_sim.recording.reader import LogMessage, LogReader
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.times import LAST_STAMP_NS, NANOSECONDS, Times, ns_array, stamp_text
from spinning_top_sim.tools import analysis, recorded_run
from spinning_top_sim.tools.analysis import Measured, SampledStates
from spinning_top_sim.tools.recorded_run import LAST_LOG_TIME_NS, RunDescription

MOST_GAPS = 10              # that are listed
MOST_EXACT = 1000           # motions that are compared with the exact one: 10 ms each
# Streams that a motion can be measured from, the most accurate first.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'imu/data', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation; a higher rate adds no accuracy
Due = defaultdict[str, list[Times]]     # by topic, when messages were due [ns]


@dataclass
class TopicReport:
    """The findings about a topic, with the keys of docs/logs.md."""

    type: str
    stream: str | None = None             # topic of the stream of this package
    count: int = 0
    rate: float | None = None             # mean [Hz]
    grid_rate: float | None = None        # by the parameters [Hz]
    missing: int | None = None            # samples of the grid that are not in the log
    # The first gaps: log times of the first and the last missing sample [ns]
    gaps_ns: list[tuple[int, int]] = field(default_factory=list)


class Section(NamedTuple):
    """A part of a run in which all rates stay the same: samples after begin_ns."""

    epoch_ns: int                         # stamp of t = 0 [ns]
    begin_ns: int                         # simulated time [ns]
    channels: dict[str, Channel]          # of the log, by its topics
    imu: Imu

    @classmethod
    def of(cls, simulation: Simulation, run: RunDescription) -> 'Section':
        return cls(simulation.epoch_ns, simulation.now_ns, {
            run.topics[channel.topic]: channel for channel in simulation.channels
            if channel.topic in run.topics}, simulation.imu)


@dataclass
class MotionReport:
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


@dataclass
class Survey:
    """All findings about a log."""

    path: Path                            # of the log
    damage: Damage
    span: tuple[int, int]                 # log times of the first and the last message [ns]
    end_ns: int                           # log time up to which samples were recorded [ns]
    topics: dict[str, TopicReport]
    run: RunDescription | None = None     # None for a log that this package did not record
    foreign_reason: str = ''              # why it is None
    motions: list[MotionReport] = field(default_factory=list)
    # By topic, the largest drifts of energy, l3 and lz since the begin of the motion, relative if
    # not from 0, and the largest error of an attitude [rad]
    drifts: dict[str, dict[str, float]] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    shown: list[SampledStates] = field(default_factory=list)    # the motions, for pictures
    notes: list[str] = field(default_factory=list)


@np.errstate(all='ignore')                  # a log may hold any numbers
def survey(reader: LogReader) -> Survey:
    """Return the findings about a log.  Raises LogError."""
    found = Survey(reader.path, reader.damage, reader.span, reader.span[1], {
        topic.name: TopicReport(topic.type_name) for topic in reader.topics})
    due = Due(list)
    try:
        run = found.run = recorded_run.read_run_description(reader)
    except recorded_run.ForeignLogError as error:
        found.foreign_reason = str(error)
    else:
        found.notes += [f'journal, entry at {stamp_text(stamp_ns)} s: {reason}'
                        for stamp_ns, reason in run.broken]
        for name, topic in run.topics.items():
            found.topics[topic].stream = name
        _follow_run(found, run, due)
    stamps_ns = _read_messages(found, reader)
    if found.motions:       # the last entry of the journal may be later than the last sample
        last = found.motions[-1]
        found.end_ns = last.end_ns = max(last.begin_ns, 0, *(
            int(stamps_ns[topic].max(initial=0)) for topic in last.section.channels))
    for topic, report in found.topics.items():
        _count(report, stamps_ns[topic], due[topic], found.end_ns)
    for motion in found.motions:
        _measure(found, motion)
    return found


def _follow_run(found: Survey, run: RunDescription, due: Due) -> None:
    """Compute the motions of a run, and when messages were due."""
    motions, section = found.motions, None
    try:
        for simulation, done in recorded_run.rerun(run, found.span[1]):
            if isinstance(done, Block):
                continue
            event = done.event
            if section is not None:
                _expect(found, run, due, section, event.sent_ns)
                motions[-1].end_ns = section.epoch_ns + event.sent_ns
            section = Section.of(simulation, run)
            # The velocities of the pivot belong to one motion.
            if event.begins_report and not (
                    event.kind == 'drive' and motions and motions[-1].cause == 'drive'):
                piece = simulation.trajectory.after(max(simulation.now_ns, 0))
                exact = piece.describe() if len(motions) < MOST_EXACT else None
                begin_ns = section.epoch_ns + section.begin_ns
                motions.append(MotionReport(event.kind, begin_ns, begin_ns, section, piece, exact,
                                            _source(run, section.channels, exact)))
    except MALFORMED as error:
        found.notes.append(f'the run cannot be followed beyond here: {reason_of(error)}')
    if section is not None:
        _expect(found, run, due, section, found.span[1] - section.epoch_ns)
    if len(motions) > MOST_EXACT:
        found.notes.append(f'only the first {MOST_EXACT} motions are compared with the exact one')


def _expect(found: Survey, run: RunDescription, due: Due, section: Section, end_ns: int) -> None:
    """Note when the messages of a section up to a simulated time were due."""
    for topic, channel in section.channels.items():
        found.topics[topic].grid_rate = NANOSECONDS / channel.period_ns
        times = channel.times(max(section.begin_ns, -1), end_ns)
        if len(times) <= recorded_run.most_samples(run):
            due[topic].append(section.epoch_ns + np.unique(channel.due(ns_array(times))))
        else:
            found.notes.append(f'{topic}: what is missing is not counted: the log lacks most of '
                               f'{len(times)} samples')


def _source(run: RunDescription, channels: Mapping[str, Channel],
            exact: Description | None) -> str | None:
    """Return the topic that a motion is measured from, as docs/logs.md says."""
    period_ns = ((exact and exact.nutation_period) or math.inf) * NANOSECONDS
    return max((run.topics[name] for name in SOURCES if name in run.topics), default=None,
               key=lambda name: min(period_ns / channels[name].period_ns, ENOUGH_SAMPLES))


def _read_messages(found: Survey, reader: LogReader) -> dict[str, Times]:
    """Compare all messages with their motions; return the log times of each topic [ns]."""
    ends_ns = [motion.end_ns for motion in found.motions[:-1]]
    blocks_ns = {topic: [np.empty(0, np.int64)] for topic in found.topics}
    for topic, samples in reader.groups():
        blocks_ns[topic].append(_stamps(samples))
        if found.motions and found.topics[topic].stream is not None:
            for number, part in itertools.groupby(
                    samples, lambda sample: bisect_left(ends_ns, sample.log_time)):
                _analyse(found, found.motions[number], topic, list(part))
    return {topic: np.concatenate(parts) for topic, parts in blocks_ns.items()}


def _stamps(samples: list[LogMessage]) -> Times:
    return np.array([min(sample.log_time, LAST_LOG_TIME_NS) for sample in samples], np.int64)


def _analyse(found: Survey, motion: MotionReport, topic: str, samples: list[LogMessage]) -> None:
    """Compare messages with their motion, and keep those that it is measured from."""
    section, piece = motion.section, motion.piece
    channel = section.channels[topic]
    fitting = [sample for sample in samples if len(sample.data) == len(channel.template)]
    attitudes = analysis.attitudes_of(
        channel.topic, section.imu, _stamps(fitting),
        channel.template.decode(b''.join(sample.data for sample in fitting)))
    if attitudes is None:
        return
    if topic == motion.source:
        motion.samples.append(attitudes)
    if not piece.rests:             # there are other constants in each of its pieces
        return
    # Log times of the run; those of a log that was changed may lie anywhere.
    times_ns = np.clip(attitudes[0] - section.epoch_ns, piece.start_ns, LAST_STAMP_NS)
    states = SampledStates(piece.top, times_ns / NANOSECONDS, attitudes[1])
    if not np.isnan(states.l3).all() and channel.topic != 'imu/data':       # which is noisy
        drifts = found.drifts.setdefault(topic, {'energy': 0.0, 'l3': 0.0, 'lz': 0.0})
        for name, largest in drifts.items():
            drift = relative_drift(getattr(states, name), getattr(piece, name))
            drifts[name] = max(largest, _largest(drift))
    if motion.exact is not None and (truth := piece.truth(times_ns)) is not None:
        error = _largest(angle_between(states.rows_quaternion, truth.rows_quaternion))
        found.errors[topic] = max(found.errors.get(topic, 0.0), error)


def _largest(values: NDArray[np.float64]) -> float:
    """Return the largest absolute value of those that are finite, 0 without any."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))


def _count(report: TopicReport, stamps_ns: Times, due: list[Times], end_ns: int) -> None:
    """Count the messages, and those that were due by a log time and are missing."""
    report.count = len(stamps_ns)
    if report.count > 1:
        duration_ns = int(stamps_ns[-1] - stamps_ns[0])
        report.rate = (report.count - 1) / duration_ns * 1e9 if duration_ns else None
    if due:
        due_ns = np.concatenate(due)
        due_ns = due_ns[due_ns <= end_ns]
        missing = ~np.isin(due_ns, stamps_ns)
        report.missing = int(np.sum(missing))
        edges = np.flatnonzero(np.diff(missing, prepend=False, append=False))
        report.gaps_ns = [(int(due_ns[begin]), int(due_ns[end - 1])) for begin, end in zip(
            edges[::2], edges[1::2], strict=True)][:MOST_GAPS]


def _measure(found: Survey, motion: MotionReport) -> None:
    """Measure a motion from the longest part of its samples that has one rate."""
    stamps_ns = np.concatenate([np.empty(0, np.int64), *(one for one, _ in motion.samples)])
    if len(stamps_ns) < 2:
        return
    part = analysis.longest_run(stamps_ns)
    rows = np.concatenate([rows for _, rows in motion.samples], axis=1)[:, part]
    motion.samples = []
    times = (stamps_ns[part] - found.span[0]) / NANOSECONDS
    data = SampledStates(motion.piece.top, times, rows)
    try:
        motion.measured = analysis.measure(
            data, motion.exact.nutation_period if motion.exact else None)
    except MALFORMED as error:
        found.notes.append(f'{motion.source} cannot be measured: {reason_of(error)}')
    else:
        found.shown.append(data)
