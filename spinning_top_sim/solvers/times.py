# SPDX-License-Identifier: Apache-2.0
"""Times as sums of two doubles, and their products with rates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Number
from spinning_top_sim.physics.pivot import NANOSECONDS

Matrix = NDArray[np.float64]
UNITS = {'s': 1, 'ns': NANOSECONDS}
# The largest time [ns] that is taken as an integer: the end of int64 lies a second behind it.
LARGEST_NS = 2 ** 63 - NANOSECONDS
# 2^27 + 1: the factor that splits a double into two halves (Dekker, Numer. Math. 18, 1971, 224).
SPLITTER = 134217729.0


def halves(x: Number) -> tuple[Number, Number]:
    """Split doubles into two of 26 bits each; products of such halves are exact."""
    big = SPLITTER * x
    high = big - (big - x)
    return high, x - high


class Times:
    """
    Times since the start of a motion, as sums of two doubles.

    unit : 'ns' for integers, 's' for doubles
    high, low : (n,) nearest doubles, and what they leave out, which may be one 0
    latest : the largest time either way
    """

    def __init__(self, unit: str, high: Column, low: Column | float, latest: float) -> None:
        self.unit, self.high, self.low, self.latest = unit, high, low, latest

    @classmethod
    def from_ns(cls, ns: NDArray[np.int64] | range) -> Times:
        """Return the times of integer nanoseconds (n,); raise ValueError for anything else."""
        if isinstance(ns, range):
            first, last = (ns[0], ns[-1]) if ns else (0, 0)
            if not -2 ** 63 <= min(first, last, ns.step) <= max(first, last, ns.step) < 2 ** 63:
                raise ValueError(f'times_ns = {ns!r}: must be within int64')
            # `numpy.arange` takes its length from doubles.
            count = first + ns.step * np.arange(len(ns), dtype=np.int64)
        else:
            count = np.asarray(ns)
            if count.ndim != 1 or (count.size and count.dtype.kind not in 'iu'):
                raise ValueError(f'times_ns has shape {count.shape} and type {count.dtype}: must '
                                 'be (n,) integer nanoseconds')
            first, last = (int(count.min()), int(count.max())) if count.size else (0, 0)
            if last >= 2 ** 63:
                raise ValueError(f'times_ns = {last}: must be within int64')
            count = count.astype(np.int64)
        latest = float(max(abs(first), abs(last)))
        if latest <= 2.0 ** 53:
            return cls('ns', count.astype(np.float64), 0.0, latest)
        upper = (count >> 20).astype(np.float64) * 2.0 ** 20
        lower = (count & (2 ** 20 - 1)).astype(np.float64)
        high = upper + lower
        return cls('ns', high, lower - (high - upper), latest)

    @classmethod
    def from_seconds(cls, t: Column) -> Times:
        return cls('s', t.copy(), 0.0, float(np.abs(t).max(initial=0.0)))

    @property
    def seconds(self) -> Column:
        return self.high if self.unit == 's' else self.high / 1e9 + self.low / 1e9

    def __len__(self) -> int:
        return len(self.high)

    def __getitem__(self, part: slice) -> Times:
        low = self.low if isinstance(self.low, float) else self.low[part]
        return Times(self.unit, self.high[part], low, self.latest)


def products(rates: tuple[Matrix, Matrix, Matrix, Matrix],
             times: Times) -> tuple[Matrix, Matrix]:
    """
    Return rate * t, (k, n), as nearest doubles and what they leave out: no error grows.

    rates : nearest doubles, the halves of these, and what they leave out, (k, 1) or (k, n)
    """
    rate, r1, r2, rate_low = rates
    t1, t2 = halves(times.high)
    high = rate * times.high
    # Exact up to the last product of halves (Dekker).
    rest = r1 * t1
    rest -= high
    rest += r1 * t2
    rest += r2 * t1
    rest += r2 * t2
    small = rate_low * times.high
    if not isinstance(times.low, float):
        small += rate * times.low
    rest += small
    return high, rest
