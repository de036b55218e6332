# SPDX-License-Identifier: Apache-2.0
"""Judges the attitudes of a run: measures, limits, and the faults that the errors show."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.reference import from_two_vectors
from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.trial import Outcome
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.verdict import Fault

FAULTS = ('first_order_integration', 'gyroscope_units', 'conjugated', 'component_order',
          'frame_ned', 'gravity_sign', 'gyroscope_wiring', 'accelerometer_wiring',
          'magnetometer_wiring', 'time_step', 'heading_offset', 'hard_iron', 'lag', 'lever_arm',
          'stamp_offset', 'no_bias_estimate', 'bias_report', 'covariance_small',
          'covariance_large', 'inaccurate', 'diverges', 'invalid_output')

# Thresholds; docs/exam.md says what they are for.  Errors are in rad.
TILT, HEADING = np.radians((0.3, 0.8)).tolist()         # rms of a right filter, no noise
DIVERGED, GROWS = np.radians(10.0), 1.2     # rms; factor from one quarter to the next
EXPLAINED = 0.25                # of the error is left at most when its cause is undone
FIRST_ORDER, FAST = np.radians((0.2, 1.0)).tolist()     # on the fast motion, no noise
FIRST_ORDER_LEFT = 0.5          # of that error, with rates for which first-order steps are right
LEVER_ARM = np.radians(1.5)     # between the attitudes with and without the lever arm
AHEAD, DELAYED = -1.5, 0.75     # steps; a filter that corrects before its step is ahead by one
BIAS_LEFT_S = 0.05              # error relative to the bias that causes it [rad/(rad/s)]


def error_measures(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, float]:
    """Return the measures of the errors in several runs, as defined in docs/exam.md."""
    settled = [outcome.last() for outcome in outcomes]
    errors = [outcome.errors for outcome in settled]
    return {
        'tilt_rms_deg': math.degrees(rms(np.concatenate([one.tilt for one in errors]))),
        'tilt_max_deg': math.degrees(max(float(np.max(one.tilt)) for one in errors)),
        'heading_rms_deg': math.degrees(rms(np.concatenate(
            [one.varying_heading(absolute) for one in errors]))),
        'convergence_s': max(measures.convergence_time(outcome.run.t, outcome.errors.tilt)
                             for outcome in outcomes),
        'heading_drift_deg_per_s': math.degrees(float(np.mean([
            abs(np.polyfit(outcome.run.t - outcome.run.t[0], np.unwrap(one.heading), 1)[0])
            for outcome, one in zip(settled, errors, strict=True)])))}


def quality(outcomes: Sequence[Outcome], imu: Mapping[str, Any],
            absolute: bool) -> dict[str, float]:
    """
    Return ratios of errors to the least that white noise allows, and to those without a filter.

    A Kalman filter of a random walk of density N, read with noise of density R, has the variance
    N R (Bar-Shalom et al. 2001, 4.5).
    """
    rate, force, field = (imu.get(f'{name}noise_density', 0.0)
                          for name in ('imu.gyroscope_', 'imu.accelerometer_', 'mag.'))
    horizontal = math.hypot(*imu.get('mag.field', scenarios.FIELD)[:2])
    alone = [measures.gyroscope_alone(one.run, slice(len(one.run.t) // 2, None))
             for one in outcomes]
    found: dict[str, float] = {}
    for what, variance in (('tilt', 2.0 * rate * force / scenarios.GRAVITY), (
            'heading', rate * field / max(horizontal, 1e-12)))[:1 + absolute]:
        errors = np.array([getattr(measures.rmse(one.estimates, one.run.truth), what)
                           for one in (outcome.last() for outcome in outcomes)])
        least = math.degrees(math.sqrt(variance)) or math.nan
        found |= {f'{what}_to_bound': float(np.mean(errors)) / least,
                  f'{what}_to_bound_spread': float(np.std(errors, ddof=1)) / least
                  if len(errors) > 1 else math.nan,
                  f'{what}_to_gyroscope': float(np.mean(errors / [
                      max(getattr(one, what), 1e-9) for one in alone]))}
    return found


def error_of(outcome: Outcome, absolute: bool) -> float:
    """Return the rms attitude error [rad]; unless `absolute`, a constant heading error is none."""
    errors = outcome.errors
    return rms(np.hypot(errors.tilt, errors.varying_heading(absolute)))


def offset_of(outcome: Outcome, absolute: bool) -> measures.Offset:
    """Return the time offset of a settled filter."""
    run = outcome.run
    return measures.time_offset(outcome.estimates, run.truth, run.rates, absolute)


def stamp_fault(offset: measures.Offset, step: float) -> Fault | None:
    """Return the fault if a time offset explains the error; step : of the samples [s]."""
    steps = offset.seconds / step
    if AHEAD <= steps <= DELAYED or offset.after > EXPLAINED * offset.before:
        return None
    side = 'behind' if steps > 0.0 else 'ahead of'
    return Fault(
        'stamp_offset', f'the attitude is {abs(1e3 * offset.seconds):.3g} ms {side} its stamp: '
        f'shifted by that, the error falls from {degrees(offset.before)} to '
        f'{degrees(offset.after)}')


def consistency(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, measures.Nees]:
    """Return the NEES of 'tilt' and 'attitude', as far as the filter has covariances."""
    runs = [(one.estimates[known], one.run.truth[known], one.covariances[known])
            for one in (outcome.last(0.75) for outcome in outcomes)
            if np.any(known := np.all(np.isfinite(one.covariances), axis=(1, 2)))]
    return {what: nees for what, whole in (('tilt', False), ('attitude', True))[:1 + absolute]
            if runs and (nees := measures.nees_of(runs, whole)) is not None}


def nees_measures(found: Mapping[str, measures.Nees]) -> dict[str, float]:
    """Return the result of `consistency` as measures."""
    names = {'tilt': 'nees', 'attitude': 'nees_attitude'}
    return {f'{names[what]}{end}': value for what, nees in found.items()
            for end, value in zip(('', '_low', '_high'), (nees.ratio, *nees.band), strict=True)}


def covariance_fault(found: Mapping[str, measures.Nees]) -> Fault | None:
    """Judge the result of `consistency`."""
    for what, nees in found.items():
        low, high = nees.band
        if not low <= nees.ratio <= high:
            name = 'covariance_small' if nees.ratio > high else 'covariance_large'
            return Fault(name, f'the squared error of the {what} is {nees.ratio:.3g} times what '
                         f'the covariance says; consistent are {low:.3g} to {high:.3g}, for '
                         f'{nees.degrees:.0f} degrees of freedom')
    return None


def noisy_limit(run: Run, absolute: bool, imu: Mapping[str, Any]) -> float:
    """
    Return the rms error [rad] in the last quarter above which a filter is wrong.

    It is the limit without noise, or three standard deviations of attitudes from single samples,
    where a slow filter starts, if that is larger; at most DIVERGED.
    """
    white = {*scenarios.CALIBRATED, 'mag.field', 'imu.rpy', 'mag.enabled'}
    if any(imu[name] != parameters.BY_NAME[name].default for name in imu.keys() - white
           if not name.endswith(('_band', '_correlation_time'))):
        return DIVERGED             # the filter may still be learning biases
    last = run.part(slice(-len(run.t) // 4, None))
    single = measures.errors_of(
        from_two_vectors(last.accelerometer, last.magnetometer), last.truth)
    return min(DIVERGED, max(math.hypot(TILT, absolute * HEADING),
                             3.0 * rms(single.judged(absolute))))


def inaccuracy(outcome: Outcome, absolute: bool, limit: float = DIVERGED) -> Fault | None:
    """Judge the error in the last quarter by a limit [rad] <= DIVERGED, and whether it grows."""
    quarters = [rms(part) for part in np.array_split(outcome.errors.judged(absolute), 4)]
    if quarters[-1] < limit:
        return None
    grows = all(later >= GROWS * one for one, later in itertools.pairwise(quarters[1:]))
    if grows and quarters[-1] >= DIVERGED:
        return Fault('diverges', f'{outcome.run.name}: the error grows from quarter to quarter: '
                     f'{", ".join(map(degrees, quarters))}')
    return Fault('inaccurate', f'{outcome.run.name}: the error in the last quarter is '
                 f'{degrees(quarters[-1])}, above {degrees(limit)}, for no reason that is known')


def degrees(angle: float) -> str:
    """Return an angle [rad] in words."""
    return f'{np.degrees(angle):.3g} deg'
