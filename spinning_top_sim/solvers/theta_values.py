# SPDX-License-Identifier: Apache-2.0
"""
The exact motion at many times, in doubles; `theta_setup` explains the symbols.

Three phases are products of a rate and the time, whose error does not grow with time: that of the
nutation in quarter periods, and those of the rotations exp i(r t + c) of alpha and beta in half
turns.  Each is reduced to the nearest integer.  What is left is an angle of at most pi/4 or pi/2
and keeps its relative precision: a top races past a pole that it misses by little.

All arithmetic is elementwise, so that a value does not depend on the other values in its block.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from operator import sub

import numpy as np
from gmpy2 import const_pi, mpfr, rint
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.solvers.multiprecision import double_double, precision
from spinning_top_sim.solvers.theta_series import SIN_ODD
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion
from spinning_top_sim.solvers.times import UNITS, Times, halves, products

Matrix = NDArray[np.float64]
QUARTER = 0.5 * math.pi         # the angle of a quarter period [rad]
SIGNS = np.array((1.0, -1.0))   # of an even and of an odd number of half turns
HALF_ANGLES = 0.5 * math.pi * np.array([[0.5], [1.0], [1.0]])       # of the three phases' units
# Smaller amplitudes leave no room for their squares in doubles, larger numbers none for halves.
LEAST_AMPLITUDE, LARGEST_NUMBER = 1e-145, 1e290


def _keep_freed_memory() -> None:
    """
    Let glibc keep freed memory for large arrays, which doubles the speed of large blocks.

    It gives memory back at once, and clears the pages again at the next use, until it has freed a
    block of this size [mallopt(3): M_MMAP_THRESHOLD].
    """
    np.empty(2 ** 22, np.uint8)


_keep_freed_memory()


class MotionConstants:
    """
    The constants of one motion in doubles.

    Raises ValueError if doubles cannot hold an amplitude or a rate.

    rates : of the three phases [1/s], in multiprecision
    start_wholes, start_offsets : at t = 0 a phase is their sum; the latter are two doubles each
    drifts : kappa/2 of alpha and beta
    stretch : K/K' times a quarter turn, 0 in the real form
    prefactors, polynomials : at even and at odd N, of the rows R of alpha and beta, s J of alpha
        and beta; the coefficients of 1, xi, xi^2 ...
    senses : s of alpha and beta
    u_dot, u_dot_polynomial : of u'
    precession0, precession_swing : of (Lz - L3 u)/lambda1
    """

    def __init__(self, motion: ThetaMotion) -> None:
        factors = motion.alpha, motion.beta
        self.rates = [motion.quarter_rate, *(x.rate / const_pi() for x in factors)]
        turns = [2 * x.phase_turns for x in factors]
        self.start_wholes = [motion.start_whole, *map(int, map(rint, turns))]
        self.start_offsets = [*map(double_double, (
            motion.start_offset, *map(sub, turns, self.start_wholes[1:])))]
        self.drifts = [0.5 * float(factor.drift) for factor in factors]
        self.stretch = QUARTER * float(motion.stretch) if motion.stretch else 0.0
        rows = [[one[part] for one in factor.parts] for part in (0, 1) for factor in factors]
        self.prefactors: list[tuple[int, ...]] = [
            (even.prefactor, odd.prefactor) for even, odd in rows]
        self.polynomials = [[
            [float(scale * x) for x in one.polynomial(motion.size)]
            for one, scale in zip(row, factor.scales, strict=True)]
            for row, factor in zip(rows, 2 * factors, strict=True)]
        self.senses = [factor.sense for factor in factors]
        _check_amplitude('alpha', motion.alpha)
        _check_amplitude('beta', motion.beta)
        self.u_dot = [in_range("cos(theta)'", x) for x in motion.u_dot]
        self.u_dot_polynomial = [*map(float, motion.u_dot_series.polynomial(motion.size))]
        self.precession0, self.precession_swing = ([*map(float, pair)] for pair in (
            motion.precession0, motion.precession_swing))

    @property
    def chains(self) -> bool:
        """Whether the motion can be part of a chain: it nutates, and passes no pole."""
        return any(self.u_dot) and all(self.senses)


def _check_amplitude(name: str, factor: Factor) -> None:
    for (real, _), scale in zip(factor.parts, factor.scales, strict=True):
        size = abs(scale) * max(map(abs, real.weights))
        if 0 < size < LEAST_AMPLITUDE:
            raise ValueError(
                f'the amplitude of {name} is {size:.3e}: the start is too close to a pole '
                f'or to rest there; must be 0 or at least {LEAST_AMPLITUDE}')


class ConstantArrays:
    """
    The constants of a motion in arrays, or those of several motions, each for so many times.

    Columns are (k, 1) or (k, n).  `coefficients` (k, 4, 2 motions), highest power first, `u_dot`,
    `precession0` and `precession_swing` have those of all motions at even and at odd N.

    stretch : None if there is no imaginary form
    prefactors : of the rows of `MotionConstants`: at even N, at odd N; where the motions of a
        chain differ, those of the first motion, then of the second, ...
    on_line : the numbers, 0 for alpha and 1 for beta, of those that have s = 0
    zeros : by the same number, of those that pass their pole exactly: whether R = 0 at y = 0 is
        at even N (0) or at odd N (1)
    first : of a chain, the place of each time's constants at even N in the last axis, (n,)
    """

    def __init__(self, motions: Sequence[MotionConstants],
                 counts: Sequence[int] | None = None) -> None:
        self._motions, self._counts, present = motions, counts, motions[0]
        self._rates: dict[str, tuple[Matrix, Matrix, Matrix, Matrix]] = {}
        self.start_wholes = self.columns([one.start_wholes for one in motions])
        self.start_offsets, self.start_offset_rests = map(self.columns, np.array(
            [one.start_offsets for one in motions]).transpose(2, 0, 1))
        self.drifts = self.columns([one.drifts for one in motions])
        (stretch,) = self.columns([(one.stretch,) for one in motions])
        self.stretch = stretch if np.any(stretch) else None
        self.prefactors = present.prefactors
        if any(one.prefactors != present.prefactors for one in motions):
            self.prefactors = [sum(rows, ()) for rows in zip(
                *(one.prefactors for one in motions), strict=True)]
        self.coefficients = _side_by_side(
            [*chain.from_iterable(chain.from_iterable(zip(*(
                one.polynomials for one in motions), strict=True)))]
            ).reshape(-1, 4, 2 * len(motions))
        self.on_line = [k for k, sense in enumerate(present.senses) if not sense]
        self.zeros = {k: pair.index(SIN_ODD) for k, pair in enumerate(present.prefactors[:2])
                      if SIN_ODD in pair}
        self.u_dot, self.precession0, self.precession_swing = np.array([
            (one.u_dot, one.precession0, one.precession_swing) for one in motions]
            ).transpose(1, 0, 2).reshape(3, -1)
        self.u_dot_coefficients = self.columns(
            _side_by_side([one.u_dot_polynomial for one in motions]).T)
        self.first = None if counts is None else np.repeat(
            np.arange(0, 2 * len(motions), 2), counts)

    def columns(self, rows: ArrayLike) -> Matrix:
        """Return what is given by motions, by columns for each time."""
        columns: Matrix = np.array(rows).T
        return columns if self._counts is None else np.repeat(columns, self._counts, axis=1)

    def turned(self, times: Times) -> tuple[Matrix, Matrix]:
        """Return what the three phases have grown by (3, n), as two doubles each."""
        if times.unit not in self._rates:
            with precision():
                rate, rest = map(self.columns, np.array([
                    [double_double(x / UNITS[times.unit]) for x in one.rates]
                    for one in self._motions]).transpose(2, 0, 1))
            self._rates[times.unit] = rate, *halves(rate), rest
        return products(self._rates[times.unit], times)

    @property
    def _middles(self) -> Matrix:
        """The rows where y = 0, at N = 0 and N = 1, (4, 2)."""
        middles: Matrix = np.where(
            np.array(self.prefactors) < SIN_ODD, self.coefficients[-1], 0.0)
        return middles

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the greatest theta in [0, pi] [rad]."""
        alpha, beta, alpha_imag, beta_imag = self._middles
        low, high = sorted((2.0 * np.arctan2(np.hypot(beta, beta_imag),
                                             np.hypot(alpha, alpha_imag))).tolist())
        return low, high

    @cached_property
    def planar_rotation(self) -> tuple[float, float] | None:
        """(i, j) if both poles are passed: theta/2 is within a quarter turn of pi/2 (i + j N)."""
        if len(self.zeros) < 2:
            return None
        alpha, beta, *_ = self._middles
        first, second = (np.arctan2(beta, alpha) / QUARTER).tolist()
        slope = (second - first + 2.0) % 4.0 - 2.0
        start_whole = int(self.start_wholes[0, 0])
        start = (first + slope * start_whole + 1.0) % 4.0 - 1.0
        return start - slope * start_whole, slope


class ThetaValues:
    """The motion at n times, in columns that are computed when they are first asked for."""

    def __init__(self, arrays: ConstantArrays, times: Times) -> None:
        self._arrays = arrays
        self._turned, self._turned_rest = arrays.turned(times)
        self._whole, part = _reduced(self._turned, self._turned_rest, arrays)
        self._offset = part[0].copy()
        part[1:] += arrays.drifts * self._offset
        # Cosine and sine by the tangent of half the angle, which is at most 1.
        part *= HALF_ANGLES
        tangent = np.tan(part, out=part)
        square = tangent * tangent
        self._cos = 1.0 - square
        square += 1.0
        self._cos /= square
        tangent += tangent
        self._sin = np.divide(tangent, square, out=tangent)
        self._evaluate()

    def _evaluate(self) -> None:
        """Compute R and s J of alpha and beta, (2, n) each."""
        arrays, quarters = self._arrays, self._whole[0]
        sin = self._sin[0]
        if arrays.stretch is None:
            xi = sin * sin
        else:
            is_real = np.equal(arrays.stretch, 0.0)     # of some motions of a chain
            sinh = np.sinh(arrays.stretch * self._offset)
            sin = np.where(is_real, sin, sinh) if np.any(is_real) else sinh
            xi = np.where(is_real, 1.0, -1.0) * sin * sin
        cos = np.sqrt(1.0 - xi)
        self._parity, self._xi = quarters & 1, xi
        odd = self._parity.astype(bool)
        self._place = self._parity if arrays.first is None else self._parity + arrays.first
        rows = _horner(arrays.coefficients.take(self._place, axis=2), xi)
        for k in arrays.zeros:          # the sign is (-1)^floor(N/2)
            rows[k] *= 1 - (quarters & 2)
        self._without_zero = {k: rows[k].copy() for k in arrays.zeros}
        bases = 1.0, cos, sin, sin * cos
        for k, (one, other, *more) in enumerate(arrays.prefactors):
            if more:
                rows[k] *= np.choose(np.take(arrays.prefactors[k], self._place), bases)
            else:
                rows[k] *= bases[one] if one == other else np.where(odd, bases[other], bases[one])
        self._real, self._imag = rows[:2], rows[2:]
        self._sin_cos, self._cos_y, self._sin_y = bases[3], cos, sin

    @cached_property
    def moduli(self) -> Matrix:
        """|alpha| D and |beta| D, (2, n); signed, not absolute, where s = 0."""
        # The squares may be too small for a double.
        moduli: Matrix = np.hypot(self._real, self._imag)
        for k in self._arrays.on_line:
            moduli[k] = self._real[k]
        return moduli

    @cached_property
    def half_theta(self) -> Matrix:
        alpha, beta = self.moduli
        scale: Column = 1.0 / np.sqrt(alpha * alpha + beta * beta)
        return self.moduli * scale

    @cached_property
    def _rotations(self) -> tuple[Matrix, Matrix]:
        """Cosines and sines of r t + c + kappa y of alpha and beta, (2, n)."""
        sign = SIGNS.take(self._whole[1:] & 1)
        return sign * self._cos[1:], sign * self._sin[1:]

    @cached_property
    def _alpha_beta(self) -> tuple[Matrix, Matrix]:
        """Real and imaginary parts of alpha D and beta D, (2, n)."""
        (cos, sin), real, imag = self._rotations, self._real, self._imag
        return real * cos - imag * sin, real * sin + imag * cos

    @cached_property
    def quaternion(self) -> Matrix:
        real, imag = self._alpha_beta
        squares = self._real * self._real + self._imag * self._imag
        scale = 1.0 / np.sqrt(squares[0] + squares[1])
        found = np.empty((4, len(scale)))
        np.multiply(real[::-1], scale, out=found[1::2])
        np.multiply(imag[::-1], scale, out=found[::2])
        np.negative(found[0], out=found[0])
        return found

    @cached_property
    def angles(self) -> Matrix:
        """
        phi, theta and psi, continued through the poles [rad], (5, n).

        phi and psi are given in two parts each, as what grows with time and the rest, less their
        values at t = 0.
        """
        (_, alpha, beta), (_, alpha_rest, beta_rest) = self._turned, self._turned_rest
        arguments = np.arctan2(self._imag, self._real)
        arguments += (math.pi * self._arrays.drifts) * self._offset
        arguments[self._arrays.on_line] = 0.0
        half = np.arctan2(self.moduli[1], self.moduli[0])
        if self._arrays.planar_rotation:
            i, j = self._arrays.planar_rotation
            half += math.tau * np.rint((QUARTER * (i + j * self._whole[0]) - half) / math.tau)
        found = np.empty((5, len(half)))
        found[0] = math.pi * ((alpha + beta) + (alpha_rest + beta_rest))
        found[1] = arguments[0] + arguments[1]
        found[2] = 2.0 * half
        found[3] = math.pi * ((alpha - beta) + (alpha_rest - beta_rest))
        found[4] = arguments[0] - arguments[1]
        return found

    @cached_property
    def theta_dot(self) -> Column:
        # theta' = -u'/sin(theta), and u' is a theta series of 2y.
        arrays, xi, (alpha, beta) = self._arrays, self._xi, self.moduli
        if not arrays.u_dot.any():
            return np.zeros(len(xi))        # at rest, perhaps at a pole
        size, prefactor, without = alpha * alpha + beta * beta, self._sin_cos, [alpha, beta]
        for k, parity in arrays.zeros.items():    # there sin y is divided out
            here = self._parity == parity
            prefactor = np.where(here, self._cos_y, prefactor)
            without[k] = np.where(here, self._without_zero[k], without[k])
        series = prefactor * _horner(arrays.u_dot_coefficients, 4.0 * xi * (1.0 - xi))
        # In this order nothing overflows on the separatrix, where all grow like cosh x.
        theta_dot: Column = -arrays.u_dot.take(self._place) * (series / size) / (
            without[0] * without[1])
        return theta_dot

    @cached_property
    def across_terms(self) -> Matrix:
        """The two terms of phi' sin(theta) [rad/s] if no pole is passed exactly, (2, n)."""
        arrays, (alpha, beta) = self._arrays, self.moduli
        series = self._sin_y * _horner(arrays.u_dot_coefficients, self._xi)
        half: Column = 0.5 / (alpha * beta)
        return np.stack((
            arrays.precession0.take(self._place) * ((alpha * alpha + beta * beta) * half),
            arrays.precession_swing.take(self._place) * (series * series * half)))

    @cached_property
    def rates(self) -> Matrix:
        """The rate of theta [rad/s], and the cosine and sine of psi, (3, n)."""
        # psi is the argument of alpha less that of beta.
        real, imag = self._alpha_beta
        moduli = self.moduli.copy()
        moduli[self._arrays.on_line] = 1.0  # it may be 0, and its sign is in theta
        cos, sin = real / moduli, imag / moduli
        for k in self._arrays.on_line:
            cos[k], sin[k] = self._rotations[0][k], self._rotations[1][k]
        return np.stack((self.theta_dot, cos[0] * cos[1] + sin[0] * sin[1],
                         sin[0] * cos[1] - cos[0] * sin[1]))


def in_range(name: str, value: mpfr) -> float:
    """Return a number as a double.  Raises ValueError where its products would overflow."""
    if abs(value) > LARGEST_NUMBER:
        raise ValueError(f'{name} is {value:.3e}: must be at most {LARGEST_NUMBER} for doubles to '
                         'hold the motion; the constants of the top are too far apart in size')
    return float(value)


def _reduced(turned: Matrix, turned_rest: Matrix,
             arrays: ConstantArrays) -> tuple[NDArray[np.int64], Matrix]:
    """
    Return the nearest integers of three phases, and what is left of them, (3, n) each.

    turned, turned_rest : what they have grown by, as two doubles each

    whole + part = turned + turned_rest + the phases at t = 0
    """
    whole = np.rint(turned)
    part = turned - whole
    shift = part + arrays.start_offsets
    shift += turned_rest
    np.rint(shift, out=shift)
    # No difference rounds where the result is small: its terms are within a factor of two of each
    # other then (Sterbenz).
    half = 0.5 * shift
    part -= half
    half -= arrays.start_offsets
    part -= half
    part += turned_rest + arrays.start_offset_rests
    wholes = whole.astype(np.int64)
    shift += arrays.start_wholes
    wholes += shift.astype(np.int64)
    return wholes, part


def _side_by_side(polynomials: Sequence[list[float]]) -> Matrix:
    """Return coefficients with the highest of at least 2 powers first, (k, n)."""
    size = max(2, *map(len, polynomials))
    return np.array([(size - len(one)) * [0.0] + one[::-1] for one in polynomials]).T


def _horner(coefficients: Matrix, xi: Column) -> Matrix:
    """Return the polynomials (..., n) at xi from their coefficients (k, ..., n or 1), k > 1."""
    value: Matrix = coefficients[0] * xi + coefficients[1]
    for coefficient in coefficients[2:]:
        value *= xi
        value += coefficient
    return value
