# SPDX-License-Identifier: Apache-2.0
"""What a sensor should read in a motion, term by term, and what defects change of it."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.kinematics import CLEAR, WIDTHS, Reals, Smoothed, Stretch, gain
from spinning_top_sim.grade.kinematics import margin as margin_of
from spinning_top_sim.tools.identify import TINY, fitted, pooled, rms

FORCES, ANGLES = ('accelerations', 'velocities'), ('rates', 'gyroscope', 'rotations')
UP = np.array((0.0, 0.0, 1.0))
AXES = np.eye(3)
STANDARD_GRAVITY = 9.80665
# Signed permutations of axes but for the identity; those that change the fewest axes first.
PERMUTATIONS = sorted((
    np.eye(3)[list(order)] * np.array(signs)[:, np.newaxis]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)),
    key=lambda one: np.sum(np.abs(one - np.eye(3))))[1:]
NOISY = 1e-3            # noise of the motion, relative to it, that counts
HIDDEN = 1e-3           # share of a coefficient in what cannot be told, from which on it cannot
BLOCKS = 20             # into which residuals are split, to know their correlation
_per_step = partial(np.gradient, axis=0)        # change per step of values (m, 3)


@dataclass(frozen=True, kw_only=True)
class Imu:
    """
    An IMU on a body, as far as it is known.

    Parameters
    ----------
    lever_arm : (3,) float, optional
        Position of the IMU in the body frame [m]; None: not known.
    mounting : (4,) float
        q(body <- IMU) as x, y, z, w.
    field : (3,) float, optional
        Magnetic field in the world [T]; None: not known.
    gyroscope_noise_density, accelerometer_noise_density : float, optional
        Of white noise [rad/s/sqrt(Hz)], [m/s^2/sqrt(Hz)]: a sample has the density over
        sqrt(interval between the samples) as its standard deviation.  0: no noise; None: unknown.
    """

    lever_arm: tuple[float, float, float] | None = None
    mounting: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    field: tuple[float, float, float] | None = None
    gyroscope_noise_density: float | None = None
    accelerometer_noise_density: float | None = None


@dataclass
class View:
    """
    Readings of one kind in one stretch beside what they should be, along axes of the body.

    reading : smoothed (m, 3)
    terms : names of what a right reading is the sum of
    effects : by name, changes of the reading by an effect of size 1 (m, 3)
    always : names of effects whose size is not known, even of a right reading
    noises : standard deviations of a component of reading - total, and of the total
    """

    reading: Reals
    terms: Sequence[str]
    effects: Mapping[str, Reals]
    always: Sequence[str]
    noises: tuple[float, float]


class Stack(NamedTuple):
    """
    Views of all stretches, one after another, each relative to the rms of its reading.

    target : what is not explained by a right reading (N, 3)
    effects, always, terms : as of `View`
    floor, noise : rms of the noise of a component of the target, and of the total
    sizes : rms of the reading of each view
    counts : rows of each view
    """

    target: Reals
    effects: Mapping[str, Reals]
    always: Sequence[str]
    terms: Sequence[str]
    floor: float
    noise: float
    sizes: Reals
    counts: Sequence[int]

    @classmethod
    def of(cls, views: Sequence[View]) -> 'Stack':
        """Return them."""
        sizes = np.array([rms(view.reading) or 1.0 for view in views])
        target, effects = pooled(((view.reading - view.effects['total']) / size, {
            name: effect / size for name, effect in view.effects.items()})
            for view, size in zip(views, sizes, strict=True))
        floor, noise = (rms(np.array([view.noises[k] for view in views]) / sizes) for k in (0, 1))
        return cls(target, effects, views[0].always, views[0].terms, floor, noise, sizes,
                   [len(view.reading) for view in views])

    def column(self, name: str) -> Reals:
        """Return an effect; also 'axes k': `free`, or an arm, along PERMUTATIONS[k]."""
        if not name.startswith('axes ') or name in self.effects:
            return self.effects[name]
        _, k, *of = name.split()
        turned: Reals = self.effects[' '.join(of) or 'free'] @ PERMUTATIONS[int(k)].T
        return turned

    def fit(self, names: Sequence[str]) -> tuple[Reals, Reals, Reals]:
        """
        Return coefficients (k,) of effects, their standard deviations, and what is left.

        The deviations are those of blocks of the residual: of noise that is correlated, too.
        """
        effects = [self.column(name) for name in names]
        columns = np.stack([effect.ravel() for effect in effects], axis=1)
        size = np.maximum(np.linalg.norm(columns, axis=0), TINY * math.sqrt(len(columns)))
        columns = columns / size
        # Noise of the total makes it larger, and the target by as much smaller.
        noise = np.array([self.noise ** 2 * len(columns) / (3.0 if name != 'total' else 1.0)
                          if name == 'total' or name.startswith('matrix') and 'arm' not in name
                          else 0.0 for name in names])
        own = np.array([name in ('total', 'matrix 00', 'matrix 11', 'matrix 22')
                        for name in names])
        values, vectors = np.linalg.eigh(columns.T @ columns - np.diag(noise / size ** 2))
        known = values > np.maximum(1e-9, vectors.T ** 2 @ (noise / size ** 2))
        inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
        found = inverse @ (columns.T @ self.target.ravel() + noise * own / size)
        residual = self.target - (columns @ found).reshape(self.target.shape)
        scores = np.array([part.T @ left for part, left in zip(
            np.array_split(columns, BLOCKS), np.array_split(residual.ravel(), BLOCKS),
            strict=True)])
        variance = np.maximum(np.diag(inverse @ scores.T @ scores @ inverse),
                              np.diag(inverse) * rms(residual) ** 2)
        hidden = np.any(np.abs(vectors[:, ~known]) > HIDDEN, axis=1)
        return found / size, np.where(hidden, np.inf, np.sqrt(variance)) / size, residual

    def compressed(self) -> tuple[Reals, dict[str, Reals]]:
        """Return target and effects with few rows, whose least squares are the same."""
        names = [*self.effects]
        columns = [*(self.effects[name].ravel() for name in names), self.target.ravel()]
        rows = np.linalg.qr(np.stack(columns, axis=1), mode='r')
        rows = rows * math.sqrt(len(rows) / self.target.size)
        effects = {name: rows[:, k, np.newaxis] for k, name in enumerate(names)}
        for k, matrix in enumerate(PERMUTATIONS):
            for of in ('', *(f' {name}' for name in self.always if name.startswith('arm'))):
                effects[f'axes {k}{of}'] = sum((
                    matrix[i, j] * effects[f'matrix {i}{j}{of}']
                    for i, j in np.argwhere(matrix)), np.zeros((1, 1)))
        return rows[:, -1, np.newaxis], effects


class Comparison:
    """
    A kind of readings in the stretches of a motion, smoothed as far as the noise asks for.

    arm, field : as given, or as last found
    """

    def __init__(self, kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float) -> None:
        self.kind, self.imu, self.gravity = kind, imu, gravity
        self.arm = np.array(imu.lever_arm or np.zeros(3))
        self.field = np.array(imu.field or np.zeros(3))
        self.stretches = [one for one in stretches if kind in one.readings]
        self.mounting = Rotation.identity() if kind == 'rates' else \
            Rotation.from_quat(imu.mounting)
        self.readings = [self.mounting.apply(one.readings[kind]) for one in self.stretches]
        self.reading_noise = max((one.sigma.get(kind, 0.0) for one in self.stretches), default=0.0)
        self.smoothed = self._clear() if self.stretches else []
        self.width = self.smoothed[0].width if self.smoothed else 1

        self.shortest = min((len(one.rates) for one in self.smoothed), default=0)
        self.size = rms(np.concatenate(self.readings)) if self.readings else 0.0
        self.own_step = max((one.intervals.get(kind, one.step) for one in self.stretches),
                            default=1.0)
        # Samples of the sensor per step of the comparison.
        self.steps = self.stretches[0].step / self.own_step if self.stretches else 1.0

    def read_at(self, lag: int) -> list[Reals]:
        """Return readings that are `lag` samples late, smoothed (m, 3); ends are wrapped."""
        return [self._read(smoothed, np.roll(reading, -lag, axis=0))
                for smoothed, reading in zip(self.smoothed, self.readings, strict=True)]

    def _read(self, smoothed: Smoothed, reading: Reals) -> Reals:
        if self.kind in ('rotations', 'velocities'):
            return reading[smoothed.inner][1:] / smoothed.body.step
        return smoothed.rate(reading) if self.kind in ANGLES else smoothed.vector(reading)

    @property
    def noisy(self) -> bool:
        """Whether the noise of the poses counts."""
        return self.width > 1 or self.share > NOISY

    def undo(self, matrix: Reals) -> None:
        """Make the readings those of a sensor without a matrix (3, 3)."""
        self.readings = [reading @ np.linalg.inv(matrix).T for reading in self.readings]
        self.reading_noise /= abs(np.linalg.det(matrix)) ** (1.0 / 3.0)

    def stack(self, lag: int) -> Stack:
        """Return what is compared, of readings that are `lag` samples late."""
        stack = Stack.of(self.views(lag))
        if not stack.always:
            return stack
        found, _ = fitted(stack.target, [stack.effects[name] for name in stack.always])
        if self.kind == 'magnetometer':
            self.field = self.field + found
        else:
            self.arm = self.arm + found
        return Stack.of(self.views(lag))

    def _clear(self) -> list[Smoothed]:
        """Return the motions smoothed so that what is differentiated is clear of noise."""
        best: tuple[float, list[Smoothed]] = np.inf, []
        for width in WIDTHS if self.kind in ('gyroscope', 'accelerations') else (1,):
            if any(len(one.t) < 4 * margin_of(width) for one in self.stretches):
                break
            smoothed = [one.at(width) for one in self.stretches]
            noises = np.array([self._motion_noise(one) for one in smoothed])
            sizes = np.array([rms(one.rates) if self.kind in ANGLES else np.hypot(
                rms(one.acceleration), rms(one.second) * max(np.linalg.norm(self.arm), 0.1))
                for one in smoothed])
            share = float(np.max(noises) / max(np.sqrt(max(
                np.mean(sizes ** 2) - np.mean(noises ** 2), 0.0)), 1e-12))
            if share < best[0]:
                best = share, smoothed
            if share < CLEAR:
                break
        self.share = best[0]
        return best[1]

    def _motion_noise(self, smoothed: Smoothed) -> float:
        """Return the noise of what the motion says of a component of a reading."""
        rates, second, linear = smoothed.body.noise(smoothed.width)
        turns = smoothed.body.sigma.get('attitudes', 0.0) * gain(smoothed.width)
        if self.kind in ANGLES:
            return rates
        if self.kind == 'magnetometer':
            return turns * float(np.linalg.norm(self.field))
        # R^T R'' r has the noise of a turn of r.
        arm = float(np.linalg.norm(self.arm)) if np.any(self.arm) else 0.1
        return float(np.sqrt(linear ** 2 + 2.0 / 3.0 * ((second * arm) ** 2
                                                        + (turns * self.gravity) ** 2)))

    def views(self, lag: int = 0) -> list[View]:
        """Return what is compared, of readings that are `lag` samples late."""
        return [self._view(smoothed, np.roll(reading, -lag, axis=0), lag)
                for smoothed, reading in zip(self.smoothed, self.readings, strict=True)]

    def _view(self, smoothed: Smoothed, reading: Reals, lag: int) -> View:
        edge = abs(lag)
        part = slice(edge, -edge or None)      # of what a roll has not wrapped
        terms, always = self._terms(smoothed), []
        smooth = self._read(smoothed, reading)
        if self.kind == 'rotations':
            turns = smoothed.body.rotation[smoothed.inner]
            terms = {'rates': (turns[:-1].inv() * turns[1:]).as_rotvec() / smoothed.body.step}
        elif self.kind == 'velocities':         # means over a step
            terms = {name: 0.5 * (term[:-1] + term[1:]) for name, term in terms.items()}
        total = sum(terms.values(), np.zeros(1))
        turn = smoothed.turn[:len(total)]
        back = turn.transpose(0, 2, 1)
        world = np.einsum('nij,nj->ni', turn, total)
        in_world = self.mounting.apply(world)
        effects = {
            **terms, 'total': total, 'step': _per_step(total), 'world': in_world,
            'reversed': self.mounting.apply(np.einsum('nij,nj->ni', turn, in_world)),
            **{f'offset {k}': 0.0 * total + axis for k, axis in enumerate(AXES)},
            'free': total}
        if self.kind in FORCES:
            effects |= self._of_forces(smoothed, terms, total, turn, back)
            always = [f'arm {k}' for k in range(3) if self.imu.lever_arm is None]
            if always:                          # the arm is not in what does not depend on it
                effects['free'] = total - effects['lever']
        if self.kind == 'magnetometer' and self.imu.field is None:
            always = [f'field {k}' for k in range(3)]
            effects |= {f'{name} {k}': column for k, axis in enumerate(AXES) for name, column in (
                ('field', back @ axis), ('turned', turn @ axis))}
        effects |= {f'matrix {i}{j}{of}': np.outer(effects[of.strip() or 'free'][:, j], AXES[i])
                    for of in ('', *(f' {name}' for name in always if name.startswith('arm')))
                    for i in range(3) for j in range(3)}
        moving = self._motion_noise(smoothed)
        noise = math.hypot(moving, self.reading_noise * gain(smoothed.width))
        return View(smooth[part], [*terms], {
            name: effect[part] for name, effect in effects.items()}, always, (noise, moving))

    def _terms(self, smoothed: Smoothed) -> dict[str, Reals]:
        if self.kind in ANGLES:
            return {'rates': smoothed.rates}
        if self.kind == 'magnetometer':
            return {'field': smoothed.of_world(self.field)}
        second, transposed = smoothed.second, smoothed.second.transpose(0, 2, 1)
        terms = {'gravity': self.gravity * smoothed.of_world(UP),
                 'tangential': 0.5 * (second - transposed) @ self.arm,
                 'centripetal': 0.5 * (second + transposed) @ self.arm}
        if np.any(smoothed.acceleration):
            terms['linear'] = smoothed.acceleration
        return terms

    def _of_forces(self, smoothed: Smoothed, terms: Mapping[str, Reals], total: Reals,
                   turn: Reals, back: Reals) -> dict[str, Reals]:
        def along(matrices: Reals, vectors: Reals) -> Reals:
            found: Reals = np.einsum('nij,nj->ni', matrices, vectors)
            return found

        n, motion = len(total), total - terms['gravity']
        second = smoothed.second[:n]
        antisymmetric = 0.5 * (second - second.transpose(0, 2, 1))
        lever = terms['tangential'] + terms['centripetal']
        speed = along(back, smoothed.velocity[:n])
        return {
            'lever': lever, 'motion': motion,
            'transport': np.cross(smoothed.rates[:n], speed),
            # The motion a step later, then the axes, then the angular acceleration.
            'difference': along(back, _per_step(along(turn, motion))),
            'axes late': along(back, _per_step(along(turn, total))) - _per_step(total),
            'tangential step': _per_step(terms['tangential']),
            # A lever arm that is longer by 1 m along axes of the body, and a x r alone.
            **{f'arm {k}': second[:, :, k] for k in range(3)},
            **{f'turned arm {k}': antisymmetric[:, :, k] for k in range(3)}}
