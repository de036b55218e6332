# SPDX-License-Identifier: Apache-2.0
"""
One pass through a log: what is in it, and how accurate that is.

Samples are processed in blocks.  Of each motion the samples of one topic are kept, to measure it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.topics import Stream
from spinning_top_sim.tools import analysis
from spinning_top_sim.tools.motions import MotionReport, Section, attitudes_of, find_sections
from spinning_top_sim.tools.run_description import (
    ForeignLogError,
    RunDescription,
    read_run_description,
)

BLOCK = 4096                # samples processed together
MOST_POINTS = 20_000        # of a series that is kept for a picture
MOST_GAPS = 10              # listed one by one
SHOWN_NUTATIONS, SHOWN_S = 8.0, 10.0      # in pictures: whichever is longer
IMU_TOPICS = ('imu/data_raw', 'ground_truth/imu', 'ground_truth/imu_bias')


@dataclass
class TopicReport:
    """What is in a topic."""

    type_name: str
    stream: str | None = None             # which of our streams it is
    count: int = 0
    first_ns: int | None = None           # log times of the first and the last message [ns]
    last_ns: int | None = None
    longest_step_ns: int = 0              # longest time between two messages [ns]
    grid_rate: float | None = None        # by the parameters [Hz]
    expected: int | None = None           # samples on the grid
    off_grid: int = 0                     # samples that are not on it
    # The first gaps: log times of the first and the last missing sample [ns]
    gaps: list[tuple[int, int]] = field(default_factory=list)
    odd_size: int = 0                     # messages of another size than the stream's
    _epoch_ns: int = 0          # of the grid
    _period_ns: int = 1
    _newest_ns: int = 0         # the newest sample, or the grid point before the first

    @property
    def rate(self) -> float | None:
        """Mean rate [Hz]."""
        if self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return None
        return (self.count - 1) / (self.last_ns - self.first_ns) * 1e9

    @property
    def missing(self) -> int | None:
        """Number of samples on the grid that are not in the log."""
        return None if self.expected is None else self.expected - self.count + self.off_grid

    def add(self, stamp_ns: int) -> None:
        """Count a message."""
        self.count += 1
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = stamp_ns
        else:
            self.longest_step_ns = max(self.longest_step_ns, stamp_ns - self.last_ns)
        self.last_ns = stamp_ns

    def begin_grid(self, section: Section, period_ns: int) -> None:
        """Expect the samples of a section on its grid."""
        self._epoch_ns, self._period_ns = section.epoch_ns, period_ns
        self.grid_rate = NANOSECONDS / period_ns
        first, last = ((at_ns - section.epoch_ns) // period_ns
                       for at_ns in (section.begin_ns, section.end_ns))
        self.expected = (self.expected or 0) + last - first
        self._newest_ns = section.epoch_ns + first * period_ns

    def add_to_grid(self, stamps_ns: NDArray[np.int64]) -> None:
        """Compare samples with the grid."""
        self.off_grid += int(np.count_nonzero((stamps_ns - self._epoch_ns) % self._period_ns))
        before = np.concatenate(([self._newest_ns], stamps_ns[:-1]))
        for place in np.flatnonzero(stamps_ns - before > self._period_ns)[:MOST_GAPS]:
            self._add_gap(int(before[place]), int(stamps_ns[place]))
        self._newest_ns = int(stamps_ns[-1])

    def end_grid(self, section: Section) -> None:
        """Note what is missing at the end of a section."""
        self._add_gap(self._newest_ns, section.end_ns + self._period_ns
                      - (section.end_ns - section.epoch_ns) % self._period_ns)

    def _add_gap(self, before_ns: int, after_ns: int) -> None:
        if after_ns - before_ns > self._period_ns and len(self.gaps) < MOST_GAPS:
            self.gaps.append((before_ns + self._period_ns, after_ns - self._period_ns))


class Series:
    """Statistics of a long series of numbers, and at most MOST_POINTS points of it."""

    def __init__(self) -> None:
        self._times_ns: NDArray[np.int64] = np.empty(0, np.int64)
        self._values: NDArray[np.float64] = np.empty(0)
        self._square_sum, self._count = 0.0, 0
        self.largest = 0.0

    def add(self, times_ns: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Append values, without those that are not finite."""
        good = np.isfinite(values)
        times_ns, values = times_ns[good], values[good]
        self.largest = max(self.largest, float(np.max(np.abs(values), initial=0.0)))
        self._square_sum += float(np.sum(values * values))
        self._count += len(values)
        self._times_ns = np.concatenate((self._times_ns, times_ns))
        self._values = np.concatenate((self._values, values))
        while len(self._values) > MOST_POINTS:
            # Of two neighbours the larger one.
            pairs = self._values[:len(self._values) // 2 * 2].reshape(-1, 2)
            pick = 2 * np.arange(len(pairs)) + np.argmax(np.abs(pairs), axis=1)
            self._times_ns, self._values = self._times_ns[pick], self._values[pick]

    def points(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return log times [ns] and values."""
        return self._times_ns, self._values

    @property
    def rms(self) -> float:
        """Root of the mean square; NaN without values."""
        return math.sqrt(self._square_sum / self._count) if self._count else math.nan


@dataclass
class Readings:
    """Readings of an IMU: log times (n,) [ns], rates (n, 3) [rad/s], forces (n, 3) [m/s^2]."""

    stamps_ns: NDArray[np.int64]
    angular_velocity: NDArray[np.float64]
    specific_force: NDArray[np.float64]


NO_READINGS = Readings(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))


@dataclass
class Survey:
    """All findings about a log."""

    damage: Damage
    whole: bool                           # the log was closed, and nothing is lost
    topics: dict[str, TopicReport]
    run: RunDescription | None = None     # None for a log that this package did not record
    foreign_reason: str = ''              # why not
    motions: list[MotionReport] = field(default_factory=list)
    # By topic, of energy, l3 and lz: relative to their values at the beginning of the motion,
    # absolute where these are 0.
    drifts: dict[str, dict[str, Series]] = field(default_factory=dict)
    # By topic: angle between the attitude and the exact solution [rad].
    errors: dict[str, Series] = field(default_factory=dict)
    shown: analysis.Tilts | None = None   # the samples shown in pictures
    # By topic: of the IMU, in the same time.
    readings: dict[str, Readings] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def begin_ns(self) -> int:
        """Log time of the first message [ns]; 0 without messages."""
        return min((t.first_ns for t in self.topics.values() if t.first_ns is not None),
                   default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message [ns]; 0 without messages."""
        return max((t.last_ns for t in self.topics.values() if t.last_ns is not None), default=0)

    @property
    def shown_until_ns(self) -> float:
        """Log time up to which samples are shown in pictures [ns]."""
        period = self.motions[0].nutation_period
        shown_s = max(SHOWN_S, SHOWN_NUTATIONS * period if math.isfinite(period) else 0.0)
        return self.motions[0].begin_ns + shown_s * NANOSECONDS


def survey(reader: LogReader) -> Survey:
    """Return the findings about a log.  Raises LogError."""
    damage = reader.damage
    found = Survey(damage, reader.whole and not damage.truncated and damage.lossless,
                   {topic.name: TopicReport(topic.type_name) for topic in reader.topics})
    sections: list[Section] = []
    try:
        found.run = read_run_description(reader)
    except ForeignLogError as error:
        found.foreign_reason = str(error)
    else:
        for topic, name in found.run.topics.items():
            found.topics[topic].stream = name
        sections, error_text = find_sections(found.run, damage.end_ns)
        if error_text:
            found.notes.append(f'the run cannot be followed beyond here: {error_text}')
    for section in sections:
        if not found.motions or section.motion is not found.motions[-1]:
            found.motions.append(section.motion)
    _read_messages(reader, found, sections)
    return found


def _read_messages(reader: LogReader, found: Survey, sections: list[Section]) -> None:
    """Count all messages, and analyse those of each section."""
    following = iter(sections)
    section = next(following, None)
    analyser = None if section is None else _SectionAnalyser(found, section, [])
    for message in reader.messages():
        found.topics[message.topic].add(message.log_time)
        while analyser is not None and message.log_time > analyser.section.end_ns:
            section = next(following, None)
            if section is None:
                break
            analyser = analyser.next(section)
        if analyser is not None:
            analyser.add(message.topic, message.log_time, message.data)
    if analyser is not None:
        for section in following:
            analyser = analyser.next(section)
        analyser.finish_motion()


class _SectionAnalyser:
    """
    Analyses the samples of a section, in blocks.

    kept: attitudes of the motion's source so far
    """

    def __init__(self, found: Survey, section: Section, kept: list[analysis.Attitudes]) -> None:
        self.section = section
        self._found, self._kept = found, kept
        self._waiting: dict[str, list[tuple[int, bytes]]] = {
            topic: [] for topic in section.streams}
        for topic, stream in section.streams.items():
            found.topics[topic].begin_grid(section, stream.period_ns)

    def add(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Take a message; those of other topics than the streams' do not matter."""
        waiting = self._waiting.get(topic)
        if waiting is not None:
            waiting.append((stamp_ns, data))
            if len(waiting) >= BLOCK:
                self._flush(topic)

    def next(self, section: Section) -> _SectionAnalyser:
        """Finish this section and return the analyser of the following one."""
        if section.motion is self.section.motion:
            self._finish()
            return _SectionAnalyser(self._found, section, self._kept)
        self.finish_motion()
        return _SectionAnalyser(self._found, section, [])

    def _finish(self) -> None:
        for topic in self.section.streams:
            self._flush(topic)
            self._found.topics[topic].end_grid(self.section)

    def finish_motion(self) -> None:
        """Finish this section, and measure the motion that ends with it."""
        self._finish()
        motion = self.section.motion
        motion.source = self.section.source
        data = _longest_run(analysis.join(self._kept)) if self._kept else None
        if data is None or len(data.stamps_ns) < 2:
            return
        tilts = analysis.Tilts(data)
        motion.measured = analysis.measure(tilts)
        values = analysis.constants(motion.top, data)
        if values is not None and tilts.theta_dot is not None:
            _, l3, lz = (float(np.median(value)) for value in values)
            middle = int(np.argmin(np.abs(tilts.height - np.median(tilts.height))))
            motion.regime = analysis.measured_regime(
                motion.top, float(tilts.theta[middle]), float(tilts.theta_dot[middle]), l3, lz)
        count = int(np.count_nonzero(data.stamps_ns <= self._found.shown_until_ns))
        if self._found.shown is None and count > 1:
            self._found.shown = analysis.Tilts(data.part(slice(count)))

    def _flush(self, topic: str) -> None:
        """Analyse the samples of a topic that have been collected."""
        report, stream = self._found.topics[topic], self.section.streams[topic]
        size = len(stream.template)
        waiting, self._waiting[topic] = self._waiting[topic], []
        samples = [(stamp_ns, data) for stamp_ns, data in waiting if len(data) == size]
        report.odd_size += len(waiting) - len(samples)
        if not samples:
            return
        stamps_ns = np.array([stamp_ns for stamp_ns, _ in samples], np.int64)
        report.add_to_grid(stamps_ns)
        self._analyse(topic, stream, stamps_ns,
                      stream.template.decode(b''.join(data for _, data in samples)))

    def _analyse(self, topic: str, stream: Stream, stamps_ns: NDArray[np.int64],
                 fields: tuple[NDArray[np.float64], ...]) -> None:
        found, motion = self._found, self.section.motion
        if stream.topic in IMU_TOPICS:
            self._keep_readings(topic, stamps_ns, fields)
        data = attitudes_of(stream, self.section.imu, stamps_ns, fields)
        data = None if data is None else data.valid()
        if data is None or not len(data.stamps_ns):
            return
        stamps_ns = data.stamps_ns
        if topic == self.section.source:
            self._kept.append(data)
        values = None if stream.topic == 'imu/data' else analysis.constants(motion.top, data)
        if values is not None:      # imu/data is noisy
            drifts = found.drifts.setdefault(
                topic, {name: Series() for name in ('energy', 'l3', 'lz')})
            for series, value, start in zip(drifts.values(), values,
                                            (motion.energy, motion.l3, motion.lz), strict=True):
                series.add(stamps_ns, (value - start) / (abs(start) or 1.0))
        if motion.exact is not None:
            exact = motion.exact.states(stamps_ns - motion.origin_ns).quaternion
            found.errors.setdefault(topic, Series()).add(
                stamps_ns, analysis.angle_between(data.quaternion, exact))

    def _keep_readings(self, topic: str, stamps_ns: NDArray[np.int64],
                       fields: tuple[NDArray[np.float64], ...]) -> None:
        """Keep the readings of the IMU that are shown in pictures."""
        shown = stamps_ns <= self._found.shown_until_ns
        if not shown.any():
            return
        old = self._found.readings.get(topic, NO_READINGS)
        self._found.readings[topic] = Readings(
            np.concatenate((old.stamps_ns, stamps_ns[shown])),
            np.concatenate((old.angular_velocity, fields[1][shown])),
            np.concatenate((old.specific_force, fields[2][shown])))


def _longest_run(data: analysis.Attitudes) -> analysis.Attitudes:
    """Return the longest part without gaps, its rate the same throughout."""
    steps = np.diff(data.stamps_ns)
    cuts = [0, *(np.flatnonzero(np.diff(steps)) + 1).tolist(), len(steps)]
    begin, end = max(itertools.pairwise(cuts), key=lambda pair: pair[1] - pair[0])
    return data.part(slice(begin, end + 1))
