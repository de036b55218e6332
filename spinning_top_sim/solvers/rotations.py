# SPDX-License-Identifier: Apache-2.0
"""Cosines and sines of angles that grow linearly with time, the same bits in any block."""

import math
import threading
from collections.abc import Iterable, Sequence
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.solvers.decimal_math import ONE
from spinning_top_sim.solvers.times import LARGEST_NS, NANOSECONDS, UNITS, Rate, Times, halves

Rows = NDArray[np.float64]

# Steps of a turn: within half a step r the first neglected term of the sine, r^5/120, is 7e-17.
STEPS = 2048
STEP_ANGLE = 2.0 * np.pi / STEPS
# Within so many turns the rest of an angle is rounded by less than 1e-16 rad.
SHORT_TURNS = 2.0 ** 22
# Grids of shorter steps have too many times in a second to keep.
SHORTEST_STEP_NS, GRIDS_KEPT, SECONDS_KEPT = 50_000, 16, 60
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


def _column(values: Iterable[Decimal]) -> Rows:
    return np.array([[float(x)] for x in values])


class Scratch(threading.local):
    """
    Memory for the temporaries of a block, which each thread keeps.

    Fresh memory costs as much as the arithmetic in it: the C library returns arrays of this size
    to the system, which clears every page again.
    """

    def __init__(self) -> None:
        self._kept = np.empty(0)

    def rows(self, *shape: int) -> Rows:
        """Return an array of this shape, of any content; the next call returns the same memory."""
        size = math.prod(shape)
        if size > len(self._kept):
            self._kept = np.empty(size)
        return self._kept[:size].reshape(shape)


_ANGLES, _PRODUCTS = Scratch(), Scratch()


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
        starts = [start.remainder_near(ONE) * STEPS for _, start in angles]
        whole = [start.to_integral_value() for start in starts]
        self._whole = WHOLE + _column(whole)
        self._start_rest = _column([a - b for a, b in zip(starts, whole, strict=True)])
        self._rates = [Rate(rate) for rate, _ in angles]
        fastest = max(abs(rate) for rate, _ in angles)
        # [steps], as halves of doubles and what they leave out, and the times up to which they
        # are enough.
        self._constants: dict[str, tuple[Rows, Rows, float]] = {}
        for unit, scale in UNITS.items():
            exact = [rate * scale * STEPS for rate, _ in angles]
            high = halves(_column(exact))[0]
            low = _column(rate - Decimal(float(x))
                          for rate, x in zip(exact, high[:, 0], strict=True))
            self._constants[unit] = high, low, SHORT_TURNS / max(float(fastest * scale), 1e-300)
        # By step and offset [ns]: `_within_second` of uniform grids.
        self._grids: dict[tuple[int, int], Rows] = {}
        # The first of the seconds that `_at_seconds` has computed, and what it found.
        self._seconds = 0, np.empty((2, len(angles), 0))

    def cosines_and_sines(self, times: Times, added: Rows | float = 0.0) -> tuple[Rows, Rows]:
        """
        Return cos and sin of the angles, (k, n) each, with `added` (k, n) [steps].

        Their memory is used again by the next call in the same thread.
        """
        return self._evaluate(times, self._start_rest + added, self._whole)

    def at_ns(self, ns: NDArray[np.int64] | range) -> tuple[Rows, Rows]:
        """
        Return cos and sin of the angles, (k, n) each, at integer nanoseconds.

        By the addition theorem from the begin of the time's second and the angle within the
        second.  A uniform grid that divides the second needs the latter once: it takes half the
        time of `cosines_and_sines`, and a value depends on its own time only.
        """
        if self._constants['ns'][2] < 1.0:        # a second has more turns than a double counts
            return self.cosines_and_sines(Times.from_ns(ns))
        if isinstance(ns, range) and NANOSECONDS % ns.step == 0 and ns.step >= SHORTEST_STEP_NS:
            return self._on_grid(ns)
        times = np.asarray(ns, dtype=np.int64)
        seconds, inverse = np.unique(times // NANOSECONDS, return_inverse=True)
        row_cosine, row_sine = (x.take(inverse, axis=1) for x in self.cosines_and_sines(
            Times.from_ns(seconds * NANOSECONDS)))
        cosine, sine = self._within_second(times % NANOSECONDS)
        return row_cosine * cosine - row_sine * sine, row_sine * cosine + row_cosine * sine

    def _on_grid(self, grid: range) -> tuple[Rows, Rows]:
        step, offset = key = grid.step, grid.start % grid.step
        if key not in self._grids:
            while len(self._grids) >= GRIDS_KEPT:
                del self._grids[next(iter(self._grids))]
            self._grids[key] = np.array(self._within_second(np.arange(offset, NANOSECONDS, step)))
        seconds = range(grid.start // NANOSECONDS, grid[-1] // NANOSECONDS + 1)
        row_cosine, row_sine = (x[:, :, np.newaxis] for x in self._at_seconds(seconds))
        cosine, sine = (x[:, np.newaxis, :] for x in self._grids[key])
        begin = (grid.start - seconds[0] * NANOSECONDS) // step
        part = slice(begin, begin + len(grid))
        rows = _PRODUCTS.rows(3, len(self._whole), len(seconds), NANOSECONDS // step)
        cosines, sines, product = rows
        np.multiply(row_cosine, cosine, out=cosines)
        cosines -= np.multiply(row_sine, sine, out=product)
        np.multiply(row_sine, cosine, out=sines)
        sines += np.multiply(row_cosine, sine, out=product)
        cosines, sines, _ = rows.reshape(3, len(self._whole), -1)[:, :, part]
        return cosines, sines

    def _at_seconds(self, seconds: range) -> tuple[Rows, Rows]:
        """Return cos and sin of the angles when these seconds begin; a minute is kept."""
        first, rows = self._seconds
        if not first <= seconds[0] <= seconds[-1] < first + rows.shape[2]:
            first = seconds[0]
            end = min(first + max(len(seconds), SECONDS_KEPT), LARGEST_NS // NANOSECONDS + 2)
            rows = np.array(self.cosines_and_sines(
                Times.from_ns(np.arange(first, end) * NANOSECONDS)))
            self._seconds = first, rows
        cosines, sines = rows[:, :, seconds[0] - first:][:, :, :len(seconds)]
        return cosines, sines

    def _within_second(self, ns: NDArray[np.int64]) -> tuple[Rows, Rows]:
        """Return cos and sin of what the angles grow by in less than a second."""
        return self._evaluate(Times.from_ns(ns), np.zeros_like(self._start_rest), WHOLE)

    def _evaluate(self, times: Times, start_rest: Rows, whole_start: Rows | float,
                  ) -> tuple[Rows, Rows]:
        """
        Return cos and sin of rate times t plus a start, (k, n) each.

        start_rest : [steps], (k, 1) or (k, n)
        whole_start : WHOLE and the whole steps of the start, (k, 1)
        """
        exact, rest, step, table_cosine, table_sine, product = _ANGLES.rows(
            6, len(self._whole), len(times))
        rate_high, rate_low, short = self._constants[times.unit]
        time_high, time_low = times.halves
        np.multiply(rate_high, time_high, out=exact)
        np.multiply(rate_high, time_low + times.low, out=rest)
        rest += np.multiply(rate_low, times.high, out=product)
        rest += start_rest
        if times.latest > short:
            far = np.abs(times.high) > short
            distant, start_rest = times[far], np.broadcast_to(start_rest, exact.shape)[:, far]
            for k, rate in enumerate(self._rates):
                turns, turns_rest = rate.fraction(distant)
                exact[k, far] = STEPS * turns
                rest[k, far] = STEPS * turns_rest + start_rest[k]
        # Adding WHOLE rounds to whole steps; taking it away again is exact, and so is the
        # difference between these steps and `exact`.
        np.add(exact, rest, out=step)
        step += whole_start
        remainder = np.subtract(exact, np.subtract(step, whole_start, out=product), out=exact)
        remainder += rest
        index = step.view(np.int64)
        index &= STEPS - 1
        # Nothing is clipped; `take` copies unless it may clip.
        COSINES.take(index, out=table_cosine, mode='clip')
        SINES.take(index, out=table_sine, mode='clip')
        square = np.multiply(remainder, remainder, out=rest)
        cosine = np.multiply(square, STEP_ANGLE ** 4 / 24.0, out=step)
        cosine -= STEP_ANGLE ** 2 / 2.0
        cosine *= square
        cosine += 1.0
        sine = np.multiply(square, -STEP_ANGLE ** 3 / 6.0, out=square)
        sine += STEP_ANGLE
        sine *= remainder
        cosines = np.multiply(table_cosine, cosine, out=remainder)
        cosines -= np.multiply(table_sine, sine, out=product)
        table_sine *= cosine
        sines = np.multiply(table_cosine, sine, out=sine)
        sines += table_sine
        return cosines, sines
