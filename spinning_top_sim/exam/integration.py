# SPDX-License-Identifier: Apache-2.0
"""Judges how a filter integrates: the fast motion at several sampling rates."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import degrees
from spinning_top_sim.exam.hypotheses import CORRECTS_FIRST, Hypothesis, changed
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.response import Response
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import InvalidOutputError, Outcome
from spinning_top_sim.tools.verdict import Fault

# Sampling rates for the order of convergence, as multiples of the rate of the fast motion; and the
# rate at which samples are merged into steps of UNEVEN samples in turn, of 2.5 to 15 ms.
FACTORS, FINEST, UNEVEN = (1.0, 2.0), 4.0, (1, 2, 6, 1, 5, 2, 1, 3)
# By which the response to a rate depends on the step, relative, and what is left of that where the
# lengths of steps are undone.
STEP, SMALL = 0.05, 0.02


def for_first_order(run: Run) -> Run:
    """Return the rates for which the normalised first-order step q + q w dt/2 is exact."""
    half = 0.5 * run.dt[:, np.newaxis] * np.linalg.norm(run.gyroscope, axis=1, keepdims=True)
    longer = np.tan(np.minimum(half, 1.5)) / np.where(half > 0.0, half, 1.0)
    return replace(run, gyroscope=longer * run.gyroscope)


# Changes of what is fed, also on the way to the begin of a run.  They name no fault.
FIRST_ORDER = Hypothesis(on_readings=for_first_order)
WITHOUT_FIELD = Hypothesis(on_readings=changed(
    ('magnetometer',), lambda rows: np.full_like(rows, np.nan)))


def judge_integration(response: Response) -> None:
    """Compare sampling rates on the fast motion, if possible without the magnetometer."""
    findings, restarts = response.findings, response.subject.restarts
    # A filter that goes on has the one rate of its IMU.
    factors = FACTORS if restarts else FACTORS[:1]
    runs = [_fast(response, factor) for factor in factors]
    without_field: tuple[Hypothesis, ...] = (WITHOUT_FIELD,)
    try:
        response.respond(runs[0].part(slice(10)), *without_field, shifted=False)
    except InvalidOutputError:
        without_field = ()
    outcomes = [response.respond(run, *without_field, shifted=False).last() for run in runs]
    errors = [_error_of_turn(outcome) for outcome in outcomes]
    findings.measures['order'] = measures.convergence_order(factors, errors)
    findings.measures['integration_error_deg'] = math.degrees(errors[0])
    if restarts:
        _judge_steps(response, outcomes, without_field)
    absolute = response.absolute and not without_field
    before = diagnosis.error_of(outcomes[0], absolute)
    fault = (_first_order(response, runs[0], before, without_field)
             or _left_over(response, runs, outcomes, absolute))
    findings.faults += filter(None, [fault])


def _fast(response: Response, factor: float) -> Run:
    return response.subject.record(replace(
        scenarios.FAST, rate=factor * scenarios.FAST.rate))


def _error_of_turn(outcome: Outcome) -> float:
    """Return the rms error of the rotation since the first sample [rad]."""
    one, true = map(Rotation.from_quat, (outcome.estimates, outcome.run.truth))
    return rms(((true[0] * one[0].inv()) * one * true.inv()).magnitude())


def _judge_steps(response: Response, outcomes: Sequence[Outcome],
                 without_field: Sequence[Hypothesis]) -> None:
    """Judge whether the filter uses the step, or turns by the number of samples."""
    findings = response.findings
    shifts = [one for one in response.shifts if one.on_readings is None]    # of the attitude
    ahead = bool(shifts)        # where the attitude is a step ahead, so are the turns
    # With a delay, they would not be those of the same uneven steps.
    uneven = None if any(one.faults for one in shifts) else response.respond(
        _fast(response, FINEST).merged(UNEVEN), *without_field)
    judged = [*outcomes, uneven.last()] if uneven else outcomes
    lengths, gains = zip(*itertools.chain(*(gains_of(one, ahead) for one in judged)), strict=True)
    slow, fast = gains[:2]          # at 100 Hz and 200 Hz
    apart = np.max(np.abs(np.subtract(gains, slow)))
    by_samples = abs(fast / FACTORS[1] - slow) < 2.0 * STEP * abs(slow)
    if apart > STEP * max(abs(slow), STEP) and (by_samples or (
            abs(slow - 1.0) < STEP and uneven is not None
            and _left_without(response, uneven, without_field, slow, ahead) < max(
                diagnosis.EXPLAINED * apart, SMALL))):
        # A wrong step turns up as a wrong scale at one rate.
        if 'time_step' in findings.names:
            findings.drop('gyroscope_wiring')
        findings.faults.append(Fault(
            'time_step', f'in steps of {", ".join(f"{1e3 * one:g}" for one in lengths)} ms '
            f'turns move it {", ".join(f"{one:.3g}" for one in gains)} times as far as the '
            'sensor: the length of a step is misused'))


def _left_without(response: Response, outcome: Outcome, without_field: Sequence[Hypothesis],
                  slow: float, ahead: bool) -> float:
    """
    Return the largest deviation of gains from `slow` when the lengths of steps are undone.

    The rates of a step are divided by its share of the turn.  Steps that do not turn the filter
    cannot be undone, and are left out.
    """
    shares = np.clip(_shares(outcome), 0.05, 20.0)[:, np.newaxis]
    again = response.respond(replace(outcome.run, gyroscope=outcome.run.gyroscope / np.vstack(
        (shares[:1], shares))), *without_field).last()
    before, after = (gains_of(one, ahead) for one in (outcome.last(), again))
    return max((abs(gain - slow) for (_, first), (_, gain) in zip(before, after, strict=True)
                if abs(first) > STEP), default=0.0)


def _shares(outcome: Outcome, shift: int = 0) -> Reals:
    """Return the turns of the filter relative to those of the sensor, of each step (n - 1,)."""
    steps, right = (increments(one)[1:] for one in (outcome.estimates, outcome.run.truth))
    return np.asarray(np.sum(np.roll(steps, shift, axis=0) * right, 1) / np.sum(right * right, 1))


def gains_of(outcome: Outcome, ahead: bool = False) -> list[tuple[float, float]]:
    """
    Return each length of a step [s], and the median of the relative turns in such steps.

    ahead : the filter may be a step behind or ahead of the sensor
    """
    lengths = outcome.run.dt[2:-1].round(6)
    found = [[(float(one), float(np.median(_shares(outcome, shift)[1:-1][lengths == one])))
              for one in np.unique(lengths)] for shift in (0, -1, 1)[:1 + 2 * ahead]]
    return min(found, key=lambda pairs: np.ptp([gain for _, gain in pairs]))


def _first_order(response: Response, run: Run, before: float,
                 without_field: Sequence[Hypothesis]) -> Fault | None:
    """Return the fault if the error of a run is that of steps of first order."""
    # An error of the scale does not fall with the rate.
    if before <= diagnosis.FIRST_ORDER or response.findings.measures['order'] < 1.0:
        return None
    after = diagnosis.error_of(
        response.respond(run, FIRST_ORDER, *without_field, shifted=False).last(),
        response.absolute and not without_field)
    return None if after >= diagnosis.FIRST_ORDER_LEFT * before else Fault(
        'first_order_integration', 'integration is first order: correcting it reduces the error '
        f'on the fast motion from {degrees(before)} to {degrees(after)}')


def _left_over(response: Response, runs: Sequence[Run], outcomes: Sequence[Outcome],
               absolute: bool) -> Fault | None:
    """Return the fault if an error is left, also with the field."""
    for run, outcome in zip(runs, outcomes, strict=True):
        if diagnosis.error_of(outcome, absolute) <= diagnosis.FAST:
            continue
        error = min(diagnosis.error_of(response.respond(run, *more).last(), response.absolute)
                    for more in ((), (CORRECTS_FIRST,)))
        if error > diagnosis.FAST:
            return response.blamed(Fault(
                'inaccurate', f'{run.name}, without noise: the error is {degrees(error)}, above '
                f'{degrees(diagnosis.FAST)}, for no reason that is known'))
    return None
