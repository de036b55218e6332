# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is regressed on the columns of its motion.  As few causes as possible explain what a
right reading does not, and are named by their coefficients.  What can be undone without a loss
(a delay, other axes, another unit) is undone, and the rest is looked for again.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import columns
from spinning_top_sim.grade.columns import AXES, DENSITIES, ENTRIES, SURE, Comparison, Imu
from spinning_top_sim.tools import conventions, identify
from spinning_top_sim.tools.identify import NEAR, Cause, Verdict, beyond, instead, rms
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
# Faults beside which the noise is not known.
UNCLEAR = {'reading_scale', 'inaccurate', 'matrix', 'rates_in_world'}
MISSING = 0.05              # share of a whole reading that is none
# By which a size differs from that of a unit, entries from axes, and from a turn, as a share.
OF_UNIT, OF_AXES, OF_TURN = 0.02, 0.1, 0.3
SANE = 0.5                  # by which the matrix of a sensor may differ from the identity
GRAVITY_BAND = 6e-3         # share by which gravity differs on Earth
EARTH_FIELD = 15e-6, 90e-6  # [T]
SAME_POWER = 1.05           # of noise, by which it may be larger besides
NOISE_BAND, NOISY = 0.05, 1e-4  # by which noise may differ from what is declared; is rounding
FOUR_SIGMA = 4.0            # standard deviations by which a measured noise may differ besides
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float, *,
          placed: bool = True, slack: float = 0.0) -> Report:
    """
    Return what is wrong with the readings of a kind.

    placed : whether it is known where the origin of the body is
    slack : share by which readings may differ, since the motion is known no better
    """
    compared, faults = Comparison(kind, stretches, imu, gravity), list[Verdict]()
    if not compared.motions:
        return Report(kind, unjudged=[f'{kind}: too few samples'] * (
            any(kind in one.readings for one in stretches)))
    samples, sigma, clear = compared.lag()
    late, sigma = samples * compared.steps, sigma * compared.steps
    if clear and abs(late) > max(LATE, SURE * sigma):
        faults.append(Verdict(
            'late' if late > 0.0 else 'early', f'the readings belong to the motion of '
            f'{abs(late):.3g} steps ({1e3 * abs(late) * compared.own_step:.3g} ms) '
            f'{"before" if late > 0.0 else "after"}', late))
    for last in (False, False, True):
        compared.compare(round(samples) if clear else 0)
        found, residual, rest = Causes(compared, placed, slack).find()
        undone = next((one for one in found if one.undo is not None), None)
        if last or not undone or undone.undo is None:
            break
        faults.append(undone)
        compared.undo(undone.undo)
    faults.extend(found)
    if kind == 'accelerations' and not placed and rest > max(STRANGE, 2.0 * compared.floor):
        return Report(kind, unjudged=[f'{kind}: {100.0 * rest:.3g} % of the reading may be the '
                                      'acceleration of the origin, without positions'])
    marks = {f'{kind}_lag_steps': Mark(late, LATE, _interval(sigma)), **_marks(compared)}
    if kind in DENSITIES and UNCLEAR.isdisjoint(one.name for one in found):
        faults.extend(_noise_faults(compared, residual, getattr(imu, DENSITIES[kind])))
    return Report(kind, [Finding(one.name, f'{kind}: {one.evidence}', one.number)
                         for one in faults], marks, unjudged=[*_untold(compared)])


def _interval(sigma: float) -> str:
    return f'+- {1.96 * sigma:.2g}'


def listed(values: Iterable[float]) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)


class Causes:
    """What may be wrong with readings; `find` finds what is."""

    def __init__(self, compared: Comparison, placed: bool, slack: float) -> None:
        self.compared, self.kind, self.placed = compared, compared.kind, placed
        self.noisy = compared.noisy
        self.arms = [name for name in compared.always if name.startswith('arm')]
        self.least = (OF_STEPS if self.kind == 'rates' else STRANGE) + slack
        self.strange = max(self.least, REAL * self.noisy)

    def find(self) -> tuple[list[Verdict], Reals, float]:
        """Return the faults, what they leave of the discrepancy, and its size beyond noise."""
        compared, always = self.compared, self.compared.always
        residual = compared.fit(always).residual
        doubt = FOUR_SIGMA * SPREAD / math.sqrt(residual.size)
        most = compared.floor * math.sqrt(SAME_POWER + 2.0 * doubt)
        before = beyond(residual, most)
        if unit := [*self._field_unit()]:
            return unit, residual, before
        if before <= self.least:
            return [*self._slow(before)], residual, before
        chosen = identify.explain(
            *identify.compressed(compared.target, compared.effects), [*self._causes()],
            math.hypot(compared.floor, 0.5 * self.least), always)
        while True:
            found, sigma, residual = compared.fit([*always, *(
                name for cause in chosen for name in cause.effects)])
            sure = np.abs(found) > SURE * sigma
            chance = [cause for cause, of in identify.parts(chosen, len(always))
                      if not np.any(sure[of])]
            if not chance:
                break
            chosen.remove(chance[-1])
        told = identify.verdicts(chosen, found, len(always))
        # A cause that is not what it seemed to be explains nothing.
        rest = before if None in told else beyond(residual, most)
        if rest > max(UNEXPLAINED * before, self.strange, 2.0 * compared.floor,
                      (ROUGH + 2.0 * compared.floor) * self.noisy):
            if self.noisy and not self._clear('free'):      # weightless: noise is seen
                return [], residual, rest
            return [Verdict('inaccurate', f'{100.0 * rest:.3g} % of the reading is not that of '
                            'the motion', rest)], residual, rest
        return [one for one in told if one and one.name], residual, rest

    def _slow(self, before: float) -> Iterator[Verdict]:
        """Yield the size of rates, where it alone makes a small discrepancy."""
        if self.kind != 'rates':
            return
        (share, _), _, residual = self.compared.fit(['total', 'step'])
        if abs(share) > STRANGE and rms(residual) < UNEXPLAINED * before:
            yield Verdict('rates_scale', f'the readings are {1.0 + share:.4g} times what they '
                          'should be', 1.0 + share)

    def _causes(self) -> Iterator[Cause]:
        if self.kind == 'accelerations':
            yield from self._causes_of_forces()
        yield Cause(['total'], lambda found: self._matrix((1.0 + found[-1]) * AXES))
        yield Cause(['step'])
        yield Cause(OFFSETS, self._bias)
        for effect, name, text in (
                ('world', 'rates_in_world' if self.compared.angles else 'reading_in_world',
                 'the world, not of the IMU'),
                ('reversed', 'rotation_reversed', 'a sensor that turns against the IMU')):
            yield Cause([*(f'in world {arm}' for arm in self.arms), 'free', effect], instead(
                name, f'the readings are in axes of {text}'))
        # So many columns fit what the origin does, too; of an unknown field they are no product.
        if not self.compared.always or (self.arms and self.placed):
            yield Cause([f'matrix {i}{j} {of}' for of in (*self.arms, 'free') for i, j in ENTRIES],
                        lambda found: self._matrix(AXES + found[-9:].reshape(3, 3)))

    def _causes_of_forces(self) -> Iterator[Cause]:
        for name in TERMS:
            if name in self.compared.effects and (not self.arms or name in (
                    'gravity', 'linear', 'motion')):
                yield Cause([name], partial(self._term, name))
        yield Cause(['difference'], self._difference)
        yield Cause(['gravity', 'fixed gravity'], instead(
            'gravity_frame', 'gravity is along z of the IMU and does not turn with it'))
        arm, judged = ('turned arm', self._split_arm) if self.arms else ('arm', self._arm)
        yield Cause([f'{arm} {k}' for k in range(3)], judged)

    def _clear(self, name: str) -> bool:
        """Return whether an effect is much larger than its noise."""
        return self.kind != 'accelerations' or rms(self.compared.effects[name]) > (
            columns.STILL + columns.CLEARLY * self.compared.noise.get(name, 0.0))

    def _matrix(self, matrix: Reals) -> Verdict | None:
        """Judge a matrix by which the readings are what they should be, multiplied."""
        size = abs(float(np.linalg.det(matrix))) ** (1.0 / 3.0)
        # A unit, or one that is converted twice.
        unit, times = next(((f', in {name}', times) for name, factor in self.compared.units.items()
                            for times in (1.0 / factor, factor)
                            if factor != 1.0 and abs(size / times - 1.0) < OF_UNIT), ('', 1.0))
        shape, change = matrix / times, float(np.max(np.abs(matrix - AXES)))
        axes = np.rint(shape)
        if np.array_equal(axes @ axes.T, AXES) and np.max(np.abs(shape - axes)) < OF_AXES and (
                unit or not np.array_equal(axes, AXES)):
            words = ', '.join(f'{axis} reads {one}' for axis, one in zip(
                'xyz', conventions.axes(axes).split(', '), strict=True))
            name = ('units' if np.array_equal(axes, AXES) else
                    'reading_sign' if np.array_equal(axes, -AXES) else
                    'sign' if np.array_equal(np.abs(axes), AXES) else 'axes')
            return Verdict(name, f'{words}, {size:.4g} times what it should be{unit}', size,
                           times * axes)
        if np.array_equal(matrix, matrix[0, 0] * AXES):
            small = max(self.strange, GRAVITY_BAND * (self.kind == 'accelerations'))
            name = 'rates_scale' if self.kind == 'rates' else 'reading_scale'
            return Verdict(name * (change > small), f'the readings are {matrix[0, 0]:.4g} times '
                           'what they should be', matrix[0, 0]) if size > MISSING else None
        left, _, right = np.linalg.svd(shape)
        turn = left @ right
        if np.linalg.det(turn) > 0.0 and np.max(np.abs(shape - turn)) < max(
                0.02, OF_TURN * change):
            vector = Rotation.from_matrix(turn).inv().as_rotvec()
            angle = float(np.linalg.norm(vector))
            return Verdict('mounting', 'the readings are in axes that are turned by '
                           f'({listed(vector)}) rad from those of the IMU{unit}', angle,
                           times * turn) if angle > self.strange else Verdict('', '')
        if change > SANE and self.compared.always:    # beside an arm it fits what it is not
            return None
        rows = '; '.join(map(listed, matrix))
        return Verdict('matrix' * (change > self.strange), f'the readings are the matrix [{rows}] '
                       'times what they should be', change)

    def _bias(self, found: Reals) -> Verdict | None:
        offset, field = found[-3:], self.compared.field
        if len(found) > 3 and self.kind == 'magnetometer' and np.linalg.norm(
                found[:3] + field) < NEAR * np.linalg.norm(field):
            return None                         # the field does not turn with the IMU
        si = next(iter(self.compared.units))
        # Where w x (w x r) is not known its mean seems to be a bias.
        coarse = self.noisy and self.kind == 'accelerations' and SURE * (
            self.compared.fit(['centripetal', *self.compared.always]).sigma[0]) > TELLS
        return Verdict('bias' * (not coarse), f'a constant ({listed(offset)}) {si} is added',
                       float(np.linalg.norm(offset)))

    def _field_unit(self) -> Iterator[Verdict]:
        """Yield the unit of a field that is not known, if it is not that of the Earth in T."""
        size, (low, high) = float(np.linalg.norm(self.compared.field)), EARTH_FIELD
        if self.kind == 'magnetometer' and self.compared.always and not low < size < high:
            for unit, factor in self.compared.units.items():
                if low < size * factor < high:
                    yield Verdict('units', f'the field is {size:.4g}: it is in {unit}, not in T',
                                  1.0 / factor, AXES / factor)

    def _term(self, term: str, found: Reals) -> Verdict | None:
        share, (what, missing) = 1.0 + float(found[-1]), TERMS[term]
        if term == 'motion' and not self.arms and 'linear' not in self.compared.effects:
            missing = 'no_lever_arm'
        text = f'the term of {what} has {share:.3g} times its size'
        # A term of noise seems to be missing; gravity is in g where the whole reading is.
        if (self.noisy and not self._clear(term)) or (
                term != 'linear' and abs(share * columns.STANDARD_GRAVITY - 1.0) < OF_UNIT):
            return None
        if term == 'gravity' and share > NEAR:
            return Verdict('gravity' * (abs(share - 1.0) > GRAVITY_BAND), text, share)
        for unit, factor in columns.LENGTHS.items() if term == 'linear' else ():
            if factor < 1.0 and abs(share / factor - 1.0) < 0.05:
                return Verdict('units', f'{text}: positions are in {unit}', share)
        if abs(share) < NEAR:
            return None if self.arms and term == 'motion' else Verdict(missing, text, share)
        if share > 0.0:                 # noise that is not white makes it smaller
            return Verdict('acceleration_scale' * (not self.noisy), text, share)
        return Verdict('gravity_sign' if term == 'gravity' else 'reading_sign', text, share)

    def _difference(self, found: Reals) -> Verdict | None:
        delay = -float(found[-1])
        return None if not 0.25 < delay < 0.8 else Verdict(
            'finite_differences', f'the acceleration, without gravity, is that of {delay:.3g} '
            'steps before, as a difference of two velocities', delay)

    def _arm(self, found: Reals) -> Verdict | None:
        arm, point = self.compared.arm, found[-3:] + self.compared.arm
        share = float(point @ arm) / (float(arm @ arm) or 1.0)
        if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * np.linalg.norm(point):
            return self._term('lever', np.array([share - 1.0]))
        return Verdict('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _split_arm(self, found: Reals) -> Verdict | None:
        """Judge by the arms that a x r and w x (w x r) have, where none is given."""
        centripetal = self.compared.arm + found[:3]
        sizes = np.linalg.norm(centripetal), np.linalg.norm(centripetal + found[-3:])
        for (small, large), term in ((sizes, 'centripetal'), (sizes[::-1], 'tangential')):
            if small < NEAR * large:
                return self._term(term, np.array([float(small / large) - 1.0]))
        return None


def _marks(compared: Comparison) -> dict[str, Mark]:
    """Return what the sensor is found to be, with intervals of 95 %."""
    kind, always = compared.kind, compared.always
    marks = {f'{kind}_discrepancy': Mark(beyond(compared.target, compared.floor)),
             f'{kind}_noise': Mark(compared.reading_noise)}

    def add(names: Sequence[str], values: Reals, effects: Sequence[str]) -> None:
        found, sigma, _ = compared.fit(effects)
        marks.update({name: Mark(float(value), meaning=_interval(deviation))
                      for name, value, deviation in zip(
                          names, values + found[:len(values)], sigma, strict=False)
                      if math.isfinite(deviation)})

    what, value = ('field', compared.field) if kind == 'magnetometer' else (
        'lever_arm', compared.arm)
    add([f'{what}_{axis}' for axis in 'xyz'[:len(always)]], value[:len(always)], always)
    if kind in DENSITIES:
        add([f'{kind}_matrix_{"xyz"[i]}{"xyz"[j]}' for i, j in ENTRIES]
            + [f'{kind}_bias_{axis}' for axis in 'xyz'],
            np.append(AXES.ravel(), np.zeros(3)), [*MATRIX, *OFFSETS, *always])
    return marks


def _untold(compared: Comparison) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    # What is not known is the arm, of both terms together.
    terms = [name for name in (('total',) if compared.angles else ('centripetal', 'linear'))
             if name in compared.effects and rms(compared.effects[name]) > 0.0]
    _, sigma, _ = compared.fit([*terms, *compared.always])
    turns, places = (max(one.body.sigma.get(name, 0.0) for one in compared.motions)
                     for name in ('attitudes', 'positions'))
    for name, deviation in zip(terms, sigma.tolist(), strict=False):
        if (worse := SURE * deviation / TELLS) > 1.0:
            yield (f'{compared.kind}: the size of the term {name} is known to '
                   f'+- {196.0 * deviation:.2g} % only' + (
                       f'; poses with noise of {turns / worse:.2g} rad, {places / worse:.2g} m '
                       'would tell' if compared.noisy and worse < math.inf else ''))


def _noise_faults(compared: Comparison, residual: Reals, density: float | None,
                  ) -> Iterator[Verdict]:
    """Compare noise with what is declared."""
    noise = compared.reading_noise
    if not compared.noisy:              # all that is left is noise of the readings
        parts = np.split(residual, np.cumsum(compared.counts)[:-1])
        # Either has fast motion, too: that of the reading, or of what no cause explains.
        noise = min(noise, rms(compared.sizes * [white(part) for part in parts]))
    exists = noise > NOISY * float(np.min(compared.sizes))
    declared = math.nan if density is None else density / math.sqrt(compared.own_step)
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > NOISE_BAND + FOUR_SIGMA * SPREAD / math.sqrt(residual.size):
        yield Verdict('noise_scale', f'the noise has a standard deviation of {noise:.4g}, '
                      f'{ratio:.4g} times what is declared, {declared:.4g}', ratio)
