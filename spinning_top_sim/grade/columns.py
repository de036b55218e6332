# SPDX-License-Identifier: Apache-2.0
"""
What a sensor should read in a motion, term by term, and what defects change of it.

A motion, exact or with noise, is a source of columns, and readings are compared with these.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools.identify import Fit, fit, fitted, pooled, rms
from spinning_top_sim.tools.kinematics import (
    WIDTHS,
    Reals,
    Smoothed,
    Stretch,
    along,
    gain,
    margin,
)

UP, AXES = np.array((0.0, 0.0, 1.0)), np.eye(3)
ENTRIES = [(i, j) for i in range(3) for j in range(3)]
STANDARD_GRAVITY = 9.80665
NORM = 1e-2             # by which the norm of a quaternion may differ from 1
CLEAR = 0.03            # noise of what is differentiated, relative to it, that is small
NOISY, ROUNDING = 1e-3, 1e-6    # the same, that counts; noise of attitudes that does not
_per_step = partial(np.gradient, axis=0)        # change per step of values (m, 3)


class Kind(NamedTuple):
    """Units of a reading with their sizes, SI first; the parameter that has its noise density."""

    units: Mapping[str, float]
    density: str = ''


_RATES = {'rad/s': 1.0, 'mrad/s': 1e-3, 'deg/s': math.pi / 180.0, 'dps': math.pi / 180.0,
          'rpm': math.pi / 30.0}
READINGS = {
    'gyroscope': Kind(_RATES, 'gyroscope_noise_density'),
    'accelerations': Kind({'m/s^2': 1.0, 'm/s2': 1.0, 'g': STANDARD_GRAVITY,
                           'mg': 1e-3 * STANDARD_GRAVITY}, 'accelerometer_noise_density'),
    'magnetometer': Kind({'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7})}
LENGTHS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}
# Those of a simulator may be the rates of its state, too.
KINDS = {'rates': Kind(_RATES), **READINGS}
ANGLES = 'rates', 'gyroscope'
# Entries of a matrix whose noise is not in the discrepancy, that of another axis.
ACROSS = [f'matrix {i}{j} free' for i, j in ENTRIES if i != j]


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


class Comparison:
    """
    Readings of a kind beside a motion, which is smoothed as far as the noise asks for.

    `compare` sets the last four, of all stretches together, over the rms of their readings:

    arm, field : as given, or as last found
    always : names of effects whose size is not known, even of a right reading
    sizes, counts : rms and number of the readings of each stretch
    units, density : as of its `Kind`
    own_step, steps : interval of the sensor [s], and its samples per sample that is compared
    target : what a right reading does not explain (N, 3)
    effects : by name, changes of the reading by an effect of size 1 (N, 3)
    floor, noise : rms of the noise of a component of the target, and of effects by name
    """

    target: Reals
    effects: Mapping[str, Reals]
    floor: float
    noise: Mapping[str, float]

    def __init__(self, kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float) -> None:
        self.kind, self.gravity, self.angles = kind, gravity, kind in ANGLES
        self.units, self.density = KINDS[kind]
        self.arm, self.field = (np.array(one or np.zeros(3)) for one in (imu.lever_arm, imu.field))
        known = {'accelerations': imu.lever_arm, 'magnetometer': imu.field}.get(kind, ())
        self.always = [f'{"field" if kind == "magnetometer" else "arm"} {k}'
                       for k in range(3)] if known is None else []
        self.mounting = Rotation.from_quat((0, 0, 0, 1) if kind == 'rates' else imu.mounting)
        stretches = [one for one in stretches if kind in one.readings]
        self.readings = [self.mounting.apply(one.readings[kind]) for one in stretches]
        self.sizes = np.array([rms(one) or 1.0 for one in self.readings])
        self.reading_noise = max((one.sigma.get(kind, 0.0) for one in stretches), default=0.0)
        self.own_step = max((one.intervals.get(kind, one.step) for one in stretches), default=1.0)
        self.steps = stretches[0].step / self.own_step if stretches else 1.0
        share, self.motions = self._clear(stretches)
        self.noisy = share > NOISY or any(
            one.width > 1 or (kind == 'magnetometer' and one.noise[0] > ROUNDING)
            for one in self.motions)

    def _clear(self, stretches: Sequence[Stretch]) -> tuple[float, list[Smoothed]]:
        """Return the share of noise, and the motions smoothed so that it is small."""
        best: tuple[float, list[Smoothed]] = math.inf, []
        for width in WIDTHS if self.kind in ('gyroscope', 'accelerations') else (1,):
            if any(len(one.t) < 4 * margin(width) for one in stretches) or not stretches:
                break
            motions = [Smoothed(one, width) for one in stretches]
            noise = max(self.noises(one)['total'] for one in motions)
            size = rms(np.array([rms(one.rates) if self.angles else math.hypot(
                rms(one.acceleration), rms(one.second) * max(float(np.linalg.norm(self.arm)), 0.1))
                for one in motions]))
            share = noise / max(math.sqrt(max(size ** 2 - noise ** 2, 0.0)), 1e-12)
            best = min(best, (share, motions), key=lambda one: one[0])
            if share < CLEAR:
                break
        return best

    def noises(self, motion: Smoothed) -> dict[str, float]:
        """Return the noise of a component of what the motion says, by terms."""
        turns, rates, second, linear = motion.noise
        if self.angles:
            return {'total': rates, 'free': rates, 'matrix': rates / math.sqrt(3.0)}
        across = math.sqrt(2.0 / 3.0)           # a turn of a vector has no noise along it
        if self.kind == 'magnetometer':
            return {'total': across * turns * float(np.linalg.norm(self.field))}
        arm = across * second * (float(np.linalg.norm(self.arm)) or 0.1)
        free = math.hypot(linear, across * turns * self.gravity)
        total = math.hypot(free, arm)
        whole = free if self.always else total
        return {'total': total, 'free': whole, 'matrix': whole / math.sqrt(3.0), 'linear': linear,
                'lever': arm, 'tangential': arm, 'centripetal': arm, 'arm': across * second,
                'motion': math.hypot(linear, arm)}

    def undo(self, matrix: Reals) -> None:
        """Make the readings those of a sensor without a matrix (3, 3)."""
        self.readings = [reading @ np.linalg.inv(matrix).T for reading in self.readings]
        scale = abs(np.linalg.det(matrix)) ** (1.0 / 3.0)
        self.sizes, self.reading_noise = self.sizes / scale, self.reading_noise / scale

    def read_at(self, lag: int) -> list[Reals]:
        """Return readings that are `lag` samples late, smoothed (m, 3); ends are wrapped."""
        return [(one.rate if self.angles else one.vector)(np.roll(reading, -lag, axis=0))
                for one, reading in zip(self.motions, self.readings, strict=True)]

    def compare(self, lag: int) -> None:
        """Compare readings that are `lag` samples late."""
        self._compare(lag)
        if not self.always:
            return
        more, _ = fitted(self.target, [self.effects[name] for name in self.always])
        if self.kind == 'magnetometer':
            self.field = self.field + more
        else:
            self.arm = self.arm + more
        self._compare(lag)

    def _compare(self, lag: int) -> None:
        keep = slice(abs(lag), -abs(lag) or None)       # what a roll has not wrapped
        parts = [(motion.smooth[keep], motion, reading, size) for motion, reading, size in zip(
            self.motions, self.read_at(lag), self.sizes, strict=True)]
        self.counts = [int(np.count_nonzero(good)) for good, *_ in parts]
        readings, self.effects = pooled((reading[keep][good] / size, {
            name: effect[keep][good] / size for name, effect in self.columns(motion).items()})
            for good, motion, reading, size in parts)
        self.target = readings - self.effects['total']
        noises = [self.noises(one) for one in self.motions]
        self.noise = {name: rms(np.array([one[name] for one in noises]) / self.sizes)
                      for name in noises[0]}
        self.floor = math.hypot(self.noise['total'], self.reading_noise * rms(
            gain(self.motions[0].width) / self.sizes))

    def fit(self, names: Sequence[str]) -> Fit:
        """Return the best coefficients of effects."""
        if not names:
            return Fit(np.empty(0), np.empty(0), self.target)
        # Noise of an effect of several axes or entries stands by its first word.
        return fit(self.target, [self.effects[name] for name in names],
                   [self.noise.get(name, self.noise.get(name.split()[0], 0.0)) for name in names],
                   [name not in ACROSS for name in names])

    def columns(self, motion: Smoothed) -> dict[str, Reals]:
        """Return the terms of a right reading, their sum `total`, and effects of defects."""
        if self.angles:
            effects = {'total': motion.rates}
        elif self.kind == 'magnetometer':
            effects = {f'field {k}': motion.back @ axis for k, axis in enumerate(AXES)}
            effects['total'] = motion.back @ self.field
        else:
            effects = self._of_forces(motion)
        total = effects['total']
        arms = self.always if self.kind == 'accelerations' else []
        effects['free'] = total - effects['lever'] if arms else total   # of an unknown arm

        def turned(reading: Reals) -> Reals:
            return self.mounting.apply(along(motion.turn, reading))

        effects |= {
            'step': _per_step(total), 'world': turned(effects['free']),
            'reversed': turned(turned(effects['free'])),
            **{f'world {arm}': turned(effects[arm]) for arm in arms},
            **{f'offset {k}': 0.0 * total + axis for k, axis in enumerate(AXES)}}
        for of in ('free', *self.always):
            effects |= {f'matrix {i}{j} {of}': np.outer(effects[of][:, j], AXES[i])
                        for i, j in ENTRIES}
        return effects

    def _of_forces(self, motion: Smoothed) -> dict[str, Reals]:
        second, transposed = motion.second, motion.second.transpose(0, 2, 1)
        tangential, centripetal = (0.5 * (second + sign * transposed) @ self.arm
                                   for sign in (-1.0, 1.0))
        lever, gravity = tangential + centripetal, self.gravity * motion.back @ UP
        moved = lever + motion.acceleration
        total, turned = gravity + moved, along(motion.turn, moved)
        return {
            'tangential': tangential, 'centripetal': centripetal, 'gravity': gravity,
            **({'linear': motion.acceleration} if np.any(motion.acceleration) else {}),
            'lever': lever, 'motion': moved, 'total': total,
            # The motion a step later, then the axes, then the angular acceleration.
            'difference': along(motion.back, _per_step(turned)),
            'axes late': along(motion.back, _per_step(along(motion.turn, total))) - _per_step(
                total),
            'tangential step': _per_step(tangential),
            # A lever arm that is longer by 1 m along axes of the body, and a x r alone.
            **{f'arm {k}': second[:, :, k] for k in range(3)},
            **{f'turned arm {k}': 0.5 * (second - transposed)[:, :, k] for k in range(3)}}
