# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: the runs that it consists of, and the report on them."""

import contextlib
import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import Fault, degrees
from spinning_top_sim.exam.excitation import increments
from spinning_top_sim.exam.field import examine_field
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.response import Responses
from spinning_top_sim.exam.scenarios import Run, Scenario
from spinning_top_sim.exam.trial import (
    ChangeReadings,
    Feed,
    Hypothesis,
    InvalidOutputError,
    MakeFilter,
    Outcome,
    feed,
    follow,
    one_line,
    without_field,
)
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10), 'field': range(1)}
# Sampling rates for the order of convergence, as multiples of the rate of the fast motion.
FINER = (1.0, 2.0)
FIELD_ASKED = 200, 1000     # updates after which a filter has shown whether it uses the field
# A filter that is not restarted is first turned to the attitude at which the run begins [s].
TURN_S = 30.0
# A filter uses the field if its heading follows at least a tenth of this alternating turn of the
# field [rad].  A larger turn would disturb a filter that assumes low noise.
DECLINATION = np.radians(2.0)
# These faults do not show in runs without noise, bias and lever arm.
SHOW_ELSEWHERE = ('inaccurate', 'lever_arm', 'no_bias_estimate', 'bias_report', 'invalid_output')
# When the lever arm comes, and until when its effect is measured [s].  Later the estimate of a
# bias would have adapted to the force.
ARM_S = 13.33, 14.33, 19.33
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
    in_field = partial(examine_field, make_filter, subject=subject,
                       imu=None if imu is None else values, feed=run_feed)
    if level == 'field':
        return in_field(numbers)
    exam = (_Exam(make_filter, run_feed, values, numbers) if restart else
            _OneFilterExam(cache(make_filter), run_feed, values, numbers))
    exam.sit()
    if level == 'full' and restart and exam.outcomes:
        exam.measures |= in_field(numbers[:1]).measures
    return Report(one_line(subject or getattr(make_filter, '__name__', 'filter')),
                  tuple(diagnosis.one_of_each(exam.faults)), exam.measures, exam.outcomes)


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
    """The runs of one exam, and what they show."""

    finer: Sequence[float] = FINER
    judges_covariance = restarts = True

    def __init__(self, make_filter: MakeFilter, feed: Feed, imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._make_filter, self._feed, self._imu, self._seeds = make_filter, feed, imu, seeds
        self._absolute = False
        self._responses: Responses | None = None
        self.faults: list[Fault] = []
        self.measures: dict[str, float] = {}
        self.outcomes: list[Outcome] = []

    def sit(self) -> None:
        """Do all runs."""
        with self._guarded():
            self._ask_for_field()
        if self.faults:
            return
        with self._guarded():
            self._identify()
        self._do_noisy_runs()
        if not self.outcomes:
            return
        self.measures = diagnosis.marks(self.outcomes, self._absolute) | self.measures
        clear = self._responses is None or not self._responses.unclear
        for part in (self._judge_integration, self._judge_lever_arm, self._judge_bias)[
                :3 if clear else 1]:
            with self._guarded():
                part()
        self._judge_noisy_runs()

    def _add(self, fault: Fault | None) -> None:
        if fault is not None:
            self.faults.append(fault)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """End a part of the exam where the filter fails in it, and report that."""
        try:
            yield
        except InvalidOutputError as error:
            self._add(Fault('invalid_output', str(error)))

    def _follow(self, run: Run, undone: Sequence[Hypothesis] = ()) -> Outcome:
        """Return the outcome of a run, fed to a new filter."""
        return follow(self._make_filter, run, undone, self._feed)

    def _run(self, scenario: Scenario, *changes: ChangeReadings, seed: int | None = None,
             ) -> Outcome:
        """Return the outcome of a scenario, by default with the first seed."""
        return self._corrected(self._record(scenario, seed), *changes)

    def _corrected(self, run: Run, *changes: ChangeReadings) -> Outcome:
        """Return the outcome of a run; causes that have been found are undone."""
        return self._follow(run, [*(Hypothesis((), '', given=one) for one in changes), *(
            self._responses.undone if self._responses is not None else ())])

    def _record(self, scenario: Scenario, seed: int | None = None) -> Run:
        return scenarios.record(scenario, self._imu, self._seeds[0] if seed is None else seed)

    def _ask_for_field(self) -> None:
        """Find out whether the filter uses the field: only then its heading can be judged."""
        for updates in FIELD_ASKED:
            run = self._record(scenarios.SLOW).part(slice(updates))
            other = replace(run, magnetometer=run.magnetometer[:, [1, 2, 0]])
            one, two = (self._follow(fed).estimates for fed in (run, other))
            self._absolute = bool(np.max(np.abs(one - two)) > 1e-9)
            if self._absolute:
                break

    def _identify(self) -> None:
        """Name the causes that show in the responses to single inputs; they are undone then."""
        self._responses = found = Responses(
            self._follow, self._imu, self._absolute, self.restarts)
        try:
            found.identify()
        finally:
            self.faults += found.faults
        clean = found.clean
        self.measures |= {'tilt_clean_deg': math.degrees(max(clean.tilt, clean.tilt_moving)),
                          'heading_clean_deg': math.degrees(max(
                              clean.heading, clean.heading_moving))}

    def _do_noisy_runs(self) -> None:
        """Follow the slow motion; drop the seeds for which the filter fails."""
        done = {}
        for seed in self._seeds:
            with self._guarded():
                done[seed] = self._run(scenarios.SLOW, seed=seed)
        self._seeds, self.outcomes = list(done), list(done.values())

    def _judge_noisy_runs(self) -> None:
        first = self.outcomes[0]
        self.measures['stamp_offset_s'] = diagnosis.stamp_fault(
            first.last(), self._absolute)[0].seconds
        self._add(diagnosis.divergence(first, self._absolute))
        if not self.faults:
            self._add(diagnosis.inaccuracy(first, self._absolute))
        if any(fault.name not in SHOW_ELSEWHERE for fault in self.faults):
            self.faults = [fault for fault in self.faults if fault.name != 'inaccurate']
        consistency = diagnosis.consistency(self.outcomes, self._absolute)
        self.measures |= diagnosis.nees_marks(consistency)
        # Faults are another reason for errors; without noise there is nothing random to judge by.
        if self.judges_covariance and not self.faults and any(
                self._imu.get(f'imu.{sensor}_noise_density')
                for sensor in ('gyroscope', 'accelerometer')):
            self._add(diagnosis.covariance_fault(consistency))

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, if possible without the magnetometer."""
        changes: tuple[ChangeReadings, ...] = (without_field,)
        try:
            self._run(replace(scenarios.FAST, duration=0.1, reversals=()), *changes)
        except InvalidOutputError:
            changes = ()
        finer = [replace(scenarios.FAST, rate=factor * scenarios.FAST.rate)
                 for factor in self.finer]
        outcomes = [self._run(scenario, *changes).last() for scenario in finer]
        moved = [rms(measures.moved(outcome.estimates, outcome.run.truth))
                 for outcome in outcomes]
        self.measures['order'] = measures.convergence_order(self.finer, moved)
        self.measures['integration_error_deg'] = math.degrees(moved[0])
        self._judge_step(outcomes)
        absolute = self._absolute and not changes
        before = diagnosis.error_of(outcomes[0], absolute)
        if before > diagnosis.FIRST_ORDER:
            corrected = self._run(finer[0], diagnosis.for_first_order, *changes).last()
            after = diagnosis.error_of(corrected, absolute)
            if after < diagnosis.FIRST_ORDER_LEFT * before:
                self._add(Fault('first_order_integration', 'integration is first order: '
                                'correcting it reduces the error on the fast motion from '
                                f'{degrees(before)} to {degrees(after)}'))

    def _judge_step(self, outcomes: Sequence[Outcome]) -> None:
        """Compare the responses to the same rates in steps of different lengths."""
        found = []
        for outcome in outcomes:
            estimated, true = map(increments, (outcome.estimates, outcome.run.truth))
            found.append(float(np.sum(estimated * true) / np.sum(true * true)))
        # A filter that does not use the step turns by the number of samples.
        samples = outcomes[0].run.dt[0] / outcomes[-1].run.dt[0]
        if abs(found[-1] - found[0]) < STEP * max(abs(found[0]), STEP) or (
                abs(found[-1] / samples - found[0]) > 0.25 * abs(found[0])):
            return
        # A wrong step turns up as a wrong scale at one rate.
        self.faults = [fault for fault in self.faults if not (
            fault.name == 'gyroscope_wiring' and 'time_step' in dict(self.faults))]
        self._add(Fault('time_step', f'at {" and ".join(f"{one.run.name}" for one in outcomes)} '
                        f'turns move it {" and ".join(f"{one:.3g}" for one in found)} times as '
                        'far as the sensor: the step is not used'))

    def _judge_lever_arm(self) -> None:
        """Compare the attitudes with and without a lever arm."""
        still, moving = map(self._record, (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The lever arm comes when the filter has settled, so that its start does not matter.
        begin, first, end = (round(t * scenarios.SLOW.rate) for t in ARM_S)
        with_arm = replace(still, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))
        arm, pivot = (self._corrected(run).estimates[first:end] for run in (with_arm, still))
        effect = rms(measures.errors_of(arm, pivot).tilt)
        self.measures['lever_arm_deg'] = math.degrees(effect)
        if effect > diagnosis.LEVER_ARM:
            self._add(Fault('lever_arm', f'10 cm off the axis adds {degrees(effect)}: motion is '
                            'mistaken for gravity'))

    def _judge_bias(self) -> None:
        """Compare two runs with and without a gyroscope bias."""
        if self._responses is not None:
            measured, fault = self._responses.bias()
            self.measures |= measured
            self._add(fault)


class _OneFilterExam(_Exam):
    """The runs of an exam of one filter that is never restarted, at the one rate of its IMU."""

    finer = FINER[:1]
    # After minutes of learning the bias the filter is too sure of it when the motion changes.
    judges_covariance = restarts = False
    _attitude = Rotation.identity()

    def sit(self) -> None:
        """Do all runs."""
        super().sit()
        if self.outcomes:
            with self._guarded():
                self._measure_convergence()

    def _follow(self, run: Run, undone: Sequence[Hypothesis] = ()) -> Outcome:
        """Return the outcome of a run, before which the sensor turns to where it begins."""
        lead = scenarios.turning(self._imu, self._attitude, run.start, TURN_S)
        outcome = super()._follow(run.after(lead), undone).since(len(lead.t))
        self._attitude = Rotation.from_quat(run.truth[-1])
        return outcome

    def _ask_for_field(self) -> None:
        """Turn the field to and fro: if the attitude follows, the heading can be judged."""
        level = Rotation.identity()
        n = round(TURN_S * scenarios.SLOW.rate / 3.0)
        run = scenarios.turning(self._imu, level, level, TURN_S, np.repeat(
            (0.5 * DECLINATION, -0.5 * DECLINATION, 0.5 * DECLINATION), n))
        # The sensor is level after each third, so the attitudes are equal for any misreading.
        one, two, three = Rotation.from_quat(self._follow(
            replace(run, name='field to and fro')).estimates[n - 1::n])
        # This sum is zero for a constant drift.
        moved = ((one.inv() * two).magnitude() + (two.inv() * three).magnitude()
                 - (one.inv() * three).magnitude())
        self._absolute = bool(moved > 0.2 * DECLINATION)

    def _measure_convergence(self) -> None:
        """Measure the convergence time after a jump of the true attitude by 90 degrees of tilt."""
        run = self._record(scenarios.SLOW)
        tilted = Rotation.from_euler('x', 90.0, degrees=True) * run.start
        lead = scenarios.turning(self._imu, tilted, tilted, TURN_S)
        outcome = self._follow(run.after(lead)).since(len(lead.t))
        self.measures['convergence_s'] = measures.convergence_time(run.t, outcome.errors.tilt)
