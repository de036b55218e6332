# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is regressed on the columns of its motion.  As few causes as possible explain what a
right reading does not, and are named by their coefficients.  What can be undone without a loss
(a delay, other axes, another unit) is undone, and the rest is looked for again.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.columns import (
    AXES,
    ENTRIES,
    LENGTHS,
    STANDARD_GRAVITY,
    Comparison,
    Imu,
)
from spinning_top_sim.grade.lag import CLEARLY, ROUNDING, SURE, lag_of
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.identify import (
    NEAR,
    Cause,
    Verdict,
    beyond,
    compressed,
    explain,
    instead,
    parts,
    rms,
    verdicts,
)
from spinning_top_sim.tools.kinematics import SPREAD, Reals, Stretch, white
from spinning_top_sim.tools.report import Finding, Mark, Report

# Terms of a specific force: what each is, and the fault where it is missing.
TERMS = {'tangential': ('a x r', 'no_tangential_term'),
         'centripetal': ('w x (w x r)', 'no_centripetal_term'),
         'gravity': ('gravity', 'no_gravity'),
         'linear': ('the acceleration of the origin', 'no_linear_acceleration'),
         'lever': ('the lever arm', 'no_lever_arm'), 'motion': ('motion', 'no_acceleration')}
OFFSETS = 'offset 0', 'offset 1', 'offset 2'
MATRIX = [f'matrix {i}{j} free' for i, j in ENTRIES]
LATE = 0.75                 # lag from which on it is a fault [samples of the sensor]
# Share of a reading from which on a discrepancy is strange: rates that are told may be those of
# the middle of a step; a real device, where poses have noise, has errors that no simulator needs.
STRANGE, OF_STEPS, REAL = 2e-3, 2e-2, 0.03
UNEXPLAINED, ROUGH = 0.25, 0.3   # shares of a discrepancy, with noise of a reading, left at most
MISSING = 0.05              # share of a whole reading that is none
# By which a size differs from that of a unit, entries from axes, and from a turn, as a share.
OF_UNIT, OF_AXES, OF_TURN = 0.02, 0.1, 0.3
SANE = 0.5                  # by which the matrix of a sensor may differ from the identity
GRAVITY_BAND = 6e-3         # share by which gravity differs on Earth
EARTH_FIELD = 15e-6, 90e-6  # [T]
SAME_POWER = 1.05           # of noise, by which it may be larger besides
NOISE_BAND, NOISY = 0.05, 1e-4  # by which noise may differ from what is declared; is rounding
LEAST_KURTOSIS = 2.4        # of normal noise; it is 3, and 1.8 of uniform noise
FOUR_SIGMA = 4.0            # standard deviations by which a measured noise may differ besides
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float, *,
          exact_gravity: bool = True, placed: bool = True, slack: float = 0.0) -> Report:
    """
    Return what is wrong with the readings of a kind.

    exact_gravity : whether that of another place on Earth is a fault
    placed : whether it is known where the origin of the body is
    slack : share by which readings may differ, since the motion is known no better
    """
    comparison = Comparison(kind, stretches, imu, gravity)
    if not comparison.motions:
        return Report(kind)
    lag, late, sigma, clear = lag_of(comparison)
    late, sigma = late * comparison.steps, sigma * comparison.steps
    faults, notes = list[Verdict](), list[str]()
    if clear and abs(late) > max(LATE, SURE * sigma):
        faults.append(Verdict(
            'late' if late > 0.0 else 'early', f'the readings belong to the motion of '
            f'{abs(late):.3g} steps ({1e3 * abs(late) * comparison.own_step:.3g} ms) '
            f'{"before" if late > 0.0 else "after"}', late))
    for last in (False, False, True):
        comparison.compare(lag)
        found, residual, rest = Causes(
            comparison, exact_gravity, placed, slack).find()
        undone = [(one, one.undo) for one in found if one.name and one.undo is not None]
        if last or not undone:
            break
        faults.extend(one for one, _ in undone)
        comparison.undo(undone[0][1])
    faults.extend(found)
    if kind == 'accelerations' and not placed and rest > max(STRANGE, 2.0 * comparison.floor):
        return Report(kind, notes=[f'{kind}: {100.0 * rest:.3g} % of the reading may be the '
                                   'acceleration of the origin: without positions they are not '
                                   'graded'])
    marks = {f'{kind}_lag_steps': Mark(late, LATE, _interval(sigma)),
             **_marks(comparison, lag)}
    if comparison.density:
        if {'reading_scale', 'inaccurate', 'matrix', 'rates_in_world'}.isdisjoint(
                one.name for one in found):
            faults.extend(_noise_faults(
                comparison, residual, getattr(imu, comparison.density),
                stretches[0].covariance.get(kind)))
        notes.extend(_untold(comparison))
    return Report(kind, [Finding(one.name, f'{kind}: {one.evidence}', one.number)
                         for one in faults if one.name], marks, notes)


def _interval(sigma: float) -> str:
    return f'+- {1.96 * sigma:.2g}'


def listed(values: Iterable[float]) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)


class Causes:
    """What may be wrong with readings; `find` finds what is."""

    def __init__(self, comparison: Comparison, exact_gravity: bool, placed: bool,
                 slack: float) -> None:
        self.comparison, self.kind, self.placed = comparison, comparison.kind, placed
        self.exact_gravity, self.noisy = exact_gravity, comparison.noisy
        self.arm_known = not comparison.always
        self.least = (OF_STEPS if self.kind == 'rates' else STRANGE) + slack
        self.strange = max(self.least, REAL * self.noisy)

    def find(self) -> tuple[list[Verdict], Reals, float]:
        """Return the faults, what they leave of the discrepancy, and its size beyond noise."""
        compared, always = self.comparison, self.comparison.always
        residual = compared.fit(always).residual
        doubt = FOUR_SIGMA * SPREAD / math.sqrt(residual.size)
        most = compared.floor * math.sqrt(SAME_POWER + 2.0 * doubt)
        before = beyond(residual, most)
        if unit := [*self._field_unit()]:
            return unit, residual, before
        if before <= self.least:
            return [], residual, before
        chosen = explain(*compressed(compared.target, compared.effects), [*self._causes()],
                         math.hypot(compared.floor, 0.5 * self.least), always)
        while True:
            found, sigma, residual = compared.fit([*always, *(
                name for cause in chosen for name in cause.effects)])
            sure = np.abs(found) > SURE * sigma
            chance = [cause for cause, of in parts(chosen, len(always)) if not np.any(sure[of])]
            if not chance:
                break
            chosen.remove(chance[-1])
        told = verdicts(chosen, found, len(always))
        # A cause that is not what it seemed to be explains nothing.
        rest = before if None in told else beyond(residual, most)
        if rest > max(UNEXPLAINED * before, self.strange, 2.0 * compared.floor,
                      (ROUGH + 2.0 * compared.floor) * self.noisy):
            if self.noisy and not self._clear('free'):      # weightless: noise is seen
                return [], residual, rest
            return [Verdict('inaccurate', f'{100.0 * rest:.3g} % of the reading is not that of '
                            'the motion', rest)], residual, rest
        return [*filter(None, told)], residual, rest

    def _causes(self) -> Iterator[Cause]:
        if self.kind == 'accelerations':
            yield from self._causes_of_forces()
        arms = [name for name in self.comparison.always if name.startswith('arm')]
        yield Cause(['total'], lambda found: self._matrix((1.0 + found[-1]) * AXES))
        yield Cause(['step'])
        yield Cause(OFFSETS, self._bias)
        for effect, name, text in (
                ('world', 'rates_in_world' if self.comparison.angles else 'reading_in_world',
                 'the world, not of the IMU'),
                ('reversed', 'rotation_reversed', 'a sensor that turns against the IMU')):
            yield Cause([*(f'world {arm}' for arm in arms), 'free', effect], instead(
                name, f'the readings are in axes of {text}'))
        entries = [f'matrix {i}{j} {of}' for of in (*arms, 'free') for i, j in ENTRIES]
        if self.kind == 'magnetometer' and self.comparison.always:
            yield Cause([f'matrix {i}{j} field {k}' for i, j in ENTRIES for k in range(3)],
                        self._matrix_of_field)
        elif self.placed or not arms:     # so many columns fit what the origin does, too
            yield Cause(entries, lambda found: self._matrix(AXES + found[-9:].reshape(3, 3)))

    def _causes_of_forces(self) -> Iterator[Cause]:
        for name in TERMS:
            if name in self.comparison.effects and (self.arm_known or name in (
                    'gravity', 'linear', 'motion')):
                yield Cause([name], partial(self._term, name))
        yield Cause(['difference'], self._difference)
        yield Cause(['tangential step'])
        yield Cause(['axes late'])
        yield Cause(['gravity', *OFFSETS], self._gravity_frame)
        yield Cause([f'arm {k}' for k in range(3)], self._arm) if self.arm_known else Cause(
            [f'turned arm {k}' for k in range(3)], self._split_arm)

    def _clear(self, name: str) -> bool:
        """Return whether an effect is much larger than its noise."""
        return self.kind != 'accelerations' or rms(self.comparison.effects[name]) > (
            ROUNDING + CLEARLY * self.comparison.noise.get(name, 0.0))

    def _matrix(self, matrix: Reals) -> Verdict | None:
        """Judge a matrix by which the readings are what they should be, multiplied."""
        size = abs(float(np.linalg.det(matrix))) ** (1.0 / 3.0)
        unit, times = self._unit_of(size)
        shape, change = matrix / times, float(np.max(np.abs(matrix - AXES)))
        if np.array_equal(matrix, matrix[0, 0] * AXES):
            return self._scale(float(matrix[0, 0]), unit, times)
        axes = np.rint(shape)
        if np.array_equal(axes @ axes.T, AXES) and np.max(np.abs(shape - axes)) < OF_AXES and (
                not np.array_equal(axes, AXES)):
            words = ', '.join(f'{axis} reads {one}' for axis, one in zip(
                'xyz', conventions.axes(axes).split(', '), strict=True))
            return Verdict('sign' if np.array_equal(np.abs(axes), AXES) else 'axes', words + unit,
                           size, times * axes)
        left, _, right = np.linalg.svd(shape)
        turn = left @ right
        if np.linalg.det(turn) > 0.0 and np.max(np.abs(shape - turn)) < max(
                0.02, OF_TURN * change):
            vector = Rotation.from_matrix(turn).inv().as_rotvec()
            angle = float(np.linalg.norm(vector))
            return Verdict('mounting' * (angle > self.strange), 'the readings are in axes that '
                           f'are turned by ({listed(vector)}) rad from those of the IMU{unit}',
                           angle, times * turn)
        if change > SANE and self.comparison.always:    # beside an arm it fits what it is not
            return None
        rows = '; '.join(map(listed, matrix))
        return Verdict('matrix' * (change > self.strange), f'the readings are the matrix [{rows}] '
                       'times what they should be', change)

    def _matrix_of_field(self, found: Reals) -> Verdict | None:
        """Judge the products (9, 3) of entries of a matrix and of a field that is not known."""
        products = np.outer(AXES, self.comparison.field + found[:3]) + found[3:].reshape(9, 3)
        matrix = np.linalg.svd(products)[0][:, 0].reshape(3, 3)     # but for its size
        size = abs(float(np.linalg.det(matrix))) ** (1.0 / 3.0)
        return self._matrix(math.copysign(1.0 / max(size, MISSING), np.trace(matrix)) * matrix)

    def _unit_of(self, size: float) -> tuple[str, float]:
        """Return the unit of readings that are so many times too large, in words, and a size."""
        for name, factor in self.comparison.units.items():
            for times in (1.0 / factor, factor):        # the other: it is converted twice
                if factor != 1.0 and abs(size / times - 1.0) < OF_UNIT:
                    return f', in {name}', times
        return '', 1.0

    def _scale(self, factor: float, unit: str, times: float) -> Verdict | None:
        text = f'the readings are {factor:.4g} times what they should be'
        if abs(factor) < MISSING and not unit:
            return None
        if factor < 0.0:
            return Verdict('reading_sign', text + unit, factor, factor * AXES)
        if unit:
            return Verdict('units', text + unit, factor, times * AXES)
        small = self.strange if self.exact_gravity or self.kind != 'accelerations' else max(
            self.strange, GRAVITY_BAND)
        name = 'rates_scale' if self.kind == 'rates' else 'reading_scale'
        return Verdict(name * (abs(factor - 1.0) > small), text, factor)

    def _bias(self, found: Reals) -> Verdict:
        offset, field = found[-3:], self.comparison.field
        if len(found) > 3 and self.kind == 'magnetometer' and np.linalg.norm(
                found[:3] + field) < NEAR * np.linalg.norm(field):
            return Verdict('reading_in_world', 'the field does not turn with the IMU')
        # Where w x (w x r) is not known its mean seems to be a bias.
        coarse = self.noisy and 'centripetal' in self.comparison.effects and SURE * (
            self.comparison.fit(['centripetal', *self.comparison.always]).sigma[0]) > TELLS
        si = next(iter(self.comparison.units))
        return Verdict('bias' * (not coarse), f'a constant ({listed(offset)}) {si} is added',
                       float(np.linalg.norm(offset)))

    def _field_unit(self) -> Iterator[Verdict]:
        """Yield the unit of a field that is not known, if it is not that of the Earth in T."""
        size, (low, high) = float(np.linalg.norm(self.comparison.field)), EARTH_FIELD
        if self.kind == 'magnetometer' and self.comparison.always and not low < size < high:
            for unit, factor in self.comparison.units.items():
                if low < size * factor < high:
                    yield Verdict('units', f'the field is {size:.4g}: it is in {unit}, not in T',
                                  1.0 / factor, AXES / factor)

    def _term(self, term: str, found: Reals) -> Verdict | None:
        share, (what, missing) = 1.0 + float(found[-1]), TERMS[term]
        if term == 'motion' and self.arm_known and 'linear' not in self.comparison.effects:
            missing = 'no_lever_arm'
        if self.noisy and not self._clear(term):
            return None                         # a term of noise seems to be missing
        text = f'the term of {what} has {share:.3g} times its size'
        if term != 'linear' and abs(share * STANDARD_GRAVITY - 1.0) < OF_UNIT:
            return None                         # in g, as the whole reading is
        if term == 'gravity':
            if abs(share - 1.0) < GRAVITY_BAND and not self.exact_gravity:
                return Verdict('', text)
            if share > NEAR:
                return Verdict('gravity', f'gravity is {share:.4g} times what it should be', share)
        for unit, factor in LENGTHS.items() if term == 'linear' else ():
            if factor < 1.0 and abs(share / factor - 1.0) < 0.05:
                return Verdict('units', f'{text}: positions are in {unit}', share)
        if abs(share) < NEAR:
            return Verdict(missing, text, share) if self.arm_known or term != 'motion' else None
        if self.noisy and share > 0.0:          # noise that is not white makes it smaller
            return Verdict('', text)
        return Verdict('acceleration_scale' if share > 0.0 else
                       'gravity_sign' if term == 'gravity' else 'reading_sign', text, share)

    def _gravity_frame(self, found: Reals) -> Verdict | None:
        fixed, gravity = float(np.linalg.norm(found[-3:])), self.comparison.gravity
        there = abs(found[-4] + 1.0) <= NEAR and abs(fixed / gravity - 1.0) <= NEAR
        text = f'gravity, {fixed:.4g} m/s^2, does not turn with the IMU'
        return Verdict('gravity_frame', text, fixed) if there else None

    def _difference(self, found: Reals) -> Verdict | None:
        delay = -float(found[-1])
        return None if not 0.25 < delay < 0.8 else Verdict(
            'finite_differences', f'the acceleration, without gravity, is that of {delay:.3g} '
            'steps before, as a difference of two velocities', delay)

    def _arm(self, found: Reals) -> Verdict | None:
        arm = self.comparison.arm
        point, size = found[-3:] + arm, float(np.linalg.norm(arm))
        share = float(point @ arm) / (size * size or 1.0)
        if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * share * size:
            return self._term('lever', np.array([share - 1.0]))
        return Verdict('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _split_arm(self, found: Reals) -> Verdict | None:
        """Judge by the arms that a x r and w x (w x r) have, where none is given."""
        centripetal = self.comparison.arm + found[:3]
        sizes = np.linalg.norm(centripetal), np.linalg.norm(centripetal + found[-3:])
        for (small, large), term in ((sizes, 'centripetal'), (sizes[::-1], 'tangential')):
            if small < NEAR * large:
                return self._term(term, np.array([float(small / large) - 1.0]))
        return None


def _marks(comparison: Comparison, lag: int) -> dict[str, Mark]:
    """
    Return what the sensor is found to be, with intervals of 95 %.

    A matrix of a gyroscope is undone in `comparison`, which the noise is then judged by.
    """
    kind, always = comparison.kind, comparison.always
    marks = {f'{kind}_discrepancy': Mark(beyond(comparison.target, comparison.floor)),
             f'{kind}_noise': Mark(comparison.reading_noise)}
    if always:
        what, values = ('field', comparison.field) if kind == 'magnetometer' else (
            'lever_arm', comparison.arm)
        marks.update({f'{what}_{axis}': Mark(float(value), meaning=_interval(deviation))
                      for axis, value, deviation in zip(
                          'xyz', values, comparison.fit(always).sigma, strict=True)})
    if comparison.density:
        first, matrix = len(always), AXES
        found, sigma, _ = comparison.fit([*always, *MATRIX, *OFFSETS])
        if kind == 'gyroscope' and np.all(sigma < np.inf):  # undone, it is smoothed as the motion
            matrix = AXES + found[first:first + 9].reshape(3, 3)
            comparison.undo(matrix)
            comparison.compare(lag)
            found, sigma, _ = comparison.fit([*always, *MATRIX, *OFFSETS])
        matrix = matrix @ (AXES + found[first:first + 9].reshape(3, 3))
        names = [f'matrix_{"xyz"[i]}{"xyz"[j]}' for i, j in ENTRIES] + [
            f'bias_{axis}' for axis in 'xyz']
        marks.update({f'{kind}_{name}': Mark(float(value), meaning=_interval(deviation))
                      for name, value, deviation in zip(names, [
                          *matrix.ravel(), *found[first + 9:]], sigma[first:], strict=True)})
    return marks


def _untold(comparison: Comparison) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    # What is not known is the arm, of both terms together.
    terms = [name for name in (('total',) if comparison.angles else ('centripetal', 'linear'))
             if name in comparison.effects and rms(comparison.effects[name]) > 0.0]
    _, sigma, _ = comparison.fit([*terms, *comparison.always])
    turns, places = (max(one.body.sigma.get(name, 0.0) for one in comparison.motions)
                     for name in ('attitudes', 'positions'))
    for name, deviation in zip(terms, sigma.tolist(), strict=False):
        if (worse := SURE * deviation / TELLS) > 1.0:
            yield (f'{comparison.kind}: the size of the term {name} is known to '
                   f'+- {196.0 * deviation:.2g} % only: its faults are not told' + (
                       f'; poses with noise of {turns / worse:.2g} rad, {places / worse:.2g} m '
                       'would tell' if comparison.noisy and worse < math.inf else ''))


def _noise_faults(comparison: Comparison, residual: Reals, density: float | None,
                  covariance: Reals | None) -> Iterator[Verdict]:
    """Compare noise with what is declared, and with normal noise."""
    noise, root = comparison.reading_noise, math.sqrt(comparison.own_step)
    if not comparison.noisy:            # all that is left is noise of the readings
        parts = [part * size for part, size in zip(np.split(
            residual, np.cumsum(comparison.counts)[:-1]), comparison.sizes, strict=True)]
        # Either has fast motion, too: that of the reading, or of what no cause explains.
        noise = min(noise, rms(np.array([white(part) for part in parts])))
        residual = np.concatenate(parts)
    exists = noise > NOISY * float(np.min(comparison.sizes))
    band = NOISE_BAND + FOUR_SIGMA * SPREAD / math.sqrt(residual.size)
    text = f'the noise has a standard deviation of {noise:.4g}'
    told = math.nan if covariance is None else math.sqrt(abs(np.trace(covariance)) / 3.0)
    if told == 0.0 and exists:
        yield Verdict('covariance_zero', f'{text}, its covariance is told as 0', noise)
    declared = (told or math.nan) if density is None else density / root
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > band:
        factors: Mapping[str, float] = {'sqrt(2)': math.sqrt(2.0), '1/sqrt(2)': math.sqrt(0.5),
                                        'sqrt(dt)': root, '1/sqrt(dt)': 1.0 / root}
        as_if = ''.join(f' ({name})' for name, factor in factors.items()
                        if abs(ratio / factor - 1.0) < band)
        yield Verdict('noise_scale', f'{text}, {ratio:.4g}{as_if} times what is declared, '
                      f'{declared:.4g}', ratio)
    if exists and not comparison.noisy and noise > rms(residual) / (1.0 + band):
        kurtosis = float(np.mean(residual ** 4)) / rms(residual) ** 4
        if kurtosis < min(LEAST_KURTOSIS, 3.0 - FOUR_SIGMA * math.sqrt(24.0 / residual.size)):
            yield Verdict('uniform_noise', f'the noise has a kurtosis of {kurtosis:.3g}; normal '
                          'noise has 3, uniform noise 1.8', kurtosis)
