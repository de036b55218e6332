# SPDX-License-Identifier: Apache-2.0
"""Times as sums of two doubles, and the phases that rates make of them."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Number
from spinning_top_sim.solvers.decimal_math import double_double

NANOSECONDS = 1_000_000_000
# The largest time [ns] that is taken as an integer: the end of int64 lies a second behind it.
LATEST_NS = 2 ** 63 - NANOSECONDS
# 2^27 + 1: the factor that splits a double into two halves (Dekker, Numer. Math. 18, 1971, 224).
SPLITTER = 134217729.0


def halves(x: Number) -> tuple[Number, Number]:
    """Split doubles into two of 26 bits each; products of such halves are exact."""
    big = SPLITTER * x
    high = big - (big - x)
    return high, x - high


@dataclass(frozen=True, eq=False)
class Times:
    """
    Times since the start of a motion, in nanoseconds, as exact sums high + low.

    high, low : (n,) nearest doubles, and what they leave out [ns]
    ns : the same times, where they are given as integers [ns]
    """

    high: Column
    low: Column
    ns: NDArray[np.int64] | range | None = None

    @classmethod
    def from_ns(cls, ns: NDArray[np.int64] | range) -> Times:
        """Return the times of integer nanoseconds (n,); raise ValueError for anything else."""
        count = _integers(ns) if isinstance(ns, range) else np.array(ns)
        if count.ndim != 1 or (count.size and count.dtype.kind not in 'iu'):
            raise ValueError(f'times_ns has shape {count.shape} and type {count.dtype}: must be '
                             '(n,) integer nanoseconds')
        if not isinstance(ns, range):
            ns = count          # not the caller's: columns are computed later
        if not count.size or max(abs(int(count.min())), abs(int(count.max()))) <= 2 ** 53:
            return cls(count.astype(np.float64), np.broadcast_to(0.0, len(count)), ns)
        upper = (count >> 20).astype(np.float64) * 2.0 ** 20
        lower = (count & (2 ** 20 - 1)).astype(np.float64)
        high = upper + lower
        return cls(high, lower - (high - upper), ns)

    @classmethod
    def from_seconds(cls, t: Column) -> Times:
        """Return the times of doubles [s]."""
        first, second = halves(t)
        high = t * 1e9                          # 1e9 has 21 bits
        return cls(high, (first * 1e9 - high) + second * 1e9)

    @property
    def seconds(self) -> Column:
        """(n,) [s]."""
        return self.high / 1e9 + self.low / 1e9

    def __len__(self) -> int:
        """Return n."""
        return len(self.high)

    def __getitem__(self, block: slice) -> Times:
        """Return a part of the times."""
        return Times(self.high[block], self.low[block],
                     None if self.ns is None else self.ns[block])


def _integers(times: range) -> NDArray[np.int64]:
    """Return a range as an array; `numpy.arange` takes its length from doubles."""
    if any(not -2 ** 63 <= ns < 2 ** 63 for ns in (*times[:1], *times[-1:], times.step)):
        raise ValueError(f'times_ns = {times!r}: must be within int64')
    start = times.start if times else 0
    return start + times.step * np.arange(len(times), dtype=np.int64)


class Rate:
    """A rate [1/s] as two doubles; its product with a time has no error that grows with it."""

    def __init__(self, per_second: Decimal) -> None:
        self.high, self.low = double_double(per_second * Decimal('1e-9'))
        self._first, self._second = halves(self.high)

    def product(self, times: Times) -> tuple[Column, Column]:
        """Return rate * t as nearest doubles and what they leave out."""
        t1, t2 = halves(times.high)
        high = self.high * times.high
        rest = ((self._first * t1 - high) + self._first * t2 + self._second * t1)
        return high, (rest + self._second * t2) + (self.low * times.high + self.high * times.low)

    def fraction(self, times: Times) -> tuple[Column, Column]:
        """Return rate * t less whole numbers: doubles in [-1/2, 1/2] and small rests."""
        high, rest = self.product(times)
        return high - np.rint(high), rest
