# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: the runs that it consists of, and the report on them."""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import degrees
from spinning_top_sim.exam.excitation import from_identity, words
from spinning_top_sim.exam.field import examine_field
from spinning_top_sim.exam.hypotheses import CORRECTS_FIRST, WITHOUT_FIELD, Hypothesis
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.report import Findings, Report
from spinning_top_sim.exam.response import Response
from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.subject import LastingSubject, Subject
from spinning_top_sim.exam.trial import (
    InvalidOutputError,
    MakeFilter,
    Outcome,
    feed,
    one_line,
)
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.tools.verdict import Fault

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10), 'field': range(1)}
# Sampling rates for the order of convergence, as multiples of the rate of the fast motion; and the
# rate at which samples are merged into steps of UNEVEN samples in turn, of 2.5 to 15 ms.
FACTORS, FINEST, UNEVEN = (1.0, 2.0), 4.0, (1, 2, 6, 1, 5, 2, 1, 3)
# What is no cause of an error with noise.
NO_CAUSE = ('inaccurate', 'diverges', 'lever_arm', 'no_bias_estimate', 'bias_report',
            'invalid_output')
# When the lever arm comes, and from when until when its effect is measured [s].  Later the
# estimate of a bias would have adapted to the force.
ARM_S = 13.33, 14.33, 19.33
SLIGHT = 0.01                   # by which the gyroscope's matrix differs where an error grows
STEP = 0.05                     # by which the response to a rate depends on the step, relative


def examine(make_filter: MakeFilter, level: str = 'quick',
            imu: Mapping[str, Any] | str | Path | None = None,
            seeds: int | Iterable[int] | None = None, *, subject: str | None = None,
            isolated: bool = True, restart: bool = True) -> Report:
    """
    Examine an attitude filter.

    The filter has a method ``update(gyroscope, accelerometer, magnetometer, dt)``: the mean
    angular velocity over the step [rad/s], specific force [m/s^2, +g upwards at rest] and field
    [T, or None] at its end, in the frame of the sensor, and the length of the step [s].  It
    returns the attitude at the end of the step, q(world <- sensor) in the order x, y, z, w; x of
    the world is east, y north and z up.  Attributes `covariance` and `bias` are optional, see
    `trial.Filter`.

    Parameters
    ----------
    make_filter : callable
        Returns a new filter: its class, a function, or one of `adapters.FILTERS`.  It is called
        for every run.
    level : {'quick', 'full', 'field'}
        'full' has more seeds, and a seed of the scenes of 'field'.
    imu : mapping or path, optional
        Parameters imu.* and mag.* by name, or the path of a parameter file such as those in
        config/imu.  The default, `scenarios.CALIBRATED`, is the noise of a calibrated device.
    seeds : int or iterable of int, optional
        Seeds of the noisy runs, or their number.  The default, SEEDS, depends on the level.
    subject : str, optional
        Name in the report.  The default is the name of the filter's class.
    isolated : bool, optional
        If False, the filter runs in this process, where a debugger can reach it.  A filter that
        crashes or never returns then ends the exam.
    restart : bool, optional
        If False, one filter is made, in this process, and used for all runs.

    Returns
    -------
    Report
        Faults with their evidence, and measures.

    Raises
    ------
    TypeError
        If `make_filter` cannot be called, such as a filter itself.
    ValueError
        If the level, a parameter or a seed is not allowed.
    """
    if not callable(make_filter):
        raise TypeError(f'make_filter = {one_line(repr(make_filter))}: pass the class of the '
                        'filter, a function that returns a new one, or one of '
                        "spinning_top_sim.exam.adapters.FILTERS, such as FILTERS['vqf']")
    if level not in SEEDS:
        raise ValueError(f'level = {level!r}: must be one of {", ".join(SEEDS)}')
    values = _imu_parameters(imu)
    numbers = list(SEEDS[level]) if seeds is None else _seed_numbers(seeds)
    if level == 'field' and not restart:
        raise ValueError("level = 'field': the filter must be made anew for each scene")
    run_feed = feed_apart if isolated and restart else feed
    subject = one_line(subject or getattr(make_filter, '__name__', 'filter'))
    # The scenes have a device of their own, whose parameters `imu` replaces.
    in_field = partial(examine_field, make_filter, subject, imu=values if imu else {},
                       feed=run_feed)
    if level == 'field':
        return in_field(numbers)
    exam = _Exam(Subject(make_filter, run_feed, values, numbers[0]) if restart else
                 LastingSubject(make_filter, values, numbers[0]), numbers)
    exam.sit()
    if level == 'full' and restart and exam.outcomes:
        scenes = in_field(numbers[:1])
        exam.findings.measures |= scenes.measures
        exam.findings.faults += scenes.found
    return exam.findings.report(subject, exam.outcomes)


def _imu_parameters(imu: Mapping[str, Any] | str | Path | None) -> Mapping[str, Any]:
    if imu is None:
        return scenarios.CALIBRATED
    values = imu if isinstance(imu, Mapping) else read_scene(imu)
    parameters.checked(values)
    others = [name for name in values if not name.startswith(('imu.', 'mag.'))]
    if others:
        raise ValueError(f'{"imu" if imu is values else imu} has {", ".join(others)}: must have '
                         'parameters imu.* and mag.* only')
    return values


def _seed_numbers(seeds: int | Iterable[int]) -> list[int]:
    try:
        numbers = list(map(operator.index, seeds if isinstance(seeds, Iterable) else range(seeds)))
    except TypeError:
        numbers = []
    if not numbers or min(numbers) < 0:
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    return numbers


class _Exam:
    """
    The runs of one exam.

    findings : faults and measures
    outcomes : of the noisy runs
    """

    def __init__(self, subject: Subject, seeds: Sequence[int]) -> None:
        self._subject, self._seeds = subject, seeds
        self.findings = Findings()
        self.outcomes: list[Outcome] = []

    def sit(self) -> None:
        """Do all runs."""
        if not self._do(self._begin):
            return
        identified = self._do(self._response.identify)
        for seed in self._seeds:        # those for which the filter fails are dropped
            self._do(partial(self._do_noisy_run, seed))
        if not self.outcomes:
            return
        self.findings.measures = (
            diagnosis.marks(self.outcomes, self._absolute) | self.findings.measures)
        self._do(self._judge_integration)
        if not self._response.unclear:
            self._do(self._judge_lever_arm)
            if identified:
                self._do(self._response.judge_bias)
                if 'frame_ned' in self.findings.names:
                    self.findings.drop('bias_report')       # it has the same axes
        self._do(self._judge_noisy_runs)
        self._do(lambda: self.findings.measures.update(self._subject.convergence()))

    def _do(self, part: Callable[[], object]) -> bool:
        """Do a part of the exam; return False where the filter fails, which is reported."""
        try:
            part()
        except InvalidOutputError as error:
            self.findings.faults.append(Fault('invalid_output', str(error)))
            return False
        return True

    def _begin(self) -> None:
        self._absolute = self._subject.uses_field()
        self._response = Response(self._subject, self._absolute, self.findings)

    def _run(self, run: Run, *more: Hypothesis) -> Outcome:
        """Return the outcome of a run; causes found are undone, shifts of time are not."""
        return self._subject.follow(run, [*more, *self._response.undone])

    def _do_noisy_run(self, seed: int) -> None:
        self.outcomes.append(self._run(self._subject.record(scenarios.SLOW, seed)))

    def _judge_noisy_runs(self) -> None:
        first, imu, findings = self.outcomes[0], self._subject.imu, self.findings
        findings.measures |= diagnosis.quality(self.outcomes, imu, self._absolute)
        findings.measures['stamp_offset_s'] = diagnosis.offset_of(
            first.last(), self._absolute).seconds
        limit = (diagnosis.noisy_limit(first.run, self._absolute)
                 if imu.keys() <= {*scenarios.CALIBRATED, 'mag.field', 'imu.rpy'}
                 else diagnosis.DIVERGED)       # it may still be learning biases
        outcomes = [self._response.respond((), one.run) for one in self.outcomes
                    ] if self._response.shifts else self.outcomes
        fault = next(filter(None, (diagnosis.inaccuracy(one, self._absolute, limit)
                                   for one in outcomes)), None)
        if fault:
            fault = self._blamed(fault)
            if fault.name == 'diverges':        # of which a growing kick is a part
                findings.drop('inaccurate')
            findings.faults.append(fault)
        if findings.names.difference(NO_CAUSE):     # a cause, of which something may be left
            findings.drop('inaccurate')
            findings.drop('diverges')
        consistency = diagnosis.consistency(outcomes, self._absolute)
        findings.measures |= diagnosis.nees_marks(consistency)
        # Faults are another reason for errors; without noise there is nothing random to judge by.
        # After minutes of learning the bias, a filter that goes on is too sure of it.
        if self._subject.restarts and not findings.faults and any(
                imu.get(f'imu.{sensor}_noise_density')
                for sensor in ('gyroscope', 'accelerometer')):
            findings.faults += filter(None, [diagnosis.covariance_fault(consistency)])

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, if possible without the magnetometer."""
        # A filter that goes on has the one rate of its IMU.
        factors = FACTORS if self._subject.restarts else FACTORS[:1]
        runs = [self._fast(factor) for factor in factors]
        aiding: tuple[Hypothesis, ...] = (WITHOUT_FIELD,)
        try:
            self._run(runs[0].part(slice(10)), *aiding)
        except InvalidOutputError:
            aiding = ()
        outcomes = [self._run(run, *aiding).last() for run in runs]
        moved = []
        for outcome in outcomes:
            one, true = map(Rotation.from_quat, (outcome.estimates, outcome.run.truth))
            moved.append(rms(((true[0] * one[0].inv()) * one * true.inv()).magnitude()))
        self.findings.measures['order'] = measures.convergence_order(factors, moved)
        self.findings.measures['integration_error_deg'] = math.degrees(moved[0])
        if self._subject.restarts:
            self._judge_steps([*outcomes, self._response.respond(
                aiding, self._fast(FINEST).merged(UNEVEN)).last()])
        absolute = self._absolute and not aiding
        before = diagnosis.error_of(outcomes[0], absolute)
        # An error of the scale does not fall with the rate.
        if before > diagnosis.FIRST_ORDER and not self.findings.measures['order'] < 1.0:
            after = diagnosis.error_of(self._run(runs[0], FIRST_ORDER, *aiding).last(), absolute)
            if after < diagnosis.FIRST_ORDER_LEFT * before:
                self.findings.faults.append(Fault(
                    'first_order_integration', 'integration is first order: correcting it reduces '
                    f'the error on the fast motion from {degrees(before)} to {degrees(after)}'))
                return
        for run, outcome in zip(runs, outcomes, strict=True):
            if diagnosis.error_of(outcome, absolute) > diagnosis.FAST:
                error = min(diagnosis.error_of(self._response.respond(more, run).last(),
                                               self._absolute) for more in ((), (CORRECTS_FIRST,)))
                if error > diagnosis.FAST:      # with the field as well
                    self.findings.faults.append(self._blamed(Fault(
                        'inaccurate', f'{run.name}, without noise: the error is '
                        f'{degrees(error)}, above {degrees(diagnosis.FAST)}, for no reason that '
                        'is known')))
                    break

    def _fast(self, factor: float) -> Run:
        return self._subject.record(replace(scenarios.FAST, rate=factor * scenarios.FAST.rate))

    def _blamed(self, error: Fault) -> Fault:
        """Blame the gyroscope for an error if nothing else is wrong but the response to it."""
        early = self._response.early
        if self.findings.names - {'gyroscope_wiring'} or from_identity(early) <= SLIGHT:
            return error
        return Fault('gyroscope_wiring', f'{words(early)}; {error.evidence}')

    def _judge_steps(self, outcomes: Sequence[Outcome]) -> None:
        """Judge whether the filter uses the step, or turns by the number of samples."""
        lengths, gains = zip(*itertools.chain(*map(gains_of, outcomes)), strict=True)
        apart = np.max(np.abs(np.subtract(gains, gains[0]))) / max(abs(gains[0]), STEP)
        by_samples = abs(gains[1] / FACTORS[1] - gains[0]) < 0.25 * abs(gains[0])
        if apart > STEP and (by_samples or abs(gains[0] - 1.0) < STEP):
            # A wrong step turns up as a wrong scale at one rate.
            if 'time_step' in self.findings.names:
                self.findings.drop('gyroscope_wiring')
            self.findings.faults.append(Fault(
                'time_step', f'in steps of {", ".join(f"{1e3 * one:g}" for one in lengths)} ms '
                f'turns move it {", ".join(f"{one:.3g}" for one in gains)} times as far as the '
                'sensor: the length of a step is misused'))

    def _judge_lever_arm(self) -> None:
        """Compare the attitudes with and without a lever arm."""
        still, moving = map(self._subject.record, (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The lever arm comes when the filter has settled, so that its start does not matter.
        begin, first, end = (round(t * scenarios.SLOW.rate) for t in ARM_S)
        with_arm = replace(still, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))
        arm, pivot = (self._response.respond((), run).estimates[first:end]
                      for run in (with_arm, still))
        effect, before = (rms(measures.errors_of(one, other).tilt) for one, other in (
            (arm, pivot), (pivot, still.truth[first:end])))
        self.findings.measures['lever_arm_deg'] = math.degrees(effect)
        if effect > max(diagnosis.LEVER_ARM, before):
            self.findings.faults.append(Fault(
                'lever_arm', f'10 cm off the axis adds {degrees(effect)}: motion is mistaken for '
                'gravity'))


def gains_of(outcome: Outcome) -> list[tuple[float, float]]:
    """Return each length of a step [s], and the share by which turns move a filter in those."""
    steps, right = (increments(one)[1:] for one in (outcome.estimates, outcome.run.truth))
    lengths, inner = outcome.run.dt[2:-1].round(6), slice(1, -1)
    found = []
    for shift in (0, -1, 1):        # a filter may be a step behind or ahead
        share = np.sum(np.roll(steps, shift, axis=0) * right, 1) / np.sum(right * right, 1)
        found.append([(float(one), float(np.median(share[inner][lengths == one])))
                      for one in np.unique(lengths)])
    return min(found, key=lambda pairs: np.ptp([gain for _, gain in pairs]))


def for_first_order(run: Run) -> Run:
    """Return the rates for which the normalised first-order step q + q w dt/2 is exact."""
    half = 0.5 * run.dt[:, np.newaxis] * np.linalg.norm(run.gyroscope, axis=1, keepdims=True)
    longer = np.tan(np.minimum(half, 1.5)) / np.where(half > 0.0, half, 1.0)
    return replace(run, gyroscope=longer * run.gyroscope)


FIRST_ORDER = Hypothesis((), '', given=for_first_order)
