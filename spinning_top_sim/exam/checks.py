# SPDX-License-Identifier: Apache-2.0
"""
The checks of the exam: one row each in CHECKS, in the order in which they are done.

A check measures one number in runs of the filter; above its limit it is a fault.  A check is left
out where one of the faults in `needs` has been found, and the report says so.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures
from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.measures import NEES_OFF, USELESS_DEG, degrees
from spinning_top_sim.exam.motions import FIELD, RATE, STARTS, STEPS, Reals
from spinning_top_sim.exam.runs import ANSWER, BACK, BIAS, LARGE, SMALL, STILL, Exam
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.conventions import Errors, errors_of
from spinning_top_sim.tools.identify import AXES, rms
from spinning_top_sim.tools.report import Mark

# Without noise a right filter has no error; what is left is its own rounding and settling [deg].
CLEAN_DEG = 0.3
MOVING_DEG = 0.5        # in motion: a mean of two samples is wrong where a turn begins
GAIN_OFF = 0.02         # of what should be 1: less than sensors differ in scale
EXPLAINED = 0.25        # of an effect: what its cause may leave of it
DELAY = 0.25            # samples: half of what a mean of two steps is late
# Of shares that are 1 where a filter ignores gravity about an axis, or all but the force; right
# ones that weigh both have up to 0.8.
IGNORES = 0.9
# Of large turns: half of what a step of first order, 2 atan(x / 2), misses.
TURNS_OFF = LARGE ** 2 / 24.0
GROWS = 2.0 + GAIN_OFF  # an error that grows slower and slower at most doubles in the second half
# Steps by which filters may read force and field late, or early: a mean of two is half a step.
SHIFTS = 0.0, 0.5, 1.0, -1.0, -0.5
BIAS_OFF = 0.3          # of a bias: integrals that leak keep as much
ARM = 0.1, 0.0, 0.0     # of the IMU off the axis [m]


class Measured(NamedTuple):
    """What a check has measured; `name`, `limit`: if they are others than the check's."""

    value: float
    evidence: str
    name: str = ''
    limit: float | None = None
    others: Mapping[str, Mark] = {}


class Check(NamedTuple):
    """A row: the fault, the measure and its limit, and the faults that would hide it."""

    fault: str
    mark: str
    limit: float
    meaning: str
    measure: Callable[[Exam], Measured | None]    # None: there is nothing to judge
    needs: Sequence[str] = ()


def repeat(exam: Exam) -> Measured:
    """Feed two new filters with the same readings."""
    one, *_, same = exam.noise
    apart = measures.largest_turn(one.estimates, same.estimates)
    return Measured(apart, 'two new filters that get the same readings are '
                    f'{degrees(apart)} apart: they are random, or share state')


def convention(exam: Exam) -> Measured:
    """Read the attitudes at the rests in every convention; undo the one that fits."""
    rests = exam.ends - 1
    found = conventions.best(exam.plain.estimates[rests], exam.run.truth[rests],
                             steady=not exam.heading)
    before, after = np.degrees((found.before, found.after)).tolist()
    if after < max(GAIN_OFF * before, CLEAN_DEG):       # the right one leaves little
        exam.convention = found.convention
    name = exam.convention.name
    return Measured(before, f'read as {name}, the error at rest falls from {before:.3g} to '
                    f'{after:.2g} deg; the other checks undo it', limit=None if name else math.nan)


def gyroscope(exam: Exam) -> Measured:
    """Identify the matrix from turns that the gyroscope reads to those of the attitude."""
    turns, moves = exam.answers()
    matrix = np.linalg.lstsq(turns, moves[:, -1], rcond=None)[0].T
    left = max(np.median(np.linalg.norm(moves[:, -1] - turns @ matrix.T, axis=1)
                         / np.linalg.norm(turns, axis=1)),
               np.ptp(np.median(_gains(turns, moves), axis=0)[ANSWER // 2:]))   # it goes on
    off = np.max(np.abs(matrix - np.eye(3)), axis=0)
    if left > EXPLAINED * max(np.max(off), GAIN_OFF):
        return Measured(float(left), f'of turns of the gyroscope {left:.2g} move the attitude '
                        'otherwise, which no matrix explains', 'accuracy', EXPLAINED)
    return Measured(float(np.max(off)), 'a rate about ' + '; '.join(
        f'{AXES[k]} turns the attitude about x, y, z by '
        + ', '.join(f'{one:.3g}' for one in column)
        for k, column in enumerate(matrix.T) if off[k] > GAIN_OFF))


def at_rest(exam: Exam) -> Measured | None:
    """Judge where new filters come to rest: no estimate of a bias explains an error there."""
    settled = [exam.ours(one) for one in exam.starts if measures.settled(one.estimates, STILL)]
    if not settled:
        return None
    tilt, whole = (_at_rest(settled, slice(axes)) for axes in (2, 3))
    if tilt > CLEAN_DEG:        # by the field?
        tilt = min(tilt, _at_rest(exam.outcomes('starts, no field', lambda: [
            one.run.without_field() for one in exam.starts]), slice(2)))
    if tilt > CLEAN_DEG or not exam.heading:
        return Measured(tilt, f'where a new filter comes to rest, the tilt is {tilt:.3g} deg off, '
                        'with and without a field')
    return Measured(whole, 'where a new filter comes to rest in a field, the attitude is '
                    f'{whole:.3g} deg off; without a field the tilt is right', 'magnetometer')


def delay(exam: Exam) -> Measured:
    """Identify the delay with which the attitude follows the gyroscope."""
    off = 1.0 - np.median(_gains(*exam.answers()), axis=0)
    off -= off[-1]
    late = float(np.sum(off))
    evidence = (f'the attitude follows the gyroscope {abs(late):.3g} samples '
                f'{"late" if late > 0.0 else "ahead"}')
    if np.max(np.abs(off[ANSWER // 2:])) > EXPLAINED * np.max(np.abs(off)):
        return Measured(abs(late), f'{evidence}, and does not end to do so: that is no delay',
                        'accuracy')
    return Measured(abs(late), evidence)


def steps(exam: Exam) -> Measured:
    """Compare turns in steps of other lengths: those of a length are off by the same factor."""
    lengths = np.resize(STEPS, len(exam.ends))
    uneven, equal = (moves[:, 0] / np.linalg.norm(turns, axis=1, keepdims=True) for turns, moves
                     in (exam.answers(lengths=lengths), exam.answers()))
    found = np.empty((len(STEPS), 3))
    for k, here in enumerate(lengths == length for length in STEPS):
        one, other = equal[here], uneven[here] - equal[here]
        factor = np.vdot(one, other) / max(np.vdot(one, one), measures.ROUNDING)
        found[k] = [np.median(np.linalg.norm(rows, axis=1))
                    for rows in (other, other - factor * one, one)]
    worst = int(np.argmax(found[:, 0]))
    off, left, gain = found[worst].tolist()
    # The next check tells a wrong gain; some right filters are never quite still.
    limit = max(GAIN_OFF, EXPLAINED * abs(gain - 1.0))
    evidence = (f'a turn in a step of {1e3 * STEPS[worst]:g} ms is {off:.3g} of it off one as '
                f'fast in {1e3 / RATE:g} ms')
    if off > limit and left > EXPLAINED * off:
        return Measured(off, f'{evidence}: by no factor', 'accuracy', max(limit, EXPLAINED))
    return Measured(off, f'{evidence}: the length is misused', limit=limit)


def large_turns(exam: Exam) -> Measured:
    """Compare large turns in one step with small ones: the closed form is the same for both."""
    large, small = (float(np.median(_gains(*answers)[:, 0]))
                    for answers in (exam.answers(LARGE), exam.answers()))
    off = abs(1.0 - large / small)
    return Measured(off, f'a turn of {LARGE:g} rad in one step, {LARGE * RATE:g} rad/s, moves the '
                    f'attitude by {large:.4g} of it, a small one by {small:.4g}; a step of '
                    f'first order is {LARGE ** 2 / 12.0:.2%} off',
                    'gyroscope' if off > EXPLAINED else '')


def tilt_answer(exam: Exam) -> Measured | None:
    """Turn the gyroscope about level axes of new filters, flat and on edge: gravity answers."""
    back = np.empty((2, 2))
    for k, (axes, start) in enumerate((((0, 1), STARTS[0]), ((0, 2), (60.0, 2.0, 87.0)))):
        outcomes = exam.kicks_of_tilt(start, axes)
        if _at_rest(outcomes[-1:], slice(2)) > CLEAN_DEG:       # it has not come to rest
            return None
        *moved, still = (measures.up(one.estimates[[-BACK, -1]]) for one in outcomes)
        first, later = np.cross(moved, still).transpose(1, 0, 2)
        # `first` is 0 if the filter misses the kick.
        back[k] = 1.0 - np.sum(first * later, axis=1) / np.maximum(
            np.sum(first ** 2, axis=1), STILL ** 2)
    share = back / np.maximum(back[:, ::-1], measures.ROUNDING)
    return Measured(1.0 - float(np.min(share)), f'within {BACK / RATE:g} s gravity leads a tilt '
                    'about x and y back by {:.2g} and {:.2g} of it, on edge about x and z by '
                    '{:.2g} and {:.2g}'.format(*back.ravel()))


def clean(exam: Exam) -> Measured:
    """Judge what is left without noise; filters may read force and field a step late or early."""
    def errors(force: float, field: float) -> Errors:
        return exam.errors(exam.shifted(force, field).part(slice(exam.lead, None)))

    force = field = 0.0
    if np.max(errors(force, field).whole) > math.radians(MOVING_DEG):
        force = min(SHIFTS, key=lambda shift: float(np.max(errors(shift, field).tilt)))
        field = min(SHIFTS, key=lambda shift: float(np.max(errors(force, shift).whole)))
    whole, kinds = np.degrees(errors(force, field).whole), np.array(exam.motion.kinds[exam.lead:])
    worst = {kind: float(np.max(whole[kinds == kind])) for kind in dict.fromkeys(kinds.tolist())}
    return Measured(max(worst.values()), 'without noise the error is ' + ', '.join(
        f'{value:.2g} deg ({kind})' for kind, value in worst.items()) + (
            f', with force and field of {force:g} and {field:g} steps later'))


def reported_bias(exam: Exam) -> Measured | None:
    """Judge the reported bias, but not where its error still falls half as fast as before."""
    outcome, off, said = exam.biased, [], []
    for axes, rows in _of_bias(outcome):
        told = outcome.biases[rows][np.isfinite(outcome.biases[rows][:, 0])]
        if len(told) < 4:           # too few: the filter hardly ever reports it
            return None
        said += [told[0], told[-1]]
        quarters = np.abs(told[np.linspace(0, len(told) - 1, 5, dtype=int)] / BIAS - 1.0)
        before, late, last = quarters[2:, axes]
        closer = late - last > np.maximum(0.5 * (before - late), measures.ROUNDING)
        off += np.where(closer, 0.0, last).tolist()
    # The turn between the rests changes the axes of the world, not those of the gyroscope.
    off.append(float(np.linalg.norm((said[2] - said[1])[:2]) / np.linalg.norm(BIAS)))
    ends = '; '.join(map(_in_degrees, said))
    return Measured(max(off), f'the bias is {_in_degrees(BIAS)} deg/s; at begin and end of the '
                    f'rests before and after a turn the filter says {ends}')


def effect_of_bias(exam: Exam) -> Measured:
    """Judge the tilt by a bias: it ends, or stays where a filter has no estimate."""
    outcome = exam.biased
    # About axes of the sensor, because the heading may drift.
    tilt = np.abs(np.cross(measures.up(outcome.run.truth), measures.up(outcome.estimates)))
    grows, ends = [], []
    for axes, rows in _of_bias(outcome):
        for axis in axes:
            first, second = (float(np.max(part)) for part in np.array_split(tilt[rows, axis], 2))
            grows.append(second / max(first, STILL))
            ends.append(float(tilt[rows, axis][-1]) / abs(BIAS[axis]))
    return Measured(max(grows), f'a bias of {_in_degrees(BIAS)} deg/s tilts the attitude '
                    f'{max(grows):.3g} times as far in the second half of a rest as in the first: '
                    'faster and faster', others={
                        'bias_tilt_s': Mark(max(ends), meaning='tilt over a bias, in the end')})


def heading_answer(exam: Exam) -> Measured | None:
    """Turn the field: it moves the heading, first the wrong way by some estimates of a bias."""
    if not exam.heading:
        return None
    turns, field = Rotation.from_quat(exam.run.truth), exam.run.magnetometer.copy()
    middle = len(field) // 2
    field[middle:] = turns[middle:].inv().apply(Rotation.from_euler('z', SMALL).apply(FIELD))
    moved = exam.outcome('field turned', replace(exam.run, magnetometer=field))
    share = float(errors_of(exam.plain.estimates[-1:], moved.estimates[-1:]).heading[0]) / SMALL
    return Measured(1.0 - abs(share), f'of a turn of the field by {degrees(SMALL)} the heading '
                    f'follows {share:.2g} within {len(exam.run.dt) / 2.0 / RATE:.0f} s')


def lever_arm(exam: Exam) -> Measured:
    """Move the IMU off the axis: the tilt must not follow the specific force."""
    rows = np.flatnonzero(np.array(exam.motion.kinds) == 'top')
    force = exam.run.accelerometer.copy()
    turns = Rotation.from_quat(exam.run.truth[rows])
    velocity = np.gradient(turns.apply(ARM), 1.0 / RATE, axis=0)
    force[rows] += turns.inv().apply(np.gradient(velocity, 1.0 / RATE, axis=0))
    with_arm = exam.outcome('lever arm', replace(exam.run, accelerometer=force))
    # When it has come; the last differences are one-sided.
    rows = rows[len(rows) // 2:-2]
    tilt = rms(errors_of(with_arm.estimates[rows], exam.plain.estimates[rows]).tilt)
    east, north, up = Rotation.from_quat(exam.run.truth[rows]).apply(force[rows]).T
    felt = rms(np.arctan2(np.hypot(east, north), up))
    return Measured(tilt / felt, f'10 cm off the axis, the specific force is {degrees(felt)} off '
                    f'the vertical, and the attitude {degrees(tilt)}: motion is taken for gravity',
                    others={'lever_arm_deg': Mark(math.degrees(tilt), meaning='by 10 cm')})


def noisy(exam: Exam) -> Measured:
    """Judge the errors with noise."""
    errors = list(map(exam.errors, _late(exam)))
    tilt, heading = (np.degrees(np.concatenate(rows)) for rows in zip(*errors, strict=True))
    value = math.degrees(max(rms(one.whole) for one in errors))
    return Measured(value, f'with noise the error is {value:.3g} deg rms', others={
        'tilt_rms_deg': Mark(rms(tilt), meaning='with noise'),
        'heading_rms_deg': Mark(rms(heading), meaning='with noise' if exam.heading
                                else 'with noise, about its mean')})


def covariance(exam: Exam) -> Measured | None:
    """Compare the squared error with the covariance; the noise is known: half of NEES_OFF."""
    ratio = measures.nees_of(_late(exam))
    if ratio is None:
        return None
    return Measured(max(ratio, 1.0 / ratio), f'the squared error of the tilt is {ratio:.3g} times '
                    'what the covariance says', limit=NEES_OFF[1] if ratio < 1.0 else None)


def _gains(turns: Reals, moves: Reals) -> Reals:
    """Return by which share of turns (n, 3) the attitude has moved about them (n, ANSWER)."""
    gains: Reals = np.einsum('nj,nkj->nk', turns, moves) / np.sum(turns ** 2, axis=1,
                                                                  keepdims=True)
    return gains


def _in_degrees(rates: Reals) -> str:
    return ', '.join(f'{rate:.2g}' for rate in np.degrees(rates))


def _at_rest(outcomes: Sequence[Outcome], axes: slice) -> float:
    """Return the largest error about axes of the world in the end of these rests [deg]."""
    return math.degrees(max(float(np.linalg.norm(measures.turns(
        one.run.truth[-1], one.estimates[-1])[axes])) for one in outcomes))


def _of_bias(outcome: Outcome) -> list[tuple[list[int], NDArray[np.intp]]]:
    """Return the axes that are level in a rest, whose errors gravity shows, and its samples."""
    rests = np.flatnonzero(np.all(np.isclose(outcome.run.gyroscope, BIAS, atol=1e-5), axis=1))
    return list(zip(([0, 1], [1, 2]), np.split(rests, 2), strict=True))


def _late(exam: Exam) -> list[Outcome]:
    """Return the second half of the runs with noise, each seed once."""
    return [one.part(slice(len(one.run.dt) // 2, None)) for one in exam.noise[:-1]]


FIRST = 'invalid_output', 'nondeterministic'
STEADY = (*FIRST, 'timing', 'accuracy')
TURNS = (*STEADY, 'gyroscope')
INPUTS = (*TURNS, 'accelerometer')
ALL = (*INPUTS, 'magnetometer')
CHECKS = (
    Check('nondeterministic', 'repeat_rad', measures.ROUNDING, 'of two filters, same readings',
          repeat),
    Check('convention', 'convention_deg', CLEAN_DEG, 'at rest, as it is told', convention, FIRST),
    Check('timing', 'steps_off', GAIN_OFF, 'turns in steps of 2.5 to 15 ms', steps, FIRST),
    Check('gyroscope', 'rates_off', GAIN_OFF, 'matrix of the rates off the identity', gyroscope,
          STEADY),
    Check('accelerometer', 'rest_deg', CLEAN_DEG, 'of new filters', at_rest, TURNS),
    Check('timing', 'delay_samples', DELAY, 'of the attitude behind the gyroscope', delay, INPUTS),
    Check('integration', 'large_turn_off', TURNS_OFF, 'turns of 0.3 rad in a step', large_turns,
          INPUTS),
    Check('accelerometer', 'tilt_answer', IGNORES, '1: gravity does not lead a tilt back',
          tilt_answer, INPUTS),
    Check('accuracy', 'clean_deg', MOVING_DEG, 'largest error without noise', clean,
          (*ALL, 'integration')),
    Check('bias', 'bias_report_off', BIAS_OFF, 'of a bias, relative', reported_bias, ALL),
    Check('bias', 'bias_growth', GROWS, 'of the tilt by a bias in half of a rest', effect_of_bias,
          ALL),
    Check('magnetometer', 'heading_answer', 1.0 - GAIN_OFF,
          '1: the heading does not follow the field', heading_answer, (*ALL, 'integration')),
    Check('lever_arm', 'lever_arm', IGNORES, 'share of the tilt of the specific force', lever_arm,
          ALL),
    Check('accuracy', 'noisy_deg', USELESS_DEG, 'rms with noise', noisy, ALL),
    Check('covariance', 'nees_off', 0.5 * NEES_OFF[0], 'squared error over its covariance',
          covariance, (*ALL, 'integration', 'lever_arm', 'bias')),
)
