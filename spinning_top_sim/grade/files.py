# SPDX-License-Identifier: Apache-2.0
"""
Reads trajectories that exist: ROS 2 logs (MCAP), and tables (CSV, Parquet, npz).

docs/grade_files.md lists the types of messages and the names of columns that are understood.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from spinning_top_sim.grade.fit import EXACT, LARGEST, whiteness
from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.grade.trajectory import LEAST_SAMPLES, Trajectory
from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams.messages import EXACT_VARIANCE
from spinning_top_sim.tools import recorded_run

ATTITUDES, GYROSCOPE, RATES = 'attitudes', 'gyroscope', 'rates'
ACCELERATIONS, MAGNETOMETER, ANGLES = 'accelerations', 'magnetometer', 'angles'
# Words in the name of a column, before its component.
WORDS = {
    ATTITUDES: {'q', 'quat', 'quaternion', 'orientation', 'attitude', 'attitudes', 'rotation'},
    GYROSCOPE: {'gyro', 'gyr', 'gyroscope'},
    ACCELERATIONS: {'a', 'acc', 'accel', 'acceleration', 'accelerations', 'accelerometer'},
    RATES: {'w', 'omega', 'rate', 'rates', 'angular'},
    MAGNETOMETER: {'m', 'mag', 'magnetic', 'magnetometer'}}
ANGLE_WORDS = {'phi': 'a', 'precession': 'a', 'theta': 'b', 'nutation': 'b', 'psi': 'c',
               'spin': 'c'}
COMPONENTS = {'w': 'w', 'x': 'x', 'y': 'y', 'z': 'z', '1': 'x', '2': 'y', '3': 'z'}
OTHERS = {'dot', 'bias', 'b', 'covariance', 'cov', 'std', 'error'}
TIMES = {'t', 'time', 'times', 'timestamp', 'stamp'}
SECONDS = {'nanosec': '1e-9', 'nsec': '1e-9', 'ns': '1e-9', 'us': '1e-6', 'ms': '1e-3'}
UNITS = {'deg': math.pi / 180.0, 'dps': math.pi / 180.0}
NEEDED = ('columns such as t, qw, qx, qy, qz or phi, theta, psi, or messages of a type that '
          'docs/grade_files.md lists')
SAME_S = 1e-6               # between two stamps of one time
EVEN = 1e-4                 # share of the interval by which evenly spaced samples may be off
GAP = 2.5                   # intervals that are a gap
DEGREE = 5                  # of the splines between samples
COARSE = 0.5                # turned from one sample to the next [rad]: derivatives fail
LATEST_START_S = 1.0        # an earlier first stamp counts from the start, a later one is a date


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,) [s] and values (n, k) by the names of `Trajectory`
    covariance : (3, 3) that the first message of an IMU tells, by name
    parameters : of the run, if the file tells them, as `parameters.checked` returns them
    notes : what was chosen or left out
    """

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    covariance: dict[str, Reals] = field(default_factory=dict)
    parameters: Mapping[str, Any] | None = None
    notes: list[str] = field(default_factory=list)

    def add(self, kind: str, times: Reals, values: Reals) -> bool:
        """Add rows in any order, unless there are some; return whether they were added."""
        known = np.isfinite(times) & np.all(np.isfinite(values), axis=1)
        at, first = np.unique(times[known], return_index=True)
        if kind == ANGLES:
            kind, values = ATTITUDES, np.roll(Rotation.from_euler('ZYZ', values).as_quat(), 1, 1)
        added = bool(len(at)) and kind not in self.parts
        if added:
            self.parts[kind] = at, values[known][first]
        return added

    def begin_at(self, time: float) -> None:
        """Count the times from this one on."""
        self.parts = {name: (at - time, values) for name, (at, values) in self.parts.items()}

    def trajectory(self, motion: ExactSolution) -> Trajectory:
        """
        Return all parts at the times of the one with most samples, made evenly spaced.

        motion : about which attitudes are interpolated; white noise about it is taken away
        """
        parts, notes = {}, self.notes
        for name, (at, values) in self.parts.items():
            steps = np.diff(at)
            ends = np.array([0, *(np.flatnonzero(steps > GAP * np.median(steps)) + 1), len(at)])
            longest = slice(*ends[np.argmax(np.diff(ends)):][:2])
            if len(ends) > 2:
                notes.append(f'{name}: the longest part without a gap is used')
            parts[name] = at[longest], values[longest]
        times, attitudes = parts[ATTITUDES]
        for name in [*parts]:
            shared = min(parts[name][0][-1], times[-1]) - max(parts[name][0][0], times[0])
            if shared < 0.5 * np.ptp(times):
                notes.append(f'{name}: not at the times of the attitudes, left out')
                del parts[name]
        begin = max(at[0] for at, _ in parts.values()) - SAME_S
        end = min(at[-1] for at, _ in parts.values()) + SAME_S
        grid = max((at[(at >= begin) & (at <= end)] for at, _ in parts.values()), key=len)
        even = np.linspace(grid[0], grid[-1], len(grid))
        if np.max(np.abs(even - grid)) < EVEN * (even[1] - even[0]):
            even = grid
        else:
            notes.append('stamps are not evenly spaced: interpolated')
        error = _turns(motion, times).inv() * Rotation.from_quat(np.roll(attitudes, -1, axis=1))
        level, white = whiteness(error.as_rotvec().T)
        turns = _turns(motion, even)
        if white and EXACT < level < LARGEST:
            notes.append(f'the attitudes are exact but for noise of {level:.3g} rad: graded '
                         'without it')
        elif np.array_equal(even, times):
            turns = Rotation.from_quat(np.roll(attitudes, -1, axis=1))
        else:
            turns = turns * RotationSpline(times, error)(even)
        made = {name: make_interp_spline(at, values, DEGREE)(even)
                for name, (at, values) in parts.items() if name != ATTITUDES}
        angle = float(abs(motion.start.l3 / motion.top.lambda3)) * (even[1] - even[0])
        if angle > COARSE and made:
            notes.append(f'the spin is {angle:.2g} rad from one sample to the next: too much to '
                         'compare readings')
            made = {}
        return Trajectory.of({ATTITUDES: np.roll(turns.as_quat(), 1, axis=1), **made,
                              'covariance': self.covariance or None}, even)


def _turns(motion: ExactSolution, times: Reals) -> Rotation:
    return Rotation.from_quat(motion.states_at_seconds(times).quaternion)


def read(path: Path, topic: str | None = None) -> Recorded:
    """
    Read a file.

    topic : of the attitudes in a log; default: the first whose type has some

    Raises OSError, LogError, ImportError or ValueError, which name the file and what it lacks.
    """
    if path.is_dir() or path.suffix == '.mcap':
        recorded = _read_log(path, topic)
    elif path.suffix not in READERS or topic is not None:
        raise ValueError(f'{path}: the name must end in .mcap' + (
            f', {", ".join(READERS)}' if topic is None else ' where --topic is given'))
    elif not path.stat().st_size:
        raise ValueError(f'{path} is empty')
    else:
        try:
            recorded = _of_columns(READERS[path.suffix](path))
        except (ValueError, EOFError) as error:
            raise ValueError(f'{path}: {" ".join(str(error).split())}') from error
    found = len(recorded.parts.get(ATTITUDES, ((), ()))[0])
    if found < LEAST_SAMPLES:
        raise ValueError(f'{path} has {found or "no"} attitudes: must have {LEAST_SAMPLES} at '
                         f'least; from {NEEDED}')
    return recorded


# ------------------------------------------------------------------------------------- tables

def _csv(path: Path) -> dict[str, Sequence[Any]]:
    lines = [line for line in path.read_text('utf-8-sig', errors='replace').splitlines()
             if line.strip()]
    comments = [line for line in lines if line.startswith('#')]
    lines = [line for line in lines if not line.startswith('#')]
    head = comments[-1].lstrip('# ') if comments else lines.pop(0)
    mark = next((mark for mark in ',;\t' if mark in head), None)
    names, *rows = [line.split(mark) for line in (head, *lines)]
    whole = [row for row in rows if len(row) == len(names)]
    if len(whole) < max(len(rows) - 1, 1):      # the last may be cut off
        raise ValueError('must have a line with the names of columns, then lines with as many '
                         'values')
    return dict(zip((name.strip(' "') for name in names), zip(*whole, strict=True), strict=True))


def _parquet(path: Path) -> dict[str, Sequence[Any]]:
    with needed('a Parquet file', 'parquet'):
        from pyarrow import parquet  # noqa: PLC0415
    table = parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def _npz(path: Path) -> dict[str, Sequence[Any]]:
    columns: dict[str, Sequence[Any]] = {}
    if not is_zipfile(path):
        raise ValueError('it is no file of numpy.savez')
    with np.load(path, allow_pickle=False) as arrays:
        for name, values in arrays.items():
            # `Trajectory.attitudes` are w, x, y, z, `States.quaternion` x, y, z, w.
            order = 'wxyz' if name == ATTITUDES else 'xyzw'
            columns.update({name: values} if values.ndim == 1 else {
                f'{name}_{part}': one for part, one in zip(order, values.T, strict=False)})
    return columns


READERS = {'.csv': _csv, '.txt': _csv, '.tum': _csv, '.parquet': _parquet, '.npz': _npz}


def _words(name: str) -> tuple[list[str], str]:
    """Return the words of the name of a column, the last being its component, and its unit."""
    bare, _, unit = name.partition('[')
    words = re.findall('[a-z]+|[0-9]+', re.sub('([a-z])([A-Z])', r'\1_\2', bare).lower())
    if len(words) > 1 and words[-1] in {*UNITS, *SECONDS, 's', 'rad'}:
        unit = unit or words.pop()
    if words and words[-1][-1] in 'wxyz' and words[-1][:-1] in set().union(*WORDS.values()):
        words[-1:] = words[-1][:-1], words[-1][-1]      # qw, accx
    return words, re.split('[^a-z]', unit.lower())[0]


def _kind(words: Sequence[str]) -> tuple[str, str]:
    """Return to what a column belongs, '' if to nothing, and its component."""
    said = {*words[:-1]}
    angle = next((ANGLE_WORDS[word] for word in words if word in ANGLE_WORDS), '')
    if OTHERS & {*words[:-1]} or (angle and {'dot', 'rate', 'velocity'} & {*words}):
        return '', ''
    component = COMPONENTS.get(words[-1], '') if words else ''
    if angle or not component:
        return (ANGLES if angle else ''), angle
    for kind, names in WORDS.items():
        if said & names and not (kind == ACCELERATIONS and 'angular' in said):
            return (GYROSCOPE if kind == RATES and 'imu' in said else kind), component
    return '', ''


def _of_columns(columns: Mapping[str, Sequence[Any]]) -> Recorded:
    """Return the parts that columns with these names make."""
    stamps: dict[str, Sequence[Any]] = {}
    groups: dict[tuple[str, str], dict[str, Reals]] = defaultdict(dict)
    for name, cells in columns.items():
        words, unit = _words(name)
        if TIMES & {*words} or words[-1:] in (['sec'], ['secs']):
            stamps.setdefault(unit if unit in SECONDS else words[-1], cells)
            continue
        kind, component = _kind(words)
        if kind:
            groups[kind, '' if kind == ANGLES else ' '.join(words[:-1])].setdefault(
                component, UNITS.get(unit, 1.0) * np.array([float(_number(one)) for one in cells]))
    if not stamps:
        raise ValueError(f'no column of times among {", ".join(columns)}: must be t, time, '
                         'timestamp or stamp')
    times, recorded = _seconds(stamps), Recorded()
    for (kind, _), group in groups.items():
        order = {ATTITUDES: 'wxyz', ANGLES: 'abc'}.get(kind, 'xyz')
        if group.keys() >= {*order}:
            recorded.add(kind, times, np.stack([group[part] for part in order], axis=1))
    if {RATES, ACCELERATIONS} <= recorded.parts.keys() and GYROSCOPE not in recorded.parts:
        recorded.parts[GYROSCOPE] = recorded.parts.pop(RATES)   # wx .. az are those of an IMU
    return recorded


def _number(cell: Any) -> Decimal:
    try:
        return Decimal(str(cell).strip())
    except InvalidOperation:        # an empty cell, a word
        return Decimal('NaN')


def _seconds(stamps: Mapping[str, Sequence[Any]]) -> Reals:
    """Return times [s] of columns by their unit; a date becomes the time since the first."""
    unit = next(iter(stamps))
    times = [_number(cell) for cell in stamps[unit]]
    scale, fine = Decimal(SECONDS.get(unit, '1')), stamps.keys() & {'nanosec', 'nsec'}
    if unit in ('sec', 'secs') and fine:
        times = [whole + _number(part) * Decimal('1e-9')
                 for whole, part in zip(times, stamps[fine.pop()], strict=True)]
    first = min((one for one in times if one.is_finite()), default=Decimal(0))
    if scale == 1 and first > 10 ** 11:         # a date in ms, us or ns: in s it has ten digits
        scale = Decimal(10) ** (-3 * round((first.adjusted() - 9) / 3))
    first = first if abs(first * scale) > LATEST_START_S else Decimal(0)
    return np.array([float((one - first) * scale) for one in times])


# --------------------------------------------------------------------------------------- logs

def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def _wxyz(q: Any) -> list[float]:
    return [q.w, q.x, q.y, q.z]


def _imu(message: Any) -> dict[str, Sequence[float]]:
    parts: dict[str, Sequence[float]] = {GYROSCOPE: _xyz(message.angular_velocity),
                                         ACCELERATIONS: _xyz(message.linear_acceleration)}
    if message.orientation_covariance[0] != -1.0 and any(_wxyz(message.orientation)):
        parts[ATTITUDES] = _wxyz(message.orientation)
    return parts


def _joints(message: Any) -> dict[str, Sequence[float]]:
    angles = {_kind(_words(name)[0])[1]: value
              for name, value in zip(message.name, message.position, strict=False)}
    return {ANGLES: [angles[part] for part in 'abc']} if angles.keys() >= {*'abc'} else {}


# By type, in the order of preference: the parts in a message.
MESSAGES: Mapping[str, Callable[[Any], Mapping[str, Sequence[float]]]] = {
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
NOT_OF_BODY = ('imu_odom', 'imu_bias')      # topics of this package


def _read_log(path: Path, wanted: str | None) -> Recorded:
    with needed('a log', 'rosbags'):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 0.3 s

    store, recorded, origin_ns, end_ns = get_typestore(Stores.ROS2_JAZZY), Recorded(), -1, 1 << 63
    covariances: dict[tuple[str, str], Reals] = {}
    found: dict[tuple[str, str], Any] = defaultdict(lambda: defaultdict(list))
    with LogReader(path) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics
                 if topic.type_name in MESSAGES and not topic.name.endswith(NOT_OF_BODY)}
        if wanted is not None and wanted not in types:
            raise ValueError(f'{path} has no topic {wanted} with attitudes; it has '
                             f'{", ".join(types) or "none"}')
        with contextlib.suppress(recorded_run.ForeignLogError):
            run = recorded_run.read_run_description(reader)
            recorded.parameters, origin_ns = run.values_in_effect, run.epoch_ns
            end_ns = next((one.stamp_ns for one in run.events if one.name != 'start'), end_ns)
        if not reader.whole:
            recorded.notes.append('the log is truncated: read as far as it goes')
        for message in reader.messages(types, end=end_ns):
            type_name = types[message.topic]
            try:
                content = store.deserialize_cdr(message.data, type_name)
                first = getattr(content, 'transforms', [content])[0]
                stamp, child = first.header.stamp, getattr(first, 'child_frame_id', '')
                parts = found[message.topic, child]
                for kind, values in MESSAGES[type_name](content).items():
                    parts[kind].append((stamp.sec * 10 ** 9 + stamp.nanosec or message.log_time,
                                        values))
            except Exception as error:      # whatever rosbags raises
                raise LogError(f'cannot read {path}: a message of {message.topic} is no '
                               f'{type_name}: {error}') from error
            if type_name.endswith('Imu') and not parts[GYROSCOPE][1:]:
                covariances.update(((message.topic, kind), getattr(content, name).reshape(3, 3))
                                   for kind, name in COVARIANCES.items())
    if origin_ns < 0:
        origin_ns = min((row[0] for parts in found.values() for rows in parts.values()
                         for row in rows), default=0)
        origin_ns = origin_ns if origin_ns > LATEST_START_S * 1e9 else 0
    order = list(MESSAGES)
    for name, child in sorted(found, key=lambda one: (
            one[0] != wanted, order.index(types[one[0]]), one)):
        for kind, rows in found[name, child].items():
            stamps_ns, values = zip(*rows, strict=True)
            if recorded.add(kind, (np.array(stamps_ns) - origin_ns) * 1e-9,
                            np.array(values, float)):
                recorded.notes.append(f'{kind} of {name}')
                matrix = covariances.get((name, kind))
                # The smallest variance means exact, and is none of noise.
                if matrix is not None and not 0.0 < np.max(np.abs(matrix)) <= EXACT_VARIANCE:
                    recorded.covariance[kind] = matrix
    return recorded
