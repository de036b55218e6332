# SPDX-License-Identifier: Apache-2.0
"""The messages of simulated runs as columns, by topic, field and component."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import yaml
from processes import run_module


class Columns:
    """Columns of a run, such as 'imu/dq.quaternion.x', without the rows that have none."""

    def __init__(self, table: Any) -> None:
        self._table = table

    def __call__(self, field: str, components: str = 'xyz') -> np.ndarray:
        """Return the components (n, 3) of a field."""
        return np.stack([self._table[f'{field}.{name}'].drop_null().to_numpy()
                         for name in components], axis=1)


def simulated(params: Sequence[str | Mapping[str, Any]], streams: Sequence[str],
              duration: float, seed: int = 0) -> Columns:
    """Return the columns of a run with the exact solution; params as in a specification."""
    with tempfile.TemporaryDirectory() as folder:
        spec = Path(folder) / 'spec.yaml'
        spec.write_text(yaml.safe_dump({
            'runs': 1, 'duration': duration, 'streams': list(streams),
            'params': [*params, {'solver.method': 'exact'}],
            'sample': {'seed': {'values': [seed]}}}))
        run_module('spinning_top_sim.tools.ensemble', (
            str(spec), '-o', f'{folder}/runs', '--workers', '1', '--quiet'))
        return Columns(pyarrow.dataset.dataset(f'{folder}/runs/data').to_table())
