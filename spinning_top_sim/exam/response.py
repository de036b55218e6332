# SPDX-License-Identifier: Apache-2.0
"""
How a filter answers its inputs one by one: turns, gravity and the field at rest, a kick, a bias.

The readings have no noise, so a right filter has no error, and what remains has a cause.  A cause
is a hypothesis: the filter is fed, or read, so that it would be right, and the error disappears.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import measures, scenarios
from spinning_top_sim.exam.course import (
    ANSWER_S,
    EARLY,
    HEADING,
    LATEST,
    TILT,
    WHOLE,
    Clean,
    Gyroscope,
    axes,
    course,
    gyroscope_of,
    mapped,
    moved,
    of_world,
    rows_of,
    shifted,
    unit,
    untilted,
    with_iron,
    words,
)
from spinning_top_sim.exam.diagnosis import (
    AHEAD,
    BIAS_LEFT_S,
    DELAYED,
    EXPLAINED,
    GRAVITY_SIGN,
    READINGS,
    Fault,
    Hypothesis,
    degrees,
    told,
)
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import ChangeReadings, InvalidOutputError, Outcome

BIAS = np.array((0.01, -0.01, 0.02))    # of the gyroscope [rad/s]; its norm is 1.4 deg/s

# Limits; docs/exam.md compares them with the values of filters.
SCATTER = 0.05                  # share of squared increments that a good matrix leaves
GAIN, GROSS_GAIN = 0.03, 0.25   # by which the gyroscope's matrix differs from the identity
LIKELY = 6                      # signed permutations of a sensor that are tried
START = 50                      # samples after which a filter that starts has an attitude
SURE = 0.2                      # of the largest error that explains: nothing else is tried
WORST = 30.0                    # condition of a matrix that can be undone
STAYS = 0.98                    # of a kick
# Of the effect of a bias is left in the same attitude, without and with a growing estimate.
LEARNED, LEARNING, BIAS_FOUND = 0.5, 0.9, 0.05
LEVI_CIVITA = np.cross(np.eye(3)[:, np.newaxis], np.eye(3)).transpose(2, 0, 1)
BIAS_OFF = 0.5                  # by which the reported bias differs, relative

SIGNED = [np.array(signs)[:, np.newaxis] * np.eye(3)[list(order)]
          for order in itertools.permutations(range(3))
          for signs in itertools.product((1.0, -1.0), repeat=3)][1:]
ONE_STEP = (        # no fault: the filter corrects before it takes the step
    Hypothesis((), 'corrected before the step',
               given=shifted(('accelerometer', 'magnetometer'), -1)),
    Hypothesis((), 'a step ahead', read=lambda q: moved(q, -1)))

Tried = tuple[Hypothesis, Outcome]


def wired(sensor: str, text: str, matrix: Any) -> Hypothesis:
    """Return the hypothesis that the readings of a sensor need this matrix."""
    return Hypothesis((f'{sensor}_wiring',), text, given=mapped(sensor, matrix))


def permuted(sensor: str, likely: Sequence[Reals], count: int) -> list[Hypothesis]:
    """Return the hypotheses that the filter has these signed permutations of a sensor."""
    return [wired(sensor, f'with {axes(one.T)} of the {sensor} for its x, y, z', one.T)
            for one in likely[:count]]


class Responses:
    """
    The answers of one filter.

    Parameters
    ----------
    follow : callable
        Feeds a run to the filter with a change and hypotheses, the last one found first.
    imu : mapping
        Its place and field count.
    absolute : bool
        Whether the heading can be judged.
    restarts : bool
        Whether each run has a new filter.
    """

    def __init__(self, follow: Callable[[Run, Sequence[Hypothesis]], Outcome],
                 imu: Mapping[str, Any], absolute: bool, restarts: bool) -> None:
        self._follow, self._absolute, self._restarts = follow, absolute, restarts
        self.course = course(imu, scenarios.SLOW.rate)
        self.faults: list[Fault] = []
        self.undone: list[Hypothesis] = []
        self._harmless: list[Hypothesis] = []
        # Whether an error is left that would be taken for that by a lever arm or a bias.
        self.unclear = False
        self.outcome = self._answer(())

    def identify(self) -> None:
        """Find causes until nothing is left to explain, and undo each."""
        for _ in range(4):
            found = self._cause()
            if found is None:
                break
            before = self._whole(self.outcome)
            one, self.outcome = found
            self.faults += [Fault(name, f'{one.text}, the error falls from {degrees(before)} to '
                                  f'{degrees(self._whole(self.outcome))}; all measures are those '
                                  'after this correction') for name in one.faults]
            kept = self.undone if set(one.faults) - {'stamp_offset'} else self._harmless
            kept.insert(0, one)
            self.unclear |= one.given is of_world
        before = len(self.faults)
        self._name_the_rest()
        self.unclear |= len(self.faults) > before
        if self.unclear:
            self.faults[-1] = self.faults[-1]._replace(evidence=f'{self.faults[-1].evidence}; '
                                                       'no lever arm and no bias is judged')

    def clean(self, outcome: Outcome) -> Clean:
        """Return the errors on the course."""
        errors = outcome.errors
        rests, motion = self.course.rests, self.course.motion
        heading = errors.turned(True)
        return Clean(rms(errors.tilt[rests]), rms(heading[rests]) * self._absolute,
                     rms(errors.tilt[motion]), rms(heading[motion]) * self._absolute)

    def _whole(self, outcome: Outcome) -> float:
        return math.hypot(*self.clean(outcome))

    def _answer(self, more: Sequence[Hypothesis], run: Run | None = None) -> Outcome:
        return self._follow(run or self.course.run, [*more, *self._harmless, *self.undone])

    def _tried(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Tried]:
        for one in hypotheses:
            with contextlib.suppress(InvalidOutputError):       # the filter rejects the readings
                yield one, (replace(self.outcome, estimates=one.read(self.outcome.estimates))
                            if one.given is None else self._answer((one,)))

    def gyroscope(self, outcome: Outcome) -> tuple[Gyroscope, Gyroscope]:
        """Return the answer to whole turns with its delay, and that to their first samples."""
        return (gyroscope_of(outcome, self.course.turns, WHOLE),
                gyroscope_of(outcome, self.course.turns, EARLY, 0))

    def _turns_wrong(self, outcome: Outcome, limit: float) -> bool:
        return min(one.off for one in self.gyroscope(outcome)) > limit

    def _cause(self) -> Tried | None:
        """Return a hypothesis that explains the error, and the outcome when it is undone."""
        if not self.clean(self.outcome).wrong and not self._turns_wrong(self.outcome, GAIN):
            return None
        limit = EXPLAINED * self._whole(self.outcome)
        for stage in (self._of_attitudes, self._of_delays, self._of_gyroscope,
                      self._of_accelerometer, self._of_axes, self._of_field, self._of_inputs):
            gross = stage == self._of_gyroscope and self._turns_wrong(self.outcome, GROSS_GAIN)
            tried = []
            for one, outcome in stage():
                error = self._whole(outcome)
                if error <= limit or (gross and not self._turns_wrong(outcome, GROSS_GAIN)):
                    tried.append((error, one, outcome))
                if error <= SURE * limit:
                    break
            least = min((error for error, *_ in tried), default=0.0)
            for error, one, outcome in tried:
                if error <= 1.1 * least:
                    return told(one, self._absolute), outcome
        return None

    def _of_attitudes(self) -> Iterator[Tried]:
        """Try misreadings of the attitudes, and what the attitudes at rest suggest."""
        said, true = (Rotation.from_quat(rows[self.course.rests])
                      for rows in (self.outcome.estimates, self.outcome.run.truth))
        in_sensor, in_world = (true.inv() * said).mean(), (said * true.inv()).mean()
        heading = 2.0 * math.atan2(*in_world.as_quat()[2:])
        back = Rotation.from_rotvec((0.0, 0.0, -heading))
        group = Rotation.create_group('O')
        square = group[int(np.argmin((group.inv() * in_sensor).magnitude()))]
        vectors, last = (np.array([np.linalg.norm(one.as_quat()[:, :3], axis=1),
                                   np.abs(one.as_quat()[:, 3])]) for one in (said, true))
        scale = max(float(np.median(
            vectors[0] * last[1] / np.maximum(vectors[1] * last[0], 1e-9))), 1e-3)
        return self._tried((
            *READINGS,
            Hypothesis(('frame_ned',), 'read as attitude of axes '
                       f'{axes(square.as_matrix())} of the sensor',
                       read=lambda q: (Rotation.from_quat(q) * square.inv()).as_quat()),
            Hypothesis(('magnetometer_wiring' if abs(heading) > 3.0 else 'heading_offset',),
                       f'turned by {-math.degrees(heading):.3g} deg about the vertical',
                       read=lambda q: (back * Rotation.from_quat(q)).as_quat()),
            Hypothesis(('inaccurate',), f'with the vector part of the attitude divided by '
                       f'{scale:.4g}', read=lambda q: unit(q / (scale, scale, scale, 1.0)))))

    def _of_gyroscope(self) -> Iterator[Tried]:
        """Try the inverse of the matrix that the gyroscope has."""
        whole, early = self.gyroscope(self.outcome)
        if min(whole.off, early.off) < GAIN:
            return iter(())
        fit = whole if whole.scatter < SCATTER else early
        scale = float(np.trace(fit.matrix)) / 3.0
        uniform = bool(np.max(np.abs(fit.matrix - scale * np.eye(3))) < 0.3 * abs(scale - 1.0))
        tried = []
        if min(whole.off, early.off) > GROSS_GAIN:
            tried = permuted('gyroscope', sorted(
                SIGNED, key=lambda one: float(np.sum((one - fit.matrix) ** 2))), 3)
            tried += [Hypothesis(
                ('gyroscope_units',), f'with the gyroscope multiplied by {text}',
                given=mapped('gyroscope', by * np.eye(3))) for text, by in (
                    ('pi/180', math.radians(1.0)), ('180/pi', math.degrees(1.0)))]
            tried.append(Hypothesis(
                ('gyroscope_wiring',), 'with rates about axes of the world (a product on the '
                'wrong side)', given=of_world))
        if np.linalg.cond(fit.matrix) < WORST:
            tried.append(Hypothesis(
                ('gyroscope_wiring', 'time_step') if uniform else ('gyroscope_wiring',),
                f'{words(fit.matrix)}: with the inverse of that'
                + ' (a scale of the rates and one of the step cannot be told apart)' * uniform,
                given=mapped('gyroscope', np.linalg.inv(fit.matrix))))
        return self._tried(tried)

    def _of_accelerometer(self) -> Iterator[Tried]:
        """Try signs, axes and scales of the accelerometer that fit the verticals at rest."""
        if self.clean(self.outcome).tilt < TILT:
            return iter(())
        attitudes, rows = self._at_rest()
        said, true = (turns.inv().apply((0.0, 0.0, 1.0)) for turns in (
            attitudes, Rotation.from_quat(self.course.run.truth[rows])))
        name = 'accelerometer'
        likely = sorted(SIGNED, key=lambda one: -float(np.sum(said * (true @ one.T))))
        tried = [GRAVITY_SIGN, *permuted(name, likely, LIKELY)]
        for part in np.array_split(np.arange(len(rows)), 2 if self._restarts else 1)[::-1]:
            # said x (matrix true) = 0
            products = np.einsum('ijk,nj,nl->nikl', LEVI_CIVITA, said[part], true[part])
            matrix = np.linalg.svd(products.reshape(-1, 9))[2][-1].reshape(3, 3)
            matrix *= 3.0 ** 0.5 * np.sign(np.sum(said * (true @ matrix.T)))
            if np.linalg.cond(matrix) < WORST:
                tried.append(wired(name, f'with the inverse of {rows_of(matrix)} on the {name}',
                                   np.linalg.inv(matrix)))
        return self._tried((*tried, *(
            wired(name, f'with the {name} multiplied by {by:.4g}', by * np.eye(3))
            for by in (scenarios.GRAVITY, 1.0 / scenarios.GRAVITY))))

    def _at_rest(self) -> tuple[Rotation, NDArray[np.intp]]:
        """Return attitudes at rest, at the end and of filters that start there, and the rows."""
        rests = self.course.rests
        said = list(self.outcome.estimates[rests])
        if self._restarts:
            said += [self._answer((), self.course.run.part(slice(row - START, row))).estimates[-1]
                     for row in rests]
        return Rotation.from_quat(said), np.resize(rests, len(said))

    def _of_axes(self) -> Iterator[Tried]:
        """Try signs and axes of the magnetometer that fit the headings at rest best."""
        before, name = self.clean(self.outcome), 'magnetometer'
        if not self._absolute or max(before.tilt, before.heading) < HEADING:
            return iter(())
        said, rows = self._at_rest()
        field = self.course.run.magnetometer[rows]

        def north(one: Reals) -> float:
            there = said.apply(field @ one.T)
            return float(np.sum(there[:, 1] / np.hypot(there[:, 0], there[:, 1])))

        return self._tried((
            Hypothesis((f'{name}_wiring',), 'with the field of a level sensor', given=untilted),
            *permuted(name, sorted(SIGNED, key=north, reverse=True), LIKELY)))

    def _of_field(self) -> Iterator[Tried]:
        """Try a hard iron, scales and units of the magnetometer."""
        before, name = self.clean(self.outcome), 'magnetometer'
        if not self._absolute or max(before.tilt, before.heading) < HEADING:
            return
        iron = self._fitted([partial(with_iron, one) for one in np.eye(3)])
        scale = 1.0 + 0.02 * self._fitted([mapped(name, np.eye(3) + 0.02 * np.diag(one))
                                           for one in np.eye(3)[:2]])
        yield from self._tried((
            Hypothesis(('hard_iron',), f'with {", ".join(f"{value:.3g}" for value in iron)} uT '
                       f'added to the {name}', given=partial(with_iron, iron)),
            wired(name, f'with x, y of the {name} multiplied by '
                  f'{", ".join(f"{value:.3g}" for value in scale)}', np.diag((*scale, 1.0)))))

    def _of_delays(self) -> Iterator[Tried]:
        """Try delays of the attitudes and the gyroscope, and what is no fault."""
        late = self.gyroscope(self.outcome)[0].late
        part = self.outcome.since(self.course.motion.start)
        offset = measures.time_offset(part.estimates, part.run.truth, part.run.rates,
                                      self._absolute).seconds * scenarios.SLOW.rate
        tried = [*ONE_STEP]
        if not AHEAD <= offset <= DELAYED:
            tried.append(Hypothesis(
                ('stamp_offset',), f'with the attitude {round(offset)} samples earlier',
                read=lambda q: moved(q, round(offset))))
        if late > 0:
            tried.append(Hypothesis(('lag',), f'with the gyroscope {late} samples earlier',
                                    given=shifted(('gyroscope',), late)))
        return self._tried(tried)

    def _of_inputs(self) -> Iterator[Tried]:
        """Try delays of the other sensors."""
        for names in (('accelerometer',), ('magnetometer',), ('accelerometer', 'magnetometer')):
            by = 2.0 * float(self._fitted([shifted(names, 2)])[0])
            if by > 0.5:
                yield from self._tried([Hypothesis(
                    ('lag',), f'with the {" and ".join(names)} {round(by)} samples earlier',
                    given=shifted(names, round(by)))])

    def _fitted(self, changes: Sequence[ChangeReadings]) -> Reals:
        """Return by how much of each small change the error becomes least, if it is linear."""
        rows = np.concatenate((self.course.rests, np.arange(
            self.course.motion.start, self.course.motion.stop, 10)))
        said = Rotation.from_quat(self.outcome.estimates[rows])
        error = (said * Rotation.from_quat(self.outcome.run.truth[rows]).inv()).as_rotvec().ravel()
        answers = [
            (Rotation.from_quat(self._answer((Hypothesis((), '', given=one),)).estimates[rows])
             * said.inv()).as_rotvec().ravel() for one in changes]
        amounts: Reals = -np.linalg.lstsq(np.stack(answers, axis=1), error, rcond=None)[0]
        return amounts

    def _name_the_rest(self) -> None:
        """Name what no hypothesis explains by where it shows."""
        left = self.clean(self.outcome)
        whole, early = self.gyroscope(self.outcome)
        text = (f'without noise the error at rest is {degrees(left.tilt)} of tilt and '
                f'{degrees(left.heading)} of heading, in motion {degrees(left.tilt_moving)} and '
                f'{degrees(left.heading_moving)}')
        if min(whole.off, early.off) > GROSS_GAIN:
            self.faults.append(Fault('gyroscope_wiring', words(early.matrix)))
        elif left.wrong and whole.late > 1:
            self.faults.append(Fault('lag', f'turns are followed {whole.late} samples late; '
                                     + text))
        elif not self._judge_kicks() and left.wrong:
            self.faults.append(Fault('inaccurate', f'{text}: no cause explains it'))

    def _judge_kicks(self) -> bool:
        """Name what does not return after a kick of the gyroscope alone; return whether."""
        named, n = len(self.faults), round(ANSWER_S * scenarios.SLOW.rate)
        error = (Rotation.from_quat(self.outcome.estimates)
                 * Rotation.from_quat(self.outcome.run.truth).inv()).as_rotvec()
        up, down = ((error[first + LATEST] - error[first - 1], error[first + n - 1]
                     - error[first - 1]) for first in self.course.kicks)
        begin, end = (0.5 * (one - other) for one, other in zip(up, down, strict=True))
        for name, sensor, what, part in (
                ('accelerometer_wiring', 'accelerometer', 'tilt', slice(2)),
                ('magnetometer_wiring', 'magnetometer', 'heading', slice(2, 3))):
            left = rms(end[part]) / max(rms(begin[part]), 1e-6)
            if left > STAYS and (self._absolute or what == 'tilt'):
                self.faults.append(Fault(
                    name, f'{left:.0%} of an error of the {what} are left after {ANSWER_S:g} s: '
                    f'the {sensor} does not correct it'))
        return len(self.faults) > named

    def bias(self) -> tuple[dict[str, float], Fault | None]:
        """Judge the effect of a gyroscope bias; return measures and the fault."""
        late, learned, found = self._with_bias(BIAS)
        size, known = float(np.linalg.norm(BIAS)), bool(np.isfinite(found[0]))
        measured = {'bias_error_s': late, 'bias_found': float(found @ BIAS) / size ** 2}
        if late <= BIAS_LEFT_S or learned:
            if not known or late > BIAS_LEFT_S or np.linalg.norm(found - BIAS) < BIAS_OFF * size:
                return measured, None
            return measured, Fault(
                'bias_report', 'the effect of a gyroscope bias of '
                f'{np.degrees(BIAS).round(2).tolist()} deg/s disappears, but the estimate is '
                f'{np.degrees(found).round(2).tolist()} deg/s')
        text = (f'with a gyroscope bias of 1 deg/s the {"attitude" if self._absolute else "tilt"} '
                f'is {late:.3g} deg off in the end: the bias is not learned')
        if known:
            text += f', and the estimate has {measured["bias_found"]:.1%} of the bias'
            small = self._with_bias(0.05 * BIAS)
            if small[0] <= BIAS_LEFT_S or small[1]:
                text += '; one twenty times as small is learned, so the estimate is limited'
        return measured, Fault('no_bias_estimate', text)

    def _with_bias(self, bias: Reals) -> tuple[float, bool, Reals]:
        """Return the effect in the end [s], whether it is being learned, and the estimate."""
        motion = self.course.motion
        run = self.course.run.part(slice(motion.stop))
        if self._harmless:
            self._harmless, self.outcome = [], self._follow(self.course.run, self.undone)
        outcome = self._answer((), replace(run, gyroscope=run.gyroscope + bias))
        one, other = (Rotation.from_quat(said.estimates[:motion.stop])
                      for said in (outcome, self.outcome))
        if self._absolute:
            apart = (one * other.inv()).magnitude()
        else:
            verticals = [turn.inv().apply((0.0, 0.0, 1.0)) for turn in (one, other)]
            apart = np.linalg.norm(verticals[0] - verticals[1], axis=1)
        size = float(np.linalg.norm(bias))
        estimates = outcome.biases - self.outcome.biases[:motion.stop]
        estimates = estimates[np.isfinite(estimates[:, 0])]
        if not len(estimates):
            estimates = np.full((1, 3), math.nan)
        found: Reals = estimates[-1]
        part = (estimates[[-1, len(estimates) // 4]] @ bias).tolist()
        first, again = apart[self.course.rests[[0, -2]]].tolist()
        learned = again < LEARNED * first or (
            again < LEARNING * first and part[0] > max(BIAS_FOUND * size ** 2, 1.2 * part[1]))
        return rms(apart[motion]) / size, bool(learned), found
