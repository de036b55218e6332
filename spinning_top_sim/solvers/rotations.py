# SPDX-License-Identifier: Apache-2.0
"""Cosines and sines of angles that grow linearly with time, the same bits in any block."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.solvers.times import NANOSECONDS, Rate, Times, halves

Rows = NDArray[np.float64]

STEPS = 2048                # of a turn; within half a step the fifth power of the rest is 7e-17
STEP_ANGLE = 2.0 * np.pi / STEPS
# Within so many turns the first product of halves is exact to a small share of a step.
SHORT_TURNS = 2.0 ** 22
# Grids of shorter steps have too many times in a second to keep.
SHORTEST_STEP_NS, GRIDS_KEPT = 50_000, 16
# 1.5 * 2^52: doubles of its size are whole numbers, whose last bits are those of the mantissa.
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

    The whole steps of an angle are looked up in a table; the rest, less than half a step, is put
    on by the addition theorem.  numpy's own cosine and sine take twice the time.

    angles : pairs of rate [turns/s] and start [turns]
    """

    def __init__(self, angles: Sequence[tuple[Decimal, Decimal]]) -> None:
        first, second, start_steps, start_rests = [], [], [], []
        for rate, start in angles:
            in_steps = rate * STEPS / 10 ** 9
            first.append(halves(float(in_steps))[0])
            second.append(float(in_steps - Decimal(first[-1])))
            start_in_steps = (start - start.to_integral_value()) * STEPS
            start_steps.append(float(start_in_steps.to_integral_value()))
            start_rests.append(float(start_in_steps - Decimal(start_steps[-1])))
        self._first, self._second, self._whole, self._start = (
            np.array(numbers)[:, np.newaxis]
            for numbers in (first, second, [WHOLE + steps for steps in start_steps], start_rests))
        self._rates = [Rate(rate) for rate, _ in angles]
        fastest = max(abs(rate.high) for rate in self._rates)
        self._short_ns = SHORT_TURNS / fastest if fastest else np.inf
        # By step and offset [ns]: `_within_second` of uniform grids.
        self._grids: dict[tuple[int, int], tuple[Rows, Rows]] = {}

    def cosines_and_sines(self, times: Times) -> tuple[Rows, Rows]:
        """Return cos and sin of the angles, (k, n) each."""
        return self._of_steps(*self._in_steps(times, self._start), self._whole)

    def at_ns(self, ns: NDArray[np.int64] | range) -> tuple[Rows, Rows]:
        """
        Return cos and sin of the angles, (k, n) each, at integer nanoseconds.

        By the addition theorem from the begin of the time's second and the angle within the
        second.  A uniform grid that divides the second needs the latter once: it takes half the
        time of `cosines_and_sines`, and a value depends on its own time only.
        """
        if isinstance(ns, range) and NANOSECONDS % ns.step == 0 and ns.step >= SHORTEST_STEP_NS:
            return self._on_grid(ns)
        times = np.asarray(ns, dtype=np.int64)
        seconds, inverse = np.unique(times // NANOSECONDS, return_inverse=True)
        row_cosine, row_sine = (x.take(inverse, axis=1) for x in self._at_seconds(seconds))
        cosine, sine = self._within_second(times % NANOSECONDS)
        return row_cosine * cosine - row_sine * sine, row_sine * cosine + row_cosine * sine

    def _on_grid(self, grid: range) -> tuple[Rows, Rows]:
        step, offset = grid.step, grid.start % grid.step
        key = step, offset
        if key not in self._grids:
            while len(self._grids) >= GRIDS_KEPT:
                del self._grids[next(iter(self._grids))]
            self._grids[key] = self._within_second(np.arange(offset, NANOSECONDS, step))
        first = grid.start // NANOSECONDS
        seconds = np.arange(first, grid[-1] // NANOSECONDS + 1)
        row_cosine, row_sine = (x[:, :, np.newaxis] for x in self._at_seconds(seconds))
        cosine, sine = (x[:, np.newaxis, :] for x in self._grids[key])
        cosines = row_cosine * cosine
        cosines -= row_sine * sine
        sines = row_sine * cosine
        sines += row_cosine * sine
        begin = (grid.start - first * NANOSECONDS) // step
        part = slice(begin, begin + len(grid))
        count = len(self._start)
        return cosines.reshape(count, -1)[:, part], sines.reshape(count, -1)[:, part]

    def _at_seconds(self, seconds: NDArray[np.int64]) -> tuple[Rows, Rows]:
        return self.cosines_and_sines(Times.from_ns(seconds * NANOSECONDS))

    def _within_second(self, ns: NDArray[np.int64]) -> tuple[Rows, Rows]:
        """Return cos and sin of what the angles grow by in less than a second."""
        return self._of_steps(*self._in_steps(Times.from_ns(ns), np.zeros_like(self._start)),
                              WHOLE)

    def _of_steps(self, major: Rows, minor: Rows, start: Rows | float) -> tuple[Rows, Rows]:
        """
        Return cos and sin of angles in steps; in place, as memory costs as much as sums.

        start : WHOLE and the whole steps of the angles at t = 0
        """
        # Adding WHOLE rounds to whole steps; taking it away again is exact.
        whole = major + start
        major -= whole - start
        major += minor
        more = major + WHOLE
        major -= more - WHOLE
        index = whole.view(np.int64)
        index += more.view(np.int64)
        index &= STEPS - 1
        table_cosine, table_sine = COSINES.take(index), SINES.take(index)
        square = np.multiply(major, major, out=minor)
        cosine = np.multiply(square, STEP_ANGLE ** 4 / 24.0, out=more)
        cosine -= STEP_ANGLE ** 2 / 2.0
        cosine *= square
        cosine += 1.0
        sine = np.multiply(square, -STEP_ANGLE ** 3 / 6.0, out=square)
        sine += STEP_ANGLE
        sine *= major
        cosines = np.multiply(table_cosine, cosine, out=major)
        cosines -= table_sine * sine
        table_sine *= cosine
        table_cosine *= sine
        table_sine += table_cosine
        return cosines, table_sine

    def _in_steps(self, times: Times, start: Rows) -> tuple[Rows, Rows]:
        """Return the angles in steps, less whole ones at the start: exact values and rests."""
        t1, t2 = times.halves
        major = self._first * t1
        minor = self._first * (t2 + times.low)
        minor += self._second * times.high
        minor += start
        far = np.abs(times.high) > self._short_ns
        if far.any():
            distant = times[far]
            for k, rate in enumerate(self._rates):
                turns, rest = rate.fraction(distant)
                major[k, far] = STEPS * turns
                minor[k, far] = STEPS * rest + start[k]
        return major, minor
