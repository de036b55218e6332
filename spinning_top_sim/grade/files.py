# SPDX-License-Identifier: Apache-2.0
"""
Reads trajectories that exist: ROS 2 logs (MCAP), and tables (CSV, Parquet, npz).

docs/grade.md lists the types of messages and the names of columns that are understood.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, RotationSpline

from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.grade.trajectory import LEAST_SAMPLES, Trajectory
from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools import recorded_run

ATTITUDES, RATES, GYROSCOPE = 'attitudes', 'rates', 'gyroscope'
ACCELERATIONS, MAGNETOMETER, ANGLES = 'accelerations', 'magnetometer', 'angles'
# Words in the name of a column, before its component.
WORDS = {
    ATTITUDES: {'q', 'quat', 'quaternion', 'orientation', 'attitude', 'attitudes', 'rotation'},
    GYROSCOPE: {'gyro', 'gyr', 'gyroscope'},
    RATES: {'w', 'omega', 'rate', 'rates', 'angular'},
    ACCELERATIONS: {'a', 'acc', 'accel', 'acceleration', 'accelerations', 'accelerometer',
                    'specific'},
    MAGNETOMETER: {'m', 'mag', 'magnetic', 'magnetometer'}}
ANGLE_WORDS = ({'phi', 'precession'}, {'theta', 'nutation'}, {'psi', 'spin'})
OTHER_WORDS = {'dot', 'velocity', 'bias', 'covariance', 'cov', 'std', 'position', 'world', 'error'}
TIMES = {'t', 'time', 'times', 'timestamp', 'stamp'}
SECONDS = {'ns': '1e-9', 'nsec': '1e-9', 'nanosec': '1e-9', 'us': '1e-6', 'ms': '1e-3'}
UNITS = {'deg': math.pi / 180.0, 'dps': math.pi / 180.0}
SAME_S = 1e-6               # between two stamps of one time
EVEN = 1e-3                 # share of the interval by which evenly spaced samples may be off
LATEST_START_S = 1.0        # a first stamp after that is a date, or of a clock of its own
GAP = 1.5                   # intervals that are a gap


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,) [s] and values (n, k) by name: `Trajectory` has the names
    covariance : (3, 3) that the first message of an IMU tells, by name
    parameters : of the run, where the file tells them, as `parameters.checked` returns them
    notes : what was chosen or left out
    """

    parts: dict[str, tuple[Reals, Reals]]
    covariance: dict[str, Reals] = field(default_factory=dict)
    parameters: Mapping[str, Any] | None = None
    notes: list[str] = field(default_factory=list)

    def trajectory(self) -> Trajectory:
        """Return the parts at the times of the attitudes, made evenly spaced.  Raises ValueError."""
        times, attitudes = self._without_gaps(*self.parts[ATTITUDES])
        others = {name: part for name, part in self.parts.items() if name != ATTITUDES and
                  min(part[0][-1], times[-1]) - max(part[0][0], times[0]) > 0.5 * np.ptp(times)}
        self.notes += [f'{name}: not at the times of the attitudes, left out'
                       for name in self.parts if name not in (ATTITUDES, *others)]
        steps, even, turns = np.diff(times), times, attitudes
        if np.max(np.abs(steps - np.median(steps))) > EVEN * np.median(steps):
            even = np.linspace(times[0], times[-1], len(times))
            spline = RotationSpline(times, Rotation.from_quat(np.roll(attitudes, -1, axis=1)))
            turns = np.roll(spline(even).as_quat(), 1, axis=1)
            self.notes.append('stamps are not evenly spaced: interpolated')
        within = np.ones(len(even), bool)
        for at, _ in others.values():
            within &= (even >= at[0] - SAME_S) & (even <= at[-1] + SAME_S)
        return Trajectory.of({'attitudes': turns[within], **{
            name: np.stack([np.interp(even[within], at, column) for column in values.T], axis=1)
            for name, (at, values) in others.items()},
            'covariance': self.covariance or None}, even[within])

    def begin_at(self, time: float) -> None:
        """Count the times from this one on."""
        self.parts = {name: (at - time, values) for name, (at, values) in self.parts.items()}

    def _without_gaps(self, times: Reals, values: Reals) -> tuple[Reals, Reals]:
        steps = np.diff(times)
        ends = [0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1), len(times)]
        longest = int(np.argmax(np.diff(ends)))
        if len(ends) > 2:
            self.notes.append(f'{len(ends) - 2} gaps: only the longest part without one is used')
        return times[ends[longest]:ends[longest + 1]], values[ends[longest]:ends[longest + 1]]


def read(path: Path, topic: str | None = None) -> Recorded:
    """
    Read a file.

    topic : of the attitudes in a log; default: the first whose type has some

    Raises OSError, LogError, ImportError or ValueError, which name the file and what it lacks.
    """
    if path.is_dir() or path.suffix == '.mcap':
        recorded = _read_log(path, topic)
    elif topic is not None:
        raise ValueError(f'--topic: {path} is no MCAP file')
    elif path.suffix in READERS:
        if not path.stat().st_size:
            raise ValueError(f'{path} is empty')
        recorded = _of_columns(READERS[path.suffix](path))
    else:
        raise ValueError(f'{path}: the name must end in .mcap, {", ".join(READERS)}')
    if ATTITUDES not in recorded.parts:
        raise ValueError(f'{path} has no attitudes: must have {NEEDED}')
    if len(recorded.parts[ATTITUDES][0]) < LEAST_SAMPLES:
        raise ValueError(f'{path} has {len(recorded.parts[ATTITUDES][0])} attitudes: must have '
                         f'{LEAST_SAMPLES} at least')
    return recorded


# ------------------------------------------------------------------------------------- tables

def _csv(path: Path) -> dict[str, Sequence[Any]]:
    lines = [line for line in path.read_text('utf-8-sig', errors='replace').splitlines()
             if line.strip()]
    comments = [line for line in lines if line.startswith('#')]
    lines = [line for line in lines if not line.startswith('#')]
    head = comments[-1].lstrip('# ') if comments else lines.pop(0)
    separator = next((mark for mark in ',;\t' if mark in head), None)
    names = [name.strip().strip('"') for name in head.split(separator)]
    rows = [line.split(separator) for line in lines]
    if not rows or any(len(row) != len(names) for row in rows[:-1]):
        raise ValueError(f'{path}: must have a line with the names of the columns, then lines '
                         'with as many numbers')
    rows = [row for row in rows if len(row) == len(names)]      # the last may be cut off
    return dict(zip(names, zip(*rows, strict=True), strict=True))


def _parquet(path: Path) -> dict[str, Sequence[Any]]:
    with needed('a Parquet file', 'parquet'):
        from pyarrow import ArrowException, parquet  # noqa: PLC0415
    try:
        table = parquet.read_table(path)
    except ArrowException as error:
        raise ValueError(f'{path}: {" ".join(str(error).split())}') from error
    return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}


def _npz(path: Path) -> dict[str, Sequence[Any]]:
    columns: dict[str, Sequence[Any]] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name, values in arrays.items():
                if values.ndim == 2 and values.shape[1] in (3, 4):
                    # `Trajectory.attitudes` are w, x, y, z, `States.quaternion` x, y, z, w.
                    order = 'xyz' if values.shape[1] == 3 else (
                        'wxyz' if name == ATTITUDES else 'xyzw')
                    columns.update((f'{name}_{part}', values[:, k])
                                   for k, part in enumerate(order))
                elif values.ndim == 1:
                    columns[name] = values
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f'{path} is no file of numpy.savez: {error}') from error
    return columns


READERS = {'.csv': _csv, '.txt': _csv, '.tum': _csv, '.parquet': _parquet, '.npz': _npz}
NEEDED = ('columns such as t, qw, qx, qy, qz or phi, theta, psi, or one of the types of messages '
          'that docs/grade.md lists')


def _words(name: str) -> tuple[list[str], str]:
    """Return the words of the name of a column, the last being its component, and its unit."""
    bare, _, unit = name.partition('[')
    bare = re.sub('([a-z])([A-Z])', r'\1_\2', bare).lower()
    words = [word for word in re.split('[^a-z0-9]+', bare) if word]
    if len(words) > 1 and words[-1] in {*UNITS, *SECONDS, 's', 'rad'}:
        unit = unit or words.pop()
    if words and words[-1] not in (*TIMES, 'omega') and len(words[-1]) > 1 and (
            words[-1][-1] in 'wxyz123') and words[-1][:-1] in set().union(*WORDS.values()):
        words[-1:] = [words[-1][:-1], words[-1][-1]]       # qw, accx
    return words, re.split('[^a-z]', unit.lower().strip())[0]


def _of_columns(columns: Mapping[str, Sequence[Any]]) -> Recorded:
    """Return the parts that columns with these names make."""
    stamps: dict[str, Sequence[Any]] = {}
    groups: dict[tuple[str, str], dict[str, Reals]] = defaultdict(dict)
    for name, cells in columns.items():
        words, unit = _words(name)
        said, last = set(words), words[-1] if words else ''
        if said & TIMES or last in SECONDS or last in ('sec', 'secs'):
            stamps[unit if unit in SECONDS else last if last in SECONDS else 's'] = cells
            continue
        kind, component = _kind(words)
        if kind:
            group = groups[kind, ' '.join(words[:-1]) if kind != ANGLES else '']
            group.setdefault(component, UNITS.get(unit, 1.0) * _numbers(cells))
    if not stamps:
        raise ValueError(f'no column of times among {", ".join(map(str, columns))}: must be t, '
                         'time or timestamp')
    times = _seconds(stamps)
    parts: dict[str, tuple[Reals, Reals]] = {}
    for (kind, _), group in groups.items():
        order = {ATTITUDES: 'wxyz', ANGLES: 'abc'}.get(kind, 'xyz')
        if any(part not in group for part in order):
            continue
        values = np.stack([group[part] for part in order], axis=1)
        known = np.all(np.isfinite(values), axis=1) & np.isfinite(times)
        at, first = np.unique(times[known], return_index=True)
        if len(at):
            _add(parts, kind, at, values[known][first])
    if RATES in parts and ACCELERATIONS in parts and GYROSCOPE not in parts:
        parts[GYROSCOPE] = parts.pop(RATES)         # wx .. az are those of an IMU
    return Recorded(parts)


def _kind(words: Sequence[str]) -> tuple[str, str]:
    """Return to what a column belongs, '' if to nothing, and its component."""
    said, last = set(words[:-1]), words[-1] if words else ''
    for component, names in zip('abc', ANGLE_WORDS, strict=True):
        if names & {*words} and not {'dot', 'rate', 'velocity', 'vel'} & {*words}:
            return ANGLES, component
    component = {'1': 'x', '2': 'y', '3': 'z'}.get(last, last)
    if component not in ('w', 'x', 'y', 'z') or (said & OTHER_WORDS - {'velocity'}) or (
            words[0] == 'b' and len(words) > 2):
        return '', ''
    if not said:
        return ATTITUDES, component
    for kind, names in WORDS.items():
        if said & names and not (kind == ACCELERATIONS and 'angular' in said):
            return (GYROSCOPE if kind == RATES and 'imu' in said else kind), component
    if 'linear' in said and 'velocity' not in said:
        return ACCELERATIONS, component
    return '', ''


def _numbers(cells: Sequence[Any]) -> Reals:
    def number(cell: Any) -> float:
        try:
            return float(cell)
        except (TypeError, ValueError):         # an empty cell
            return math.nan
    return np.array([number(cell) for cell in cells])


def _seconds(stamps: Mapping[str, Sequence[Any]]) -> Reals:
    """Return times [s], from the first one on if that is a date; by columns of these units."""
    def number(cell: Any) -> Decimal:
        try:
            return Decimal(str(cell).strip())
        except InvalidOperation:
            return Decimal('NaN')
    wide = 's' if 's' in stamps else next(iter(stamps))
    whole = stamps.get('sec', stamps.get('secs', stamps[wide]))
    times = [number(cell) for cell in whole]
    unit = Decimal(SECONDS.get(wide, '1'))
    for fine in ('nanosec', 'nsec') if {'sec', 'secs'} & {*stamps} else ():
        if fine in stamps:
            times = [a + number(b) * Decimal('1e-9')
                     for a, b in zip(times, stamps[fine], strict=True)]
    first = next((one for one in times if one.is_finite()), Decimal(0))
    if unit == 1 and abs(first) > 10 ** 11:         # a date in s is less
        unit = Decimal(10) ** (-3 * round((first.adjusted() - 9) / 3))
    begin = first if abs(first * unit) > LATEST_START_S else Decimal(0)
    return np.array([float((one - begin) * unit) for one in times])


def _add(parts: dict[str, tuple[Reals, Reals]], kind: str, times: Reals, values: Reals) -> None:
    """Add a part; the first of each name stays.  Angles become attitudes."""
    if kind == ANGLES:
        turns = Rotation.from_euler('ZYZ', values).as_quat()
        kind, values = ATTITUDES, np.roll(turns, 1, axis=1)
    parts.setdefault(kind, (times, values))


# --------------------------------------------------------------------------------------- logs

def _imu(message: Any) -> dict[str, Sequence[float]]:
    found = {GYROSCOPE: _xyz(message.angular_velocity),
             ACCELERATIONS: _xyz(message.linear_acceleration)}
    if message.orientation_covariance[0] != -1.0 and message.orientation.w ** 2 + sum(
            part * part for part in _xyz(message.orientation)) > 0.5:
        found[ATTITUDES] = _wxyz(message.orientation)
    return found


def _joints(message: Any) -> dict[str, Sequence[float]]:
    angles = {component: value for name, value in zip(message.name, message.position, strict=False)
              for component, names in zip('abc', ANGLE_WORDS, strict=True)
              if names & {*_words(name)[0]}}
    return {ANGLES: [angles[part] for part in 'abc']} if len(angles) == 3 else {}


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _wxyz(q: Any) -> list[float]:
    return [q.w, q.x, q.y, q.z]


# By type, in the order of preference for attitudes: the parts in a message.
MESSAGES = {
    'geometry_msgs/msg/PoseStamped': lambda m: {ATTITUDES: _wxyz(m.pose.orientation)},
    'geometry_msgs/msg/PoseWithCovarianceStamped':
        lambda m: {ATTITUDES: _wxyz(m.pose.pose.orientation)},
    'nav_msgs/msg/Odometry': lambda m: {ATTITUDES: _wxyz(m.pose.pose.orientation),
                                        RATES: _xyz(m.twist.twist.angular)},
    'geometry_msgs/msg/QuaternionStamped': lambda m: {ATTITUDES: _wxyz(m.quaternion)},
    'sensor_msgs/msg/JointState': _joints,
    'tf2_msgs/msg/TFMessage': lambda m: {ATTITUDES: _wxyz(m.transforms[0].transform.rotation)},
    'sensor_msgs/msg/Imu': _imu,
    'sensor_msgs/msg/MagneticField': lambda m: {MAGNETOMETER: _xyz(m.magnetic_field)}}
COVARIANCES = {GYROSCOPE: 'angular_velocity_covariance',
               ACCELERATIONS: 'linear_acceleration_covariance'}
NOT_OF_BODY = ('imu_odom', 'imu_bias')      # of this package


def _read_log(path: Path, wanted: str | None) -> Recorded:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 0.3 s

    store = get_typestore(Stores.ROS2_JAZZY)
    recorded, found = Recorded({}), defaultdict(lambda: defaultdict(list))
    with LogReader(path) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics
                 if topic.type_name in MESSAGES and not topic.name.endswith(NOT_OF_BODY)}
        if wanted is not None and wanted not in types:
            raise ValueError(f'{path} has no topic {wanted} with attitudes; it has '
                             f'{", ".join(types) or "none"}')
        end_ns = 1 << 63
        with contextlib.suppress(recorded_run.ForeignLogError):
            run = recorded_run.read_run_description(reader)
            recorded.parameters, origin_ns = run.values_in_effect, run.epoch_ns
            end_ns = next((event.stamp_ns for event in run.events if event.name != 'start'), end_ns)
        if not reader.whole:
            recorded.notes.append('the log is truncated: read as far as it goes')
        for message in reader.messages(types, end=end_ns):
            try:
                content = store.deserialize_cdr(message.data, types[message.topic])
                stamp = getattr(content, 'transforms', [content])[0].header.stamp
                stamp_ns = stamp.sec * 10 ** 9 + stamp.nanosec or message.log_time
                for kind, values in MESSAGES[types[message.topic]](content).items():
                    found[message.topic][kind].append((stamp_ns, values))
                    if kind in COVARIANCES and not found[message.topic][kind][1:]:
                        recorded.covariance[kind] = getattr(
                            content, COVARIANCES[kind]).reshape(3, 3)
            except Exception as error:
                raise LogError(f'cannot read {path}: a message of {message.topic} is no '
                               f'{types[message.topic]}: {error}') from error
    if recorded.parameters is None:
        origin_ns = min((rows[0][0] for kinds in found.values() for rows in kinds.values()),
                        default=0)
        origin_ns = origin_ns if origin_ns > LATEST_START_S * 1e9 else 0
    order = list(MESSAGES)
    for name in sorted(found, key=lambda name: (name != wanted, order.index(types[name]), name)):
        for kind, rows in found[name].items():
            stamps, first = np.unique([row[0] for row in rows], return_index=True)
            _add(recorded.parts, kind, (stamps - origin_ns) * 1e-9,
                 np.array([rows[k][1] for k in first], float))
    return recorded
