# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter: its runs, each fed when a check asks for it, and the loop over checks."""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import answers, bias, motions
from spinning_top_sim.exam.checks import CHECKS
from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter, Outcome, feed_apart
from spinning_top_sim.exam.feeding import feed as feed_here
from spinning_top_sim.exam.measures import Errors, errors_of
from spinning_top_sim.exam.motions import NEAR, RATE, Motion, Run
from spinning_top_sim.exam.scenes import examine_field
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.conventions import Convention
from spinning_top_sim.tools.report import Finding, Mark, Report
from spinning_top_sim.tools.scene_file import read_scene

# Seeds of the noisy runs.
SEEDS = {'quick': range(3), 'full': range(10), 'field': range(1)}
# A filter is settled if it has turned by less than STILL [rad] in the second half of a rest at
# the start; slow ones get longer ones.
LEADS_S, STILL = (10.0, 40.0, 160.0), math.radians(0.05)
ARM, ARM_AFTER_S = (0.1, 0.0, 0.0), 4.0     # of the IMU [m], and when it comes in the top's motion
FIELD_TURN = math.radians(3.0)              # of the field about the vertical
NOISE_LEAD_S, NOISE_S = 6.0, 20.0           # rest and motion of the noisy runs


def examine(make_filter: MakeFilter, level: str = 'quick',
            imu: Mapping[str, Any] | str | Path | None = None,
            seeds: int | Iterable[int] | None = None, *, subject: str | None = None,
            isolated: bool = True, feed: Feed | None = None,
            show: Callable[[float, float], object] | None = None,
            ) -> Report:
    """
    Examine an attitude filter.

    The filter has a method ``update(gyroscope, accelerometer, magnetometer, dt)``: the rotation
    of the step over its length [rad/s], specific force [m/s^2, +g upwards at rest] and field
    [T, or None] at its end, in the frame of the sensor, and the length of the step [s].  It
    returns the attitude at the end of the step, q(world <- sensor) in the order x, y, z, w; x of
    the world is east, y north and z up.  Attributes `covariance` and `bias` are optional, see
    `feeding.Filter`.

    Parameters
    ----------
    make_filter : callable
        Returns a new filter for every run: its class, a function, or one of `adapters.FILTERS`.
    level : {'quick', 'full', 'field'}
        'full' has more seeds, and a seed of the scenes of 'field'.
    imu : mapping or path, optional
        Parameters imu.* and mag.* that replace those of the noisy runs and of the scenes, or the
        path of a parameter file such as those in config/imu.
    seeds : int or iterable of int, optional
        Seeds of the noisy runs, or their number; default: SEEDS.
    subject : str, optional
        Name in the report; default: that of the filter's class.
    isolated : bool, optional
        If False, the filter runs in this process, where a debugger can reach it.
    feed, show : callable, optional
        What feeds a filter, as `feeding.feed`; what takes the number of parts done and to do.

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
    values = checked_imu(imu, level)
    numbers = list(SEEDS[level]) if seeds is None else _seed_numbers(seeds)
    feed = feed or (feed_apart if isolated else feed_here)
    show = show or (lambda done, total: None)
    subject = one_line(subject or getattr(make_filter, '__name__', 'filter'))
    if level == 'field':
        return examine_field(make_filter, subject, numbers, values, feed, show)
    of_noise = {name: value for name, value in values.items()
                if not name.startswith(motions.OF_SCENES)}
    report = Exam(make_filter, feed, {**motions.CALIBRATED, **of_noise}, numbers).sit(subject,
                                                                                      show)
    if level == 'full' and report.outcomes:
        scenes = examine_field(make_filter, subject, numbers[:1], values, feed, show)
        report = replace(report, found=[*report.found, *scenes.found],
                         marks={**report.marks, **scenes.marks},
                         notes=[*report.notes, *scenes.notes])
    return report


def checked_imu(imu: Mapping[str, Any] | str | Path | None, level: str) -> Mapping[str, Any]:
    """Return the parameters that are given.  Raises ValueError for what the level has not."""
    if imu is None:
        return {}
    given = imu if isinstance(imu, Mapping) else read_scene(imu)
    checked, source = parameters.checked(given), 'imu' if imu is given else imu
    taken = motions.TAKEN + motions.OF_SCENES * (level != 'quick')
    for name, value in given.items():
        if not name.startswith(('imu.', 'mag.')):
            raise ValueError(f'{source} has {name}: must have parameters imu.* and mag.* only')
        default = parameters.BY_NAME[name].default
        if not name.startswith(taken) and checked[name] != default:
            raise ValueError(f'{source} has {name} = {value!r}: must be {default!r}, because '
                             f'nothing in level {level} has it')
    if not any(checked['mag.field'][:2]):
        raise ValueError(f'{source} has mag.field = {given["mag.field"]!r}: must have a '
                         'horizontal part, which shows north')
    return {name: checked[name] for name in given if name.startswith(taken)}


def _seed_numbers(seeds: int | Iterable[int]) -> list[int]:
    try:
        numbers = list(map(operator.index, seeds if isinstance(seeds, Iterable) else range(seeds)))
    except TypeError:
        numbers = []
    if not numbers or min(numbers) < 0:
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    return numbers


class Exam:
    """
    The runs of one exam, and what the checks have found so far.

    convention : of the attitudes; it is undone in all outcomes
    """

    def __init__(self, make_filter: MakeFilter, feed: Feed, imu: Mapping[str, Any],
                 seeds: Sequence[int]) -> None:
        self._make_filter, self._feed = make_filter, feed
        self.imu, self.seeds = imu, seeds
        self.convention = Convention()
        self._outcomes: dict[str, list[Outcome]] = {}

    def sit(self, subject: str, show: Callable[[float, float], object]) -> Report:
        """Do all checks but those that a fault hides."""
        found: list[Finding] = []
        marks: dict[str, Mark] = {}
        hides: dict[str, list[str]] = {}
        for k, check in enumerate(CHECKS):
            show(k, len(CHECKS))
            names = [finding.name for finding in found]
            if hidden := [name for name in check.needs if name in names]:
                hides.setdefault(', '.join(hidden), []).append(check.mark)
                continue
            try:
                measured = check.measure(self)
            except InvalidOutputError as error:
                found.append(Finding('invalid_output', str(error)))
                continue
            if measured is None:
                continue
            limit = check.limit if measured.limit is None else measured.limit
            marks |= {check.mark: Mark(measured.value, limit, check.meaning), **measured.others}
            if measured.value > limit:
                found.append(Finding(measured.name or check.fault, measured.evidence,
                                     measured.value))
        show(len(CHECKS), len(CHECKS))
        notes = [f'not judged because of {names}: {", ".join(left_out)}'
                 for names, left_out in hides.items()]
        if 'field turned' in self._outcomes and not self.heading:
            notes.append('the magnetometer changes nothing: tilt and steady heading are judged')
        return Report(subject, found, marks, notes, self._outcomes.get('noise', ()))

    def outcomes(self, name: str) -> list[Outcome]:
        """Return the outcomes of a run by its name in RUNS, in our convention."""
        if name not in self._outcomes:
            self._outcomes[name] = self.fed(RUNS[name](self))
        return self._outcomes[name]

    def fed(self, runs: Sequence[Run]) -> list[Outcome]:
        """Return the outcomes of other runs, in our convention."""
        told = self._feed(self._make_filter, runs)
        return [replace(one, estimates=self.convention.undo(one.estimates)) for one in told
                ] if self.convention.parts else told

    def read_in(self, convention: Convention) -> None:
        """Read the attitudes of all runs in another convention than before."""
        self._outcomes = {name: [replace(one, estimates=convention.undo(
            self.convention.tell(one.estimates))) for one in outcomes]
            for name, outcomes in self._outcomes.items() if name != 'turns'}
        self.convention = convention

    @cached_property
    def lead_s(self) -> float:
        """How long the filter rests at the start until it is settled [s]."""
        for seconds in LEADS_S[:-1]:
            (outcome,) = self.fed([Motion(motions.euler(NEAR)).rest(seconds).run('rest')])
            turns = Rotation.from_quat(outcome.estimates[len(outcome.estimates) // 2:])
            if float(np.max((turns[0].inv() * turns).magnitude())) < STILL:
                return seconds
        return LEADS_S[-1]

    @cached_property
    def motion(self) -> Motion:
        """The excitation."""
        return motions.excitation(self.lead_s)

    @cached_property
    def run(self) -> Run:
        """The excitation as a perfect IMU reads it."""
        return self.motion.run('excitation')

    @cached_property
    def heading(self) -> bool:
        """Whether the field changes attitudes: only then the heading is judged against north."""
        one, other = (self.outcomes(name)[0].estimates for name in ('excitation', 'field turned'))
        return bool(np.max(np.abs(one - other)) > 1e-6)

    @cached_property
    def bias(self) -> tuple[Outcome, list[bias.Effect]]:
        """The effects of a bias."""
        return bias.effects(self)

    def errors(self, name: str = 'excitation') -> Errors:
        """Return the errors in the excitation; without north, the heading from when settled on."""
        errors = errors_of(self.outcomes(name)[0].estimates, self.run.truth)
        if not self.heading:
            turned = errors.heading - errors.heading[round(self.lead_s * RATE)]
            errors = errors._replace(heading=(turned + math.pi) % math.tau - math.pi)
        return errors

    @cached_property
    def clean(self) -> Errors:
        """The errors in the excitation; filters may read force and field at the begin of steps."""
        errors, settled = self.errors(), slice(round(self.lead_s * RATE), None)
        if np.max(errors.whole[settled]) < STILL:
            return errors
        return min(errors, self.errors('force of the begin'),
                   key=lambda one: float(np.max(one.whole[settled])))


def _field_turned(exam: Exam) -> list[Run]:
    """Turn the field about the vertical, to one side and then to the other."""
    middle = len(exam.run.dt) // 2
    turns = Rotation.from_quat(exam.run.truth)
    west = np.where(np.arange(2 * middle + 1)[:len(turns)] < middle, FIELD_TURN, -FIELD_TURN)
    field = turns.inv().apply(Rotation.from_euler('z', west[:, np.newaxis]).apply(
        turns.apply(exam.run.magnetometer)))
    return [replace(exam.run, name='field turned', magnetometer=field)]


def _begin(exam: Exam) -> list[Run]:
    """Read force and field at the begin of each step."""
    force, field = (np.vstack((rows[:1], rows[:-1]))
                    for rows in (exam.run.accelerometer, exam.run.magnetometer))
    return [replace(exam.run, name='force of the begin', accelerometer=force, magnetometer=field)]


def _starts() -> list[Run]:
    return [run.without_field() for run in motions.starts()]


def _turns(exam: Exam, size: float) -> list[Run]:
    """Return starts with kicks about what the filter takes for the vertical."""
    said = [one.estimates for one in exam.outcomes('starts')]
    return answers.kicked_starts(_starts(), UPRIGHT, said, size)


UPRIGHT, LEVEL = (0.0, 0.0, 1.0), (0.6, 0.8, 0.0)
RUNS: Mapping[str, Callable[[Exam], list[Run]]] = {
    'twice': lambda exam: 2 * [motions.noisy('twice', motions.CALIBRATED, 0, 1.0, 1.0)],
    'excitation': lambda exam: [exam.run],
    'force of the begin': _begin,
    'field turned': _field_turned,
    'no field': lambda exam: [exam.run.without_field()],
    'uneven': lambda exam: [motions.uneven(1000).without_field()],
    'uneven turns': lambda exam: [answers.kicked_steps(exam.outcomes('uneven')[0])],
    'starts': lambda exam: _starts(),
    'turns': lambda exam: _turns(exam, answers.SMALL),
    'large turns': lambda exam: _turns(exam, answers.LARGE),
    'tilts': lambda exam: answers.kicked_starts(_starts(), LEVEL, [
        run.truth for run in motions.starts()]),
    'turns with field': lambda exam: answers.kicked_starts(motions.starts(), UPRIGHT, [
        run.truth for run in motions.starts()]),
    'arm': lambda exam: [motions.with_arm(exam.motion, exam.run, ARM, ARM_AFTER_S)],
    'noise': lambda exam: [motions.noisy(f'noise, seed {seed}', exam.imu, seed, NOISE_LEAD_S,
                                         NOISE_S) for seed in exam.seeds]}
