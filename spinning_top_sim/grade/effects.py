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

from spinning_top_sim.tools.identify import Fit, compressed, fit, fitted, pooled, rms
from spinning_top_sim.tools.kinematics import (
    WIDTHS,
    Reals,
    Smoothed,
    Stretch,
    along,
    gain,
    margin,
)

ANGLES = 'rates', 'gyroscope'
UP, AXES = np.array((0.0, 0.0, 1.0)), np.eye(3)
ENTRIES = [(i, j) for i in range(3) for j in range(3)]
STANDARD_GRAVITY = 9.80665
CLEAR = 0.03            # noise of what is differentiated, relative to it, that is small
NOISY = 1e-3            # the same, that counts
# Errors of samples that are left out, over the median; they are few, and more than rounding.
OUTLIER, FEW, ROUNDING = 20.0, 0.1, 1e-6
# Signed permutations of axes but for the identity; those that change the fewest axes first.
PERMUTATIONS = sorted((
    np.eye(3)[list(order)] * np.array(signs)[:, np.newaxis]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)),
    key=lambda one: np.sum(np.abs(one - np.eye(3))))[1:]
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


class Compared(NamedTuple):
    """
    Readings beside what they should be, stretch after stretch, over the rms of the readings.

    target : what a right reading does not explain (N, 3)
    effects : by name, changes of the reading by an effect of size 1 (N, 3)
    always : names of effects whose size is not known, even of a right reading
    floor, noise : rms of the noise of a component of the target, and of effects by name
    """

    target: Reals
    effects: Mapping[str, Reals]
    always: Sequence[str]
    floor: float
    noise: Mapping[str, float]

    def column(self, name: str) -> Reals:
        """Return an effect; also 'axes k': `free`, or an arm, along PERMUTATIONS[k]."""
        if not name.startswith('axes '):
            return self.effects[name]
        _, k, *of = name.split()
        turned: Reals = self.effects[' '.join(of) or 'free'] @ PERMUTATIONS[int(k)].T
        return turned

    def fit(self, names: Sequence[str]) -> Fit:
        """Return the best coefficients of effects."""
        if not names:
            return Fit(np.empty(0), np.empty(0), self.target)
        return fit(self.target, [self.column(name) for name in names],
                   [self.noise.get(name, self.noise.get(name[:7].strip('012 '), 0.0))
                    for name in names],
                   [name not in [f'matrix {i}{j}' for i, j in ENTRIES if i != j]
                    for name in names])

    def compressed(self) -> tuple[Reals, dict[str, Reals]]:
        """Return target and effects with few rows, 'axes k' among them."""
        target, effects = compressed(self.target, self.effects)
        for k, matrix in enumerate(PERMUTATIONS):
            for of in ('', *(f' {name}' for name in self.always if name.startswith('arm'))):
                effects[f'axes {k}{of}'] = sum((matrix[i, j] * effects[f'matrix {i}{j}{of}']
                                                for i, j in np.argwhere(matrix)), np.zeros((1, 1)))
        return target, effects


class Comparison:
    """
    Readings of a kind in the stretches of a motion, smoothed as far as the noise asks for.

    arm, field : as given, or as last found
    share : noise of what is differentiated, relative to it
    sizes, counts : rms and number of the readings of each stretch that are compared
    own_step, steps : interval of the sensor [s], and its samples per sample that is compared
    """

    def __init__(self, kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float) -> None:
        self.kind, self.imu, self.gravity = kind, imu, gravity
        self.arm = np.array(imu.lever_arm or np.zeros(3))
        self.field = np.array(imu.field or np.zeros(3))
        stretches = [one for one in stretches if kind in one.readings]
        self.mounting = Rotation.identity() if kind == 'rates' else \
            Rotation.from_quat(imu.mounting)
        self.readings = [self.mounting.apply(one.readings[kind]) for one in stretches]
        self.reading_noise = max((one.sigma.get(kind, 0.0) for one in stretches), default=0.0)
        self.share, self.smoothed = self._clear(stretches)
        self.counts = [len(one.rates) for one in self.smoothed]
        self.good = [np.ones(count, bool) for count in self.counts]     # samples to compare
        self.sizes = np.array([rms(one) or 1.0 for one in self.readings])
        self.own_step = max((one.intervals.get(kind, one.step) for one in stretches), default=1.0)
        self.steps = stretches[0].step / self.own_step if stretches else 1.0
        self.noisy = self.share > NOISY or any(
            one.width > 1 or (kind == 'magnetometer' and one.body.noise(1)[0] > ROUNDING)
            for one in self.smoothed)

    def _clear(self, stretches: Sequence[Stretch]) -> tuple[float, list[Smoothed]]:
        """Return the share of noise, and the motions smoothed so that it is small."""
        best: tuple[float, list[Smoothed]] = math.inf, []
        for width in WIDTHS if self.kind in ('gyroscope', 'accelerations') else (1,):
            if any(len(one.t) < 4 * margin(width) for one in stretches) or not stretches:
                break
            smoothed = [Smoothed(one, width) for one in stretches]
            noise = max(self.noises(one)['total'] for one in smoothed)
            size = rms(np.array([rms(one.rates) if self.kind in ANGLES else math.hypot(
                rms(one.acceleration), rms(one.second) * max(float(np.linalg.norm(self.arm)), 0.1))
                for one in smoothed]))
            share = noise / max(math.sqrt(max(size ** 2 - noise ** 2, 0.0)), 1e-12)
            best = min(best, (share, smoothed), key=lambda one: one[0])
            if share < CLEAR:
                break
        return best

    def noises(self, smoothed: Smoothed) -> dict[str, float]:
        """Return the noise of a component of what the motion says, by terms."""
        turns, rates, second, linear = smoothed.body.noise(smoothed.width)
        if self.kind in ANGLES:
            return {'total': rates, 'free': rates, 'matrix': rates / math.sqrt(3.0)}
        across = math.sqrt(2.0 / 3.0)           # a turn of a vector has no noise along it
        if self.kind == 'magnetometer':
            return {'total': across * turns * float(np.linalg.norm(self.field))}
        arm = across * second * (float(np.linalg.norm(self.arm)) or 0.1)
        free = math.hypot(linear, across * turns * self.gravity)
        total = math.hypot(free, arm)
        whole = free if self.imu.lever_arm is None else total
        return {'total': total, 'free': whole, 'matrix': whole / math.sqrt(3.0), 'linear': linear,
                'lever': arm, 'tangential': arm, 'centripetal': arm, 'arm': across * second,
                'motion': math.hypot(linear, arm), 'turn': second}

    def undo(self, matrix: Reals) -> None:
        """Make the readings those of a sensor without a matrix (3, 3)."""
        self.readings = [reading @ np.linalg.inv(matrix).T for reading in self.readings]
        scale = abs(np.linalg.det(matrix)) ** (1.0 / 3.0)
        self.sizes, self.reading_noise = self.sizes / scale, self.reading_noise / scale

    def read_at(self, lag: int) -> list[Reals]:
        """Return readings that are `lag` samples late, smoothed (m, 3); ends are wrapped."""
        return [(one.rate if self.kind in ANGLES else one.vector)(np.roll(reading, -lag, axis=0))
                for one, reading in zip(self.smoothed, self.readings, strict=True)]

    def leave_out(self, lag: int, designs: Sequence[Reals]) -> bool:
        """
        Compare no samples that a design does not fit by far, if they are few; return whether.

        Where a force sets in, a derivative of samples does not hold.
        """
        before = self.good.copy()
        for k, (design, reading) in enumerate(zip(designs, self.read_at(lag), strict=True)):
            good = np.ones(len(reading), bool)
            for _ in range(3):
                gram = np.linalg.pinv(design[good].T @ design[good], 1e-12, hermitian=True)
                error = np.linalg.norm(
                    reading - design @ (gram @ (design[good].T @ reading[good])), axis=1)
                good = error <= OUTLIER * np.median(error[good]) + ROUNDING * self.sizes[k]
            self.good[k] = good if np.mean(good) > 1.0 - FEW else np.ones(len(reading), bool)
        return any(np.any(one != other) for one, other in zip(before, self.good, strict=True))

    def compare(self, lag: int) -> Compared:
        """Return what is compared, of readings that are `lag` samples late."""
        found = self._compared(lag)
        if not found.always:
            return found
        more, _ = fitted(found.target, [found.effects[name] for name in found.always])
        if self.kind == 'magnetometer':
            self.field = self.field + more
        else:
            self.arm = self.arm + more
        return self._compared(lag)

    def _compared(self, lag: int) -> Compared:
        keep = slice(abs(lag), -abs(lag) or None)       # what a roll has not wrapped
        rows = [np.flatnonzero(good[keep]) + abs(lag) for good in self.good]
        self.counts = [len(one) for one in rows]
        readings, effects = pooled((reading[part] / size, {
            name: effect[part] / size for name, effect in self.effects(one).items()})
            for one, reading, part, size in zip(
                self.smoothed, self.read_at(lag), rows, self.sizes, strict=True))
        noises = [self.noises(one) for one in self.smoothed]
        noise = {name: rms(np.array([one[name] for one in noises]) / self.sizes)
                 for name in noises[0]}
        reading = self.reading_noise * rms(gain(self.smoothed[0].width) / self.sizes)
        return Compared(readings - effects['total'], effects, [
            name for name in effects if name[:-2] in ('arm', 'field')
            and (self.imu.lever_arm if name[:3] == 'arm' else self.imu.field) is None],
            math.hypot(noise['total'], reading), noise)

    def effects(self, smoothed: Smoothed) -> dict[str, Reals]:
        """Return the terms of a right reading, their sum `total`, and effects of defects."""
        effects = {}
        if self.kind in ANGLES:
            effects['total'] = smoothed.rates
        elif self.kind == 'magnetometer':
            effects = {f'field {k}': smoothed.back @ axis for k, axis in enumerate(AXES)}
            effects['total'] = smoothed.back @ self.field
        else:
            effects = self._of_forces(smoothed)
        total = effects['total']
        world = self.mounting.apply(along(smoothed.turn, total))
        known = self.kind != 'accelerations' or self.imu.lever_arm is not None
        effects |= {
            'step': _per_step(total), 'world': world,
            'reversed': self.mounting.apply(along(smoothed.turn, world)),
            'free': total if known else total - effects['lever'],   # of an arm that is not known
            **{f'offset {k}': 0.0 * total + axis for k, axis in enumerate(AXES)}}
        for of in ('free', *(() if known else ('arm 0', 'arm 1', 'arm 2'))):
            effects |= {f'matrix {i}{j}' + f' {of}' * (of != 'free'): np.outer(
                effects[of][:, j], AXES[i]) for i, j in ENTRIES}
        return effects

    def _of_forces(self, smoothed: Smoothed) -> dict[str, Reals]:
        second, transposed = smoothed.second, smoothed.second.transpose(0, 2, 1)
        tangential, centripetal = (0.5 * (second + sign * transposed) @ self.arm
                                   for sign in (-1.0, 1.0))
        lever, gravity = tangential + centripetal, self.gravity * smoothed.back @ UP
        linear = {'linear': smoothed.acceleration} if np.any(smoothed.acceleration) else {}
        motion = lever + smoothed.acceleration
        total = gravity + motion
        turned, back = along(smoothed.turn, motion), smoothed.back
        return {
            'tangential': tangential, 'centripetal': centripetal, 'gravity': gravity, **linear,
            'lever': lever, 'motion': motion, 'total': total,
            # The motion a step later, then the axes, then the angular acceleration.
            'difference': along(back, _per_step(turned)),
            'axes late': along(back, _per_step(along(smoothed.turn, total))) - _per_step(total),
            'tangential step': _per_step(tangential),
            # A lever arm that is longer by 1 m along axes of the body, and a x r alone.
            **{f'arm {k}': second[:, :, k] for k in range(3)},
            **{f'turned arm {k}': 0.5 * (second - transposed)[:, :, k] for k in range(3)}}
