# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: the runs that it consists of, and the report on them."""

import contextlib
import math
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.course import increments
from spinning_top_sim.exam.diagnosis import Fault, Hypothesis
from spinning_top_sim.exam.field import examine_field
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.response import Responses
from spinning_top_sim.exam.scenarios import Reals, Run, Scenario
from spinning_top_sim.exam.trial import (
    ChangeReadings,
    Feed,
    InvalidOutputError,
    MakeFilter,
    Outcome,
    feed,
    follow,
    one_line,
)
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10), 'field': range(1)}
# Sampling rates for the order of convergence, as multiples of the rate of the fast motion.
FINER = (1.0, 2.0)
FIELD_ASKED = 200, 1000     # updates after which a filter has shown whether it uses the field
EXTRA = (scenarios.POLE, scenarios.SATURATION, scenarios.DROPS, scenarios.COMMAND)
# A filter that is not restarted is first turned to the attitude at which the run begins [s].
TURN_S = 30.0
# A filter uses the field if its heading follows at least a tenth of this alternating turn of the
# field [rad].  A larger turn would disturb a filter that assumes low noise.
DECLINATION = np.radians(2.0)
# These faults do not show in runs without noise, bias and lever arm.
SHOW_ELSEWHERE = ('inaccurate', 'lever_arm', 'no_bias_estimate', 'bias_report', 'invalid_output')
ARM_S = 1.0, 6.0                # after the lever arm came, its effect is measured
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
        'full' has more seeds and motions, and a seed of the scenes of 'field'.
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
    in_field = partial(examine_field, make_filter, subject=subject,
                       imu=None if imu is None else values,
                       feed=feed_apart if isolated else feed)
    if level == 'field':
        if not restart:
            raise ValueError("level = 'field': the filter must be made anew for each scene")
        return in_field(numbers)
    exam = (_Exam(_NewFilter(make_filter, feed_apart if isolated else feed, values), numbers)
            if restart else _OneFilterExam(_OneFilter(cache(make_filter), feed, values), numbers))
    exam.sit(EXTRA if level == 'full' else ())
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


@dataclass
class _NewFilter:
    """Feeds each run to a new filter, and undoes the misreadings that were already found."""

    make_filter: MakeFilter
    feed: Feed
    imu: Mapping[str, Any]

    def follow(self, run: Run, undone: Sequence[Hypothesis] = (),
               change: ChangeReadings | None = None, magnetometer: bool = True) -> Outcome:
        """Return the outcome of a run whose readings are first changed by `change`."""
        changes = [one for one in (change, *(one.given for one in undone)) if one is not None]

        def read(estimates: Reals) -> Reals:
            for one in reversed(undone):
                estimates = one.read(estimates)
            return estimates

        try:
            return follow(self.make_filter, run, changes, read, magnetometer, self.feed)
        except InvalidOutputError as error:
            raise InvalidOutputError(f'{run.name}: {error}') from error


@dataclass
class _OneFilter(_NewFilter):
    """Feeds all runs to one filter; before each the sensor turns slowly to where it begins."""

    attitude: Reals = field(default_factory=lambda: np.array((0.0, 0.0, 0.0, 1.0)))

    def follow(self, run: Run, undone: Sequence[Hypothesis] = (),
               change: ChangeReadings | None = None, magnetometer: bool = True) -> Outcome:
        """Return the outcome of a run whose readings are first changed by `change`."""
        lead = scenarios.turning(self.imu, self.attitude, run.truth[0], TURN_S)
        outcome = super().follow(run.after(lead), undone, change, magnetometer).since(len(lead.t))
        self.attitude = run.truth[-1]       # not reached if the filter fails in its first step
        return outcome


class _Exam:
    """The runs of one exam, and what they show."""

    finer: Sequence[float] = FINER
    judges_covariance = restarts = True

    def __init__(self, subject: _NewFilter, seeds: Sequence[int]) -> None:
        self._subject, self._seeds, self._imu = subject, seeds, subject.imu
        self._absolute = False
        self._responses: Responses | None = None
        self.faults: list[Fault] = []
        self.measures: dict[str, float] = {}
        self.outcomes: list[Outcome] = []

    def sit(self, extra: Sequence[Scenario]) -> None:
        """Do all runs, those of the `extra` scenarios included."""
        with self._guarded():
            self._ask_for_field()
        with self._guarded():
            self._identify()
        noisy = self._noisy_runs()
        if not noisy:
            return
        self.measures |= diagnosis.marks(self.outcomes, self._absolute)
        offset, fault = diagnosis.stamp_fault(noisy[0].last(), self._absolute)
        self.measures['stamp_offset_s'] = offset.seconds
        self._add(fault)
        self._add(diagnosis.divergence(noisy[0], self._absolute))
        clear = self._responses is None or not self._responses.unclear
        for part in (self._judge_integration, partial(self._judge_lever_arm, noisy[0]),
                     self._judge_bias)[:3 if clear else 1]:
            with self._guarded():
                part()
        self._do_extra(extra)
        if not self.faults:
            self._add(diagnosis.inaccuracy(noisy[0], self._absolute))
        if any(fault.name not in SHOW_ELSEWHERE for fault in self.faults):
            self.faults = [fault for fault in self.faults if fault.name != 'inaccurate']
        consistency = diagnosis.consistency(noisy, self._absolute)
        self.measures |= diagnosis.nees_marks(consistency)
        if self.judges_covariance and not self.faults:  # faults are another reason for errors
            self._add(diagnosis.covariance_fault(consistency))

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

    def _run(self, scenario: Scenario, change: ChangeReadings | None = None,
             magnetometer: bool = True, seed: int | None = None) -> Outcome:
        """Return the outcome of a scenario, by default with the first seed."""
        return self._follow(self._record(scenario, seed), change, magnetometer)

    def _follow(self, run: Run, change: ChangeReadings | None = None,
                magnetometer: bool = True) -> Outcome:
        undone = self._responses.undone if self._responses is not None else ()
        return self._subject.follow(run, undone, change, magnetometer)

    def _record(self, scenario: Scenario, seed: int | None = None) -> Run:
        return scenarios.record(scenario, self._imu, self._seeds[0] if seed is None else seed)

    def _ask_for_field(self) -> None:
        """Find out whether the filter uses the field: only then its heading can be judged."""
        for updates in FIELD_ASKED:
            run = self._record(scenarios.SLOW).part(slice(updates))
            other = replace(run, magnetometer=run.magnetometer[:, [1, 2, 0]])
            one, two = (self._subject.follow(fed).estimates for fed in (run, other))
            self._absolute = bool(np.max(np.abs(one - two)) > 1e-9)
            if self._absolute:
                break

    def _identify(self) -> None:
        """Name the causes that show in the answers to single inputs; they are undone from now."""
        self._responses = found = Responses(
            self._subject.follow, self._imu, self._absolute, self.restarts)
        try:
            found.identify()
        finally:
            self.faults += found.faults
        clean = found.clean(found.outcome)
        self.measures |= {'tilt_clean_deg': math.degrees(max(clean.tilt, clean.tilt_moving)),
                          'heading_clean_deg': math.degrees(max(
                              clean.heading, clean.heading_moving))}

    def _noisy_runs(self) -> list[Outcome]:
        """Return the outcomes on the slow motion; drop the seeds for which the filter failed."""
        done = {}
        for seed in self._seeds:
            with self._guarded():
                done[seed] = self._run(scenarios.SLOW, seed=seed)
        self._seeds = list(done)
        self.outcomes += done.values()
        return list(done.values())

    @cached_property
    def _pivot(self) -> Outcome:
        """The outcome without noise, bias and lever arm."""
        return self._run(scenarios.PIVOT)

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, if possible without the magnetometer."""
        magnetometer = False
        try:
            self._run(replace(scenarios.FAST, duration=0.1, reversals=()), magnetometer=False)
        except InvalidOutputError:
            magnetometer = True
        finer = [replace(scenarios.FAST, rate=factor * scenarios.FAST.rate)
                 for factor in self.finer]
        outcomes = [self._run(scenario, magnetometer=magnetometer).last() for scenario in finer]
        moved = [rms(measures.moved(outcome.estimates, outcome.run.truth))
                 for outcome in outcomes]
        self.measures['order'] = measures.convergence_order(self.finer, moved)
        self.measures['integration_error_deg'] = math.degrees(moved[0])
        self._judge_step(outcomes)
        corrected = self._run(finer[0], diagnosis.for_first_order, magnetometer).last()
        before, after = (diagnosis.error_of(outcome, self._absolute and magnetometer)
                         for outcome in (outcomes[0], corrected))
        self._add(diagnosis.first_order_fault(before, after, finer[0].rate))

    def _judge_lever_arm(self, noisy: Outcome) -> None:
        """Compare the attitudes with and without a lever arm, and with and without noise."""
        still, moving = map(self._record, (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The lever arm comes when the filter has settled, so that its start does not matter.
        begin = 2 * len(still.t) // 3
        arm = self._follow(replace(moving, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:]))))
        # Later the estimate of a bias would have adapted to the force.
        rows = slice(*(begin + round(t * scenarios.SLOW.rate) for t in ARM_S))
        effect = rms(measures.errors_of(
            arm.estimates[rows], self._pivot.estimates[rows]).tilt)
        self.measures['lever_arm_deg'] = math.degrees(effect)
        self._add(diagnosis.lever_arm_fault(
            effect, math.hypot(*scenarios.LEVER_ARM.values['imu.lever_arm'])))
        density = self._imu.get('imu.accelerometer_noise_density', 0.0)
        if density:
            quiet = self._pivot if not any(self._imu.get('imu.lever_arm', ())) else self._run(
                replace(scenarios.PIVOT, values=scenarios.SLOW.values))
            rows = slice(len(still.t) // 2, len(still.t))
            tilt = rms(measures.errors_of(noisy.estimates[rows], quiet.estimates[rows]).tilt)
            sample = density * math.sqrt(scenarios.SLOW.rate) / scenarios.GRAVITY
            self.measures['noise_gain'] = tilt / (math.sqrt(2.0) * sample)

    def _judge_step(self, outcomes: Sequence[Outcome]) -> None:
        """Compare the answers to the same rates in steps of different lengths."""
        answers = []
        for outcome in outcomes:
            said, true = map(increments, (outcome.estimates, outcome.run.truth))
            answers.append(float(np.sum(said * true) / np.sum(true * true)))
        if abs(answers[-1] - answers[0]) < STEP * max(abs(answers[0]), STEP):
            return
        # A wrong step turns up as a wrong scale at one rate.
        self.faults = [fault for fault in self.faults if not (
            fault.name == 'gyroscope_wiring' and 'time_step' in dict(self.faults))]
        self._add(Fault('time_step', f'at {" and ".join(f"{one.run.name}" for one in outcomes)} '
                        f'turns move it {" and ".join(f"{one:.3g}" for one in answers)} times as '
                        'far as the sensor: the step is not used'))

    def _judge_bias(self) -> None:
        """Compare two runs with and without a gyroscope bias."""
        if self._responses is not None:
            measured, fault = self._responses.bias()
            self.measures |= measured
            self._add(fault)

    def _do_extra(self, extra: Sequence[Scenario]) -> None:
        for scenario in extra:
            with self._guarded():
                outcome = self._run(scenario)
                self.outcomes.append(outcome)
                self.measures[f'tilt_rms_{scenario.name}_deg'] = math.degrees(
                    rms(outcome.last().errors.tilt))


class _OneFilterExam(_Exam):
    """The runs of an exam of one filter that is never restarted, at the one rate of its IMU."""

    finer = FINER[:1]
    # After minutes of learning the bias the filter is too sure of it when the motion changes.
    judges_covariance = restarts = False

    def sit(self, extra: Sequence[Scenario]) -> None:
        """Do all runs."""
        super().sit(extra)
        if self._seeds and self.outcomes:
            with self._guarded():
                self._measure_convergence()

    def _ask_for_field(self) -> None:
        """Turn the field to and fro: if the attitude follows, the heading can be judged."""
        level = np.array((0.0, 0.0, 0.0, 1.0))
        n = round(TURN_S * scenarios.SLOW.rate / 3.0)
        run = scenarios.turning(self._imu, level, level, TURN_S, np.repeat(
            (0.5 * DECLINATION, -0.5 * DECLINATION, 0.5 * DECLINATION), n))
        # The sensor is level after each third, so the attitudes are equal for any misreading.
        one, two, three = Rotation.from_quat(self._subject.follow(
            replace(run, name='field to and fro')).estimates[n - 1::n])
        # This sum is zero for a constant drift.
        moved = ((one.inv() * two).magnitude() + (two.inv() * three).magnitude()
                 - (one.inv() * three).magnitude())
        self._absolute = bool(moved > 0.2 * DECLINATION)

    def _measure_convergence(self) -> None:
        """Measure the convergence time after a jump of the true attitude by 90 degrees of tilt."""
        run = self._record(scenarios.SLOW)
        tilted = Rotation.from_euler('x', 90.0, degrees=True) * Rotation.from_quat(run.truth[0])
        lead = scenarios.turning(self._imu, tilted.as_quat(), tilted.as_quat(), TURN_S)
        outcome = self._subject.follow(run.after(lead)).since(len(lead.t))
        self.measures['convergence_s'] = measures.convergence_time(run.t, outcome.errors.tilt)
