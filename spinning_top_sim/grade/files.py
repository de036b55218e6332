# SPDX-License-Identifier: Apache-2.0
"""
Reads motions and readings from files: logs, one table, and what EuRoC and TUM define.

Nothing is guessed: a column is what its name says in docs/grade.md, or what `--columns` says.
What is not understood is refused in one line, with what to type.
"""

import contextlib
import csv
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from spinning_top_sim.grade.columns import READINGS
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.table import Columns, column_numbers, read_columns
from spinning_top_sim.times import NEVER_NS, stamp_text
from spinning_top_sim.tools import recorded_run
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.foreign_messages import PLACES, samples
from spinning_top_sim.tools.kinematics import Reals
from spinning_top_sim.tools.scene_file import likely_name

# Columns of each part of a motion, and factors of their units by name, the first by default.
PARTS: dict[str, tuple[Sequence[str], Mapping[str, Any]]] = {
    't': (['t'], {'s': 10 ** 9, 'ms': 10 ** 6, 'us': 10 ** 3, 'ns': 1}),
    'attitudes': (['qx', 'qy', 'qz', 'qw'], {'1': 1.0}),
    'positions': (['px', 'py', 'pz'], {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}),
    **{name: ([f'{letter}{axis}' for axis in 'xyz'], READINGS[name])
       for name, letter in zip(READINGS, 'gam', strict=True)}}
UNITS = {name: units for names, units in PARTS.values() for name in names}
# The end of a name in brackets; a unit in them, no index; what resembles one of our names.
BRACKETS = re.compile(r'\s*[\[({][^\])}]*[\])}]$')
UNIT = re.compile(r'[\[({](?!\d+\W)([^\])}]*)[\])}]$')
ALIKE = re.compile(r'(?<![a-z0-9])([pqgam])[^a-z0-9]?([wxyz])(?![a-z0-9])')
# Columns of TUM, maybe without names, and our names; our names of EuRoC's without their units.
OF_TUM = ['t', 'px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw']
TUM = ['timestamp', 'tx', 'ty', 'tz', *OF_TUM[4:]], [f'column {k}' for k in range(1, 9)]
EUROC = {'timestamp': 't [ns]', **{f'{theirs}_{axis}': f'{ours}{axis}' for theirs, ours in (
    ('p_RS_R', 'p'), ('q_RS', 'q'), ('w_RS_S', 'g'), ('a_RS_S', 'a')) for axis in 'wxyz'}}
OF_EUROC = 'state_groundtruth_estimate0/data.csv', 'imu0/data.csv'
# Topics of this package that are graded where its log has them, the first of each kind.
OURS = 'pose', 'ground_truth/odom', 'ground_truth/imu', 'imu/data_raw', 'imu/data', 'imu/mag'
# Intervals of motions that can be graded [s]: others are those of times in another unit.
INTERVALS = 1e-5, 0.5
LEAST_SAMPLES = 20
Chosen = dict[str, list[tuple[str, str]]]       # by our name: columns and their units


@dataclass
class Recorded:
    """What is in a file, with notes: times (n,) [s] and values (n, k) by names of PARTS, SI."""

    parts: dict[str, tuple[Reals, Reals]] = field(default_factory=dict)
    origin: Any = None          # the stamp at which times begin [ns]
    notes: list[str] = field(default_factory=list)
    run: Any = None             # of a log of this package, as `recorded_run` describes it

    def add(self, kind: str, source: str, stamps: Any, values: Reals,
            rows: Sequence[str]) -> None:
        """Add a part: exact stamps [ns], values, NaN: none, and names of rows.  ValueError."""
        at = np.flatnonzero(np.all(np.isfinite(values), axis=1))
        if self.origin is None and len(at):
            self.origin = stamps[at[0]]
            first = Decimal(self.origin).scaleb(-9).normalize()
            self.notes.append(f'the first time is {first:f} s')
        times = 1e-9 * np.array([float(stamps[row] - self.origin) for row in at])
        steps, same = np.diff(times), np.all(np.diff(values[at], axis=0) == 0.0, axis=1)
        for k in np.flatnonzero((steps < 0.0) | ((steps == 0.0) & ~same))[:1]:
            raise ValueError(f'{rows[at[k + 1]]}: {kind} are at {times[k + 1]:.9g} s after '
                             f'{times[k]:.9g} s: must ascend: one motion, enough digits')
        once = np.append(True, steps > 0.0)[:len(at)]
        if not np.all(once):
            self.notes.append(f'{kind}: {np.sum(~once)} rows are there twice: used once')
        at, times, steps = at[once], times[once], steps[steps > 0.0]
        usual = float(np.median(steps)) if len(steps) else math.nan
        if len(at) < LEAST_SAMPLES or not INTERVALS[0] <= usual <= INTERVALS[1]:
            raise ValueError(f'{len(at)} rows of {kind}, {usual:.4g} s apart: must be '
                             f'{LEAST_SAMPLES} at least, {INTERVALS[0]:g} to {INTERVALS[1]:g} s '
                             "apart; the unit of times in a table: --columns 't=COLUMN:UNIT'")
        values, names = values[at], [rows[row] for row in at]
        self.parts[kind] = times, unit(values, names) if kind == 'attitudes' else values
        self.notes.append(f'{kind} of {source}: {len(at)} rows, {1.0 / usual:.4g} Hz, from '
                          f'{times[0]:.6g} to {times[-1]:.6g} s')

    def check(self) -> None:
        """Raise ValueError if there are no attitudes at the times of the other parts."""
        if 'attitudes' not in self.parts:
            raise ValueError('; '.join(['no attitudes', *self.notes]))
        first, last = self.parts['attitudes'][0][[0, -1]]
        for name, (times, _) in self.parts.items():
            if times[0] > last or times[-1] < first:
                raise ValueError(f'{name} from {times[0]:.6g} to {times[-1]:.6g} s, attitudes '
                                 f'from {first:.6g} to {last:.6g} s: must be of one clock')


def unit(attitudes: Reals, rows: Sequence[str]) -> Reals:
    """Return quaternions (n, 4), normalized.  ValueError, by the name of a row: they are none."""
    norms = np.linalg.norm(attitudes, axis=1, keepdims=True)
    for row in np.flatnonzero(np.abs(norms - 1.0) >= 0.01)[:1]:
        raise ValueError(f'{rows[row]}: |q| = {norms[row, 0]:.4g}: must be 1')
    return attitudes / norms


def known(name: Any, allowed: Collection[str]) -> str:
    """Return a name.  ValueError, with a hint: it is not allowed."""
    if name not in allowed:
        alike = [one for one in allowed if one[:3] == str(name)[:3]] or allowed
        raise ValueError(f'{name!r}: must be one of {", ".join(allowed)}'
                         f'{likely_name(str(name), alike)}')
    return str(name)


def read(path: Path, columns: str | None = None, topics: Sequence[str] = ()) -> Recorded:
    """
    Read a log, a table, or a folder of EuRoC, as `--columns` and `--topic` of the command say.

    Raises OSError, ImportError, LogError or ValueError, which name the file and what to type.
    """
    recorded, unused = Recorded(), list[str]()
    euroc = next((one for one in (path, path / 'mav0') if (one / 'imu0').is_dir()), None)
    is_log = path.suffix == '.mcap' or (path.is_dir() and not euroc)
    try:
        if (columns and (is_log or euroc)) or (topics and not is_log):
            raise ValueError('--columns is for tables, and --topic for logs')
        if is_log:
            unused = _add_log(recorded, path, topics)
        elif euroc:
            for name in OF_EUROC:
                table, rows = read_columns(euroc / name)
                unused += _add(recorded, {EUROC.get(BRACKETS.sub('', column), column): cells
                                          for column, cells in table.items()}, rows, {})
            unused += sorted({one.relative_to(euroc).as_posix() for one in euroc.glob('*/*.*')}
                             .difference(OF_EUROC))
        else:
            table, rows = read_columns(path)
            if [*table] in TUM and path.suffix != '.csv' and not columns:
                table = dict(zip(OF_TUM, table.values(), strict=True))
            unused = _add(recorded, table, rows, columns_said(columns or ''))
        recorded.notes += [f'not used: {", ".join(unused)}'] * bool(unused)
        recorded.check()
    except (ValueError, EOFError, csv.Error, BadZipFile) as error:
        raise ValueError(f'{path}: {one_line(error)}') from error
    return recorded


def _add_log(recorded: Recorded, path: Path, wanted: Sequence[str]) -> list[str]:
    """Add the parts of a log; return what is not used.  Raises LogError or ValueError."""
    ours, end_ns = list[str | None](), NEVER_NS
    with LogReader(path) as reader:
        with contextlib.suppress(recorded_run.ForeignLogError):
            run = recorded.run = recorded_run.read_run_description(reader)
            ours = [run.topics.get(name) for name in OURS]
            for one in [one for one in run.events if one.event.kind != 'start'][:1]:
                end_ns = one.stamp_ns
                recorded.notes.append(f'read up to the first event, at {stamp_text(end_ns)} s')
        if not reader.whole:
            recorded.notes.append('the log is damaged: what is whole is read')
        found = samples(reader, end_ns)
        unused = {topic.name for topic in reader.topics if topic.type_name not in PLACES}
    sources = {name for every in found.values() for name in every}
    for name in {*wanted} - sources:
        raise ValueError(f'--topic {name}: the log has {", ".join(sorted(sources)) or "none"}')
    many = {one for every in found.values() for one in every if len(every[one]) >= LEAST_SAMPLES}
    groups = wanted, *([one] for one in ours), many, sources.copy()
    for kind, every in found.items():
        here = next(filter(None, ([name for name in every if name in group] for group in groups)))
        if len(here) > 1:
            raise ValueError(f'{kind} are in {", ".join(here)}: choose by --topic {here[0]}')
        rows = every[here[0]]
        sources.discard(here[0])
        recorded.add(kind, here[0], [row.stamp_ns for row in rows],
                     np.array([row.values for row in rows]),
                     [f'message {k}' for k in range(len(rows))])
    return sorted(unused | sources)


def columns_said(text: str) -> Chosen:
    """Return the columns that 't=sec:s+nanosec:ns, qw=rot_0, az=' says; none: left out."""
    said: Chosen = {}
    text = Path(text).read_text('utf-8') if text and '=' not in text else text
    for item in filter(str.strip, re.split(r'[,\n]', text)):
        name, equals, what = map(str.strip, item.partition('='))
        if name not in UNITS or not equals or name in said:
            raise ValueError(f"--columns '{item.strip()}': must be NAME=COLUMN:UNIT, with each "
                             f'NAME once, of {", ".join(UNITS)}')
        columns = what.split('+') if name == 't' else [what]
        said[name] = [_column(name, one) for one in columns if one]
    return said


def _column(name: str, text: str) -> tuple[str, str]:
    """Return column and unit of COLUMN:UNIT, COLUMN [UNIT] or COLUMN.  Raises ValueError."""
    column, colon, unit = map(str.strip, text.rpartition(':'))
    if not colon:
        column, unit = unit, (UNIT.search(unit) or ('', ''))[1] or next(iter(UNITS[name]))
    if unit not in UNITS[name]:
        raise ValueError(f"--columns '{name}={column}:{unit}': the unit must be one of "
                         f'{", ".join(UNITS[name])}')
    return column, unit


def _chosen(columns: Columns, said: Chosen, wanted: Sequence[str]) -> Chosen:
    """Return the columns of the parts that are wanted, or there.  Raises ValueError."""
    chosen, alike = dict(said), dict[str, list[str]]()
    for column in columns:
        if like := ALIKE.search(column.lower()):
            alike.setdefault(like[1] + like[2], []).append(column)
        name = BRACKETS.sub('', column)
        if name in UNITS and name not in said:
            chosen[name] = [_column(name, column), *chosen.get(name, ())]
    unclear = [
        name for kind, (names, _) in PARTS.items()
        if kind in wanted or any(chosen.get(name, name in alike) for name in names)
        for name in names if not said.get(name) and len(chosen.get(name, ())) != 1]
    if unclear:
        items = (f'{name}={" or ".join(alike.get(name, ["COLUMN"]))}:UNIT' for name in unclear)
        units = dict.fromkeys(', '.join(UNITS[name]) for name in unclear)
        raise ValueError(f"say --columns '{', '.join(items)}', each UNIT one of "
                         f"{'; '.join(units)}; or leave a part out, such as 'ax=, ay=, az='; the "
                         f'file has {", ".join(columns) or "no columns"}')
    return chosen


def _add(recorded: Recorded, columns: Columns, rows: Sequence[str], said: Chosen) -> list[str]:
    """Add the parts of a table; return what is not used.  Raises ValueError."""
    chosen = _chosen(columns, said, ('t',) if recorded.parts else ('t', 'attitudes'))
    used = {known(column, columns) for pairs in chosen.values() for column, _ in pairs}
    for kind, (names, units) in PARTS.items():
        pairs = [pair for name in names for pair in chosen.get(name, ())]
        source = ', '.join(f'{column} [{unit}]' for column, unit in pairs).replace(' [1]', '')
        values = [units[unit] * column_numbers(columns, column, rows, exact=kind == 't')
                  for column, unit in pairs]
        if kind == 't':
            stamps = sum(values)
            recorded.notes.append(f'times of column {source}')
        elif values:
            recorded.add(kind, source, stamps, np.stack(values, axis=1), rows)
    return [column for column in columns if column not in used]
