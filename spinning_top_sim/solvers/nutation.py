# SPDX-License-Identifier: Apache-2.0
"""
The nutation of the exact motion, to full relative precision next to a pole.

The phase of the nutation is counted from the nearest quarter period, where the theta functions are
short polynomials; even and odd quarter periods have series of their own (`theta_setup`).
"""

import math
from decimal import Decimal
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Number
from spinning_top_sim.solvers.decimal_math import double_double
from spinning_top_sim.solvers.theta_series import TERMS, Series
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion
from spinning_top_sim.solvers.times import Rate, Times

QUARTER_PERIOD_ANGLE = 0.5 * math.pi
BLOCK = 4096                # times evaluated together: temporaries stay in the cache
# Smaller amplitudes leave no room for their products in doubles.
LEAST_AMPLITUDE = Decimal('1e-290')
# Larger numbers leave none for splitting them.
MOST = Decimal('1e290')


class NutationColumns(NamedTuple):
    """
    The nutation at n times, (n,) each; the symbols are those of `theta_setup`.

    alpha, beta : |alpha| D and |beta| D; signed, not absolute, where s = 0
    alpha_argument, beta_argument : arguments of (R + i s J) exp(i s kappa y) [rad]
    theta_dot : [rad/s]
    half_theta : theta/2, continued through the poles [rad]
    """

    alpha: Column
    beta: Column
    alpha_argument: Column
    beta_argument: Column
    theta_dot: Column
    half_theta: Column


class _FactorSeries:
    """R and J of alpha or beta at even or at odd N, in doubles."""

    def __init__(self, name: str, factor: Factor, odd: int) -> None:
        series = factor.odd if odd else factor.even
        self.real = _coefficients(series.real.scaled(Decimal(factor.sign)), name)
        self.imag = _coefficients(series.imag)
        self._real_prefactor, self._imag_prefactor = series.real.prefactor, series.imag.prefactor
        self._sense, self._drift = factor.sense, float(factor.drift)
        self._crosses, self.has_zero = factor.crosses, series.has_zero

    def at(self, y: Column, flip: Column, xi: Column, prefactors: tuple[Column | float, ...],
           ) -> tuple[Column, Column, Column]:
        """Return modulus (signed if real), argument, and the modulus without its factor sin y."""
        polynomial = _horner(self.real, xi)
        if self._crosses:
            polynomial = flip * polynomial
        real = prefactors[self._real_prefactor] * polynomial
        if not self._sense:
            return real, 0.0 * y, polynomial if self.has_zero else real
        imag = prefactors[self._imag_prefactor] * _horner(self.imag, xi)
        modulus = np.hypot(real, imag)          # its square may be too small for a double
        return modulus, self._drift * y + self._sense * np.arctan2(imag, real), modulus


class _Quarter:
    """Alpha, beta and cos(theta)' at even or at odd N."""

    def __init__(self, motion: ThetaMotion, odd: int) -> None:
        self._alpha = _FactorSeries('alpha', motion.alpha, odd)
        self._beta = _FactorSeries('beta', motion.beta, odd)
        smallest = min(max(map(abs, x.real + x.imag)) for x in (self._alpha, self._beta))
        # A power of 2: near a pole all is small.
        self._magnifier = 2.0 ** -math.frexp(smallest)[1] if smallest else 1.0
        self._u_dot = in_range("cos(theta)'", motion.u_dot[odd] * Decimal(self._magnifier))
        self._u_dot_series = _coefficients(motion.u_dot_series)
        self._imaginary, self._stretch = motion.imaginary, float(motion.stretch)

    def at(self, y: Column, flip: Column) -> tuple[Column, ...]:
        """Return the first 5 of `NutationColumns` at y, |y| <= pi/4; flip: (-1)^floor(N/2)."""
        if self._imaginary:
            s = np.sinh(y * self._stretch)
            xi = -s * s
        else:
            s = np.sin(y)
            xi = s * s
        c = np.sqrt(1.0 - xi)           # cos y > 0, or cosh x
        prefactors = (1.0, c, s, s * c)
        alpha, alpha_argument, alpha_without_sin = self._alpha.at(y, flip, xi, prefactors)
        beta, beta_argument, beta_without_sin = self._beta.at(y, flip, xi, prefactors)
        if not self._u_dot:             # resting, perhaps at a pole
            return alpha, beta, alpha_argument, beta_argument, 0.0 * y
        # theta' = -u'/sin(theta), and u' is a theta series of 2y.  Where alpha or beta has a zero,
        # its factor sin y is divided out of both.
        prefactor = 2.0 * c if self._alpha.has_zero or self._beta.has_zero else 2.0 * s * c
        u_dot = prefactor * _horner(self._u_dot_series, 4.0 * xi * (1.0 - xi))
        # In this order nothing overflows on the separatrix, where all grow like cosh x.
        theta_dot = (-0.5 * self._u_dot * (u_dot / (alpha * alpha + beta * beta))
                     / (self._magnifier * alpha_without_sin * beta_without_sin))
        return alpha, beta, alpha_argument, beta_argument, theta_dot


class NutationPhase:
    """The phase of the nutation, counted from the nearest quarter period."""

    def __init__(self, motion: ThetaMotion) -> None:
        self._rate = Rate(motion.quarter_rate)
        self._quarter0 = motion.quarter0
        self._offset, self._offset_rest = double_double(motion.offset0)

    def at(self, times: Times) -> tuple[Column, Column]:
        """
        Return the nearest whole number N of quarter periods, and the angle y from there.

        y has full relative precision: a top races past a pole that it misses by little.
        """
        high, rest = self._rate.product(times)
        whole = np.rint(high)
        part = high - whole
        # Knuth's sum of part and offset: `nearest` with what it leaves out.
        nearest = part + self._offset
        taken = nearest - part
        left_out = (part - (nearest - taken)) + (self._offset - taken)
        shift = np.rint(nearest + rest)
        # Exact where the result is small (Sterbenz), as shift is 0 or +-1.
        y = (nearest - shift) + (left_out + (rest + self._offset_rest))
        return whole + (self._quarter0 + shift), QUARTER_PERIOD_ANGLE * y


class Nutation:
    """The nutation of one motion; ValueError if doubles cannot hold an amplitude or a rate."""

    def __init__(self, motion: ThetaMotion, start_theta: float) -> None:
        # Even and odd quarter periods.
        self._kinds = _Quarter(motion, 0), _Quarter(motion, 1)
        self._phase = NutationPhase(motion)
        self._planar_rotation = motion.planar_rotation
        self._turns0 = 0.0
        if motion.planar_rotation:
            self._turns0 = round(self._turns(
                motion.quarter0, QUARTER_PERIOD_ANGLE * float(motion.offset0), 0.5 * start_theta))

    def at(self, times: Times) -> NutationColumns:
        """Return the nutation at n times."""
        columns = np.empty((6, len(times)))
        for first in range(0, len(times), BLOCK):
            block = slice(first, first + BLOCK)
            self._fill(columns[:, block], times[block])
        return NutationColumns(*columns)

    def _fill(self, out: NDArray[np.float64], times: Times) -> None:
        quarters, y = self._phase.at(times)
        place = quarters.astype(np.int64) & 3
        flip = np.where(place < 2, 1.0, -1.0)
        odd = (place & 1).astype(bool)
        for quarter, here in zip(self._kinds, (~odd, odd), strict=True):
            if here.all():
                out[:5] = quarter.at(y, flip)
            elif here.any():
                out[:5, here] = quarter.at(y[here], flip[here])
        half_theta = np.arctan2(out[1], out[0])
        if self._planar_rotation:
            half_theta += 2.0 * math.pi * np.rint(self._turns(quarters, y, half_theta))
        out[5] = half_theta

    def _turns(self, quarters: Number, y: Number, half_theta: Number) -> Number:
        """
        Return the whole turns to add to `half_theta`, before rounding.

        In a planar rotation, which passes both poles, theta/2 stays within a quarter turn of
        (pi/2) (intercept + slope Z), Z in quarter periods.
        """
        assert self._planar_rotation is not None
        intercept, slope = self._planar_rotation
        steady = QUARTER_PERIOD_ANGLE * (intercept + slope * quarters) + slope * y
        return (steady - half_theta) / (2.0 * math.pi) - self._turns0


def in_range(name: str, value: Decimal) -> float:
    """Return a number as a double.  Raises ValueError where its products would overflow."""
    if abs(value) > MOST:
        raise ValueError(f'{name} is {value:.3e}: must be at most {MOST} for doubles to hold '
                         f'the motion; the constants of the top are too far apart in size')
    return float(value)


def _coefficients(series: Series, checked: str = '') -> tuple[float, ...]:
    """Return the polynomial's coefficients as doubles, highest of TERMS first."""
    exact = series.polynomial()
    largest = max(abs(x) for x in exact)
    if checked and 0 < largest < LEAST_AMPLITUDE:
        raise ValueError(f'the amplitude of {checked} is {largest:.3e}: the start is too close to '
                         f'a pole or to rest there; must be 0 or at least {LEAST_AMPLITUDE}')
    return (0.0,) * (TERMS - len(exact)) + tuple(float(x) for x in reversed(exact))


def _horner(coefficients: tuple[float, ...], x: Column) -> Column:
    """Return the polynomial with these coefficients, highest of four first, at x."""
    c3, c2, c1, c0 = coefficients
    return ((c3 * x + c2) * x + c1) * x + c0
