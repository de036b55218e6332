# SPDX-License-Identifier: Apache-2.0
"""
Jacobi's theta functions as short polynomials, in multiprecision.

theta1 .. theta4 of y are used in the real form, with the nome q = exp(-pi K'/K) [DLMF 20.2(i)], or
in the imaginary form, after Jacobi's transformation: with the nome q' = exp(-pi K/K') and
hyperbolic functions of x = y K/K' [DLMF 20.7(viii)].  The smaller nome is at most exp(-pi), so
four terms reach 1e-19 and six 1e-39.  Positive constants that all series of a form share are left
out.
"""

import math
from collections.abc import Sequence
from functools import reduce
from itertools import count, zip_longest
from operator import add, mul
from typing import NamedTuple

from gmpy2 import frexp, mpfr, sqrt

from spinning_top_sim.solvers.multiprecision import ONE, ZERO, GaussMean

# What the terms of a series have in common: one of the four prefactors 1, cos y, sin y and
# sin y cos y.  The rest of cos(n y) or sin(n y) is a polynomial in xi = sin^2 y [DLMF 4.21(iii)],
# of which these are the first two, for n = 0 and 2 or n = 1 and 3; f(n + 2) = (2 - 4 xi) f(n) -
# f(n - 2).
COS_EVEN, COS_ODD, SIN_ODD, SIN_EVEN = range(4)
FIRST_POLYNOMIALS = ([1], [1, -2]), ([1], [1, -4]), ([1], [3, -4]), ([0], [2])
MOST_TERMS = 6
# Of the polynomials in doubles, and of rates, and states that are handed over: motions between
# changes of the vertical can be chaotic, and every error grows.
DIGITS_OF_DOUBLES, DIGITS_OF_SERIES = 19, 39


def _polynomials(first: Sequence[int], second: Sequence[int]) -> list[Sequence[int]]:
    rows = [first, second]
    while len(rows) < MOST_TERMS:
        rows.append([2 * a - 4 * b - c for a, b, c in zip_longest(
            rows[-1], [0, *rows[-1]], rows[-2], fillvalue=0)])
    return rows


# By prefactor and power of xi, the coefficients of the multiples that have such a power.
MULTIPLE_ANGLES = [
    [[mpfr(row[power]) if power < len(row) else ZERO for row in rows[power:]]
     for power in range(MOST_TERMS)]
    for rows in (_polynomials(*pair) for pair in FIRST_POLYNOMIALS)]


class Series(NamedTuple):
    """
    The sum of weights[k] times cos(n y) or sin(n y): a prefactor times a polynomial in sin^2 y.

    In the imaginary form y stands for ix: cosh x for cos y, sinh x for sin y, xi = -sinh^2 x.
    """

    prefactor: int
    weights: Sequence[mpfr]

    def polynomial(self, most: int) -> list[mpfr]:
        """Return the coefficients of xi^0, xi^1 ... of so many terms."""
        weights, shapes = self.weights[:most], MULTIPLE_ANGLES[self.prefactor]
        # A sum of -0 is -0.
        return [reduce(add, map(mul, weights[power:], shapes[power]))
                for power in range(len(weights))]

    def at(self, sin: mpfr, cos: mpfr, xi: mpfr) -> mpfr:
        """Return the sum by Clenshaw's recurrence."""
        twice, value, before = 2 - 4 * xi, ZERO, ZERO
        for weight in reversed(self.weights):
            value, before = weight + twice * value - before, value
        if self.prefactor == COS_EVEN:
            return value - before * twice / 2
        if self.prefactor == COS_ODD:
            return (value - before) * cos
        return (value + before) * sin if self.prefactor == SIN_ODD else 2 * before * sin * cos

    @property
    def leading(self) -> mpfr:
        """At y = 0, the value of a cosine series, or the derivative of a sine series."""
        return sum(map(mul, self.weights, MULTIPLE_ANGLES[self.prefactor][0]), ZERO)


NOTHING = Series(COS_EVEN, [ZERO])
# A real and an imaginary part
Parts = tuple[Series, Series]


class ThetaForm:
    """
    The theta functions in the real or in the imaginary form.

    mean : of which k is the modulus of the form: k^2 is m in the real and 1 - m in the imaginary
        form, and at most 1/2
    size : coefficients of a polynomial that doubles need
    theta1 .. theta4 : the functions of y, or what the transformation makes of them
    slope1, middle3, middle4 : the derivative of theta1, and theta3 and theta4, at y = 0
    odd_over_even : the factor that the transforms of theta1 and theta4 have lost, squared; those
        of theta2 and theta3 have not
    """

    def __init__(self, mean: GaussMean, imaginary: bool) -> None:
        self.mean, self.imaginary = mean, imaginary
        q = mean.nome()
        exponent, significand = frexp(q)
        depth = -math.log10(significand) - exponent * math.log10(2.0)
        # Terms k are of size q^(k^2 - k/2) or less beside the first one.
        self.size, terms = (
            next(k for k in count(2) if (2 * k * k - k) * depth > 2 * wanted)
            for wanted in (DIGITS_OF_DOUBLES, DIGITS_OF_SERIES))
        # 2 q^(k^2) and q^(k (k + 1))
        self._even, self._odd, power = [ONE, 2 * q], [ONE], q
        for _ in range(1, terms):
            power *= q
            self._odd.append(self._odd[-1] * power)
            power *= q
            self._even.append(self._even[-1] * power)
        self._even.pop()
        self.theta1 = Series(SIN_ODD, _alternating(self._odd))
        self.theta3 = Series(COS_EVEN, self._even)
        pair = Series(COS_ODD, self._odd), Series(COS_EVEN, _alternating(self._even))
        self.theta2, self.theta4 = pair[::-1] if imaginary else pair
        self.slope1, self.middle3, self.middle4 = (
            one.leading for one in (self.theta1, self.theta3, self.theta4))
        self.odd_over_even = 4 * sqrt(q) if imaginary else ONE

    def slopes_of_sn2(self) -> tuple[mpfr, mpfr]:
        """Return c with d(sn^2 chi)/dchi = c theta1(2y)/D(y)^4, for theta4 and theta3 as D."""
        # 2 sn cn dn by the quotients of DLMF 22.2 and the duplication of theta1 [DLMF 20.7.10];
        # c from the first term at y = 0, where chi = (2K/pi) y.
        even = self.middle4 ** 4 * self.mean.quarter_period / self.slope1
        return even, -even * self.odd_over_even ** 2

    def shifted(self, amplitude: mpfr, sense: int) -> tuple[Parts, Parts]:
        """
        Return the parts R and s J of i s theta1(y - i s a) and of theta2(y - i s a).

        amplitude : sinh a, or, in the imaginary form, sin of its transform a K/K'
        sense : s
        """
        square = -amplitude * amplitude if self.imaginary else amplitude * amplitude
        other, twice = sqrt(1 + square), 2 + 4 * square      # twice: 2 cosh 2a, or 2 cos 2a
        sines = _weighted(self._odd, -amplitude, amplitude, twice)
        cosines = _weighted(self._odd, other, other, twice)
        theta1 = (Series(COS_ODD, _alternating(sines)),
                  Series(SIN_ODD, _alternating(_signed(sense, cosines))))
        if self.imaginary:
            sines = _weighted(self._even, -2 * amplitude * other, ZERO, twice)
            cosines = _weighted(self._even, twice / 2, ONE, twice)
            return theta1, (Series(COS_EVEN, _alternating(cosines)),
                            Series(SIN_EVEN, _alternating(_signed(-sense, sines))))
        return theta1, (Series(COS_ODD, cosines), Series(SIN_ODD, _signed(sense, sines)))


def _alternating(weights: Sequence[mpfr]) -> list[mpfr]:
    return [-x if k % 2 else x for k, x in enumerate(weights)]


def _signed(sign: int, weights: Sequence[mpfr]) -> Sequence[mpfr]:
    return weights if sign > 0 else [-x for x in weights]


def _weighted(weights: Sequence[mpfr], before: mpfr, value: mpfr,
              twice: mpfr) -> list[mpfr]:
    """Return weights times sines or cosines of a, 3a ..., or of 0, 2a ..., from two of them."""
    products = []
    for weight in weights:
        products.append(weight * value)
        before, value = value, twice * value - before
    return products
