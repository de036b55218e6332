# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors count in motion only, and the report on a filter in several of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam import measures
from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter
from spinning_top_sim.exam.motions import Run
from spinning_top_sim.tools.report import Finding, Mark, Report


class ScoredRun(NamedTuple):
    """A run, and the samples of it whose errors count."""

    run: Run
    counts: NDArray[np.intp]


def report_of(make_filter: MakeFilter, runs: Sequence[Callable[[], ScoredRun]], kind: str,
              subject: str, feed: Feed, show: Callable[[float, float], object]) -> Report:
    """
    Return the report on a filter in runs, made one by one; names of marks begin with `kind`.

    The whole error is judged, of a filter that does not use the field the tilt.
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
                whole = measures.differ(one.estimates, other.estimates)
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
