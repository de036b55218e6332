# SPDX-License-Identifier: Apache-2.0
"""
The checks of the exam: one row each in CHECKS, in the order in which they are done.

A check measures one number in runs of the filter; above its limit it is a fault.  A check is left
out where one of the faults in `needs` has been found, and the report says so.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import answers, bias, measures
from spinning_top_sim.exam.measures import degrees
from spinning_top_sim.exam.motions import RATE, ROUNDING, Reals
from spinning_top_sim.exam.runs import FIELD_TURN, Exam
from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.identify import AXES, rms
from spinning_top_sim.tools.report import Mark

# Without noise a right filter has no error; what is left is its own rounding and settling [deg].
CLEAN_DEG = 0.3
GAIN_OFF = 0.02         # of turns: less than sensors differ in scale
TURNS_OFF = 0.003       # of large turns; a step of first order is 0.0075 off
DELAY = 0.25            # samples: half of what a mean of two steps is late
UNEVEN = 0.8            # 1 - ratio of gains about two axes: those of right filters differ less
FOLLOWS = 0.7           # half of the power: the filter is faster than the motion
GROWS = 2.0 + 2.0 * bias.STEADY         # see bias.growth
NOISY_DEG = 5.0         # a right filter that corrects first lags a step, on the top 2.3 deg


class Measured(NamedTuple):
    """
    What a check has measured.

    name : of the fault, if it is another than the check's
    limit : if it depends on the runs
    others : further measures
    """

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
    """Feed two filters of one process with the same readings."""
    one, other = (outcome.estimates for outcome in exam.outcomes('twice'))
    apart = measures.largest_turn(one, other)
    return Measured(apart, 'two new filters of one process that get the same readings are '
                    f'{degrees(apart)} apart: they are random, or share state')


def convention(exam: Exam) -> Measured:
    """Read the attitudes at the rests in every convention; undo the one that fits."""
    told, rests = exam.outcomes('excitation')[0].estimates, _rests(exam)
    found = conventions.best(told[rests], exam.run.truth[rests],
                             'absolute' if exam.heading else 'any')
    before, after, as_told = *np.degrees((found.before, found.after)), _rates(exam).off_identity
    if found.convention.parts and after < max(0.1 * before, CLEAN_DEG):
        exam.read_in(found.convention)
        # What is taken for axes of the sensor may be a sensor that is read wrongly.
        if _rates(exam).off_identity > max(as_told, answers.FIT):
            exam.read_in(conventions.Convention())
    name = exam.convention.name
    return Measured(before, f'read as {name}, the error at rest falls from {before:.3g} to '
                    f'{after:.2g} deg; the other checks undo it', limit=None if name else math.nan)


def gyroscope(exam: Exam) -> Measured:
    """Identify the matrix from turns that the gyroscope reads to those of the attitude."""
    found = _rates(exam)
    off = found.off_identity
    if found.left > 0.5:
        return Measured(max(off, found.left), f'turns of the gyroscope move the attitude '
                        f'otherwise, by {found.left:.2g} of them, differently in each attitude',
                        'accuracy')
    # What comes late has lost something on its way; what differs otherwise is no matrix.
    whole = off > answers.FIT or abs(found.delay) < DELAY
    return Measured(off, str(found), limit=None if whole and found.left < answers.FIT * off
                    else math.nan)


def delay(exam: Exam) -> Measured | None:
    """Identify the delay with which the attitude follows the gyroscope, if it does follow."""
    found = _rates(exam)
    if found.off_identity > GAIN_OFF:
        return None
    return Measured(abs(found.delay), f'the attitude follows the gyroscope {abs(found.delay):.3g} '
                    f'samples {"late" if found.delay > 0.0 else "ahead"}')


def steps(exam: Exam) -> Measured | None:
    """Compare turns in steps of different lengths, if they are right in equal ones."""
    if _rates(exam).off_identity > GAIN_OFF:
        return None
    ((still,), (moved,)) = exam.outcomes('uneven'), exam.outcomes('uneven turns')
    kicks = answers.kicks(still, moved)
    return Measured(float(np.max(np.abs(kicks.gains - 1.0))), 'in steps of '
                    f'{", ".join(f"{1e3 * one:g}" for one in still.run.dt[kicks.steps])} ms a '
                    f'turn moves the attitude {", ".join(f"{one:.3g}" for one in kicks.gains)} '
                    'times as far: the length of the step is misused')


def large_turns(exam: Exam) -> Measured | None:
    """Compare large turns in one step with the closed form, if small ones are right."""
    if _rates(exam).off_identity > GAIN_OFF:
        return None
    off = answers.kicks(*exam.outcomes('attitudes'), *exam.outcomes('large turns')).off
    turn = f'a turn of {answers.LARGE:g} rad in one step'
    if off > answers.FIT:
        return Measured(off, f'{turn}, {answers.LARGE * RATE:g} rad/s, moves the attitude '
                        f'otherwise, by {off:.2g} of it; a small one does not', 'gyroscope')
    return Measured(off, f'{turn} is {off:.2%} off the rotation; a step of first order is '
                    f'{answers.LARGE ** 2 / 12:.2%} off',
                    limit=max(TURNS_OFF, _trembles(exam) / answers.LARGE))


def tilt_at_rest(exam: Exam) -> Measured:
    """Judge the tilt at which new filters come to rest: no estimate of a bias explains it."""
    tilt, alone = (_at_rest(exam, name, slice(2)) for name in ('starts', 'starts, no field'))
    return Measured(tilt, f'where a new filter comes to rest, the tilt is up to {tilt:.3g} deg off'
                    f', without the magnetometer {alone:.3g} deg',
                    'accuracy' if _rates(exam).off_identity > answers.FIT else
                    'magnetometer' if alone < 0.5 * tilt else 'accelerometer',
                    CLEAN_DEG + math.degrees(_trembles(exam)))


def tilt_answer(exam: Exam) -> Measured | None:
    """Turn the gyroscope alone about each axis, and across it: gravity leads the tilt back."""
    if _rates(exam).off_identity > answers.FIT or not exam.level:
        return None
    tilts = exam.outcomes('tilts')
    back = np.array([[answers.led_back(still, moved) for moved in tilts[2 * k:2 * k + 2]]
                     for k, still in enumerate(exam.level)])
    least = float(np.min(back[:, 0] / np.maximum(back[:, 1], ROUNDING)))
    return Measured(1.0 - least, 'gravity leads a tilt about x, y and z back by ' + ', '.join(
        f'{one:.2g}' for one in back[:, 0]) + f' of it within {-answers.LONG / RATE:g} s, and by '
        + ', '.join(f'{one:.2g}' for one in back[:, 1]) + ' across',
                    limit=UNEVEN + _trembles(exam) / answers.SMALL)


def heading_at_rest(exam: Exam) -> Measured | None:
    """Judge the heading at which new filters come to rest."""
    if not exam.heading:
        return None
    heading = _at_rest(exam, 'starts', slice(2, 3))
    return Measured(heading, 'where a new filter comes to rest, the heading is up to '
                    f'{heading:.3g} deg off')


def heading_answer(exam: Exam) -> Measured | None:
    """Turn the field to one side and to the other: the heading follows."""
    if not exam.heading:
        return None
    one, other = (exam.errors(name).heading for name in ('excitation', 'field turned'))
    moved = np.angle(np.exp(1j * (other - one)))
    share = float(moved[-1] - moved[len(moved) // 2 - 1]) / (2.0 * FIELD_TURN)
    return Measured(1.0 - share, f'of a turn of the field by {degrees(2.0 * FIELD_TURN)} the '
                    f'heading follows {share:.2g} within {len(moved) / 2.0 / RATE:.0f} s')


def clean(exam: Exam) -> Measured:
    """Judge what is left without noise."""
    whole, settled = np.degrees(exam.clean.whole), round(exam.lead_s * RATE)
    names = {'at rest': 'rest', 'in turns': 'turn', 'in fast turns': 'fast', 'in a slow turn':
             'slow', 'on a top': 'top'}
    worst = {text: max(float(np.max(whole[part.begin:part.end])) for part in exam.motion.of(kind)
                       if part.begin >= settled) for text, kind in names.items()}
    return Measured(max(worst.values()), 'without noise the error is ' + ', '.join(
        f'{value:.2g} deg {text}' for text, value in worst.items()))


def lever_arm(exam: Exam) -> Measured:
    """Move the IMU off the axis: the tilt must not follow the specific force."""
    ((part,), (with_arm,)) = exam.motion.of('top'), exam.outcomes('arm')
    # When it has come; the last differences are one-sided.
    rows = slice((part.begin + part.end) // 2, part.end - 2)
    still = exam.outcomes('excitation')[0].estimates[rows]
    tilt = rms(errors_of(with_arm.estimates[rows], still).tilt)
    east, north, up = Rotation.from_quat(exam.run.truth[rows]).apply(
        with_arm.run.accelerometer[rows]).T
    felt = rms(np.arctan2(np.hypot(east, north), up))
    return Measured(tilt / felt, f'10 cm off the axis, the specific force is {degrees(felt)} off '
                    f'the vertical, and the attitude {degrees(tilt)}: motion is taken for gravity',
                    others={'lever_arm_deg': Mark(math.degrees(tilt), meaning='by 10 cm')})


def effect_of_bias(exam: Exam) -> Measured:
    """Judge the error that a bias leaves: it ends, or stays where a filter has no estimate."""
    found = exam.bias
    judged = [one for one in found.courses if len(one.apart) and bias.settled(one.error)]
    judged += [one for one in found.courses[:2] if bias.growth(one.error) > GROWS]
    worst = max(judged, key=lambda one: one.left, default=None)
    tilt = max(bias.last(one.error) / abs(bias.BIAS[one.axis]) for one in found.courses)
    return Measured(worst.left if worst else 0.0, '' if worst is None else (
        f'a bias of {_in_degrees(bias.BIAS)} deg/s turns the attitude about {AXES[worst.axis]} by '
        f'{degrees(bias.last(worst.error))} in the end, {worst.left:.0%} of the largest effect: '
        + ('it is not learned' if len(found.said) else 'it grows faster and faster')), others={
            'bias_tilt_s': Mark(tilt, meaning='tilt over a bias, in the end')})


def reported_bias(exam: Exam) -> Measured | None:
    """Judge the reported bias where it has settled, or moves away from the true one."""
    if not len(exam.bias.said):
        return None
    off = [bias.last(one.apart) for one in exam.bias.courses
           if bias.settled(one.apart) or bias.growth(one.apart) > 1.0]
    return Measured(max(off, default=0.0), f'the bias is {_in_degrees(bias.BIAS)} deg/s, and in '
                    f'the end the filter says {_in_degrees(exam.bias.said)}')


def noisy(exam: Exam) -> Measured:
    """Judge errors with noise by those of attitudes from single samples."""
    errors, single = [], []
    for outcome in exam.outcomes('noise'):
        last = outcome.part(slice(len(outcome.run.dt) // 2, None))
        run, found = last.run, errors_of(last.estimates, last.run.truth)
        errors.append(found if exam.heading else found.about_mean())
        single.append(rms(errors_of(measures.from_two_vectors(
            run.accelerometer, run.magnetometer), run.truth).whole))
    tilt, heading = (np.degrees(np.concatenate(rows)) for rows in zip(*errors, strict=True))
    value = math.degrees(max(rms(one.whole) for one in errors))
    return Measured(value, f'with noise the error is {value:.3g} deg rms',
                    limit=max(NOISY_DEG, 3.0 * math.degrees(max(single))), others={
                        'tilt_rms_deg': Mark(rms(tilt), meaning='with noise'),
                        'tilt_max_deg': Mark(float(np.max(tilt)), meaning='with noise'),
                        'heading_rms_deg': Mark(rms(heading), meaning='with noise' if exam.heading
                                                else 'with noise, about its mean')})


def covariance(exam: Exam) -> Measured | None:
    """Compare the squared error with the covariance."""
    nees = measures.nees_of(exam.outcomes('noise'))
    if nees is None or not any(exam.imu[f'imu.{sensor}_noise_density'] for sensor in (
            'gyroscope', 'accelerometer')):
        return None
    off = max(nees.ratio, 1.0 / max(nees.ratio, 1e-300))
    return Measured(off, str(nees), limit=nees.high if nees.ratio > 1.0 else 1.0 / nees.low)


def _rests(exam: Exam) -> list[int]:
    """Return the last sample of each rest."""
    return [part.end - 1 for part in exam.motion.of('rest')]


def _rates(exam: Exam) -> answers.Rates:
    return answers.rates(*exam.outcomes('attitudes'), *exam.outcomes('turns'))


def _in_degrees(rates: Reals) -> str:
    return ', '.join(f'{rate:.2g}' for rate in np.degrees(rates))


def _trembles(exam: Exam) -> float:
    """Return the largest turn of a step in rests [rad]: corrections may have a fixed size."""
    turns = np.abs(measures.increments(exam.outcomes('attitudes')[0].estimates))
    return float(max(np.max(turns[end + answers.SHORT + 1:end]) for end in exam.ends))


def _at_rest(exam: Exam, name: str, axes: slice) -> float:
    """Return the largest error about axes of the world that has settled in these runs [deg]."""
    # A filter that never settles has errors at rest for other reasons.
    sizes = [np.linalg.norm(measures.turns(one.run.truth, one.estimates)[:, axes], axis=1)
             for one in exam.outcomes(name) if exam.settles]
    return math.degrees(max((size[-1] for size in sizes if bias.settled(size)), default=0.0))


FIRST = 'invalid_output', 'nondeterministic'
INPUTS = (*FIRST, 'gyroscope', 'timing', 'accuracy')
ALL = (*INPUTS, 'accelerometer', 'magnetometer')
CHECKS = (
    Check('nondeterministic', 'repeat_rad', ROUNDING, 'of two filters, same readings', repeat),
    Check('convention', 'convention_deg', CLEAN_DEG, 'at rest, as it is told', convention, FIRST),
    Check('gyroscope', 'rates_off', GAIN_OFF, 'matrix of the rates off the identity', gyroscope,
          FIRST),
    Check('timing', 'delay_samples', DELAY, 'of the attitude behind the gyroscope', delay, INPUTS),
    Check('timing', 'steps_off', GAIN_OFF, 'turns in steps of 2.5 to 15 ms', steps, INPUTS),
    Check('integration', 'large_turn_off', TURNS_OFF, 'turns of 0.3 rad in a step', large_turns,
          INPUTS),
    Check('accelerometer', 'rest_tilt_deg', CLEAN_DEG, 'of new filters', tilt_at_rest, INPUTS),
    Check('accelerometer', 'tilt_answer', UNEVEN, '1: gravity does not lead a tilt back',
          tilt_answer, (*INPUTS, 'accelerometer')),
    Check('magnetometer', 'rest_heading_deg', CLEAN_DEG, 'of new filters', heading_at_rest,
          (*INPUTS, 'integration', 'accelerometer')),
    Check('magnetometer', 'heading_answer', 0.99, '1: the heading does not follow the field',
          heading_answer, (*ALL, 'integration')),
    Check('bias', 'bias_left', bias.LEFT, 'of the largest effect of a bias, if it is learned',
          effect_of_bias, ALL),
    Check('bias', 'bias_report_off', bias.LEFT, 'of a bias, relative', reported_bias,
          (*ALL, 'integration')),
    Check('accuracy', 'clean_deg', CLEAN_DEG, 'largest error without noise', clean,
          (*ALL, 'integration')),
    Check('lever_arm', 'lever_arm', FOLLOWS, 'share of the tilt of the specific force', lever_arm,
          ALL),
    Check('accuracy', 'noisy_deg', NOISY_DEG, 'rms with noise', noisy, ALL),
    Check('covariance', 'nees_off', 1.0, 'squared error over its covariance', covariance,
          (*ALL, 'integration', 'lever_arm', 'bias')),
)
