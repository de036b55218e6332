# SPDX-License-Identifier: Apache-2.0
"""
The exact motion for arrays of times.

Two ways lead to a quaternion.  `ExactStates` evaluates the formulas of `exact.nutation_at`, even
and odd quarter periods apart, for every column.  For quaternions alone, and away from the
separatrix (m1 >= 1e-5), `_FullCircle` uses the theta series of the even quarter periods all
round, so that a block of times goes through without a case distinction; and as such a series
is a sum of a few sinusoids, a block of a uniform grid is a product of two small matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal, localcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from spinning_top_sim.solvers.exact import (
    FIXED_BITS,
    FIXED_ONE,
    QUARTER_PERIOD_ANGLE,
    FixedRate,
    Functions,
    nutation_at,
    transverse_rates,
)
from spinning_top_sim.solvers.long_decimals import double_double, pi
from spinning_top_sim.solvers.theta_series import Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion

if TYPE_CHECKING:
    from spinning_top_sim.solvers.exact import ExactSolution

ARRAY = Functions(np.sin, np.sinh, np.sqrt, np.hypot, np.arctan2)
CHUNK = 4096                # times in a block: its temporaries stay in the cache
TWO_PI = 2.0 * math.pi
NEGLIGIBLE = 1e-18          # beside the largest coefficient

TABLE_STEPS = 2048          # of a turn; within a step five powers reach 1e-17
STEP_ANGLE = TWO_PI / TABLE_STEPS
SHORT_TURNS = 2.0 ** 24     # so many turns are counted right with a rate split in two

GRID_BLOCK = 512            # states in a row of the grid's product
GRID_ROWS = 16              # rows that are worked on together
MOST_ROWS = 1 << 15         # whose count times a limb fits 64 bits
LIMB = 48                   # bits: two limbs are the fraction of a turn


def _blocks(n: int) -> Iterator[slice]:
    for first in range(0, n, CHUNK):
        yield slice(first, min(first + CHUNK, n))


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

    def whole_and_part(self, t: np.ndarray, t_rest: np.ndarray | None
                       ) -> tuple[np.ndarray, np.ndarray]:
        high, rest = self.product(t, t_rest)
        whole = np.rint(high)
        return whole, (high - whole) + rest


class ExactStates:
    """
    States at many times; every column is an array (n,) or (n, k) computed when first asked for.

    theta [rad], continued through poles; theta_dot [rad/s]; phi, psi [rad], unwrapped;
    quaternion (n, 4) x, y, z, w, body to world; angular_velocity (n, 3), body frame [rad/s].
    """

    def __init__(self, evaluator: ArrayEvaluator, t: np.ndarray, t_rest: np.ndarray | None = None):
        self._evaluator, self._t, self._t_rest = evaluator, t, t_rest

    @cached_property
    def quaternion(self) -> np.ndarray:
        if self._t_rest is None and self._evaluator.full_circle:
            return self._evaluator.full_circle.quaternion(self._t)
        return self._evaluator.general_quaternion(self._nutation, self._t, self._t_rest)

    @cached_property
    def theta(self) -> np.ndarray:
        return self._evaluator.theta(self._nutation)

    @property
    def theta_dot(self) -> np.ndarray:
        return self._nutation[4]

    @cached_property
    def phi(self) -> np.ndarray:
        return self._evaluator.phi(self._nutation, self._t, self._t_rest)

    @cached_property
    def psi(self) -> np.ndarray:
        return self._evaluator.psi(self._nutation, self._t, self._t_rest)

    @cached_property
    def angular_velocity(self) -> np.ndarray:
        return self._evaluator.angular_velocity(self._nutation, self._t, self._t_rest)

    @cached_property
    def _nutation(self) -> np.ndarray:
        return self._evaluator.nutation(self._t, self._t_rest)


class ArrayEvaluator:
    """What `ExactSolution` needs to serve arrays; one per solution."""

    def __init__(self, solution: ExactSolution):
        self.solution = solution
        motion = solution.theta_motion
        with localcontext() as context:
            context.prec = motion.digits
            two_pi = 2 * pi()
            alpha, beta = motion.alpha, motion.beta
            self.quarters = Rate(motion.quarter_rate)
            self.offset0 = double_double(motion.offset0)
            self.precession, self.spin = (
                Rate(motion.mean_precession_rate), Rate(motion.mean_spin_rate))
            self.alpha_turns, self.beta_turns, self.spin_turns = (
                Rate(x / two_pi) for x in (alpha.rate, beta.rate, motion.mean_spin_rate))
            self.alpha_phase, self.beta_phase, self.spin_phase = (
                float(x * two_pi) for x in (alpha.phase_turns, beta.phase_turns,
                                            alpha.phase_turns - beta.phase_turns))
            self.full_circle = _FullCircle(motion) if alpha.full_circle else None

    # ------------------------------------------------------------------------- what is offered

    def states(self, t: Any) -> ExactStates:
        return ExactStates(self, self._checked(t))

    def states_at_ns(self, ns: Any) -> ExactStates:
        ns = np.asarray(ns)
        if ns.ndim != 1 or ns.dtype.kind not in 'iu':
            raise ValueError(
                f'ns has shape {ns.shape} and type {ns.dtype}: must be (n,) whole nanoseconds')
        if ns.size:
            for extreme in (int(ns.min()), int(ns.max())):
                self._check_ns(extreme)
        return ExactStates(self, *_seconds(ns.astype(np.int64)))

    def quaternion(self, t: Any) -> np.ndarray:
        return self.states(t).quaternion

    def quaternion_grid(self, start_ns: int, step_ns: int, count: int) -> np.ndarray:
        if count < 0:
            raise ValueError(f'count = {count!r}: must be >= 0')
        for extreme in (start_ns, start_ns + step_ns * max(0, count - 1)):
            self._check_ns(extreme)
        if self.full_circle:
            return self.full_circle.quaternion_grid(start_ns, step_ns, count)
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
        alpha, beta, *_, turns = nutation
        half_theta = np.arctan2(beta, alpha)
        if self.solution.turning:
            half_theta += TWO_PI * np.rint(turns)
        return 2.0 * half_theta

    def phi(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        _, _, alpha_argument, beta_argument, *_ = nutation
        return self._unwrapped(self.precession, self.solution.phi_phase, t, t_rest,
                               alpha_argument + beta_argument)

    def psi(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
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

    def general_quaternion(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None
                           ) -> np.ndarray:
        out = np.empty((len(t), 4))
        for block in _blocks(len(t)):
            alpha, beta, alpha_argument, beta_argument, *_ = nutation[:, block]
            times = t[block], _part_of(t_rest, block)
            scale = 1.0 / np.sqrt(alpha * alpha + beta * beta)
            angle = TWO_PI * self.alpha_turns.whole_and_part(*times)[1] + (
                self.alpha_phase + alpha_argument)
            cos_half = scale * alpha
            out[block, 3], out[block, 2] = cos_half * np.cos(angle), cos_half * np.sin(angle)
            angle = TWO_PI * self.beta_turns.whole_and_part(*times)[1] + (
                self.beta_phase + beta_argument)
            sin_half = scale * beta
            out[block, 1], out[block, 0] = sin_half * np.cos(angle), -sin_half * np.sin(angle)
        return out

    def angular_velocity(self, nutation: np.ndarray, t: np.ndarray, t_rest: np.ndarray | None
                         ) -> np.ndarray:
        out = np.empty((len(t), 3))
        for block in _blocks(len(t)):
            alpha, beta, alpha_argument, beta_argument, theta_dot, _ = nutation[:, block]
            _, part = self.spin_turns.whole_and_part(t[block], _part_of(t_rest, block))
            psi = TWO_PI * part + (self.spin_phase + (alpha_argument - beta_argument))
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
                raise self.solution._too_late(latest)
        return t

    def _check_ns(self, ns: int) -> None:
        if abs(ns) > self.solution.ns_limit:
            raise self.solution._too_late(ns * 1e-9)


def _part_of(t_rest: np.ndarray | None, block: slice) -> np.ndarray | None:
    return None if t_rest is None else t_rest[block]


def _seconds(ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return int64 nanoseconds in seconds, as nearest doubles and rests."""
    whole, count = (x.astype(np.float64) for x in np.divmod(ns, 10 ** 9))
    part, part_rest = Rate(Decimal('1e-9')).product(count, None)
    total = whole + part                            # Dekker's sum: whole is 0 or the larger
    return total, (part - (total - whole)) + part_rest


# -------------------------------------------------------------------------- one form all round


def _sine_table() -> tuple[np.ndarray, np.ndarray]:
    """Sines and cosines of whole steps, from angles of at most an eighth of a turn."""
    step = np.arange(TABLE_STEPS)
    quarter = np.rint(step / (TABLE_STEPS // 4)).astype(int)
    angle = STEP_ANGLE * (step - quarter * (TABLE_STEPS // 4))
    s, c = np.sin(angle), np.cos(angle)
    return np.choose(quarter % 4, (s, c, -s, -c)), np.choose(quarter % 4, (c, -s, -c, s))


SINES, COSINES = _sine_table()


class _Block:
    """Named buffers for a block of n times; everything below is computed in place in them."""

    def __init__(self, n: int):
        (self.t1, self.t2, self.rest, self.step, self.work, self.square,
         self.table_sine, self.table_cosine,
         self.sin_v, self.cos_v, self.sin_alpha, self.cos_alpha, self.sin_beta, self.cos_beta,
         self.alpha_real, self.alpha_imag, self.beta_real, self.beta_imag,
         self.scale) = np.empty((19, n))
        self.index = np.empty(n, np.int64)
        self.latest = 0.0       # the largest |t| of the call

    def load(self, t: np.ndarray) -> None:
        """Take the times and split them as `_halves` does."""
        self.t = t
        np.multiply(t, 134217729.0, out=self.work)
        np.subtract(self.work, t, out=self.rest)
        np.subtract(self.work, self.rest, out=self.t1)
        np.subtract(t, self.t1, out=self.t2)


class _Rotor:
    """The angle 2 pi (rate t + start), rate and start in turns: its sine and cosine."""

    def __init__(self, rate: Decimal, start: Decimal):
        self.fixed = FixedRate.of(rate, start)
        self.turns = Rate(rate)
        in_steps = rate * TABLE_STEPS
        self.rate = float(in_steps)
        self.rate1, _ = _halves(self.rate)
        self.rate2 = float(in_steps - Decimal(self.rate1))
        self.start = float((start - start.to_integral_value()) * TABLE_STEPS)

    def sin_cos(self, b: _Block, sine: np.ndarray, cosine: np.ndarray) -> None:
        """Look up the nearest step of the table, and turn on by the rest of the angle."""
        self._count_steps(b)
        np.copyto(b.index, b.step, casting='unsafe')
        np.bitwise_and(b.index, TABLE_STEPS - 1, out=b.index)
        np.take(SINES, b.index, out=b.table_sine, mode='clip')
        np.take(COSINES, b.index, out=b.table_cosine, mode='clip')
        # Sine of the rest, and cosine less 1, by their power series.
        np.multiply(b.rest, b.rest, out=b.square)
        np.multiply(b.square, STEP_ANGLE ** 5 / 120.0, out=b.work)
        np.subtract(b.work, STEP_ANGLE ** 3 / 6.0, out=b.work)
        np.multiply(b.work, b.square, out=b.work)
        np.add(b.work, STEP_ANGLE, out=b.work)
        np.multiply(b.rest, b.work, out=b.rest)
        np.multiply(b.square, STEP_ANGLE ** 4 / 24.0, out=b.work)
        np.subtract(b.work, STEP_ANGLE ** 2 / 2.0, out=b.work)
        np.multiply(b.work, b.square, out=b.square)
        # The sum of both angles; the large term is added last.
        np.multiply(b.table_sine, b.square, out=sine)
        np.multiply(b.table_cosine, b.rest, out=b.work)
        np.add(sine, b.work, out=sine)
        np.add(sine, b.table_sine, out=sine)
        np.multiply(b.table_cosine, b.square, out=cosine)
        np.multiply(b.table_sine, b.rest, out=b.work)
        np.subtract(cosine, b.work, out=cosine)
        np.add(cosine, b.table_cosine, out=cosine)

    def _count_steps(self, b: _Block) -> None:
        """Set b.step to the nearest whole number of steps, b.rest to what remains."""
        if b.latest * abs(self.turns.high) > SHORT_TURNS:
            _, part = self.turns.whole_and_part(b.t, None)
            np.multiply(part, TABLE_STEPS, out=b.rest)
            np.add(b.rest, self.start, out=b.rest)
            np.rint(b.rest, out=b.step)
            np.subtract(b.rest, b.step, out=b.rest)
            return
        # t1 rate1 is exact, and so is its difference from a near whole number.
        np.multiply(b.t1, self.rate2, out=b.work)
        np.multiply(b.t2, self.rate, out=b.rest)
        np.add(b.work, b.rest, out=b.work)
        np.add(b.work, self.start, out=b.work)
        np.multiply(b.t1, self.rate1, out=b.rest)
        np.add(b.rest, b.work, out=b.step)
        np.rint(b.step, out=b.step)
        np.subtract(b.rest, b.step, out=b.rest)
        np.add(b.rest, b.work, out=b.rest)


class _FullCircleFactor:
    """Alpha or beta: a series for R and one for J (none if it is real), and the rotation."""

    def __init__(self, factor: Factor, v_rate: Decimal, v_start: Decimal):
        branch = factor.full_circle
        assert branch is not None
        # exp i(drift y) with y = v and drift = -s in the real form.
        self.rotor = _Rotor(factor.rate / (2 * pi()) - factor.sense * v_rate,
                            factor.phase_turns - factor.sense * v_start)
        self.real = branch.real.scaled(Decimal(factor.sign))
        self.imag = branch.imag.scaled(Decimal(factor.sense)) if branch.imag else None
        self.real_polynomial = _Polynomial(self.real)
        self.imag_polynomial = _Polynomial(self.imag) if self.imag else None

    def modes(self) -> dict[int, complex]:
        """Return c_n with R + i s J = sum of c_n exp(i n v)."""
        modes: dict[int, complex] = {}
        for series, unit in ((self.real, 1.0), (self.imag, 1.0j)):
            if series is None:
                continue
            is_sine = series.kind.startswith('sin')
            for k, weight in enumerate(series.weights):
                n = 2 * k + series.kind.endswith('odd')
                half = 0.5 * float(weight) * unit * (-1.0j if is_sine else 1.0)
                modes[n] = modes.get(n, 0.0) + half
                modes[-n] = modes.get(-n, 0.0) + (-half if is_sine else half)
        largest = max(abs(c) for c in modes.values())
        return {n: c for n, c in modes.items() if abs(c) > NEGLIGIBLE * largest}


class _Polynomial:
    """A theta series as prefactor * polynomial in sin^2 v."""

    def __init__(self, series: Series):
        self.prefactor = series.prefactor
        exact = series.polynomial()
        least = Decimal(NEGLIGIBLE) * max(abs(x) for x in exact)
        while len(exact) > 1 and abs(exact[-1]) < least:
            exact.pop()
        self.coefficients = [float(x) for x in exact]

    def evaluate(self, b: _Block, out: np.ndarray) -> None:
        """From b.square = sin^2 v, b.sin_v and b.cos_v."""
        *rest, last = self.coefficients
        out[...] = last
        for coefficient in reversed(rest):
            np.multiply(out, b.square, out=out)
            np.add(out, coefficient, out=out)
        prefactor = (None, b.cos_v, b.sin_v, None)[self.prefactor]
        if prefactor is not None:
            np.multiply(out, prefactor, out=out)


class _FullCircle:
    """
    Quaternions from the real form of the theta series, at any phase v = (pi/2) Z.

    alpha = (R + i s J)(v) / D(v) exp i(rotation), with D from |alpha|^2 + |beta|^2 = 1.
    """

    def __init__(self, motion: ThetaMotion):
        v_rate, v_start = motion.quarter_rate / 4, (motion.quarter0 + motion.offset0) / 4
        self.phase = _Rotor(v_rate, v_start)
        self.alpha = _FullCircleFactor(motion.alpha, v_rate, v_start)
        self.beta = _FullCircleFactor(motion.beta, v_rate, v_start)
        self._grid: _Grid | None = None

    def quaternion(self, t: np.ndarray) -> np.ndarray:
        out = np.empty((len(t), 4))
        block = _Block(0)
        for part in _blocks(len(t)):
            if part.stop - part.start != len(block.t1):
                block = _Block(part.stop - part.start)
                block.latest = max(float(t.max()), -float(t.min()))
            self._quaternion_block(block, t[part], out[part])
        return out

    def _quaternion_block(self, b: _Block, t: np.ndarray, out: np.ndarray) -> None:
        b.load(t)
        self.phase.sin_cos(b, b.sin_v, b.cos_v)
        self.alpha.rotor.sin_cos(b, b.sin_alpha, b.cos_alpha)
        self.beta.rotor.sin_cos(b, b.sin_beta, b.cos_beta)
        np.multiply(b.sin_v, b.sin_v, out=b.square)
        b.scale[...] = 0.0
        for factor, real, imag in ((self.alpha, b.alpha_real, b.alpha_imag),
                                   (self.beta, b.beta_real, b.beta_imag)):
            factor.real_polynomial.evaluate(b, real)
            np.multiply(real, real, out=b.work)
            np.add(b.scale, b.work, out=b.scale)
            if factor.imag_polynomial:
                factor.imag_polynomial.evaluate(b, imag)
                np.multiply(imag, imag, out=b.work)
                np.add(b.scale, b.work, out=b.scale)
        np.sqrt(b.scale, out=b.scale)
        np.divide(1.0, b.scale, out=b.scale)
        _rotate(b, self.alpha, b.alpha_real, b.alpha_imag, b.sin_alpha, b.cos_alpha)
        out[:, 3], out[:, 2] = b.step, b.rest
        _rotate(b, self.beta, b.beta_real, b.beta_imag, b.sin_beta, b.cos_beta)
        out[:, 1] = b.step
        np.negative(b.rest, out=out[:, 0])

    def quaternion_grid(self, start_ns: int, step_ns: int, count: int) -> np.ndarray:
        if self._grid is None or self._grid.step_ns != step_ns:
            self._grid = _Grid(self, step_ns)
        return self._grid.quaternion(start_ns, count)


def _rotate(b: _Block, factor: _FullCircleFactor, real: np.ndarray, imag: np.ndarray,
            sine: np.ndarray, cosine: np.ndarray) -> None:
    """Leave (real + i imag) exp(i rotation) * scale in b.step + i b.rest."""
    np.multiply(sine, b.scale, out=sine)
    np.multiply(cosine, b.scale, out=cosine)
    np.multiply(real, cosine, out=b.step)
    np.multiply(real, sine, out=b.rest)
    if factor.imag_polynomial:
        np.multiply(imag, sine, out=b.work)
        np.subtract(b.step, b.work, out=b.step)
        np.multiply(imag, cosine, out=b.work)
        np.add(b.rest, b.work, out=b.rest)


# ------------------------------------------------------------------------------ uniform grids


class _Grid:
    """
    The full circle on times start + k step: alpha D = sum over modes of c_n exp i(nu_n t).

    As exp i nu (T + s) = exp(i nu T) exp(i nu s), a block of states is the product of a matrix
    (starts of rows x modes) and a matrix (modes x times within a row), which is kept.  Phases are
    products of integers, so that no error grows along the grid.
    """

    def __init__(self, circle: _FullCircle, step_ns: int):
        self.circle, self.step_ns = circle, step_ns
        self.offsets = tuple(self._within_row(factor) for factor in (circle.alpha, circle.beta))

    def quaternion(self, start_ns: int, count: int) -> np.ndarray:
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
            for factor in (self.circle.alpha, self.circle.beta))
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

    def _within_row(self, factor: _FullCircleFactor) -> np.ndarray:
        """Return real over imaginary parts of c_n exp(i nu_n k step), k within a row."""
        modes = factor.modes()
        waves = self._waves(factor, modes, 0, self.step_ns, GRID_BLOCK, with_start=False)
        waves *= np.array(list(modes.values()))[:, None]
        return np.concatenate((waves.real, waves.imag))

    def _row_starts(self, factor: _FullCircleFactor, start_ns: int, rows: int
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Return exp(i nu_n T) so that products with `_within_row` are real, imaginary parts."""
        waves = self._waves(factor, factor.modes(), start_ns, self.step_ns * GRID_BLOCK, rows,
                            with_start=True).T
        return (np.concatenate((waves.real, -waves.imag), axis=1),
                np.concatenate((waves.imag, waves.real), axis=1))

    def _waves(self, factor: _FullCircleFactor, modes: dict[int, complex], start_ns: int,
               step_ns: int, count: int, with_start: bool) -> np.ndarray:
        """Return exp 2 pi i (rotation + n v), a row for every mode n."""
        (turn_high, turn_low), (v_high, v_low) = (
            _fractions(rotor.fixed, start_ns, step_ns, count, with_start)
            for rotor in (factor.rotor, self.circle.phase))
        numbers = np.array(list(modes))[:, None]
        turns = turn_high + numbers * v_high        # 48-bit fractions: exact
        turns -= np.rint(turns)
        turns += turn_low + numbers * v_low
        return np.exp(2.0j * np.pi * turns)


def _fractions(fixed: FixedRate, start_ns: int, step_ns: int, count: int, with_start: bool
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return the fractions of rate * (start + k step), k < count, as exact and small parts."""
    start = fixed.rate * start_ns + (fixed.start if with_start else 0)
    start, step = ((x % FIXED_ONE) >> (FIXED_BITS - 2 * LIMB) for x in (
        start, fixed.rate * step_ns))
    mask = np.uint64((1 << LIMB) - 1)
    k = np.arange(count, dtype=np.uint64)

    def limb(number: int, shift: int) -> np.uint64:
        return np.uint64(number >> shift & int(mask))
    low = k * limb(step, 0) + limb(start, 0)
    high = k * limb(step, LIMB) + limb(start, LIMB) + (low >> np.uint64(LIMB))
    return ((high & mask).astype(np.float64) * 2.0 ** -LIMB,
            (low & mask).astype(np.float64) * 2.0 ** -(2 * LIMB))
