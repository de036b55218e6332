# SPDX-License-Identifier: Apache-2.0
"""By how much readings are late."""

import math
from collections.abc import Sequence

import numpy as np

from spinning_top_sim.grade.effects import ANGLES, Comparison
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.kinematics import Reals, Smoothed

LAGS = range(-5, 41)        # lags that are tried [samples]
ENOUGH = 3                  # independent samples a column, from which on a lag can be told
ROUNDING = 1e-5             # share of a reading from which on a lag is looked for
SURE = 5.0                  # standard deviations from which on a number is not chance
CLEARLY = 10.0              # by which a term must exceed its noise to be missed


def lag_of(comparison: Comparison) -> tuple[int, float, float, bool]:
    """
    Return by how many samples readings are late: as whole, with its fraction, and its deviation;
    and whether that explains much.

    The reading is fitted by all terms, of all axes, at each lag: what else is wrong does not
    count.
    """
    unknown = 0, math.nan, math.inf, False
    lags = [lag for lag in LAGS if 4 * abs(lag) < min(comparison.counts)]
    part, designs, noises = slice(-lags[0], -lags[-1] or None), [], []
    for smoothed in comparison.smoothed:
        design, noise = _design(comparison, smoothed)
        designs.append(design)
        noises.append(noise)
    best = 0
    found: dict[int, tuple[float, float]] = {}
    while comparison.leave_out(best, designs) or not found:
        found = _misfits(comparison, lags, designs, noises, part)
        before, best = best, min(found, key=lambda lag: found[lag][0])
        if best == before:
            break
    count, size = 3 * sum(np.count_nonzero(good[part]) for good in comparison.good), rms(
        comparison.sizes)
    compared, width = comparison.compare(0), comparison.smoothed[0].width
    # Of smoothed samples fewer are independent: they must be more than the columns.
    few = count < ENOUGH * 3 * width * designs[0].shape[1]
    weak = rms(compared.effects['total']) < CLEARLY * compared.noise['total']
    still = found[0][1] < count * (ROUNDING * size) ** 2
    if few or weak or still or best in (lags[0], lags[-1]):
        return unknown                          # every lag explains it
    # Around its minimum the sum of squares is a parabola.
    now, least, sooner, later = (found[lag][0] for lag in (0, best, best - 1, best + 1))
    curvature = sooner - 2.0 * least + later
    if curvature <= 0.0:
        return unknown
    late = best + 0.5 * (sooner - later) / curvature
    less = 0.125 * (sooner - later) ** 2 / curvature
    rest = max(found[best][1] - less, 0.0)
    variance = rest / count * 2.0 * width       # of correlated noise
    most = 1.5 * count * (compared.floor * size) ** 2
    gained = now - least + less                 # which is that of a parabola, about
    clear = bool(rest < 0.25 * found[0][1] or (
        rest < most and gained > max((2.0 * SURE) ** 2 * variance,
                                     0.05 * curvature * late ** 2)))
    return best if clear else 0, late, math.sqrt(2.0 * variance / curvature), clear


def _design(comparison: Comparison, smoothed: Smoothed) -> tuple[Reals, Reals]:
    """Return columns of unit size that any reading may have, and how noise is in them."""
    effects, noise = comparison.effects(smoothed), comparison.noises(smoothed)
    names = [name for name in ('gravity', 'linear', 'world', *(
        f'{name} {k}' for name in ('arm', 'turned arm', 'field') for k in range(3)))
        if name in effects] + ['total'] * (comparison.kind in ANGLES)
    design = np.hstack([*map(effects.__getitem__, names), np.ones((len(smoothed.rates), 1))])
    sizes = np.linalg.norm(design, axis=0)
    sizes[sizes == 0.0] = np.inf                # such as the part of a x r along r
    # By axes: noise of the angular acceleration, as of any a x r, and of the others.
    every = np.zeros((6, len(sizes)))
    for k, name in enumerate(names):
        columns = slice(3 * k, 3 * k + 3)
        if name.endswith(('arm 0', 'arm 1', 'arm 2')):
            every[:3, columns] = noise['turn'] * np.cross(np.eye(3), np.eye(3)[int(name[-1])])
        else:
            every[3:, columns] = noise.get(name, 0.0) * np.eye(3)
    return design / sizes, every / sizes


def _misfits(comparison: Comparison, lags: Sequence[int], designs: Sequence[Reals],
             noises: Sequence[Reals], part: slice) -> dict[int, tuple[float, float]]:
    """
    Return the sums of squares that designs leave of readings by their lag.

    The first is without what noise of the columns leaves: it would draw the lag to where the
    columns are small.
    """
    rows = [np.flatnonzero(good[part]) + (part.start or 0) for good in comparison.good]
    bases = []
    for design, noise, chosen in zip(designs, noises, rows, strict=True):
        left, sizes, right = np.linalg.svd(design[chosen], full_matrices=False)
        known = sizes > 1e-9 * sizes[0]
        bases.append((left[:, known], noise @ (right[known].T / sizes[known])))
    found = {}
    for lag in lags:
        whole = noisy = 0.0
        for (basis, noise), chosen, reading in zip(bases, rows, comparison.read_at(lag),
                                                   strict=True):
            sizes = basis.T @ reading[chosen]
            whole += float(np.sum((reading[chosen] - basis @ sizes) ** 2))
            noisy += len(chosen) * float(np.sum((noise @ sizes) ** 2))
        found[lag] = whole - noisy, whole
    return found
