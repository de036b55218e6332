# SPDX-License-Identifier: Apache-2.0
"""
Names faults of a filter from their signatures, each with its evidence.

A misreading that stays the same is found by undoing it: the attitudes, or the readings, are
changed as the fault would have it, and the error vanishes.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures
from spinning_top_sim.exam.measures import Reals, errors_of, rms
from spinning_top_sim.exam.trial import Input, Outcome, Output, same

FAULTS = ('first_order_integration', 'gyroscope_units', 'conjugated', 'component_order',
          'frame_ned', 'gravity_sign', 'lever_arm', 'stamp_offset', 'no_bias_estimate',
          'covariance_small', 'covariance_large', 'diverges', 'invalid_output')

# The thresholds; docs/exam.md says how far from them filters are.  Errors [rad].
GROSS = np.radians(3.0)         # of a filter that may misread something
DIVERGED = np.radians(10.0)
EXPLAINED = 0.25                # of the error is left where its cause is undone
FIRST_ORDER = np.radians(0.2)   # on the fast motion
FIRST_ORDER_LEFT = 0.5          # of that error, with rates for which such steps are right
LEVER_ARM = np.radians(1.0)     # between the attitudes with and without the lever arm
AHEAD, DELAYED = -1.5, 0.75     # steps: a filter that corrects before its step is ahead by one
BIAS_LEFT_S = 0.05              # error for the bias that causes it [rad/(rad/s)]
BIAS_REMAINS = 0.9              # of that error, between the second and the last quarter
BIAS_FOUND = 0.05               # of the bias, by the estimate
CONSISTENT = 0.9999             # probability of the band of the NEES


class Fault(NamedTuple):
    """
    What is wrong with a filter.

    Parameters
    ----------
    name : str
        One of FAULTS.
    evidence : str
        From what it follows.
    """

    name: str
    evidence: str


class Hypothesis(NamedTuple):
    """
    A misreading, in words, and how to undo it.

    given : what the filter must get for its readings; None: them
    read : what its attitudes are then
    """

    faults: tuple[str, ...]
    text: str
    given: Input | None = None
    read: Output = same


def _turned(left: Sequence[float], right: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Output:
    """Return what turns an attitude on both sides, by quaternions x, y, z, w."""
    def read(estimates: Reals) -> Reals:
        turned: Reals = (Rotation.from_quat(left) * Rotation.from_quat(estimates)
                         * Rotation.from_quat(right)).as_quat()
        return turned
    return read


def conjugate(estimates: Reals) -> Reals:
    """Return the inverse attitudes."""
    return estimates * (-1.0, -1.0, -1.0, 1.0)


def w_last(estimates: Reals) -> Reals:
    """Return x, y, z, w of w, x, y, z."""
    return np.roll(estimates, -1, axis=-1)


def _scaled(factor: float) -> Input:
    return lambda gyroscope, accelerometer, dt: (factor * gyroscope, accelerometer)


def for_first_order(gyroscope: Reals, accelerometer: Reals, dt: Reals) -> tuple[Reals, Reals]:
    """
    Return the rates for which a step q + q w dt/2, normalised, is right.

    Such a step turns by 2 atan(|w| dt/2), less than |w| dt by |w dt|^3/12.
    """
    half = 0.5 * dt * np.linalg.norm(gyroscope, axis=1)
    longer = np.tan(np.minimum(half, 1.5)) / np.where(half > 0.0, half, 1.0)
    return gyroscope * np.where(half > 0.0, longer, 1.0)[:, np.newaxis], accelerometer


_HALF = 0.5 ** 0.5
NED_WORLD = Hypothesis(('frame_ned',), 'read as attitude in a world north-east-down',
                       read=_turned((_HALF, _HALF, 0.0, 0.0)))
GRAVITY_SIGN = Hypothesis(
    ('gravity_sign',), 'with the sign of the accelerometer changed',
    given=lambda gyroscope, accelerometer, dt: (gyroscope, -accelerometer))
# What can be found from attitudes alone comes first.
READINGS = (
    Hypothesis(('component_order',), 'read as w, x, y, z', read=w_last),
    Hypothesis(('conjugated',), 'conjugated', read=conjugate),
    NED_WORLD,
    Hypothesis(('frame_ned',), 'read as attitude of axes forward-right-down in a world '
               'north-east-down', read=_turned((_HALF, _HALF, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),
    Hypothesis(('frame_ned',), 'read as attitude in a world north-west-up',
               read=_turned((0.0, 0.0, _HALF, _HALF))),
    Hypothesis(('conjugated', 'component_order'), 'read as w, x, y, z and conjugated',
               read=lambda estimates: conjugate(w_last(estimates))))
# What harms a filter least comes first.
REPEATED = (
    GRAVITY_SIGN,
    Hypothesis(('gyroscope_units',), 'with the gyroscope multiplied by pi/180',
               given=_scaled(np.pi / 180.0)),
    Hypothesis(('gyroscope_units',), 'with the gyroscope in deg/s', given=_scaled(180.0 / np.pi)))


def marks(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, float]:
    """Return what docs/exam.md defines of the errors of filters, over several runs."""
    settled = [outcome.last() for outcome in outcomes]
    errors = [outcome.errors for outcome in settled]
    return {
        'tilt_rms_deg': math.degrees(rms(np.concatenate([one.tilt for one in errors]))),
        'tilt_max_deg': math.degrees(max(float(np.max(one.tilt)) for one in errors)),
        'heading_rms_deg': math.degrees(rms(np.concatenate(
            [one.turned(absolute) for one in errors]))),
        'convergence_s': max(measures.convergence_time(outcome.run.t, outcome.errors.tilt)
                             for outcome in outcomes),
        'heading_drift_deg_per_s': math.degrees(float(np.mean([
            abs(measures.drift(outcome.run.t, one.heading))
            for outcome, one in zip(settled, errors, strict=True)])))}


def error_of(outcome: Outcome, absolute: bool) -> float:
    """Return the rms attitude error [rad]."""
    return rms(outcome.errors.attitude(absolute))


def explain(outcome: Outcome, absolute: bool,
            again: Callable[[Hypothesis], Outcome] | None) -> Hypothesis | None:
    """
    Return the misreading that makes the error of a settled filter vanish, if there is one.

    absolute : whether the heading counts
    again : repeats the run for a hypothesis; None where that cannot be done
    """
    before = error_of(outcome, absolute)
    if before < GROSS:
        return None
    tried = [(rms(errors_of(one.read(outcome.estimates), outcome.run.truth).attitude(absolute)),
              one) for one in READINGS]
    if again is not None:
        for one in REPEATED:
            if min(error for error, _ in tried) <= EXPLAINED * before:
                break
            tried.append((error_of(again(one), absolute), one))
    after, best = min(tried, key=lambda pair: pair[0])
    if after > EXPLAINED * before:
        return None
    text = f'{best.text}, the error falls from {_degrees(before)} to {_degrees(after)}'
    if not absolute and best in (NED_WORLD, GRAVITY_SIGN):
        best = best._replace(faults=('frame_ned', 'gravity_sign'))
        text += '; the two cannot be told apart without a heading'
    return best._replace(text=text)


def stamp_fault(outcome: Outcome, absolute: bool) -> tuple[measures.Offset, Fault | None]:
    """Look for an error of a settled filter that is a delay."""
    run = outcome.run
    offset = measures.time_offset(outcome.estimates, run.truth, run.rates, absolute)
    steps = offset.seconds / float(np.median(run.dt))
    if AHEAD <= steps <= DELAYED or offset.after > EXPLAINED * offset.before:
        return offset, None
    side = 'behind' if steps > 0.0 else 'ahead of'
    return offset, Fault(
        'stamp_offset', f'the attitude is {abs(1e3 * offset.seconds):.3g} ms {side} its stamp: '
        f'shifted by that, the error falls from {_degrees(offset.before)} to '
        f'{_degrees(offset.after)}')


def first_order_fault(before: float, after: float, rate: float) -> Fault | None:
    """Judge errors on the fast motion [rad], as it is and for what a first-order step leaves."""
    if before < FIRST_ORDER or after > FIRST_ORDER_LEFT * before:
        return None
    return Fault('first_order_integration',
                 f'at {rate:g} Hz, with rates tan(|w| dt/2)/(|w| dt/2) times as large, the error '
                 f'falls from {_degrees(before)} to {_degrees(after)}')


def lever_arm_fault(effect: float, arm: float) -> Fault | None:
    """Judge the attitude error that a lever arm [m] adds [rad]."""
    if effect < LEVER_ARM:
        return None
    return Fault('lever_arm', f'on a lever arm of {arm:g} m the attitude differs by '
                 f'{_degrees(effect)} from that without: its acceleration is taken for gravity')


class BiasEffect(NamedTuple):
    """
    What a constant bias of the gyroscope does.

    early, late : attitude error for the bias, in the second and the last quarter [s]
    found : share of the bias in the filter's estimate at the end; None without one
    """

    early: float
    late: float
    found: float | None


def bias_effect(plus: Outcome, minus: Outcome, bias: Reals, absolute: bool) -> BiasEffect:
    """Compare runs with this bias [rad/s] and its opposite; errors of other causes cancel."""
    size = float(np.linalg.norm(bias))
    one, other = (Rotation.from_quat(outcome.estimates) for outcome in (plus, minus))
    if absolute:
        apart = (one * other.inv()).magnitude()
    else:
        verticals = [turn.inv().apply((0.0, 0.0, 1.0)) for turn in (one, other)]
        apart = np.linalg.norm(verticals[0] - verticals[1], axis=1)
    quarter = len(apart) // 4
    found = None
    if len(plus.biases.values) and len(minus.biases.values):
        change = 0.5 * (plus.biases.values[-1] - minus.biases.values[-1])
        found = float(change @ bias / size ** 2)
    return BiasEffect(rms(apart[quarter:2 * quarter]) / (2.0 * size),
                      rms(apart[-quarter:]) / (2.0 * size), found)


def bias_fault(effect: BiasEffect, absolute: bool) -> Fault | None:
    """Judge what a bias does to tilt, and to the heading where there is a magnetometer."""
    estimated = (effect.late < BIAS_REMAINS * effect.early if effect.found is None else
                 effect.found > BIAS_FOUND)
    if estimated or effect.late < BIAS_LEFT_S:
        return None
    what = 'attitude' if absolute else 'tilt'
    text = (f'a bias of the gyroscope of 1 deg/s leaves an error of the {what} of '
            f'{effect.late:.3g} deg, after {effect.early:.3g} deg earlier')
    if effect.found is not None:
        text += f', and the estimate has {effect.found:.1%} of the bias'
    return Fault('no_bias_estimate', text)


def consistency(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, measures.Nees]:
    """Return the NEES of tilt and attitude by name, as far as there are covariances."""
    runs = [(one.estimates[samples], one.run.truth[samples], covariances)
            for one in (outcome.last(0.75) for outcome in outcomes)
            for samples, covariances in (one.covariances,) if len(samples)]
    if not runs:
        return {}
    found = {what: measures.nees_of(runs, whole)
             for what, whole in (('tilt', False), ('attitude', True))[:1 + absolute]}
    return {what: nees for what, nees in found.items() if nees is not None}


def nees_marks(found: Mapping[str, measures.Nees]) -> dict[str, float]:
    """Return the measures of what `consistency` returns."""
    marked: dict[str, float] = {}
    for what, nees in found.items():
        name = 'nees' if what == 'tilt' else 'nees_attitude'
        low, high = nees.band()
        marked |= {name: nees.ratio, f'{name}_low': low, f'{name}_high': high}
    return marked


def covariance_fault(found: Mapping[str, measures.Nees]) -> Fault | None:
    """Judge what `consistency` returns."""
    for what, nees in found.items():
        low, high = nees.band(CONSISTENT)
        if not low <= nees.ratio <= high:
            name = 'covariance_small' if nees.ratio > high else 'covariance_large'
            return Fault(name, f'the squared error of the {what} is {nees.ratio:.3g} times what '
                         f'the covariance says; consistent are {low:.3g} to {high:.3g}, for '
                         f'{nees.degrees:.0f} degrees of freedom')
    return None


def divergence(outcome: Outcome, absolute: bool) -> Fault | None:
    """Judge the error at the end."""
    last = outcome.last(0.25)
    error = error_of(last, True) if absolute else rms(last.errors.tilt)
    if error < DIVERGED:
        return None
    return Fault('diverges', f'{last.run.name}: the error in the last quarter is '
                 f'{_degrees(error)}, for no reason that is known')


def one_of_each(faults: Sequence[Fault]) -> Iterator[Fault]:
    """Yield the first fault of each name, in the order of FAULTS."""
    by_name = {fault.name: fault for fault in reversed(faults)}
    yield from (by_name[name] for name in FAULTS if name in by_name)


def _degrees(angle: float) -> str:
    return f'{np.degrees(angle):.3g} deg'
