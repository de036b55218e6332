# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is regressed on the terms of its motion and on effects of defects.  As few causes as
possible explain what a right reading does not, and are named by the sizes of their effects.
"""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import columns
from spinning_top_sim.grade.columns import AXES, DENSITIES, ENTRIES, OF_TURNS, Comparison, Imu
from spinning_top_sim.tools import conventions, identify
from spinning_top_sim.tools.identify import NEAR, NO_FAULT, SURE, Cause, Fit, Model
from spinning_top_sim.tools.kinematics import Reals, Stretch
from spinning_top_sim.tools.report import Finding, Mark, Report

# Terms of a specific force, and the fault where one is missing.
TERMS = {'tangential': 'no_tangential_term', 'centripetal': 'no_centripetal_term',
         'gravity': 'no_gravity', 'linear': 'no_linear_acceleration', 'lever': 'no_lever_arm'}
OFFSETS = 'offset 0', 'offset 1', 'offset 2'
MATRIX = [f'matrix {i}{j} total' for i, j in ENTRIES]
LATE = 0.75                 # lag from which on it is a fault [samples of the sensor]
# Share of a reading from which on a discrepancy is strange: half a step may be between readings
# and attitudes; a real device, where poses have noise, has errors that no simulator needs.
STRANGE, OF_STEPS, REAL = 2e-3, 2e-2, 0.03
UNEXPLAINED = 0.25          # share of a discrepancy, with noise of a reading, left at most
CLEARLY = 10.0              # by which a term must exceed its noise to be missed
# By which a size differs from that of a unit, entries from axes, and from a turn, as a share.
OF_UNIT, OF_AXES, OF_TURN = 0.02, 0.1, 0.3
GRAVITY_BAND = 6e-3         # share by which gravity differs on Earth
EARTH_FIELD = 15e-6, 90e-6  # [T]
NOISE_BAND, OF_CHANCE = 0.05, 5.7   # by which noise may differ from what is declared
ROUNDING = 1e-4             # share of a reading that is no noise
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float) -> Report:
    """Return what is wrong with the readings of a kind."""
    compared = Comparison(kind, stretches, imu, gravity)
    if not compared.motions:
        return Report(kind, unjudged=[f'{kind}: too few samples'] * (
            any(kind in one.readings for one in stretches)))
    samples, sigma, clear = compared.lag()
    late, sigma = samples * compared.steps, sigma * compared.steps
    model = compared.model(round(samples) if clear else 0)
    found, rest = Causes(compared, model).find()
    if math.isnan(late) and found and found[0].name == 'mounting' and (
            model.fit(['step']).beyond < UNEXPLAINED * model.fit([]).beyond):
        return Report(kind, unjudged=[f'{kind}: {found[0].evidence}, or readings are late: this '
                                      'motion does not tell'])
    marks = {f'{kind}_lag_steps': Mark(late, LATE, _interval(sigma)),
             f'{kind}_discrepancy': Mark(model.fit([]).beyond),
             f'{kind}_noise': Mark(compared.reading_noise), **dict(_estimates(kind, model))}
    if kind in DENSITIES and not found:         # beside a fault the noise is not known
        found = [*_noise_faults(compared, model, rest, getattr(imu, DENSITIES[kind]))]
    if clear and abs(late) > max(LATE, SURE * sigma):
        found = [Finding(
            'late' if late > 0.0 else 'early', f'the readings belong to the motion of '
            f'{abs(late):.3g} steps ({1e3 * abs(late) * compared.own_step:.3g} ms) '
            f'{"before" if late > 0.0 else "after"}', late), *found]
    return Report(kind, [one._replace(evidence=f'{kind}: {one.evidence}') for one in found],
                  marks, unjudged=[*_untold(compared, model)])


def _interval(sigma: float) -> str:
    return f'+- {1.96 * sigma:.2g}'


def listed(values: Reals) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)


class Causes:
    """What may be wrong with readings; `find` finds what is."""

    def __init__(self, compared: Comparison, model: Model) -> None:
        self.compared, self.model = compared, model
        self.kind, self.noisy = compared.kind, compared.noisy
        self.arms = [name for name in compared.always if name.startswith('arm')]
        self.strange = max(STRANGE, REAL * self.noisy, OF_STEPS * compared.stepped)

    def find(self) -> tuple[list[Finding], Fit]:
        """Return the faults, and what they leave of the discrepancy."""
        right = self.model.fit([])
        if self.kind == 'magnetometer' and self.compared.always:
            size, (low, high) = float(np.linalg.norm(right.found)), EARTH_FIELD
            for unit, factor in self.compared.units.items():
                if not low < size < high and low < size * factor < high:
                    return [Finding('units', f'the field is {size:.4g}: it is in {unit}, not in '
                                    'T', 1.0 / factor)], right
        if right.beyond <= STRANGE:
            return [], right
        found, rest = identify.explain(self.model, [*self._causes(right.beyond)], 0.5 * STRANGE)
        if rest.beyond > max(UNEXPLAINED * right.beyond, self.strange, 2.0 * rest.noise,
                             (UNEXPLAINED + 2.0 * rest.noise) * self.noisy):
            # Where the terms cannot be seen, as in free fall, noise is.
            return [Finding('inaccurate', f'{100.0 * rest.beyond:.3g} % of the reading is not '
                            'that of the motion', rest.beyond)] * (
                                self.kind != 'accelerations' or self._clear('total')), rest
        return found, rest

    def _causes(self, before: float) -> Iterator[Cause]:
        for name in TERMS if self.kind == 'accelerations' else ():
            if not self.arms or name in ('gravity', 'linear'):
                yield Cause([name], partial(self._term, name))
        yield Cause(['total'], lambda found: self._matrix((1.0 + found[-1]) * AXES))
        yield Cause(['step'])
        if self.kind == 'rates' and before <= self.strange:      # their size is known as well
            return
        if self.kind == 'accelerations':
            yield Cause(['difference'], _difference)
            yield Cause(['gravity', 'fixed gravity'], identify.instead(
                'gravity_frame', 'gravity is along z of the IMU and does not turn with it'))
            arm, judged = ('turned arm', _split_arm) if self.arms else ('arm', self._arm)
            yield Cause([f'{arm} {k}' for k in range(3)], judged)
        yield Cause(OFFSETS, self._bias)
        for effect, name, text in (
                ('world', 'rates_in_world' if self.kind in OF_TURNS else 'reading_in_world',
                 'the world, not of the IMU'),
                ('reversed', 'rotation_reversed', 'a sensor that turns against the IMU')):
            yield Cause([*(f'in world {arm}' for arm in self.arms), 'total', effect],
                        identify.instead(name, f'the readings are in axes of {text}'))
        if self.arms or not self.compared.always:       # of an unknown field it is no product
            yield Cause([f'matrix {i}{j} {of}' for of in (*self.arms, 'total')
                         for i, j in ENTRIES],
                        lambda found: self._matrix(AXES + found[-9:].reshape(3, 3)))

    def _clear(self, name: str) -> bool:
        """Return whether an effect is much larger than its noise."""
        return not self.noisy or self.model.clear(name, CLEARLY)

    def _term(self, term: str, found: Reals) -> Finding | None:
        """Judge the size of a term."""
        share = 1.0 + float(found[-1])
        text = f'the term {term} has {share:.3g} times its size'
        # A term of noise seems to be missing; gravity is in g where the whole reading is.
        if not self._clear(term) or abs(share * columns.STANDARD_GRAVITY - 1.0) < OF_UNIT:
            return None
        if abs(share) < NEAR:
            return Finding(TERMS[term], text, share)
        if share < 0.0:
            return Finding('gravity_sign' if term == 'gravity' else 'reading_sign', text, share)
        if term == 'gravity':
            return Finding('gravity' * (abs(share - 1.0) > GRAVITY_BAND), text, share)
        # Noise that is not white makes it smaller.
        return Finding('acceleration_scale' * (not self.noisy), text, share)

    def _arm(self, found: Reals) -> Finding | None:
        """Judge where the IMU is."""
        arm, point = self.compared.arm, found[-3:] + self.compared.arm
        share = float(point @ arm) / (float(arm @ arm) or 1.0)
        if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * np.linalg.norm(point):
            return self._term('lever', np.array([share - 1.0]))
        return Finding('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _bias(self, found: Reals) -> Finding | None:
        offset = found[-3:]
        if self.kind == 'magnetometer' and self.compared.always and (
                np.linalg.norm(found[:3]) < NEAR * np.linalg.norm(offset)):
            return None                         # the field does not turn with the IMU
        # Where w x (w x r) is not known its mean seems to be a bias.
        coarse = self.noisy and self.kind == 'accelerations' and SURE * (
            self.model.fit(['centripetal']).sigma[-1]) > TELLS
        return NO_FAULT if coarse else Finding(
            'bias', f'a constant ({listed(offset)}) {next(iter(self.compared.units))} is added',
            float(np.linalg.norm(offset)))

    def _matrix(self, matrix: Reals) -> Finding | None:
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
            return Finding('units' if np.array_equal(axes, AXES) else
                           'reading_sign' if np.array_equal(axes, -AXES) else
                           'sign' if np.array_equal(np.abs(axes), AXES) else 'axes',
                           f'{words}, {size:.4g} times what it should be{unit}', size)
        if np.array_equal(matrix, matrix[0, 0] * AXES):
            name, small = ('rates_scale', STRANGE) if self.kind == 'rates' else (
                'reading_scale', max(self.strange, GRAVITY_BAND * (self.kind == 'accelerations')))
            return Finding(name * (change > small), f'the readings are {matrix[0, 0]:.4g} times '
                           'what they should be', matrix[0, 0])
        left, _, right = np.linalg.svd(shape)
        turn = left @ right
        if np.linalg.det(turn) > 0.0 and np.max(np.abs(shape - turn)) < max(
                OF_UNIT, OF_TURN * change):
            vector = Rotation.from_matrix(turn).inv().as_rotvec()
            angle = float(np.linalg.norm(vector))
            return Finding('mounting' * (angle > self.strange), 'the readings are in axes that '
                           f'are turned by ({listed(vector)}) rad from those of the IMU{unit}',
                           angle)
        return None


def _difference(found: Reals) -> Finding | None:
    delay = -float(found[-1])
    return Finding('finite_differences', 'the acceleration, without gravity, is that of '
                   f'{delay:.3g} steps before, as a difference of two velocities',
                   delay) if 0.25 < delay < 0.8 else None


def _split_arm(found: Reals) -> Finding | None:
    """Judge by the arms that a x r and w x (w x r) have, where none is given."""
    sizes = np.linalg.norm(found[:3] + found[-3:]), np.linalg.norm(found[:3])
    shares = (sizes / np.max(sizes)).tolist()
    return next((Finding(TERMS[term], f'the term {term} has {share:.3g} times its size', share)
                 for term, share in zip(TERMS, shares, strict=False) if share < NEAR), None)


def _estimates(kind: str, model: Model) -> Iterator[tuple[str, Mark]]:
    """Yield what the sensor is found to be, with intervals of 95 %."""
    def told(names: Sequence[str], right: Reals, effects: Sequence[str]) -> Iterator[Any]:
        fit, own = model.fit(effects), slice(-len(names), None)
        for name, value, sigma in zip(names, right + fit.found[own], fit.sigma[own], strict=True):
            if math.isfinite(sigma):
                yield name, Mark(float(value), meaning=_interval(sigma))

    if model.always:
        what = 'field' if kind == 'magnetometer' else 'lever_arm'
        yield from told([f'{what}_{axis}' for axis in 'xyz'], np.zeros(3), [])
    if kind in DENSITIES:
        yield from told([*(f'{kind}_matrix_{"xyz"[i]}{"xyz"[j]}' for i, j in ENTRIES),
                         *(f'{kind}_bias_{axis}' for axis in 'xyz')],
                        np.append(AXES, np.zeros(3)), [*MATRIX, *OFFSETS])


def _untold(compared: Comparison, model: Model) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    turns, places = (max(one.body.sigma.get(name, 0.0) for one, _ in compared.motions)
                     for name in ('attitudes', 'positions'))
    for name in {'accelerations': ('centripetal', 'linear'), 'magnetometer': ()}.get(
            compared.kind, ('total',)):
        sigma = float(model.fit([name]).sigma[-1])
        if (worse := SURE * sigma / TELLS) > 1.0 and model.clear(name, 1.5):
            yield (f'{compared.kind}: the size of the term {name} is known to '
                   f'+- {196.0 * sigma:.2g} % only' + (
                       f'; poses with noise of {turns / worse:.2g} rad, {places / worse:.2g} m '
                       'would tell' if compared.noisy and worse < math.inf else ''))


def _noise_faults(compared: Comparison, model: Model, rest: Fit,
                  density: float | None) -> Iterator[Finding]:
    """Compare noise with what is declared."""
    # Without noise of poses, all that is left is that of readings, or a fast motion.
    noise = compared.reading_noise if compared.noisy else min(
        compared.reading_noise, rest.rest / (math.sqrt(3.0) * model.size(OFFSETS[0])))
    exists = noise > ROUNDING * float(np.min(compared.sizes))
    declared = math.nan if density is None else density / math.sqrt(compared.own_step)
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > NOISE_BAND + OF_CHANCE / math.sqrt(model.count):
        yield Finding('noise_scale', f'the noise has a standard deviation of {noise:.4g}, '
                      f'{ratio:.4g} times what is declared, {declared:.4g}', ratio)
