# SPDX-License-Identifier: Apache-2.0
"""Tables of the true states, for programs without ROS: CSV, or Parquet through pyarrow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation

# Names and units of the columns.
UNITS = {
    't': 's', 'theta': 'rad', 'theta_dot': 'rad/s', 'phi': 'rad', 'phi_dot': 'rad/s',
    'psi': 'rad', 'psi_dot': 'rad/s', 'qx': '1', 'qy': '1', 'qz': '1', 'qw': '1',
    'omega_1': 'rad/s', 'omega_2': 'rad/s', 'omega_3': 'rad/s', 'energy': 'J',
    'l3': 'kg m^2/s', 'lz': 'kg m^2/s'}
ROWS_AT_ONCE = 20_000

# The columns of consecutive rows, in the order of UNITS, each (n,).
Rows = Sequence[NDArray[np.float64]]


def write_table(path: Path, file_format: str, values: Mapping[str, Any], duration_ns: int,
                commands: Sequence[tuple[int, float, float]],
                show: Callable[[int], None]) -> str:
    """
    Simulate a run into a new table of states, on the grid of `pose.rate`.

    Parameters
    ----------
    path : Path
        The table; it must not exist.
    file_format : {'csv', 'parquet'}
        Format of the file.
    values : mapping
        Checked parameters (`parameters.checked`).
    duration_ns : int
        Simulated time [ns].
    commands : sequence of (int, float, float)
        Time [ns], L3 and Lz [kg m^2/s], in ascending order of time.
    show : callable
        Takes the simulated time reached [ns].

    Returns
    -------
    str
        Number of rows and names of columns.

    Raises
    ------
    OSError
        The file exists, or writing failed.
    ValueError
        pyarrow is missing, the motion cannot begin, or a command is refused.
    IntegrationError
        The Euler form cannot go on.
    """
    # Before there is a file: pyarrow may be missing, and there may be no motion.
    write = _write_csv if file_format == 'csv' else _parquet_writer()
    simulation = Simulation(values)
    period_ns = max(1, round(NANOSECONDS / values['pose.rate']))
    count = 0

    def counted() -> Iterator[Rows]:
        nonlocal count
        for rows in _rows(simulation, period_ns, duration_ns, commands):
            yield rows
            count += len(rows[0])
            show(count * period_ns)

    with open(path, 'xb') as file:
        write(file, counted())
    return f'{count} rows of {", ".join(UNITS)}'


def _rows(simulation: Simulation, period_ns: int, duration_ns: int,
          commands: Sequence[tuple[int, float, float]]) -> Iterator[Rows]:
    """Yield consecutive rows of the table.  A command changes the rows after its time."""
    next_ns = 0
    stops = [*((at_ns, (l3, lz)) for at_ns, l3, lz in commands), (duration_ns, None)]
    for end_ns, momenta in stops:
        while next_ns <= end_ns:
            count = min((end_ns - next_ns) // period_ns + 1, ROWS_AT_ONCE)
            times = range(next_ns, next_ns + count * period_ns, period_ns)
            states = simulation.segment.states(times)
            columns = (np.array(times) / NANOSECONDS, states.theta, states.theta_dot, states.phi,
                       states.phi_dot, states.psi, states.psi_dot, *states.quaternion.T,
                       *states.angular_velocity.T, states.energy, states.l3, states.lz)
            yield [np.broadcast_to(column, count) for column in columns]
            next_ns += count * period_ns
        simulation.advance(end_ns)
        if momenta is not None:
            simulation.command(*momenta)


def _write_csv(file: BinaryIO, blocks: Iterable[Rows]) -> None:
    head = ','.join(f'{name} [{unit}]' for name, unit in UNITS.items())
    file.write(f'{head}\n'.encode())
    for columns in blocks:
        lines = zip(*(column.tolist() for column in columns), strict=True)
        file.write(''.join(','.join(map(repr, line)) + '\n' for line in lines).encode())


def _parquet_writer() -> Callable[[BinaryIO, Iterable[Rows]], None]:
    """Return what writes a Parquet file.  Raises ValueError where pyarrow is missing."""
    try:
        import pyarrow as pa  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise ValueError(f'parquet needs the Python package pyarrow: {error}') from error
    schema = pa.schema([(name, pa.float64()) for name in UNITS])

    def write(file: BinaryIO, blocks: Iterable[Rows]) -> None:
        with parquet.ParquetWriter(file, schema) as writer:
            for columns in blocks:
                writer.write_table(pa.table(list(map(np.ascontiguousarray, columns)),
                                            schema=schema))
    return write
