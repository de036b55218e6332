# SPDX-License-Identifier: Apache-2.0
"""
Reads the motions of other programs: ROS 2 logs (MCAP), and tables (CSV, Parquet, npz).

The fields of messages are columns like those of tables.  docs/grade_files.md lists the types of
messages and the names of columns that are understood.
"""

import contextlib
import csv
import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.messages import EXACT_VARIANCE
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.foreign_messages import NO_ORIENTATION, deserialized

ATTITUDES, GYROSCOPE, RATES = 'attitudes', 'gyroscope', 'rates'
ACCELERATIONS, MAGNETOMETER, ANGLES = 'accelerations', 'magnetometer', 'angles'
# Words in the name of a column, before its component.
WORDS = {
    ATTITUDES: {'q', 'qpos', 'quat', 'quaternion', 'orientation', 'attitude', 'attitudes',
                'rotation'},
    GYROSCOPE: {'g', 'gyro', 'gyr', 'gyroscope'},
    ACCELERATIONS: {'a', 'acc', 'accel', 'acceleration', 'accelerations', 'accelerometer'},
    RATES: {'w', 'omega', 'rate', 'rates', 'angular'},
    MAGNETOMETER: {'m', 'mag', 'magnetic', 'magnetometer'}}
ANGLE_WORDS = {'phi': 'a', 'precession': 'a', 'theta': 'b', 'nutation': 'b', 'psi': 'c',
               'spin': 'c'}
COMPONENTS = {'w': 'w', 'x': 'x', 'y': 'y', 'z': 'z', '0': 'w', '1': 'x', '2': 'y', '3': 'z'}
OTHERS = {'dot', 'bias', 'b', 'covariance', 'cov', 'std', 'error'}
TIMES = {'t', 'time', 'times', 'timestamp', 'stamp'}
WHOLE = 'sec', 'secs'               # of a stamp in two columns, and what is beside it
REST = 'nanosec', 'nanosecs', 'nsec', 'nsecs'
SECONDS = {'': '1', 's': '1', 'ms': '1e-3', 'us': '1e-6', 'ns': '1e-9',
           **dict.fromkeys(WHOLE, '1'), **dict.fromkeys(REST, '1e-9')}
_DEG, _G = math.pi / 180.0, 9.80665
_ANGLE = {'': 1.0, 'rad': 1.0, 'mrad': 1e-3, 'deg': _DEG}
_RATE = {**_ANGLE, 'rad/s': 1.0, 'mrad/s': 1e-3, 'deg/s': _DEG, 'dps': _DEG}
# By part, units that the name of a column may tell; their letters and exponents count.
UNITS = {
    ATTITUDES: {'': 1.0}, ANGLES: _ANGLE, GYROSCOPE: _RATE, RATES: _RATE,
    ACCELERATIONS: {'': 1.0, 'm/s^2': 1.0, 'm/s/s': 1.0, 'g': _G, 'mg': 1e-3 * _G},
    MAGNETOMETER: {'': 1.0, 'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7,
                   'gauss': 1e-4}}
SIGNS = str.maketrans({'µ': 'u', 'μ': 'u', '°': 'deg', '⁻': '-', '¹': '1', '²': '2', '³': '3'})
SUFFIXES = {'rad', 'deg', 'dps', *SECONDS} - {''}       # units without brackets
# In the order of preference.
MESSAGES = [f'{package}/msg/{name}' for package, name in (
    ('geometry_msgs', 'PoseStamped'), ('geometry_msgs', 'PoseWithCovarianceStamped'),
    ('nav_msgs', 'Odometry'), ('geometry_msgs', 'QuaternionStamped'), ('geometry_msgs', 'Pose'),
    ('geometry_msgs', 'TransformStamped'), ('sensor_msgs', 'JointState'),
    ('tf2_msgs', 'TFMessage'), ('sensor_msgs', 'Imu'), ('sensor_msgs', 'MagneticField'))]
COVARIANCES = {GYROSCOPE: 'angular_velocity_covariance',
               ACCELERATIONS: 'linear_acceleration_covariance'}
NOT_OF_BODY = ('imu_odom', 'imu_bias', 'imu/dq')    # topics of this package
TUM = 'timestamp tx ty tz qx qy qz qw'      # of a file that does not name its columns
NEEDED = ('columns such as t, qw, qx, qy, qz or phi, theta, psi, or messages of a type that '
          'docs/grade_files.md lists')
LEAST_SAMPLES = 50
LATEST_START_S = 1.0        # an earlier first stamp counts from the start, a later one is a date

Reals = NDArray[np.float64]
Table = Mapping[str, Sequence[Any]]
Part = tuple[Reals, Sequence[str]]      # values (n, k), and the names of their columns


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,), ascending [s], and values (n, k) by name: attitudes, q(world <- body) as
        w, x, y, z; rates, in the body; gyroscope, accelerations and magnetometer of the IMU
    covariance : (3, 3) that the first message of an IMU tells, by name
    parameters : of the run, if the file tells them, as `parameters.checked` returns them
    sources : table or columns of each part, by name
    notes : what was chosen or left out
    """

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    covariance: dict[str, Reals] = field(default_factory=dict)
    parameters: Mapping[str, Any] | None = None
    sources: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, tables: Mapping[str, Table], origin: Decimal | None = None) -> None:
        """Add what is in tables, the first of each kind; `origin` is the stamp of t = 0 [s]."""
        read = {name: _parts(columns) for name, columns in tables.items()}
        if origin is None:
            origin = min((one for stamps, _ in read.values() for one in stamps
                          if one.is_finite()), default=Decimal(0))
            origin = origin if abs(origin) > LATEST_START_S else Decimal(0)
        for name, (stamps, parts) in read.items():
            times = (stamps - origin).astype(float)
            for kind, (values, names) in parts.items():
                known = np.isfinite(times) & np.all(np.isfinite(values), axis=1)
                at, first = np.unique(times[known], return_index=True)
                if len(at) and kind not in self.parts:
                    self.parts[kind] = at, values[known][first]
                    source = self.sources[kind] = name or ', '.join(names)
                    self.notes.append(f'{kind} of {source}: {len(at)} from {at[0]:.6g} to '
                                      f'{at[-1]:.6g} s')


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
        recorded = Recorded()
        try:
            recorded.add({'': READERS[path.suffix](path)})
        except (ValueError, EOFError) as error:
            raise ValueError(f'{path}: {" ".join(str(error).split())}') from error
    times, attitudes = recorded.parts.get(ATTITUDES, (np.empty(0), np.empty((0, 4))))
    if len(times) < LEAST_SAMPLES:
        raise ValueError(f'{path} has {len(times) or "no"} attitudes: must have {LEAST_SAMPLES} '
                         f'at least; from {NEEDED}')
    for at in times[~np.any(attitudes, axis=1)][:1]:
        raise ValueError(f'{path}: the attitude at {at:.9g} s is 0, 0, 0, 0: must be a unit '
                         'quaternion')
    return recorded


# ------------------------------------------------------------------------------------- tables

def _csv(path: Path) -> Table:
    text = path.read_text('utf-8-sig', errors='replace')
    filled = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in filled if not line.startswith('#')] or ['']
    mark = next((mark for mark in ';\t,' if mark in lines[0]), ' ')
    if mark == ';':                                 # with decimal commas
        lines = [line.replace(',', '.') for line in lines]
    split = partial(csv.reader, delimiter=mark, skipinitialspace=True)
    names, *rows = split(lines)
    if re.match('[-+.0-9]', lines[0]):              # no names: those of a comment, or of TUM
        rows = [names, *rows]
        comments = [line.lstrip('# ') for line in filled if line.startswith('#')]
        named = filter(lambda head: len(head) == len(rows[0]), split([*reversed(comments), TUM]))
        names = next(named, names)
    return _columns(names, rows)


def _columns(names: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    whole = [row for row in rows if len(row) == len(names)]
    if len(whole) < max(len(rows) - 1, 1):      # the last may be cut off
        raise ValueError('must have a line with the names of columns, then lines with as many '
                         'values')
    return dict(zip(names, zip(*whole, strict=True), strict=True))


def _parquet(path: Path) -> Table:
    with needed('a Parquet file', 'parquet'):
        from pyarrow import parquet  # noqa: PLC0415
    table = parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def _npz(path: Path) -> Table:
    columns: dict[str, Sequence[Any]] = {}
    if not is_zipfile(path):
        raise ValueError('it is no file of numpy.savez')
    with np.load(path, allow_pickle=False) as arrays:
        for name, values in arrays.items():
            # `Trajectory.attitudes` are w, x, y, z, `States.quaternion` x, y, z, w.
            order = 'wxyz' if name == ATTITUDES else 'xyzw'
            if values.ndim == 2:
                columns.update((f'{name}_{part}', column) for part, column in zip(
                    order, values.T, strict=False))
            elif values.ndim == 1:
                columns[name] = values
    return columns


READERS = {'.csv': _csv, '.txt': _csv, '.tum': _csv, '.parquet': _parquet, '.npz': _npz}


def _words(name: str) -> tuple[list[str], str]:
    """Return the words of the name of a column, the last being its component, and its unit."""
    bare, _, unit = name.partition('[')
    words = re.findall('[a-z]+|[0-9]+', re.sub('([a-z])([A-Z])', r'\1_\2', bare).lower())
    if words and words[-1] in (SUFFIXES if words[1:] else WHOLE + REST):
        unit = words.pop()
    if words and words[-1][-1] in 'wxyz' and words[-1][:-1] in set().union(*WORDS.values()):
        words[-1:] = words[-1][:-1], words[-1][-1]      # qw, accx
    return words, unit.partition(']')[0]


def _kind(words: Sequence[str]) -> tuple[str, str]:
    """Return to what a column belongs, '' if to nothing, and its component."""
    said, component = {*words[:-1]}, COMPONENTS.get(words[-1], '') if words else ''
    if said & OTHERS:
        return '', ''
    if angles := [ANGLE_WORDS[word] for word in words if word in ANGLE_WORDS]:
        return ('', '') if {'dot', 'rate', 'velocity'} & {*words} else (ANGLES, angles[0])
    for kind, names in WORDS.items():
        if component and said & names and not (kind == ACCELERATIONS and 'angular' in said):
            return (GYROSCOPE if kind == RATES and 'imu' in said else kind), component
    return '', ''


def _parts(columns: Table) -> tuple[NDArray[np.object_], dict[str, Part]]:
    """Return stamps (n,), decimals [s], and the parts that these columns make."""
    stamps: dict[str, dict[str, Sequence[Any]]] = defaultdict(dict)     # by clock and unit
    groups: dict[tuple[str, str], dict[str, tuple[Reals, str]]] = defaultdict(dict)
    for name, cells in columns.items():
        words, unit = _words(name)
        kind, component = _kind(words)
        if TIMES & {*words} or unit in WHOLE + REST:
            stamps[' '.join(words)].setdefault(_unit(name, unit, SECONDS), cells)
        elif kind:
            factor = UNITS[kind][_unit(name, unit, UNITS[kind])]
            groups[kind, '' if kind == ANGLES else ' '.join(words[:-1])].setdefault(
                component, (factor * np.array([_number(cell) for cell in cells]), name))
    if not stamps:
        raise ValueError(f'no column of times among {", ".join(columns)}: must be t, time, '
                         'timestamp or stamp')
    parts: dict[str, Part] = {}
    for (kind, _), group in groups.items():
        order = {ATTITUDES: 'wxyz', ANGLES: 'abc'}.get(kind, 'xyz')
        if group.keys() >= {*order}:
            parts.setdefault(kind, (np.stack([group[part][0] for part in order], axis=1),
                                    [group[part][1] for part in order]))
    if ANGLES in parts:
        angles, names = parts.pop(ANGLES)
        turns = Rotation.from_euler('ZYZ', np.nan_to_num(angles))
        known = np.isfinite(np.sum(angles, axis=1, keepdims=True))
        parts.setdefault(ATTITUDES, (
            np.where(known, np.roll(turns.as_quat(), 1, axis=1), np.nan), names))
    if {RATES, ACCELERATIONS} <= parts.keys() and GYROSCOPE not in parts:
        parts[GYROSCOPE] = parts.pop(RATES)     # wx .. az are those of an IMU
    return _seconds(next(iter(stamps.values()))), parts


def _unit(name: str, unit: str, known: Collection[str]) -> str:
    """Return the known unit that is spelled like `unit`; `name` is that of the column."""
    def spelled(text: str) -> str:      # without signs between, an exponent of -1, and the unit 1
        return re.sub('-1(?![0-9])|^1$|[^a-z0-9\ufffd]', '', text.translate(SIGNS).lower())

    for one in known:
        if spelled(one) == spelled(unit):
            return one
    allowed = ', '.join([*filter(None, known), 'or missing']).removeprefix('or ')
    raise ValueError(f'{name}: the unit must be {allowed}')


def _number(cell: Any) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):     # an empty cell, a word
        return math.nan


def _decimal(cell: Any) -> Decimal:
    with contextlib.suppress(InvalidOperation):
        return Decimal(str(cell).strip())
    with contextlib.suppress(ValueError):       # a date as text
        return Decimal(int(np.datetime64(str(cell).strip(), 'ns').astype(int))) / 10 ** 9
    return Decimal('NaN')


def _seconds(stamps: Mapping[str, Sequence[Any]]) -> NDArray[np.object_]:
    """Return stamps (n,), decimals [s], of the columns of a clock by their unit."""
    unit = min(stamps, key=lambda unit: unit not in WHOLE)      # else the first
    times = np.array([_decimal(cell) for cell in stamps[unit]], object)
    for rest in stamps.keys() & REST if unit in WHOLE else ():
        times += [_decimal(part) * Decimal('1e-9') for part in stamps[rest]]
    scale = Decimal(SECONDS[unit])
    first = min((one for one in times if one.is_finite()), default=Decimal(0))
    if scale == 1 and first > 10 ** 11:         # a date in ms, us or ns: in s it has ten digits
        scale = Decimal(10) ** (-3 * round((first.adjusted() - 9) / 3))
    return times * scale


# --------------------------------------------------------------------------------------- logs

def _read_log(path: Path, wanted: str | None) -> Recorded:
    recorded, origin, end_ns = Recorded(), None, 1 << 63
    with LogReader(path) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics
                 if topic.type_name in MESSAGES}
        if wanted is not None and wanted not in types:
            raise ValueError(f'{path} has no topic {wanted} with attitudes; it has '
                             f'{", ".join(types) or "none"}')
        with contextlib.suppress(recorded_run.ForeignLogError):
            run = recorded_run.read_run_description(reader)
            recorded.parameters, origin = run.values_in_effect, Decimal(run.epoch_ns) / 10 ** 9
            end_ns = next((one.stamp_ns for one in run.events if one.event.kind != 'start'), end_ns)
            types = {name: kind for name, kind in types.items()
                     if name == wanted or not name.endswith(NOT_OF_BODY)}
        if not reader.whole:
            recorded.notes.append('the log is truncated: read as far as it goes')
        tables, first = _log_tables(reader, types, end_ns)
    chosen = sorted(tables, key=lambda one: (
        one[0] != wanted, _rests(tables[one]), one[0].endswith(NOT_OF_BODY),
        MESSAGES.index(types[one[0]]), one))
    recorded.add({' '.join(filter(None, one)): tables[one] for one in chosen}, origin)
    for topic, message in first.items():
        recorded.covariance.update((kind, matrix) for kind, matrix in _covariances(message)
                                   if recorded.sources.get(kind) == topic)
    return recorded


def _rests(table: Table) -> bool:
    """Return whether nothing in it changes, such as a fixed frame among transforms."""
    return all(len({*cells}) == 1 for name, cells in table.items() if name != 'stamp_ns')


def _covariances(message: Any) -> Iterator[tuple[str, Reals]]:
    for kind, name in COVARIANCES.items():
        matrix = np.reshape(getattr(message, name, -np.ones(9)), (3, 3))
        # -1: there are no such readings.  The smallest variance means exact, none of noise.
        if matrix[0, 0] >= 0.0 and not 0.0 < np.max(matrix) <= EXACT_VARIANCE:
            yield kind, matrix


def _log_tables(reader: LogReader, types: Mapping[str, str], end_ns: int,
                ) -> tuple[dict[tuple[str, str], Table], dict[str, Any]]:
    """Return tables by topic and, of transforms, frame; and the first message of each topic."""
    tables: dict[tuple[str, str], Any] = defaultdict(lambda: defaultdict(list))
    first: dict[str, Any] = {}
    for topic, log_time, content in _contents(reader, types, end_ns):
        frame = content.child_frame_id if hasattr(content, 'transform') else ''
        first.setdefault(topic, content)
        table, stamp_ns = tables[topic, frame], 0
        if hasattr(content, 'header'):
            stamp_ns = content.header.stamp.sec * 10 ** 9 + content.header.stamp.nanosec
        table['stamp_ns'].append(stamp_ns or log_time)
        for name, value in _fields(content):
            table[name].append(value)
    return tables, first


def _contents(reader: LogReader, types: Mapping[str, str],
              end_ns: int) -> Iterator[tuple[str, int, Any]]:
    """Yield topics, log times and messages, or transforms in them.  Raises LogError."""
    for message in reader.messages(types, end=end_ns):
        try:
            content = deserialized(message.data, types[message.topic])
        except ValueError as error:
            raise LogError(f'cannot read {reader.path}: a message of {message.topic} is '
                           f'{error}') from error
        for one in getattr(content, 'transforms', [content]):
            yield message.topic, message.log_time, one


def _fields(message: Any, prefix: str = '') -> Iterator[tuple[str, float]]:
    """Yield the names and values of the numbers in a message; of joints those of the positions."""
    if hasattr(message, 'position') and hasattr(message, 'effort'):
        yield from zip(message.name, message.position.tolist(), strict=False)
        return
    first_variance = getattr(message, 'orientation_covariance', (0.0,))[0]
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if isinstance(value, float):
            yield prefix + name, value
        elif hasattr(value, '__dataclass_fields__') and not (
                name == 'orientation' and first_variance == NO_ORIENTATION):
            yield from _fields(value, f'{prefix}{name}.')
