# SPDX-License-Identifier: Apache-2.0
"""
Identifies the faults of a filter by their signatures, and gives the evidence for each.

A constant misinterpretation of readings or attitudes is identified by inverting it: if the error
disappears, it was the cause.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures
from spinning_top_sim.exam.excitation import axes, mapped, moved, shifted
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import ChangeAttitudes, Hypothesis, Outcome

FAULTS = ('first_order_integration', 'gyroscope_units', 'conjugated', 'component_order',
          'frame_ned', 'gravity_sign', 'gyroscope_wiring', 'accelerometer_wiring',
          'magnetometer_wiring', 'time_step', 'heading_offset', 'hard_iron', 'lag', 'lever_arm',
          'stamp_offset', 'no_bias_estimate', 'bias_report', 'covariance_small',
          'covariance_large', 'inaccurate', 'diverges', 'invalid_output')

# Thresholds; docs/exam.md compares them with the values of filters.  Errors are in rad.
TILT, HEADING = np.radians((0.3, 0.8)).tolist()         # rms of a right filter, no noise
GROSS = np.radians(3.0)         # a smaller error is no misreading
DIVERGED, GROWS = np.radians(10.0), 1.2     # from one quarter to the next
EXPLAINED = 0.25                # of the error is left at most when its cause is undone
FIRST_ORDER = np.radians(0.2)   # on the fast motion
FIRST_ORDER_LEFT = 0.5          # of that error, with rates for which first-order steps are right
LEVER_ARM = np.radians(1.0)     # between the attitudes with and without the lever arm
AHEAD, DELAYED = -1.5, 0.75     # steps; a filter that corrects before its step is ahead by one
BIAS_LEFT_S = 0.05              # error relative to the bias that causes it [rad/(rad/s)]
CONSISTENT = 0.9999             # probability of the NEES band


class Fault(NamedTuple):
    """
    A fault of a filter.

    Parameters
    ----------
    name : str
        One of FAULTS.
    evidence : str
        Why the exam reports it.
    """

    name: str
    evidence: str


class Clean(NamedTuple):
    """Errors without noise, rms [rad]: at rest, and in motion."""

    tilt: float
    heading: float
    tilt_moving: float
    heading_moving: float

    @property
    def wrong(self) -> bool:
        """Whether one is larger than that of a right filter."""
        return (max(self.tilt, self.tilt_moving) > TILT
                or max(self.heading, self.heading_moving) > HEADING)

    def __str__(self) -> str:
        return (f'without noise the error at rest is {degrees(self.tilt)} of tilt and '
                f'{degrees(self.heading)} of heading, in motion {degrees(self.tilt_moving)} and '
                f'{degrees(self.heading_moving)}')


def _turned(left: Sequence[float], right: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
            ) -> ChangeAttitudes:
    """Return the multiplication of attitudes by quaternions x, y, z, w on both sides."""
    return lambda estimates: (Rotation.from_quat(left) * Rotation.from_quat(estimates)
                              * Rotation.from_quat(right)).as_quat()


def for_first_order(run: Run) -> Run:
    """Return the rates for which the normalised first-order step q + q w dt/2 is exact."""
    half = 0.5 * run.dt * np.linalg.norm(run.gyroscope, axis=1)
    longer = np.tan(np.minimum(half, 1.5)) / np.where(half > 0.0, half, 1.0)
    return replace(run, gyroscope=run.gyroscope * np.where(
        half > 0.0, longer, 1.0)[:, np.newaxis])


_HALF = 0.5 ** 0.5
_CONJUGATE, _W_LAST = np.array((-1.0, -1.0, -1.0, 1.0)), [1, 2, 3, 0]
NED_WORLD = Hypothesis(('frame_ned',), 'read as attitude in a world north-east-down',
                       read=_turned((_HALF, _HALF, 0.0, 0.0)))
GRAVITY_SIGN = Hypothesis(
    ('gravity_sign',), 'with the sign of the accelerometer changed',
    given=lambda run: replace(run, accelerometer=-run.accelerometer))
# These need the attitudes only.
READINGS = (
    Hypothesis(('component_order',), 'read as w, x, y, z', read=lambda q: q[:, _W_LAST]),
    Hypothesis(('conjugated',), 'conjugated', read=lambda q: q * _CONJUGATE),
    NED_WORLD,
    Hypothesis(('frame_ned',), 'read as attitude of axes forward-right-down in a world '
               'north-east-down', read=_turned((_HALF, _HALF, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),
    Hypothesis(('frame_ned',), 'read as attitude in a world north-west-up',
               read=_turned((0.0, 0.0, _HALF, _HALF))),
    Hypothesis(('conjugated', 'component_order'), 'read as w, x, y, z and conjugated',
               read=lambda q: q[:, _W_LAST] * _CONJUGATE))
LIKELY = 6                      # signed permutations of a sensor that are tried
SIGNED = [np.array(signs)[:, np.newaxis] * np.eye(3)[list(order)]
          for order in itertools.permutations(range(3))
          for signs in itertools.product((1.0, -1.0), repeat=3)][1:]
ONE_STEP = (        # no fault: the filter corrects before it takes the step
    Hypothesis((), 'corrected before the step',
               given=shifted(('accelerometer', 'magnetometer'), -1)),
    Hypothesis((), 'a step ahead', read=lambda q: moved(q, -1)))


def wired(sensor: str, text: str, matrix: Any) -> Hypothesis:
    """Return the hypothesis that the readings of a sensor need this matrix."""
    return Hypothesis((f'{sensor}_wiring',), text, given=mapped(sensor, matrix))


def permuted(sensor: str, fit: Callable[[Reals], float], count: int = LIKELY) -> list[Hypothesis]:
    """Return the hypotheses that the filter has those signed permutations that fit best."""
    return [wired(sensor, f'with {axes(one.T)} of the {sensor} for its x, y, z', one.T)
            for one in sorted(SIGNED, key=fit, reverse=True)[:count]]


def marks(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, float]:
    """Return the measures of the errors in several runs, as defined in docs/exam.md."""
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


def explain(outcome: Outcome, absolute: bool) -> Hypothesis | None:
    """Return the misreading of attitudes that explains the error of a settled filter, or None."""
    before = error_of(outcome, absolute)
    after, best = min((
        (error_of(replace(outcome, estimates=one.read(outcome.estimates)), absolute), one)
        for one in READINGS), key=lambda pair: pair[0])
    if before < GROSS or after > EXPLAINED * before:
        return None
    text = (f'{best.text}, the error falls from {degrees(before)} to {degrees(after)}; all '
            'measures are those after this correction')
    return ambiguous(best._replace(text=text), absolute)


def ambiguous(one: Hypothesis, absolute: bool) -> Hypothesis:
    """Return a hypothesis that has both names where two cannot be told apart."""
    if absolute or one.faults not in (('gravity_sign',), NED_WORLD.faults):
        return one
    return one._replace(faults=('frame_ned', 'gravity_sign'),
                        text=f'{one.text}; the two cannot be told apart without a heading')


def stamp_fault(outcome: Outcome, absolute: bool) -> tuple[measures.Offset, Fault | None]:
    """Return the time offset of a settled filter, and the fault if it explains the error."""
    run = outcome.run
    offset = measures.time_offset(outcome.estimates, run.truth, run.rates, absolute)
    steps = offset.seconds / float(np.median(run.dt))
    if AHEAD <= steps <= DELAYED or offset.after > EXPLAINED * offset.before:
        return offset, None
    side = 'behind' if steps > 0.0 else 'ahead of'
    return offset, Fault(
        'stamp_offset', f'the attitude is {abs(1e3 * offset.seconds):.3g} ms {side} its stamp: '
        f'shifted by that, the error falls from {degrees(offset.before)} to '
        f'{degrees(offset.after)}')


def consistency(outcomes: Sequence[Outcome], absolute: bool) -> dict[str, measures.Nees]:
    """Return the NEES of 'tilt' and 'attitude', as far as the filter has covariances."""
    runs = [(one.estimates[known], one.run.truth[known], one.covariances[known])
            for one in (outcome.last(0.75) for outcome in outcomes)
            if np.any(known := np.all(np.isfinite(one.covariances), axis=(1, 2)))]
    if not runs:
        return {}
    found = {what: measures.nees_of(runs, whole)
             for what, whole in (('tilt', False), ('attitude', True))[:1 + absolute]}
    return {what: nees for what, nees in found.items() if nees is not None}


def nees_marks(found: Mapping[str, measures.Nees]) -> dict[str, float]:
    """Return the result of `consistency` as measures."""
    names = {'tilt': 'nees', 'attitude': 'nees_attitude'}
    return {f'{names[what]}{end}': value for what, nees in found.items()
            for end, value in zip(('', '_low', '_high'), (nees.ratio, *nees.band()), strict=True)}


def covariance_fault(found: Mapping[str, measures.Nees]) -> Fault | None:
    """Judge the result of `consistency`."""
    for what, nees in found.items():
        low, high = nees.band(CONSISTENT)
        if not low <= nees.ratio <= high:
            name = 'covariance_small' if nees.ratio > high else 'covariance_large'
            return Fault(name, f'the squared error of the {what} is {nees.ratio:.3g} times what '
                         f'the covariance says; consistent are {low:.3g} to {high:.3g}, for '
                         f'{nees.degrees:.0f} degrees of freedom')
    return None


def divergence(outcome: Outcome, absolute: bool) -> Fault | None:
    """Judge whether the error grows from quarter to quarter."""
    error = outcome.errors.attitude(True) if absolute else outcome.errors.tilt
    quarters = [rms(part) for part in np.array_split(error, 4)]
    if quarters[-1] < DIVERGED or any(
            later < GROWS * earlier for earlier, later in itertools.pairwise(quarters[1:])):
        return None
    return Fault('diverges', f'{outcome.run.name}: the error grows from quarter to quarter: '
                 f'{", ".join(map(degrees, quarters))}')


def inaccuracy(outcome: Outcome, absolute: bool) -> Fault | None:
    """Judge the error in the last quarter, for which there is no other reason."""
    last = outcome.last(0.25)
    error = error_of(last, True) if absolute else rms(last.errors.tilt)
    if error < DIVERGED:
        return None
    return Fault('inaccurate', f'{last.run.name}: the error in the last quarter is '
                 f'{degrees(error)}, for no reason that is known')


def one_of_each(faults: Sequence[Fault]) -> Iterator[Fault]:
    """Yield the first fault of each name: a misreading, which hides the others, comes first."""
    names = [fault.name for fault in faults]
    yield from (fault for k, fault in enumerate(faults) if fault.name not in names[:k])


def degrees(angle: float) -> str:
    """Return an angle [rad] in words."""
    return f'{np.degrees(angle):.3g} deg'
