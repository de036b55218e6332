# SPDX-License-Identifier: Apache-2.0
"""Tables of true states, as CSV and Parquet; their numbers are read back to the last bit."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.streams.cdr import NANOSECONDS, Values, fill
from spinning_top_sim.streams.channel import Channel, Rows, Samples, Stamps
from spinning_top_sim.tools import cli

# Names and units of the columns of a table.
UNITS = {
    't': 's', 'theta': 'rad', 'theta_dot': 'rad/s', 'phi': 'rad', 'phi_dot': 'rad/s',
    'psi': 'rad', 'psi_dot': 'rad/s', 'qx': '1', 'qy': '1', 'qz': '1', 'qw': '1',
    'omega_1': 'rad/s', 'omega_2': 'rad/s', 'omega_3': 'rad/s', 'energy': 'J',
    'l3': 'kg m^2/s', 'lz': 'kg m^2/s'}
RIDE_UNITS = {**UNITS, 'x': 'm', 'y': 'm', 'z': 'm', 'vx': 'm/s', 'vy': 'm/s', 'vz': 'm/s'}


class Columns:
    """Encodes fields of so many columns each as the rows of a table, (n, columns)."""

    def __init__(self, counts: Sequence[int]) -> None:
        self._counts = counts

    def __len__(self) -> int:
        return 8 * sum(self._counts)

    def encode(self, stamps_ns: Stamps, fields: Sequence[Values]) -> Rows:
        columns = np.empty((sum(self._counts), len(stamps_ns)))
        fill([field.T for field in np.split(columns, np.cumsum(self._counts)[:-1])], fields)
        return columns.T


def true_states(period_ns: int, *, pivot_moves: bool) -> Channel:
    """Return the channel whose messages are the rows of a table of true states."""
    return Channel('table', '', '', period_ns,
                   Columns([len(RIDE_UNITS if pivot_moves else UNITS)]),
                   lambda samples: [_true(samples, pivot_moves)])


def _true(samples: Samples, pivot_moves: bool) -> Sequence[NDArray[np.float64]]:
    states = samples.states
    return (
        samples.t_ns / NANOSECONDS, states.theta, states.theta_dot, states.phi, states.phi_dot,
        states.psi, states.psi_dot, *states.rows_quaternion, *states.rows_angular_velocity,
        states.energy, states.l3, states.lz,
        *((*states.pivot.position, *states.pivot.velocity) if pivot_moves else ()))


def write_csv(path: Path, blocks: Iterable[NDArray[np.float64]],
              units: Mapping[str, str]) -> None:
    """Write rows with a head of names and units.  An existing file raises FileExistsError."""
    with cli.new_file(path) as file:
        file.write(','.join(f'{name} [{unit}]' for name, unit in units.items()) + '\n')
        for rows in blocks:
            # csv.writer looks for what to quote in every number, and takes a third longer.
            file.writelines(','.join(map(repr, row)) + '\n' for row in rows.tolist())


def write_parquet(path: Path, blocks: Iterable[NDArray[np.float64]],
                  units: Mapping[str, str]) -> None:
    """Write a Parquet file.  Raises ImportError, and makes no file, without pyarrow."""
    with needed('a Parquet file', 'parquet'):
        import pyarrow as pa  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    schema = pa.schema([pa.field(name, pa.float64(), metadata={'unit': unit})
                        for name, unit in units.items()])
    with cli.new_file(path, 'xb') as file, parquet.ParquetWriter(file, schema) as writer:
        for rows in blocks:
            writer.write_table(pa.table(list(rows.T), schema=schema))
