# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: the runs that it consists of, and the report on them."""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.bias import judge_bias
from spinning_top_sim.exam.diagnosis import degrees
from spinning_top_sim.exam.field import examine_field
from spinning_top_sim.exam.integration import judge_integration
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Findings, Report
from spinning_top_sim.exam.response import Response
from spinning_top_sim.exam.subject import LastingSubject, Subject
from spinning_top_sim.exam.trial import InvalidOutputError, MakeFilter, Outcome, feed
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.tools.verdict import Fault

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10), 'field': range(1)}
# When the lever arm comes, and from when until when its effect is measured [s].  Later the
# estimate of a bias would have adapted to the force.
ARM_S = 13.33, 14.33, 19.33
# What begins the names of the parameters that the exam takes, and that only its scenes take.
TAKEN = ('imu.gyroscope_', 'imu.accelerometer_', 'imu.bias_', *scenarios.OF_PLACE, 'mag.enabled',
         'mag.soft_iron', 'mag.hard_iron', 'mag.noise_density', 'mag.random_walk', 'mag.range',
         'mag.resolution')
OF_SCENES = 'imu.bandwidth', 'imu.vibration.', 'mag.disturbance.'


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
        Only the scenes of the field have bandwidth, vibration and disturbed fields.
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
    has_scenes = level == 'field' or (level == 'full' and restart)
    values = _imu_parameters(imu, has_scenes)
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
    values = {name: value for name, value in values.items() if not name.startswith(OF_SCENES)}
    exam = _Exam(Subject(make_filter, run_feed, values, numbers[0]) if restart else
                 LastingSubject(make_filter, values, numbers[0]), numbers)
    exam.sit()
    if has_scenes and exam.outcomes:
        scenes = in_field(numbers[:1])
        exam.findings.measures |= scenes.measures
        exam.findings.faults += scenes.found
    return exam.findings.report(subject, exam.outcomes)


def _imu_parameters(imu: Mapping[str, Any] | str | Path | None,
                    has_scenes: bool) -> Mapping[str, Any]:
    if imu is None:
        return scenarios.CALIBRATED
    given = imu if isinstance(imu, Mapping) else read_scene(imu)
    checked = parameters.checked(given)
    source = 'imu' if imu is given else imu
    for name in given:
        if not name.startswith(('imu.', 'mag.')):
            raise ValueError(f'{source} has {name}: must have parameters imu.* and mag.* only')
        taken = has_scenes if name.startswith(OF_SCENES) else name.startswith(TAKEN)
        default = parameters.BY_NAME[name].default
        if not taken and checked[name] != default:
            raise ValueError(f'{source} has {name} = {given[name]!r}: must be {default!r}, '
                             'because this exam has no run with it')
    if not any(checked['mag.field'][:2]):
        raise ValueError(f'{source} has mag.field = {given["mag.field"]!r}: must have a '
                         'horizontal part, which shows north')
    return {name: checked[name] for name in given}


def _seed_numbers(seeds: int | Iterable[int]) -> list[int]:
    try:
        numbers = list(map(operator.index, seeds if isinstance(seeds, Iterable) else range(seeds)))
    except TypeError:
        numbers = []
    if not numbers or min(numbers) < 0:
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    return numbers


class _Exam:
    """The runs of one exam."""

    def __init__(self, subject: Subject, seeds: Sequence[int]) -> None:
        self._subject, self._seeds = subject, seeds
        self.findings = Findings()
        self.outcomes: list[Outcome] = []       # of the noisy runs

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
            diagnosis.error_measures(self.outcomes, self._absolute) | self.findings.measures)
        self._do(partial(judge_integration, self._response))
        if not self._response.unclear:
            self._do(self._judge_lever_arm)
            if identified:
                self._do(partial(judge_bias, self._response))
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
        if self._subject.restarts and self._subject.shares_state():
            raise InvalidOutputError('the attitudes depend on a filter that ran before in '
                                     'the same process: filters must share no state')
        self._absolute = self._subject.uses_field()
        self._response = Response(self._subject, self._absolute, self.findings)

    def _do_noisy_run(self, seed: int) -> None:
        self.outcomes.append(self._response.respond(
            self._subject.record(scenarios.SLOW, seed), shifted=False))

    def _judge_noisy_runs(self) -> None:
        measured = self.findings.measures
        measured |= diagnosis.quality(self.outcomes, self._subject.imu, self._absolute)
        measured['stamp_offset_s'] = diagnosis.offset_of(
            self.outcomes[0].last(), self._absolute).seconds
        outcomes = [self._response.respond(one.run) for one in self.outcomes
                    ] if self._response.shifts else self.outcomes
        self._judge_errors(outcomes)
        self._judge_covariance(outcomes)

    def _judge_errors(self, outcomes: Sequence[Outcome]) -> None:
        limit = diagnosis.noisy_limit(outcomes[0].run, self._absolute, self._subject.imu)
        for outcome in outcomes:
            if fault := diagnosis.inaccuracy(outcome, self._absolute, limit):
                self.findings.faults.append(self._response.blamed(fault))
                return

    def _judge_covariance(self, outcomes: Sequence[Outcome]) -> None:
        consistency = diagnosis.consistency(outcomes, self._absolute)
        self.findings.measures |= diagnosis.nees_measures(consistency)
        # Faults are another reason for errors; without noise there is nothing random to judge by.
        # After minutes of learning the bias, a filter that goes on is too sure of it.
        if self._subject.restarts and not self.findings.faults and any(
                self._subject.imu.get(f'imu.{sensor}_noise_density')
                for sensor in ('gyroscope', 'accelerometer')):
            self.findings.faults += filter(None, [diagnosis.covariance_fault(consistency)])

    def _judge_lever_arm(self) -> None:
        """Compare the attitudes with and without a lever arm."""
        still, moving = map(self._subject.record, (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The lever arm comes when the filter has settled, so that its start does not matter.
        begin, first, end = (round(t * scenarios.SLOW.rate) for t in ARM_S)
        with_arm = replace(still, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))
        arm, pivot = (self._response.respond(run).estimates[first:end]
                      for run in (with_arm, still))
        effect, before = (rms(measures.errors_of(one, other).tilt) for one, other in (
            (arm, pivot), (pivot, still.truth[first:end])))
        self.findings.measures['lever_arm_deg'] = math.degrees(effect)
        if effect > max(diagnosis.LEVER_ARM, before):
            self.findings.faults.append(Fault(
                'lever_arm', f'10 cm off the axis adds {degrees(effect)}: motion is mistaken for '
                'gravity'))
