# SPDX-License-Identifier: Apache-2.0
"""What a simulator returns, checked, beside the exact motion: errors, drifts, rates."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from scipy.ndimage import correlate1d
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Body, Reals, Start, rotation_of
from spinning_top_sim.physics.states import States, relative_drift
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools.analysis import Attitudes, measure

# Columns of each part.
_PARTS = {'attitudes': (4,), 'rates': (3,), 'accelerations': (3,), 'gyroscope': (3,),
          'magnetometer': (3,), 'increments': (6,), 'energy': ()}
LEAST_SAMPLES = 20
# Sixth-order central differences, for samples -3 .. 3.
_WEIGHTS = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
MARGIN = 3


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
    covariance: Mapping[str, Reals] = field(default_factory=dict)
    step: float = field(init=False)             # [s]
    rotation: Rotation = field(init=False)      # world <- body

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

    def __post_init__(self) -> None:
        self.step = float(self.t[-1] - self.t[0]) / (len(self.t) - 1)
        self.rotation = rotation_of(self.attitudes)


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
    start: Start
    trajectory: Trajectory
    derived: bool = True        # the rates are from the attitudes, as before `use_told_rates`
    solution: ExactSolution = field(init=False)
    truth: States = field(init=False)               # of it, at the times of the trajectory
    errors: Mapping[str, Reals] = field(init=False)     # as of `errors_by_angle`
    worst: float = field(init=False)                # total error [rad]
    # In the body, at all samples but MARGIN at each end (n - 6, 3) [rad/s].
    rates: Reals = field(init=False)

    def __post_init__(self) -> None:
        self.solution = ExactSolution(self.body, self.start.state_of(self.body))
        self.truth = self.solution.states_at_seconds(self.trajectory.t)
        right = Rotation.from_quat(self.truth.quaternion)
        self.errors = errors_by_angle(self.trajectory.rotation, right)
        self.worst = float(np.max(self.errors['total']))
        # The rotation from the exact attitudes turns slowly.
        error, n = right.inv() * self.trajectory.rotation, len(self.trajectory.t) - 2 * MARGIN
        here = error[MARGIN:-MARGIN].inv()
        total = sum(weight * (here * error[at:at + n]).as_rotvec()
                    for at, weight in enumerate(_WEIGHTS) if weight)
        self.rates = total / self.trajectory.step + here.apply(
            self.truth.angular_velocity[MARGIN:-MARGIN])

    def use_told_rates(self, in_world: bool) -> None:
        """Make the rates told those of the motion; `in_world` : they are in axes of the world."""
        told = self.trajectory.rates
        if told is not None:
            rates = self.trajectory.rotation.inv().apply(told) if in_world else told
            self.derived, self.rates = False, rates[MARGIN:-MARGIN]

    @property
    def angular_accelerations(self) -> Reals:
        """In the body (n - 12, 3) [rad/s^2]."""
        inner = slice(MARGIN, -MARGIN)
        total = correlate1d(self.rates - self.truth.angular_velocity[inner], _WEIGHTS, axis=0)
        return (total / self.trajectory.step + self.truth.angular_acceleration[inner])[inner]

    @property
    def data(self) -> Attitudes:
        """Attitudes and rates."""
        part = self.trajectory.rotation[MARGIN:-MARGIN].as_quat()
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
