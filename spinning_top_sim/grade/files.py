# SPDX-License-Identifier: Apache-2.0
"""
Reads motions and readings from files: one table, and what EuRoC and TUM define.

Nothing is guessed: a column is what its name says in docs/grade.md, or what `--columns` says.
What is not understood is refused in one line, with what to type.
"""

import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import is_zipfile

import numpy as np

from spinning_top_sim.grade.columns import LENGTHS, NORM, READINGS
from spinning_top_sim.installation import needed
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.kinematics import Reals

TIMES = {'s': Decimal(1), 'ms': Decimal('1e-3'), 'us': Decimal('1e-6'), 'ns': Decimal('1e-9'),
         'iso': Decimal('1e-9')}
# Columns of each part of a motion, and factors of their units by name, the first by default.
PARTS: dict[str, tuple[str, Mapping[str, Any]]] = {
    't': ('t', TIMES), 'attitudes': ('qx qy qz qw', {'1': 1.0}),
    'positions': ('px py pz', LENGTHS),
    **{name: (' '.join(f'{letter}{axis}' for axis in 'xyz'), READINGS[name].units)
       for name, letter in zip(READINGS, 'gam', strict=True)}}
UNITS = {name: units for names, units in PARTS.values() for name in names.split()}
TUM = ['t', 'px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw']
# Columns of EuRoC's state_groundtruth_estimate0 and imu0, by their names without the unit.
EUROC = {'timestamp': 't', **{f'{a}_{axis}': f'{b}{axis}' for a, b in (
    ('p_RS_R', 'p'), ('q_RS', 'q'), ('w_RS_S', 'g'), ('a_RS_S', 'a')) for axis in 'wxyz'}}
# Intervals of motions that can be graded [s]: others are those of times in another unit.
INTERVALS = 1e-5, 0.5
LEAST_SAMPLES = 20
_SIGNS = str.maketrans({'µ': 'u', 'μ': 'u', '°': 'deg', '²': '^2'})
Chosen = dict[str, list[tuple[str, str]]]       # by our name: columns and their units


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,), ascending [s], and values (n, k) by names of PARTS, SI; attitudes are
        q(world <- body) as x, y, z, w
    covariance : (3, 3) that the first message of an IMU tells, by name
    first_s, origin_ns : the first stamp, of a table [s] and of a log [ns]
    run : of a log of this package, as `recorded_run` describes it
    notes : what was read, and what was not
    """

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    covariance: dict[str, Reals] = field(default_factory=dict)
    first_s: Decimal = Decimal(0)
    origin_ns: int = 0
    run: Any = None
    notes: list[str] = field(default_factory=list)

    def add(self, kind: str, source: str, times: Reals, values: Reals,
            rows: Sequence[str]) -> None:
        """
        Add a part whose times are in seconds from the first stamp of the file.

        rows : what each row is called

        Raises ValueError.
        """
        whole = np.flatnonzero(np.all(np.isfinite(values), axis=1) & np.isfinite(times))
        times, values = times[whole], values[whole]
        steps = np.diff(times)
        for at in np.flatnonzero(steps < 0.0)[:1]:
            raise ValueError(f'{rows[whole[at + 1]]}: the time goes back from {times[at]:.9g} to '
                             f'{times[at + 1]:.9g} s: one motion at a time, in a file of its own')
        same = steps == 0.0
        for at in np.flatnonzero(same & np.any(values[1:] != values[:-1], axis=1))[:1]:
            raise ValueError(f'{rows[whole[at + 1]]}: another row of {kind} at the time '
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
                raise ValueError(f'{rows[whole[at]]}: |q| = {float(norms[at, 0]):.4g}: must be 1: '
                                 'these are no unit quaternions')
            values = values / norms
        self.parts[kind] = times, values
        self.notes.append(f'{kind} of {source}: {len(times)} rows, {1.0 / usual:.4g} Hz, from '
                          f'{times[0]:.6g} to {times[-1]:.6g} s')

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
        if not READINGS.keys() & self.parts.keys():
            self.notes.append('no readings: the IMU is not graded')


class Table(NamedTuple):
    """Columns of a file by name, and what its rows are called."""

    columns: Mapping[str, Sequence[Any]]
    rows: Sequence[str]

    def cells(self, column: str, parse: Callable[[str], Any]) -> list[Any]:
        """Return the parsed cells of a column, NaN of an empty one.  Raises ValueError."""
        found: list[Any] = []
        for row, cell in zip(self.rows, self.columns[column], strict=True):
            text = '' if cell is None else str(cell).strip()
            try:
                value = parse(text) if text and '_' not in text else math.nan
            except (InvalidOperation, ValueError):
                value = math.inf
            if math.isinf(value) or '_' in text or (math.isnan(value) and parse is not float):
                raise ValueError(f'{row}: {column} = {text[:40]!r} is no ' + (
                    'number: correct it, leave it empty, or cut the line off' if parse is float
                    else 'time: correct it, or cut the line off; of a date say --columns '
                    f"'t={column}:iso'"))
            found.append(value)
        return found


def _date(text: str) -> Decimal:
    """Return the nanoseconds of a date."""
    return Decimal(int(np.datetime64(text.removesuffix('Z'), 'ns').astype(int)))


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
                _add(recorded, _text(path / part / 'data.csv'), {})
        elif path.suffix.lower() not in READERS:
            raise ValueError(f'the name must end in .mcap, {", ".join(READERS)}')
        else:
            _add(recorded, READERS[path.suffix.lower()](path), columns_said(said) if said else {})
        recorded.check()
    except (ValueError, EOFError) as error:
        raise ValueError(f'{path}: {one_line(error)}') from error
    return recorded


def columns_said(text: str) -> Chosen:
    """
    Return the columns that 't=stamp:ns, qw=rot_0, az=' says; none: not in the file.

    A time may have several, which are added up: 't=sec:s+nanosec:ns'.  Raises ValueError.
    """
    if '=' not in text:
        text = Path(text).read_text('utf-8')
    said: Chosen = {}
    for item in filter(str.strip, re.split(r'[,\n]', text)):
        name, equals, what = (word.strip() for word in item.partition('='))
        if name not in UNITS or not equals or name in said:
            raise ValueError(f"--columns '{item.strip()}': must be NAME=COLUMN:UNIT, with each "
                             f'NAME once, of {", ".join(UNITS)}')
        said[name] = []
        for one in filter(None, what.split('+') if name == 't' else [what]):
            column, colon, unit = one.rpartition(':')
            said[name].append((column.strip(), _unit(name, unit.strip(), item.strip()))
                              if colon else (one.strip(), next(iter(UNITS[name]))))
    return said


def _unit(name: str, unit: str, where: str) -> str:
    """Return a unit by its name.  Raises ValueError."""
    unit = unit.translate(_SIGNS)
    if unit not in UNITS[name]:
        raise ValueError(f"{where}: the unit must be {', '.join(UNITS[name])}: say "
                         f"--columns '{name}=COLUMN:UNIT'")
    return unit


# ------------------------------------------------------------------------------------- readers

def _text(path: Path) -> Table:
    try:
        lines = [(f'line {number}', line.strip()) for number, line in enumerate(
            path.read_text('utf-8-sig').splitlines(), 1) if line.strip()]
    except UnicodeDecodeError as error:
        raise ValueError(f'no UTF-8 text: {error.reason} at byte {error.start}') from error
    where = [name for name, line in lines if not line.startswith('#')]
    bare = [line for _, line in lines if not line.startswith('#')]
    if not bare:
        raise ValueError('the file has no rows')
    mark = next((mark for mark in ',;\t' if mark in bare[0]), ' ')
    comments = [line.lstrip('# \t') for _, line in lines if line.startswith('#')]
    heads, rows = ([[cell.strip() for cell in row] for row in csv.reader(
        part, delimiter=mark, skipinitialspace=True)] for part in (comments, bare))
    if _are_numbers(rows[0]):           # no names: those of a comment, or of TUM
        count = len(rows[0])
        names = next((head for head in heads if len(head) == count),
                     TUM if mark == ' ' and count == len(TUM) else [])
        if not names:
            raise ValueError(f'{where[0]}: {count} numbers without names: write a line of names '
                             'such as t,qw,qx,qy,qz above them')
    else:
        names, where, rows = rows[0], where[1:], rows[1:]
    if mark == ' ' and names == ['timestamp', 'tx', 'ty', 'tz', *TUM[4:]]:
        names = TUM
    if twice := [name for name in names if name and names.count(name) > 1]:
        raise ValueError(f'{len(twice)} columns are called {twice[0]}: each needs a name of its '
                         'own')
    for line, row in zip(where, rows, strict=True):
        if len(row) != len(names):
            raise ValueError(f'{line} has {len(row)} values, the head {len(names)} names: correct '
                             'it, or cut it off')
    return Table(dict(zip(names, zip(*rows, strict=True), strict=True)), where)


def _are_numbers(cells: Sequence[str]) -> bool:
    try:
        return bool([float(cell) for cell in cells if cell])
    except ValueError:
        return False


def _arrays(columns: Mapping[str, Sequence[Any]]) -> Table:
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1:
        raise ValueError(f'columns have {", ".join(map(str, sorted(lengths))) or "no"} rows: must '
                         'have as many')
    return Table(columns, [f'row {k}' for k in range(*lengths)])


def _parquet(path: Path) -> Table:
    with needed('a Parquet file', 'parquet'):
        from pyarrow import parquet  # noqa: PLC0415
    table = parquet.read_table(path)
    return _arrays({name: table[name].to_numpy() for name in table.column_names})


def _npz(path: Path) -> Table:
    if not is_zipfile(path):
        raise ValueError('it is no file of numpy.savez')
    columns: dict[str, Sequence[Any]] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name, values in arrays.items():
            columns.update({name: values} if values.ndim == 1 else {
                f'{name}[{k}]': column for k, column in enumerate(values.T)
            } if values.ndim == 2 else {})
    return _arrays(columns)


READERS = {'.csv': _text, '.txt': _text, '.tum': _text, '.tsv': _text, '.parquet': _parquet,
           '.npz': _npz}


# ------------------------------------------------------------------------------------- columns

def _add(recorded: Recorded, table: Table, said: Chosen) -> None:
    """Add the parts of a table.  Raises ValueError."""
    chosen = {**_ours(table.columns), **said}
    used = {column for columns in chosen.values() for column, _ in columns}
    if missing := sorted(used - table.columns.keys()):
        raise ValueError(f'--columns {missing[0]}: the file has {", ".join(table.columns)}')
    unused = ', '.join(name for name in table.columns if name not in used)
    for kind, (names, units) in PARTS.items():
        there = [name for name in names.split() if chosen.get(name)]
        if not there and (kind not in ('t', 'attitudes') or kind in recorded.parts):
            continue
        if missing := [name for name in names.split() if name not in there]:
            what = ', '.join(f'{name}=COLUMN' + ':UNIT' * (len(units) > 1) for name in missing)
            raise ValueError(f'no column {", ".join(missing)}: name {unused or "them"}, by '
                             f"--columns '{what}'" + (
                                 f' with a UNIT of {", ".join(units)}' if len(units) > 1 else
                                 '; Euler angles are not read'))
        source = ', '.join(f'{column} [{unit}]' if unit != '1' and f'[{unit}]' not in column else
                           column
                           for name in names.split() for column, unit in chosen[name])
        if kind == 't':
            stamps: Any = sum(units[unit] * np.array(
                table.cells(column, _date if unit == 'iso' else Decimal), object)
                for column, unit in chosen['t'])
            if not recorded.parts:
                recorded.first_s = min(stamps, default=Decimal(0))
                recorded.notes.append(f'times of {source}: the first is '
                                      f'{float(recorded.first_s):.12g} s')
            times = (stamps - recorded.first_s).astype(float)
        else:
            recorded.add(kind, source, times, np.stack([units[unit] * np.array(
                table.cells(column, float)) for name in names.split()
                for column, unit in chosen[name]], axis=1), table.rows)
    if unused:
        recorded.notes.append(f'not used: {unused}')


def _ours(columns: Mapping[str, Sequence[Any]]) -> Chosen:
    """Return the columns that have our names, with or without a unit in brackets, or EuRoC's."""
    bare = {column: re.sub(r'\s*\[.*', '', column.lstrip('#').strip()) for column in columns}
    if {'timestamp', 'q_RS_w'} <= {*bare.values()} or {'timestamp', 'w_RS_S_x'} <= {
            *bare.values()}:
        return {EUROC[name]: [(column, 'ns' if name == 'timestamp' else next(iter(
            UNITS[EUROC[name]])))] for column, name in bare.items() if name in EUROC}
    found: Chosen = {}
    for column, name in bare.items():
        if name not in UNITS:
            continue
        if name in found:
            raise ValueError(f"{column}: say which column is {name}: --columns "
                             f"'{name}={column}:UNIT'")
        unit = re.search(r'\[(.*)\]', column)
        found[name] = [(column, _unit(name, unit[1], column) if unit and unit[1] else next(iter(
            UNITS[name])))]
    return found
