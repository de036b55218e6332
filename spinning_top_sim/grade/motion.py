# SPDX-License-Identifier: Apache-2.0
"""What a simulator returns, checked, beside the exact motion: errors, drifts, rates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.kinematics import SIDE, Smoothed, Stretch, white
from spinning_top_sim.grade.scenes import Body, Reals
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.analysis import Attitudes, measure

# Columns of each part.
_PARTS = {'attitudes': (4,), 'rates': (3,), 'accelerations': (3,), 'gyroscope': (3,),
          'magnetometer': (3,), 'increments': (6,), 'energy': ()}
LEAST_SAMPLES = 30
READINGS = 'gyroscope', 'accelerations', 'magnetometer'


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
    covariance: Mapping[str, Reals] = field(default_factory=dict)
    @classmethod
    def of(cls, said: Any, times: Any = None) -> Self:
        """Return what a run has said, by default at its `t`.  Raises InvalidTrajectoryError."""
        if hasattr(said, 'attitudes'):
            said = {name: getattr(said, name, None) for name in (*_PARTS, 't', 'covariance')}
        elif not isinstance(said, Mapping):
            said = {'attitudes': said}
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
        parts = {name: _numbers(name, said[name], (len(t), *columns))
                 for name, columns in _PARTS.items() if name in said}
        attitudes = parts.pop('attitudes')
        norms = np.linalg.norm(attitudes, axis=1, keepdims=True)
        for at in np.flatnonzero(~(np.abs(norms - 1.0) < 1e-2)):
            raise InvalidTrajectoryError(f'attitudes[{at}] = {attitudes[at].tolist()}: the norm '
                                         'must be 1')
        told = said.get('covariance')
        if not isinstance(told, Mapping):
            told = {} if told is None else {'gyroscope': told, 'accelerations': told}
        if others := [*map(str, told.keys() - {'gyroscope', 'accelerations'})]:
            raise InvalidTrajectoryError(f'covariance of {", ".join(others)}: must be of gyroscope'
                                         ' or accelerations')
        return cls(t, attitudes / norms, **parts, covariance={
            name: _numbers(f'covariance of {name}', matrix, (3, 3))
            for name, matrix in told.items()})

    @property
    def rotation(self) -> Rotation:
        """The attitudes, world <- body."""
        return Rotation.from_quat(self.attitudes)

    @property
    def step(self) -> float:
        """Interval between samples [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    def moved(self, seconds: float) -> Self:
        """Return the motion with its attitudes at later times."""
        return replace(self, t=self.t + seconds)

    def stretch(self, rates: Reals | None = None) -> Stretch:
        """Return the motion with its readings; `rates` are those that the simulator tells."""
        readings = {name: values for name in READINGS
                    if (values := getattr(self, name)) is not None}
        if self.rates is not None:
            readings['rates'] = self.rates
        if self.increments is not None:
            readings |= {'rotations': self.increments[:, :3], 'velocities': self.increments[:, 3:]}
        sigma = {name: float(np.sqrt(np.mean(white(values) ** 2)))
                 for name, values in readings.items()}
        return Stretch(self.t, self.rotation, np.zeros((len(self.t), 3)), readings, sigma,
                       rates=rates)


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


def errors_by_angle(rotation: Rotation, truth: Rotation) -> dict[str, Reals]:
    """
    Return the angle between attitudes world <- body (n,), and its parts [rad].

    precession : about the vertical, times sin(theta); nutation : of theta; spin : about the axis
    """
    axes = [one.apply((0.0, 0.0, 1.0)).T for one in (rotation, truth)]
    tip, right = (x + 1j * y for x, y, _ in axes)
    tilt, right_tilt = (np.arctan2(np.hypot(x, y), z) for x, y, z in axes)
    between = truth.inv() * rotation
    _, _, z, w = between.as_quat().T
    return {'total': between.magnitude(),
            'precession': np.unwrap(np.angle(tip * np.conj(right))) * np.abs(right),
            'nutation': tilt - right_tilt, 'spin': np.unwrap(2.0 * np.arctan2(z, w))}


@dataclass
class Motion:
    """A motion beside the exact one from the same state."""

    name: str
    body: Body
    start: State
    trajectory: Trajectory
    told: bool = False          # the rates told are those of the motion
    stretch: Stretch = field(init=False)
    smoothed: Smoothed = field(init=False)          # of it
    solution: ExactSolution = field(init=False)
    errors: Mapping[str, Reals] = field(init=False)     # as of `errors_by_angle`
    worst: float = field(init=False)                    # total error [rad]

    def __post_init__(self) -> None:
        self.solution = ExactSolution(self.body, self.start)
        truth = Rotation.from_quat(self.solution.states_at_seconds(self.trajectory.t).quaternion)
        self.errors = errors_by_angle(self.trajectory.rotation, truth)
        self.worst = float(np.max(self.errors['total']))
        self.use_rates(told=False, in_world=False)

    def use_rates(self, told: bool, in_world: bool) -> None:
        """Take rates from the attitudes, or those told; `in_world` : these are in its axes."""
        rates, self.told = self.trajectory.rates, told and self.trajectory.rates is not None
        if rates is not None and in_world:
            rates = self.trajectory.rotation.inv().apply(rates)
        self.stretch = self.trajectory.stretch(rates if self.told else None)
        self.smoothed = self.stretch.at(1)

    @property
    def rates(self) -> Reals:
        """In the body, at all samples but SIDE at each end [rad/s]."""
        return self.smoothed.rates

    @property
    def slack(self) -> float:
        """By how much readings may differ from attitudes: half a step may be between them."""
        first, second = self.trajectory.rotation[0], self.trajectory.rotation[1]
        return 0.0 if self.told else float(0.5 * (first.inv() * second).magnitude()) ** 2

    @property
    def data(self) -> Attitudes:
        """Attitudes and rates."""
        part = self.trajectory.rotation[SIDE:-SIDE].as_quat()
        stamps = np.rint(1e9 * self.trajectory.t[SIDE:-SIDE]).astype(np.int64)
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
