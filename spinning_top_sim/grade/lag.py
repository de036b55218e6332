# SPDX-License-Identifier: Apache-2.0
"""By how much readings are late."""

import math

import numpy as np

from spinning_top_sim.grade.columns import Comparison
from spinning_top_sim.tools.identify import rms

LAGS = range(-5, 41)        # lags that are tried [samples]
ENOUGH = 3                  # independent samples a column, from which on a lag can be told
ROUNDING = 1e-5             # share of a reading from which on a lag is looked for
SURE = 5.0                  # standard deviations from which on a number is not chance
CLEARLY = 10.0              # by which a term must exceed its noise to be missed
# Effects that any reading may have, along any axes.
ANY = ('gravity', 'linear', 'world', *(
    f'{name} {k}' for name in ('arm', 'turned arm', 'field') for k in range(3)))


def lag_of(comparison: Comparison) -> tuple[int, float, float, bool]:
    """
    Return by how many samples readings are late: as whole, with its fraction, and its deviation;
    and whether that explains much.

    The reading is regressed on all terms, of all axes, at each lag: what else is wrong does not
    count.
    """
    unknown = 0, math.nan, math.inf, False
    lags = [lag for lag in LAGS if 4 * abs(lag) < min(
        len(one.rates) for one in comparison.motions)]
    part, rows, bases = slice(-lags[0], -lags[-1] or None), [], []
    for motion in comparison.motions:
        effects = comparison.columns(motion)
        design = np.hstack([effect for name, effect in effects.items() if name in ANY or (
            name == 'total' and comparison.angles)] + [np.ones((len(motion.rates), 1))])
        rows.append(np.flatnonzero(motion.smooth[part]) + part.start)
        left, sizes, _ = np.linalg.svd(design[rows[-1]] / np.maximum(
            np.linalg.norm(design, axis=0), 1e-300), full_matrices=False)
        bases.append(left[:, sizes > 1e-9 * sizes[0]])
    misfit = {}
    for lag in lags:
        read = [reading[row] for reading, row in zip(comparison.read_at(lag), rows, strict=True)]
        misfit[lag] = sum(float(np.sum((one - basis @ (basis.T @ one)) ** 2))
                          for basis, one in zip(bases, read, strict=True))
    best = min(misfit, key=misfit.__getitem__)
    count, size = 3 * sum(map(len, rows)), rms(comparison.sizes)
    width = comparison.motions[0].width
    comparison.compare(0)
    # Of smoothed samples fewer are independent: they must be more than the columns.
    few = count < ENOUGH * 3 * width * design.shape[1]
    weak = rms(comparison.effects['total']) < CLEARLY * comparison.noise['total']
    still = misfit[0] < count * (ROUNDING * size) ** 2
    if few or weak or still or best in (lags[0], lags[-1]):
        return unknown                          # every lag explains it
    # Around its minimum the sum of squares is a parabola.
    now, least, sooner, later = (misfit[lag] for lag in (0, best, best - 1, best + 1))
    curvature = sooner - 2.0 * least + later
    if curvature <= 0.0:
        return unknown
    late = best + 0.5 * (sooner - later) / curvature
    less = 0.125 * (sooner - later) ** 2 / curvature
    rest = max(least - less, 0.0)
    variance = rest / count * 2.0 * width       # of correlated noise
    most = 1.5 * count * (comparison.floor * size) ** 2
    gained = now - least + less                 # which is that of a parabola, about
    clear = bool(rest < 0.25 * now or (rest < most and gained > max(
        (2.0 * SURE) ** 2 * variance, 0.05 * curvature * late ** 2)))
    return best if clear else 0, late, math.sqrt(2.0 * variance / curvature), clear
