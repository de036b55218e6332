# SPDX-License-Identifier: Apache-2.0
"""Tables of true states as messages of a channel, and as Parquet."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed
from spinning_top_sim.streams.channel import Channel, Rows
from spinning_top_sim.streams.messages import Values, fill
from spinning_top_sim.table import RIDE_UNITS, UNITS, columns
from spinning_top_sim.times import NANOSECONDS, Times


class Columns:
    """Encodes fields of so many columns each as the rows of a table, (n, columns)."""

    def __init__(self, counts: Sequence[int]) -> None:
        self._counts = counts

    def __len__(self) -> int:
        return 8 * sum(self._counts)

    def encode(self, stamps_ns: Times, fields: Sequence[Values]) -> Rows:
        table = np.empty((sum(self._counts), len(stamps_ns)))
        fill([field.T for field in np.split(table, np.cumsum(self._counts)[:-1])], fields)
        return table.T


def true_states(period_ns: int, *, pivot_moves: bool) -> Channel:
    """Return the channel whose messages are the rows of a table of true states."""
    return Channel('table', '', '', period_ns,
                   Columns([len(RIDE_UNITS if pivot_moves else UNITS)]),
                   lambda samples: [columns(samples.t_ns / NANOSECONDS, samples.states,
                                            pivot_moves=pivot_moves)])


def write_parquet(path: Path, blocks: Iterable[NDArray[np.float64]],
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
