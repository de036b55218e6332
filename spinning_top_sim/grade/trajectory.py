# SPDX-License-Identifier: Apache-2.0
"""What a simulator returns, checked, and what follows from it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Reals

# Columns of each part, 0: numbers.
_PARTS = {'attitudes': 4, 'rates': 3, 'accelerations': 3, 'gyroscope': 3, 'magnetometer': 3,
          'increments': 6, 'energy': 0}
LEAST_SAMPLES = 50


class InvalidTrajectoryError(ValueError):
    """A simulator has returned no motion; the text names what and why."""


@dataclass(frozen=True)
class Trajectory:
    """
    A motion at n equally spaced times, as a simulator tells it.

    Parameters
    ----------
    t : (n,) array
        Times [s].
    attitudes : (n, 4) array
        q(world <- body) as w, x, y, z.
    rates : (n, 3) array, optional
        Angular velocity in the body frame [rad/s].
    accelerations, gyroscope, magnetometer : (n, 3) array, optional
        Readings in the frame of the IMU [m/s^2, +g upwards at rest], [rad/s], [T].
    increments : (n, 6) array, optional
        Rotation [rad] and velocity [m/s] in the frame of the IMU over the interval that ends at
        each time; the first row is not used.
    energy : (n,) array, optional
        Kinetic and potential energy, but for a constant [J].
    covariance : mapping, optional
        Covariances (3, 3) that the simulator tells of 'gyroscope' and 'accelerations'; a single
        matrix is meant for both.
    """

    t: Reals
    attitudes: Reals
    rates: Reals | None = None
    accelerations: Reals | None = None
    gyroscope: Reals | None = None
    magnetometer: Reals | None = None
    increments: Reals | None = None
    energy: Reals | None = None
    covariance: Mapping[str, Reals] | None = None

    @classmethod
    def of(cls, said: Any, times: Reals) -> Self:
        """Return what a run has said.  Raises InvalidTrajectoryError if it is no motion."""
        if hasattr(said, 'attitudes'):
            said = {name: getattr(said, name, None) for name in cls.__dataclass_fields__}
        elif not isinstance(said, Mapping):
            said = {'attitudes': said}
        n = len(times)
        if 'attitudes' not in said:
            raise InvalidTrajectoryError(f'the mapping has {sorted(map(str, said))}: must have '
                                         'attitudes')
        parts = {name: _numbers(name, said[name], (n, columns) if columns else (n,))
                 for name, columns in _PARTS.items() if said.get(name) is not None}
        attitudes = parts.pop('attitudes')
        norms = np.linalg.norm(attitudes, axis=1, keepdims=True)
        for at in np.flatnonzero(~(np.abs(norms - 1.0) < 1e-2)):
            raise InvalidTrajectoryError(f'attitudes[{at}] = {attitudes[at].tolist()}: the norm '
                                         'must be 1')
        attitudes /= norms
        flips = np.cumprod(np.where(np.sum(attitudes[1:] * attitudes[:-1], axis=1) < 0.0, -1, 1))
        attitudes[1:] *= flips[:, np.newaxis]
        covariance = said.get('covariance')
        if covariance is not None:
            covariance = covariance if isinstance(covariance, Mapping) else dict.fromkeys(
                ('gyroscope', 'accelerations'), covariance)
            covariance = {name: _numbers(f'covariance of {name}', matrix, (3, 3))
                          for name, matrix in covariance.items()}
        return cls(times, attitudes, covariance=covariance, **parts)

    @property
    def step(self) -> float:
        """Time between two samples [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @cached_property
    def rotation(self) -> Rotation:
        """Rotations world <- body."""
        return Rotation.from_quat(self.attitudes[:, [1, 2, 3, 0]])


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Reals:
    """Return an array of this shape.  Raises InvalidTrajectoryError."""
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidTrajectoryError(f'{name}: {error}') from error
    if numbers.shape != shape:
        raise InvalidTrajectoryError(f'{name} has shape {numbers.shape}: must be {shape}')
    for at in np.argwhere(~np.isfinite(numbers))[:1]:
        raise InvalidTrajectoryError(f'{name}{at.tolist()} = {numbers[tuple(at)]}: must be finite')
    return numbers


def equally_spaced(times: Any) -> Reals:
    """Return times (n,) [s].  Raises InvalidTrajectoryError unless they are equally spaced."""
    t = np.array(times, dtype=float)
    if t.ndim != 1 or len(t) < LEAST_SAMPLES:
        raise InvalidTrajectoryError(f'times have shape {t.shape}: must be (n,), n >= '
                                     f'{LEAST_SAMPLES}')
    steps = np.diff(t)
    for at in np.flatnonzero(~(np.abs(steps - np.median(steps)) <= 1e-3 * np.median(steps)))[:1]:
        raise InvalidTrajectoryError(
            f'times[{at + 1}] - times[{at}] = {steps[at]:g} s after {np.median(steps):g} s: must '
            'be equally spaced')
    return t
