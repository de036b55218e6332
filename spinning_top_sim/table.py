# SPDX-License-Identifier: Apache-2.0
"""Tables of true states, as CSV and Parquet; numbers are read back to the last bit."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed

FilePath = str | Path

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
