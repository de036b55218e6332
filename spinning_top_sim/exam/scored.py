# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors count in motion only, and the report on a filter in several of them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam.feeding import Feed, InvalidOutputError, MakeFilter, Outcome
from spinning_top_sim.exam.measures import Rmse, rmse
from spinning_top_sim.exam.motions import Run
from spinning_top_sim.tools.report import Finding, Mark, Report

# A mean error above that, and above the gyroscope's alone, is a fault: more than that of any
# published filter with tuned gains [deg].
USELESS_DEG = 10.0
ASKED = 1000                    # updates after which a filter has shown whether it uses the field


class ScoredRun(NamedTuple):
    """A run, and the samples of it whose errors count."""

    run: Run
    counts: NDArray[np.intp]    # samples of a known truth in motion
    # Of the gyroscope alone [deg]; NaN: unknown.
    alone: Rmse = Rmse(math.nan, math.nan, math.nan)

    def follow(self, make_filter: MakeFilter, feed: Feed) -> Outcome:
        """Return the outcome of a new filter, the samples that count.  Raises as `feed`."""
        (outcome,) = feed(make_filter, [self.run])
        return outcome.part(self.counts)


def uses_field(make_filter: MakeFilter, feed: Feed, run: Run) -> bool:
    """Return whether attitudes depend on the field.  Raises InvalidOutputError."""
    part = run.part(slice(ASKED))
    one, other = feed(make_filter, [part, replace(
        part, magnetometer=part.magnetometer[:, [1, 2, 0]])])
    return bool(np.max(np.abs(one.estimates - other.estimates)) > 1e-6)


def report_of(make_filter: MakeFilter, runs: Iterable[ScoredRun], total: int, kind: str,
              subject: str, feed: Feed, show: Callable[[float, float], object]) -> Report:
    """
    Return the report on a filter in `total` runs; the names of its marks begin with `kind`.

    The whole error is judged, of a filter that does not use the field the tilt.
    """
    found: dict[str, list[tuple[Rmse, Rmse]]] = {}      # of the filter and of the gyroscope alone
    outcomes, failed, whole = [], [], None
    for done, scored in enumerate(runs):
        show(done, total)
        try:
            whole = uses_field(make_filter, feed, scored.run) if whole is None else whole
            outcomes.append(outcome := scored.follow(make_filter, feed))
        except InvalidOutputError as error:
            failed.append(str(error))
        else:
            found.setdefault(scored.run.name, []).append(
                (rmse(outcome.estimates, outcome.run.truth), scored.alone))
    show(total, total)
    faults = [Finding('invalid_output', '; '.join(failed))] if failed else []
    marks: dict[str, Mark] = {}
    if found:
        mean, alone = (Rmse(*row) for row in np.mean(
            [pair for same in found.values() for pair in same], axis=0).tolist())
        judged, least = (mean.total, alone.total) if whole else (mean.tilt, alone.tilt)
        if judged > USELESS_DEG and not judged < least:
            faults.append(Finding('accuracy', f'in the mean the {"error" if whole else "tilt"} is '
                                  f'{judged:.3g} deg; the gyroscope alone has {least:.3g}', judged))
        marks = {f'{kind}_rms_deg': Mark(mean.total, USELESS_DEG if whole else math.nan,
                                         'in motion, mean over the runs'),
                 f'{kind}_heading_rms_deg': Mark(mean.heading, meaning='heading alone'),
                 f'{kind}_tilt_rms_deg': Mark(mean.tilt, math.nan if whole else USELESS_DEG,
                                              'tilt alone')}
    for name, same in found.items():
        of_filter, of_gyroscope = np.array(same)[:, :, 0].T
        ratio = float(np.mean(of_filter / of_gyroscope))
        marks[f'{kind}_rms_{name}_deg'] = Mark(float(np.mean(of_filter)), meaning='' if math.isnan(
            ratio) else f'{ratio:.2g} times that of the gyroscope alone')
    notes = [] if whole or not found else [
        'the magnetometer changes nothing: the filter is judged by its tilt']
    return Report(subject, faults, marks, notes, outcomes)
