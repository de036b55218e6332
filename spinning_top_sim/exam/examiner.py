# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter: the loop over the checks."""

import operator
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.exam import motions, scenes
from spinning_top_sim.exam.checks import CHECKS
from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter, feed_apart
from spinning_top_sim.exam.feeding import feed as feed_here
from spinning_top_sim.exam.runs import Exam
from spinning_top_sim.exam.scored import report_of
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.report import Finding, Mark, Report
from spinning_top_sim.tools.scene_file import read_scene

SEEDS = {'quick': 3, 'full': 10, 'field': 1}        # of the noisy runs, or of the scenes


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
        'field' are scenes of a sensor in a hand instead of the checks; 'full' is both.
    imu : mapping or path, optional
        Parameters imu.* and mag.* that replace those of the noisy runs and of the scenes, or the
        path of a parameter file such as those in config/imu.
    seeds : int or iterable of int, optional
        Seeds of the noisy runs, or their number; default: 3, of 'full' 10 and one of the
        scenes, of 'field' 1.
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
    numbers = _seed_numbers(SEEDS[level] if seeds is None else seeds)
    feed = feed or (feed_apart if isolated else feed_here)
    show = show or (lambda done, total: None)
    subject = one_line(subject or getattr(make_filter, '__name__', 'filter'))
    reports = []
    if level != 'field':
        of_noise = {name: value for name, value in values.items()
                    if name.startswith(motions.TAKEN)}
        reports.append(_sit(Exam(make_filter, feed, {**motions.CALIBRATED, **of_noise}, numbers),
                            subject, show))
    if level != 'quick':
        runs = [partial(scenes.record, scene, seed, values)
                for seed in (numbers if level == 'field' else numbers[:1])
                for scene in scenes.SCENES]
        reports.append(report_of(make_filter, runs, 'field', subject, feed, show))
    return reports[0].plus(*reports[1:])


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


def _sit(exam: Exam, subject: str, show: Callable[[float, float], object]) -> Report:
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
            measured = check.measure(exam)
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
    absolute = 'field turned' not in exam.done or exam.heading
    if not absolute:
        notes.append('the magnetometer changes nothing: tilt and steady heading are judged')
    return Report(subject, found, marks, notes, exam.done.get('noise', ()), absolute)
