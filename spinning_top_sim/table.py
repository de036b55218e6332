# SPDX-License-Identifier: Apache-2.0
"""
Tables: those of true states are written as CSV and Parquet, and those of other programs are read.

Numbers are read back to the last bit.
"""

import csv
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed

FilePath = str | Path
Columns = Mapping[str, Sequence[Any]]           # numbers, or texts, by name
NUMBER = re.compile(r'[-+]?[\d.]+([eE][-+]?\d+)?')
NUMBERS = re.compile(rf'({NUMBER.pattern}[,;|\s]+){{2}}')         # how a line of them begins

# Names and units of the columns of a table; the second one is for a pivot that moves.
UNITS = {
    't': 's', 'theta': 'rad', 'theta_dot': 'rad/s', 'phi': 'rad', 'phi_dot': 'rad/s',
    'psi': 'rad', 'psi_dot': 'rad/s', 'qx': '1', 'qy': '1', 'qz': '1', 'qw': '1',
    'omega_1': 'rad/s', 'omega_2': 'rad/s', 'omega_3': 'rad/s', 'energy': 'J',
    'l3': 'kg m^2/s', 'lz': 'kg m^2/s'}
RIDE_UNITS = {**UNITS, 'x': 'm', 'y': 'm', 'z': 'm', 'vx': 'm/s', 'vy': 'm/s', 'vz': 'm/s'}


def columns(t: NDArray[np.float64], states: Any, *, pivot_moves: bool) -> Sequence[Any]:
    """Return the columns (n,) of UNITS or RIDE_UNITS of `States` at times (n,) [s]."""
    return (
        t, states.theta, states.theta_dot, states.phi, states.phi_dot, states.psi,
        states.psi_dot, *states.rows_quaternion, *states.rows_angular_velocity, states.energy,
        states.l3, states.lz,
        *((*states.pivot.position, *states.pivot.velocity) if pivot_moves else ()))


def write_csv(path: FilePath, blocks: Iterable[NDArray[np.float64]],
              units: Mapping[str, str]) -> None:
    """Write rows with a head of names and units.  An existing file raises FileExistsError."""
    with new_file(path, partial=True) as file:
        file.write(','.join(f'{name} [{unit}]' for name, unit in units.items()) + '\n')
        for rows in blocks:
            # csv.writer looks for what to quote in every number, and takes a third longer.
            file.writelines(','.join(map(repr, row)) + '\n' for row in rows.tolist())


def write_parquet(path: FilePath, blocks: Iterable[NDArray[np.float64]],
                  units: Mapping[str, str]) -> None:
    """Write a Parquet file.  Raises ImportError, and makes no file, without pyarrow."""
    with needed('a Parquet file', 'parquet'):
        import pyarrow as pa  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    schema = pa.schema([pa.field(name, pa.float64(), metadata={'unit': unit})
                        for name, unit in units.items()])
    with (new_file(path, 'xb', partial=True) as file,
          parquet.ParquetWriter(file, schema) as writer):
        for rows in blocks:
            writer.write_table(pa.table(list(rows.T), schema=schema))


def read_columns(path: Path) -> tuple[Columns, Sequence[str]]:
    """
    Return the columns of a table, and what its rows are called, such as 'line 2'.

    Columns without a name are 'column 1', ...  Raises OSError, ImportError or ValueError.
    """
    kind, rows = path.suffix.lower(), list[str]()
    if kind in ('.csv', '.txt', '.tum', '.tsv'):
        names, columns, rows = _text(path)
    elif kind == '.parquet':
        with needed('a Parquet file', 'parquet'):
            from pyarrow import parquet  # noqa: PLC0415
        table = parquet.read_table(path)
        names, columns = table.column_names, [one.to_numpy() for one in table.columns]
    elif kind == '.npz':
        if not is_zipfile(path):
            raise ValueError('it is no file of numpy.savez')
        with np.load(path, allow_pickle=False) as arrays:
            names, columns = [*arrays], [np.atleast_1d(one) for one in arrays.values()]
    else:
        raise ValueError('must be .mcap, or a table .csv, .txt, .tum, .tsv, .parquet or .npz')
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'two columns are called {name}: each needs a name of its own; '
                             'without a line of names they are column 1, column 2, ...')
    lengths = {len(column) for column in columns}
    if len(lengths) > 1:
        raise ValueError(f'columns have {sorted(lengths)} rows: must have as many')
    return dict(zip(names, columns, strict=True)), rows or [
        f'row {k}' for k in range(max(lengths, default=0))]


def column_numbers(columns: Columns, name: str, rows: Sequence[str], *,
                   exact: bool) -> NDArray[Any]:
    """
    Return a column (n,) as float, NaN where a cell is empty, or exactly, as Decimal.

    Raises ValueError, by what its row is called: a cell is no number, or, if `exact`, empty.
    """
    found = list[Any]()
    for row, cell in zip(rows, columns[name], strict=True):
        text = '' if cell is None else str(cell).strip()
        try:
            number = Decimal(text) if exact else float(text or 'nan')
        except (ArithmeticError, ValueError):
            number = math.inf
        if '_' in text or math.isinf(number) or (math.isnan(number) and exact):
            raise ValueError(f'{row}: {name} = {text[:40]!r}: must be a number such as -12.5')
        found.append(number)
    return np.array(found)


def _text(path: Path) -> tuple[list[str], list[Any], list[str]]:
    """Read columns between commas, semicolons, tabs, bars or spaces; # begins a comment."""
    try:
        lines = [line.strip(' ') for line in path.read_text('utf-8-sig').splitlines()]
    except UnicodeDecodeError as error:
        raise ValueError('it is no text in UTF-8: convert it, as by iconv or gunzip') from error
    bare = ['' if line[:1] == '#' else line for line in lines]
    first = next(filter(str.strip, bare), '')
    mark = next((mark for mark in ',;\t|' if mark in first), ' ')

    def cells(lines: Sequence[str]) -> list[list[str]]:
        return [[*map(str.strip, row)]
                for row in csv.reader(lines, delimiter=mark, skipinitialspace=True)]

    heads = cells([first, *(line.strip('# ') for line in lines if line[:1] == '#')])
    names = next((head for head in heads if len(head) == len(heads[0])
                  and not any(map(NUMBER.fullmatch, head))), [''] * len(heads[0]))
    rows = {f'line {k}': row for k, row in enumerate(cells(bare), 1) if any(row)}
    if rows and names is heads[0]:
        del rows[next(iter(rows))]
    for where, row in rows.items():
        if len(row) != len(names):
            begin = next((k for k, line in enumerate(bare, 1) if NUMBERS.match(line)), 0)
            above = (f'; numbers begin in line {begin}: keep it and a line of names, as by '
                     f'tail -n +{begin - 1}') * (begin > int(where[5:]))
            raise ValueError(f'{where} has {len(row)} values, and there are {len(names)} columns: '
                             f'must be as many, with decimal points; comments begin with #{above}')
    return ([name or f'column {k}' for k, name in enumerate(names, 1)],
            [[row[k] for row in rows.values()] for k in range(len(names))], [*rows])
