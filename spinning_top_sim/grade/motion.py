# SPDX-License-Identifier: Apache-2.0
"""What a simulator returns, checked, beside the exact motion."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Body
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch, white

READINGS = 'rates', 'gyroscope', 'accelerations', 'magnetometer'
LEAST_SAMPLES = 30
NORM = 1e-2             # by which the norm of a quaternion may differ from 1


class InvalidTrajectoryError(ValueError):
    """A simulator has returned no motion; the text names what and why."""


@dataclass
class Trajectory:
    """
    A motion at n equally spaced times, as a simulator tells it.

    Parameters
    ----------
    t : (n,) array
        Times [s].
    attitudes : (n, 4) array
        q(world <- body) as x, y, z, w.
    rates : (n, 3) array, optional
        Angular velocity in the body frame [rad/s].
    gyroscope, accelerations, magnetometer : (n, 3) array, optional
        Readings in the frame of the IMU [rad/s], [m/s^2, +g upwards at rest], [T].
    covariance : mapping, optional
        Covariances (3, 3) that the simulator tells of 'gyroscope' and 'accelerations'; a single
        matrix is meant for both.
    """

    t: Reals
    attitudes: Reals
    rates: Reals | None = None
    gyroscope: Reals | None = None
    accelerations: Reals | None = None
    magnetometer: Reals | None = None
    covariance: Mapping[str, Reals] = field(default_factory=dict)

    @classmethod
    def of(cls, said: Any, times: Any = None) -> Self:
        """Return what a run has said, by default at its `t`.  Raises InvalidTrajectoryError."""
        if not isinstance(said, Mapping):
            said = {name: getattr(said, name, None) for name in cls.__dataclass_fields__} if (
                hasattr(said, 'attitudes')) else {'attitudes': said}
        said = {str(name): part for name, part in said.items() if part is not None}
        if 'attitudes' not in said:
            raise InvalidTrajectoryError(f'what is returned has {sorted(said) or "nothing"}: must '
                                         'have attitudes')
        times = said.get('t') if times is None else times
        if times is None:
            raise InvalidTrajectoryError('times = None: must be given, the trajectory has no t')
        t = _numbers('times', times, (np.size(times),))
        if len(t) < LEAST_SAMPLES:
            raise InvalidTrajectoryError(f'{len(t)} times: must be {LEAST_SAMPLES} at least')
        steps, usual = np.diff(t), np.median(np.diff(t))
        for at in np.flatnonzero(~(np.abs(steps - usual) <= 1e-3 * usual) | (steps <= 0.0))[:1]:
            raise InvalidTrajectoryError(f'times[{at + 1}] - times[{at}] = {steps[at]:g} s where '
                                         f'{usual:g} s is usual: must be equally spaced, > 0')
        attitudes = _numbers('attitudes', said['attitudes'], (len(t), 4))
        norms = np.linalg.norm(attitudes, axis=1, keepdims=True)
        for at in np.flatnonzero(~(np.abs(norms - 1.0) < NORM))[:1]:
            raise InvalidTrajectoryError(f'attitudes[{at}] = {attitudes[at].tolist()}: the norm '
                                         'must be 1')
        told = said.get('covariance', {})
        if not isinstance(told, Mapping):
            told = {'gyroscope': told, 'accelerations': told}
        if others := [*map(str, told.keys() - {'gyroscope', 'accelerations'})]:
            raise InvalidTrajectoryError(f'covariance of {", ".join(others)}: must be of gyroscope'
                                         ' or accelerations')
        return cls(t, attitudes / norms, **{
            name: _numbers(name, said[name], (len(t), 3)) for name in READINGS if name in said},
            covariance={name: _numbers(f'covariance of {name}', matrix, (3, 3))
                        for name, matrix in told.items()})

    @property
    def step(self) -> float:
        """Interval between samples [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    def stretch(self, rates: Reals | None = None) -> Stretch:
        """Return the motion with its readings; `rates` are those of the motion if not None."""
        readings = {name: values for name in READINGS
                    if (values := getattr(self, name)) is not None}
        return Stretch(self.t, Rotation.from_quat(self.attitudes), np.zeros((len(self.t), 3)),
                       readings, {name: white(values, jumps=False)
                                  for name, values in readings.items()}, rates=rates)


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


class Motion:
    """
    A motion beside the exact one from the same state.

    errors : angles to the exact attitudes (n,) [rad]
    smoothed : what the body does, by its attitudes or by the rates told
    """

    def __init__(self, name: str, body: Body, start: State, trajectory: Trajectory) -> None:
        self.name, self.body, self.start, self.trajectory = name, body, start, trajectory
        self.solution = ExactSolution(body, start)
        self.truth: Reals = self.solution.states_at_seconds(trajectory.t).quaternion
        self.stretch: Stretch = trajectory.stretch()
        self.smoothed = Smoothed(self.stretch, 1)
        rotation = self.stretch.rotation
        self.errors: Reals = (Rotation.from_quat(self.truth).inv() * rotation).magnitude()

    @property
    def worst(self) -> float:
        """The largest error [rad]."""
        return float(np.max(self.errors))

    def use_rates(self, told: bool, in_world: bool) -> None:
        """Take rates from the attitudes, or those told; `in_world` : these are in its axes."""
        rates = self.trajectory.rates if told else None
        if rates is not None and in_world:
            rates = self.stretch.rotation.inv().apply(rates)
        self.stretch = self.trajectory.stretch(rates)
        self.smoothed = Smoothed(self.stretch, 1)

    @property
    def slack(self) -> float:
        """By how much readings may differ from attitudes: half a step may be between them."""
        first, second = self.stretch.rotation[0], self.stretch.rotation[1]
        told = self.stretch.rates is not None
        return 0.0 if told else float(0.5 * (first.inv() * second).magnitude()) ** 2

    @property
    def marks(self) -> dict[str, float]:
        """The largest error, and the largest relative changes of the constants of the motion."""
        body, w = self.body, self.smoothed.rates
        up = self.smoothed.turn[:, 2]
        momenta = w * body.inertia
        values = {'energy': 0.5 * np.sum(momenta * w, axis=1) + body.gravity_torque * up[:, 2],
                  'l3': momenta[:, 2], 'lz': np.sum(momenta * up, axis=1)}
        first = self.solution.states_at_seconds(np.zeros(1))
        return {'total_error_deg': math.degrees(self.worst), **{
            f'{name}_drift': float(np.max(np.abs(relative_drift(
                value, float(getattr(first, name)[0]))))) for name, value in values.items()}}

