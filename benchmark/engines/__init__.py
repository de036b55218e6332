# SPDX-License-Identifier: Apache-2.0
"""
Physics engines and integrators as their documentation uses them, for `grade`.

Each module has `run(top, start, times, dt)` with the options of `benchmark/engines.py`.  The rest
of a run is shared here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import export


def model(top: Any, start: Any, file_format: str) -> str:
    """Return the top, its start and its IMU as `spinning-top export --model` writes them."""
    values = {f'top.{name}': getattr(top, name) for name in (
        'lambda1', 'lambda3', 'mass', 'com_distance', 'gravity')}
    values |= {f'initial.{name}': getattr(start, name) for name in (
        'theta', 'theta_dot', 'phi', 'psi')}
    values |= {'spin.l3': start.l3, 'spin.lz': start.lz, 'imu.lever_arm': top.lever_arm,
               'imu.rpy': tuple(mounting(top).as_euler('xyz'))}
    return export.model(parameters.checked(values), file_format)


def mounting(top: Any) -> Rotation:
    """Return the rotation body <- IMU."""
    return Rotation.from_quat(top.mounting)


def recorded(times: np.ndarray, dt: float, advance: Callable[[int], object],
             read: Callable[[], Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """
    Return what `read` tells at the times.

    advance : makes a number of steps of dt
    """
    every = round((times[1] - times[0]) / dt)
    rows = [{name: np.array(value, float) for name, value in read().items()}]
    for _ in times[1:]:
        advance(every)
        rows.append({name: np.array(value, float) for name, value in read().items()})
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
