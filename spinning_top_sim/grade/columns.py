# SPDX-License-Identifier: Apache-2.0
"""
What a sensor should read in a motion, term by term, and what defects change of it.

A motion, exact or with noise, is a source of columns, and readings are compared with these.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools import kinematics
from spinning_top_sim.tools.identify import Fit, fit, fitted, pooled, rms
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch, along

UP, AXES = np.array((0.0, 0.0, 1.0)), np.eye(3)
ENTRIES = [(i, j) for i in range(3) for j in range(3)]
STANDARD_GRAVITY = 9.80665
NORM = 1e-2             # by which the norm of a quaternion may differ from 1
CLEAR = 0.03            # noise of what is differentiated, relative to it, that is small
NOISY, ROUNDING = 1e-3, 1e-6    # the same, that counts; noise of attitudes that does not
LAGS = range(-5, 41)    # that are tried [samples]
ENOUGH = 3              # independent samples a column, from which on a lag can be told
STILL = 1e-5            # share of a reading below which no lag is looked for
SURE = 5.0              # standard deviations from which on a number is not chance
CLEARLY = 10.0          # by which a term must exceed its noise to be missed
# Effects that any reading may have, along any axes.
ANY = 'gravity', 'linear', 'world', 'arm', 'turned arm', 'field'
_per_step = partial(np.gradient, axis=0)        # change per step of values (m, 3)
_RATES = {'rad/s': 1.0, 'mrad/s': 1e-3, 'deg/s': math.pi / 180.0, 'dps': math.pi / 180.0,
          'rpm': math.pi / 30.0}
# Units of readings with their sizes, SI first.
READINGS: dict[str, Mapping[str, float]] = {
    'gyroscope': _RATES,
    'accelerations': {'m/s^2': 1.0, 'm/s2': 1.0, 'g': STANDARD_GRAVITY,
                      'mg': 1e-3 * STANDARD_GRAVITY},
    'magnetometer': {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7}}
LENGTHS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3}
# Those of a simulator may be the rates of its state, too.
KINDS = {'rates': _RATES, **READINGS}
DENSITIES = {'gyroscope': 'gyroscope_noise_density',
             'accelerations': 'accelerometer_noise_density'}
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

    Raises
    ------
    ValueError
        Naming the field, its value and what is allowed.
    """

    lever_arm: tuple[float, float, float] | None = None
    mounting: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    field: tuple[float, float, float] | None = None
    gyroscope_noise_density: float | None = None
    accelerometer_noise_density: float | None = None

    def __post_init__(self) -> None:
        for name, length in (('lever_arm', 3), ('mounting', 4), ('field', 3)):
            value = np.asarray(getattr(self, name) or (0.0,) * length, dtype=float)
            if value.shape != (length,) or not np.all(np.isfinite(value)):
                raise ValueError(f'{name} = {getattr(self, name)!r}: must be {length} finite '
                                 'numbers')
        if abs(math.hypot(*self.mounting) - 1.0) > 1e-6:
            raise ValueError(f'mounting = {self.mounting!r}: its norm must be 1')


class Comparison:
    """
    Readings of a kind beside a motion, which is smoothed as far as the noise asks for.

    `compare` sets the last four, of all stretches together, over the rms of their readings:

    arm, field : as given, or as last found
    always : names of effects whose size is not known, even of a right reading
    sizes, counts : rms and number of the readings of each stretch
    own_step, steps : interval of the sensor [s], and its samples per sample that is compared
    target : what a right reading does not explain (N, 3)
    effects : by name, changes of the reading by an effect of size 1 (N, 3)
    floor, noise : rms of the noise of a component of the target, and of effects by name
    """

    target: Reals
    effects: Mapping[str, Reals]
    floor: float
    noise: Mapping[str, float]

    def __init__(self, kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float,
                 widths: Sequence[int] = kinematics.WIDTHS) -> None:
        self.kind, self.gravity, self.units = kind, gravity, KINDS[kind]
        self.angles = kind in ('rates', 'gyroscope')
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
        share, self.motions = self._clear(stretches, widths)
        self.noisy = share > NOISY or any(
            one.width > 1 or (kind == 'magnetometer' and one.noise[0] > ROUNDING)
            for one in self.motions)

    def _clear(self, stretches: Sequence[Stretch],
               widths: Sequence[int]) -> tuple[float, list[Smoothed]]:
        """Return the share of noise, and the motions smoothed so that it is small."""
        best: tuple[float, list[Smoothed]] = math.inf, []
        for width in (1,) if self.kind in ('rates', 'magnetometer') else widths:
            least = 4 * kinematics.margin(width)
            if min((len(one.t) for one in stretches), default=0) < least:
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

    def read(self, motion: Smoothed, reading: Reals, lag: int) -> Reals:
        """Return a reading that is `lag` samples late, smoothed (m, 3); ends are wrapped."""
        return (motion.rate if self.angles else motion.vector)(np.roll(reading, -lag, axis=0))

    def lag(self) -> tuple[float, float, bool]:
        """
        Return by how many samples readings are late, its deviation, and whether it explains much.

        The reading is regressed on all terms, of all axes, at each lag: what else is wrong does
        not count.
        """
        lags = [lag for lag in LAGS if 4 * abs(lag) < min(len(one.rates) for one in self.motions)]
        keep, residuals = slice(-lags[0], -lags[-1] or None), []
        for motion, reading in zip(self.motions, self.readings, strict=True):
            good = motion.smooth[keep]
            design = np.hstack([effect[keep][good] for name, effect in self.columns(motion).items()
                                if name.startswith(ANY) or (name == 'total' and self.angles)]
                               + [np.ones((np.count_nonzero(good), 1))])
            design /= np.maximum(np.linalg.norm(design, axis=0), 1e-300)
            read = np.hstack([self.read(motion, reading, lag)[keep][good] for lag in lags])
            residuals.append(read - design @ np.linalg.lstsq(design, read, rcond=1e-9)[0])
        misfit = sum(np.sum(one ** 2, axis=0) for one in residuals).reshape(-1, 3).sum(axis=1)
        best, now, count = int(np.argmin(misfit)), misfit[lags.index(0)], 3 * sum(
            map(len, residuals))
        width, size = self.motions[0].width, rms(self.sizes)
        self.compare(0)
        # Of smoothed samples fewer are independent: they must be more than the columns.
        if (count < ENOUGH * 3 * width * design.shape[1] or best in (0, len(lags) - 1)
                or now < count * (STILL * size) ** 2
                or rms(self.effects['total']) < CLEARLY * self.noise['total']):
            return math.nan, math.inf, False    # every lag explains it
        # Around its minimum the sum of squares is a parabola.
        sooner, least, later = misfit[best - 1:best + 2].tolist()
        curvature = sooner - 2.0 * least + later
        late = lags[best] + 0.5 * (sooner - later) / curvature
        rest = max(least - 0.125 * (sooner - later) ** 2 / curvature, 0.0)
        variance = rest / count * 2.0 * width   # of correlated noise
        sigma, unlike = math.sqrt(2.0 * variance / curvature), (2.0 * SURE) ** 2 * variance
        likely = np.abs(np.array(lags)[misfit - rest < unlike] - late)
        if np.any(likely > 1.0 + 2.0 * SURE * sigma) or now - rest < unlike * (
                abs(late) > 2.0 * sigma):
            return math.nan, math.inf, False    # others, or none, explain it as well
        clear = rest < 0.25 * now or (rest < 1.5 * count * (self.floor * size) ** 2
                                      and now - rest > max(unlike, 0.05 * curvature * late ** 2))
        return late, sigma, clear

    def compare(self, lag: int) -> None:
        """Compare readings that are `lag` samples late."""
        self._compare(lag)
        if self.always:
            more, _ = fitted(self.target, [self.effects[name] for name in self.always])
            if self.kind == 'magnetometer':
                self.field = self.field + more
            else:
                self.arm = self.arm + more
            self._compare(lag)

    def _compare(self, lag: int) -> None:
        keep = slice(abs(lag), -abs(lag) or None)       # what a roll has not wrapped
        self.counts = [np.count_nonzero(motion.smooth[keep]) for motion in self.motions]
        readings, self.effects = pooled((
            self.read(motion, reading, lag)[keep][motion.smooth[keep]] / size,
            {name: effect[keep][motion.smooth[keep]] / size
             for name, effect in self.columns(motion).items()})
            for motion, reading, size in zip(
                self.motions, self.readings, self.sizes, strict=True))
        self.target = readings - self.effects['total']
        noises = [self.noises(one) for one in self.motions]
        self.noise = {name: rms(np.array([one[name] for one in noises]) / self.sizes)
                      for name in noises[0]}
        self.floor = math.hypot(self.noise['total'], self.reading_noise * rms(
            kinematics.gain(self.motions[0].width) / self.sizes))

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
            **{f'in world {arm}': turned(effects[arm]) for arm in arms},
            **{f'offset {k}': 0.0 * total + axis for k, axis in enumerate(AXES)}}
        for of in ('free', *arms):
            effects |= {f'matrix {i}{j} {of}': np.outer(effects[of][:, j], AXES[i])
                        for i, j in ENTRIES}
        return effects

    def _of_forces(self, motion: Smoothed) -> dict[str, Reals]:
        second, transposed = motion.second, motion.second.transpose(0, 2, 1)
        tangential, centripetal = (0.5 * (second + sign * transposed) @ self.arm
                                   for sign in (-1.0, 1.0))
        lever, gravity = tangential + centripetal, self.gravity * motion.back @ UP
        moved = lever + motion.acceleration
        return {
            'tangential': tangential, 'centripetal': centripetal, 'gravity': gravity,
            **({'linear': motion.acceleration} if np.any(motion.acceleration) else {}),
            'lever': lever, 'motion': moved, 'total': gravity + moved,
            'fixed gravity': self.gravity * (0.0 * gravity + self.mounting.apply(UP)),
            # The motion a step later, then the axes.
            'difference': along(motion.back, _per_step(along(motion.turn, moved))),
            # A lever arm that is longer by 1 m along axes of the body, and a x r alone.
            **{f'arm {k}': second[:, :, k] for k in range(3)},
            **{f'turned arm {k}': 0.5 * (second - transposed)[:, :, k] for k in range(3)}}
