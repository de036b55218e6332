# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors count in motion only, and the report on a filter in several of them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter
from spinning_top_sim.exam.measures import Rmse, rmse
from spinning_top_sim.exam.motions import ROUNDING, Run
from spinning_top_sim.tools.report import Finding, Mark, Report

# A mean error above that, and above the gyroscope's alone, is a fault: more than that of any
# published filter with tuned gains [deg].
USELESS_DEG = 10.0
ASKED = 1000                    # updates after which a filter has shown whether it uses the field


class ScoredRun(NamedTuple):
    """A run, the samples of it whose errors count, and those of the gyroscope alone (or NaN)."""

    run: Run
    counts: NDArray[np.intp]
    alone: Rmse = Rmse(math.nan, math.nan, math.nan)


def report_of(make_filter: MakeFilter, runs: Iterable[ScoredRun], total: int, kind: str,
              subject: str, feed: Feed, show: Callable[[float, float], object]) -> Report:
    """
    Return the report on a filter in `total` runs; the names of its marks begin with `kind`.

    The whole error is judged, of a filter that does not use the field the tilt.
    """
    outcomes, failed, rows, whole = [], [], [], True
    for done, (run, counts, alone) in enumerate(runs):
        show(done, total)
        try:
            if not done:
                part = run.part(slice(ASKED))
                one, other = feed(make_filter, [part, replace(
                    part, magnetometer=part.magnetometer[:, [1, 2, 0]])])
                whole = bool(np.max(np.abs(one.estimates - other.estimates)) > ROUNDING)
            outcome = feed(make_filter, [run])[0].part(counts)
        except InvalidOutputError as error:
            failed.append(str(error))
            continue
        outcomes.append(outcome)
        rows.append((rmse(outcome.estimates, outcome.run.truth), alone))
    show(total, total)
    faults = [Finding('invalid_output', '; '.join(failed))] if failed else []
    if not rows:
        return Report(subject, faults)
    table = np.array(rows)              # (runs, of the filter and the gyroscope alone, Rmse)
    mean, alone = (Rmse(*row) for row in np.mean(table, axis=0).tolist())
    judged, least = (mean.total, alone.total) if whole else (mean.tilt, alone.tilt)
    if judged > USELESS_DEG and not judged < least:
        faults.append(Finding('accuracy', f'the mean {"error" if whole else "tilt error"} is '
                              f'{judged:.3g} deg; the gyroscope alone has {least:.3g}', judged))
    limits = (USELESS_DEG, math.nan) if whole else (math.nan, USELESS_DEG)
    marks = {f'{kind}_rms_deg': Mark(mean.total, limits[0], 'in motion, mean over the runs'),
             f'{kind}_heading_rms_deg': Mark(mean.heading, meaning='heading alone'),
             f'{kind}_tilt_rms_deg': Mark(mean.tilt, limits[1], 'tilt alone')}
    names = [one.run.name for one in outcomes]
    for name in dict.fromkeys(names):
        of_filter, of_gyroscope = table[np.array(names) == name, :, 0].mean(axis=0).tolist()
        marks[f'{kind}_rms_{name}_deg'] = Mark(of_filter, meaning='' if math.isnan(of_gyroscope)
                                               else f'{of_gyroscope:.3g} by the gyroscope alone')
    return Report(subject, faults, marks, [] if whole else [
        'the magnetometer changes nothing: the filter is judged by its tilt'], outcomes)
