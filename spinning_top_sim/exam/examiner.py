# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter in Python: which runs it gets, and what follows from them."""

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, measures, scenarios
from spinning_top_sim.exam.diagnosis import Fault, Hypothesis
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Run, Scenario
from spinning_top_sim.exam.trial import (
    Feed,
    Input,
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
SEEDS = {'quick': range(3), 'full': range(10)}
# Of the gyroscope [rad/s], about all axes: 1.4 deg/s.
BIAS = (0.01, -0.01, 0.02)
BIASED = replace(scenarios.PIVOT, name='bias', duration=120.0, rate=25.0)
# Sampling rates for the order of convergence, relative to that of the fast motion.
FINER = (1.0, 2.0, 4.0)
FIELD_ASKED = 200           # updates after which a filter has shown whether it uses the field
EXTRA = (scenarios.POLE, scenarios.SATURATION, scenarios.DROPS, scenarios.COMMAND)
# A filter that is not made again is turned to where a run begins, so long [s].
TURN_S = 30.0
# It uses the field if it follows one that is turned to and fro by this, by a tenth [rad]; more
# would harm a filter that believes in small noise.
DECLINATION = np.radians(2.0)

NOTHING_MISREAD = Hypothesis((), '')
# Number of a run, and what came of it; and what computes them for numbers, in any order.
Result = tuple[int, Outcome | InvalidOutputError]
Compute = Callable[[Callable[[int], Result], Iterable[int]], Iterable[Result]]


def examine(make_filter: MakeFilter, level: str = 'quick',
            imu: Mapping[str, Any] | str | Path | None = None,
            seeds: int | Iterable[int] | None = None, *, subject: str | None = None,
            workers: int = 1, isolated: bool = True, restart: bool = True) -> Report:
    """
    Examine an attitude filter.

    Parameters
    ----------
    make_filter : callable
        Returns a new filter, see `trial.Filter`; it is called for every run.
    level : {'quick', 'full'}
        'full' has more seeds and motions.
    imu : mapping or path, optional
        Parameters imu.* and mag.* by name, or the path of a file of them, as in config/imu;
        default: the noise of a calibrated device, `scenarios.CALIBRATED`.
    seeds : int or iterable of int, optional
        Of noise and start of the noisy runs, or how many; default: SEEDS of the level.
    subject : str, optional
        Name in the report; default: that of the filter's class.
    workers : int, optional
        Processes that share the seeds and the motions of level 'full', by Dask; 1: this one.
    isolated : bool, optional
        False feeds the filter in this process, where a debugger finds it, and where one that
        never returns, or crashes, ends the exam.
    restart : bool, optional
        False makes one filter, in this process, which goes on from run to run.

    Returns
    -------
    Report
        Faults with their evidence, and measures.

    Raises
    ------
    ValueError
        For a level, parameter, seed or number of workers that is not allowed.
    OSError
        If the file cannot be read.
    ImportError
        For several workers without Dask.
    EnsembleError
        If the workers are lost.
    NodeError
        If a node that runs is not there, or others publish on its topics.

    Notes
    -----
    The same arguments give the same report, unless the filter itself is random.  A filter that
    raises, never returns or returns what is no attitude has the fault `invalid_output`; the other
    runs go on.
    """
    if level not in SEEDS:
        raise ValueError(f'level = {level!r}: must be one of {", ".join(SEEDS)}')
    values = (scenarios.CALIBRATED if imu is None else
              imu if isinstance(imu, Mapping) else read_scene(imu))
    parameters.checked(values)
    others = [name for name in values if not name.startswith(('imu.', 'mag.'))]
    if others:
        raise ValueError(f'{"imu" if isinstance(imu, Mapping) else imu} has {", ".join(others)}: '
                         'must have parameters imu.* and mag.* only')
    numbers = list(SEEDS[level] if seeds is None else
                   range(seeds) if isinstance(seeds, int | np.integer) else
                   seeds if isinstance(seeds, Iterable) else ())
    if not numbers or not all(isinstance(seed, int | np.integer) and seed >= 0
                              for seed in numbers):
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    if not 1 <= workers <= 1024 or (workers > 1 and not (isolated and restart)):
        raise ValueError(f'workers = {workers}: must be from 1 to 1024, and 1 for a filter in '
                         'this process')
    with _computing_by(workers) as compute:
        conditions = (_Conditions(make_filter, feed_apart if isolated else feed, values)
                      if restart else _OneFilter(cache(make_filter), feed, values))
        exam = (_Exam if restart else _OneFilterExam)(
            conditions, [int(seed) for seed in numbers], compute)
        exam.sit(EXTRA if level == 'full' else ())
    return Report(one_line(subject or getattr(make_filter, '__name__', 'filter')),
                  tuple(diagnosis.one_of_each(exam.faults)), exam.measures, exam.outcomes)


@contextlib.contextmanager
def _computing_by(workers: int) -> Iterator[Compute]:
    if workers == 1:
        yield map
        return
    try:
        from spinning_top_sim.tools import ensemble_cluster  # noqa: PLC0415
    except ImportError as error:
        raise ImportError("several workers need Dask: pip install 'spinning_top_sim[exam]' "
                          f'({error})') from error
    with ensemble_cluster.connect(workers, None) as client:
        yield partial(ensemble_cluster.compute, client)


@dataclass
class _Conditions:
    """
    What the runs of an exam have in common.

    correction : the misreading that is known already; it is undone
    """

    make_filter: MakeFilter
    feed: Feed
    imu: Mapping[str, Any]
    correction: Hypothesis = NOTHING_MISREAD

    def follow(self, run: Run, given: Input | None = None, magnetometer: bool = True) -> Outcome:
        """Feed a new filter."""
        try:
            return follow(self.make_filter, run, _both(self.correction.given, given),
                          self.correction.read, magnetometer, self.feed)
        except InvalidOutputError as error:
            raise InvalidOutputError(f'{run.name}: {error}') from error

    def follow_one(self, runs: Sequence[tuple[Scenario, int]], number: int) -> Result:
        """Feed a new filter with one of these scenarios and seeds."""
        scenario, seed = runs[number]
        try:
            return number, self.follow(scenarios.record(scenario, self.imu, seed))
        except InvalidOutputError as error:
            return number, error


@dataclass
class _OneFilter(_Conditions):
    """
    The conditions of a filter that is made once.

    Before each run it is turned to where the run begins, so that it is settled there.

    attitude : where it is, q(world <- sensor)
    """

    attitude: scenarios.Reals = field(default_factory=lambda: np.array((0.0, 0.0, 0.0, 1.0)))

    def follow(self, run: Run, given: Input | None = None, magnetometer: bool = True) -> Outcome:
        """Feed the filter."""
        lead = scenarios.turning(self.imu, self.attitude, run.truth[0], TURN_S)
        outcome = super().follow(run.after(lead), given, magnetometer).since(len(lead.t))
        self.attitude = run.truth[-1]       # a filter that fails does so with its first step
        return outcome


class _Exam:
    """The runs of one exam."""

    finer: Sequence[float] = FINER
    biased = BIASED
    judges_covariance = True

    def __init__(self, conditions: _Conditions, seeds: Sequence[int], compute: Compute) -> None:
        self._conditions, self._seeds, self._compute = conditions, seeds, compute
        self._imu = conditions.imu
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
        offset, fault = diagnosis.stamp_fault(noisy[0].last(), self._absolute)
        self.measures['stamp_offset_s'] = offset.seconds
        self._add(fault)
        if not self.faults:
            self._guard(self._judge_divergence)
        if 'diverges' not in [one.name for one in self.faults]:     # else the rest says nothing
            for part in (self._judge_integration, partial(self._judge_lever_arm, noisy[0]),
                         self._judge_bias):
                self._guard(part)
        done = self._try([(scenario, self._seeds[0]) for scenario in extra])
        self.outcomes += done.values()
        for number, outcome in done.items():
            self.measures[f'tilt_rms_{extra[number].name}_deg'] = math.degrees(
                rms(outcome.last().errors.tilt))
        if not self.faults:
            self._add(diagnosis.divergence(noisy[0], self._absolute))
        consistency = diagnosis.consistency(noisy, self._absolute)
        self.measures |= diagnosis.nees_marks(consistency)
        if self.judges_covariance and not self.faults:  # else the errors have another reason
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
        run = scenarios.record(scenario, self._imu, seed)
        return self._conditions.follow(run, given, magnetometer)

    def _try(self, runs: Sequence[tuple[Scenario, int]]) -> dict[int, Outcome]:
        """Return the outcomes of scenarios and seeds by number, where the filter does not fail."""
        results = dict(self._compute(partial(self._conditions.follow_one, runs),
                                     range(len(runs))))
        done = {}
        for number in range(len(runs)):
            result = results[number]
            if isinstance(result, InvalidOutputError):
                self._add(Fault('invalid_output', str(result)))
            else:
                done[number] = result
        return done

    def _ask_for_field(self) -> None:
        """Find out whether another field gives other attitudes: then the heading counts."""
        run = scenarios.record(scenarios.SLOW, self._imu, self._seeds[0]).part(
            slice(FIELD_ASKED))
        other = replace(run, magnetometer=run.magnetometer[:, [1, 2, 0]])
        one, two = (self._conditions.follow(fed).estimates for fed in (run, other))
        self._absolute = bool(np.max(np.abs(one - two)) > 1e-9)

    def _judge_divergence(self) -> None:
        """Look at the errors without noise, bias and lever arm."""
        self._add(diagnosis.divergence(self._pivot, self._absolute))

    def _noisy_runs(self) -> list[Outcome]:
        """Return the outcomes on the slow motion, a misreading that explains them undone."""
        said = self._runs_of_seeds()
        self.outcomes += said
        if not said:
            return []

        def again(hypothesis: Hypothesis) -> Outcome:
            return self._run(scenarios.SLOW, self._seeds[0], hypothesis.given).last()

        settled = said[0].last()
        late = diagnosis.stamp_fault(settled, self._absolute)[1] is not None
        try:
            found = diagnosis.explain(settled, self._absolute, None if late else again)
        except InvalidOutputError:      # of a filter that cannot take other readings
            found = diagnosis.explain(settled, self._absolute, None)
        if found is None:
            return said
        self.faults += [Fault(name, found.text) for name in found.faults]
        # So that it hides nothing else.
        self._conditions.correction = found
        if found.given is None:
            return [replace(outcome, estimates=found.read(outcome.estimates))
                    for outcome in said]
        return self._runs_of_seeds()

    def _runs_of_seeds(self) -> list[Outcome]:
        """Return the outcomes on the slow motion; seeds with which the filter fails are left."""
        done = self._try([(scenarios.SLOW, seed) for seed in self._seeds])
        self._seeds = [self._seeds[number] for number in done]
        return list(done.values())

    def _judge_integration(self) -> None:
        """Compare sampling rates on the fast motion, without what could correct the heading."""
        magnetometer = False
        try:
            self._run(replace(scenarios.FAST, duration=0.1, reversals=()), self._seeds[0],
                      magnetometer=False)
        except InvalidOutputError:
            magnetometer = True
        absolute, seed = self._absolute and magnetometer, self._seeds[0]
        finer = [replace(scenarios.FAST, rate=factor * scenarios.FAST.rate)
                 for factor in self.finer]
        outcomes = [self._run(scenario, seed, magnetometer=magnetometer).last()
                    for scenario in finer]
        moved = [rms(measures.moved(outcome.estimates, outcome.run.truth))
                 for outcome in outcomes]
        self.measures['order'] = measures.convergence_order(self.finer, moved)
        self.measures['integration_error_deg'] = math.degrees(moved[0])
        corrected = self._run(finer[0], seed, diagnosis.for_first_order, magnetometer).last()
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
        arm = self._conditions.follow(replace(moving, accelerometer=np.concatenate(
            (still.accelerometer[:begin], moving.accelerometer[begin:])))).last()
        pivot = self._pivot.last()
        effect = rms(measures.errors_of(arm.estimates, pivot.estimates).tilt)
        self.measures['lever_arm_deg'] = math.degrees(effect)
        self._add(diagnosis.lever_arm_fault(
            effect, math.hypot(*scenarios.LEVER_ARM.values['imu.lever_arm'])))
        density = self._imu.get('imu.accelerometer_noise_density', 0.0)
        if density:
            quiet = pivot if not any(self._imu.get('imu.lever_arm', ())) else self._run(
                replace(scenarios.SLOW, noisy=False), seed).last()
            tilt = rms(measures.errors_of(noisy.last().estimates, quiet.estimates).tilt)
            sample = density * math.sqrt(scenarios.SLOW.rate) / scenarios.GRAVITY
            self.measures['noise_gain'] = tilt / (math.sqrt(2.0) * sample)

    def _judge_bias(self) -> None:
        """Compare two runs with opposite biases of the gyroscope."""
        x, y, z = BIAS
        plus, minus = (self._run(replace(self.biased, bias=bias), self._seeds[0])
                       for bias in (BIAS, (-x, -y, -z)))
        effect = diagnosis.bias_effect(plus, minus, np.array(BIAS), self._absolute)
        self.measures['bias_error_s'] = effect.late
        self.measures['bias_found'] = math.nan if effect.found is None else effect.found
        self._add(diagnosis.bias_fault(effect, self._absolute))


class _OneFilterExam(_Exam):
    """The runs of an exam of one filter that goes on: at one rate, as an IMU has it."""

    finer = FINER[:1]
    biased = replace(BIASED, rate=scenarios.SLOW.rate)
    # A filter that has learned its bias for minutes is too sure of it when the motion changes.
    judges_covariance = False

    def sit(self, extra: Sequence[Scenario]) -> None:
        """Do all the runs."""
        super().sit(extra)
        if self._seeds and self.outcomes:
            self._guard(self._tilt)

    def _ask_for_field(self) -> None:
        """Turn the field to and fro: where the attitude follows, the heading counts."""
        level = np.array((0.0, 0.0, 0.0, 1.0))
        n = round(TURN_S * scenarios.SLOW.rate / 3.0)
        run = scenarios.turning(self._imu, level, level, TURN_S, np.repeat(
            (0.5 * DECLINATION, -0.5 * DECLINATION, 0.5 * DECLINATION), n))
        # After each third the sensor is level: the attitudes are equal, whatever is misread.
        one, two, three = Rotation.from_quat(self._conditions.follow(
            replace(run, name='field to and fro')).estimates[n - 1::n])
        # A drift goes on: it makes this zero.
        moved = ((one.inv() * two).magnitude() + (two.inv() * three).magnitude()
                 - (one.inv() * three).magnitude())
        self._absolute = bool(moved > 0.2 * DECLINATION)

    def _tilt(self) -> None:
        """Measure how long it takes after the sensor is tilted by 90 degrees, in no time."""
        run = scenarios.record(scenarios.SLOW, self._imu, self._seeds[0])
        tilted = Rotation.from_euler('x', 90.0, degrees=True) * Rotation.from_quat(run.truth[0])
        lead = scenarios.turning(self._imu, tilted.as_quat(), tilted.as_quat(), TURN_S)
        outcome = self._conditions.follow(run.after(lead)).since(len(lead.t))
        self.measures['convergence_s'] = measures.convergence_time(run.t, outcome.errors.tilt)


def _both(first: Input | None, second: Input | None) -> Input | None:
    """Return the change of readings by `second`, and then by `first`."""
    if first is None or second is None:
        return first or second

    def given(gyroscope: scenarios.Reals, accelerometer: scenarios.Reals, dt: scenarios.Reals,
              ) -> tuple[scenarios.Reals, scenarios.Reals]:
        return first(*second(gyroscope, accelerometer, dt), dt)
    return given
