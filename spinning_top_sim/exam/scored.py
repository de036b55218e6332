# SPDX-License-Identifier: Apache-2.0
"""Runs whose errors count in motion only, and the report on a filter in several of them."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.measures import rmse
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.trial import Feed, InvalidOutputError, MakeFilter, Outcome, follow
from spinning_top_sim.tools.verdict import Fault


class ScoredRun(NamedTuple):
    """A run, and the samples of it whose errors count."""

    run: Run
    counts: NDArray[np.intp]    # samples of a known truth in motion
    alone: float = math.nan     # error there of the gyroscope alone [deg]; NaN: unknown

    def follow(self, make_filter: MakeFilter, feed: Feed = feed_apart) -> Outcome:
        """Return the outcome of a new filter, the samples that count.  Raises as `follow`."""
        return follow(make_filter, self.run, (), feed).part(self.counts)


def report_of(make_filter: MakeFilter, runs: Iterable[ScoredRun], kind: str, subject: str,
              feed: Feed = feed_apart,
              show: Callable[[float], object] = lambda done: None) -> Report:
    """Return the report on a filter in runs; the names of its measures begin with `kind`."""
    found: dict[str, list[tuple[float, ...]]] = {}
    outcomes, failed, means = [], [], {}
    for number, scored in enumerate(runs, start=1):
        try:
            outcomes.append(outcome := scored.follow(make_filter, feed))
        except InvalidOutputError as error:
            failed.append(str(error))
        else:
            one = rmse(outcome.estimates, outcome.run.truth)
            found.setdefault(scored.run.name, []).append((*one, one.total / scored.alone))
        show(number)
    if found:
        names = f'{kind}_rms_deg', f'{kind}_heading_rms_deg', f'{kind}_tilt_rms_deg'
        means = dict(zip(names, np.mean([one for same in found.values() for one in same],
                                        axis=0).tolist(), strict=False))
    for name, same in found.items():
        total, ratio = np.array(same)[:, [0, 3]].T
        means |= {f'{kind}_rms_{name}_deg': float(np.mean(total)),
                  f'{kind}_rms_{name}_spread_deg': float(np.std(total, ddof=1))
                  if len(same) > 1 else math.nan,
                  f'{kind}_{name}_to_gyroscope': float(np.mean(ratio))}
    means = {name: value for name, value in means.items() if not math.isnan(value)}
    faults = [Fault('invalid_output', '; '.join(failed))] if failed else []
    return Report(subject, faults, means, outcomes)
