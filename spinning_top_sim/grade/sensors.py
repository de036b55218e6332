# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is fitted with its physical terms: for the accelerometer gravity, the acceleration of the
origin, a x r and w x (w x r).  What remains is the discrepancy; as few causes as possible explain
it, by least squares.  What is found and can be undone without a loss (a delay, other axes, another
unit) is undone, and the rest is looked for again.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.effects import (
    ANGLES,
    FORCES,
    PERMUTATIONS,
    STANDARD_GRAVITY,
    Comparison,
    Imu,
    Stack,
)
from spinning_top_sim.grade.kinematics import ORDER, Reals, Stretch
from spinning_top_sim.tools.identify import (
    NEAR,
    Cause,
    beyond,
    explain,
    instead,
    rms,
)
from spinning_top_sim.tools.report import Finding, Mark


class Kind(NamedTuple):
    """A kind of readings: factors of other units, and from where on a discrepancy is strange."""

    units: Mapping[str, float]
    strange: float = 2e-3
    unit: str = ''


_DEGREES = {'deg/s': 180.0 / math.pi, 'rad/s for deg/s': math.pi / 180.0, 'rpm': 30.0 / math.pi}
_G = {'g': 1.0 / STANDARD_GRAVITY, 'mg': 1e3 / STANDARD_GRAVITY}
# Rates may be those of the middle of a step; velocities are means over a step, compared with those
# of its ends: a larger discrepancy is not strange.
KINDS = {
    'rates': Kind(_DEGREES, 2e-2, 'rad/s'), 'gyroscope': Kind(_DEGREES, unit='rad/s'),
    'accelerations': Kind(_G, unit='m/s^2'),
    'magnetometer': Kind({'gauss': 1e4, 'mT': 1e3, 'uT': 1e6, 'nT': 1e9}, unit='T'),
    'rotations': Kind(_DEGREES, unit='rad/s'), 'velocities': Kind(_G, 5e-2, 'm/s^2')}
DENSITIES = {'gyroscope': 'gyroscope_noise_density',
             'accelerations': 'accelerometer_noise_density'}
LAGS = range(-5, 41)        # lags that are tried [samples]
ROUNDING = 1e-5         # share of a reading from which on a lag is looked for
LATE = 0.75                 # lag from which on it is a fault [samples]
REAL = 0.03             # share by which a device may differ where poses have noise
SURE = 5.0                  # standard deviations from which on a number is not chance
BLOCKS = 20                 # into which residuals are split, to know their correlation
SAME_POWER = 1.05           # of the noise, by which it may be larger besides
MISSING = 0.05          # share of a whole reading that is none
UNEXPLAINED = 0.5           # share of a discrepancy that causes leave where they explain nothing
GRAVITY_BAND = 6e-3         # share by which gravity differs on Earth
EARTH_FIELD = 15e-6, 90e-6  # [T]
NOISY = 1e-4                # smaller noise, relative to the reading, is rounding
NOISE_BAND = 0.05           # share by which noise may differ from what is declared
LEAST_KURTOSIS = 2.4        # of normal noise; it is 3, and 1.8 of uniform noise
FOUR_SIGMA = 4.0            # standard deviations by which a measured noise may differ besides
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told
# The relative standard deviation of white noise that is measured by the median of n differences,
# times sqrt(n).
SIXTH = 6               # order of the differences by which noise is judged
_SPREAD = 1.65 * math.sqrt(0.5 * math.comb(4 * ORDER, 2 * ORDER)) / math.comb(2 * ORDER, ORDER)


class Judged(NamedTuple):
    """Faults, marks by name, and notes on what was found or could not be told."""

    faults: list[Finding]
    marks: dict[str, Mark]
    notes: list[str]


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float, *,
          exact_gravity: bool = True, covariance: Reals | None = None,
          slack: float = 0.0) -> Judged:
    """
    Return what is wrong with the readings of one of KINDS.

    exact_gravity : whether that of another place on Earth is a fault
    covariance : (3, 3) that is declared
    slack : share by which readings may differ, since the motion is known no better
    """
    comparison = Comparison(kind, stretches, imu, gravity)
    judged = Judged([], {}, [])
    if not comparison.smoothed:
        return judged
    lag = 0
    if kind != 'velocities':        # these are means over a step
        lag, late, sigma = _lag(comparison)
        late, sigma = late * comparison.steps, sigma * comparison.steps
        judged.marks[f'{kind}_lag_steps'] = Mark(late, LATE, _interval(sigma))
        if abs(late) > max(LATE, SURE * sigma):
            judged.faults.append(Finding(
                'late' if late > 0.0 else 'early', f'the readings belong to the motion of '
                f'{abs(late):.3g} steps ({1e3 * abs(late) * comparison.own_step:.3g} ms) '
                f'{"before" if late > 0.0 else "after"}', late))
    for last in (False, False, True):
        stack = comparison.stack(lag)
        causes = Causes(comparison, stack, exact_gravity, slack)
        found, residual = causes.find()
        undone = [fault for fault in found if fault.evidence in causes.undo and not last]
        judged.faults.extend(fault for fault in undone or found if fault.name)
        if not undone:
            break
        comparison.undo(causes.undo[undone[0].evidence])
    known = {'reading_scale', 'inconsistent_reading', 'matrix'}.isdisjoint(
        fault.name for fault in found)
    judged.marks.update(_marks(comparison, stack, residual))
    if kind in DENSITIES and known:
        judged.faults.extend(_noise_faults(comparison, stack, residual, covariance))
    judged.notes.extend(_untold(comparison, stack))
    return Judged([fault._replace(evidence=f'{kind}: {fault.evidence}')
                   for fault in judged.faults], judged.marks, judged.notes)


def _interval(sigma: float) -> str:
    return f'+- {1.96 * sigma:.2g}'


def _lag(comparison: Comparison) -> tuple[int, float, float]:
    """
    Return by how many samples readings are late: as whole, with its fraction, and its deviation.

    The reading is fitted by all terms, of all axes, at each lag: what else is wrong does not
    count.
    """
    lags = [lag for lag in LAGS if 4 * abs(lag) < comparison.shortest]
    bases = []
    for view in comparison.views():
        names = ['total'] if comparison.kind in ANGLES else [*view.terms, *view.always]
        columns = np.hstack([*(view.effects[name] for name in (*names, 'world')),
                             np.ones((len(view.reading), 1))])[_cut(lags)]
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        bases.append(left[:, sizes > 1e-9 * sizes[0]])

    def left_at(lag: int) -> float:
        total = 0.0
        for basis, reading in zip(bases, comparison.read_at(lag), strict=True):
            part = reading[_cut(lags)]
            total += float(np.sum((part - basis @ (basis.T @ part)) ** 2))
        return total

    found = {lag: left_at(lag) for lag in lags}
    best = min(found, key=lambda lag: found[lag])
    if best in (lags[0], lags[-1]):
        return 0, math.nan, math.inf
    # Around its minimum the sum of squares is a parabola.
    now, least, before, after = (found[lag] for lag in (0, best, best - 1, best + 1))
    curvature = before - 2.0 * least + after
    if curvature <= 0.0:
        return 0, math.nan, math.inf
    late = best + 0.5 * (before - after) / curvature
    count = sum(3 * len(basis) for basis in bases)
    variance = least / count * 2.0 * comparison.width       # of correlated noise
    small = sum(view.noises[0] ** 2 for view in comparison.views()) / len(bases) * 1.5 + (
        KINDS[comparison.kind].strange * comparison.size) ** 2
    if now < count * (ROUNDING * comparison.size) ** 2:     # every lag explains it
        return 0, math.nan, math.inf
    clear = least < 0.25 * now or (least < count * small and now - least > SURE ** 2 * variance)
    return (best, late, math.sqrt(2.0 * variance / curvature)) if best == 0 or clear else (
        0, math.nan, math.inf)


def _cut(lags: Sequence[int]) -> slice:
    """Return the samples for which there is a reading at all lags."""
    return slice(-lags[0], -lags[-1] or None)


class Causes:
    """
    What may be wrong with readings.

    undo : by the evidence of a fault that can be undone, the matrix by which it multiplied
    """

    def __init__(self, comparison: Comparison, stack: Stack, exact_gravity: bool,
                 slack: float) -> None:
        self.comparison, self.stack = comparison, stack
        self.kind, self.exact_gravity = comparison.kind, exact_gravity
        self.undo: dict[str, Reals] = {}
        # A real device has errors that no simulator needs.
        self.least = KINDS[self.kind].strange + slack
        self.strange = max(self.least, REAL * comparison.noisy)

    def find(self) -> tuple[list[Finding], Reals]:
        """Return the faults, and what they leave of the discrepancy."""
        stack = self.stack
        _, _, residual = stack.fit(stack.always) if stack.always else (0, 0, stack.target)
        doubt = FOUR_SIGMA * _SPREAD / math.sqrt(residual.size)
        most = stack.floor * math.sqrt(SAME_POWER + 2.0 * doubt)
        before = beyond(residual, most)
        unit = [*self._field_unit()]
        if unit or before <= self.least:
            return unit, residual
        target, effects = stack.compressed()
        pairs, _ = explain(target, effects, [*self._causes()], math.hypot(
            stack.floor, 0.5 * self.least), stack.always)
        while pairs:
            names = [*stack.always, *(name for cause, _ in pairs for name in cause.effects)]
            found, sigma, residual = stack.fit(names)
            sure = np.abs(found) > SURE * sigma
            ends = len(stack.always) + np.cumsum([len(cause.effects) for cause, _ in pairs])
            chance = [k for k, (end, (cause, _)) in enumerate(zip(ends, pairs, strict=True))
                      if not np.any(sure[end - len(cause.effects):end])]
            if not chance:
                break
            del pairs[chance[-1]]
        else:
            residual = stack.fit(stack.always)[2] if stack.always else stack.target
        rest = beyond(residual, most)
        if rest > max(UNEXPLAINED * before, self.strange, 2.0 * stack.floor):
            return [Finding('inaccurate', f'{100.0 * rest:.3g} % of the reading is not that of '
                            'the motion', rest)], residual
        return [fault for _, fault in pairs], residual

    def _causes(self) -> Iterator[Cause]:
        last = {'rates': 'rates_in_world', 'gyroscope': 'rates_in_world'}
        text = 'the readings are in axes of '
        if self.kind in FORCES:
            yield from self._causes_of_forces()
        yield Cause(['total'], self._scale)
        yield Cause(['step'])
        yield Cause(['offset 0', 'offset 1', 'offset 2'], self._bias)
        yield Cause(['total', 'world'], lambda found: instead(
            last.get(self.kind, 'reading_in_world'), f'{text}the world, not of the IMU')(
                found[-2:]))
        yield Cause(['total', 'reversed'], lambda found: instead(
            'rotation_reversed', f'{text}a sensor that turns against the IMU')(found[-2:]))
        arms = [name for name in self.stack.always if self.kind in FORCES]
        for k in range(len(PERMUTATIONS)):
            yield Cause(['free', f'axes {k}', *(f'axes {k} {arm}' for arm in arms)],
                        partial(self._axes, k, len(arms)))
        entries = [f'matrix {i}{j}' for i in range(3) for j in range(3)]
        yield Cause([*entries, *(f'{entry} {arm}' for arm in arms for entry in entries)],
                    self._matrix)
        if self.kind == 'magnetometer' and self.stack.always:
            yield Cause([f'turned {k}' for k in range(3)], self._turned_field)

    def _causes_of_forces(self) -> Iterator[Cause]:
        known = self.comparison.imu.lever_arm is not None
        for name in ('tangential', 'centripetal', 'gravity', 'linear', 'lever', 'motion',
                     'transport'):
            if name in self.stack.effects and (known or name in (
                    'gravity', 'linear', 'motion', 'transport')):
                yield Cause([name], partial(self._term, name))
        yield Cause(['difference'], self._difference)
        yield Cause(['tangential step'])
        yield Cause(['axes late'])
        yield Cause(['gravity', 'offset 0', 'offset 1', 'offset 2'], self._gravity_frame)
        if known:
            yield Cause(['arm 0', 'arm 1', 'arm 2'], self._arm)
        else:
            yield Cause(['turned arm 0', 'turned arm 1', 'turned arm 2'], self._split_arm)

    def _undone(self, matrix: Reals, name: str, evidence: str, number: float) -> Finding:
        self.undo[evidence] = matrix
        return Finding(name, evidence, number)

    def _scale(self, found: Reals) -> Finding | None:
        factor = 1.0 + float(found[-1])
        for unit, times in KINDS[self.kind].units.items():
            if abs(abs(factor) / times - 1.0) < 0.01:
                factor = math.copysign(times, factor)
                return self._undone(factor * np.eye(3), 'units', f'the readings are {factor:.4g} '
                                    f'times what they should be: they are in {unit}', factor)
        text = f'the readings are {factor:.4g} times what they should be'
        if abs(factor) < MISSING:
            return None
        if factor < 0.0:
            return self._undone(factor * np.eye(3), 'reading_sign', text, factor)
        known = self.kind in FORCES and not self.exact_gravity and (
            abs(factor - 1.0) < GRAVITY_BAND)
        scale = 'rates_scale' if self.kind == 'rates' else 'reading_scale'
        return Finding('' if known or abs(factor - 1.0) < self.strange else scale, text, factor)

    def _bias(self, found: Reals) -> Finding:
        offset = found[-3:]
        size = float(np.linalg.norm(offset))
        if self.kind == 'magnetometer' and self.stack.always and (
                np.linalg.norm(found[:3] + self.comparison.field) < NEAR * np.linalg.norm(
                    self.comparison.field)):
            return Finding('reading_in_world', 'the field does not turn with the IMU')
        return Finding('bias', f'a constant ({listed(offset)}) {KINDS[self.kind].unit} is added',
                       size)

    def _axes(self, k: int, arms: int, found: Reals) -> Finding | None:
        less, factor = found[-2 - arms:len(found) - arms].tolist()
        if arms and less == 0.0 and factor == 0.0:      # weightless: the arm alone is seen
            less, factor = -1.0, 1.0
        if abs(less + 1.0) > NEAR or factor < NEAR:
            return None
        units = {unit: times for unit, times in KINDS[self.kind].units.items()
                 if abs(factor / times - 1.0) < 0.05}
        if not units and abs(factor - 1.0) > NEAR:
            return None
        matrix = PERMUTATIONS[k]
        words = ', '.join(f'{axis} reads {"-" if np.sum(row) < 0.0 else ""}'
                          f'{"xyz"[int(np.argmax(np.abs(row)))]}'
                          for axis, row in zip('xyz', matrix, strict=True))
        size = next(iter(units.values()), 1.0)
        sign = np.array_equal(np.abs(matrix), np.eye(3))
        return self._undone(size * matrix, 'sign' if sign else 'axes', words + ''.join(
            f', in {unit}' for unit in units), factor)

    def _matrix(self, found: Reals) -> Finding | None:
        arms = 27 if self.kind in FORCES and self.stack.always else 0
        matrix = np.eye(3) + found[len(found) - 9 - arms:len(found) - arms].reshape(3, 3)
        left, _, right = np.linalg.svd(matrix)
        turn = left @ right
        change = float(np.max(np.abs(matrix - np.eye(3))))
        if np.linalg.det(turn) > 0.0 and np.max(np.abs(matrix - turn)) < max(0.02, 0.1 * change):
            vector = Rotation.from_matrix(turn).inv().as_rotvec()
            angle = float(np.linalg.norm(vector))
            return self._undone(turn, 'mounting' if angle > self.strange else '',
                                f'the readings are in axes that are turned by ({listed(vector)}) '
                                'rad from those of the IMU', angle)
        words = '; '.join(f'({listed(row)})' for row in matrix)
        return Finding('matrix' if change > self.strange else '', f'the readings are the matrix '
                       f'[{words}] times what they should be', change)

    def _field_unit(self) -> Iterator[Finding]:
        """Yield the unit of a field that is not known, if it is not that of the Earth in T."""
        size = float(np.linalg.norm(self.comparison.field))
        if self.kind == 'magnetometer' and self.stack.always and not (
                EARTH_FIELD[0] < size < EARTH_FIELD[1]):
            for unit, times in KINDS[self.kind].units.items():
                if EARTH_FIELD[0] < size / times < EARTH_FIELD[1]:
                    yield self._undone(times * np.eye(3), 'units', f'the field is {size:.4g}: it '
                                       f'is in {unit}, not in T', times)

    def _turned_field(self, found: Reals) -> Finding | None:
        field = self.comparison.field
        gone = np.linalg.norm(found[:3] + field) < NEAR * np.linalg.norm(field)
        return Finding('rotation_reversed', 'the field turns against the IMU') if gone else None

    # Terms of a specific force: what each is, and the fault where it is missing.
    _TERMS: ClassVar = {
        'gravity': ('gravity', 'no_gravity'), 'tangential': ('a x r', 'no_tangential_term'),
        'centripetal': ('w x (w x r)', 'no_centripetal_term'),
        'linear': ('the acceleration of the origin', 'no_linear_acceleration'),
        'lever': ('the lever arm', 'no_lever_arm'), 'motion': ('motion', 'no_acceleration'),
        'transport': ('w x v', 'no_transport_term')}

    def _term(self, term: str, found: Reals) -> Finding | None:
        share, (what, missing) = 1.0 + float(found[-1]), self._TERMS[term]
        if term == 'motion' and 'linear' not in self.stack.terms:
            missing = 'no_lever_arm'
        if term == 'motion' and self.stack.always:      # whose arm is not known
            return None if abs(share) < NEAR else Finding('acceleration_scale', f'accelerations, without gravity, are {share:.3g} times what they should be', share)
        text = f'the term of {what} has {share:.3g} times its size'
        if term == 'gravity' and self.stack.always and abs(share * STANDARD_GRAVITY - 1.0) < 0.01:
            return None                                 # in g: the arm is as much smaller
        if abs(share) < NEAR:
            return Finding(missing, text, share)
        if term == 'transport':
            return None
        if term == 'gravity' and not self.exact_gravity and abs(share - 1.0) < GRAVITY_BAND:
            return Finding('', text)
        if term == 'gravity' and share > 0.0:
            return Finding('gravity', f'gravity is {share:.4g} times {STANDARD_GRAVITY} m/s^2',
                           share)
        return Finding('acceleration_scale' if share > 0.0 else
                       'gravity_sign' if term == 'gravity' else 'reading_sign', text, share)

    def _gravity_frame(self, found: Reals) -> Finding | None:
        fixed = float(np.linalg.norm(found[-3:]))
        gravity = self.comparison.gravity
        there = abs(found[-4] + 1.0) <= NEAR and abs(fixed / gravity - 1.0) <= NEAR
        text = f'gravity, {fixed:.4g} m/s^2, does not turn with the IMU'
        return Finding('gravity_frame', text, fixed) if there else None

    def _difference(self, found: Reals) -> Finding | None:
        delay = -float(found[-1])
        return None if not 0.25 < delay < 0.8 else Finding(
            'finite_differences', f'the acceleration, without gravity, is that of {delay:.3g} '
            'steps before, as a difference of two velocities', delay)

    def _arm(self, found: Reals) -> Finding:
        arm = self.comparison.arm
        point, size = found[-3:] + arm, float(np.linalg.norm(arm))
        share = float(point @ arm) / (size * size or 1.0)
        term = 'lever' if 'linear' in self.stack.terms else 'motion'
        if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * share * size:
            return self._term(term, np.array([share - 1.0])) or Finding('', '')
        return Finding('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _split_arm(self, found: Reals) -> Finding | None:
        """Judge by the arms that a x r and w x (w x r) have, where none is given."""
        centripetal = self.comparison.arm + found[:3]
        tangential = centripetal + found[-3:]
        sizes = np.linalg.norm(centripetal), np.linalg.norm(tangential)
        for (small, large), term in ((sizes, 'centripetal'), (sizes[::-1], 'tangential')):
            if small < NEAR * large:
                return self._term(term, np.array([float(small / large) - 1.0]))
        return None


def _marks(comparison: Comparison, stack: Stack, residual: Reals) -> dict[str, Mark]:
    """Return what the sensor is found to be, with intervals of 95 %."""
    kind = comparison.kind
    names = [f'matrix {i}{j}' for i in range(3) for j in range(3)] + [
        f'offset {k}' for k in range(3)]
    found, sigma, _ = stack.fit([*stack.always, *names])
    marks = {f'{kind}_discrepancy': Mark(beyond(stack.target, stack.floor)),
             f'{kind}_noise': Mark(comparison.reading_noise)}
    if kind in ('gyroscope', 'accelerations'):
        extra = min(comparison.share, 1.0) ** 2     # a motion with noise seems larger
        first = len(stack.always)
        for i, axis in enumerate('xyz'):
            for j, other in enumerate('xyz'):
                value, deviation = found[first + 3 * i + j], sigma[first + 3 * i + j]
                marks[f'{kind}_matrix_{axis}{other}'] = Mark(
                    float(value) + (i == j), meaning=_interval(float(deviation) + extra / 1.96))
            marks[f'{kind}_bias_{axis}'] = Mark(
                float(found[first + 9 + i]), meaning=_interval(float(sigma[first + 9 + i])))
    if comparison.kind == 'accelerations' and stack.always:
        _, deviations, _ = stack.fit(stack.always)
        marks.update({f'lever_arm_{axis}': Mark(float(value), meaning=_interval(float(deviation)))
                      for axis, value, deviation in zip('xyz', comparison.arm, deviations,
                                                        strict=True)})
    if comparison.kind == 'magnetometer':
        marks.update({f'field_{axis}': Mark(float(value))
                      for axis, value in zip('xyz', comparison.field, strict=True)})
    return marks


def _untold(comparison: Comparison, stack: Stack) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    # What is not known is the arm, of both terms together.
    terms = [name for name in stack.terms if not (stack.always and name == 'tangential')]
    _, sigma, _ = stack.fit([*terms, *stack.always])
    turns = max(one.sigma.get('attitudes', 0.0) for one in comparison.stretches)
    places = max(one.sigma.get('positions', 0.0) for one in comparison.stretches)
    for name, deviation in zip(terms, sigma.tolist(), strict=False):
        if (worse := SURE * deviation / TELLS) > 1.0 and rms(stack.effects[name]) > 0.0:
            yield (f'{comparison.kind}: the size of the term {name} is known to '
                   f'+- {100.0 * 1.96 * deviation:.2g} % only: its faults are not told; noise '
                   f'of poses below {turns / worse:.2g} rad, {places / worse:.2g} m would tell')


def _noise_faults(comparison: Comparison, stack: Stack, residual: Reals,
                  covariance: Reals | None) -> Iterator[Finding]:
    """Compare noise with what is declared, and with normal noise."""
    density, size = getattr(comparison.imu, DENSITIES[comparison.kind]), rms(stack.sizes)
    noise, root = comparison.reading_noise, math.sqrt(comparison.own_step)
    if not comparison.noisy:            # all that is left is noise of the readings
        residual = residual * np.repeat(stack.sizes, stack.counts)[:, np.newaxis]
        parts = np.split(residual, np.cumsum(stack.counts)[:-1])
        noise = rms(np.array([rms(np.diff(part, SIXTH, axis=0)) for part in parts])) / math.sqrt(
            math.comb(2 * SIXTH, SIXTH))
    exists = noise > NOISY * size
    band = NOISE_BAND + FOUR_SIGMA * _SPREAD / math.sqrt(residual.size)
    text = f'the noise has a standard deviation of {noise:.4g}'
    told = math.nan if covariance is None else math.sqrt(abs(np.trace(covariance)) / 3.0)
    if told == 0.0 and exists:
        yield Finding('covariance_zero', f'{text}, its covariance is told as 0', noise)
    declared = (told or math.nan) if density is None else density / root
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > band:
        factors = {'sqrt(2)': math.sqrt(2.0), '1/sqrt(2)': math.sqrt(0.5), 'sqrt(dt)': root,
                   '1/sqrt(dt)': 1.0 / root}
        as_if = min(factors, key=lambda name: abs(ratio / factors[name] - 1.0))
        named = f' ({as_if})' if abs(ratio / factors[as_if] - 1.0) < band else ''
        yield Finding('noise_scale', f'{text}, {ratio:.4g}{named} times what is declared, '
                      f'{declared:.4g}', ratio)
    if exists and not comparison.noisy and noise > rms(residual) / (1.0 + band):
        kurtosis = float(np.mean(residual ** 4)) / rms(residual) ** 4
        doubt = FOUR_SIGMA * math.sqrt(24.0 / residual.size)
        if kurtosis < min(LEAST_KURTOSIS, 3.0 - doubt):
            yield Finding('uniform_noise', f'the noise has a kurtosis of {kurtosis:.3g}; normal '
                          'noise has 3, uniform noise 1.8', kurtosis)


def listed(values: Iterable[float]) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)
