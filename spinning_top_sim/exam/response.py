# SPDX-License-Identifier: Apache-2.0
"""
How a filter responds to its inputs one by one: turns, gravity and field at rest, a kick, a bias.

The readings have no noise, so a right filter has no error, and what remains has a cause.  A cause
is a hypothesis: its inverse is applied to the readings or the attitudes, and the error disappears.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, excitation, hypotheses, measures, scenarios
from spinning_top_sim.exam.diagnosis import HEADING, TILT, degrees
from spinning_top_sim.exam.excitation import from_identity, gyroscope_of, words
from spinning_top_sim.exam.hypotheses import (
    Hypothesis,
    axes,
    changed,
    delayed,
    moved,
    permuted,
    sharpened,
    wired,
)
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Findings
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.subject import Subject
from spinning_top_sim.exam.trial import InvalidOutputError, Outcome
from spinning_top_sim.tools.verdict import Fault

BIAS = np.array((0.01, -0.01, 0.02))    # of the gyroscope [rad/s]; its norm is 1.4 deg/s
# Errors of a right filter: tilt and heading at rest, then in motion, rms [rad].
CLEAN = np.array((TILT, HEADING, TILT, HEADING))
# The largest entry of the gyroscope's matrix less the identity: what is looked into, and what is
# too much for any other error to be judged; unless filters that start at rest have this error.
GAIN, GROSS_GAIN, GROSS_REST = 0.003, 0.25, np.radians(10.0)
START = 50                      # samples after which a filter that starts has an attitude
SURE = 0.2                      # share of the limit of an explanation: nothing else is tried
LAG_LEAVES = 0.1                # most of the error, after a delay or a low pass is undone
WORST = 30.0                    # condition of a matrix that can be inverted
EARLY_RESTS = slice(2, 5)       # rests of a short run, when the error of the start is over
NEAR = 0.5                      # largest error without a kick with which a kick is judged [rad]
STUCK = np.radians(1.0)         # attitudes that differ less are always the same
# The search for the affine change of a sensor, or for its delay.
FITS = 0.1                      # share of the error at rest that a good fit leaves
STEPS, LITTLE = 4, 0.05         # the last step changes it by less than this share
LESS = 0.7                      # a step that leaves more of the whole error is the last one
# A bias counts as learned if at most LEARNED of its first effect is left in the same attitude
# later; LEARNING suffices if the estimate that the filter reports grows.
LEARNED, LEARNING = 0.5, 0.9
BIAS_FOUND = 0.05               # share of the bias in the estimate that is more than none
BIAS_OFF = 0.5                  # relative error of an estimate that is wrong
UNDONE = '; all measures but those of the field are those after this correction'

Tried = tuple[Hypothesis, Outcome]


class Response:
    """
    The response of a filter to the excitation; `findings` takes its faults and measures.

    absolute : whether the heading is judged
    undone : inverses of the causes that were found, for other runs
    shifts : those of time, such as of a filter that corrects before its step
    early : response to the begin of turns (3, 3), the identity for a right filter
    unclear : whether an error is left that would be taken for that by a lever arm or a bias
    """

    def __init__(self, subject: Subject, absolute: bool, findings: Findings) -> None:
        self._subject, self._absolute, self._findings = subject, absolute, findings
        self.undone: list[Hypothesis] = []
        self.shifts: list[Hypothesis] = []
        self.early, self.unclear = np.eye(3), False
        self._excitation = excitation.excite(subject.imu, subject.restarts)
        self._run, self._rests = self._excitation.run, self._excitation.rests

    def identify(self) -> None:
        """
        Find causes until nothing is left to explain, and undo each.

        Raises InvalidOutputError if the filter fails.
        """
        self._outcome = self.respond()
        for _ in range(4):
            best = self._cause()
            if best is None:
                break
            before = self._error(self._outcome)
            one, self._outcome = best
            is_shift = {*one.faults} <= {'stamp_offset'}
            self._findings.faults += [
                Fault(name, f'{one.text}, the error falls from {degrees(before)} to '
                      f'{degrees(self._error(self._outcome))}{"" if is_shift else UNDONE}')
                for name in one.faults]
            (self.shifts if is_shift else self.undone).insert(0, one)
            self.unclear |= one.given is hypotheses.of_world
        clean = np.degrees(self._errors(self._outcome))
        self._findings.measures |= {'tilt_clean_deg': float(max(clean[::2])),
                                 'heading_clean_deg': float(max(clean[1::2]))}
        others = self._unexplained()
        # A heading that nothing corrects is any.
        if 'magnetometer_wiring' in [fault.name for fault in others]:
            self._findings.drop('heading_offset')
        faults = self._findings.faults = [*self._findings.faults, *others]
        self.unclear |= bool(others)
        if self.unclear:
            faults[-1] = faults[-1]._replace(
                evidence=f'{faults[-1].evidence}; no lever arm and no bias is judged')

    def _errors(self, outcome: Outcome, *places: Any) -> Reals:
        """Return errors of tilt and heading, by default at rest, then in motion, rms [rad]."""
        errors = outcome.errors
        heading = self._absolute * errors.heading
        return np.array([rms(error[rows])
                         for rows in places or (self._rests, self._excitation.motion)
                         for error in (errors.tilt, heading)])

    def _error(self, outcome: Outcome, *places: Any) -> float:
        return float(np.linalg.norm(self._errors(outcome, *places)))

    def respond(self, more: Sequence[Hypothesis] = (), run: Run | None = None) -> Outcome:
        """Return the outcome of a run, by default the excitation; all that is found is undone."""
        return self._subject.follow(run or self._run, [*more, *self.shifts, *self.undone])

    def _try(self, *hypotheses: Hypothesis, screened: bool = True) -> Iterator[Tried]:
        """Yield the hypotheses with their outcomes; `screened` leaves out what is in vain."""
        for one in hypotheses:
            with contextlib.suppress(InvalidOutputError):       # the filter rejects the readings
                if one.given is None:
                    yield one, replace(self._outcome, estimates=one.read(self._outcome.estimates))
                elif not (screened and self._subject.restarts and self._in_vain(one)):
                    yield one, self.respond((one,))

    def _in_vain(self, one: Hypothesis) -> bool:
        """Return whether a short run has the error of early rests still: a long one would, too."""
        rests = self._rests[EARLY_RESTS]
        short = self.respond((one,), self._run.part(slice(rests[-1] + 1)))
        before, after = (self._error(outcome, rests) for outcome in (self._outcome, short))
        return before > HEADING and after > LESS * before

    def _turns_wrong(self, outcome: Outcome) -> bool:
        return from_identity(*gyroscope_of(outcome, self._excitation.turns)[:2]) > GROSS_GAIN

    def _cause(self) -> Tried | None:
        """
        Return a hypothesis that explains the error, and the outcome when it is undone.

        What would look like another cause is tried before that one.
        """
        gross = self._turns_wrong(self._outcome)
        if not (gross or np.any(self._errors(self._outcome) > CLEAN)):
            return None
        whole, early, late = gyroscope_of(self._outcome, self._excitation.turns)
        return (self._best(self._of_attitudes()) or self._best(self._of_delays(late))
                or self._best(self._of_gyroscope(whole, early), mends_turns=gross)
                or self._best(self._of_sensor('accelerometer', 2, (0, 1), hypotheses.GRAVITY_SIGN))
                or self._best(self._of_sensor('magnetometer', 1, (0,), hypotheses.LEVEL))
                or self._best(self._of_smoothing(), LAG_LEAVES))

    def _best(self, tried: Iterator[Tried], share: float = diagnosis.EXPLAINED,
              mends_turns: bool = False) -> Tried | None:
        """Return the one that leaves least, if it explains the error or mends wrong turns."""
        limit, least, best = share * self._error(self._outcome), math.inf, None
        for one, outcome in tried:
            error = self._error(outcome)
            if error < least and (error <= limit or (
                    mends_turns and not self._turns_wrong(outcome))):
                least, best = error, (hypotheses.ambiguous(one, self._absolute), outcome)
            if error <= SURE * limit:
                break
        return best

    def _of_attitudes(self) -> Iterator[Tried]:
        """Try misreadings of the attitudes, and what the attitudes at rest suggest."""
        estimated, true = (Rotation.from_quat(rows[self._rests])
                           for rows in (self._outcome.estimates, self._run.truth))
        in_sensor, in_world = (true.inv() * estimated).mean(), (estimated * true.inv()).mean()
        heading = 2.0 * math.atan2(*in_world.as_quat(canonical=True)[2:])
        back = Rotation.from_rotvec((0.0, 0.0, -heading))
        group = Rotation.create_group('O')
        square = group[int(np.argmin((group.inv() * in_sensor).magnitude()))]
        tangents = [np.tan(0.5 * turns.magnitude()) for turns in (estimated, true)]
        scale = max(float(np.median(tangents[0] / np.maximum(tangents[1], 1e-9))), 1e-3)
        return self._try(
            *hypotheses.MISREADINGS,
            Hypothesis(('frame_ned',), 'read as attitude of axes '
                       f'{axes(square.as_matrix())} of the sensor',
                       read=lambda q: (Rotation.from_quat(q) * square.inv()).as_quat()),
            Hypothesis(('magnetometer_wiring' if abs(heading) > 3.0 else 'heading_offset',),
                       f'turned by {-math.degrees(heading):.3g} deg about the vertical',
                       read=lambda q: (back * Rotation.from_quat(q)).as_quat()),
            Hypothesis(('inaccurate',), f'with the vector part of the attitude divided by '
                       f'{scale:.4g}', read=lambda q: Rotation.from_quat(
                           q / (scale, scale, scale, 1.0)).as_quat()))

    def _of_delays(self, late: int) -> Iterator[Tried]:
        """Try delays of the attitudes and the gyroscope, and what is no fault."""
        offset = scenarios.SLOW.rate * diagnosis.offset_of(
            self._outcome.part(self._excitation.motion), self._absolute).seconds
        yield from self._try(         # the filter corrects before it takes the step
            hypotheses.CORRECTS_FIRST,
            Hypothesis((), 'a step ahead', read=lambda q: moved(q, -1)))
        if not diagnosis.AHEAD <= offset <= diagnosis.DELAYED:
            yield from self._try(Hypothesis(
                ('stamp_offset',), f'with the attitude {round(offset)} samples earlier',
                read=lambda q: moved(q, round(offset))))
        if late > 0:
            yield from self._try(delayed(('gyroscope',), late))

    def _of_gyroscope(self, whole: Reals, early: Reals) -> Iterator[Tried]:
        """Try the inverse of the matrix that the gyroscope has."""
        if from_identity(whole, early) < GAIN:
            return
        if from_identity(whole, early) > GROSS_GAIN:
            yield from self._try(         # judged by the turns
                *permuted('gyroscope', lambda one: -np.sum((one - early) ** 2)),
                *(wired('gyroscope', f'with the gyroscope multiplied by {text}', by * np.eye(3),
                        fault='gyroscope_units') for text, by in (
                            ('pi/180', math.radians(1.0)), ('180/pi', math.degrees(1.0)))),
                Hypothesis(('gyroscope_wiring',), 'with rates about axes of the world (a product '
                           'on the wrong side)', given=hypotheses.of_world), screened=False)
        for kind, matrix in (1, early), (0, whole):
            scale = float(np.trace(matrix)) / 3.0
            if scale > 1.0 / WORST and from_identity(matrix / scale) < 0.3 * abs(1 - 1 / scale):
                yield from self._inverses(kind, scale * np.eye(3), lambda fed: Hypothesis(
                    ('gyroscope_wiring', 'time_step'), f'with steps {np.trace(fed) / 3.0:.4g} '
                    'times as long (scales of rates and steps cannot be told apart)',
                    given=changed(('dt',), partial(np.multiply, np.trace(fed) / 3.0))))
            yield from self._inverses(kind, matrix, lambda fed: wired(
                'gyroscope', f'{words(np.linalg.inv(fed))}: with the inverse of that', fed))

    def _inverses(self, kind: int, matrix: Reals,
                  make: Callable[[Reals], Hypothesis]) -> Iterator[Tried]:
        """Try the inverse of matrix `kind` of `gyroscope_of`, and improve it when it is undone."""
        fed = np.eye(3)
        for _ in range(2):
            if np.linalg.cond(matrix) > WORST:
                return
            fed = fed @ np.linalg.inv(matrix)
            for one, outcome in self._try(make(fed), screened=False):
                yield one, outcome
                matrix = gyroscope_of(outcome, self._excitation.turns)[:2][kind]

    def _of_sensor(self, name: str, axis: int, level: Sequence[int],
                   *more: Hypothesis) -> Iterator[Tried]:
        """
        Try more hypotheses, and changes of the axes of a sensor that attitudes at rest show.

        axis, level : axes of the world along which the readings of a right filter are positive,
            and zero: up and the horizontal ones for the accelerometer, north and east for the
            magnetometer.  `fit` is largest where readings, turned by the attitudes, are so.
        """
        tilt, heading, *_ = self._errors(self._outcome)
        shows = {'accelerometer': tilt >= TILT,
                 'magnetometer': self._absolute and max(tilt, heading) >= HEADING}
        if not shows[name]:
            return
        if name == 'accelerometer' and self._kicks() != []:     # another unit corrects nothing
            more = *more, *hypotheses.UNITS
        readings = getattr(self._run, name)
        found = self._at_rest(self._outcome)

        def fit(one: Reals) -> float:
            there = np.concatenate([turns.apply(readings[rows] @ one.T) for turns, rows in found])
            return float(np.sum(there[:, axis]
                                / np.linalg.norm(there[:, [axis, *level]], axis=1)))

        yield from self._try(*more, *permuted(name, fit))
        if name == 'magnetometer':
            yield from self._affine(name, 'hard_iron', level, 9)
        yield from self._affine(name, f'{name}_wiring', level, 0)

    def _of_smoothing(self) -> Iterator[Tried]:
        """Try delays and low passes of the sensors, each in several steps."""
        error = self._apart(self._run.truth)
        for names, change in itertools.product(
                (('gyroscope',), ('accelerometer',), ('magnetometer',),
                 ('accelerometer', 'magnetometer')), (delayed, sharpened)):
            samples, before = 1.0, self._error(self._outcome)
            for _ in range(STEPS):
                tried = [*self._try(change(names, samples), screened=False)]
                yield from tried
                if not tried or (left := self._error(tried[0][1])) > before:
                    break
                before, turned = left, self._apart(tried[0][1].estimates)
                more = float(turned @ error) / max(float(turned @ turned), 1e-12)
                if more * samples < 0.5 or abs(more - 1.0) < LITTLE:
                    break
                samples = more * samples

    def _apart(self, others: Reals) -> Reals:
        judged = [*self._rests, *range(*self._excitation.motion.indices(len(others)))[::10]]
        return excitation.apart(self._outcome.estimates[judged], others[judged], self._absolute)

    def _at_rest(self, outcome: Outcome, more: Sequence[Hypothesis] = (),
                 ) -> list[tuple[Rotation, NDArray[np.intp]]]:
        """Return attitudes of filters that start at rest, those at the ends of rests, and rows."""
        found = [(Rotation.from_quat(outcome.estimates[self._rests]), self._rests)]
        if self._subject.restarts:
            # Within turns too, the readings are those of a rest in the same attitude.
            turns = self._excitation.turns
            starts = np.concatenate((self._rests, turns + 15, turns + 30))
            still = np.full((START, 3), excitation.NEVER_ZERO)
            found.insert(0, (Rotation.from_quat([self.respond(more, replace(
                self._run.part(np.full(START, row)), gyroscope=still)).estimates[-1]
                for row in starts]), starts))
        return found

    def _affine(self, name: str, fault: str, level: Sequence[int],
                first: int) -> Iterator[Tried]:
        """Try the affine change of a sensor that attitudes at rest show, in several steps."""
        readings = getattr(self._run, name)
        size = float(np.linalg.norm(readings[0]))
        fed, outcome, before = np.eye(4), self._outcome, math.inf
        tried: tuple[Hypothesis, ...] = ()
        for _ in range(STEPS):
            if self._error(outcome) > LESS * before:
                return
            before = self._error(outcome)
            for turns, rows in self._at_rest(outcome, tried):
                change, left = excitation.affine_of(readings[rows] / size, turns, level, first)
                if left < FITS:
                    break
            if np.linalg.cond(change) > WORST:
                return
            fed = fed @ np.linalg.inv(change)
            one = wired(name, f'with the {name} multiplied by [matrix, offset] = '
                        f'{fed[:3].round(4).tolist()}', fed[:3, :3], size * fed[:3, 3], fault)
            tried = one,
            for _, outcome in self._try(one):
                yield one, outcome

    def _kicks(self) -> list[Fault] | None:
        """Name the sensors that do not correct a kick; None: it is too far off to tell."""
        not_corrected = partial(excitation.not_corrected, self._outcome.estimates,
                                given=self._excitation, absolute=self._absolute)
        if not not_corrected(self._run.truth):
            return []
        without = self.respond((), self._excitation.still).estimates    # has the same error
        error = measures.errors_of(without, self._run.truth).attitude(True)
        # Far from the truth no filter is linear.
        return not_corrected(without) if error[self._excitation.kicks[0][0]] < NEAR else None

    def _unexplained(self) -> list[Fault]:
        """Name what no hypothesis explains by where it shows; set `early`."""
        clean = self._errors(self._outcome)
        left = ('without noise the error at rest is {} of tilt and {} of heading, '
                'in motion {} and {}').format(*map(degrees, clean))
        wrong = bool(np.any(clean > CLEAN))
        whole, early, late = gyroscope_of(self._outcome, self._excitation.turns)
        self.early = early
        turns = Rotation.from_quat(self._outcome.estimates)
        if np.max((turns * turns[0].inv()).magnitude()) < STUCK:
            return [Fault('inaccurate', 'the attitude hardly changes')]
        if from_identity(whole, early) > GROSS_GAIN:
            if self._subject.restarts:      # what is wrong without turns is not the gyroscope's
                turns, rows = self._at_rest(self._outcome)[0]
                start = measures.errors_of(turns.as_quat(), self._run.truth[rows])
                if rms(start.judged(self._absolute)) > GROSS_REST:
                    return [Fault('inaccurate', f'{left}: no cause explains it')]
            return [Fault('gyroscope_wiring', words(early))]
        if wrong and late > 1:
            return [Fault('lag', f'turns are followed {late} samples late; {left}')]
        found = self._kicks() or []
        if 'accelerometer_wiring' in [fault.name for fault in found]:
            for one, outcome in self._try(*hypotheses.UNITS, screened=False):
                if not excitation.not_corrected(outcome.estimates, self._run.truth,
                                                self._excitation, self._absolute):
                    return [Fault(one.faults[0], f'{found[0].evidence}, but {one.text} it is')]
        if not found and wrong:
            return [Fault('inaccurate', f'{left}: no cause explains it')]
        return found or excitation.astray(self._outcome, self._excitation, self._absolute)

    def judge_bias(self) -> None:
        """
        Compare runs with and without a gyroscope bias, after `identify`.

        See `no_bias_estimate` and `bias_report` in docs/exam.md.
        """
        motion, size = self._excitation.motion, float(np.linalg.norm(BIAS))
        run = self._run.part(slice(motion.stop))
        outcome = self.respond((), replace(run, gyroscope=run.gyroscope + BIAS))
        apart = measures.errors_of(
            outcome.estimates, self._outcome.estimates[:motion.stop]).judged(self._absolute)
        estimates = outcome.biases - self._outcome.biases[:motion.stop]
        estimates = estimates[np.isfinite(estimates[:, 0])]
        if not len(estimates):
            estimates = np.full((1, 3), math.nan)
        found, left_s = estimates[-1], rms(apart[motion]) / size
        share, before = (estimates[[-1, len(estimates) // 4]] @ BIAS / size ** 2).tolist()
        first, again = apart[self._rests[[0, -2]]].tolist()
        self._findings.measures |= {'bias_error_s': left_s, 'bias_found': share}
        left, shares = left_s > diagnosis.BIAS_LEFT_S, (found / BIAS).tolist()
        # A filter that has gone on for minutes is sure of its bias, and learns another one slowly.
        close = bool(np.median(np.linalg.norm(
            estimates[-len(estimates) // 8:] - BIAS, axis=1)) < BIAS_OFF * size)
        right = -BIAS_FOUND < share < 2.0 if left or not self._subject.restarts else close
        learns = again < LEARNED * first or (
            again < LEARNING * first and (close or share > max(BIAS_FOUND, 1.2 * before)))
        partly = self._absolute and min(shares) < BIAS_FOUND and max(shares) > LEARNED
        if left and (partly or not learns):
            self._findings.faults.append(Fault(
                'no_bias_estimate', 'with a gyroscope bias of 1 deg/s the '
                f'{"attitude" if self._absolute else "tilt"} is {left_s:.3g} deg off in the end: '
                f'the bias is not learned{" about each axis" * partly} in '
                f'{motion.stop / scenarios.SLOW.rate:.0f} s'))
        elif not right and not math.isnan(share):
            self._findings.faults.append(Fault(
                'bias_report', f'a gyroscope bias of {np.degrees(BIAS).round(2).tolist()} deg/s '
                f'is learned, but the estimate is {np.degrees(found).round(2).tolist()} deg/s'))
