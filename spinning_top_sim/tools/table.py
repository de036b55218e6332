# SPDX-License-Identifier: Apache-2.0
"""Tables of the true states, for programs without ROS: CSV, or Parquet through pyarrow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.streams.schedule import offline_targets

# Names and units of the columns.
UNITS = {
    't': 's', 'theta': 'rad', 'theta_dot': 'rad/s', 'phi': 'rad', 'phi_dot': 'rad/s',
    'psi': 'rad', 'psi_dot': 'rad/s', 'qx': '1', 'qy': '1', 'qz': '1', 'qw': '1',
    'omega_1': 'rad/s', 'omega_2': 'rad/s', 'omega_3': 'rad/s', 'energy': 'J',
    'l3': 'kg m^2/s', 'lz': 'kg m^2/s'}
ROWS_AT_ONCE = 20_000

# Time [ns], and L3 and Lz commanded there [kg m^2/s].
Stop = tuple[int, tuple[float, float] | None]
# Consecutive rows of the table; the first axis has the columns, in the order of UNITS.
Rows = NDArray[np.float64]


def write_table(path: Path, file_format: str, values: Mapping[str, Any], stops: Sequence[Stop],
                show: Callable[[float], object]) -> str:
    """
    Simulate a run into a new table of states, on the grid of `pose.rate`; return what it holds.

    file_format : 'csv' or 'parquet'
    stops : in ascending order of time, the last one is the end of the run
    show : takes the simulated time reached [s]
    """
    # Before there is a file: pyarrow may be missing, and there may be no motion.
    write = _write_csv if file_format == 'csv' else _parquet_writer()
    simulation = Simulation(values)
    period_ns = max(1, round(NANOSECONDS / values['pose.rate']))
    write(path, _rows(simulation, period_ns, stops, show))
    return f'{stops[-1][0] // period_ns + 1} rows of {", ".join(UNITS)}'


def _rows(simulation: Simulation, period_ns: int, stops: Sequence[Stop],
          show: Callable[[float], object]) -> Iterator[Rows]:
    """Yield consecutive rows of the table.  A command changes the rows after its time."""
    next_ns = 0
    for target_ns, momenta in offline_targets(0, stops, ROWS_AT_ONCE * period_ns):
        times = range(next_ns, target_ns + 1, period_ns)
        if times:
            states = simulation.segment.states(times)
            yield np.stack(np.broadcast_arrays(
                np.array(times) / NANOSECONDS, states.theta, states.theta_dot, states.phi,
                states.phi_dot, states.psi, states.psi_dot, *states.quaternion.T,
                *states.angular_velocity.T, states.energy, states.l3, states.lz))
            next_ns = times[-1] + period_ns
        simulation.advance(target_ns)
        if momenta is not None:
            simulation.command(*momenta)
        show(target_ns / NANOSECONDS)


def _write_csv(path: Path, blocks: Iterable[Rows]) -> None:
    with open(path, 'x', encoding='utf-8') as file:
        file.write(','.join(f'{name} [{unit}]' for name, unit in UNITS.items()) + '\n')
        for rows in blocks:
            # csv.writer looks for what to quote in every number, and takes a third longer.
            file.writelines(','.join(map(repr, row)) + '\n' for row in rows.T.tolist())


def _parquet_writer() -> Callable[[Path, Iterable[Rows]], None]:
    """Return what writes a Parquet file.  Raises ValueError where pyarrow is missing."""
    try:
        import pyarrow as pa  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise ValueError(f'parquet needs the Python package pyarrow: {error}') from error
    schema = pa.schema([(name, pa.float64()) for name in UNITS])

    def write(path: Path, blocks: Iterable[Rows]) -> None:
        with open(path, 'xb') as file, parquet.ParquetWriter(file, schema) as writer:
            for rows in blocks:
                writer.write_table(pa.table(list(rows), schema=schema))
    return write
