# SPDX-License-Identifier: Apache-2.0
"""
One pass through a log: what is in it, and how right that is.

Samples are looked at in blocks; of each motion the samples of one topic are kept, to measure it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.top import Top
from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import Stream, all_streams
from spinning_top_sim.tools import analysis
from spinning_top_sim.tools.rerun import Account, DepartureError, NotOursError, Rerun, read_account

BLOCK = 4096                # samples looked at together
MOST_POINTS = 20_000        # of a curve that is kept for a picture
MOST_GAPS = 10              # told one by one
# Which samples measure a motion, the best first: angles of their own, exact rates, neither.
SOURCES = ('joint_states', 'ground_truth/imu', 'ground_truth/odom', 'imu/data', 'pose')
ENOUGH_SAMPLES = 12.0       # in a nutation: more from another topic show nothing new
PICTURED_NUTATIONS, PICTURED_S = 8.0, 10.0      # kept for pictures: whichever is longer


@dataclass
class TopicReport:
    """
    What there is of a topic.

    stream: which of ours, None for others;  rate: mean [Hz];  grid: period [Hz] told by the
    parameters;  missing: samples of the grid that are not there;  off_grid: those beside it
    gaps: the first of them, as (from, to) log times [ns];  odd: messages of another layout
    """

    type_name: str
    stream: str | None = None
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    longest_step_ns: int = 0
    grid_rate: float | None = None
    expected: int | None = None
    off_grid: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)
    odd: int = 0

    @property
    def rate(self) -> float | None:
        if self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return None
        return (self.count - 1) / (self.last_ns - self.first_ns) * 1e9

    @property
    def missing(self) -> int | None:
        return None if self.expected is None else self.expected - self.count + self.off_grid

    def see(self, stamp_ns: int) -> None:
        """Count a message."""
        self.count += 1
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = stamp_ns
        else:
            self.longest_step_ns = max(self.longest_step_ns, stamp_ns - self.last_ns)
        self.last_ns = stamp_ns


class Curve:
    """The largest magnitudes of a long series in at most MOST_POINTS points."""

    def __init__(self) -> None:
        self._times: list[Any] = []
        self._values: list[Any] = []
        self.largest = 0.0
        self._squares, self.count = 0.0, 0

    def add(self, stamps_ns: Any, values: Any) -> None:
        """Append samples; those that are no numbers are left out."""
        good = np.isfinite(values)
        stamps_ns, values = stamps_ns[good], values[good]
        if not len(values):
            return
        self.largest = max(self.largest, float(np.max(np.abs(values))))
        self._squares += float(np.sum(values * values))
        self.count += len(values)
        self._times.append(stamps_ns)
        self._values.append(values)
        if sum(map(len, self._times)) > MOST_POINTS:
            times, numbers = self.points()
            pairs = numbers[:len(numbers) // 2 * 2].reshape(-1, 2)
            pick = 2 * np.arange(len(pairs)) + np.argmax(np.abs(pairs), axis=1)
            self._times, self._values = [times[pick]], [numbers[pick]]

    def points(self) -> tuple[Any, Any]:
        """Return stamps [ns] and values."""
        if not self._times:
            return np.empty(0, np.int64), np.empty(0)
        return np.concatenate(self._times), np.concatenate(self._values)

    @property
    def rms(self) -> float:
        return math.sqrt(self._squares / self.count) if self.count else math.nan


@dataclass
class Motion:
    """
    What the top did from a start, command or reset to the next.

    cause: start, command or reset;  begin_ns, end_ns: log times;  origin_ns: log time at which
    the exact solution has t = 0;  described: its numbers, None where it cannot hold the motion
    measured: the same from the data;  source: the topic they come from
    regime: the name told by the data
    """

    cause: str
    begin_ns: int
    end_ns: int
    origin_ns: int
    top: Top
    l3: float
    lz: float
    energy: float
    exact: ExactSolution | None
    described: Description | None
    measured: analysis.Measured | None = None
    source: str | None = None
    regime: str | None = None


@dataclass
class Section:
    """A stretch of a motion with the same rates: samples later than begin_ns, up to end_ns."""

    motion: Motion
    begin_ns: int
    end_ns: int
    epoch_ns: int
    streams: dict[str, Stream]          # by topic of the log, for their rates and layouts
    imu: Imu


@dataclass
class Survey:
    """
    All that a log tells.

    account: of the run, None for a log that is not ours;  why_not: then the reason
    drifts: of E, L3, Lz by topic, relative to what the motion began with (absolute where that is
    0);  errors: of the attitude against the exact solution [rad], by topic
    tilts: the samples shown in pictures;  readings: of the IMU there, by topic: stamps, rates,
    forces
    """

    damage: Damage
    whole: bool
    topics: dict[str, TopicReport]
    account: Account | None = None
    why_not: str = ''
    motions: list[Motion] = field(default_factory=list)
    drifts: dict[str, dict[str, Curve]] = field(default_factory=dict)
    errors: dict[str, Curve] = field(default_factory=dict)
    tilts: analysis.Tilts | None = None
    readings: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def begin_ns(self) -> int:
        return min((t.first_ns for t in self.topics.values() if t.first_ns is not None),
                   default=0)

    @property
    def end_ns(self) -> int:
        return max((t.last_ns for t in self.topics.values() if t.last_ns is not None), default=0)


def survey(reader: LogReader) -> Survey:
    """Return what a log tells.  Raises LogError."""
    damage = reader.damage
    found = Survey(damage, reader.whole and not damage.truncated and damage.lossless,
                   {topic.name: TopicReport(topic.type_name) for topic in reader.topics})
    try:
        found.account = read_account(reader)
    except NotOursError as error:
        found.why_not = str(error)
    else:
        for topic, name in found.account.topics.items():
            found.topics[topic].stream = name
    _Pass(found, damage.end_ns).go(reader)
    return found


class _Pass:
    """Walks through the messages and their sections together."""

    def __init__(self, found: Survey, end_ns: int) -> None:
        self._found = found
        self._stamps: dict[str, list[int]] = {}
        self._data: dict[str, list[bytes]] = {}
        self._kept: list[analysis.Attitudes] = []
        self._sections: list[Section] = []
        self._source: str | None = None
        self._last: dict[str, int] = {}
        if found.account is not None:
            self._sections = _sections(found.account, found, end_ns)
        self._index = -1

    def go(self, reader: LogReader) -> None:
        topics, account = self._found.topics, self._found.account
        ours = {} if account is None else account.topics
        if self._sections:
            self._enter(0)
        for message in reader.messages():
            stamp_ns, topic = message.log_time, message.topic
            while self._sections and stamp_ns > self._sections[self._index].end_ns and (
                    self._index + 1 < len(self._sections)):
                self._enter(self._index + 1)
            topics[topic].see(stamp_ns)
            if topic in ours and self._sections:
                stamps = self._stamps.setdefault(topic, [])
                stamps.append(stamp_ns)
                self._data.setdefault(topic, []).append(message.data)
                if len(stamps) >= BLOCK:
                    self._flush(topic)
        if self._sections:
            while self._index + 1 < len(self._sections):
                self._enter(self._index + 1)
            self._leave()
            self._measure()

    def _enter(self, index: int) -> None:
        """Go on to the next section."""
        if self._index >= 0:
            self._leave()
            if self._sections[index].motion is not self._sections[self._index].motion:
                self._measure()
        self._index = index
        section = self._sections[index]
        self._source = _source(section)
        for topic, stream in section.streams.items():
            report = self._found.topics[topic]
            report.grid_rate = 1e9 / stream.period_ns
            first = (section.begin_ns - section.epoch_ns) // stream.period_ns
            last = (section.end_ns - section.epoch_ns) // stream.period_ns
            report.expected = (report.expected or 0) + last - first
            self._last[topic] = section.epoch_ns + first * stream.period_ns

    def _leave(self) -> None:
        section = self._sections[self._index]
        for topic in list(self._stamps):
            self._flush(topic)
        for topic, stream in section.streams.items():
            self._gap(topic, section.end_ns - (section.end_ns - section.epoch_ns)
                      % stream.period_ns + stream.period_ns, stream.period_ns)

    def _gap(self, topic: str, stamp_ns: int, period_ns: int) -> None:
        """Tell of samples missing before one."""
        report = self._found.topics[topic]
        if stamp_ns - self._last[topic] > period_ns and len(report.gaps) < MOST_GAPS:
            report.gaps.append((self._last[topic] + period_ns, stamp_ns - period_ns))

    def _flush(self, topic: str) -> None:
        """Look at the samples that have come together of a topic."""
        stamps_list, data = self._stamps.pop(topic, []), self._data.pop(topic, [])
        section = self._sections[self._index]
        stream = section.streams.get(topic)
        if not stamps_list or stream is None:
            return
        report = self._found.topics[topic]
        size = len(stream.template)
        if any(len(message) != size for message in data):
            good = [i for i, message in enumerate(data) if len(message) == size]
            report.odd += len(data) - len(good)
            stamps_list, data = [stamps_list[i] for i in good], [data[i] for i in good]
            if not data:
                return
        stamps = np.array(stamps_list, np.int64)
        period = stream.period_ns
        report.off_grid += int(np.count_nonzero((stamps - section.epoch_ns) % period))
        steps = np.diff(stamps, prepend=self._last[topic])
        for place in np.flatnonzero(steps > period)[:MOST_GAPS]:
            self._last[topic] = int(stamps[place] - steps[place])
            self._gap(topic, int(stamps[place]), period)
        self._last[topic] = int(stamps[-1])
        self._look(topic, section, stream, stamps, stream.template.decode_many(b''.join(data)))

    def _look(self, topic: str, section: Section, stream: Stream, stamps: Any,
              runs: tuple[Any, ...]) -> None:
        found, motion = self._found, section.motion
        window = stamps <= self._pictured_until()
        if stream.topic in ('imu/data_raw', 'ground_truth/imu', 'ground_truth/imu_bias') and (
                window.any()):
            old = found.readings.get(topic)
            new: tuple[Any, ...] = (stamps[window], runs[1][window], runs[2][window])
            if old is not None:
                new = tuple(np.concatenate(pair) for pair in zip(old, new, strict=True))
            found.readings[topic] = new
        data = _attitudes(stream, section.imu, stamps, runs)
        if data is None:
            return
        if topic == self._source:
            self._kept.append(data)
        if stream.topic != 'imu/data':
            values = analysis.constants(motion.top, data)
            starts = (motion.energy, motion.l3, motion.lz)
            if values is not None:
                curves = found.drifts.setdefault(
                    topic, {name: Curve() for name in ('energy', 'l3', 'lz')})
                for curve, value, start in zip(curves.values(), values, starts, strict=True):
                    curve.add(stamps, (value - start) / (abs(start) or 1.0))
        if motion.exact is not None:
            exact = motion.exact.states_at_ns(stamps - motion.origin_ns).quaternion
            found.errors.setdefault(topic, Curve()).add(
                stamps, analysis.angle_between(data.quaternion, exact))

    def _pictured_until(self) -> float:
        motion = self._found.motions[0]
        period = None if motion.described is None else motion.described.nutation_period
        return motion.begin_ns + 1e9 * max(PICTURED_S, PICTURED_NUTATIONS * (period or 0.0))

    def _measure(self) -> None:
        """Measure the motion that is over."""
        motion, kept = self._sections[self._index].motion, self._kept
        self._kept = []
        motion.source = self._source
        if not kept:
            return
        data = _longest_run(kept)
        if len(data.stamps_ns) < 2:
            return
        tilts = analysis.Tilts(data)
        motion.measured = analysis.measure(tilts)
        values = analysis.constants(motion.top, data)
        if values is not None and tilts.theta_dot is not None:
            _, l3, lz = (float(np.median(value)) for value in values)
            middle = int(np.argmin(np.abs(tilts.height - np.median(tilts.height))))
            motion.regime = analysis.measured_regime(
                motion.top, float(tilts.theta[middle]), float(tilts.theta_dot[middle]), l3, lz)
        if self._found.tilts is None:
            shown = int(np.count_nonzero(data.stamps_ns <= self._pictured_until()))
            if shown > 1:
                self._found.tilts = analysis.Tilts(_cut(data, 0, shown))


def _sections(account: Account, found: Survey, end_ns: int) -> list[Section]:
    """Return the stretches of the run, and its motions into `found`."""
    sections: list[Section] = []
    try:
        rerun = Rerun(account)
        values = account.values
        begin_ns = account.epoch_ns + account.begun_ns
        _begin_motion(found, rerun, 'start', begin_ns)
        sections.append(_section(found, rerun, begin_ns, values))
        for event in rerun.legs(end_ns):
            if event is None:
                continue
            sections[-1].end_ns = rerun.stamp_ns
            begin_ns = rerun.stamp_ns
            if event.name == 'reset':
                values = rerun.simulation.values
                begin_ns = rerun.simulation.epoch_ns - 1
            if event.name in ('command', 'reset'):
                found.motions[-1].end_ns = rerun.stamp_ns
                _begin_motion(found, rerun, event.name, begin_ns)
            sections.append(_section(found, rerun, begin_ns, values))
    except (DepartureError, ValueError) as error:
        found.notes.append(f'the run cannot be followed beyond here: {error}')
    if sections:
        sections[-1].end_ns = max(end_ns, sections[-1].begin_ns)
        found.motions[-1].end_ns = sections[-1].end_ns
    return sections


def _begin_motion(found: Survey, rerun: Rerun, cause: str, begin_ns: int) -> None:
    simulation = rerun.simulation
    exact = simulation.exact()
    found.motions.append(Motion(
        cause, begin_ns, begin_ns, simulation.epoch_ns + simulation.anchor_ns, simulation.top,
        simulation.l3, simulation.lz, simulation.start_energy,
        None if exact is None else exact.solution, simulation.describe()))


def _section(found: Survey, rerun: Rerun, begin_ns: int, values: Mapping[str, Any]) -> Section:
    """Return a section with copies of the streams as they are now."""
    assert found.account is not None
    imu = Imu(values)
    now = {stream.topic: stream for stream in rerun.simulation.streams}
    streams = {}
    for topic, name in found.account.topics.items():
        rate = 1e9 / now[name].period_ns
        copy = next(s for s in all_streams(values, imu) if s.topic == name)
        copy.set_rate(rate)
        streams[topic] = copy
    return Section(found.motions[-1], begin_ns, begin_ns, rerun.simulation.epoch_ns, streams, imu)


def _source(section: Section) -> str | None:
    """Return the topic that measures a motion best."""
    topics = {stream.topic: topic for topic, stream in section.streams.items()}
    there = [name for name in SOURCES if name in topics]
    described = section.motion.described
    period = None if described is None else described.nutation_period
    if not there:
        return None

    def samples(name: str) -> float:
        nutation = math.inf if period is None else period
        return min(nutation * 1e9 / section.streams[topics[name]].period_ns, ENOUGH_SAMPLES)
    return topics[max(there, key=samples)]


def _attitudes(stream: Stream, imu: Imu, stamps: Any,
               runs: tuple[Any, ...]) -> analysis.Attitudes | None:
    """Return the attitudes that a topic's messages hold."""
    if stream.topic == 'joint_states':
        return analysis.from_angles(stamps, *runs)
    if stream.topic == 'pose':
        return analysis.Attitudes(stamps, runs[0].copy())
    if stream.topic == 'ground_truth/odom':
        return analysis.Attitudes(stamps, runs[0].copy(), tuple(runs[1].T.copy()))
    if stream.topic in ('ground_truth/imu', 'imu/data'):
        quaternion, rates = imu.in_body(tuple(runs[0].T), tuple(runs[1].T))
        return analysis.Attitudes(stamps, np.stack(quaternion, axis=1), tuple(rates))
    return None


def _longest_run(parts: list[analysis.Attitudes]) -> analysis.Attitudes:
    """Return the longest stretch without gaps, its rate the same throughout."""
    def joined_columns(name: str) -> Any:
        if getattr(parts[0], name) is None:
            return None
        return tuple(np.concatenate(columns) for columns in zip(
            *(getattr(part, name) for part in parts), strict=True))
    joined = analysis.Attitudes(
        np.concatenate([part.stamps_ns for part in parts]),
        np.concatenate([part.quaternion for part in parts]),
        joined_columns('rates'), joined_columns('angles'))
    steps = np.diff(joined.stamps_ns)
    cuts = [0, *(np.flatnonzero(np.diff(steps)) + 1).tolist(), len(steps)]
    begin, end = max(itertools.pairwise(cuts), key=lambda pair: pair[1] - pair[0])
    return _cut(joined, begin, end + 1)


def _cut(data: analysis.Attitudes, begin: int, end: int) -> analysis.Attitudes:
    piece = slice(begin, end)

    def cut(columns: tuple[Any, ...] | None) -> Any:
        return None if columns is None else tuple(column[piece] for column in columns)
    return analysis.Attitudes(data.stamps_ns[piece], data.quaternion[piece], cut(data.rates),
                              cut(data.angles))
