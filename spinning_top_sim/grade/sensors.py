# SPDX-License-Identifier: Apache-2.0
"""
Compares readings of an IMU with the motion that the same simulator tells.

A reading is fitted with its physical terms: for the accelerometer gravity, a x r and w x (w x r).
The error of the motion does not matter.  What remains is the discrepancy.  Its white noise is
measured by sixth differences, in which motions vanish: `floor` is its rms in all motions together,
and `most` what it may be at most.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.measures import rms
from spinning_top_sim.grade import regression
from spinning_top_sim.grade.motion import Motion
from spinning_top_sim.grade.readings import FORCES, Readings, readings_of
from spinning_top_sim.grade.regression import NEAR, Cause, beyond, fitted, instead, listed, pooled
from spinning_top_sim.grade.scenes import Body, Reals
from spinning_top_sim.tools.verdict import Fault


class Kind(NamedTuple):
    """A kind of readings."""

    units: Sequence[float]          # factors of other units
    strange: float = 2e-3           # discrepancy beyond the noise for which a cause is looked for
    in_world: str = 'reading_in_world'      # faults in axes of the world, of size and of sign
    scale: str = 'reading_scale'
    sign: str = 'reading_sign'
    density: str = ''               # parameter of the body: the density of the noise


_DEGREES, _G = (180.0 / math.pi, math.pi / 180.0), (1.0 / 9.80665,)
# Rates may be those of the middle of a step; velocities are means over a step, compared with those
# of its ends: a larger discrepancy is not strange.
KINDS = {
    'rates': Kind(_DEGREES, 2e-2, 'rates_in_world', 'rates_scale', 'rates_scale'),
    'gyroscope': Kind(_DEGREES, in_world='rates_in_world', density='gyroscope_noise_density'),
    'accelerations': Kind(
        _G, scale='acceleration_scale', density='accelerometer_noise_density'),
    'magnetometer': Kind((1e4, 1e6, 1e9)),
    'rotations': Kind(_DEGREES),
    'velocities': Kind(_G, 5e-2)}
# Discrepancies and noise are relative to the rms of the reading.
_SIXTH = math.comb(12, 6)   # sum of the squares of the coefficients of a sixth difference
# The rms of white noise by n of them has this over sqrt(n) as its relative standard deviation:
# neighbours are correlated by math.comb(12, 6 + k) / _SIXTH.
_SPREAD = math.sqrt(0.5 * math.comb(24, 12)) / _SIXTH
SAME_POWER = 1.05           # of the noise, by which it may be larger besides
LAGS = range(-3, 31)        # lags that are tried [samples]
LATE = 0.75                 # lag from which on it is a fault [steps]
CONSISTENT = 1e-3           # discrepancy below which no lag is looked for
# A turn of the axes leaves at most these shares of the discrepancy, and of what causes leave.
TURNED, TURNED_RATHER = 0.02, 0.1
UNEXPLAINED = 0.5           # share that causes leave where they explain nothing
NOISY = 1e-4                # smaller noise is rounding
NOISE_BAND = 0.05           # share by which noise may differ from what is declared
FOUR_SIGMA = 4.0            # standard deviations by which its measurement may differ besides
LEAST_KURTOSIS = 2.4        # of normal noise; it is 3, and 1.8 of uniform noise


def judge(kind: str, motions: Sequence[Motion]) -> tuple[list[Fault], dict[str, float]]:
    """Return faults and measures of the readings of one of KINDS."""
    runs = [run for motion in motions if (run := readings_of(kind, motion))]
    if not runs:
        return [], {}
    # Velocities are means over a step.
    lag, late = (0, 0.0) if kind == 'velocities' else _lag(runs)
    wrong, effects = zip(*(run.at_lag(lag) for run in runs), strict=True)
    target, sizes = np.concatenate(wrong), np.array([run.size for run in runs])
    noise, floor = np.array([*map(_white, wrong)]), _white(*wrong)
    doubt = FOUR_SIGMA * _SPREAD / math.sqrt(target.size)       # the relative error of the noise
    most = floor * math.sqrt(SAME_POWER + 2.0 * doubt)
    marks = {f'{kind}_lag_steps': late, f'{kind}_noise': float(np.mean(sizes * noise)),
             f'{kind}_discrepancy': beyond(target, most)}
    faults = []
    if abs(late) > LATE:
        faults.append(Fault('imu_one_step_late', 'readings belong to the motion of '
                            f'{abs(late):.3g} steps {"before" if late > 0.0 else "after"}', late))
    found, residual, explained = _find_causes(
        kind, motions, *pooled(zip(wrong, effects, strict=True)), floor, most)
    faults += found
    if explained and KINDS[kind].density and not any(
            fault.name in ('units', 'reading_scale') for fault in faults):
        noises = [size * rest for size, rest in zip(
            sizes, np.split(residual, np.cumsum([*map(len, wrong)])[:-1]), strict=True)]
        # A cause that is found has taken fast motion away, or has left some.
        level = float(np.mean(np.minimum(sizes * noise, [*map(_white, noises)])))
        faults += _noise_faults(kind, motions[0], level, level > NOISY * sizes[0],
                                np.concatenate(noises), NOISE_BAND + doubt)
    return [fault._replace(evidence=f'{kind}: {fault.evidence}') for fault in faults], marks


def _find_causes(kind: str, motions: Sequence[Motion], target: Reals, effects: Mapping[str, Reals],
                 floor: float, most: float) -> tuple[list[Fault], Reals, bool]:
    """Return the causes of a discrepancy, what they leave of it, and whether that is noise."""
    before, strange = beyond(target, most), KINDS[kind].strange
    if motions[0].derived and kind != 'rates':
        # Rates of the attitudes may be half a step apart from those of the simulator.
        firsts = (motion.trajectory.rotation[:2] for motion in motions)
        strange += max(float(0.5 * (a.inv() * b).magnitude()) ** 2 for a, b in firsts)
    if before <= strange:
        return [], target, True
    faults, residual = regression.explain(target, effects, _causes(kind, motions[0].body),
                                          math.hypot(floor, 0.5 * strange))
    mounted, left = _mounted(target, effects['total'])
    if beyond(left, most) < min(TURNED * before, TURNED_RATHER * beyond(residual, most)):
        faults, residual = mounted, left
    rest = beyond(residual, most)
    if explained := rest <= max(UNEXPLAINED * before, strange):
        return faults, residual, explained
    name = 'rates_scale' if kind == 'rates' else 'inconsistent_reading'
    text = f'{100.0 * rest:.3g} % of the reading is not that of the motion'
    return [*faults, Fault(name, text, rest)], residual, explained


def _mounted(target: Reals, total: Reals) -> tuple[list[Fault], Reals]:
    """Return the fault that the axes are not those of the IMU, and what it leaves (m, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')     # vectors along one line allow many turns
        turn, _ = Rotation.align_vectors(target + total, total)
    text = f'the readings are in axes that are turned by ({listed(turn.inv().as_rotvec())}) rad'
    return [Fault('mounting', f'{text} from those of the IMU', turn.magnitude())], (
        target + total - turn.apply(total))


def _noise_faults(kind: str, motion: Motion, noise: float, exists: bool, residual: Reals,
                  band: float) -> Iterator[Fault]:
    """Compare noise with what is declared and with normal noise; `band`: of the ratio to 1."""
    density = getattr(motion.body, KINDS[kind].density)
    covariance = motion.trajectory.covariance.get(kind)
    root = math.sqrt(motion.trajectory.step)
    text = f'the noise has a standard deviation of {noise:.4g}'
    told = math.nan if covariance is None else math.sqrt(abs(np.trace(covariance)) / 3.0)
    if told == 0.0 and exists:
        yield Fault('covariance_zero', f'{text}, its covariance is told as 0', noise)
    declared = (told or math.nan) if density is None else density / root
    ratio = noise / declared if declared else math.inf if exists else 1.0
    if abs(ratio - 1.0) > band:
        factors = {'sqrt(2)': math.sqrt(2.0), '1/sqrt(2)': math.sqrt(0.5), 'sqrt(dt)': root,
                   '1/sqrt(dt)': 1.0 / root}
        as_if = min(factors, key=lambda name: abs(ratio / factors[name] - 1.0))
        named = f' ({as_if})' if abs(ratio / factors[as_if] - 1.0) < band else ''
        yield Fault('noise_scale', f'{text}, {ratio:.4g}{named} times what is declared, '
                    f'{declared:.4g}', ratio)
    if exists and noise > rms(residual) / (1.0 + band):
        kurtosis = float(np.mean(residual ** 4)) / rms(residual) ** 4
        doubt = FOUR_SIGMA * math.sqrt(24.0 / residual.size)
        if kurtosis < min(LEAST_KURTOSIS, 3.0 - doubt):
            yield Fault('uniform_noise', f'the noise has a kurtosis of {kurtosis:.3g}; normal '
                        'noise has 3, uniform noise 1.8', kurtosis)


def _lag(runs: Sequence[Readings]) -> tuple[int, float]:
    """Return by how many samples readings are late, with any size of their terms, and by what."""
    def left(lag: int) -> float:
        target, effects = pooled(run.at_lag(lag, (*run.terms, 'step')) for run in runs)
        return rms(fitted(target, [*effects.values()])[1])

    floor, now, best = _white(*(run.at_lag(0)[0] for run in runs)), left(0), 0
    if now ** 2 >= 1.1 * floor ** 2 + CONSISTENT ** 2:
        most = len(runs[0].effects['total']) // 4
        found = {lag: left(lag) for lag in LAGS if lag < most}
        best = min(found, key=lambda lag: found[lag])
        best = best if found[best] < 0.5 * now else 0
    target, effects = pooled(run.at_lag(best) for run in runs)
    # The acceleration of a step may be that of its begin, without a lag of the reading.
    steps, rest = fitted(target, [effects[name] for name in (
        'step', 'tangential step') if name in effects])
    return best, best - (float(steps[0]) if rms(target) > max(1e-6, 2.0 * rms(rest)) else 0.0)


def _white(*runs: Reals) -> float:
    """Return the standard deviation of white noise, by differences in which motions vanish."""
    return rms(np.concatenate([np.diff(rows, 6, axis=0) for rows in runs])) / math.sqrt(_SIXTH)


def _causes(kind: str, body: Body) -> list[Cause]:
    """Return what may be wrong with the readings of a sensor."""
    text = 'the readings are in axes of '
    causes = [Cause(['total'], partial(_scale, KINDS[kind])), Cause(['step']),
              Cause(['total', 'world'], instead(
                  KINDS[kind].in_world, f'{text}the world, not of the IMU')),
              Cause(['total', 'reversed'], instead(
                  'rotation_reversed', f'{text}a sensor that turns against the IMU'))]
    if kind not in FORCES:
        return causes
    return [*causes, *(Cause([name], partial(_term, name)) for name in _TERMS),
            Cause(['gravity', 'fixed 0', 'fixed 1', 'fixed 2'], partial(_gravity_frame, body)),
            Cause(['difference'], _difference), Cause(['tangential step']), Cause(['axes late']),
            Cause(['arm 0', 'arm 1', 'arm 2'], partial(_arm, body))]


def _scale(kind: Kind, found: Reals) -> Fault:
    factor = 1.0 + float(found[0])
    unit = any(abs(abs(factor) / unit - 1.0) < 0.01 for unit in kind.units)
    return Fault('units' if unit else kind.sign if factor < 0.0 else kind.scale,
                 f'the readings are {factor:.4g} times what they should be', factor)


# Terms of a specific force: what each is, and the fault where it is missing.
_TERMS = {'gravity': ('gravity', 'no_gravity'), 'tangential': ('a x r', 'no_tangential_term'),
          'centripetal': ('w x (w x r)', 'no_centripetal_term'),
          'kinematic': ('motion', 'no_lever_arm')}


def _term(term: str, found: Reals) -> Fault:
    share = 1.0 + float(found[0])
    what, missing = _TERMS[term]
    return Fault(missing if abs(share) < NEAR else 'acceleration_scale' if share > 0.0 else
                 'gravity_sign' if term == 'gravity' else 'reading_sign',
                 f'the term of {what} has {share:.3g} times its size', share)


def _gravity_frame(body: Body, found: Reals) -> Fault | None:
    fixed = float(np.linalg.norm(found[1:]))
    there = abs(found[0] + 1.0) <= NEAR and abs(fixed / body.gravity - 1.0) <= NEAR
    text = f'gravity, {fixed:.4g} m/s^2, does not turn with the IMU'
    return Fault('gravity_frame', text, fixed) if there else None


def _difference(found: Reals) -> Fault | None:
    delay = -float(found[0])
    return None if not 0.25 < delay < 0.8 else Fault(
        'finite_differences', f'the acceleration, without gravity, is that of {delay:.3g} steps '
        'before, as a difference of two velocities', delay)


def _arm(body: Body, found: Reals) -> Fault:
    arm, point = np.array(body.lever_arm), found + body.lever_arm
    size = float(np.linalg.norm(arm))
    share = float(point @ arm) / (size * size or 1.0)
    if share > NEAR and np.linalg.norm(point - share * arm) < 0.1 * share * size:
        return _term('kinematic', np.array([share - 1.0]))
    of = ', the centre of mass' if np.linalg.norm(point - body.com) < 0.1 * max(
        size, abs(body.com_distance)) else ''
    return Fault('no_lever_arm', f'the readings are those at ({listed(point)}) m{of}, not at '
                 f'({listed(arm)}) m', float(np.linalg.norm(found)))
