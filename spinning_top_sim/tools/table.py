# SPDX-License-Identifier: Apache-2.0
"""The truth as a table for people without ROS tools: CSV, or Parquet through pyarrow."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.solvers.propagator import ExactPropagator
from spinning_top_sim.solvers.rk45 import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation

# Name, unit, and how to read it from states.
COLUMNS: tuple[tuple[str, str, Callable[[Any], Any]], ...] = (
    ('theta', 'rad', lambda s: s.theta), ('theta_dot', 'rad/s', lambda s: s.theta_dot),
    ('phi', 'rad', lambda s: s.phi), ('phi_dot', 'rad/s', lambda s: s.phi_dot),
    ('psi', 'rad', lambda s: s.psi), ('psi_dot', 'rad/s', lambda s: s.psi_dot),
    *((f'q{axis}', '1', lambda s, i=i: _component(s.quaternion, i))
      for i, axis in enumerate('xyzw')),
    *((f'omega_{i + 1}', 'rad/s', lambda s, i=i: s.body_rates[i]) for i in range(3)),
    ('energy', 'J', lambda s: s.energy), ('l3', 'kg m^2/s', lambda s: s.l3),
    ('lz', 'kg m^2/s', lambda s: s.lz))
ROWS_AT_ONCE = 20_000


def _component(quaternion: Any, i: int) -> Any:
    return quaternion[:, i] if isinstance(quaternion, np.ndarray) else quaternion[i]


def write_table(path: Path, kind: str, values: Mapping[str, Any], duration_ns: int,
                commands: Sequence[tuple[int, float, float]],
                show: Callable[[int], None]) -> str:
    """
    Write the states on the grid of `pose.rate` into a new file; return what to tell about it.

    kind: 'csv' or 'parquet'.  Raises OSError (FileExistsError rather than overwrite), ValueError.
    """
    names = ['t', *(name for name, _, _ in COLUMNS)]
    rows = 0
    with open(path, 'xb') as file:
        write, close = _writer(kind, file, names)
        for block in _blocks(values, duration_ns, commands, show):
            write(block)
            rows += len(block[0])
        close()
    return f'{rows} rows of {", ".join(names)}'


def _blocks(values: Mapping[str, Any], duration_ns: int,
            commands: Sequence[tuple[int, float, float]],
            show: Callable[[int], None]) -> Iterator[list[Any]]:
    """Yield columns of consecutive states, t [s] first."""
    simulation = Simulation(values)
    period = max(1, round(NANOSECONDS / values['pose.rate']))
    ends = [(at_ns, (l3, lz)) for at_ns, l3, lz in commands if at_ns <= duration_ns]
    next_ns = 0
    for end_ns, command in (*ends, (duration_ns, None)):
        while next_ns <= end_ns:
            count = min((end_ns - next_ns) // period + 1, ROWS_AT_ONCE)
            times = next_ns + period * np.arange(count, dtype=np.int64)
            yield [times / NANOSECONDS, *_columns(simulation, times, period)]
            next_ns += count * period
            show(int(times[-1]))
        simulation.advance(end_ns)
        if command is not None:
            simulation.command(*command)


def _columns(simulation: Simulation, times: Any, period: int) -> list[Any]:
    solver = simulation.solver
    if isinstance(solver, ExactPropagator):
        grid = solver.grid(int(times[0]) - simulation.anchor_ns, period, len(times))
        return [np.broadcast_to(read(grid), len(times)) for _, _, read in COLUMNS]
    rows = []
    for t_ns in times.tolist():
        state = solver.at_ns(t_ns - simulation.anchor_ns)
        rows.append([read(state) for _, _, read in COLUMNS])
    return list(np.array(rows).T)


def _writer(kind: str, file: Any, names: Sequence[str]) -> tuple[Callable[[list[Any]], None],
                                                                 Callable[[], None]]:
    if kind == 'csv':
        units = ['s', *(unit for _, unit, _ in COLUMNS)]
        head = ','.join(f'{name} [{unit}]' for name, unit in zip(names, units, strict=True))
        file.write(f'{head}\n'.encode())

        def write_csv(columns: list[Any]) -> None:
            lists = [np.asarray(column).tolist() for column in columns]
            text = '\n'.join(','.join(map(repr, row)) for row in zip(*lists, strict=True))
            file.write(f'{text}\n'.encode())
        return write_csv, lambda: None
    try:
        import pyarrow as pa  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise ValueError(f'parquet needs the Python package pyarrow: {error}') from error
    schema = pa.schema([(name, pa.float64()) for name in names])
    writer = parquet.ParquetWriter(file, schema)
    return (lambda columns: writer.write_table(pa.table(
        [np.ascontiguousarray(column) for column in columns], schema=schema))), writer.close
