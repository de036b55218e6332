# SPDX-License-Identifier: Apache-2.0
"""Tables of true states, as CSV and Parquet; their numbers are read back to the last bit."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.stream import Encoded, Samples, Stream

# Names and units of the columns of a table.
UNITS = {
    't': 's', 'theta': 'rad', 'theta_dot': 'rad/s', 'phi': 'rad', 'phi_dot': 'rad/s',
    'psi': 'rad', 'psi_dot': 'rad/s', 'qx': '1', 'qy': '1', 'qz': '1', 'qw': '1',
    'omega_1': 'rad/s', 'omega_2': 'rad/s', 'omega_3': 'rad/s', 'energy': 'J',
    'l3': 'kg m^2/s', 'lz': 'kg m^2/s'}
RIDE_UNITS = {**UNITS, 'x': 'm', 'y': 'm', 'z': 'm', 'vx': 'm/s', 'vy': 'm/s', 'vz': 'm/s'}


class TrueStates(Stream):
    """
    The true states as rows of numbers: a stream whose messages are the rows of a table.

    units : names and units of its columns: UNITS, and those that `added` returns for samples
    """

    def __init__(self, period_ns: int, units: Mapping[str, str],
                 added: Callable[[Samples], Sequence[NDArray[np.float64]]] = lambda _: (),
                 ) -> None:
        self.period_ns, self.units, self._added = period_ns, units, added

    @property
    def size(self) -> int:
        return 8 * len(self.units)

    def encode(self, *samples: Samples) -> Encoded:
        return (np.concatenate([one.t_ns for one in samples]),
                np.concatenate([self._rows(one) for one in samples]))

    def _rows(self, samples: Samples) -> NDArray[np.float64]:
        states = samples.states
        return np.stack(np.broadcast_arrays(
            samples.t_ns / NANOSECONDS, states.theta, states.theta_dot, states.phi, states.phi_dot,
            states.psi, states.psi_dot, *states.quaternion.T, *states.angular_velocity.T,
            states.energy, states.l3, states.lz, *self._added(samples)), axis=-1)


def write_csv(path: Path, blocks: Iterable[NDArray[np.float64]],
              units: Mapping[str, str]) -> None:
    """Write rows with a head of names and units.  An existing file raises FileExistsError."""
    with open(path, 'x', encoding='utf-8') as file:
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
    with open(path, 'xb') as file, parquet.ParquetWriter(file, schema) as writer:
        for rows in blocks:
            writer.write_table(pa.table(list(rows.T), schema=schema))
