# SPDX-License-Identifier: Apache-2.0
"""The exam of a filter: the loop over the checks, or over runs whose errors count."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.exam import measures, motions, scenes
from spinning_top_sim.exam.broad import read_trial, trials_in
from spinning_top_sim.exam.checks import CHECKS
from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter, feed_apart
from spinning_top_sim.exam.motions import Scored
from spinning_top_sim.exam.runs import Exam
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.report import Finding, Mark, Report
from spinning_top_sim.tools.scene_file import read_scene

SEEDS = {'quick': 3, 'field': 1}     # of the noisy runs, of the scenes


def examine(make_filter: MakeFilter, level: str = 'quick',
            imu: Mapping[str, Any] | str | Path | None = None,
            seeds: int | Iterable[int] | None = None, *, data: str | Path | None = None,
            subject: str | None = None, feed: Feed = feed_apart,
            show: Callable[[float, float], object] = lambda done, total: None) -> Report:
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
    level : {'quick', 'field'}
        'field' are scenes of a sensor in a hand instead of the checks.
    imu : mapping or path, optional
        Parameters imu.* and mag.* that replace those of the noisy runs and of the scenes, or the
        path of a parameter file such as those in config/imu.
    seeds : int or iterable of int, optional
        Seeds of the noisy runs, or their number; default: 3, of 'field' 1.
    data : path, optional
        A folder with trials of BROAD (.mat), which take the place of a level; each is fed from its
        first sample on.
    subject : str, optional
        Name in the report; default: that of the filter's class.
    feed : callable, optional
        `feeding.feed` feeds the filter in this process, where a debugger can reach it.
    show : callable, optional
        Takes the number of parts done and to do.

    Returns
    -------
    Report
        Faults with their evidence, and measures.

    Raises
    ------
    TypeError
        If `make_filter` cannot be called, such as a filter itself.
    ValueError
        If the level, a parameter or a seed is not allowed, or there is no trial in the folder.
    """
    if not callable(make_filter):
        raise TypeError(f'make_filter = {one_line(repr(make_filter))}: pass the class of the '
                        "filter, or one of exam.adapters.FILTERS, such as FILTERS['vqf']")
    if data is not None and (level, imu, seeds) != ('quick', None, None):
        raise ValueError('data cannot be given with level, imu or seeds')
    if level not in SEEDS:
        raise ValueError(f'level = {level!r}: must be one of {", ".join(SEEDS)}')
    taken = motions.TAKEN + motions.OF_SCENES * (level == 'field')
    values = {} if imu is None else _checked(imu, level, taken)
    seeds = SEEDS[level] if seeds is None else seeds
    numbers = list(seeds if isinstance(seeds, Iterable) else range(seeds))
    if not numbers or min(numbers) < 0:
        raise ValueError(f'seeds = {seeds!r}: must be a positive number, or integers >= 0')
    subject = one_line(subject or getattr(make_filter, '__name__', 'filter'))
    if data is not None:
        return report_of(make_filter, [partial(read_trial, path) for path in trials_in(data)],
                         'data', subject, feed, show)
    if level == 'quick':
        return _sit(Exam(partial(feed, make_filter), {**motions.CALIBRATED, **values}, numbers),
                    subject, show)
    runs = [partial(scenes.record, scene, seed, values)
            for seed in numbers for scene in scenes.SCENES]
    return report_of(make_filter, runs, 'field', subject, feed, show)


def _checked(imu: Mapping[str, Any] | str | Path, level: str,
             taken: tuple[str, ...]) -> dict[str, Any]:
    """Return the parameters that are given.  Raises ValueError for what the level has not."""
    given = imu if isinstance(imu, Mapping) else read_scene(imu)
    checked, source = parameters.checked(given), 'imu' if imu is given else imu
    for name, value in given.items():
        # A file of an IMU may say that it has none of the rest.
        if not name.startswith(taken) and not (name.startswith(('imu.', 'mag.')) and (
                checked[name] == parameters.BY_NAME[name].default)):
            raise ValueError(f'{source} has {name} = {value!r}, which nothing in level {level} '
                             f'has: must be {", ".join(f"{one}*" for one in taken)}')
    return {name: checked[name] for name in given if name.startswith(taken)}


def _sit(exam: Exam, subject: str, show: Callable[[float, float], object]) -> Report:
    """Do all checks but those that a fault hides."""
    found: list[Finding] = []
    marks: dict[str, Mark] = {}
    left_out = []
    for k, check in enumerate(CHECKS):
        show(k, len(CHECKS))
        if any(finding.name in check.needs for finding in found):
            left_out.append(check.mark)
            continue
        try:
            measured = check.measure(exam)
        except InvalidOutputError as error:
            found.append(Finding('invalid_output', str(error)))
            left_out.append(check.mark)
            continue
        if measured is None:
            continue
        limit = check.limit if measured.limit is None else measured.limit
        marks |= {check.mark: Mark(measured.value, limit, check.meaning), **measured.others}
        if measured.value > limit or math.isnan(measured.value):
            found.append(Finding(measured.name or check.fault, measured.evidence, measured.value))
    show(len(CHECKS), len(CHECKS))
    notes = [f'not judged because of this: {", ".join(left_out)}'] if left_out else []
    absolute = 'no field' not in exam.told or exam.heading
    if not absolute:
        notes.append('the magnetometer changes nothing: tilt and steady heading are judged')
    noise = exam.noise[:-1] if 'noise' in exam.told else []
    return Report(subject, found, marks, notes, noise, absolute)


def report_of(make_filter: MakeFilter, runs: Sequence[Callable[[], Scored]], kind: str,
              subject: str, feed: Feed, show: Callable[[float, float], object]) -> Report:
    """
    Return the report on a filter in runs, made one by one; names of marks begin with `kind`.

    Only samples that count are judged: the whole error, or the tilt where the field is ignored.
    """
    outcomes, failed, whole = [], [], True
    for done, make_run in enumerate(runs):
        show(done, len(runs))
        run, counts = make_run()
        try:
            if not done:
                part = run.part(slice(1000))        # shows whether it uses the field
                one, other = feed(make_filter, [part, replace(
                    part, magnetometer=part.magnetometer[:, [1, 2, 0]])])
                whole = measures.largest_turn(one.estimates, other.estimates) > measures.ROUNDING
            outcomes.append(feed(make_filter, [run])[0].part(counts))
        except InvalidOutputError as error:
            failed.append(str(error))
    show(len(runs), len(runs))
    faults = [Finding('invalid_output', '; '.join(failed))] if failed else []
    if not outcomes:
        return Report(subject, faults)
    errors = [measures.rmse(one.estimates, one.run.truth) for one in outcomes]
    total, heading, tilt = np.mean(errors, axis=0).tolist()
    judged, name = (total, 'error') if whole else (tilt, 'tilt error')
    if judged > measures.USELESS_DEG:
        faults.append(Finding('accuracy', f'the mean {name} is {judged:.3g} deg', judged))
    limits = (measures.USELESS_DEG, math.nan) if whole else (math.nan, measures.USELESS_DEG)
    marks = {f'{kind}_rms_deg': Mark(total, limits[0], 'in motion, mean over the runs'),
             f'{kind}_heading_rms_deg': Mark(heading, meaning='heading alone'),
             f'{kind}_tilt_rms_deg': Mark(tilt, limits[1], 'tilt alone')}
    names = [one.run.name for one in outcomes]
    for name in dict.fromkeys(names):
        of_run = [error[0] for error, other in zip(errors, names, strict=True) if other == name]
        marks[f'{kind}_rms_{name}_deg'] = Mark(float(np.mean(of_run)))
    return Report(subject, faults, marks, [] if whole else [
        'the magnetometer changes nothing: the filter is judged by its tilt'], outcomes, whole)
