# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: the runs that it consists of, and the report on them."""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import degrees
from spinning_top_sim.exam.excitation import from_identity, words
from spinning_top_sim.exam.field import examine_field
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.response import Responses
from spinning_top_sim.exam.scenarios import Run, Scenario
from spinning_top_sim.exam.trial import (
    WITHOUT_FIELD,
    ChangeReadings,
    Feed,
    Hypothesis,
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
    exam = (_Exam(make_filter, run_feed, values, numbers) if restart else
            _OneFilterExam(cache(make_filter), run_feed, values, numbers))
    exam.sit()
    if level == 'full' and restart and exam.outcomes:
        exam.measures |= in_field(numbers[:1]).measures
    first: dict[str, Fault] = {}        # of each name: a misreading, which hides others, is first
    for fault in exam.faults:
        first.setdefault(fault.name, fault)
    return Report(subject, [*first.values()], exam.measures, exam.outcomes)


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


class _Exam(Responses):
    """The runs of one exam."""

    finer: Sequence[float] = FINER

    def __init__(self, make_filter: MakeFilter, feed: Feed, imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        super().__init__(make_filter, feed, imu)
        self._seeds = seeds
        self.outcomes: list[Outcome] = []

    def sit(self) -> None:
        """Do all runs."""
        self._do(self._ask_for_field)
        if self.faults:
            return
        identified = self._do(self._identify)
        for seed in self._seeds:        # those for which the filter fails are dropped
            self._do(partial(self._do_noisy_run, seed))
        if not self.outcomes:
            return
        self.measures = diagnosis.marks(self.outcomes, self._absolute) | self.measures
        self._do(self._judge_integration)
        if not self.unclear:
            self._do(self._judge_lever_arm)
            if identified:
                self._do(self._judge_bias)
        self._judge_noisy_runs()

    def _do(self, part: Callable[[], object]) -> bool:
        """Do a part of the exam; return False where the filter fails, which is reported."""
        try:
            part()
        except InvalidOutputError as error:
            self.faults.append(Fault('invalid_output', str(error)))
            return False
        return True

    def _run(self, run: Run, *changes: ChangeReadings) -> Outcome:
        """Return the outcome of a run; causes that have been found are undone."""
        return self._follow(run, [*(Hypothesis((), '', given=one) for one in changes),
                                  *self.undone])

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

    def _do_noisy_run(self, seed: int) -> None:
        self.outcomes.append(self._run(self._record(scenarios.SLOW, seed)))

    def _judge_noisy_runs(self) -> None:
        first = self.outcomes[0]
        self.measures |= diagnosis.quality(self.outcomes, self._imu, self._absolute)
        self.measures['stamp_offset_s'] = diagnosis.stamp_fault(
            first.last(), self._absolute)[0].seconds
        large = diagnosis.inaccuracy(first, self._absolute)
        if large and not self.faults and from_identity(self._early) > SLIGHT:
            large = Fault('gyroscope_wiring', f'{words(self._early)}; {large.evidence}')
        if large and (large.name == 'diverges' or not self.faults):
            self.faults.append(large)
        if any(fault.name not in SHOW_ELSEWHERE for fault in self.faults):
            self.faults = [fault for fault in self.faults if fault.name != 'inaccurate']
        consistency = diagnosis.consistency(self.outcomes, self._absolute)
        self.measures |= diagnosis.nees_marks(consistency)
        # Faults are another reason for errors; without noise there is nothing random to judge by.
        # After minutes of learning the bias, a filter that goes on is too sure of it.
        if self.restarts and not self.faults and any(
                self._imu.get(f'imu.{sensor}_noise_density')
                for sensor in ('gyroscope', 'accelerometer')):
            self.faults += filter(None, [diagnosis.covariance_fault(consistency)])

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, if possible without the magnetometer."""
        runs = [self._record(replace(scenarios.FAST, rate=factor * scenarios.FAST.rate))
                for factor in self.finer]
        changes: tuple[ChangeReadings, ...] = (WITHOUT_FIELD,)
        try:
            self._run(runs[0].part(slice(10)), *changes)
        except InvalidOutputError:
            changes = ()
        outcomes = [self._run(run, *changes).last() for run in runs]
        moved, gains = [], []
        for outcome in outcomes:
            one, true = map(Rotation.from_quat, (outcome.estimates, outcome.run.truth))
            moved.append(rms(((true[0] * one[0].inv()) * one * true.inv()).magnitude()))
            steps, right = map(increments, (outcome.estimates, outcome.run.truth))
            gains.append(float(np.sum(steps * right) / np.sum(right * right)))
        self.measures['order'] = measures.convergence_order(self.finer, moved)
        self.measures['integration_error_deg'] = math.degrees(moved[0])
        # A filter that does not use the step turns by the number of samples.
        apart = abs(gains[-1] - gains[0]) / max(abs(gains[0]), STEP)
        if apart > STEP and abs(gains[-1] / self.finer[-1] - gains[0]) < 0.25 * abs(gains[0]):
            # A wrong step turns up as a wrong scale at one rate.
            names = [fault.name for fault in self.faults]
            self.faults = [fault for fault in self.faults if not (
                fault.name == 'gyroscope_wiring' and 'time_step' in names)]
            self.faults.append(Fault(
                'time_step', f'at {" and ".join(run.name for run in runs)} turns move it '
                f'{" and ".join(f"{gain:.3g}" for gain in gains)} times as far as the sensor: the '
                'step is not used'))
        absolute = self._absolute and not changes
        before = diagnosis.error_of(outcomes[0], absolute)
        # An error of the scale does not fall with the rate.
        if before > diagnosis.FIRST_ORDER and not self.measures['order'] < 1.0:
            after = diagnosis.error_of(self._run(runs[0], for_first_order, *changes).last(),
                                       absolute)
            if after < diagnosis.FIRST_ORDER_LEFT * before:
                self.faults.append(Fault(
                    'first_order_integration', 'integration is first order: correcting it reduces '
                    f'the error on the fast motion from {degrees(before)} to {degrees(after)}'))

    def _judge_lever_arm(self) -> None:
        """Compare the attitudes with and without a lever arm."""
        still, moving = map(self._record, (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The lever arm comes when the filter has settled, so that its start does not matter.
        begin, first, end = (round(t * scenarios.SLOW.rate) for t in ARM_S)
        with_arm = replace(still, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))
        arm, pivot = (self._run(run).estimates[first:end] for run in (with_arm, still))
        effect = rms(measures.errors_of(arm, pivot).tilt)
        self.measures['lever_arm_deg'] = math.degrees(effect)
        if effect > diagnosis.LEVER_ARM:
            self.faults.append(Fault('lever_arm', f'10 cm off the axis adds {degrees(effect)}: '
                                     'motion is mistaken for gravity'))


class _OneFilterExam(_Exam):
    """The runs of an exam of one filter that is never restarted, at the one rate of its IMU."""

    finer = FINER[:1]
    restarts = False
    _attitude = Rotation.identity()

    def sit(self) -> None:
        """Do all runs."""
        super().sit()
        if self.outcomes:
            self._do(self._measure_convergence)

    def _follow(self, run: Run, undone: Sequence[Hypothesis] = ()) -> Outcome:
        """Return the outcome of a run, before which the sensor turns to where it begins."""
        lead = scenarios.turning(self._imu, self._attitude, run.start, TURN_S)
        self._attitude = Rotation.from_quat(run.truth[-1])
        return super()._follow(run.after(lead), undone).part(slice(len(lead.t), None))

    def _ask_for_field(self) -> None:
        """Turn the field to and fro: if the attitude follows, the heading can be judged."""
        level = Rotation.identity()
        n = round(TURN_S * scenarios.SLOW.rate / 3.0)
        run = scenarios.turning(self._imu, level, level, TURN_S)
        turns = Rotation.from_quat(run.truth)
        west = Rotation.from_rotvec(0.5 * DECLINATION * np.repeat(
            ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)), n, axis=0))
        run = replace(run, name='field to and fro', magnetometer=(
            turns.inv() * west * turns).apply(run.magnetometer))
        # The sensor is level after each third, so the attitudes are equal for any misreading.
        one, two, three = Rotation.from_quat(self._follow(run).estimates[n - 1::n])
        # This sum is zero for a constant drift.
        moved = ((one.inv() * two).magnitude() + (two.inv() * three).magnitude()
                 - (one.inv() * three).magnitude())
        self._absolute = bool(moved > 0.2 * DECLINATION)

    def _measure_convergence(self) -> None:
        """Measure the convergence time after a jump of the true attitude by 90 degrees of tilt."""
        run = self._record(scenarios.SLOW)
        tilted = Rotation.from_euler('x', 90.0, degrees=True) * run.start
        tilt = self._follow(run.after(scenarios.turning(
            self._imu, tilted, tilted, TURN_S))).errors.tilt[-len(run.t):]
        self.measures['convergence_s'] = measures.convergence_time(run.t, tilt)


def for_first_order(run: Run) -> Run:
    """Return the rates for which the normalised first-order step q + q w dt/2 is exact."""
    half = 0.5 * run.dt[:, np.newaxis] * np.linalg.norm(run.gyroscope, axis=1, keepdims=True)
    longer = np.tan(np.minimum(half, 1.5)) / np.where(half > 0.0, half, 1.0)
    return replace(run, gyroscope=longer * run.gyroscope)
