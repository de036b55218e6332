# SPDX-License-Identifier: Apache-2.0
"""Cosines and sines of angles that grow linearly with time, the same bits in any block."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.solvers.decimal_math import ONE
from spinning_top_sim.solvers.times import NANOSECONDS, Rate, Times, halves

Rows = NDArray[np.float64]

# Steps of a turn: within half a step r the first neglected term of the sine, r^5/120, is 7e-17.
STEPS = 2048
STEP_ANGLE = 2.0 * np.pi / STEPS
# Within so many turns the rest of an angle is rounded by less than 1e-16 rad.
SHORT_TURNS = 2.0 ** 22
# Grids of shorter steps have too many times in a second to keep.
SHORTEST_STEP_NS, GRIDS_KEPT = 50_000, 16
# 1.5 * 2^52: doubles of this size are whole numbers k + WHOLE; their last bits are those of k.
WHOLE = 1.5 * 2.0 ** 52


def _table() -> tuple[Rows, Rows]:
    """Return cosines and sines of whole steps, from angles of at most an eighth of a turn."""
    step = np.arange(STEPS)
    quarter = np.rint(step / (STEPS // 4)).astype(int)
    angle = STEP_ANGLE * (step - quarter * (STEPS // 4))
    cosine, sine = np.cos(angle), np.sin(angle)
    return (np.choose(quarter % 4, (cosine, -sine, -cosine, sine)),
            np.choose(quarter % 4, (sine, cosine, -sine, -cosine)))


COSINES, SINES = _table()


class Rotations:
    """
    k angles, each a rate times t plus a start.

    An angle is s = exact + rest in steps of STEP_ANGLE, where `exact` is a product of two halves
    of doubles, without rounding.  With the nearest step j and r = (s - j) STEP_ANGLE,

        cos(s) = cos(j) cos(r) - sin(j) sin(r),   sin(s) = sin(j) cos(r) + cos(j) sin(r):

    cos(j) and sin(j) come from a table, cos(r) and sin(r) from three terms of their series.
    numpy's cosine and sine take twice the time.

    angles : pairs of rate [turns/s] and start [turns]
    """

    def __init__(self, angles: Sequence[tuple[Decimal, Decimal]]) -> None:
        rows = []
        for rate, start in angles:
            per_ns, at_zero = rate * STEPS / 10 ** 9, start.remainder_near(ONE) * STEPS
            rate_high, whole = halves(float(per_ns))[0], at_zero.to_integral_value()
            rows.append((rate_high, float(per_ns - Decimal(rate_high)),
                         WHOLE + float(whole), float(at_zero - whole)))
        self._rate_high, self._rate_low, self._whole, self._start_rest = (
            np.array(rows).T[:, :, np.newaxis])
        self._rates = [Rate(rate) for rate, _ in angles]
        fastest = max(abs(rate.high) for rate in self._rates)
        self._short_ns = SHORT_TURNS / fastest if fastest else np.inf
        # By step and offset [ns]: `_within_second` of uniform grids.
        self._grids: dict[tuple[int, int], tuple[Rows, Rows]] = {}

    def cosines_and_sines(self, times: Times, added: Rows | float = 0.0) -> tuple[Rows, Rows]:
        """Return cos and sin of the angles, (k, n) each, with `added` (k, n) [steps]."""
        return self._of_steps(*self._in_steps(times, self._start_rest + added), self._whole)

    def at_ns(self, ns: NDArray[np.int64] | range) -> tuple[Rows, Rows]:
        """
        Return cos and sin of the angles, (k, n) each, at integer nanoseconds.

        By the addition theorem from the begin of the time's second and the angle within the
        second.  A uniform grid that divides the second needs the latter once: it takes half the
        time of `cosines_and_sines`, and a value depends on its own time only.
        """
        if self._short_ns < 1.0:        # a second has more turns than a double counts
            return self.cosines_and_sines(Times.from_ns(ns))
        if isinstance(ns, range) and NANOSECONDS % ns.step == 0 and ns.step >= SHORTEST_STEP_NS:
            return self._on_grid(ns)
        times = np.asarray(ns, dtype=np.int64)
        seconds, inverse = np.unique(times // NANOSECONDS, return_inverse=True)
        row_cosine, row_sine = (x.take(inverse, axis=1) for x in self._at_seconds(seconds))
        cosine, sine = self._within_second(times % NANOSECONDS)
        return row_cosine * cosine - row_sine * sine, row_sine * cosine + row_cosine * sine

    def _on_grid(self, grid: range) -> tuple[Rows, Rows]:
        step, offset = key = grid.step, grid.start % grid.step
        if key not in self._grids:
            while len(self._grids) >= GRIDS_KEPT:
                del self._grids[next(iter(self._grids))]
            self._grids[key] = self._within_second(np.arange(offset, NANOSECONDS, step))
        first = grid.start // NANOSECONDS
        seconds = np.arange(first, grid[-1] // NANOSECONDS + 1)
        row_cosine, row_sine = (x[:, :, np.newaxis] for x in self._at_seconds(seconds))
        cosine, sine = (x[:, np.newaxis, :] for x in self._grids[key])
        begin = (grid.start - first * NANOSECONDS) // step
        part = slice(begin, begin + len(grid))
        cosines = (row_cosine * cosine - row_sine * sine).reshape(len(self._whole), -1)
        sines = (row_sine * cosine + row_cosine * sine).reshape(len(self._whole), -1)
        return cosines[:, part], sines[:, part]

    def _at_seconds(self, seconds: NDArray[np.int64]) -> tuple[Rows, Rows]:
        return self.cosines_and_sines(Times.from_ns(seconds * NANOSECONDS))

    def _within_second(self, ns: NDArray[np.int64]) -> tuple[Rows, Rows]:
        """Return cos and sin of what the angles grow by in less than a second."""
        return self._of_steps(*self._in_steps(Times.from_ns(ns), np.zeros_like(self._start_rest)),
                              WHOLE)

    def _of_steps(self, exact: Rows, rest: Rows, whole_start: Rows | float) -> tuple[Rows, Rows]:
        """
        Return cos and sin of angles in steps; both arguments are overwritten.

        In place, as fresh memory costs as much as the sums.

        whole_start : WHOLE and the whole steps of the angles at t = 0
        """
        # Adding WHOLE rounds to whole steps, and taking it away again is exact.  `rest` may have
        # whole steps too, so the last bits of both sums together are those of the step j.
        step = exact + whole_start
        remainder = exact
        remainder -= step - whole_start
        remainder += rest
        more_steps = remainder + WHOLE
        remainder -= more_steps - WHOLE
        index = step.view(np.int64)
        index += more_steps.view(np.int64)
        index &= STEPS - 1
        table_cosine, table_sine = COSINES.take(index), SINES.take(index)
        square = np.multiply(remainder, remainder, out=rest)
        cosine = np.multiply(square, STEP_ANGLE ** 4 / 24.0, out=more_steps)
        cosine -= STEP_ANGLE ** 2 / 2.0
        cosine *= square
        cosine += 1.0
        sine = np.multiply(square, -STEP_ANGLE ** 3 / 6.0, out=square)
        sine += STEP_ANGLE
        sine *= remainder
        cosines = np.multiply(table_cosine, cosine, out=remainder)
        cosines -= table_sine * sine
        sines = np.multiply(table_sine, cosine, out=table_sine)
        sines += np.multiply(table_cosine, sine, out=table_cosine)
        return cosines, sines

    def _in_steps(self, times: Times, start_rest: Rows) -> tuple[Rows, Rows]:
        """Return `exact` and `rest` of the angles, without the whole steps at t = 0."""
        time_high, time_low = times.halves
        exact = self._rate_high * time_high
        rest = self._rate_high * (time_low + times.low)
        rest += self._rate_low * times.high
        rest += start_rest
        far = np.abs(times.high) > self._short_ns
        if far.any():
            distant, start_rest = times[far], np.broadcast_to(start_rest, exact.shape)[:, far]
            for k, rate in enumerate(self._rates):
                turns, turns_rest = rate.fraction(distant)
                exact[k, far] = STEPS * turns
                rest[k, far] = STEPS * turns_rest + start_rest[k]
        return exact, rest
