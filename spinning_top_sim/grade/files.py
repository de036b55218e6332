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
    **{name: (' '.join(f'{letter}{axis}' for axis in 'xyz'), READINGS[name])
       for name, letter in zip(READINGS, 'gam', strict=True)}}
UNITS = {name: units for names, units in PARTS.values() for name in names.split()}
TUM = ['t', 'px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw']
# Columns of EuRoC's state_groundtruth_estimate0 and imu0, by their names without the unit.
EUROC = {'timestamp': 't', **{f'{a}_{axis}': f'{b}{axis}' for a, b in (
    ('p_RS_R', 'p'), ('q_RS', 'q'), ('w_RS_S', 'g'), ('a_RS_S', 'a')) for axis in 'wxyz'}}
# Intervals of motions that can be graded [s]: others are those of times in another unit.
INTERVALS = 1e-5, 0.5
LEAST_SAMPLES = 20
Chosen = dict[str, list[tuple[str, str]]]       # by our name: columns and their units


@dataclass
class Recorded:
    """
    What is in a file.

    parts : times (n,), ascending [s], and values (n, k) by names of PARTS, SI; attitudes are
        q(world <- body) as x, y, z, w
    densities : of the noise that the first message of an IMU declares, by name
    origin : the first stamp [s]
    run : of a log of this package, as `recorded_run` describes it
    notes : what was read, and what was not
    """

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    densities: dict[str, float] = field(default_factory=dict)
    origin: Decimal = Decimal(0)
    run: Any = None
    notes: list[str] = field(default_factory=list)

    def add(self, kind: str, source: str, times: Reals, values: Reals,
            rows: Sequence[str]) -> None:
        """
        Add a part whose times are in seconds from the first stamp of the file.

        rows : what each row is called

        Raises ValueError.
        """
        whole = np.flatnonzero(np.all(np.isfinite(values), axis=1))
        steps, same = np.diff(times[whole]), np.all(np.diff(values[whole], axis=0) == 0.0, axis=1)
        for at in np.flatnonzero((steps < 0.0) | ((steps == 0.0) & ~same))[:1]:
            raise ValueError(f'{rows[whole[at + 1]]}: after {times[whole[at]]:.9g} s the time of '
                             f'{kind} is {times[whole[at + 1]]:.9g} s: one motion a file, with '
                             'times of enough digits')
        if twice := np.count_nonzero(steps == 0.0):
            self.notes.append(f'{kind}: {twice} rows are there twice: used once')
        whole = whole[np.append(True, steps > 0.0)] if len(whole) else whole
        times, values = times[whole], values[whole]
        usual = float(np.median(np.diff(times))) if len(times) > 1 else math.nan
        if len(times) < LEAST_SAMPLES or not INTERVALS[0] <= usual <= INTERVALS[1]:
            raise ValueError(f'{len(times)} {kind}, {usual:.4g} s apart: must be {LEAST_SAMPLES} '
                             f'at least, {INTERVALS[0]:g} to {INTERVALS[1]:g} s apart; name the '
                             "unit of times by --columns 't=COLUMN:UNIT'")
        if kind == 'attitudes':
            norms = np.linalg.norm(values, axis=1, keepdims=True)
            for at in np.flatnonzero(~(np.abs(norms - 1.0) < NORM))[:1]:
                raise ValueError(f'{rows[whole[at]]}: |q| = {float(norms[at, 0]):.4g}: must be 1')
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
        """Return the parsed cells of a column; an empty value is NaN.  Raises ValueError."""
        found: list[Any] = []
        for row, cell in zip(self.rows, self.columns[column], strict=True):
            text = '' if cell is None else str(cell).strip()
            try:
                found.append(parse(text or 'nan'))
            except (InvalidOperation, ValueError):
                found.append(math.inf)
            if '_' in text or math.isinf(found[-1]) or (
                    math.isnan(found[-1]) and parse is not float):
                raise ValueError(f'{row}: {column} = {text[:40]!r} is no ' + (
                    'number: correct it, or leave it empty' if parse is float else
                    f"time: correct it, or of a date say --columns 't={column}:iso'"))
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
    recorded, kind = Recorded(), path.suffix.lower()
    try:
        if path.is_dir():
            for part in ('state_groundtruth_estimate0', 'imu0'):
                _add(recorded, _text(path / part / 'data.csv'), {})
        elif kind not in READERS:
            raise ValueError(f'the name must end in .mcap, {", ".join(READERS)}')
        else:
            _add(recorded, READERS[kind](path), columns_said(said) if said else {})
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
            said[name].append((column.strip(), _unit(name, unit)) if colon else (
                one.strip(), next(iter(UNITS[name]))))
    return said


def _unit(name: str, text: str) -> str:
    """Return a unit by its name.  Raises ValueError."""
    unit = text.strip()
    if unit not in UNITS[name]:
        raise ValueError(f"[{unit}]: say --columns '{name}=COLUMN:UNIT' with a UNIT of "
                         f'{", ".join(UNITS[name])}')
    return unit


# ------------------------------------------------------------------------------------- readers

def _text(path: Path) -> Table:
    lines = {f'line {k}': line.strip() for k, line in enumerate(
        path.read_text('utf-8-sig').splitlines(), 1) if line.strip()}
    bare = [line for line in lines.values() if line[0] != '#']
    if not bare:
        raise ValueError('the file has no rows')
    mark = next((mark for mark in ',;\t' if mark in bare[0]), ' ')

    def cells(line: str) -> list[str]:
        return [cell.strip() for row in csv.reader([line], delimiter=mark, skipinitialspace=True)
                for cell in row]

    rows = {where: cells(line) for where, line in lines.items() if line[0] != '#'}
    names = cells(bare[0])
    try:
        [float(cell) for cell in names if cell]
    except ValueError:
        del rows[next(iter(rows))]
    else:                               # no names: those of a comment, or of TUM
        names = next((head for line in lines.values() if line[0] == '#' and len(
            head := cells(line.lstrip('# \t'))) == len(names)),
            TUM if mark == ' ' and len(names) == len(TUM) else [])
    if mark == ' ' and names == ['timestamp', 'tx', 'ty', 'tz', *TUM[4:]]:
        names = TUM
    for where, row in rows.items():
        if len(row) != len(names):
            raise ValueError(f'{where} has {len(row)} values, and there are {len(names)} names: '
                             'correct it, or cut it off; a line of names such as t,qw,qx,qy,qz '
                             'stands above the numbers')
    if twice := [name for name in names if name and names.count(name) > 1]:
        raise ValueError(f'{len(twice)} columns are called {twice[0]}: each needs a name of its '
                         'own')
    return _arrays(dict(zip(names, zip(*rows.values(), strict=True), strict=False)), [*rows])


def _arrays(columns: Mapping[str, Sequence[Any]], rows: Sequence[str] = ()) -> Table:
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1:
        raise ValueError(f'columns have {", ".join(map(str, sorted(lengths))) or "no"} rows: must '
                         'have as many')
    return Table(columns, rows or [f'row {k}' for k in range(*lengths)])


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
            raise ValueError(f'no column {", ".join(missing)}: name {unused or "them"}, by '
                             f"--columns '{', '.join(f'{name}=COLUMN:UNIT' for name in missing)}' "
                             f'with a UNIT of {", ".join(units)}')
        pairs = [pair for name in names.split() for pair in chosen[name]]
        source = ', '.join(column if unit in ('1', *re.findall(r'\[(.*)\]', column)) else
                           f'{column} [{unit}]' for column, unit in pairs)
        if kind == 't':
            stamps: Any = sum(units[unit] * np.array(
                table.cells(column, _date if unit == 'iso' else Decimal), object)
                for column, unit in pairs)
            if not recorded.parts:
                recorded.origin = next(iter(stamps), Decimal(0))
                recorded.notes.append(f'times of {source}: the first is '
                                      f'{float(recorded.origin):.12g} s')
            times = (stamps - recorded.origin).astype(float)
        else:
            recorded.add(kind, source, times, np.stack([
                units[unit] * np.array(table.cells(column, float)) for column, unit in pairs],
                axis=1), table.rows)
    if unused:
        recorded.notes.append(f'not used: {unused}')


def _ours(columns: Mapping[str, Sequence[Any]]) -> Chosen:
    """Return the columns that have our names, with or without a unit in brackets, or EuRoC's."""
    bare = {column: re.sub(r'\s*\[.*', '', column.lstrip('#').strip()) for column in columns}
    if 'timestamp' in bare.values() and not {'q_RS_w', 'w_RS_S_x'}.isdisjoint(bare.values()):
        return {EUROC[name]: [(column, 'ns' if name == 'timestamp' else next(iter(
            UNITS[EUROC[name]])))] for column, name in bare.items() if name in EUROC}
    found: Chosen = {}
    for column, name in bare.items():
        if name in found:
            raise ValueError(f"{column}: say which column is {name}: --columns "
                             f"'{name}={column}:UNIT'")
        if name in UNITS:
            unit = re.search(r'\[(.+)\]', column)
            found[name] = [(column, _unit(name, unit[1]) if unit else next(iter(UNITS[name])))]
    return found
