# SPDX-License-Identifier: Apache-2.0
"""
How a filter responds to its inputs one by one: turns, gravity and field at rest, kicks.

The readings have no noise, so a right filter has no error, and what remains has a cause.  A cause
is a hypothesis: its inverse is applied to the readings or the attitudes, and the error disappears.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, fits, hypotheses, kicks, scenarios
from spinning_top_sim.exam.diagnosis import HEADING, TILT, degrees
from spinning_top_sim.exam.excitation import NEVER_ZERO, excite
from spinning_top_sim.exam.fits import Turns, from_identity, turns_of, words
from spinning_top_sim.exam.hypotheses import Hypothesis, delayed, permuted, sharpened, wired
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Findings
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.subject import Subject
from spinning_top_sim.exam.trial import InvalidOutputError, Outcome
from spinning_top_sim.tools.verdict import Fault

# Errors of a right filter: tilt and heading at rest, then in motion, rms [rad].
CLEAN = np.array((TILT, HEADING, TILT, HEADING))
# How far the response to turns may be from the identity.  Above GAIN the gyroscope is examined;
# above SLIGHT it is blamed for an error.  Above GROSS_GAIN nothing else is judged, and it is
# blamed if filters that start before turns are off by less than GROSS_REST until then, not later.
GAIN, SLIGHT, GROSS_GAIN, GROSS_REST = 0.003, 0.01, 0.25, np.radians(10.0)
REVERSED = 3.0                  # heading of a filter whose field has the opposite sign [rad]
MOST_CAUSES = 4
START = 50                      # samples after which a filter that starts has an attitude
SURE = 0.2                      # share of the limit of an explanation: nothing else is tried
# Most of the error, after a low pass, a delay or a small error of the gyroscope is undone.
LITTLE_LEFT = 0.1
WORST = 30.0                    # condition of a matrix that can be inverted
EARLY_RESTS = slice(2, 5)       # rests of a short run, when the error of the start is over
STUCK = np.radians(1.0)         # attitudes that differ less are always the same
# The search for the affine change of a sensor, or for its delay.
FITS = 0.1                      # share of the error at rest that a good fit leaves
STEPS, LITTLE = 4, 0.05         # the last step changes it by less than this share
LESS = 0.7                      # a step that leaves more of the whole error is the last one
UNDONE = '; all measures but those of the field are those after this correction'

Tried = tuple[Hypothesis, Outcome]


class Response:
    """
    The response of a filter to the excitation; `findings` takes its faults and measures.

    absolute : whether the heading is judged
    outcome : of the excitation; the causes that were found are undone
    """

    def __init__(self, subject: Subject, absolute: bool, findings: Findings) -> None:
        self.subject, self.absolute, self.findings = subject, absolute, findings
        self.shifts: list[Hypothesis] = []      # causes found that shift the time
        self._undone: list[Hypothesis] = []     # the others
        self.unclear = False    # an error is left that would pass for a lever arm's or a bias's
        self.excitation = excite(subject.imu, subject.restarts)
        self._run, self._rests = self.excitation.run, self.excitation.rests

    def identify(self) -> None:
        """Find causes until nothing is left to explain, and undo each.  Raises as `follow`."""
        self.outcome = self.respond(self._run)
        for _ in range(MOST_CAUSES):
            best = self._cause()
            if best is None:
                break
            before = self._error(self.outcome)
            one, self.outcome = best
            self.findings.faults += [
                Fault(name, f'{one.text}, the error falls from {degrees(before)} to '
                      f'{degrees(self._error(self.outcome))}{"" if one.shift else UNDONE}')
                for name in one.faults]
            (self.shifts if one.shift else self._undone).insert(0, one)
            # A constant bias of the sensor is none about axes of the world, and longer steps raise
            # the gains of a filter.
            self.unclear |= one.on_readings is hypotheses.of_world or 'time_step' in one.faults
        clean = np.degrees(self._errors(self.outcome))
        self.findings.measures |= {'tilt_clean_deg': float(max(clean[::2])),
                                   'heading_clean_deg': float(max(clean[1::2]))}
        others = self._unexplained()
        # A heading that nothing corrects is any.
        if 'magnetometer_wiring' in [fault.name for fault in others]:
            self.findings.drop('heading_offset')
        faults = self.findings.faults = [*self.findings.faults, *others]
        self.unclear |= bool(others)
        if self.unclear:
            faults[-1] = faults[-1]._replace(
                evidence=f'{faults[-1].evidence}; no lever arm and no bias is judged')

    def _errors(self, outcome: Outcome, *places: Any) -> Reals:
        """Return errors of tilt and heading, by default at rest, then in motion, rms [rad]."""
        errors = outcome.errors
        heading = self.absolute * errors.heading
        return np.array([rms(error[rows])
                         for rows in places or (self._rests, self.excitation.motion)
                         for error in (errors.tilt, heading)])

    def _error(self, outcome: Outcome, *places: Any) -> float:
        return float(np.linalg.norm(self._errors(outcome, *places)))

    def respond(self, run: Run, *more: Hypothesis, shifted: bool = True) -> Outcome:
        """Return the outcome of a run; undo `more`, shifts if `shifted`, and other causes."""
        return self.subject.follow(run, [
            *more, *(self.shifts if shifted else ()), *self._undone])

    def blamed(self, error: Fault) -> Fault:
        """Blame the gyroscope for an error if nothing else is wrong but the response to it."""
        if self.findings.names - {'gyroscope_wiring'}:      # perhaps there is no outcome
            return error
        early = self._turns(self.outcome).early
        return error if from_identity(early) <= SLIGHT else Fault(
            'gyroscope_wiring', f'{words(early)}; {error.evidence}')

    def _try(self, *hypotheses: Hypothesis, screened: bool = True) -> Iterator[Tried]:
        """Yield the hypotheses with their outcomes; `screened` leaves out what is in vain."""
        for one in hypotheses:
            with contextlib.suppress(InvalidOutputError):       # the filter rejects the readings
                if one.on_readings is None:
                    yield one, replace(
                        self.outcome, estimates=one.on_attitudes(self.outcome.estimates))
                elif not (screened and self.subject.restarts and self._in_vain(one)):
                    yield one, self.respond(self._run, one)

    def _in_vain(self, one: Hypothesis) -> bool:
        """Return whether a short run has the error of early rests still: a long one would, too."""
        rests = self._rests[EARLY_RESTS]
        short = self.respond(self._run.part(slice(rests[-1] + 1)), one)
        before, after = (self._error(outcome, rests) for outcome in (self.outcome, short))
        return before > HEADING and after > LESS * before

    def _turns(self, outcome: Outcome) -> Turns:
        return turns_of(outcome, self.excitation.turn_begins)

    def _turns_wrongly(self) -> bool:
        """Return whether filters that start before turns are right until these, then wrong."""
        if not self.subject.restarts:
            return True
        rows = self.excitation.turn_begins[:, np.newaxis] + np.arange(-START, fits.WHOLE)
        begins = START + rows.shape[1] * np.arange(len(rows))
        outcome = replace(self.outcome.part(rows.ravel()), estimates=np.concatenate(
            [self.respond(self._run.part(one)).estimates for one in rows]))
        start = outcome.part(begins - 1).errors.judged(self.absolute)
        return rms(start) < GROSS_REST and turns_of(outcome, begins).off > GROSS_GAIN

    def _cause(self) -> Tried | None:
        """
        Return a hypothesis that explains the error, and the outcome when it is undone.

        What would look like another cause is tried before that one.
        """
        turns = self._turns(self.outcome)
        gross = turns.off > GROSS_GAIN
        if not (gross or np.any(self._errors(self.outcome) > CLEAN)):
            return None
        found = self._explanation(turns, gross)
        if found or not self.subject.restarts or hypotheses.CORRECTS_FIRST in self.shifts:
            return found
        # A filter that corrects before the step may have a fault besides.
        before = self.outcome
        self.shifts.insert(0, hypotheses.CORRECTS_FIRST)
        self.outcome = self.respond(self._run)
        found = self._explanation(self._turns(self.outcome), gross)
        if found is None or self._error(found[1]) > diagnosis.EXPLAINED * self._error(before):
            self.shifts.pop(0)
            self.outcome, found = before, None
        return found

    def _explanation(self, turns: Turns, gross: bool) -> Tried | None:
        """Return the best hypothesis of the first group with one that explains the error."""
        return (self._best(self._of_attitudes()) or self._best(self._of_delays(turns.late))
                or self._best(self._of_gyroscope(turns), diagnosis.EXPLAINED if gross
                              else LITTLE_LEFT)
                or self._best(self._of_accelerometer()) or self._best(self._of_magnetometer())
                or self._best(self._of_smoothing(), LITTLE_LEFT))

    def _best(self, tried: Iterator[Tried],
              share: float = diagnosis.EXPLAINED) -> Tried | None:
        """
        Return the one that leaves the least error, if that is at most this share of the error.

        Once SURE * share is left, no other one is tried.
        """
        limit, least, best = share * self._error(self.outcome), math.inf, None
        for one, outcome in tried:
            error = self._error(outcome)
            if error < least and error <= limit:
                least, best = error, (hypotheses.ambiguous(one, self.absolute), outcome)
            if error <= SURE * limit:
                break
        return best

    def _of_attitudes(self) -> Iterator[Tried]:
        """Try misreadings of the attitudes, and what the attitudes at rest suggest."""
        estimated, true = (Rotation.from_quat(rows[self._rests])
                           for rows in (self.outcome.estimates, self._run.truth))
        in_sensor, in_world = (true.inv() * estimated).mean(), (estimated * true.inv()).mean()
        heading = 2.0 * math.atan2(*in_world.as_quat(canonical=True)[2:])
        back = Rotation.from_rotvec((0.0, 0.0, -heading))
        steady = rms((back * estimated * true.inv()).magnitude()) < diagnosis.DIVERGED
        turned = Hypothesis(
            ('magnetometer_wiring' if abs(heading) > REVERSED else 'heading_offset',),
            f'turned by {-math.degrees(heading):.3g} deg about the vertical',
            on_attitudes=lambda q: (back * Rotation.from_quat(q)).as_quat())
        group = Rotation.create_group('O')
        square = group[int(np.argmin((group.inv() * in_sensor).magnitude()))]
        tangents = [np.tan(0.5 * one.magnitude()) for one in (estimated, true)]
        scale = max(float(np.median(tangents[0] / np.maximum(tangents[1], 1e-9))), 1e-3)
        return self._try(
            *hypotheses.MISREADINGS,
            Hypothesis(('frame_ned',), 'read as attitude of axes '
                       f'{hypotheses.axes(square.as_matrix())} of the sensor',
                       on_attitudes=lambda q: (Rotation.from_quat(q) * square.inv()).as_quat()),
            *([turned] if steady else []),
            Hypothesis(('inaccurate',), f'with the vector part of the attitude divided by '
                       f'{scale:.4g}', on_attitudes=lambda q: Rotation.from_quat(
                           q / (scale, scale, scale, 1.0)).as_quat()))

    def _of_delays(self, late: int) -> Iterator[Tried]:
        """Try delays of the attitudes and the gyroscope, and what is no fault."""
        offset = scenarios.SLOW.rate * diagnosis.offset_of(
            self.outcome.part(self.excitation.motion), self.absolute).seconds
        yield from self._try(         # the filter corrects before it takes the step
            hypotheses.CORRECTS_FIRST,
            Hypothesis(on_attitudes=lambda q: hypotheses.shifted(q, -1), shift=True))
        if not diagnosis.AHEAD <= offset <= diagnosis.DELAYED:
            yield from self._try(Hypothesis(
                ('stamp_offset',), f'with the attitude {round(offset)} samples earlier',
                on_attitudes=lambda q: hypotheses.shifted(q, round(offset)), shift=True))
        if late > 0:
            yield from self._try(delayed(('gyroscope',), late))

    def _of_gyroscope(self, turns: Turns) -> Iterator[Tried]:
        """Try the inverse of the matrix that the gyroscope has."""
        if turns.off < GAIN:
            return
        if turns.off > GROSS_GAIN:
            yield from self._try(         # judged by the turns
                *permuted('gyroscope', lambda one: -np.sum((one - turns.early) ** 2)),
                *(wired('gyroscope', f'with the gyroscope multiplied by {text}', by * np.eye(3),
                        fault='gyroscope_units') for text, by in (
                            ('pi/180', math.radians(1.0)), ('180/pi', math.degrees(1.0)))),
                Hypothesis(('gyroscope_wiring',), 'with rates about axes of the world (a product '
                           'on the wrong side)', on_readings=hypotheses.of_world), screened=False)
        for matrix_of in attrgetter('early'), attrgetter('whole'):
            matrix = matrix_of(turns)
            scale = float(np.trace(matrix)) / 3.0
            if scale > 1.0 / WORST and from_identity(matrix / scale) < 0.3 * abs(1 - 1 / scale):
                yield from self._inverses(matrix_of, scale * np.eye(3), lambda fed: Hypothesis(
                    ('gyroscope_wiring', 'time_step'), f'with steps {np.trace(fed) / 3.0:.4g} '
                    'times as long (scales of rates and steps cannot be told apart)',
                    on_readings=hypotheses.changed(
                        ('dt',), partial(np.multiply, np.trace(fed) / 3.0))))
            yield from self._inverses(matrix_of, matrix, lambda fed: wired(
                'gyroscope', f'{words(np.linalg.inv(fed))}: with the inverse of that', fed))

    def _inverses(self, matrix_of: Callable[[Turns], Reals], matrix: Reals,
                  make: Callable[[Reals], Hypothesis]) -> Iterator[Tried]:
        """Try the inverse of a matrix of the turns, and improve it when it is undone."""
        fed = np.eye(3)
        for _ in range(2):
            if np.linalg.cond(matrix) > WORST:
                return
            fed = fed @ np.linalg.inv(matrix)
            for one, outcome in self._try(make(fed), screened=False):
                yield one, outcome
                matrix = matrix_of(self._turns(outcome))

    def _of_accelerometer(self) -> Iterator[Tried]:
        """Try its sign, its unit, its axes, and the affine change that attitudes at rest show."""
        if self._errors(self.outcome)[0] < TILT:
            return
        up, horizontal = 2, (0, 1)      # axes of the world
        # Another unit corrects nothing.
        units = hypotheses.UNITS if self._uncorrected(again=False) != [] else ()
        yield from self._try(hypotheses.GRAVITY_SIGN)
        yield from (tried for tried in self._try(*units) if self._corrects(tried[1]))
        yield from self._permutations('accelerometer', up, horizontal)
        yield from self._affine('accelerometer', 'accelerometer_wiring', horizontal)

    def _of_magnetometer(self) -> Iterator[Tried]:
        """Try the field of a level sensor, its axes, and the same changes of the magnetometer."""
        if not self.absolute or max(self._errors(self.outcome)[:2]) < HEADING:
            return
        north, east = 1, (0,)
        yield from self._try(hypotheses.LEVEL)
        yield from self._permutations('magnetometer', north, east)
        yield from self._affine('magnetometer', 'hard_iron', east, offset_only=True)
        yield from self._affine('magnetometer', 'magnetometer_wiring', east)

    def _permutations(self, name: str, axis: int, level: Sequence[int]) -> Iterator[Tried]:
        """
        Try changes of the axes of a sensor that attitudes at rest show.

        axis, level : axes of the world along which the readings of a right filter are positive,
            and zero.  `fit` is largest where readings, turned by the attitudes, are so.
        """
        readings = getattr(self._run, name)
        found = self._at_rest(self.outcome)

        def fit(one: Reals) -> float:
            there = np.concatenate([
                attitudes.apply(readings[rows] @ one.T) for attitudes, rows in found])
            return float(np.sum(there[:, axis]
                                / np.linalg.norm(there[:, [axis, *level]], axis=1)))

        return self._try(*permuted(name, fit))

    def _of_smoothing(self) -> Iterator[Tried]:
        """Try delays and low passes of the sensors, each in several steps."""
        error = self._apart(self._run.truth)
        for names, change in itertools.product(
                (('gyroscope',), ('accelerometer',), ('magnetometer',),
                 ('accelerometer', 'magnetometer')), (delayed, sharpened)):
            samples, before = 1.0, self._error(self.outcome)
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
        judged = [*self._rests, *range(*self.excitation.motion.indices(len(others)))[::10]]
        return fits.axes_moved(self.outcome.estimates[judged], others[judged], self.absolute)

    def _at_rest(self, outcome: Outcome,
                 *more: Hypothesis) -> list[tuple[Rotation, NDArray[np.intp]]]:
        """Return attitudes of filters that start at rest, those at the ends of rests, and rows."""
        found = [(Rotation.from_quat(outcome.estimates[self._rests]), self._rests)]
        if self.subject.restarts:
            # Within turns too, the readings are those of a rest in the same attitude.
            begins = self.excitation.turn_begins
            starts = np.concatenate((self._rests, begins + 15, begins + 30))
            still = np.full((START, 3), NEVER_ZERO)
            found.insert(0, (Rotation.from_quat([self.respond(replace(
                self._run.part(np.full(START, row)), gyroscope=still), *more).estimates[-1]
                for row in starts]), starts))
        return found

    def _affine(self, name: str, fault: str, level: Sequence[int],
                offset_only: bool = False) -> Iterator[Tried]:
        """Try the affine change of a sensor that attitudes at rest show, in several steps."""
        readings = getattr(self._run, name)
        size = float(np.linalg.norm(readings[0]))
        fed, outcome, before = np.eye(4), self.outcome, math.inf
        tried: tuple[Hypothesis, ...] = ()
        for _ in range(STEPS):
            if self._error(outcome) > LESS * before:
                return
            before = self._error(outcome)
            for attitudes, rows in self._at_rest(outcome, *tried):
                change, left = fits.affine_of(
                    readings[rows] / size, attitudes, level, offset_only)
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

    def _uncorrected(self, again: bool = True) -> list[Fault] | None:
        """See `kicks.uncorrected`."""
        return kicks.uncorrected(self.respond, self.outcome, self.excitation, self.absolute,
                                 self.subject.imu, again)

    def _corrects(self, outcome: Outcome) -> bool:
        """See `kicks.corrects`."""
        return kicks.corrects(outcome, self.excitation, self.absolute)

    def _unexplained(self) -> list[Fault]:
        """Name what no hypothesis explains by where it shows."""
        clean = self._errors(self.outcome)
        left = ('without noise the error at rest is {} of tilt and {} of heading, '
                'in motion {} and {}').format(*map(degrees, clean))
        wrong = bool(np.any(clean > CLEAN))
        turns = self._turns(self.outcome)
        attitudes = Rotation.from_quat(self.outcome.estimates)
        if np.max((attitudes * attitudes[0].inv()).magnitude()) < STUCK:
            return [Fault('inaccurate', 'the attitude hardly changes')]
        if turns.off > GROSS_GAIN:
            return [Fault('gyroscope_wiring', words(turns.early)) if self._turns_wrongly()
                    else Fault('inaccurate', f'{left}: no cause explains it')]
        if wrong and turns.late > 1:
            return [Fault('lag', f'turns are followed {turns.late} samples late; {left}')]
        found = self._uncorrected() or []
        if 'accelerometer_wiring' in [fault.name for fault in found]:
            for one, outcome in self._try(*hypotheses.UNITS, screened=False):
                if self._corrects(outcome):
                    return [Fault(one.faults[0], f'{found[0].evidence}, but {one.text} it is')]
        if not found and wrong:
            return [Fault('inaccurate', f'{left}: no cause explains it')]
        return found or kicks.astray(self.outcome, self.excitation, self.absolute)
