# SPDX-License-Identifier: Apache-2.0
"""
Compares readings with the motion of the same simulator or recording, and names what is wrong.

A reading is regressed on the terms of its motion and on effects of defects.
"""

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.columns import AXES, DENSITIES, ENTRIES, OF_TURNS, Comparison, Imu
from spinning_top_sim.tools import identify
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
LIKE = 0.1                  # share by which a size may differ from that of a unit
CLEARLY = 10.0              # by which a term must exceed its noise to be missed
OF_TURN = 0.3               # share of a change by which a matrix may be no turn
# Share by which gravity differs on Earth, and that of it which a small world still has.
GRAVITY_BAND, ELSEWHERE = 6e-3, 0.05
EARTH_FIELD = 15e-6, 90e-6  # [T]
NOISE_BAND, OF_CHANCE = 0.05, 5.7   # by which noise may differ from what is declared
ROUNDING = 1e-4             # share of a reading that is no noise
SEEN = 1.5                  # by which a term must exceed its noise to be judged
TELLS = 0.5                 # uncertainty of a share of a term up to which its fault can be told


def judge(kind: str, stretches: Sequence[Stretch], imu: Imu, gravity: float) -> Report:
    """Return what is wrong with the readings of a kind."""
    compared = Comparison(kind, stretches, imu, gravity)
    if not compared.motions:
        return Report(kind, unjudged=[f'{kind}: too few samples'] * (
            any(kind in one.readings for one in stretches)))
    shift = compared.lag()
    model, found, rest = _explained(compared, shift)
    if (found or rest.beyond > STRANGE) and (other := compared.exchanged(shift)).told:
        another, others, left = _explained(other, shift)
        if ((cost(others) < cost(found) and left.beyond < rest.beyond + REAL)
                or left.beyond + STRANGE < UNEXPLAINED * rest.beyond):
            compared, model, found, rest = other, another, others, left
    right, alone = model.fit([]), model.fit(['step'])
    either = len(found) == 1 and alone.beyond < UNEXPLAINED * right.beyond  # it may be a lag, too
    late, sigma, unjudged = math.nan, math.inf, [*_untold(compared, model)]
    # The lag alone and, unless that is none, beside any matrix, bias and a x r.
    whatever = model.fit(['step', *MATRIX, *OFFSETS, *(k for k in model.names if 'turned' in k)])
    for fit in [alone] if either else [whatever] if found else [alone, whatever]:
        if not abs(late) + 1.96 * sigma <= LATE:
            late, sigma = (compared.steps * float(one[len(model.always)])
                           for one in (shift - fit.found, fit.sigma))
    name = 'early' if late < 0.0 else 'late'
    text = (f'the readings are {abs(late):.3g} {_interval(sigma)} steps of '
            f'{1e3 * compared.own_step:.3g} ms {name}')
    # `step` tells lags near `shift`, beside another fault only those that noise hides from `lag`.
    near = abs(late / compared.steps - shift) < 1.5
    is_late = abs(late) > max(LATE + 1.96 * sigma, SURE * sigma) and (
        near if shift or (found and compared.noisy and not either) else not found)
    if not is_late and not abs(late) + 1.96 * sigma <= LATE and (either or not found):
        or_else = found[0].evidence if found else 'there is no fault'
        unjudged, found = [f'{kind}: {or_else}, or {text}: this motion does not tell'
                           f'{_needed(compared, SURE * sigma)}', *unjudged], []
    unit = next(iter(compared.units))
    marks = {f'{kind}_lag_steps': Mark(late, LATE, _interval(sigma)),
             f'{kind}_noise': Mark(compared.reading_noise, meaning=unit),
             **dict(_estimates(kind, model, unit))}
    if kind in DENSITIES and not found:         # beside a fault the noise is not known
        found = [*_noise_faults(compared, model, rest, getattr(imu, DENSITIES[kind]))]
    found = [Finding(name, text, late)] * is_late + found
    return Report(kind, [one._replace(evidence=f'{kind}: {one.evidence}') for one in found],
                  marks, unjudged=unjudged)


def cost(found: Sequence[Finding]) -> int:
    """Return how unlikely faults are: the more, the less explained, the more free numbers."""
    free = 'bias', 'gravity', 'mounting', 'rates_scale', 'reading_scale', *TERMS.values()
    return sum(6 if one.name == 'inaccurate' else 2 + (one.name in free) for one in found)


def _explained(compared: Comparison, lag: int) -> tuple[Model, list[Finding], Fit]:
    """Return the model of readings that are late, the faults that explain them, what is left."""
    if compared.arms:
        compared.arm = compared.model(lag).fit([]).found
    model = compared.model(lag)
    if compared.kind == 'accelerations':
        right, local = model.fit([]), model.fit(['gravity'])
        if abs(local.found[-1]) < GRAVITY_BAND and local.beyond < UNEXPLAINED * right.beyond:
            compared.gravity *= 1.0 + float(local.found[-1])    # of another place on Earth
            model = compared.model(lag)
    found, rest = Causes(compared, model).find()
    return model, [*compared.told, *found], rest


def _interval(sigma: float, unit: str = '') -> str:
    return f'+- {1.96 * sigma:.2g} {unit}'.rstrip()


def listed(values: Reals) -> str:
    """Return numbers for a reader."""
    return ', '.join(f'{value:.4g}' for value in values)


class Causes:
    """What may be wrong with readings; `find` finds what is."""

    def __init__(self, compared: Comparison, model: Model) -> None:
        self.compared, self.model = compared, model
        self.kind, self.noisy, self.arms = compared.kind, compared.noisy, compared.arms
        self.strange = max(STRANGE, REAL * self.noisy, OF_STEPS * compared.stepped)

    def find(self) -> tuple[list[Finding], Fit]:
        """Return the faults, and what they leave of the discrepancy."""
        right = self.model.fit([])
        if self.kind == 'magnetometer' and self.compared.always:
            size, (low, high) = float(np.linalg.norm(right.found)), EARTH_FIELD
            # Magnets and iron make no field that is still so large, or so small.
            if not 0.1 * low < size < 10.0 * high:
                unit = next((name for name, factor in self.compared.units.items()
                             if low < factor * size < high), '')
                return [Finding('units' if unit else 'reading_scale', f'the field is {size:.4g}, '
                                f'as if in {unit or "no unit"}, of the Earth {low:g} to {high:g}',
                                size)], right
        if right.beyond <= STRANGE:     # of each sample: a mean is known better
            bias = self.model.fit(['step', *OFFSETS])
            size = float(np.linalg.norm(bias.found[-3:])) * self.model.size(OFFSETS[0])
            sure = size > STRANGE and np.any((np.abs(bias.found) > SURE * bias.sigma)[-3:])
            return [*filter(None, [self._bias(bias.found) if sure else None])], right
        found, rest = identify.explain(self.model, [*self._causes()], 0.5 * STRANGE)
        # Several causes explain anything of which little shows.
        vague = self.arms and not self.model.clear('total', SEEN)
        rest = right if vague and len(self.compared.told + found) > 1 else rest
        if rest.beyond > max(UNEXPLAINED * right.beyond, self.strange,
                             UNEXPLAINED * self.noisy + 2.0 * rest.noise):
            found = [Finding('inaccurate', f'{100.0 * rest.beyond:.3g} % of the reading is not '
                             'that of the motion', rest.beyond)]
        return found, rest

    def _causes(self) -> Iterator[Cause]:
        for name in TERMS if self.kind == 'accelerations' else ():
            if not self.arms or name in ('gravity', 'linear'):
                yield Cause([name], partial(self._term, name))
        if not self.compared.told:      # a unit that is exchanged is a scale
            yield Cause(['total'], lambda found: self._matrix((1.0 + found[-1]) * AXES))
        yield Cause(['step'])
        if self.kind == 'accelerations':
            yield Cause(['difference'], lambda found: Finding(
                'finite_differences', 'the acceleration, without gravity, is a difference of '
                f'velocities {-found[-1]:.3g} steps ago', -found[-1]) if (
                    0.25 < -found[-1] < 0.8) else None)
            arm, judged = ('turned arm', self._split_arm) if self.arms else ('arm', self._arm)
            yield Cause([f'{arm} {k}' for k in range(3)], judged)
        yield Cause(OFFSETS, self._bias)
        arms = [f'in world {arm}' for arm in self.arms]
        for effects, name, text in (
                (['gravity', 'fixed gravity'], 'gravity_frame', 'gravity is along z of the IMU'),
                ([*arms, 'total', 'world'], 'rates_in_world' if self.kind in OF_TURNS else
                 'reading_in_world', 'the readings are in axes of the world'),
                ([*arms, 'total', 'reversed'], 'rotation_reversed', 'the IMU turns backwards')):
            if effects[-1] in self.model.names:
                yield Cause(effects, identify.instead(name, text))
        yield Cause(self.compared.matrix, lambda found: self._matrix(
            AXES + found[-9:].reshape(3, 3)))

    def _term(self, term: str, found: Reals) -> Finding | None:
        """Judge the size of a term."""
        share = 1.0 + float(found[-1])
        text = f'the term {term} has {share:z.4f} times its size'
        if not self.model.clear(term, CLEARLY):     # a term of noise seems to be missing
            return None
        if abs(share) < NEAR and not (term == 'gravity' and share > ELSEWHERE):
            millimetres = term == 'linear' and abs(1e3 * share - 1.0) < LIKE
            return Finding(TERMS[term], text + ', as of positions in mm' * millimetres, share)
        if share < 0.0:
            return Finding('gravity_sign' if term == 'gravity' else 'reading_sign', text, share)
        if term == 'gravity':
            clear = self.model.clear('total', CLEARLY)
            return Finding('gravity' * (clear and abs(share - 1.0) > GRAVITY_BAND), text, share)
        # Noise that is not white makes it smaller.
        return Finding('acceleration_scale' * (not self.noisy), text, share)

    def _arm(self, found: Reals) -> Finding | None:
        """Judge where the IMU is."""
        arm, point = self.compared.arm, found[-3:] + self.compared.arm
        share = float(point @ arm) / (float(arm @ arm) or 1.0)
        if share > NEAR and np.linalg.norm(point - share * arm) < LIKE * np.linalg.norm(point):
            return self._term('lever', np.array([share - 1.0]))
        return Finding('no_lever_arm', f'the readings are those at ({listed(point)}) m, not at '
                       f'({listed(arm)}) m', float(np.linalg.norm(found[-3:])))

    def _split_arm(self, found: Reals) -> Finding | None:
        """Judge by the arms that a x r and w x (w x r) have, where none is given."""
        seen = [self.model.size(name) for name in self.arms]
        sizes = {'tangential': float(np.linalg.norm(seen * (found[:3] + found[-3:]))),
                 'centripetal': float(np.linalg.norm(seen * found[:3]))}
        term = min(sizes, key=lambda one: sizes[one])
        share = sizes[term] / max(sizes.values())
        return Finding(TERMS[term], f'the term {term} has {share:.4f} times its size',
                       share) if share < NEAR else None

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
        change = float(np.max(np.abs(matrix - AXES)))
        if np.linalg.det(matrix) <= STRANGE ** 3:   # they are something else
            return None
        if np.array_equal(matrix, matrix[0, 0] * AXES):
            name, small = ('rates_scale', STRANGE) if self.kind == 'rates' else (
                'reading_scale', max(self.strange, GRAVITY_BAND * (self.kind == 'accelerations')))
            return Finding(name * (change > small), f'the readings are {matrix[0, 0]:.4g} times '
                           'what they should be', matrix[0, 0])
        turn = Rotation.from_matrix(matrix)
        angle, near = float(turn.magnitude()), max(REAL, OF_TURN * change)
        return Finding('mounting', 'the axes of the readings are turned by '
                       f'({listed(turn.inv().as_rotvec())}) rad from those given', angle) if (
            angle > self.strange and np.max(np.abs(matrix - turn.as_matrix())) < near) else None


def _estimates(kind: str, model: Model, unit: str) -> Iterator[tuple[str, Mark]]:
    """Yield what the sensor is found to be, with intervals of 95 %."""
    what = 'field' if kind == 'magnetometer' else 'lever_arm'
    matrix = [f'{kind}_matrix_{"xyz"[i]}{"xyz"[j]}' for i, j in ENTRIES]
    for effects, names, right in (
            ([], [f'{what}_{axis}' for axis in 'xyz'] * bool(model.always), np.zeros(3)),
            ([*MATRIX, *OFFSETS], [*matrix, *(f'{kind}_bias_{axis}' for axis in 'xyz')] * (
                kind in DENSITIES and model.clear('total', SEEN)), np.append(AXES, np.zeros(3)))):
        fit = model.fit(effects)
        for name, value, sigma, base in zip(
                names, fit.found[-len(right):], fit.sigma[-len(right):], right, strict=False):
            if math.isfinite(sigma):
                of = 'm' if 'arm' in name else unit if 'matrix' not in name else ''
                yield name, Mark(float(base + value), meaning=_interval(sigma, of))


def _untold(compared: Comparison, model: Model) -> Iterator[str]:
    """Yield what cannot be told of the readings, and the poses that could tell it."""
    for name in {'accelerations': ('centripetal', 'linear', 'total'), 'magnetometer': ()}.get(
            compared.kind, ('total',)):
        seen = model.clear(name, SEEN)
        sigma = float(model.fit([name]).sigma[-1]) if seen else math.inf
        if SURE * sigma > TELLS and (seen or name == 'total'):
            also = ', and of a bias,' if name == 'centripetal' and compared.noisy else ''
            what = 'reading' if name == 'total' else f'term {name}'
            yield (f'{compared.kind}: the size of the {what}{also} ' + (
                f'is known to +- {196.0 * sigma:.2g} % only' if seen else 'does not show here')
                   + _needed(compared, SURE * sigma / TELLS))


def _needed(compared: Comparison, worse: float) -> str:
    """Return the noise of poses, less by a factor, that would tell."""
    turns, places = (max(one.body.sigma.get(name, 0.0) for one, _ in compared.motions) / worse
                     for name in ('attitudes', 'positions'))
    return (f'; poses with noise of {turns:.2g} rad, {places:.2g} m would tell'
            if compared.noisy and 1.0 < worse < math.inf else '')


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
