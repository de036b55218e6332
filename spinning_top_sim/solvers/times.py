# SPDX-License-Identifier: Apache-2.0
"""Times as sums of two doubles, and the phases that rates make of them."""

from __future__ import annotations

from decimal import Decimal
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Number
from spinning_top_sim.solvers.decimal_math import double_double

NANOSECONDS = 1_000_000_000
UNITS = {'s': Decimal(1), 'ns': Decimal('1e-9')}
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
    Times since the start of a motion, as exact sums of two doubles in the unit they come in.

    The sums are computed when they are first asked for: those of a block stay in the cache.

    ns : (n,) integers [ns], None where the times are given as doubles
    t : (n,) doubles [s]
    """

    def __init__(self, ns: NDArray[np.int64] | range | None, t: Column | None = None) -> None:
        self.ns, self._t = ns, t

    @classmethod
    def from_ns(cls, ns: NDArray[np.int64] | range) -> Times:
        """Return the times of integer nanoseconds (n,); raise ValueError for anything else."""
        if isinstance(ns, range):
            if any(not -2 ** 63 <= extreme < 2 ** 63 for extreme in (
                    *ns[:1], *ns[-1:], ns.step)):
                raise ValueError(f'times_ns = {ns!r}: must be within int64')
            return cls(ns)
        count = np.array(ns)        # not the caller's: columns are computed later
        if count.ndim != 1 or (count.size and count.dtype.kind not in 'iu'):
            raise ValueError(f'times_ns has shape {count.shape} and type {count.dtype}: must be '
                             '(n,) integer nanoseconds')
        if count.dtype.kind == 'u' and count.size and int(count.max()) >= 2 ** 63:
            raise ValueError(f'times_ns = {int(count.max())}: must be within int64')
        return cls(count.astype(np.int64))

    @classmethod
    def from_seconds(cls, t: Column) -> Times:
        """Return the times of doubles [s]."""
        return cls(None, t.copy())

    @property
    def latest(self) -> float:
        """The largest time either way."""
        given = self._given
        if not len(given):
            return 0.0
        ends = (given[0], given[-1]) if isinstance(given, range) else (given.max(), given.min())
        return max(abs(float(end)) for end in ends)

    @property
    def unit(self) -> str:
        """Nanoseconds for integers, seconds for doubles."""
        return 's' if self.ns is None else 'ns'

    @cached_property
    def _sums(self) -> tuple[Column, Column]:
        """Nearest doubles, and what they leave out."""
        ns = self.ns
        if ns is None:
            return self.seconds, np.broadcast_to(0.0, len(self))
        if isinstance(ns, range):       # `numpy.arange` takes its length from doubles
            ns = (ns.start if ns else 0) + ns.step * np.arange(len(ns), dtype=np.int64)
        if self.latest <= 2.0 ** 53:
            return ns.astype(np.float64), np.broadcast_to(0.0, len(ns))
        upper = (ns >> 20).astype(np.float64) * 2.0 ** 20
        lower = (ns & (2 ** 20 - 1)).astype(np.float64)
        high = upper + lower
        return high, lower - (high - upper)

    @property
    def high(self) -> Column:
        """Nearest doubles (n,)."""
        return self._sums[0]

    @property
    def low(self) -> Column:
        """What the nearest doubles leave out (n,)."""
        return self._sums[1]

    @cached_property
    def halves(self) -> tuple[Column, Column]:
        """The nearest doubles, split; see `halves`."""
        return halves(self.high)

    @property
    def seconds(self) -> Column:
        """(n,) [s]."""
        return self.high / 1e9 + self.low / 1e9 if self._t is None else self._t

    def __len__(self) -> int:
        return len(self._given)

    def __getitem__(self, part: slice | NDArray[np.bool_]) -> Times:
        if self.ns is None:
            return Times(None, self.seconds[part])
        if isinstance(self.ns, range) and isinstance(part, slice):
            return Times(self.ns[part])
        return Times(np.asarray(self.ns)[part])

    @property
    def _given(self) -> NDArray[np.int64] | range | Column:
        return self.seconds if self.ns is None else self.ns


class Rate:
    """A rate [1/s] as two doubles; its product with a time has no error that grows with it."""

    def __init__(self, per_second: Decimal) -> None:
        self._constants = {
            unit: double_double(per_second * scale) for unit, scale in UNITS.items()}

    def product(self, times: Times) -> tuple[Column, Column]:
        """Return rate * t as nearest doubles and what they leave out."""
        rate_high, rate_low = self._constants[times.unit]
        r1, r2 = halves(rate_high)
        t1, t2 = times.halves
        high = rate_high * times.high
        rest = ((r1 * t1 - high) + r1 * t2 + r2 * t1)
        return high, (rest + r2 * t2) + (rate_low * times.high + rate_high * times.low)

    def fraction(self, times: Times) -> tuple[Column, Column]:
        """Return rate * t less whole numbers: doubles in [-1/2, 1/2] and small rests."""
        high, rest = self.product(times)
        return high - np.rint(high), rest
