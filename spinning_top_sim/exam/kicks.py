# SPDX-License-Identifier: Apache-2.0
"""Whether a filter corrects errors at rest: its answers to kicks of the gyroscope alone."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.excitation import (
    ANSWER_S,
    ASTRAY,
    KICKS,
    LONG_ANSWER_S,
    Excitation,
    excite,
)
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import Outcome
from spinning_top_sim.tools.verdict import Fault

# An error is not corrected if more than STAYS of it is left and later more than STILL; it grows if
# more than GROWN is left in ANSWER_S.  Where less than NEARLY is left, nothing is measured again.
NEARLY, STAYS, STILL, GROWN = 0.9, 0.995, 0.9, 1.02
OF_HEADING = 0.3                # least share of the heading in what the magnetometer must correct
FARTHER = 1.03                  # of the error after the heading is turned: no right filter's
NEAR = 0.5                      # largest error without a kick with which a kick is judged [rad]


def corrects(outcome: Outcome, excitation: Excitation, absolute: bool,
             limit: float = STAYS) -> bool:
    """
    Return whether less than this share of kicks is left.

    The attitudes without kicks are not fed: they count as right.
    """
    return most_left(answer_of(outcome, excitation.run.truth, excitation, absolute, limit)) < limit


def uncorrected(respond: Callable[[Run], Outcome], outcome: Outcome, excitation: Excitation,
                absolute: bool, imu: Mapping[str, Any], again: bool) -> list[Fault] | None:
    """
    Name the sensors that do not correct a kick; None: the error is too large to tell.

    respond : returns the outcome of a run
    outcome : of `excitation`, whose sensor `imu` describes
    absolute : whether the heading is judged
    again : whether another excitation waits longer for the answer to a kick that stays
    """
    if corrects(outcome, excitation, absolute, NEARLY):
        return []
    found = _uncorrected(respond, outcome, excitation, absolute, STAYS)
    if not again or not found or found[0].name == 'inaccurate':
        return found
    longer = excite(imu, goes_astray=False, answer_s=LONG_ANSWER_S)
    return _uncorrected(respond, respond(longer.run), longer, absolute, STILL)


def _uncorrected(respond: Callable[[Run], Outcome], outcome: Outcome, excitation: Excitation,
                 absolute: bool, limit: float) -> list[Fault] | None:
    without = respond(excitation.still).estimates       # has the same error
    error = measures.errors_of(without, excitation.run.truth).judged(absolute=True)
    if error[excitation.kicks[0][0]] >= NEAR:           # where no filter is linear
        return None
    return not_corrected(answer_of(outcome, without, excitation, absolute, limit),
                         excitation.answer_s, limit)


def answer_of(outcome: Outcome, without: Reals, excitation: Excitation, absolute: bool,
              limit: float) -> Reals:
    """
    Return the matrix from an attitude error at rest to what is left of it after the answer.

    An error is a rotation vector about axes of the world.  An eigenvalue of 1 is that of an error
    that stays, such as one about an axis of the sensor that nothing corrects.

    without : attitudes (n, 4) without kicks
    absolute : the matrix is (3, 3); otherwise (2, 2), of tilts

    Of the matrices at two rests, that of the level one counts if more than the share `limit` of an
    error is left there, else the one with the larger spectral radius.
    """
    n = round(excitation.answer_s * scenarios.SLOW.rate)
    errors = Rotation.from_quat(outcome.estimates) * Rotation.from_quat(without).inv()
    kicks, axes = (slice(None), slice(None)) if absolute else (slice(1, None), slice(2))
    answers = []
    for firsts in excitation.kicks:
        left = errors[np.append(firsts, firsts[-1] + n) - 1]
        left = left * left[0].inv()
        begin, end = (left[:-1] * Rotation.from_rotvec(KICKS)).as_rotvec(), left[1:].as_rotvec()
        answers.append(np.linalg.lstsq(begin[kicks, axes], end[kicks, axes], rcond=None)[0].T)
    # At the second rest, heading and tilt are still moved by what earlier kicks have left.
    answers[1][:2, 2:] = answers[1][2:, :2] = 0.0
    return max(answers[:1] if most_left(answers[0]) > limit else answers, key=most_left)


def most_left(answer: Reals) -> float:
    """Return the spectral radius of what `answer_of` returns."""
    return float(np.max(np.abs(np.linalg.eigvals(answer))))


def not_corrected(answer: Reals, answer_s: float, limit: float) -> list[Fault]:
    """
    Name the sensors that do not correct kicks.

    answer : as from `answer_of`, after `answer_s` [s]
    limit : the share that may be left
    """
    most = most_left(answer)
    # By which sensor an error grows, and whether by the bias, is not known.
    if most > GROWN ** (answer_s / ANSWER_S):
        return [Fault('inaccurate', f'an error grows to {most:.0%} in {answer_s:g} s at rest')]
    left: dict[bool, float] = {}
    values, vectors = np.linalg.eig(answer.T)
    # The component of an error along such a vector becomes `value` times as large, whatever the
    # rest of the error is.
    for value, along in zip(values, vectors.T, strict=True):
        is_heading = float(np.linalg.norm(along[2:])) > OF_HEADING
        left[is_heading] = max(float(np.abs(value)), left.get(is_heading, 0.0))
    return [Fault(f'{sensor}_wiring', f'{left[is_heading]:.1%} of an error of the {what} are left '
                  f'after {answer_s:g} s, above {limit:.1%}: the {sensor} does not correct it')
            for is_heading, sensor, what in (
                (False, 'accelerometer', 'tilt'), (True, 'magnetometer', 'heading'))
            if left.get(is_heading, 0.0) > limit]


def astray(outcome: Outcome, excitation: Excitation, absolute: bool) -> list[Fault]:
    """Return the fault of a filter that, turned far off north, turns farther."""
    errors = np.abs(outcome.part(excitation.astray).errors.heading)
    if not absolute or np.max(errors) < max(ASTRAY, FARTHER * errors[0]):
        return []
    return [Fault('inaccurate', f'turned off north by {np.degrees(errors[0]):.0f} deg, it turns '
                  f'to {np.degrees(np.max(errors)):.0f} deg')]
