# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: which runs it gets, and what follows from them."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import Fault, Hypothesis
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Run, Scenario
from spinning_top_sim.exam.trial import Input, InvalidOutputError, MakeFilter, Outcome, follow
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10)}
# Of the gyroscope [rad/s], about all axes: 1.4 deg/s.
BIAS = (0.01, -0.01, 0.02)
BIASED = replace(scenarios.PIVOT, name='bias', duration=120.0, rate=25.0)
# Sampling rates for the order of convergence, relative to that of the fast motion.
FINER = (1.0, 2.0, 4.0)
FIELD_ASKED = 200           # updates after which a filter has shown whether it uses the field
EXTRA = (scenarios.POLE, scenarios.SATURATION, scenarios.DROPS, scenarios.COMMAND)


def examine(make_filter: MakeFilter, level: str = 'quick',
            imu: Mapping[str, Any] | str | Path | None = None,
            seeds: int | Iterable[int] | None = None,
            subject: str | None = None) -> Report:
    """
    Examine an attitude filter.

    Parameters
    ----------
    make_filter : callable
        Returns a new filter, see `trial.Filter`; it is called for every run.
    level : {'quick', 'full'}
        'full' has more seeds and motions.
    imu : mapping or path, optional
        Parameters of the IMU by name, or the path of a file of them, as in config/imu; default:
        the noise of a calibrated device, `scenarios.CALIBRATED`.
    seeds : int or iterable of int, optional
        Of noise and start of the noisy runs, or how many; default: SEEDS of the level.
    subject : str, optional
        Name in the report; default: that of the filter's class.

    Returns
    -------
    Report
        Faults with their evidence, and measures.

    Raises
    ------
    ValueError
        For a level, parameter or seed that is not allowed.
    OSError
        If the file cannot be read.

    Notes
    -----
    The same arguments give the same report, unless the filter itself is random.  A filter that
    raises or returns what is no attitude has the fault `invalid_output`; the other runs go on.
    """
    if level not in SEEDS:
        raise ValueError(f'level = {level!r}: must be one of {", ".join(SEEDS)}')
    values = (scenarios.CALIBRATED if imu is None else
              imu if isinstance(imu, Mapping) else read_scene(imu))
    parameters.checked(values)
    numbers = list(SEEDS[level] if seeds is None else
                   range(seeds) if isinstance(seeds, int) else seeds)
    if not numbers or not all(isinstance(seed, int | np.integer) and seed >= 0
                              for seed in numbers):
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    exam = _Exam(make_filter, values, [int(seed) for seed in numbers])
    exam.sit(EXTRA if level == 'full' else ())
    return Report(subject or str(getattr(make_filter, '__name__', 'filter')),
                  tuple(diagnosis.in_order(exam.faults)), exam.measures, exam.outcomes)


class _Exam:
    """The runs of one exam."""

    def __init__(self, make_filter: MakeFilter, imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._make_filter, self._imu, self._seeds = make_filter, imu, seeds
        self._correction = Hypothesis((), '')
        self._absolute = False
        self.faults: list[Fault] = []
        self.measures: dict[str, float] = {}
        self.outcomes: list[Outcome] = []

    def sit(self, extra: Sequence[Scenario]) -> None:
        """Do all the runs."""
        self._guard(self._ask_for_field)
        noisy = self._noisy_runs()
        if not noisy:
            return
        self.measures |= diagnosis.marks(self.outcomes, self._absolute)
        offset, fault = diagnosis.stamp_fault(noisy[0].later(), self._absolute)
        self.measures['stamp_offset_s'] = offset.seconds
        self._add(fault)
        if not self.faults:
            self._guard(self._judge_divergence)
        if 'diverges' not in [one.name for one in self.faults]:     # else the rest says nothing
            for part in (self._judge_integration, partial(self._judge_lever_arm, noisy[0]),
                         self._judge_bias):
                self._guard(part)
        for scenario in extra:
            outcome = self._try(scenario, self._seeds[0])
            if outcome is not None:
                self.measures[f'tilt_rms_{scenario.name}_deg'] = math.degrees(
                    rms(outcome.later().errors.tilt))
        if not self.faults:
            self._add(diagnosis.divergence(noisy[0], self._absolute))
        consistency = diagnosis.consistency(noisy, self._absolute)
        self.measures |= diagnosis.nees_marks(consistency)
        if not self.faults:         # else the errors have another reason
            self._add(diagnosis.covariance_fault(consistency))

    def _add(self, fault: Fault | None) -> None:
        if fault is not None:
            self.faults.append(fault)

    def _guard(self, part: Callable[[], None]) -> None:
        """Do a part of the exam; one that the filter fails does not end the others."""
        try:
            part()
        except InvalidOutputError as error:
            self._add(Fault('invalid_output', str(error)))

    def _run(self, scenario: Scenario, seed: int, given: Input | None = None,
             magnetometer: bool = True) -> Outcome:
        """Feed a new filter, with the misreading undone that is known already."""
        return self._follow(scenarios.record(scenario, self._imu, seed), given, magnetometer)

    def _follow(self, run: Run, given: Input | None = None, magnetometer: bool = True) -> Outcome:
        try:
            return follow(self._make_filter, run, _both(self._correction.given, given),
                          self._correction.read, magnetometer)
        except InvalidOutputError as error:
            raise InvalidOutputError(f'{run.name}: {error}') from error

    def _try(self, scenario: Scenario, seed: int) -> Outcome | None:
        try:
            outcome = self._run(scenario, seed)
        except InvalidOutputError as error:
            self._add(Fault('invalid_output', str(error)))
            return None
        self.outcomes.append(outcome)
        return outcome

    def _ask_for_field(self) -> None:
        """Find out whether another field gives other attitudes: then the heading counts."""
        run = scenarios.record(scenarios.SLOW, self._imu, self._seeds[0]).part(
            slice(FIELD_ASKED))
        other = replace(run, magnetometer=run.magnetometer[:, [1, 2, 0]])
        one, two = (self._follow(fed).estimates for fed in (run, other))
        self._absolute = bool(np.max(np.abs(one - two)) > 1e-9)

    def _judge_divergence(self) -> None:
        """Look at the errors without noise, bias and lever arm."""
        self._add(diagnosis.divergence(self._pivot, self._absolute))

    def _noisy_runs(self) -> list[Outcome]:
        """Return the outcomes on the slow motion, a misreading that explains them undone."""
        said = {seed: outcome for seed in self._seeds
                if (outcome := self._try(scenarios.SLOW, seed)) is not None}
        if not said:
            return []
        first = next(iter(said))

        def again(hypothesis: Hypothesis) -> Outcome:
            return self._run(scenarios.SLOW, first, hypothesis.given).later()

        try:
            found = diagnosis.explain(said[first].later(), self._absolute, again)
        except InvalidOutputError:      # of a filter that cannot take other readings
            found = diagnosis.explain(said[first].later(), self._absolute, None)
        if found is None:
            return list(said.values())
        self.faults += [Fault(name, found.text) for name in found.faults]
        # So that it hides nothing else.
        self._correction = found
        if found.given is None:
            return [replace(outcome, estimates=found.read(outcome.estimates))
                    for outcome in said.values()]
        return [self._run(scenarios.SLOW, seed) for seed in said]

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, without what could correct the heading."""
        magnetometer = False
        try:
            self._run(replace(scenarios.FAST, duration=0.1, reversals=()), self._seeds[0],
                      magnetometer=False)
        except InvalidOutputError:
            magnetometer = True
        absolute, seed = self._absolute and magnetometer, self._seeds[0]
        finer = [replace(scenarios.FAST, rate=factor * scenarios.FAST.rate) for factor in FINER]
        outcomes = [self._run(scenario, seed, magnetometer=magnetometer).later()
                    for scenario in finer]
        moved = [rms(measures.moved(outcome.estimates, outcome.run.truth))
                 for outcome in outcomes]
        self.measures['order'] = measures.convergence_order(FINER, moved)
        self.measures['integration_error_deg'] = math.degrees(moved[0])
        corrected = self._run(finer[0], seed, diagnosis.for_first_order, magnetometer).later()
        self._add(diagnosis.first_order_fault(
            diagnosis.error_of(outcomes[0], absolute), diagnosis.error_of(corrected, absolute),
            finer[0].rate))

    @cached_property
    def _pivot(self) -> Outcome:
        """What the filter says without noise, bias and lever arm."""
        return self._run(scenarios.PIVOT, self._seeds[0])

    def _judge_lever_arm(self, noisy: Outcome) -> None:
        """Compare the attitudes with and without a lever arm, and with and without noise."""
        seed = self._seeds[0]
        still, moving = (scenarios.record(scenario, self._imu, seed)
                         for scenario in (scenarios.PIVOT, scenarios.LEVER_ARM))
        # The filter has settled before, so that this is no matter of its start.
        begin = len(still.t) // 3
        arm = self._follow(replace(moving, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))).later()
        pivot = self._pivot.later()
        effect = rms(measures.errors_of(arm.estimates, pivot.estimates).tilt)
        self.measures['lever_arm_deg'] = math.degrees(effect)
        self._add(diagnosis.lever_arm_fault(
            effect, math.hypot(*scenarios.LEVER_ARM.values['imu.lever_arm'])))
        density = self._imu.get('imu.accelerometer_noise_density', 0.0)
        if density:
            tilt = rms(measures.errors_of(noisy.later().estimates, pivot.estimates).tilt)
            sample = density * math.sqrt(scenarios.SLOW.rate) / scenarios.GRAVITY
            self.measures['noise_gain'] = tilt / (math.sqrt(2.0) * sample)

    def _judge_bias(self) -> None:
        """Compare two runs with opposite biases of the gyroscope."""
        x, y, z = BIAS
        plus, minus = (self._run(replace(BIASED, bias=bias), self._seeds[0])
                       for bias in (BIAS, (-x, -y, -z)))
        effect = diagnosis.bias_effect(plus, minus, np.array(BIAS), self._absolute)
        self.measures['bias_error_s'] = effect.late
        self.measures['bias_found'] = math.nan if effect.found is None else effect.found
        self._add(diagnosis.bias_fault(effect, self._absolute))


def _both(first: Input | None, second: Input | None) -> Input | None:
    """Return the change of readings by `second`, and then by `first`."""
    if first is None or second is None:
        return first or second

    def given(gyroscope: scenarios.Reals, accelerometer: scenarios.Reals, dt: scenarios.Reals,
              ) -> tuple[scenarios.Reals, scenarios.Reals]:
        return first(*second(gyroscope, accelerometer, dt), dt)
    return given
