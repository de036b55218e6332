# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is fitted with its physical terms: for the accelerometer gravity, the acceleration of the
origin, a x r and w x (w x r).  As few causes as possible explain what remains, by least squares.
What is found and can be undone without a loss (a delay, other axes, another unit) is undone, and
the rest is looked for again.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.effects import (
    ANGLES,
    ENTRIES,
    PERMUTATIONS,
    STANDARD_GRAVITY,
    Compared,
    Comparison,
    Imu,
)
from spinning_top_sim.grade.lag import CLEARLY, ROUNDING, SURE, lag_of
from spinning_top_sim.tools.conventions import axes
from spinning_top_sim.tools.identify import NEAR, Cause, beyond, explain, instead, rms
from spinning_top_sim.tools.kinematics import Reals, Stretch
from spinning_top_sim.tools.report import Finding, Mark

_ANGLE = {'deg/s': 180.0 / math.pi, 'rad/s, taken for deg/s': math.pi / 180.0}
# By kind: the factors of other units by name; the unit of a reading.
UNITS = {'rates': _ANGLE, 'gyroscope': _ANGLE, 'accelerations': {'g': 1.0 / STANDARD_GRAVITY},
         'magnetometer': {'gauss': 1e4, 'mT': 1e3, 'uT': 1e6, 'nT': 1e9}}
SI = {'gyroscope': 'rad/s', 'accelerations': 'm/s^2', 'magnetometer': 'T'}
DENSITIES = {'gyroscope': 'gyroscope_noise_density',
             'accelerations': 'accelerometer_noise_density'}
# Terms of a specific force: what each is, and the fault where it is missing.
TERMS = {'tangential': ('a x r', 'no_tangential_term'),
         'centripetal': ('w x (w x r)', 'no_centripetal_term'),
         'gravity': ('gravity', 'no_gravity'),
         'linear': ('the acceleration of the origin', 'no_linear_acceleration'),
         'lever': ('the lever arm', 'no_lever_arm'), 'motion': ('motion', 'no_acceleration')}
OFFSETS = 'offset 0', 'offset 1', 'offset 2'
LATE = 0.75                 # lag from which on it is a fault [samples of the sensor]
# Share of a reading from which on a discrepancy is strange: rates that are told may be those of
# the middle of a step; a real device, where poses have noise, has errors that no simulator needs.
STRANGE, OF_STEPS, REAL = 2e-3, 2e-2, 0.03
UNEXPLAINED, ROUGH = 0.5, 0.3   # shares of a discrepancy, with noise of a reading, left at most
MISSING = 0.05              # share of a whole reading that is none
GRAVITY_BAND = 6e-3         # share by which gravity differs on Earth
EARTH_FIELD = 15e-6, 90e-6  # [T]
SAME_POWER = 1.05           # of noise, by which it may be larger besides
NOISE_BAND, NOISY = 0.05, 1e-4  # by which noise may differ from what is declared; is rounding
LEAST_KURTOSIS = 2.4        # of normal noise; it is 3, and 1.8 of uniform noise
FOUR_SIGMA = 4.0            # standard deviations by which a measured noise may differ besides
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told
SIXTH = 6                   # order of the differences by which noise is judged
# The relative standard deviation of white noise by n of them, times sqrt(n).
_SPREAD = math.sqrt(0.5 * math.comb(4 * SIXTH, 2 * SIXTH)) / math.comb(2 * SIXTH, SIXTH)


class Judged(NamedTuple):
    """Faults, marks by name, and notes on what could not be told."""

    faults: list[Finding]
    marks: dict[str, Mark]
    notes: list[str]


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float, *,
          exact_gravity: bool = True, covariance: Reals | None = None,
          slack: float = 0.0) -> Judged:
    """
    Return what is wrong with the readings of a kind.

    exact_gravity : whether that of another place on Earth is a fault
    covariance : (3, 3) that is declared
    slack : share by which readings may differ, since the motion is known no better
    """
    comparison, judged = Comparison(kind, stretches, imu, gravity), Judged([], {}, [])
    if not comparison.smoothed:
        return judged
    lag, late, sigma, clear = lag_of(comparison)
    late, sigma = late * comparison.steps, sigma * comparison.steps
    judged.marks[f'{kind}_lag_steps'] = Mark(late, LATE, _interval(sigma))
    if clear and abs(late) > max(LATE, SURE * sigma):
        judged.faults.append(Finding(
            'late' if late > 0.0 else 'early', f'the readings belong to the motion of '
            f'{abs(late):.3g} steps ({1e3 * abs(late) * comparison.own_step:.3g} ms) '
            f'{"before" if late > 0.0 else "after"}', late))
    for last in (False, False, True):
        compared = comparison.compare(lag)
        causes = Causes(comparison, compared, exact_gravity, slack)
        found, residual = causes.find()
        undone = [fault for fault in found if fault.evidence in causes.undo and not last]
        judged.faults.extend(fault for fault in undone or found if fault.name)
        if not undone:
            break
        comparison.undo(causes.undo[undone[0].evidence])
    judged.marks.update(_marks(comparison, compared, lag))
    if kind in DENSITIES:
        unknown = {'reading_scale', 'inaccurate', 'matrix', 'rates_in_world'}
        if unknown.isdisjoint(fault.name for fault in found):
            judged.faults.extend(_noise_faults(comparison, residual, covariance))
        judged.notes.extend(_untold(comparison, compared))
    return Judged([fault._replace(evidence=f'{kind}: {fault.evidence}')
                   for fault in judged.faults], judged.marks, judged.notes)


def _interval(sigma: float) -> str:
    return f'+- {1.96 * sigma:.2g}'


class Causes:
    """
    What may be wrong with readings.

    undo : by the evidence of a fault that can be undone, the matrix by which it multiplied
    """

    def __init__(self, comparison: Comparison, compared: Compared, exact_gravity: bool,
                 slack: float) -> None:
        self.comparison, self.compared, self.kind = comparison, compared, comparison.kind
        self.exact_gravity, self.undo = exact_gravity, dict[str, Reals]()
        self.known = comparison.imu.lever_arm is not None       # where the IMU is
        self.least = (OF_STEPS if self.kind == 'rates' else STRANGE) + slack
        self.strange = max(self.least, REAL * comparison.noisy)
        # Where w x (w x r) is not known its mean seems to be a bias.
        self.coarse = comparison.noisy and 'centripetal' in compared.effects and (
            SURE * compared.fit(['centripetal', *compared.always]).sigma[0] > TELLS)

    def find(self) -> tuple[list[Finding], Reals]:
        """Return the faults, and what they leave of the discrepancy."""
        compared, always = self.compared, self.compared.always
        residual = compared.fit(always).residual
        doubt = FOUR_SIGMA * _SPREAD / math.sqrt(residual.size)
        most = compared.floor * math.sqrt(SAME_POWER + 2.0 * doubt)
        before = beyond(residual, most)
        if unit := [*self._field_unit()]:
            return unit, residual
        if before <= self.least:
            return [], residual
        pairs, _ = explain(*compared.compressed(), [*self._causes()], math.hypot(
            compared.floor, 0.5 * self.least), always)
        while True:                             # without what may be chance
            names = [*always, *(name for cause, _ in pairs for name in cause.effects)]
            found, sigma, residual = compared.fit(names)
            sure, end = np.abs(found) > SURE * sigma, len(names)
            for k in reversed(range(len(pairs))):
                first = end - len(pairs[k][0].effects)
                if not np.any(sure[first:end]):
                    del pairs[k]
                    break
                end = first
            else:
                break
        rest = beyond(residual, most)
        if rest > max(UNEXPLAINED * before, self.strange, 2.0 * compared.floor,
                      (ROUGH + 2.0 * compared.floor) * self.comparison.noisy):
            if self.comparison.noisy and not self._clear('free'):     # weightless: noise is seen
                return [], residual
            return [Finding('inaccurate', f'{100.0 * rest:.3g} % of the reading is not that of '
                            'the motion', rest)], residual
        return [fault for _, fault in pairs], residual

    def _causes(self) -> Iterator[Cause]:
        if self.kind == 'accelerations':
            yield from self._causes_of_forces()
        yield Cause(['total'], self._scale)
        yield Cause(['step'])
        yield Cause(OFFSETS, self._bias)
        for effect, name, text in (
                ('world', 'rates_in_world' if self.kind in ANGLES else 'reading_in_world',
                 'the world, not of the IMU'),
                ('reversed', 'rotation_reversed', 'a sensor that turns against the IMU')):
            yield Cause(['total', effect], instead(
                name, f'the readings are in axes of {text}'))
        arms = [name for name in self.compared.always if name.startswith('arm')]
        for k in range(len(PERMUTATIONS)):
            yield Cause(['free', f'axes {k}', *(f'axes {k} {arm}' for arm in arms)],
                        partial(self._axes, k, len(arms)))
        entries = [f'matrix {i}{j}' for i, j in ENTRIES]
        yield Cause([*entries, *(f'{entry} {arm}' for arm in arms for entry in entries)],
                    partial(self._matrix, 9 * len(arms)))

    def _causes_of_forces(self) -> Iterator[Cause]:
        for name in TERMS:
            if name in self.compared.effects and (self.known or name in (
                    'gravity', 'linear', 'motion')):
                yield Cause([name], partial(self._term, name))
        yield Cause(['difference'], self._difference)
        yield Cause(['tangential step'])
        yield Cause(['axes late'])
        yield Cause(['gravity', *OFFSETS], self._gravity_frame)
        yield Cause([f'arm {k}' for k in range(3)], self._arm) if self.known else Cause(
            [f'turned arm {k}' for k in range(3)], self._split_arm)

    def _clear(self, name: str) -> bool:
        """Return whether an effect is much larger than its noise."""
        return self.kind != 'accelerations' or rms(self.compared.effects[name]) > (
            ROUNDING + CLEARLY * self.compared.noise.get(name, 0.0))

    def _undone(self, matrix: Reals, name: str, evidence: str, number: float) -> Finding:
        if name:
            self.undo[evidence] = matrix
        return Finding(name, evidence, number)

    def _scale(self, found: Reals) -> Finding | None:
        factor = 1.0 + float(found[-1])
        text = f'the readings are {factor:.4g} times what they should be'
        for unit, times in UNITS[self.kind].items():
            if abs(abs(factor) / times - 1.0) < 0.01:
                return self._undone(math.copysign(times, factor) * np.eye(3), 'units',
                                    f'{text}: they are in {unit}', factor)
        if abs(factor) < MISSING:
            return None
        if factor < 0.0:
            return self._undone(factor * np.eye(3), 'reading_sign', text, factor)
        small = self.strange if self.exact_gravity or self.kind != 'accelerations' else max(
            self.strange, GRAVITY_BAND)
        name = 'rates_scale' if self.kind == 'rates' else 'reading_scale'
        return Finding(name * (abs(factor - 1.0) > small), text, factor)

    def _bias(self, found: Reals) -> Finding:
        offset, field = found[-3:], self.comparison.field
        if len(found) > 3 and self.kind == 'magnetometer' and np.linalg.norm(
                found[:3] + field) < NEAR * np.linalg.norm(field):
            return Finding('reading_in_world', 'the field does not turn with the IMU')
        text = f'a constant ({listed(offset)}) {SI.get(self.kind, "rad/s")} is added'
        return Finding('bias' * (not self.coarse), text, float(np.linalg.norm(offset)))

    def _axes(self, k: int, arms: int, found: Reals) -> Finding | None:
        less, factor = found[len(found) - arms - 2:len(found) - arms].tolist()
        if arms and not self._clear('free'):    # weightless: the arm alone is seen
            less, factor = (0.0, 0.0) if self.comparison.noisy else (-1.0, 1.0)
        sizes = {unit: times for unit, times in UNITS[self.kind].items()
                 if abs(factor / times - 1.0) < 0.05}
        if abs(less + 1.0) > NEAR or (not sizes and abs(factor - 1.0) > NEAR):
            return None
        matrix = PERMUTATIONS[k]
        words = ', '.join(f'{axis} reads {one}' for axis, one in zip(
            'xyz', axes(matrix).split(', '), strict=True))
        return self._undone(
            next(iter(sizes.values()), 1.0) * matrix,
            'sign' if np.array_equal(np.abs(matrix), np.eye(3)) else 'axes',
            words + ''.join(f', in {unit}' for unit in sizes), factor)

    def _matrix(self, arms: int, found: Reals) -> Finding | None:
        matrix = np.eye(3) + found[len(found) - arms - 9:len(found) - arms].reshape(3, 3)
        left, _, right = np.linalg.svd(matrix)
        turn, change = left @ right, float(np.max(np.abs(matrix - np.eye(3))))
        if np.linalg.det(turn) > 0.0 and np.max(np.abs(matrix - turn)) < max(0.02, 0.1 * change):
            vector = Rotation.from_matrix(turn).inv().as_rotvec()
            angle = float(np.linalg.norm(vector))
            return self._undone(turn, 'mounting' * (angle > self.strange), 'the readings are in '
                                f'axes that are turned by ({listed(vector)}) rad from those of '
                                'the IMU', angle)
        near = [k for k, one in enumerate(PERMUTATIONS) if np.max(np.abs(matrix - one)) < 0.1]
        if near:
            return self._axes(near[0], 0, np.array((-1.0, 1.0)))
        rows = '; '.join(map(listed, matrix))
        return Finding('matrix' * (change > self.strange), f'the readings are the matrix [{rows}] '
                       'times what they should be', change)

    def _field_unit(self) -> Iterator[Finding]:
        """Yield the unit of a field that is not known, if it is not that of the Earth in T."""
        size, (low, high) = float(np.linalg.norm(self.comparison.field)), EARTH_FIELD
        if self.kind == 'magnetometer' and self.compared.always and not low < size < high:
            for unit, times in UNITS[self.kind].items():
                if low < size / times < high:
                    yield self._undone(times * np.eye(3), 'units', f'the field is {size:.4g}: it '
                                       f'is in {unit}, not in T', times)

    def _term(self, term: str, found: Reals) -> Finding | None:
        share, (what, missing) = 1.0 + float(found[-1]), TERMS[term]
        if term == 'motion' and self.known and 'linear' not in self.compared.effects:
            missing = 'no_lever_arm'
        if self.comparison.noisy and not self._clear(term):
            return None                         # a term of noise seems to be missing
        text = f'the term of {what} has {share:.3g} times its size'
        if term == 'gravity':
            if not self.known and abs(share * STANDARD_GRAVITY - 1.0) < 0.01:
                return None                     # in g: the arm is as much smaller
            if abs(share - 1.0) < GRAVITY_BAND and not self.exact_gravity:
                return Finding('', text)
            if share > NEAR:
                return Finding('gravity', f'gravity is {share:.4g} times what it should be', share)
        for unit, factor in (('mm', 1e-3), ('cm', 1e-2)) if term == 'linear' else ():
            if abs(share / factor - 1.0) < 0.05:
                return Finding('units', f'{text}: positions are in {unit}', share)
        if abs(share) < NEAR:
            return Finding(missing, text, share) if self.known or term != 'motion' else None
        if self.comparison.noisy and share > 0.0:       # noise that is not white makes it smaller
            return Finding('', text)
        return Finding('acceleration_scale' if share > 0.0 else
                       'gravity_sign' if term == 'gravity' else 'reading_sign', text, share)

    def _gravity_frame(self, found: Reals) -> Finding | None:
        fixed, gravity = float(np.linalg.norm(found[-3:])), self.comparison.gravity
        there = abs(found[-4] + 1.0) <= NEAR and abs(fixed / gravity - 1.0) <= NEAR
        text = f'gravity, {fixed:.4g} m/s^2, does not turn with the IMU'
        return Finding('gravity_frame', text, fixed) if there else None

    def _difference(self, found: Reals) -> Finding | None:
        delay = -float(found[-1])
        return None if not 0.25 < delay < 0.8 else Finding(
            'finite_differences', f'the acceleration, without gravity, is that of {delay:.3g} '
            'steps before, as a difference of two velocities', delay)

    def _arm(self, found: Reals) -> Finding | None:
        arm = self.comparison.arm
        point, size = found[-3:] + arm, float(np.linalg.norm(arm))
        share = float(point @ arm) / (size * size or 1.0)
        if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * share * size:
            return self._term('lever', np.array([share - 1.0]))
        return Finding('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _split_arm(self, found: Reals) -> Finding | None:
        """Judge by the arms that a x r and w x (w x r) have, where none is given."""
        centripetal = self.comparison.arm + found[:3]
        sizes = np.linalg.norm(centripetal), np.linalg.norm(centripetal + found[-3:])
        for (small, large), term in ((sizes, 'centripetal'), (sizes[::-1], 'tangential')):
            if small < NEAR * large:
                return self._term(term, np.array([float(small / large) - 1.0]))
        return None


def _marks(comparison: Comparison, compared: Compared, lag: int) -> dict[str, Mark]:
    """Return what the sensor is found to be, with intervals of 95 %."""
    kind, always = comparison.kind, compared.always
    marks = {f'{kind}_discrepancy': Mark(beyond(compared.target, compared.floor)),
             f'{kind}_noise': Mark(comparison.reading_noise)}
    if always:
        what, values = ('field', comparison.field) if kind == 'magnetometer' else (
            'lever_arm', comparison.arm)
        marks.update({f'{what}_{axis}': Mark(float(value), meaning=_interval(deviation))
                      for axis, value, deviation in zip(
                          'xyz', values, compared.fit(always).sigma, strict=True)})
    if kind in DENSITIES:
        names = [f'matrix {i}{j}' for i, j in ENTRIES]
        found, sigma, _ = compared.fit([*always, *names, *OFFSETS])
        first, matrix = len(always), np.eye(3)
        if kind == 'gyroscope' and np.all(sigma < np.inf):  # undone, it is smoothed as the motion
            matrix = matrix + found[first:first + 9].reshape(3, 3)
            comparison.undo(matrix)
            found, sigma, _ = comparison.compare(lag).fit([*always, *names, *OFFSETS])
        matrix = matrix @ (np.eye(3) + found[first:first + 9].reshape(3, 3))
        for k, value in enumerate([*matrix.ravel(), *found[first + 9:]]):
            name = f'matrix_{"xyz"[k // 3]}{"xyz"[k % 3]}' if k < 9 else f'bias_{"xyz"[k - 9]}'
            marks[f'{kind}_{name}'] = Mark(float(value), meaning=_interval(sigma[first + k]))
    return marks


def _untold(comparison: Comparison, compared: Compared) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    # What is not known is the arm, of both terms together.
    terms = [name for name in ('total', *TERMS) if name in compared.effects and (
        name in ('centripetal', 'linear') or (name == 'total' and comparison.kind in ANGLES))]
    terms = [name for name in terms if rms(compared.effects[name]) > 0.0]
    _, sigma, _ = compared.fit([*terms, *compared.always])
    turns, places = (max(one.body.sigma.get(name, 0.0) for one in comparison.smoothed)
                     for name in ('attitudes', 'positions'))
    for name, deviation in zip(terms, sigma.tolist(), strict=False):
        if (worse := SURE * deviation / TELLS) > 1.0:
            yield (f'{comparison.kind}: the size of the term {name} is known to '
                   f'+- {196.0 * deviation:.2g} % only: its faults are not told' + (
                       f'; poses with noise of {turns / worse:.2g} rad, {places / worse:.2g} m '
                       'would tell' if comparison.noisy and worse < math.inf else ''))


def _noise_faults(comparison: Comparison, residual: Reals,
                  covariance: Reals | None) -> Iterator[Finding]:
    """Compare noise with what is declared, and with normal noise."""
    density = getattr(comparison.imu, DENSITIES[comparison.kind])
    size = float(np.min(comparison.sizes))
    noise, root = comparison.reading_noise, math.sqrt(comparison.own_step)
    if not comparison.noisy:            # all that is left is noise of the readings
        parts = [part * one for part, one in zip(np.split(
            residual, np.cumsum(comparison.counts)[:-1]), comparison.sizes, strict=True)]
        left = rms(np.array([rms(np.diff(part, SIXTH, axis=0)) for part in parts])) / math.sqrt(
            math.comb(2 * SIXTH, SIXTH))
        # A cause that is found may have left some fast motion.
        noise = left if left < 1.2 * noise else noise
        residual = np.concatenate(parts)
    exists = noise > NOISY * size
    band = NOISE_BAND + FOUR_SIGMA * _SPREAD / math.sqrt(residual.size)
    text = f'the noise has a standard deviation of {noise:.4g}'
    told = math.nan if covariance is None else math.sqrt(abs(np.trace(covariance)) / 3.0)
    if told == 0.0 and exists:
        yield Finding('covariance_zero', f'{text}, its covariance is told as 0', noise)
    declared = (told or math.nan) if density is None else density / root
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > band:
        factors: Mapping[str, float] = {'sqrt(2)': math.sqrt(2.0), '1/sqrt(2)': math.sqrt(0.5),
                                        'sqrt(dt)': root, '1/sqrt(dt)': 1.0 / root}
        as_if = ''.join(f' ({name})' for name, factor in factors.items()
                        if abs(ratio / factor - 1.0) < band)
        yield Finding('noise_scale', f'{text}, {ratio:.4g}{as_if} times what is declared, '
                      f'{declared:.4g}', ratio)
    if exists and not comparison.noisy and noise > rms(residual) / (1.0 + band):
        kurtosis = float(np.mean(residual ** 4)) / rms(residual) ** 4
        if kurtosis < min(LEAST_KURTOSIS, 3.0 - FOUR_SIGMA * math.sqrt(24.0 / residual.size)):
            yield Finding('uniform_noise', f'the noise has a kurtosis of {kurtosis:.3g}; normal '
                          'noise has 3, uniform noise 1.8', kurtosis)


def listed(values: Iterable[float]) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)
