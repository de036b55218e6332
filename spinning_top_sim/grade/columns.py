# SPDX-License-Identifier: Apache-2.0
"""What a sensor should read in a motion, term by term, and what defects change of it."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.physics.top import numbers
from spinning_top_sim.tools import conventions, kinematics
from spinning_top_sim.tools.identify import SURE, TARGET, Model, rms
from spinning_top_sim.tools.kinematics import Reals, Smoothed, Stretch, along
from spinning_top_sim.tools.report import Finding

UP, AXES = np.array((0.0, 0.0, 1.0)), np.eye(3)
ENTRIES = [(i, j) for i in range(3) for j in range(3)]
STANDARD_GRAVITY = 9.80665
CLEAR, NOISY = 0.03, 1e-3   # noise of rates or forces, relative: small enough; not negligible
ARM = np.full(3, 0.06)  # of an IMU whose place is not known [m]
# Signed permutations, the simplest first.
EXCHANGES = sorted((sign * axes for axes in np.rint(conventions.TURNS.as_matrix())
                    for sign in (1.0, -1.0)), key=lambda one: (
                        -np.trace(np.abs(one)), -abs(np.trace(one)), -np.trace(one)))
LAGS = range(-5, 41)    # that are tried [samples]
EXACT = 1e-5            # share of a reading that differences of poses may leave
# Terms and effects that any reading may have, along any axes.
ANY = 'gravity', 'linear', 'world', 'arm', 'turned arm', 'field', 'rates'
# Units of readings with their sizes, SI first.
READINGS: dict[str, Mapping[str, float]] = {
    'gyroscope': {'rad/s': 1.0, 'mrad/s': 1e-3, 'deg/s': math.pi / 180.0,
                  'dps': math.pi / 180.0, 'rpm': math.pi / 30.0},
    'accelerations': {'m/s^2': 1.0, 'm/s2': 1.0, 'm/s²': 1.0, 'g': STANDARD_GRAVITY,
                      'mg': 1e-3 * STANDARD_GRAVITY},
    'magnetometer': {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'G': 1e-4, 'mG': 1e-7}}
KINDS = {'rates': READINGS['gyroscope'], **READINGS}    # a simulator has those of its state
OF_TURNS = 'rates', 'gyroscope'
DENSITIES = {'gyroscope': 'gyroscope_noise_density',
             'accelerations': 'accelerometer_noise_density'}


@dataclass(frozen=True, kw_only=True)
class Imu:
    """
    An IMU on a body, as far as it is known.  ValueError: a value is not as below.

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

    def __post_init__(self) -> None:
        for name, length in (('lever_arm', 3), ('mounting', 4), ('field', 3)):
            if (value := getattr(self, name)) is not None:
                vars(self)[name] = tuple(numbers(name, value, length).tolist())
        for name in DENSITIES.values():
            if not (getattr(self, name) is None or getattr(self, name) >= 0.0):
                raise ValueError(f'{name} = {getattr(self, name)!r}: must be 0 or positive')
        if abs(math.hypot(*self.mounting) - 1.0) > 1e-6:
            raise ValueError(f'mounting = {self.mounting!r}: its norm must be 1')


class Comparison:
    """Readings of a kind beside motions, smoothed as far as their noise asks for."""

    def __init__(self, kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float,
                 widths: Sequence[int] = kinematics.WIDTHS) -> None:
        self.kind, self.gravity, self.units = kind, gravity, KINDS[kind]
        self.arm, self.field = (np.array(one or np.zeros(3)) for one in (imu.lever_arm, imu.field))
        known = {'accelerations': imu.lever_arm, 'magnetometer': imu.field}.get(kind, ())
        self.always = [f'{"field" if kind == "magnetometer" else "arm"} {k}'
                       for k in range(3)] if known is None else []
        self.arms = self.always if kind == 'accelerations' else []
        self.matrix = [f'matrix {i}{j} {of}' for of in (*self.arms, 'total') for i, j in ENTRIES]
        self.exchange = AXES        # by which what is read is multiplied, and the fault of that
        self.told: list[Finding] = []
        self.mounting = Rotation.from_quat((0, 0, 0, 1) if kind == 'rates' else imu.mounting)
        stretches = [one for one in stretches
                     if kind in one.readings and len(one.t) >= 4 * kinematics.margin(1)]
        of_field = rms(self.field) * (kind == 'magnetometer')       # readings may be zeros
        sizes = [max(rms(one.readings[kind]), of_field) for one in stretches]
        least = 0.1 if kind in OF_TURNS else 0.01       # at rest there are no rates, but gravity
        self.sizes = np.maximum(sizes, least * max(sizes, default=0.0) or 1.0)
        self.reading_noise = rms(np.array([one.sigma.get(kind, 0.0) for one in stretches] or [0]))
        # The interval of the sensor [s], and its samples per sample that is compared.
        self.own_step = max((one.intervals.get(kind, one.step) for one in stretches), default=1.0)
        self.steps = stretches[0].step / self.own_step if stretches else 1.0
        self.stepped = any(one.rates is None and not one.intervals for one in stretches)
        self.motions, self.noisy = self._clear(stretches, widths)

    def _clear(self, stretches: Sequence[Stretch], widths: Sequence[int],
               ) -> tuple[list[tuple[Smoothed, Smoothed]], bool]:
        """Return the motions, smoothed so that their noise is small, and whether it counts."""
        least, motions, random = math.inf, list[tuple[Smoothed, Smoothed]](), (
            np.random.default_rng(0))
        pairs = [(one, one.noisier(random)) for one in stretches]
        for width in (1,) if self.kind in ('rates', 'magnetometer') else widths:
            if min((len(one.t) for one in stretches), default=0) < 4 * kinematics.margin(width):
                break
            smoothed = [(Smoothed(one, width), Smoothed(two, width)) for one, two in pairs]
            plain, noisy = (np.concatenate([
                one.acceleration + one.second @ (self.arm if np.any(self.arm) else ARM)
                if self.kind == 'accelerations' else one.rates for one in every])
                for every in zip(*smoothed, strict=True))
            share = rms(noisy - plain) / max(rms(plain), 1e-12)
            if share < least:
                least, motions = share, smoothed
            if share < CLEAR:
                break
        return motions, least > NOISY

    def read(self, motion: Smoothed, lag: int, matrix: Reals | None = None) -> Reals:
        """Return readings that are `lag` samples late, smoothed (m, 3); ends are wrapped."""
        reading = self.mounting.apply(np.roll(motion.body.readings[self.kind], -lag, axis=0)
                                      @ (self.exchange if matrix is None else matrix).T)
        return (motion.rate if self.kind in OF_TURNS else motion.vector)(reading)

    def lag(self) -> int:
        """Return by how many samples readings are late, 0 where no other number is clear."""
        motions, residuals = [one for one, _ in self.motions], []
        motions = [one for one in motions if len(one.rates) > 4 * LAGS[-1]] or motions
        lags = [lag for lag in LAGS if 4 * abs(lag) < min(len(one.rates) for one in motions)]
        for motion in motions:      # by all terms, of all axes: what else is wrong does not count
            good = np.flatnonzero(motion.smooth)
            good = good[(good >= -lags[0]) & (good < len(motion.smooth) - lags[-1])]
            design = np.hstack([effect[good] for name, effect in self.columns(motion).items()
                                if name.startswith(ANY)] + [np.ones((len(good), 1))])
            design /= np.maximum(np.linalg.norm(design, axis=0), 1e-300)
            read = np.hstack([self.read(motion, lag)[good] for lag in lags])
            residuals.append(read - design @ np.linalg.lstsq(design, read, rcond=1e-9)[0])
        squares = np.mean(np.concatenate(residuals) ** 2, axis=0).reshape(-1, 3).mean(axis=1)
        best, least = int(np.argmin(squares)), (EXACT * rms(self.sizes)) ** 2
        # Of smoothed samples fewer are independent.
        unlike = 2.0 * SURE ** 2 * motions[0].width / (3 * sum(map(len, residuals)))
        near = squares < squares[best] + unlike * max(squares[best], least)
        alone = np.max(np.abs(np.flatnonzero(near) - best)) <= 1 and 0 < best < len(lags) - 1
        return lags[best] if alone and squares[lags.index(0)] > least else 0

    def exchanged(self, lag: int) -> 'Comparison':
        """Return the same with those axes, signs, and unit of readings that fit best."""
        keep, squares = slice(abs(lag), -abs(lag) or None), np.zeros((10, 10))
        for (motion, _), size in zip(self.motions, self.sizes, strict=True):
            effects = self.columns(motion)
            rows = np.stack([effects['total'], *(self.read(motion, lag, np.outer(one, two))
                                                 for one in AXES for two in AXES),
                             *(effects[name] for name in self.always)])[:, keep]
            rows = rows.reshape(len(rows), -1).T / size
            left = rows[:, :10] - rows[:, 10:] @ np.linalg.lstsq(rows[:, 10:], rows[:, :10])[0]
            squares += left.T @ left
        tried = [(*unit, axes) for unit in self.units.items() for axes in EXCHANGES]
        sizes = np.array([np.append(-1.0 / unit, axes) for _, unit, axes in tried])
        rest = np.sqrt(np.maximum(np.sum(sizes @ squares * sizes, axis=1), 0.0))
        good = rest <= conventions.AS_GOOD * np.min(rest) + EXACT * math.sqrt(squares[0, 0])
        good &= rest ** 2 < np.trace(squares[1:, 1:]) / 3.0     # less is left than was read
        called, unit, axes = tried[int(np.argmax(good))]
        other = copy(self)
        other.exchange, other.sizes = unit * axes, unit * self.sizes
        other.reading_noise *= unit
        name = 'axes' if np.trace(np.abs(axes)) < 3.0 else (
            {3.0: 'units', -3.0: 'reading_sign'}.get(float(np.trace(axes)), 'sign'))
        other.told = [Finding(name, f'the readings are {1.0 / unit:.4g} times the right ones, '
                              f'axes {conventions.axes(axes.T)}, in {called}', 1.0 / unit)] * bool(
                                  np.any(other.exchange != AXES))
        return other

    def model(self, lag: int) -> Model:
        """Return what readings that are `lag` samples late may contain beside what is right."""
        keep = slice(abs(lag), -abs(lag) or None)       # what a roll has not wrapped
        plain, noisy = list[dict[str, Reals]](), list[dict[str, Reals]]()
        for pair, size in zip(self.motions, self.sizes, strict=True):
            smooth = pair[0].smooth[keep]
            for motion, parts in zip(pair, (plain, noisy), strict=True):
                effects = self.columns(motion)
                read = self.read(motion, lag)
                effects |= {TARGET: read - effects['total'], 'step': np.gradient(
                    read if self.noisy else effects.get('whole', read), axis=0)}
                parts.append({name: one[keep][smooth] / size for name, one in effects.items()})
        return Model(plain, noisy, self.always)

    def columns(self, motion: Smoothed) -> dict[str, Reals]:
        """Return the terms of a right reading, their sum `total`, and effects of defects."""
        if self.kind == 'accelerations':
            effects = self._of_forces(motion)
        elif self.kind == 'magnetometer':
            effects = {f'field {k}': motion.back @ axis for k, axis in enumerate(AXES)}
            effects['total'] = motion.back @ self.field
        else:
            effects = dict.fromkeys(('rates', 'total', 'whole'), motion.rates)
        total = effects['total']

        def turned(reading: Reals) -> Reals:
            return self.mounting.apply(along(motion.turn, reading))

        effects |= {
            'world': turned(total), 'reversed': turned(turned(total)),
            **{f'in world {arm}': turned(effects[arm]) for arm in self.arms},
            **{f'offset {k}': 0.0 * total + axis for k, axis in enumerate(AXES)}}
        for of in ('total', *self.arms):
            effects |= {f'matrix {i}{j} {of}': np.outer(effects[of][:, j], AXES[i])
                        for i, j in ENTRIES}
        return effects

    def _of_forces(self, motion: Smoothed) -> dict[str, Reals]:
        """Return the terms of a specific force, `total` without those of an unknown arm."""
        second, transposed = motion.second, motion.second.transpose(0, 2, 1)
        tangential, centripetal = (0.5 * (second + sign * transposed) @ self.arm
                                   for sign in (-1.0, 1.0))
        gravity, moved = self.gravity * motion.back @ UP, motion.acceleration + second @ self.arm
        return {
            'tangential': tangential, 'centripetal': centripetal, 'gravity': gravity,
            'linear': motion.acceleration, 'lever': second @ self.arm, 'whole': gravity + moved,
            'total': gravity + (motion.acceleration if self.always else moved),
            'fixed gravity': self.gravity * (0.0 * gravity + self.mounting.apply(UP)),
            # The motion a step later, then the axes.
            'difference': along(motion.back, np.gradient(along(motion.turn, moved), axis=0)),
            # A lever arm that is longer by 1 m along axes of the body, and a x r alone.
            **{f'arm {k}': second[:, :, k] for k in range(3)},
            **{f'turned arm {k}': 0.5 * (second - transposed)[:, :, k] for k in range(3)}}
