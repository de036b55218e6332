# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors count in motion only, and the report on a filter in several of them."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam.diagnosis import DIVERGED, degrees
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import Rmse, rmse
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.trial import Feed, InvalidOutputError, MakeFilter, Outcome, follow
from spinning_top_sim.tools.verdict import Fault


class ScoredRun(NamedTuple):
    """A run, and the samples of it whose errors count."""

    run: Run
    counts: NDArray[np.intp]    # samples of a known truth in motion
    # Of the gyroscope alone [deg]; NaN: unknown.
    alone: Rmse = Rmse(math.nan, math.nan, math.nan)

    def follow(self, make_filter: MakeFilter, feed: Feed = feed_apart) -> Outcome:
        """Return the outcome of a new filter, the samples that count.  Raises as `follow`."""
        return follow(make_filter, self.run, (), feed).part(self.counts)


def report_of(make_filter: MakeFilter, runs: Iterable[ScoredRun], kind: str, subject: str,
              feed: Feed = feed_apart,
              show: Callable[[float], object] = lambda done: None) -> Report:
    """Return the report on a filter in runs; the names of its measures begin with `kind`."""
    found: dict[str, list[tuple[Rmse, Rmse]]] = {}      # of the filter and of the gyroscope alone
    outcomes, faults, failed, means = [], [], [], {}
    for number, scored in enumerate(runs, start=1):
        try:
            outcomes.append(outcome := scored.follow(make_filter, feed))
        except InvalidOutputError as error:
            failed.append(str(error))
        else:
            found.setdefault(scored.run.name, []).append(
                (rmse(outcome.estimates, outcome.run.truth), scored.alone))
        show(number)
    if found:
        names = f'{kind}_rms_deg', f'{kind}_heading_rms_deg', f'{kind}_tilt_rms_deg'
        of_filter, alone = np.mean([pair for same in found.values() for pair in same], axis=0)
        means = dict(zip(names, of_filter.tolist(), strict=True))
        tilts = np.radians((of_filter[2], alone[2])).tolist()
        if tilts[0] > DIVERGED and tilts[0] > tilts[1]:
            faults.append(Fault(
                'inaccurate', 'in the scenes the tilt error is {} in the mean, above {} and that '
                'of the gyroscope alone, {}'.format(*map(
                    degrees, (tilts[0], DIVERGED, tilts[1])))))
    for name, same in found.items():
        totals, of_gyroscope = np.array(same)[:, :, 0].T
        means |= {f'{kind}_rms_{name}_deg': float(np.mean(totals)),
                  f'{kind}_rms_{name}_spread_deg': float(np.std(totals, ddof=1))
                  if len(same) > 1 else math.nan,
                  f'{kind}_{name}_to_gyroscope': float(np.mean(totals / of_gyroscope))}
    means = {name: value for name, value in means.items() if not math.isnan(value)}
    if failed:
        faults.append(Fault('invalid_output', '; '.join(failed)))
    return Report(subject, faults, means, outcomes)
