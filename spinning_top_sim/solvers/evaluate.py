# SPDX-License-Identifier: Apache-2.0
"""
The exact motion at many times, in doubles; `constants` explains the symbols.

Three phases are products of a rate and the time, whose error does not grow with time: that of the
nutation in quarter periods, and those of the rotations exp i(r t + c) of alpha and beta in half
turns.  Each is reduced to the nearest integer.  What is left is an angle of at most pi/4 or pi/2
and keeps its relative precision: a top races past a pole that it misses by little.

All arithmetic is elementwise, so that a value does not depend on the other values in its block.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from operator import sub

import numpy as np
from gmpy2 import const_pi, mpfr, rint
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Number, Quaternion
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.constants import ThetaMotion
from spinning_top_sim.solvers.theta import SIN_ODD, precision

Matrix = NDArray[np.float64]
QUARTER = 0.5 * math.pi         # the angle of a quarter period [rad]
SIGNS = np.array((1.0, -1.0))   # of an even and of an odd number of half turns
HALF_ANGLES = 0.5 * math.pi * np.array([[0.5], [1.0], [1.0]])       # of the three phases' units
# 2^27 + 1: the factor that splits a double into two halves (Dekker, Numer. Math. 18, 1971, 224).
SPLITTER = 134217729.0
# Once glibc has freed a block of this size, it keeps freed memory for large arrays instead of
# clearing the pages again [mallopt(3)]: 20 000 attitudes take 0.9 ms, and would take 2.3 ms.
# A node, which computes little at once, gives the memory back (nodes.executable).
np.empty(2 ** 22, np.uint8)


def halves(x: Number) -> tuple[Number, Number]:
    """Split doubles into two of 26 bits each; products of such halves are exact."""
    big = SPLITTER * x
    high = big - (big - x)
    return high, x - high


class Phases:
    """
    The phases of nutation [quarter periods], and of alpha and beta [half turns].

    rates : per second
    wholes, rests : integers and what is left at t = 0
    """

    def __init__(self, rates: Sequence[mpfr], wholes: Sequence[int],
                 rests: Sequence[mpfr]) -> None:
        self._rates = rates
        self.start_wholes = np.array(wholes, np.float64)[:, np.newaxis]
        self._start_offsets, self._start_rests = _columns(rests)
        self._scaled: dict[int, list[Matrix]] = {}

    def at(self, per_second: int, t: Column,
           ) -> tuple[Matrix, Matrix, NDArray[np.int64], Matrix]:
        """
        Return the three phases, (3, n) each; the arguments are those of `ExactStates`.

        As what they have grown by, rate * t, in doubles and what these leave out; and from their
        values at t = 0 on, as the nearest integers and what is left.
        """
        if per_second not in self._scaled:
            with precision():
                rate, rate_low = _columns([x / per_second for x in self._rates])
            self._scaled[per_second] = [rate, *halves(rate), rate_low]
        rate, r1, r2, rate_low = self._scaled[per_second]
        t1, t2 = halves(t)
        high = rate * t
        # Exact up to the last product of halves (Dekker).
        rest = r1 * t1
        rest -= high
        rest += r1 * t2
        rest += r2 * t1
        rest += r2 * t2
        rest += rate_low * t
        whole = np.rint(high)
        part = high - whole
        shift = part + self._start_offsets
        shift += rest
        np.rint(shift, out=shift)
        # No difference rounds where the result is small: its terms are within a factor of two of
        # each other then (Sterbenz).
        half = 0.5 * shift
        part -= half
        half -= self._start_offsets
        part -= half
        part += rest + self._start_rests
        shift += self.start_wholes
        return high, rest, whole.astype(np.int64) + shift.astype(np.int64), part


class ThetaArrays:
    """
    The constants of a motion in doubles.

    phi_phase, psi_phase : phi and psi at t = 0 less the arguments of alpha and beta [rad]
    sign, turn : theta is sign * (theta in [0, pi]) + turn, for a start beyond a pole
    on_line : 0 for alpha and 1 for beta: those that move on a line through zero, s = 0
    zeros : those that pass zero, and whether R = 0 at y = 0 is at even N (0) or at odd N (1)
    fall : of theta' sin(theta) = fall theta1(2y)/D^4, with the sign of sin(theta)
    sense : in which theta/2 goes round if both poles are passed, else 0
    """

    def __init__(self, motion: ThetaMotion, start: State) -> None:
        factors = alpha, beta = motion.alpha, motion.beta
        self.phi_phase = float(start.phi - alpha.start_argument - beta.start_argument)
        self.psi_phase = float(start.psi - alpha.start_argument + beta.start_argument)
        self.turn = math.tau * round(start.theta / math.tau)
        self.sign = -1.0 if start.theta < self.turn else 1.0
        turns = [x.phase / const_pi() for x in factors]
        wholes = [*map(int, map(rint, turns))]
        self.phases = Phases(
            [motion.quarter_rate, *(x.rate / const_pi() for x in factors)],
            [motion.start_whole, *wholes], [motion.start_offset, *map(sub, turns, wholes)])
        self.drifts = np.array([[0.5 * float(factor.drift)] for factor in factors])
        self.stretch = QUARTER * float(motion.stretch)
        # At even and at odd N, of the rows R of alpha and beta, s J of alpha and beta; the
        # polynomials in xi have their highest power first, (k, 4, 2).
        rows = [[one[part] for one in factor.parts] for part in (0, 1) for factor in factors]
        self.prefactors = [(even.prefactor, odd.prefactor) for even, odd in rows]
        self.coefficients = _highest_first(
            one.polynomial(motion.size) for row in rows for one in row).reshape(-1, 4, 2)
        self.on_line = [k for k, factor in enumerate(factors) if not factor.pole_rate]
        self.zeros = {k: pair.index(SIN_ODD) for k, pair in enumerate(self.prefactors[:2])
                      if SIN_ODD in pair}
        # (Lz + L3)/(2 lambda1) and (Lz - L3)/(2 lambda1) [rad/s]
        self.pole_rates = [float(factor.pole_rate) for factor in factors]
        self.sense = math.copysign(1.0, start.theta_dot) * self.sign * (len(self.zeros) == 2)
        self.start_half = 0.5 * abs(start.theta - self.turn)
        # At even and at odd N
        _, self.momentum_rates, self.swing, u_dot = np.array(
            [[*map(float, one)] for one in motion.turning]).T
        self.fall = -self.sign * u_dot
        self.theta1 = _highest_first([motion.theta1.polynomial(motion.size)])


class ExactStates(States):
    """
    The states of an exact solution, on the branch of its start.

    per_second : 1 for times in s, 10^9 in ns
    t : (n,) times
    """

    method = 'exact'

    def __init__(self, top: Top, start: State, arrays: ThetaArrays, per_second: int, t: Column,
                 ) -> None:
        super().__init__(top, start, len(t))
        self.t = t / per_second
        self._arrays = arrays
        self._turned, self._turned_rest, whole, part = arrays.phases.at(per_second, t)
        self._offset = part[0].copy()
        part[1:] += arrays.drifts * self._offset
        # Cosine and sine by the tangent of half the angle, which is at most 1.  `part` is
        # the memory of the tangents, then of the sines.
        part *= HALF_ANGLES
        tangent = np.tan(part, out=part)
        square = tangent * tangent
        cosines = 1.0 - square[1:]
        square += 1.0
        cosines /= square[1:]
        tangent += tangent
        sines = np.divide(tangent, square, out=tangent)
        # Of r t + c + kappa y of alpha and beta, (2, n) each
        signs = SIGNS.take(whole[1:] & 1)
        cosines *= signs
        sines[1:] *= signs
        self._rotations = cosines, sines[1:]
        # R and s J of alpha and beta, (2, n) each
        self._quarters = quarters = whole[0].copy()
        sin = np.sinh(arrays.stretch * self._offset) if arrays.stretch else sines[0]
        xi = -sin * sin if arrays.stretch else sin * sin
        cos = np.sqrt(1.0 - xi)
        self._parity, self._xi = quarters & 1, xi
        odd = self._parity.astype(bool)
        rows = _horner(arrays.coefficients.take(self._parity, axis=2), xi)
        for k in arrays.zeros:          # the sign is (-1)^floor(N/2)
            rows[k] *= 1 - (quarters & 2)
        self._without_zero = {k: rows[k].copy() for k in arrays.zeros}
        bases = 1.0, cos, sin, sin * cos
        for k, (one, other) in enumerate(arrays.prefactors):
            rows[k] *= bases[one] if one == other else np.where(odd, bases[other], bases[one])
        self._real, self._imag = rows[:2], rows[2:]
        self._cos_y, self._sin_y = cos, sin

    @cached_property
    def moduli(self) -> Matrix:
        """|alpha| D and |beta| D, (2, n); signed, not absolute, where s = 0."""
        # The squares may be too small for a double.
        moduli: Matrix = np.hypot(self._real, self._imag)
        for k in self._arrays.on_line:
            moduli[k] = self._real[k]
        return moduli

    @cached_property
    def _alpha_beta(self) -> tuple[Matrix, Matrix]:
        """Real and imaginary parts of alpha D and beta D, (2, n)."""
        (cos, sin), real, imag = self._rotations, self._real, self._imag
        return real * cos - imag * sin, real * sin + imag * cos

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        (alpha, beta), (alpha_imag, beta_imag) = self._alpha_beta
        squares = self._real * self._real + self._imag * self._imag
        scale = 1.0 / np.sqrt(squares[0] + squares[1])
        return -(beta_imag * scale), beta * scale, alpha_imag * scale, alpha * scale

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        # phi and psi in two parts each, what grows with time and the rest.
        arrays, (_, alpha, beta), (_, alpha_rest, beta_rest) = (
            self._arrays, self._turned, self._turned_rest)
        arguments = np.arctan2(self._imag, self._real)
        arguments += (math.pi * arrays.drifts) * self._offset
        arguments[arrays.on_line] = 0.0
        half = np.arctan2(self.moduli[1], self.moduli[0])
        if arrays.sense:        # by less than half a turn it differs from this
            turned = arrays.start_half + arrays.sense * QUARTER * (
                self._quarters - arrays.phases.start_wholes[0])
            half += math.tau * np.rint((turned - half) / math.tau)
        return (math.pi * ((alpha + beta) + (alpha_rest + beta_rest))
                + ((arguments[0] + arguments[1]) + arrays.phi_phase),
                arrays.sign * (2.0 * half) + arrays.turn,
                math.pi * ((alpha - beta) + (alpha_rest - beta_rest))
                + ((arguments[0] - arguments[1]) + arrays.psi_phase))

    @cached_property
    def theta_dot(self) -> Column:
        # theta' = -u'/sin(theta), and u' is a theta series of 2y.
        arrays, xi, (alpha, beta) = self._arrays, self._xi, self.moduli
        if not arrays.fall.any():       # it rests, perhaps at a pole
            return np.zeros(len(xi))
        size, without = alpha * alpha + beta * beta, [alpha, beta]
        prefactor = self._sin_y * self._cos_y
        for k, parity in arrays.zeros.items():    # there sin y is divided out
            here = self._parity == parity
            prefactor = np.where(here, self._cos_y, prefactor)
            without[k] = np.where(here, self._without_zero[k], without[k])
        series = prefactor * _horner(arrays.theta1, 4.0 * xi * (1.0 - xi))
        # In this order nothing overflows on the separatrix, where all grow like cosh x.
        rate: Column = arrays.fall.take(self._parity) * (series / size) / (
            without[0] * without[1])
        return rate

    @cached_property
    def across(self) -> Column:
        """
        Phi' sin(theta) = (Lz - L3 cos(theta))/(lambda1 sin(theta)) [rad/s].

        In half angles nothing cancels near a pole.  In the real form nothing cancels, of a fast
        top either, in what has been added since the nearest turning point.
        """
        arrays, (alpha, beta) = self._arrays, self.moduli
        if arrays.stretch or arrays.on_line:
            across = np.zeros(len(alpha))
            of_alpha, of_beta = arrays.pole_rates
            if of_alpha:
                across += of_alpha * (beta / alpha)
            if of_beta:
                across += of_beta * (alpha / beta)
            return across
        series = self._sin_y * _horner(arrays.theta1, self._xi)
        momentum = (arrays.momentum_rates.take(self._parity) * (alpha * alpha + beta * beta)
                    + arrays.swing.take(self._parity) * (series * series))
        slow: Column = 0.5 * momentum / (alpha * beta)
        return slow

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        # psi is the argument of alpha less that of beta.
        real, imag = self._alpha_beta
        moduli = self.moduli.copy()
        moduli[self._arrays.on_line] = 1.0  # it may be 0, and its sign is in theta
        cos, sin = real / moduli, imag / moduli
        for k in self._arrays.on_line:
            cos[k], sin[k] = self._rotations[0][k], self._rotations[1][k]
        return attitude.transverse(
            self._arrays.sign * self.theta_dot, self.across, cos[0] * cos[1] + sin[0] * sin[1],
            sin[0] * cos[1] - cos[0] * sin[1])


def _columns(numbers: Sequence[mpfr]) -> Matrix:
    """Return nearest doubles and what they leave out, (2, k, 1)."""
    high = [*map(float, numbers)]
    return np.array([high, [*map(float, map(sub, numbers, high))]])[:, :, np.newaxis]


def _highest_first(polynomials: Iterable[Sequence[mpfr]]) -> Matrix:
    """Return coefficients in doubles, with the highest of at least 2 powers first, (k, n)."""
    doubles = [[*map(float, one)] for one in polynomials]
    size = max(2, *map(len, doubles))
    return np.array([(size - len(one)) * [0.0] + one[::-1] for one in doubles]).T


def _horner(coefficients: Matrix, xi: Column) -> Matrix:
    """Return the polynomials (..., n) at xi from their coefficients (k, ..., n or 1), k > 1."""
    value: Matrix = coefficients[0] * xi + coefficients[1]
    for coefficient in coefficients[2:]:
        value *= xi
        value += coefficient
    return value
