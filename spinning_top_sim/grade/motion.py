# SPDX-License-Identifier: Apache-2.0
"""Compares a motion with the exact one: errors, drifts, rates."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Body, Reals, Start
from spinning_top_sim.grade.trajectory import Trajectory
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.analysis import Attitudes, measure

# Sixth-order central differences, for samples -3 .. 3.
_WEIGHTS = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
MARGIN = 3


@dataclass(frozen=True)
class Errors:
    """
    Errors of an attitude, simulated minus exact (n,) [rad].

    A small rotation is split in three directions that are regular at the poles: precession is
    turned about the vertical, times sin(theta); nutation changes the tilt; spin turns about the
    axis.  `total` is the angle of the whole rotation.
    """

    total: Reals
    precession: Reals
    nutation: Reals
    spin: Reals


def errors_of(rotation: Rotation, truth: Rotation) -> Errors:
    """Split the rotation between two attitudes world <- body at n times."""
    tips, tilts = [], []
    for one in (rotation, truth):
        x, y, z = one.apply((0.0, 0.0, 1.0)).T
        tips.append(x + 1j * y)
        tilts.append(np.arctan2(np.hypot(x, y), z))
    between = truth.inv() * rotation
    _, _, z, w = between.as_quat().T
    return Errors(
        total=between.magnitude(), nutation=tilts[0] - tilts[1],
        precession=np.unwrap(np.angle(tips[0] * np.conj(tips[1]))) * np.abs(tips[1]),
        spin=np.unwrap(2.0 * np.arctan2(z, w)))


def derivative(values: Reals, step: float) -> Reals:
    """Return the derivative of rows (n, k) at all samples but `MARGIN` at each end."""
    n = len(values) - 2 * MARGIN
    total: Reals = sum(weight * values[at:at + n] for at, weight in enumerate(_WEIGHTS) if weight)
    return total / step


def rates_of_attitudes(rotation: Rotation, step: float) -> Reals:
    """Return body rates [rad/s] at all samples but `MARGIN` at each end, by differences."""
    n = len(rotation) - 2 * MARGIN
    here = rotation[MARGIN:MARGIN + n].inv()
    total: Reals = sum(weight * (here * rotation[at:at + n]).as_rotvec()
                       for at, weight in enumerate(_WEIGHTS) if weight)
    return total / step


@dataclass(frozen=True)
class Motion:
    """A motion of a scene, and the exact one that starts in the same state."""

    name: str
    body: Body
    start: Start
    trajectory: Trajectory

    @cached_property
    def solution(self) -> ExactSolution:
        return ExactSolution(self.body, self.start.state_of(self.body))

    @cached_property
    def errors(self) -> Errors:
        """Errors of the attitude."""
        truth = self.solution.states_at_seconds(self.trajectory.t).quaternion
        return errors_of(self.trajectory.rotation, Rotation.from_quat(truth))

    @property
    def worst(self) -> float:
        """Largest error of the attitude [rad]."""
        return float(np.max(self.errors.total))

    @cached_property
    def rates(self) -> Reals:
        """Body rates at all samples but `MARGIN` at each end, from the attitudes (n - 6, 3)."""
        return rates_of_attitudes(self.trajectory.rotation, self.trajectory.step)

    @cached_property
    def height(self) -> Reals:
        """cos(theta) at all samples but `MARGIN` at each end (n - 6,)."""
        height: Reals = self.trajectory.rotation[MARGIN:-MARGIN].apply((0.0, 0.0, 1.0))[:, 2]
        return height

    def constants(self, rates: Reals) -> tuple[Reals, Reals, Reals]:
        """Return E [J], L3 and Lz [kg m^2/s] (n - 6,), given rates as `rates` has them."""
        constants = self._data(rates).constants(self.body)
        assert constants is not None
        return constants

    def _data(self, rates: Reals) -> Attitudes:
        part = self.trajectory.attitudes[MARGIN:-MARGIN, [1, 2, 3, 0]]
        stamps = np.rint(1e9 * self.trajectory.t[MARGIN:-MARGIN]).astype(np.int64)
        return Attitudes(stamps, np.vstack((part.T, rates.T)))

    def marks(self, rates: Reals) -> dict[str, float]:
        """Return the measures, given rates as `rates` has them; docs/grade.md defines them."""
        marks = {f'{name}_error_deg': math.degrees(float(np.max(np.abs(values))))
                 for name, values in vars(self.errors).items()}
        first = self.solution.states_at_seconds(np.zeros(1))
        for name, values in zip(('energy', 'l3', 'lz'), self.constants(rates), strict=True):
            marks[f'{name}_drift'] = float(np.max(np.abs(relative_drift(
                values, float(getattr(first, name)[0])))))
        exact = self.solution.describe()
        found = measure(self._data(rates), exact.nutation_period)
        for name in ('nutation_period', 'mean_precession_rate'):
            value, right = getattr(found, name), getattr(exact, name)
            marks[f'{name}_error'] = value / right - 1.0 if value and right else math.nan
        return marks
