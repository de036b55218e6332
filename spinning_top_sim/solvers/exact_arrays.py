# SPDX-License-Identifier: Apache-2.0
"""
The exact motion for arrays of times.

Two ways lead to a quaternion.  `ExactStates` evaluates the formulas of `exact.nutation_at`, even
and odd quarter periods apart, for every column.  For quaternions alone `_Attitudes` stays with the
series of the even quarter periods, all round in the real form, or from one passage of u2 to the
next in the imaginary form, so that blocks of times go through without a case distinction.  And as
a series in the real form is a sum of a few sinusoids, a block of a uniform grid is a product
of two small matrices (`_Grid`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from decimal import Decimal
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from spinning_top_sim.solvers.exact import (
    QUARTER_PERIOD_ANGLE,
    Functions,
    nutation_at,
    transverse_rates,
)
from spinning_top_sim.solvers.exact_attitude import modes, too_late
from spinning_top_sim.solvers.long_decimals import (
    FIXED_BITS,
    FIXED_ONE,
    ONE,
    ZERO,
    FixedRate,
    double_double,
    pi,
    precision,
    sinh_cosh,
)
from spinning_top_sim.solvers.theta_series import Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion

if TYPE_CHECKING:
    from spinning_top_sim.solvers.exact import ExactSolution

ARRAY = Functions(np.sin, np.sinh, np.sqrt, np.hypot, np.arctan2)
CHUNK = 5120                # times in a block: its temporaries stay in the cache
TWO_PI = 2.0 * math.pi
NEGLIGIBLE = 1e-18          # beside the largest coefficient

TABLE_STEPS = 2048          # of a turn; within a step the fifth power of the rest is 6e-17
STEP_ANGLE = TWO_PI / TABLE_STEPS
SHORT_TURNS = 2.0 ** 22     # so many turns are counted right with a rate split in two

GRID_BLOCK = 512            # states in a row of the grid's product
GRID_ROWS = 16              # rows that are worked on together
KEPT_GRIDS = 16             # steps whose factor matrices are kept, 0.1 MB each
MOST_ROWS = 1 << 15         # whose count times a limb fits 64 bits
LIMB = 48                   # bits: two limbs are the fraction of a turn


class ExactStates:
    """States at many times; a column is computed when it is first asked for, and kept."""

    def __init__(self, evaluator: ArrayEvaluator, t: np.ndarray, t_rest: np.ndarray | None = None):
        self._evaluator, self._t, self._t_rest = evaluator, t, t_rest

    @cached_property
    def quaternion(self) -> np.ndarray:
        """(n, 4) x, y, z, w: body to world, the sign continuous in time."""
        return self._evaluator.attitudes.quaternion(self._t, self._t_rest)

    @cached_property
    def theta(self) -> np.ndarray:
        """(n,) [rad]: smooth through a pole that is passed exactly, so it may leave [0, pi]."""
        return self._evaluator.theta(self._nutation)

    @property
    def theta_dot(self) -> np.ndarray:
        """(n,) [rad/s]."""
        return self._nutation[4]

    @cached_property
    def phi(self) -> np.ndarray:
        """(n,) [rad], unwrapped."""
        return self._evaluator.phi(self._nutation, self._t, self._t_rest)

    @cached_property
    def psi(self) -> np.ndarray:
        """(n,) [rad], unwrapped."""
        return self._evaluator.psi(self._nutation, self._t, self._t_rest)

    @cached_property
    def angular_velocity(self) -> np.ndarray:
        """(n, 3) [rad/s], of the body, in its own frame."""
        return self._evaluator.angular_velocity(self._nutation, self._t, self._t_rest)

    @cached_property
    def _nutation(self) -> np.ndarray:
        return self._evaluator.nutation(self._t, self._t_rest)


class ArrayEvaluator:
    """What `ExactSolution` needs to serve arrays; one per solution."""

    def __init__(self, solution: ExactSolution):
        self.solution = solution
        motion = solution.theta_motion
        with precision(motion.digits):
            two_pi = 2 * pi()
            alpha, beta = motion.alpha, motion.beta
            self.quarters = Rate(motion.quarter_rate)
            self.offset0 = double_double(motion.offset0)
            self.precession, self.spin = (
                Rate(motion.mean_precession_rate), Rate(motion.mean_spin_rate))
            self.spin_turns = Rate(motion.mean_spin_rate / two_pi)
            self.spin_phase = float(two_pi * (alpha.phase_turns - beta.phase_turns))
            self.attitudes = _Attitudes(motion)

    # ------------------------------------------------------------------------- what is offered

    def states(self, t: Any) -> ExactStates:
        """See ExactSolution.states."""
        return ExactStates(self, self._checked(t).copy())     # columns come later

    def states_at_ns(self, ns: Any) -> ExactStates:
        """See ExactSolution.states_at_ns."""
        ns = np.asarray(ns)
        if ns.ndim != 1 or ns.dtype.kind not in 'iu':
            raise ValueError(
                f'ns has shape {ns.shape} and type {ns.dtype}: must be (n,) whole nanoseconds')
        if ns.size:
            for extreme in (int(ns.min()), int(ns.max())):
                self._check_ns(extreme)
        return ExactStates(self, *_seconds(ns.astype(np.int64)))

    def quaternion(self, t: Any) -> np.ndarray:
        """See ExactSolution.quaternion."""
        return self.attitudes.quaternion(self._checked(t), None)

    def quaternion_grid(self, start_ns: int, step_ns: int, count: int) -> np.ndarray:
        """See ExactSolution.quaternion_grid."""
        if count < 0:
            raise ValueError(f'count = {count!r}: must be >= 0')
        for extreme in (start_ns, start_ns + step_ns * max(0, count - 1)):
            self._check_ns(extreme)
        if not self.attitudes.imaginary:
            return self.attitudes.quaternion_grid(start_ns, step_ns, count)
        out = np.empty((count, 4))
        for block in _blocks(count):
            ns = start_ns + step_ns * np.arange(block.start, block.stop)
            out[block] = self.states_at_ns(ns).quaternion
        return out

    # ------------------------------------------------------------------ columns, block by block

    def nutation(self, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        """Return rows alpha, beta, their arguments, theta' (see NutationPoint), missing turns."""
        solution = self.solution
        columns = np.zeros((6, len(t)))
        for block in _blocks(len(t)):
            quarters, y = self._nutation_phase(t[block], _part_of(t_rest, block))
            place = quarters.astype(np.int64) & 3
            flip = np.where(place < 2, 1.0, -1.0)
            odd = (place & 1).astype(bool)
            out = columns[:, block]
            for branch, here in zip(solution.branches, (~odd, odd), strict=True):
                index = np.flatnonzero(here)
                if index.size:
                    point = nutation_at(branch, y[index], flip[index], ARRAY)
                    for row, values in zip(out, point, strict=False):
                        row[index] = values
            if solution.turning:
                out[5] = solution.turning.turns(quarters, y, np.arctan2(out[1], out[0]))
        return columns

    def _nutation_phase(self, t: np.ndarray, t_rest: np.ndarray | None
                        ) -> tuple[np.ndarray, np.ndarray]:
        """Return whole quarter periods and the angle y from there, accurate relative to itself."""
        high, rest = self.quarters.product(t, t_rest)
        whole = np.rint(high)
        part = high - whole
        offset, offset_rest = self.offset0
        shift = np.rint(part + (rest + offset))
        part -= shift
        nearest = part + offset                     # Knuth's sum: exact with what it leaves out
        taken = nearest - part
        left_out = (part - (nearest - taken)) + (offset - taken)
        return (whole + (self.solution.quarter0 + shift),
                QUARTER_PERIOD_ANGLE * (nearest + (left_out + (rest + offset_rest))))

    def theta(self, nutation: np.ndarray) -> np.ndarray:
        """Return 2 atan2(|beta|, |alpha|), and the whole turns of a planar rotation."""
        alpha, beta, *_, turns = nutation
        half_theta = np.arctan2(beta, alpha)
        if self.solution.turning:
            half_theta += TWO_PI * np.rint(turns)
        return 2.0 * half_theta

    def phi(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        """Return arg alpha + arg beta."""
        _, _, alpha_argument, beta_argument, *_ = nutation
        return self._unwrapped(self.precession, self.solution.phi_phase, t, t_rest,
                               alpha_argument + beta_argument)

    def psi(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        """Return arg alpha - arg beta."""
        _, _, alpha_argument, beta_argument, *_ = nutation
        return self._unwrapped(self.spin, self.solution.psi_phase, t, t_rest,
                               alpha_argument - beta_argument)

    def _unwrapped(self, rate: Rate, phase: float, t: np.ndarray, t_rest: np.ndarray | None,
                   nutation: np.ndarray) -> np.ndarray:
        out = np.empty(len(t))
        for block in _blocks(len(t)):
            high, rest = rate.product(t[block], _part_of(t_rest, block))
            out[block] = high + (rest + (phase + nutation[block]))
        return out

    def angular_velocity(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None
                         ) -> np.ndarray:
        """Return (n, 3) in the body's frame."""
        out = np.empty((len(t), 3))
        for block in _blocks(len(t)):
            alpha, beta, alpha_argument, beta_argument, theta_dot, _ = nutation[:, block]
            part, rest = self.spin_turns.fraction(t[block], _part_of(t_rest, block))
            psi = TWO_PI * (part + rest) + (self.spin_phase + (alpha_argument - beta_argument))
            out[block, 0], out[block, 1] = transverse_rates(
                self.solution.precession_across_axis(alpha, beta), theta_dot,
                np.cos(psi), np.sin(psi))
        out[:, 2] = self.solution.axial_rate
        return out

    # ------------------------------------------------------------------------------- the times

    def _checked(self, t: Any) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        if t.ndim != 1:
            raise ValueError(f't has shape {t.shape}: must be (n,) seconds')
        if t.size:
            latest = max(float(t.max()), -float(t.min()))
            if not latest <= self.solution.time_limit:      # catches NaN too
                raise too_late(f'{latest!r} s', self.solution.time_limit)
        return t

    def _check_ns(self, ns: int) -> None:
        if abs(ns) > self.solution.ns_limit:
            raise too_late(f'{ns} ns', self.solution.time_limit)


def _blocks(n: int) -> Iterator[slice]:
    for first in range(0, n, CHUNK):
        yield slice(first, min(first + CHUNK, n))


def _part_of(t_rest: np.ndarray | None, block: slice) -> np.ndarray | None:
    return None if t_rest is None else t_rest[block]


def _seconds(ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return int64 nanoseconds in seconds, as nearest doubles and rests."""
    whole, count = (x.astype(np.float64) for x in np.divmod(ns, 10 ** 9))
    part, part_rest = NANOSECOND.product(count, None)
    total = whole + part                            # Dekker's sum: whole is 0 or the larger
    return total, (part - (total - whole)) + part_rest


def _halves(x: Any) -> tuple[Any, Any]:
    """Split doubles into two of 26 bits each, whose products are exact [Dekker 1971]."""
    big = 134217729.0 * x   # 2^27 + 1
    high = big - (big - x)
    return high, x - high


class Rate:
    """
    A rate in double-double; its product with a time has no rounding that grows with the time.

    Times are pairs of arrays: the doubles, and what they leave out (None: nothing).
    """

    def __init__(self, per_second: Decimal):
        self.high, self.low = double_double(per_second)
        self.halves = _halves(self.high)

    def product(self, t: np.ndarray, t_rest: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return rate * t as nearest double and rest."""
        t1, t2 = _halves(t)
        r1, r2 = self.halves
        high = self.high * t
        rest = ((r1 * t1 - high) + r1 * t2 + r2 * t1) + r2 * t2 + self.low * t
        if t_rest is not None:
            rest += self.high * t_rest
        return high, rest

    def fraction(self, t: np.ndarray, t_rest: np.ndarray | None
                 ) -> tuple[np.ndarray, np.ndarray]:
        """Return rate * t less whole numbers, as a double in [-1/2, 1/2] and a small rest."""
        high, rest = self.product(t, t_rest)
        return high - np.rint(high), rest


NANOSECOND = Rate(Decimal('1e-9'))


# -------------------------------------------------------------------------- one form all round


def _turn_table() -> np.ndarray:
    """Return exp(i angle) of whole steps, from angles of at most an eighth of a turn."""
    step = np.arange(TABLE_STEPS)
    quarter = np.rint(step / (TABLE_STEPS // 4)).astype(int)
    angle = STEP_ANGLE * (step - quarter * (TABLE_STEPS // 4))
    s, c = np.sin(angle), np.cos(angle)
    return (np.choose(quarter % 4, (c, -s, -c, s))
            + 1j * np.choose(quarter % 4, (s, c, -s, -c)))


TURN = _turn_table()
# Constants as arrays, which numpy takes up faster than numbers.
SINE_1, SINE_3 = np.array(STEP_ANGLE), np.array(-STEP_ANGLE ** 3 / 6.0)
COSINE_2, COSINE_4 = np.array(-STEP_ANGLE ** 2 / 2.0), np.array(STEP_ANGLE ** 4 / 24.0)
COUNTER = np.array(1.5 * 2.0 ** 52)     # doubles of its size are the whole numbers
UNITY, FOUR_ONES = np.array(1.0), np.ones(4)


class _Block:
    """
    Buffers for a block of n times: all is computed in place, in the cache.

    Rows belong to rotors, later to series or to the halves x + iy and z + iw of the quaternions.
    What is alike goes through numpy together: a call costs as much as some thousand sums.
    """

    def __init__(self, n: int, powers: int, latest: float):
        self.latest = latest                    # the largest |t| of the call
        self.times = np.empty((4, n))           # what angles are linear in: t1, t2, 1 and y
        self.t1, self.t2, ones, self.y = self.times
        self.powers = np.empty((powers, n))     # of xi, from 1 on
        self.powers[0] = ones[...] = 1.0
        self.sin, self.cos, self.flip, self.scale = np.empty((4, n))
        rows = np.empty((12, n))                # of the angles
        self.exact, self.minor, self.rest, self.step = rows.reshape(4, 3, n)
        self.rest_rotation = np.empty((3, n), complex)
        # What comes later takes the memory of what is done with, so that all fits the cache.
        self.rotation = rows[:6].reshape(3, 2 * n).view(complex)
        self.series, self.squares = rows[6:10], self.rest_rotation.view(float).reshape(6, n)[:4]
        self.halves = self.rest_rotation[:2]

    def load(self, t: np.ndarray, t_rest: np.ndarray | None) -> None:
        """Take the times, and split them as `_halves` does."""
        self.t, self.t_rest = t, t_rest
        np.multiply(t, 134217729.0, out=self.t2)
        np.subtract(self.t2, t, out=self.t1)
        np.subtract(self.t2, self.t1, out=self.t1)
        np.subtract(t, self.t1, out=self.t2)


class _Angle(NamedTuple):
    """2 pi (rate t + start) + drift y, rate and start in turns."""

    rate: Decimal
    start: Decimal
    drift: float = 0.0

    def negative(self) -> _Angle:
        """Return the angle of the conjugate."""
        return _Angle(-self.rate, -self.start, -self.drift)


class _Rotors:
    """exp(i angle) for up to three angles side by side."""

    def __init__(self, *angles: _Angle):
        self.turns = [Rate(angle.rate) for angle in angles]
        self.fastest = max(abs(rate.high) for rate in self.turns)
        self.exact_rates, self.start_steps, minor_rates = [], [], []
        for rate, start, drift in angles:
            in_steps = rate * TABLE_STEPS
            exact_rate, _ = _halves(float(in_steps))
            start_steps = (start - start.to_integral_value()) * TABLE_STEPS
            whole = start_steps.to_integral_value()
            self.exact_rates.append(np.array(exact_rate))
            self.start_steps.append(int(whole))
            minor_rates.append((float(in_steps - Decimal(exact_rate)), float(in_steps),
                                float(start_steps - whole), drift / STEP_ANGLE))
        # For t1, t2, 1 and y; without drifts y is left out, as it may be undefined.
        self.minor_rates = np.array(minor_rates)
        if not self.minor_rates[:, 3].any():
            self.minor_rates = self.minor_rates[:, :3].copy()
        # A table for each, that begins at the start.
        self.tables = [np.roll(TURN, -start) for start in self.start_steps]

    def count_steps(self, b: _Block) -> tuple[np.ndarray, np.ndarray]:
        """Return COUNTER + the nearest whole numbers of steps from the start, and the rests."""
        n, columns = self.minor_rates.shape
        exact, minor, rest, step = b.exact[:n], b.minor[:n], b.rest[:n], b.step[:n]
        if b.t_rest is not None or b.latest * self.fastest > SHORT_TURNS:
            np.matmul(self.minor_rates[:, 2:], b.times[2:columns], out=minor)
            for turns, exact_row, minor_row in zip(self.turns, exact, minor, strict=True):
                part, part_rest = turns.fraction(b.t, b.t_rest)
                np.multiply(part, TABLE_STEPS, out=exact_row)
                np.add(minor_row, TABLE_STEPS * part_rest, out=minor_row)
        else:
            # The products of halves are exact, and so are their differences from near whole
            # numbers.  What else there is, little of a turn, is one product of matrices.
            for exact_rate, row in zip(self.exact_rates, exact, strict=True):
                np.multiply(b.t1, exact_rate, out=row)
            np.matmul(self.minor_rates, b.times[:columns], out=minor)
        np.add(exact, minor, out=rest)
        np.add(rest, COUNTER, out=step)         # rounds, as doubles of this size are whole
        np.subtract(step, COUNTER, out=rest)
        np.subtract(exact, rest, out=rest)
        np.add(rest, minor, out=rest)
        return step, rest

    def rotations(self, b: _Block) -> np.ndarray:
        """Return exp(i angle): the nearest step from the table, turned on by the rest."""
        step, rest = self.count_steps(b)
        n = len(step)
        rotation, rest_rotation = b.rotation[:n], b.rest_rotation[:n]
        # Cosine and sine of the rest by their power series.
        square, series = b.exact[:n], b.minor[:n]
        np.multiply(rest, rest, out=square)
        np.multiply(square, COSINE_4, out=series)
        np.add(series, COSINE_2, out=series)
        np.multiply(series, square, out=series)
        np.add(series, UNITY, out=rest_rotation.real)
        np.multiply(square, SINE_3, out=series)
        np.add(series, SINE_1, out=series)
        np.multiply(series, rest, out=rest_rotation.imag)
        index = step.view(np.int64)             # the last bits of COUNTER + k are those of k
        np.bitwise_and(index, TABLE_STEPS - 1, out=index)
        for table, row, out in zip(self.tables, index, rotation, strict=True):
            table.take(row, out=out, mode='clip')           # 'raise' would buffer
        np.multiply(rotation, rest_rotation, out=rotation)
        return rotation


def _polynomial(series: Series, largest_xi: Decimal) -> list[float]:
    """Return the coefficients in xi of a theta series less its prefactor, lowest first."""
    exact = series.polynomial()
    sizes = [abs(c) * largest_xi ** i for i, c in enumerate(exact)]
    while len(exact) > 1 and sizes[len(exact) - 1] < Decimal(NEGLIGIBLE) * max(sizes):
        exact.pop()
    return [float(x) for x in exact]


class _AttitudeFactor:
    """Alpha or beta over the even quarter periods: series for R and s J, and the rotation."""

    def __init__(self, factor: Factor, v_rate: Decimal, v_start: Decimal):
        branch = factor.full_circle or factor.even
        self.flips = factor.crosses and not factor.full_circle
        if factor.full_circle:          # the drift -s y, with y = v, is part of the rotation
            self.angle = _Angle(factor.rate / (2 * pi()) - factor.sense * v_rate,
                                factor.phase_turns - factor.sense * v_start)
        else:
            self.angle = _Angle(factor.rate / (2 * pi()), factor.phase_turns, float(factor.drift))
        self.fixed = FixedRate.of(self.angle.rate, self.angle.start)
        self.real = branch.real.scaled(Decimal(factor.sign))
        self.imag = branch.imag.scaled(Decimal(factor.sense)) if branch.imag else None


class _Attitudes:
    """
    Quaternions from the series of the even quarter periods.

    alpha = (R + i s J)(y)/D(y) exp i(rotation), with D from |alpha|^2 + |beta|^2 = 1.  In the real
    form y = v = (pi/2) Z, at any Z; the imaginary form, near the separatrix, reaches
    from Z = -1 to 1 about the nearest even Z, where D = cosh x and more than e^14.

    A row of the result is two complex numbers, i beta = x + iy and i conj(alpha) = z + iw: each is
    a product of complex numbers, (-s J + iR) exp(i rotation) and (s J + iR) exp(-i rotation).
    """

    def __init__(self, motion: ThetaMotion):
        self.imaginary = motion.alpha.full_circle is None
        self.stretch = float(motion.stretch)
        v = _Angle(motion.quarter_rate / 4, (motion.quarter0 + motion.offset0) / 4)
        self.phase_fixed = FixedRate.of(v.rate, v.start)
        self.alpha, self.beta = (
            _AttitudeFactor(factor, v.rate, v.start) for factor in (motion.alpha, motion.beta))
        both = self.beta.angle, self.alpha.angle.negative()
        if self.imaginary:
            self.phase, self.rotors = _Rotors(v), _Rotors(*both)
        else:
            self.rotors = _Rotors(*both, v)         # the phase is a rotor like the others
        self._set_up_series(
            sinh_cosh(motion.stretch * pi() / 2)[0] ** 2 if self.imaginary else ONE)
        self._grids: dict[int, _Grid] = {}

    def _set_up_series(self, largest_xi: Decimal) -> None:
        """-s J and R of beta, s J and R of alpha: prefactors and a matrix of coefficients."""
        none = Series('cos even', (ZERO,))
        rows = (self.beta.imag.scaled(-ONE) if self.beta.imag else none, self.beta.real,
                self.alpha.imag or none, self.alpha.real)
        polynomials = [_polynomial(series, largest_xi) for series in rows]
        self.coefficients = np.zeros((4, max(2, *map(len, polynomials))))
        for row, polynomial in zip(self.coefficients, polynomials, strict=True):
            row[:len(polynomial)] = polynomial
        self.prefactors = [series.prefactor for series in rows]

    def quaternion(self, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        """Return (n, 4) x, y, z, w."""
        n = len(t)
        out = np.empty((n, 4))
        if not n:
            return out
        # Blocks of one size, so that the same buffers serve all; the last may overlap another.
        size = math.ceil(n / math.ceil(n / CHUNK))
        buffers = _Block(size, self.coefficients.shape[1], max(float(t.max()), -float(t.min())))
        for first in range(0, n, size):
            begin = min(first, n - size)
            block = slice(begin, begin + size)
            buffers.load(t[block], _part_of(t_rest, block))
            self._fill(out[block].view(complex), buffers)
        return out

    def _fill(self, out: np.ndarray, b: _Block) -> None:
        """Set the columns x + iy and z + iw."""
        if self.imaginary:
            self._hyperbolic_phase(b)
        rotation = self.rotors.rotations(b)
        if self.imaginary:
            self._evaluate_series(b, b.sin, b.cos)
        else:
            self._evaluate_series(b, rotation[2].imag, rotation[2].real)
        for k in (0, 1):
            half = b.halves[k]
            np.multiply(b.series[2 * k], b.scale, out=half.real)
            np.multiply(b.series[2 * k + 1], b.scale, out=half.imag)
            np.multiply(half, rotation[k], out=out[:, k])

    def _evaluate_series(self, b: _Block, sin: np.ndarray, cos: np.ndarray) -> None:
        """Set b.series, and b.scale = 1/D."""
        xi = np.multiply(sin, sin, out=b.powers[1])
        if self.imaginary:
            np.negative(xi, out=xi)
        for k in range(2, len(b.powers)):
            np.multiply(b.powers[k - 1], xi, out=b.powers[k])
        np.matmul(self.coefficients, b.powers, out=b.series)
        for row, prefactor in zip(b.series, self.prefactors, strict=True):
            for factor in ((), (cos,), (sin,), (sin, cos))[prefactor]:
                np.multiply(row, factor, out=row)
        if self.beta.flips:
            b.series[:2] *= b.flip
        if self.alpha.flips:
            b.series[2:] *= b.flip
        np.multiply(b.series, b.series, out=b.squares)
        np.matmul(FOUR_ONES, b.squares, out=b.scale)        # the quickest sum
        np.sqrt(b.scale, out=b.scale)
        np.divide(UNITY, b.scale, out=b.scale)

    def _hyperbolic_phase(self, b: _Block) -> None:
        """Set b.y in [-pi/2, pi/2], b.flip = (-1)^(N/2), b.sin = sinh x and b.cos = cosh x."""
        (step,), (rest,) = self.phase.count_steps(b)
        (start,) = self.phase.start_steps
        step += start - COUNTER
        half_turns = np.rint(step * (2.0 / TABLE_STEPS))
        np.subtract(1.0, 2.0 * (half_turns.astype(np.int64) & 1), out=b.flip)
        step -= half_turns * (TABLE_STEPS // 2)
        np.multiply(step + rest, STEP_ANGLE, out=b.y)
        growing = 0.5 * np.exp(b.y * self.stretch)
        falling = 0.25 / growing
        np.subtract(growing, falling, out=b.sin)
        np.add(growing, falling, out=b.cos)

    def quaternion_grid(self, start_ns: int, step_ns: int, count: int) -> np.ndarray:
        """Return (count, 4) x, y, z, w; in the real form only."""
        if step_ns not in self._grids:
            if len(self._grids) == KEPT_GRIDS:
                self._grids.clear()
            self._grids[step_ns] = _Grid(self, step_ns)
        return self._grids[step_ns].quaternion(start_ns, count)


# ------------------------------------------------------------------------------ uniform grids


class _Grid:
    """
    The real form on times start + k step: alpha D = sum over modes of c_n exp i(nu_n t).

    As exp i nu (T + s) = exp(i nu T) exp(i nu s), a block of states is the product of a matrix
    (starts of rows x modes) and a matrix (modes x times within a row), which is kept.  Phases are
    products of integers, so that no error grows along the grid.
    """

    def __init__(self, attitudes: _Attitudes, step_ns: int):
        self.attitudes, self.step_ns = attitudes, step_ns
        self.offsets = tuple(
            self._within_row(factor) for factor in (attitudes.alpha, attitudes.beta))

    def quaternion(self, start_ns: int, count: int) -> np.ndarray:
        """Return (count, 4) x, y, z, w."""
        rows = -(-count // GRID_BLOCK)
        out = np.empty((rows, min(count, GRID_BLOCK), 4))
        for first in range(0, rows, MOST_ROWS):
            self._fill(out[first:first + MOST_ROWS],
                       start_ns + first * GRID_BLOCK * self.step_ns)
        return out.reshape(-1, 4)[:count]

    def _fill(self, out: np.ndarray, start_ns: int) -> None:
        rows, width, _ = out.shape
        alpha_rows, beta_rows = (
            self._row_starts(factor, start_ns, rows)
            for factor in (self.attitudes.alpha, self.attitudes.beta))
        alpha_offsets, beta_offsets = (x[:, :width] for x in self.offsets)
        for first in range(0, rows, GRID_ROWS):
            group = slice(first, first + GRID_ROWS)
            w = alpha_rows[0][group] @ alpha_offsets
            z = alpha_rows[1][group] @ alpha_offsets
            y = beta_rows[0][group] @ beta_offsets
            minus_x = beta_rows[1][group] @ beta_offsets
            scale = w * w
            for component in (z, y, minus_x):
                scale += component * component
            np.sqrt(scale, out=scale)
            np.divide(1.0, scale, out=scale)
            np.multiply(w, scale, out=out[group, :, 3])
            np.multiply(z, scale, out=out[group, :, 2])
            np.multiply(y, scale, out=out[group, :, 1])
            np.negative(scale, out=scale)
            np.multiply(minus_x, scale, out=out[group, :, 0])

    def _within_row(self, factor: _AttitudeFactor) -> np.ndarray:
        """Return real over imaginary parts of c_n exp(i nu_n k step), k within a row."""
        amplitudes = modes(factor.real, factor.imag)
        phase = self.attitudes.phase_fixed
        waves = np.array(list(amplitudes.values()))[:, None] * _waves(
            amplitudes, _fractions(0, factor.fixed.rate * self.step_ns, GRID_BLOCK),
            _fractions(0, phase.rate * self.step_ns, GRID_BLOCK))
        return np.concatenate((waves.real, waves.imag))

    def _row_starts(self, factor: _AttitudeFactor, start_ns: int, rows: int
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Return exp(i nu_n T) so that products with `_within_row` are real, imaginary parts."""
        row_ns = self.step_ns * GRID_BLOCK
        rotation, phase = (_fractions(fixed.at(start_ns), fixed.rate * row_ns, rows)
                           for fixed in (factor.fixed, self.attitudes.phase_fixed))
        waves = _waves(modes(factor.real, factor.imag), rotation, phase).T
        return (np.concatenate((waves.real, -waves.imag), axis=1),
                np.concatenate((waves.imag, waves.real), axis=1))


def _waves(numbers: Iterable[int], rotation: tuple[np.ndarray, np.ndarray],
           phase: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return exp 2 pi i (rotation + n phase), a row for every mode n."""
    n = np.array(list(numbers))[:, None]
    turns = rotation[0] + n * phase[0]        # fractions of 48 bits: exact
    turns -= np.rint(turns)
    turns += rotation[1] + n * phase[1]
    return np.exp(2.0j * np.pi * turns)


def _fractions(start: int, step: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return start + k step, k < count, less whole turns, as 48-bit fractions and what is left."""
    start, step = ((x % FIXED_ONE) >> (FIXED_BITS - 2 * LIMB) for x in (start, step))
    mask = (1 << LIMB) - 1
    k = np.arange(count, dtype=np.uint64)
    low = k * np.uint64(step & mask) + np.uint64(start & mask)
    high = (k * np.uint64(step >> LIMB) + np.uint64(start >> LIMB)) + (low >> np.uint64(LIMB))
    return ((high & np.uint64(mask)).astype(np.float64) * 2.0 ** -LIMB,
            (low & np.uint64(mask)).astype(np.float64) * 2.0 ** -(2 * LIMB))
