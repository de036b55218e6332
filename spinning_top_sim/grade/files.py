# SPDX-License-Identifier: Apache-2.0
"""
Reads motions and readings from files: one table, and what EuRoC and TUM define.

Nothing is guessed: a column is what its name says in docs/grade.md, or what `--columns` says.
What is not understood is refused in one line, with what to type.
"""

import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.tools.cli import one_line

Reals = NDArray[np.float64]
Columns = Mapping[str, Sequence[Any]]
# By part of a motion: its columns in a table, what --columns may say of their unit, by name, and
# words in the names of columns that may be meant.
_ANGLE = {'rad/s': 1.0, 'mrad/s': 1e-3, 'deg/s': math.pi / 180.0, 'dps': math.pi / 180.0,
          'rpm': math.pi / 30.0}


class Kind(NamedTuple):
    """Columns of a part of a motion, factors of their units by name, and words that hint at it."""

    columns: tuple[str, ...]
    units: Mapping[str, float]
    words: str


KINDS = {
    'positions': Kind(('px', 'py', 'pz'), {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}, 'position|pos|translation|p|t'),
    'attitudes': Kind(('qx', 'qy', 'qz', 'qw'), {'1': 1.0},
                      'quaternion|quat|qpos|rotation|rot|orientation|attitude|q'),
    'gyroscope': Kind(('gx', 'gy', 'gz'), _ANGLE,
                      'gyroscope|gyro|gyr|omega|velocity|rates|rate|g|w'),
    'accelerations': Kind(('ax', 'ay', 'az'), {
        'm/s^2': 1.0, 'm/s2': 1.0, 'g': 9.80665, 'mg': 9.80665e-3, 'cm/s^2': 1e-2},
        'accelerometer|acceleration|accel|acc|a'),
    'magnetometer': Kind(('mx', 'my', 'mz'), {
        'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7},
        'magnetometer|magnetic|mag|field|m')}
TIMES = {'s': Decimal(1), 'ms': Decimal('1e-3'), 'us': Decimal('1e-6'), 'ns': Decimal('1e-9'),
         'iso': Decimal('1e-9')}        # iso: a date, which is made nanoseconds
NAMES = {'t': TIMES, **{name: kind.units for kind in KINDS.values() for name in kind.columns}}
TUM = 't px py pz qx qy qz qw'.split()
# Columns of EuRoC's state_groundtruth_estimate0 and imu0, by their names without the unit.
EUROC = {'timestamp': 't', **{f'{a}_{axis}': f'{b}{axis}' for a, b in (
    ('p_RS_R', 'p'), ('q_RS', 'q'), ('w_RS_S', 'g'), ('a_RS_S', 'a')) for axis in 'wxyz'}}
# Intervals of motions that can be graded [s]: others are those of times in another unit.
INTERVALS = 1e-5, 0.5
NORM = 1e-2             # by which the norm of a quaternion may differ from 1
LEAST_SAMPLES = 20
_SIGNS = str.maketrans({'µ': 'u', 'μ': 'u', '°': 'deg', '²': '^2'})


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,), ascending [s], and values (n, k) by names of KINDS, SI; attitudes are
        q(world <- body) as x, y, z, w
    covariance : (3, 3) that the first message of an IMU tells, by name
    first_s, origin_ns : the first stamp, of a table [s] and of a log [ns]
    run : of a log of this package, as `recorded_run` describes it
    notes : what was read, and what was not
    """

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    covariance: dict[str, Reals] = field(default_factory=dict)
    first_s: float = 0.0
    origin_ns: int = 0
    run: Any = None
    notes: list[str] = field(default_factory=list)

    def add(self, kind: str, source: str, times: Reals, values: Reals, where: str) -> None:
        """
        Add a part whose times are in seconds from the first stamp of the file.

        where : what to write of a row in errors, such as 'line {}'; rows count from 0

        Raises ValueError.
        """
        whole = np.flatnonzero(np.all(np.isfinite(values), axis=1) & np.isfinite(times))
        times, values = times[whole], values[whole]
        steps = np.diff(times)
        for at in np.flatnonzero(steps < 0.0)[:1]:
            raise ValueError(f'{where.format(whole[at + 1])}: the time goes back from '
                             f'{times[at]:.9g} to {times[at + 1]:.9g} s: one motion at a time, '
                             'in a file of its own')
        same = steps == 0.0
        for at in np.flatnonzero(same & np.any(values[1:] != values[:-1], axis=1))[:1]:
            raise ValueError(f'{where.format(whole[at + 1])}: another row of {kind} at the time '
                             f'{times[at]:.9g} s: write times with more digits')
        if np.any(same):
            self.notes.append(f'{kind}: {np.sum(same)} rows are there twice: used once')
            times, values = times[np.append(True, ~same)], values[np.append(True, ~same)]
        if len(times) < LEAST_SAMPLES:
            raise ValueError(f'{len(times)} {kind}: must be {LEAST_SAMPLES} at least')
        usual = float(np.median(np.diff(times)))
        if not INTERVALS[0] <= usual <= INTERVALS[1]:
            raise ValueError(f'the times of {kind} are {usual:.4g} s apart: must be '
                             f"{INTERVALS[0]:g} to {INTERVALS[1]:g} s; name their unit: --columns "
                             "'t=t:ms', or us, ns")
        if kind == 'attitudes':
            norms = np.linalg.norm(values, axis=1, keepdims=True)
            for at in np.flatnonzero(~(np.abs(norms - 1.0) < NORM))[:1]:
                raise ValueError(f'{where.format(whole[at])}: |q| = {float(norms[at, 0]):.4g}: '
                                 'must be 1: these are no unit quaternions')
            values = values / norms
        self.parts[kind] = times, values
        self.notes.append(f'{kind} of {source}: {len(times)} rows, '
                          f'{1.0 / usual:.4g} Hz, from {times[0]:.6g} to {times[-1]:.6g} s')

    def check(self) -> None:
        """Raise ValueError if there are no attitudes, or no readings at their times."""
        if 'attitudes' not in self.parts:
            raise ValueError('no attitudes')
        times = self.parts['attitudes'][0]
        for kind, (at, _) in self.parts.items():
            if at[0] > times[-1] or at[-1] < times[0]:
                raise ValueError(f'{kind} from {at[0]:.6g} to {at[-1]:.6g} s, attitudes from '
                                 f'{times[0]:.6g} to {times[-1]:.6g} s: stamps must be of one '
                                 'clock')
        if not {'gyroscope', 'accelerations', 'magnetometer'} & self.parts.keys():
            self.notes.append('no readings: the IMU is not graded')


def read_table(path: Path, said: str | None) -> Recorded:
    """
    Read a table, or a folder of EuRoC.

    said : what --columns says, or the path of a file that holds it

    Raises OSError, ImportError or ValueError, which name the file and what to type.
    """
    recorded = Recorded()
    try:
        if path.is_dir():
            for part in ('state_groundtruth_estimate0', 'imu0'):
                _add(recorded, _text_columns(path / part / 'data.csv'), {})
        elif path.suffix not in READERS:
            raise ValueError(f'the name must end in .mcap, {", ".join(READERS)}')
        elif not path.stat().st_size:
            raise ValueError('the file is empty')
        else:
            _add(recorded, READERS[path.suffix](path), columns_said(said) if said else {})
        recorded.check()
    except (ValueError, EOFError) as error:
        raise ValueError(f'{path}: {one_line(error)}') from error
    return recorded


def columns_said(text: str) -> dict[str, list[tuple[str, str]]]:
    """
    Return columns of a file and their units by our name, of 't=stamp:ns, qw=rot_0, az='.

    A time may have several, which are added up: 't=sec:s+nanosec:ns'.  None: not in the file.
    Raises ValueError.
    """
    if '=' not in text:
        text = Path(text).read_text('utf-8')
    said: dict[str, list[tuple[str, str]]] = {}
    for item in re.split(r'[,\n]', text):
        name, equals, what = (word.strip() for word in item.partition('='))
        if not name and not what:
            continue
        if name not in NAMES or not equals:
            raise ValueError(f"--columns '{item.strip()}': must be NAME=COLUMN:UNIT with a NAME "
                             f'of {", ".join(NAMES)}')
        if name in said:
            raise ValueError(f'--columns: {name} is said twice')
        said[name] = [_named(name, one) for one in what.split('+' if name == 't' else '\n')
                      if one.strip()]
    return said


def _named(name: str, text: str) -> tuple[str, str]:
    """Return column and unit of 'rot_0:1'."""
    column, colon, unit = text.strip().rpartition(':')
    unit = unit.strip()
    if colon and unit.translate(_SIGNS) in NAMES[name]:
        return column.strip(), unit.translate(_SIGNS)
    if colon and not column.endswith(':'):
        raise ValueError(f'--columns {name}={text.strip()}: the unit must be '
                         f'{", ".join(NAMES[name])}')
    return text.strip(), next(iter(NAMES[name]))


# ------------------------------------------------------------------------------------- readers

class Table(NamedTuple):
    """Columns of a file, and what to write of a row of it, such as 'line {}'."""

    columns: Columns
    where: Sequence[int]            # line of each row; empty: rows have none


def _text_columns(path: Path) -> Table:
    try:
        text = path.read_text('utf-8-sig')
    except UnicodeDecodeError as error:
        raise ValueError(f'no UTF-8 text: {error.reason} at byte {error.start}') from error
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    bare = [(number, line) for number, line in lines if not line.lstrip().startswith('#')]
    comments = [(number, line.lstrip('# \t')) for number, line in lines[:lines.index(bare[0])]
                ] if bare else []
    if not bare:
        raise ValueError('the file has no rows')
    mark = next((mark for mark in ',;\t' if mark in bare[0][1]), ' ')
    rows = [(number, row) for (number, _), row in zip(bare, csv.reader(
        (line.strip() if mark == ' ' else line for _, line in bare), delimiter=mark,
        skipinitialspace=True), strict=False)]
    names = [name.strip() for name in rows[0][1]]
    if all(_is_number(name) for name in names if name):     # no names: those of a comment, or TUM
        heads = [[name.strip() for name in re.split(mark if mark != ' ' else r'\s+', line.strip())]
                 for _, line in reversed(comments[-1:])]
        if heads and len(heads[0]) == len(names):
            names = heads[0]
        elif mark == ' ' and len(names) == len(TUM):
            names = TUM
        else:
            raise ValueError(f'line {rows[0][0]}: {len(names)} numbers without names: write a '
                             'line of names such as t,qw,qx,qy,qz above them')
    else:
        rows = rows[1:]
    if mark == ' ' and ' '.join(names) == 'timestamp tx ty tz qx qy qz qw':
        names = TUM
    for name, count in Counter(filter(None, names)).items():
        if count > 1:
            raise ValueError(f'{count} columns are called {name}: each needs a name of its own')
    for number, row in rows:
        if len(row) != len(names):
            raise ValueError(f'line {number} has {len(row)} values, the head {len(names)} names: '
                             'correct it, or cut it off')
    return Table(dict(zip(names, zip(*(row for _, row in rows), strict=True), strict=True)),
                 [number for number, _ in rows])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parquet(path: Path) -> Table:
    with needed('a Parquet file', 'parquet'):
        from pyarrow import parquet  # noqa: PLC0415
    table = parquet.read_table(path)
    return Table({name: table[name].to_numpy() for name in table.column_names}, ())


def _npz(path: Path) -> Table:
    columns: dict[str, Sequence[Any]] = {}
    if not is_zipfile(path):
        raise ValueError('it is no file of numpy.savez')
    with np.load(path, allow_pickle=False) as arrays:
        for name, values in arrays.items():
            columns.update({name: values} if values.ndim == 1 else {
                f'{name}[{k}]': column for k, column in enumerate(values.T)
            } if values.ndim == 2 else {})
    return Table(columns, ())


READERS = {'.csv': _text_columns, '.txt': _text_columns, '.tum': _text_columns,
           '.tsv': _text_columns, '.parquet': _parquet, '.npz': _npz}


# ------------------------------------------------------------------------------------- columns

def _add(recorded: Recorded, table: Table, said: Mapping[str, list[tuple[str, str]]]) -> None:
    """Add the parts of a table.  Raises ValueError."""
    chosen = {**_ours(table.columns), **said}
    for name, columns in said.items():
        for column, _ in columns:
            if column not in table.columns:
                raise ValueError(f'--columns {name}={column}: the file has '
                                 f'{", ".join(table.columns)}')
    unused = [name for name in table.columns if name not in {
        column for columns in chosen.values() for column, _ in columns}]
    _need(chosen, 't', ('t',), unused)
    where = 'row {}'
    times, recorded.first_s, clock = _times(chosen['t'], table)
    if not recorded.parts:
        recorded.notes.append(clock)
    for kind, (names, units, _) in KINDS.items():
        there = [name for name in names if chosen.get(name)]
        if kind == 'attitudes' and not recorded.parts.get(kind) or there:
            _need(chosen, kind, names, unused)
            values = np.stack([units[chosen[name][0][1]] * np.fromiter(
                _numbers(chosen[name][0][0], table), float) for name in names], axis=1)
            source = ', '.join(
                column if f'[{unit}]' in column else f'{column} [{unit}]'
                for ((column, unit),) in map(chosen.__getitem__, names))
            try:
                recorded.add(kind, source, times, values, where)
            except ValueError as error:     # a row by its line
                raise ValueError(re.sub(r'^row (\d+)', lambda found: _place(
                    table, int(found[1])), str(error))) from None
    for kind, (names, _, _) in KINDS.items():
        if kind not in recorded.parts and (alike := _alike(kind, names, unused)):
            recorded.notes.append(f'{kind}: none; {alike}')
    if unused:
        recorded.notes.append(f'not used: {", ".join(unused)}')


def _place(table: Table, row: int) -> str:
    return f'line {table.where[row]}' if table.where else f'row {row}'


def _ours(columns: Columns) -> dict[str, list[tuple[str, str]]]:
    """Return the columns that have our names, with or without a unit in brackets, or EuRoC's."""
    found: dict[str, list[tuple[str, str]]] = {}
    euroc = {column: EUROC.get(re.sub(r'\s*\[.*', '', column.lstrip('#').strip()))
             for column in columns}
    if {'t', 'qw'} <= {*euroc.values()} or {'t', 'gx', 'ax'} <= {*euroc.values()}:
        return {name: [(column, 'ns' if name == 't' else next(iter(NAMES[name])))]
                for column, name in euroc.items() if name}
    for column in columns:
        matched = re.fullmatch(r'(\w+)(?: ?\[([^\]]*)\])?', column)
        name, unit = matched.groups() if matched else ('', None)
        if name in NAMES:
            unit = next(iter(NAMES[name])) if unit is None else unit.translate(_SIGNS)
            if unit not in NAMES[name]:
                raise ValueError(f"{column}: the unit must be {', '.join(NAMES[name])}: --columns "
                                 f"'{name}={column}:UNIT'")
            if name in found:
                raise ValueError(f"{found[name][0][0]} and {column}: which is {name}? --columns "
                                 f"'{name}={column}:{unit}'")
            found[name] = [(column, unit)]
    return found


def _need(chosen: Mapping[str, Sequence[Any]], kind: str, names: Sequence[str],
          unused: Sequence[str]) -> None:
    """Raise ValueError unless all columns of a part are there."""
    if missing := [name for name in names if not chosen.get(name)]:
        raise ValueError(f'no column {", ".join(missing)}; ' + (
            _alike(kind, missing, unused) or f'the file has {", ".join(unused) or "no other"}' + (
                ', and Euler angles are not read' if kind == 'attitudes' else '')
            + f": name what is meant: --columns '{missing[0]}=COLUMN:"
            f"{next(iter(NAMES[missing[0]]))}'"))


def _alike(kind: str, names: Sequence[str], unused: Sequence[str]) -> str:
    """Return what to type where columns may be meant by others, '' if none may be."""
    found: dict[str, list[str]] = {name: [] for name in names}
    for column in unused:
        flat = re.sub('[^a-z0-9]', '', column.lower())
        if kind == 't':
            matched = re.search('(time|stamp|sec|date|clock|^t)', flat)
        else:
            matched = re.search(f'(?:{KINDS[kind].words})([wxyz0-9])', flat)
        for name in names if matched else ():
            if kind == 't' or matched[1] in (name[-1], *'0123456789'):
                found[name].append(column)
    named = [f'{name}={columns[0] if len(columns) == 1 else "COLUMN"}:'
             + ('1' if kind == 'attitudes' else 'UNIT')
             for name, columns in found.items() if columns]
    if not named:
        return ''
    of = dict.fromkeys(column for columns in found.values() for column in columns)
    units = '' if kind == 'attitudes' else f' with a UNIT of {", ".join(NAMES[names[0]])}'
    return f"if it is {', '.join(of)}: --columns '{', '.join(named)}'{units}"


def _times(columns: Sequence[tuple[str, str]], table: Table) -> tuple[Reals, float, str]:
    """Return times from the first stamp [s], this stamp, and a note about the clock."""
    total: Any = 0
    for column, unit in columns:
        total = total + TIMES[unit] * np.array([*_decimals(column, unit, table)], object)
    first = min((one for one in total if one.is_finite()), default=Decimal(0))
    text = ' + '.join(f'{column} [{unit}]' for column, unit in columns)
    return (total - first).astype(float), float(first), (
        f'times of {text}: the first is {float(first):.12g} s')


def _decimals(column: str, unit: str, table: Table) -> Iterator[Decimal]:
    for row, cell in enumerate(table.columns[column]):
        text = str(cell).strip()
        try:
            yield Decimal(int(np.datetime64(text.removesuffix('Z'), 'ns').astype(int))) if (
                unit == 'iso') else Decimal(text)
        except (InvalidOperation, ValueError):
            raise ValueError(
                f'{_place(table, row)}: {column} = {text[:40]!r} is no number' + (
                    f": a row of units is cut off, and said: --columns 't={column}:"
                    f"{text}'" if text in TIMES else f", of a date say --columns 't={column}:iso'")
            ) from None


def _numbers(column: str, table: Table) -> Iterator[float]:
    for row, cell in enumerate(table.columns[column]):
        text = '' if cell is None else str(cell).strip()
        try:
            value = math.nan if text in ('', 'nan', 'NaN') else float(text)
        except ValueError:
            value = math.inf
        if math.isinf(value) or '_' in text:
            raise ValueError(f'{_place(table, row)}: {column} = {text[:40]!r} is no number: '
                             'correct it, leave it empty, or cut the line off') from None
        yield value
