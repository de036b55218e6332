# SPDX-License-Identifier: Apache-2.0
"""
How a filter responds to its inputs one by one: turns, gravity and field at rest, a kick, a bias.

The readings have no noise, so a right filter has no error, and what remains has a cause.  A cause
is a hypothesis: its inverse is applied to the readings or the attitudes, and the error disappears.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, excitation, measures, scenarios
from spinning_top_sim.exam.diagnosis import HEADING, TILT, Clean, Fault, degrees
from spinning_top_sim.exam.excitation import Gyroscope, axes, mapped, moved, shifted, words
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import ChangeReadings, Hypothesis, InvalidOutputError, Outcome

BIAS = np.array((0.01, -0.01, 0.02))    # of the gyroscope [rad/s]; its norm is 1.4 deg/s

# Limits of a right filter.
GAIN, GROSS_GAIN = 0.003, 0.25  # by which the gyroscope's matrix differs from the identity
START = 50                      # samples after which a filter that starts has an attitude
SURE = 0.2                      # of the largest error that explains: nothing else is tried
WORST = 30.0                    # condition of a matrix that can be inverted
STAYS = 0.98                    # of a kick
# Of the Gauss-Newton method: differences, relative; steps, and by what the error falls in one.
SMALL, STEPS, LESS = 0.02, 4, 0.7
# Of the effect of a bias is left in the same attitude, without and with a growing estimate.
LEARNED, LEARNING, BIAS_FOUND = 0.5, 0.9, 0.05
NEAR = 0.5                      # error in which a kick is judged [rad]
BIAS_OFF = 0.5                  # by which the reported bias differs, relative
STUCK = np.radians(1.0)         # by which attitudes differ at least

Tried = tuple[Hypothesis, Outcome]


class Responses:
    """
    The responses of one filter.

    Parameters
    ----------
    follow : callable
        Feeds a run to the filter with hypotheses, the last one found first.
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
        self._given = excitation.excite(imu, scenarios.SLOW.rate)
        self._run = excitation.with_kicks(self._given)
        self.faults: list[Fault] = []
        self.undone: list[Hypothesis] = []
        self._harmless: list[Hypothesis] = []
        # Whether an error is left that would be taken for that by a lever arm or a bias.
        self.unclear = False
        self._outcome = self._respond(())

    def identify(self) -> None:
        """Find causes until nothing is left to explain, and undo each."""
        for _ in range(4):
            found = self._cause()
            if found is None:
                break
            before = self._whole(self._outcome)
            one, self._outcome = found
            self.faults += [Fault(name, f'{one.text}, the error falls from {degrees(before)} to '
                                  f'{degrees(self._whole(self._outcome))}; all measures are those '
                                  'after this correction') for name in one.faults]
            (self.undone if {*one.faults} - {'stamp_offset'} else self._harmless).insert(0, one)
            self.unclear |= one.given is excitation.of_world
        before = len(self.faults)
        self._name_the_rest()
        self.unclear |= len(self.faults) > before
        if self.unclear:
            self.faults[-1] = self.faults[-1]._replace(evidence=f'{self.faults[-1].evidence}; '
                                                       'no lever arm and no bias is judged')

    @property
    def clean(self) -> Clean:
        """Errors without noise, after all corrections."""
        return self._clean(self._outcome)

    def _clean(self, outcome: Outcome) -> Clean:
        errors = outcome.errors
        heading = self._absolute * errors.turned(True)
        return Clean(*(rms(error[rows]) for rows in (self._given.rests, self._given.motion)
                       for error in (errors.tilt, heading)))

    def _whole(self, outcome: Outcome) -> float:
        return math.hypot(*self._clean(outcome))

    def _respond(self, more: Sequence[Hypothesis], run: Run | None = None) -> Outcome:
        return self._follow(run or self._run, [*more, *self._harmless, *self.undone])

    def _tried(self, hypotheses: Iterable[Hypothesis]) -> Iterator[Tried]:
        for one in hypotheses:
            with contextlib.suppress(InvalidOutputError):       # the filter rejects the readings
                yield one, (replace(self._outcome, estimates=one.read(self._outcome.estimates))
                            if one.given is None else self._respond((one,)))

    def _gyroscope(self, outcome: Outcome) -> tuple[Gyroscope, Gyroscope]:
        """Return the response to whole turns with its delay, and that to their first samples."""
        return (excitation.gyroscope_of(outcome, self._given.turns, excitation.WHOLE),
                excitation.gyroscope_of(outcome, self._given.turns, excitation.EARLY, 0))

    def _turns_wrong(self, outcome: Outcome) -> bool:
        return min(one.off for one in self._gyroscope(outcome)) > GROSS_GAIN

    def _cause(self) -> Tried | None:
        """Return a hypothesis that explains the error, and the outcome when it is undone."""
        gross = self._turns_wrong(self._outcome)
        if not (gross or self.clean.wrong):
            return None
        limit = diagnosis.EXPLAINED * self._whole(self._outcome)
        for stage in (self._of_attitudes, self._of_delays, self._of_gyroscope,
                      self._of_accelerometer, self._of_magnetometer, self._of_smoothing):
            tried = []
            for one, outcome in stage():
                error = self._whole(outcome)
                if error <= limit or (gross and stage == self._of_gyroscope
                                      and not self._turns_wrong(outcome)):
                    tried.append((error, one, outcome))
                if error <= SURE * limit:
                    break
            least = min((error for error, *_ in tried), default=0.0)
            for error, one, outcome in tried:
                if error <= 1.1 * least:
                    return diagnosis.ambiguous(one, self._absolute), outcome
        return None

    def _of_attitudes(self) -> Iterator[Tried]:
        """Try misreadings of the attitudes, and what the attitudes at rest suggest."""
        estimated, true = (Rotation.from_quat(rows[self._given.rests])
                           for rows in (self._outcome.estimates, self._run.truth))
        in_sensor, in_world = (true.inv() * estimated).mean(), (estimated * true.inv()).mean()
        heading = math.remainder(2.0 * math.atan2(*in_world.as_quat()[2:]), math.tau)
        back = Rotation.from_rotvec((0.0, 0.0, -heading))
        group = Rotation.create_group('O')
        square = group[int(np.argmin((group.inv() * in_sensor).magnitude()))]
        vectors, last = (np.array([np.linalg.norm(one.as_quat()[:, :3], axis=1),
                                   np.abs(one.as_quat()[:, 3])]) for one in (estimated, true))
        scale = max(float(np.median(
            vectors[0] * last[1] / np.maximum(vectors[1] * last[0], 1e-9))), 1e-3)
        return self._tried((
            *diagnosis.READINGS,
            Hypothesis(('frame_ned',), 'read as attitude of axes '
                       f'{axes(square.as_matrix())} of the sensor',
                       read=lambda q: (Rotation.from_quat(q) * square.inv()).as_quat()),
            Hypothesis(('magnetometer_wiring' if abs(heading) > 3.0 else 'heading_offset',),
                       f'turned by {-math.degrees(heading):.3g} deg about the vertical',
                       read=lambda q: (back * Rotation.from_quat(q)).as_quat()),
            Hypothesis(('inaccurate',), f'with the vector part of the attitude divided by '
                       f'{scale:.4g}', read=lambda q: Rotation.from_quat(
                           q / (scale, scale, scale, 1.0)).as_quat())))

    def _of_delays(self) -> Iterator[Tried]:
        """Try delays of the attitudes and the gyroscope, and what is no fault."""
        late = self._gyroscope(self._outcome)[0].late
        part = self._outcome.since(self._given.motion.start)
        offset = measures.time_offset(part.estimates, part.run.truth, part.run.rates,
                                      self._absolute).seconds * scenarios.SLOW.rate
        tried = [*diagnosis.ONE_STEP]
        if not diagnosis.AHEAD <= offset <= diagnosis.DELAYED:
            tried.append(Hypothesis(
                ('stamp_offset',), f'with the attitude {round(offset)} samples earlier',
                read=lambda q: moved(q, round(offset))))
        if late > 0:
            tried.append(Hypothesis(('lag',), f'with the gyroscope {late} samples earlier',
                                    given=shifted(('gyroscope',), late)))
        return self._tried(tried)

    def _of_gyroscope(self) -> Iterator[Tried]:
        """Try the inverse of the matrix that the gyroscope has."""
        whole, early = self._gyroscope(self._outcome)
        if min(whole.off, early.off) < GAIN:
            return
        if min(whole.off, early.off) > GROSS_GAIN:
            yield from self._tried([
                *diagnosis.permuted(
                    'gyroscope', lambda one: -np.sum((one - early.matrix) ** 2), 3),
                *(Hypothesis(('gyroscope_units',), f'with the gyroscope multiplied by {text}',
                             given=mapped('gyroscope', by * np.eye(3))) for text, by in (
                                 ('pi/180', math.radians(1.0)), ('180/pi', math.degrees(1.0)))),
                Hypothesis(('gyroscope_wiring',), 'with rates about axes of the world (a product '
                           'on the wrong side)', given=excitation.of_world)])
        for fit in (early, whole):
            scale = float(np.trace(fit.matrix)) / 3.0
            uniform = np.max(np.abs(fit.matrix - scale * np.eye(3))) < 0.3 * abs(scale - 1.0)
            if uniform and scale > 1.0 / WORST:
                yield from self._tried([Hypothesis(
                    ('gyroscope_wiring', 'time_step'), f'with steps {1.0 / scale:.4g} times as '
                    'long (scales of rates and steps cannot be told apart)',
                    given=partial(excitation.with_steps, 1.0 / scale))])
            if np.linalg.cond(fit.matrix) < WORST:
                yield from self._tried([diagnosis.wired(
                    'gyroscope', f'{words(fit.matrix)}: with the inverse of that',
                    np.linalg.inv(fit.matrix))])

    def _of_accelerometer(self) -> Iterator[Tried]:
        """Try signs, axes and scales of the accelerometer that fit the verticals at rest."""
        if self.clean.tilt < TILT:
            return
        attitudes, rows = self._at_rest()
        estimated, true = (turns.inv().apply((0.0, 0.0, 1.0)) for turns in (
            attitudes, Rotation.from_quat(self._run.truth[rows])))
        name = 'accelerometer'
        units = [diagnosis.wired(name, f'with the {name} multiplied by {by:.4g}', by * np.eye(3))
                 for by in (scenarios.GRAVITY, 1.0 / scenarios.GRAVITY)]
        permuted = diagnosis.permuted(name, lambda one: np.sum(estimated * (true @ one.T)))
        yield from self._tried((diagnosis.GRAVITY_SIGN, *permuted, *units))
        yield from self._affine(name, ((f'{name}_wiring', 4),), scenarios.GRAVITY)

    def _of_magnetometer(self) -> Iterator[Tried]:
        """Try signs and axes of the magnetometer that fit the headings at rest, and irons."""
        if not self._absolute or max(self.clean.tilt, self.clean.heading) < HEADING:
            return
        estimated, rows = self._at_rest()
        field, name = self._run.magnetometer[rows], 'magnetometer'

        def north(one: Reals) -> float:
            there = estimated.apply(field @ one.T)
            return float(np.sum(there[:, 1] / np.hypot(there[:, 0], there[:, 1])))

        yield from self._tried((
            Hypothesis((f'{name}_wiring',), 'with the field of a level sensor',
                       given=excitation.untilted), *diagnosis.permuted(name, north)))
        yield from self._affine(name, (('hard_iron', 1), (f'{name}_wiring', 4)),
                                float(np.linalg.norm(field[0])))

    def _of_smoothing(self) -> Iterator[Tried]:
        """Try delays and low passes of the sensors."""
        for names in (('gyroscope',), ('accelerometer',), ('magnetometer',),
                      ('accelerometer', 'magnetometer')):
            derivatives = self._derivatives([excitation.sharpened(names, 1.0)], self._outcome)
            by, what = float(self._amounts(self._outcome, derivatives)[0]), ' and '.join(names)
            if by > 0.5:
                yield from self._tried((
                    Hypothesis(('lag',), f'with the {what} {round(by)} samples earlier',
                               given=shifted(names, round(by))),
                    Hypothesis(('lag',), f'with the inverse of a low pass of {by:.3g} samples '
                               f'on the {what}', given=excitation.sharpened(names, by))))

    def _at_rest(self) -> tuple[Rotation, NDArray[np.intp]]:
        """Return attitudes at rest, at the end and of filters that start there, and the rows."""
        rests = self._given.rests
        estimated = list(self._outcome.estimates[rests])
        if self._restarts:
            estimated += [self._respond((), self._run.part(slice(row - START, row))).estimates[-1]
                          for row in rests]
        return Rotation.from_quat(estimated), np.resize(rests, len(estimated))

    def _affine(self, name: str, causes: Sequence[tuple[str, int]],
                size: float) -> Iterator[Tried]:
        """
        Try the affine change of a sensor that makes the error least, by the Gauss-Newton method.

        causes : names, and for each the columns of [offset, matrix] that are free
        size : of its readings
        """
        def change(amounts: Reals) -> ChangeReadings:
            columns = amounts.reshape(-1, 3).T
            matrix = columns[:, 1:] if columns.shape[1] > 1 else np.zeros((3, 3))
            return mapped(name, np.eye(3) + matrix, size * columns[:, 0])

        for fault, free in causes:
            outcome, amounts, before = self._outcome, np.zeros(3 * free), math.inf
            for _ in range(STEPS):
                if self._whole(outcome) > LESS * before:
                    break
                before = self._whole(outcome)
                derivatives = self._derivatives([change(amounts + SMALL * one) for one in np.eye(
                    len(amounts))], outcome) / SMALL
                amounts = amounts + self._amounts(outcome, derivatives)
                text = (f'with [offset, matrix] = {np.array2string(amounts, precision=3)} of the '
                        f'readings of the {name} added')
                one = Hypothesis((fault,), text, given=change(amounts))
                for _, outcome in self._tried((one,)):
                    yield one, outcome

    def _derivatives(self, changes: Sequence[ChangeReadings], outcome: Outcome) -> Reals:
        """Return how the attitudes at rest and in motion differ after small changes (m, n)."""
        before = self._turns(outcome)
        return np.stack([(self._turns(outcome) * before.inv()).as_rotvec().ravel()
                         for outcome in (self._respond((Hypothesis((), '', given=one),))
                                         for one in changes)], axis=1)

    def _amounts(self, outcome: Outcome, derivatives: Reals) -> Reals:
        """Return the amounts of the changes that make the error least, if it is linear."""
        true = self._turns(replace(outcome, estimates=outcome.run.truth))
        error = self._turns(outcome) * true.inv()
        amounts: Reals = -np.linalg.lstsq(derivatives, error.as_rotvec().ravel(), rcond=1e-3)[0]
        return amounts

    def _turns(self, outcome: Outcome) -> Rotation:
        return Rotation.from_quat(outcome.estimates[np.concatenate((self._given.rests, np.arange(
            self._given.motion.start, self._given.motion.stop, 10)))])

    def _name_the_rest(self) -> None:
        """Name what no hypothesis explains by where it shows."""
        left = self.clean
        whole, early = self._gyroscope(self._outcome)
        turns = Rotation.from_quat(self._outcome.estimates)
        if np.max((turns * turns[0].inv()).magnitude()) < STUCK:
            self.faults.append(Fault('inaccurate', 'the attitude hardly changes'))
        elif min(whole.off, early.off) > GROSS_GAIN:
            self.faults.append(Fault('gyroscope_wiring', words(early.matrix)))
        elif left.wrong and whole.late > 1:
            self.faults.append(Fault('lag', f'turns are followed {whole.late} samples late; '
                                     f'{left}'))
        elif not self._judge_kicks() and left.wrong:
            self.faults.append(Fault('inaccurate', f'{left}: no cause explains it'))

    def _judge_kicks(self) -> bool:
        """Name what does not return after a kick of the gyroscope alone; return whether."""
        named = len(self.faults)
        names = self._not_corrected(self._run.truth)
        if names:       # compared with a run without kicks, as there may be another error
            without = self._respond((), self._given.run).estimates
            first, _ = self._given.kicks
            error = Rotation.from_quat(without[first]).inv() * Rotation.from_quat(
                self._run.truth[first])
            # Far from the truth no filter is linear.
            names = self._not_corrected(without) if error.magnitude() < NEAR else {}
        for name, (what, left) in names.items():
            if self._absolute or what == 'tilt':
                self.faults.append(Fault(
                    f'{name}_wiring', f'{left:.0%} of an error of the {what} are left after '
                    f'{excitation.ANSWER_S:g} s: the {name} does not correct it'))
        return len(self.faults) > named

    def _not_corrected(self, without: Reals) -> dict[str, tuple[str, float]]:
        """Return the sensors that leave a kick, what they should correct, and what is left."""
        n = round(excitation.ANSWER_S * scenarios.SLOW.rate)
        error = (Rotation.from_quat(self._outcome.estimates)
                 * Rotation.from_quat(without).inv()).as_rotvec()
        up, down = ((error[first + excitation.LATEST] - error[first - 1], error[first + n - 1]
                     - error[first - 1]) for first in self._given.kicks)
        begin, end = (0.5 * (one - other) for one, other in zip(up, down, strict=True))
        found = {}
        for name, what, part in (('accelerometer', 'tilt', slice(2)),
                                 ('magnetometer', 'heading', slice(2, 3))):
            left = rms(end[part]) / max(rms(begin[part]), 1e-6)
            if left > STAYS:
                found[name] = what, left
        return found

    def bias(self) -> tuple[dict[str, float], Fault | None]:
        """Judge the effect of a gyroscope bias; return measures and the fault."""
        late, learned, found = self._with_bias()
        size, known = float(np.linalg.norm(BIAS)), bool(np.isfinite(found[0]))
        share = float(found @ BIAS) / size ** 2
        measured = {'bias_error_s': late, 'bias_found': share}
        left = late > diagnosis.BIAS_LEFT_S
        if left and not learned:
            return measured, Fault(
                'no_bias_estimate', 'with a gyroscope bias of 1 deg/s the '
                f'{"attitude" if self._absolute else "tilt"} is {late:.3g} deg off in the end: '
                'the bias is not learned')
        right = (-BIAS_FOUND < share < 1.0 / BIAS_OFF if left else
                 np.linalg.norm(found - BIAS) < BIAS_OFF * size)
        if right or not known:
            return measured, None
        return measured, Fault(
            'bias_report', f'a gyroscope bias of {np.degrees(BIAS).round(2).tolist()} deg/s is '
            f'learned, but the estimate is {np.degrees(found).round(2).tolist()} deg/s')

    def _with_bias(self) -> tuple[float, bool, Reals]:
        """Return the effect in the end [s], whether it is being learned, and the estimate."""
        motion, size = self._given.motion, float(np.linalg.norm(BIAS))
        run = self._run.part(slice(motion.stop))
        if self._harmless:
            self._harmless, self._outcome = [], self._follow(self._run, self.undone)
        outcome = self._respond((), replace(run, gyroscope=run.gyroscope + BIAS))
        one, other = (Rotation.from_quat(rows[:motion.stop])
                      for rows in (outcome.estimates, self._outcome.estimates))
        if self._absolute:
            apart = (one * other.inv()).magnitude()
        else:
            verticals = [turn.inv().apply((0.0, 0.0, 1.0)) for turn in (one, other)]
            apart = np.linalg.norm(verticals[0] - verticals[1], axis=1)
        estimates = outcome.biases - self._outcome.biases[:motion.stop]
        estimates = estimates[np.isfinite(estimates[:, 0])]
        if not len(estimates):
            estimates = np.full((1, 3), math.nan)
        part = (estimates[[-1, len(estimates) // 4]] @ BIAS).tolist()
        first, again = apart[self._given.rests[[0, -2]]].tolist()
        learned = again < LEARNED * first or (
            again < LEARNING * first and part[0] > max(BIAS_FOUND * size ** 2, 1.2 * part[1]))
        return rms(apart[motion]) / size, bool(learned), estimates[-1]
