# SPDX-License-Identifier: Apache-2.0
"""Compares a motion with the exact one: errors, drifts, rates."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Body, Reals, Start
from spinning_top_sim.grade.trajectory import Trajectory
from spinning_top_sim.physics.states import States, relative_drift
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.analysis import Attitudes, measure

# Sixth-order central differences, for samples -3 .. 3.
_WEIGHTS = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
MARGIN = 3


def errors_of(rotation: Rotation, truth: Rotation) -> dict[str, Reals]:
    """
    Split the rotation between two attitudes world <- body, simulated and exact (n,) [rad].

    A small rotation is split in directions that are regular at the poles: `precession` turns about
    the vertical, times sin(theta); `nutation` is that of theta; `spin` turns about the axis.
    `total` is the angle of the whole rotation.
    """
    tips, tilts = [], []
    for one in (rotation, truth):
        x, y, z = one.apply((0.0, 0.0, 1.0)).T
        tips.append(x + 1j * y)
        tilts.append(np.arctan2(np.hypot(x, y), z))
    between = truth.inv() * rotation
    _, _, z, w = between.as_quat().T
    return {'total': between.magnitude(), 'precession': np.unwrap(np.angle(
                tips[0] * np.conj(tips[1]))) * np.abs(tips[1]),
            'nutation': tilts[0] - tilts[1], 'spin': np.unwrap(2.0 * np.arctan2(z, w))}


@dataclass
class Motion:
    """
    A motion of a scene, and the exact one that starts in the same state.

    told : rates (n, 3) that the simulator tells, where they are right
    """

    name: str
    body: Body
    start: Start
    trajectory: Trajectory
    told: Reals | None = None

    @cached_property
    def solution(self) -> ExactSolution:
        return ExactSolution(self.body, self.start.state_of(self.body))

    @cached_property
    def truth(self) -> States:
        """The exact states at the times of the samples."""
        return self.solution.states_at_seconds(self.trajectory.t)

    @cached_property
    def errors(self) -> dict[str, Reals]:
        """Errors of the attitude, as `errors_of` has them."""
        return errors_of(self.trajectory.rotation, Rotation.from_quat(self.truth.quaternion))

    @property
    def worst(self) -> float:
        """Largest error of the attitude [rad]."""
        return float(np.max(self.errors['total']))

    @property
    def rates(self) -> Reals:
        """Body rates at all samples but `MARGIN` at each end (n - 6, 3): told, or `derived`."""
        return self.derived if self.told is None else self.told[MARGIN:-MARGIN]

    @cached_property
    def derived(self) -> Reals:
        """
        Body rates from the attitudes.

        What is differentiated is the rotation from the exact attitudes, which turns slowly.
        """
        error = Rotation.from_quat(self.truth.quaternion).inv() * self.trajectory.rotation
        inner, n = slice(MARGIN, -MARGIN), len(self.trajectory.t) - 2 * MARGIN
        here = error[inner].inv()
        total: Reals = sum(weight * (here * error[at:at + n]).as_rotvec()
                           for at, weight in enumerate(_WEIGHTS) if weight)
        return total / self.trajectory.step + here.apply(self.truth.angular_velocity[inner])

    @property
    def accelerations(self) -> Reals:
        """Angular accelerations (n - 12, 3)."""
        inner, n = slice(MARGIN, -MARGIN), len(self.trajectory.t) - 4 * MARGIN
        off = self.rates - self.truth.angular_velocity[inner]
        total: Reals = sum(weight * off[at:at + n] for at, weight in enumerate(_WEIGHTS) if weight)
        return (total / self.trajectory.step
                + self.truth.angular_acceleration[2 * MARGIN:-2 * MARGIN])

    @property
    def data(self) -> Attitudes:
        """Attitudes and rates."""
        part = self.trajectory.attitudes[MARGIN:-MARGIN, [1, 2, 3, 0]]
        stamps = np.rint(1e9 * self.trajectory.t[MARGIN:-MARGIN]).astype(np.int64)
        return Attitudes(stamps, np.vstack((part.T, self.rates.T)))

    @property
    def marks(self) -> dict[str, float]:
        """The measures; docs/grade.md defines them."""
        marks = {f'{name}_error_deg': math.degrees(float(np.max(np.abs(values))))
                 for name, values in self.errors.items()}
        first = self.solution.states_at_seconds(np.zeros(1))
        for name, values in zip(('energy', 'l3', 'lz'), self.data.constants(self.body) or (),
                                strict=True):
            marks[f'{name}_drift'] = float(np.max(np.abs(relative_drift(
                values, float(getattr(first, name)[0])))))
        exact = self.solution.describe()
        found = measure(self.data, exact.nutation_period)
        for name in ('nutation_period', 'mean_precession_rate'):
            value, right = getattr(found, name), getattr(exact, name)
            marks[f'{name}_error'] = value / right - 1.0 if value and right else math.nan
        return marks
