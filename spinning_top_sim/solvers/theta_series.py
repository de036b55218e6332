# SPDX-License-Identifier: Apache-2.0
"""
Jacobi's theta functions as short polynomials, in long decimals.

theta1 .. theta4 of y are used in the real form, with the nome q = exp(-pi K'/K) [DLMF 20.2(i)], or
in the imaginary form, after Jacobi's transformation: with the nome q' = exp(-pi K/K') and
hyperbolic functions of x = y K/K' [DLMF 20.7(viii)].  The smaller nome is at most exp(-pi), so
four terms reach 1e-19.  Positive constants that all series of a form share are left out.
"""

from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

from spinning_top_sim.solvers.decimal_math import ONE, ZERO
from spinning_top_sim.solvers.elliptic import GaussMean

# What the terms of a series have in common: one of the four prefactors 1, cos y, sin y and
# sin y cos y.  The rest of cos(n y) or sin(n y) is a polynomial in xi = sin^2 y [DLMF 4.21(iii)],
# of which these are the coefficients, for n = 0, 2, 4, 6 or n = 1, 3, 5, 7.
COS_EVEN, COS_ODD, SIN_ODD, SIN_EVEN = range(4)
MULTIPLE_ANGLES = (
    ((1,), (1, -2), (1, -8, 8), (1, -18, 48, -32)),
    ((1,), (1, -4), (1, -12, 16), (1, -24, 80, -64)),
    ((1,), (3, -4), (5, -20, 16), (7, -56, 112, -64)),
    ((0,), (2,), (4, -8), (6, -32, 32)))
MOST_TERMS = 4


class Series(NamedTuple):
    """
    A prefactor times a polynomial in xi = sin^2 y.

    In the imaginary form y stands for ix: cosh x for cos y, sinh x for sin y, xi = -sinh^2 x.
    """

    prefactor: int
    polynomial: tuple[Decimal, ...]

    @classmethod
    def of(cls, prefactor: int, weights: Sequence[Decimal]) -> 'Series':
        """Return the sum of weights[k] times cos(n y) or sin(n y)."""
        polynomial = [ZERO] * len(weights)
        for weight, shape in zip(weights, MULTIPLE_ANGLES[prefactor], strict=False):
            for power, coefficient in enumerate(shape):
                polynomial[power] += weight * coefficient
        return cls(prefactor, tuple(polynomial))

    def scaled(self, scale: Decimal) -> 'Series':
        return Series(self.prefactor, tuple(scale * x for x in self.polynomial))

    def at(self, sin: Decimal, cos: Decimal, xi: Decimal) -> Decimal:
        value = ZERO
        for coefficient in reversed(self.polynomial):
            value = value * xi + coefficient
        return value * (ONE, cos, sin, sin * cos)[self.prefactor]

    @property
    def leading(self) -> Decimal:
        """At y = 0, the value of a cosine series, or the derivative of a sine series."""
        return self.polynomial[0]


class ThetaForm:
    """
    The theta functions in the real or in the imaginary form.

    mean : of which k is the modulus of the form: k^2 is m in the real and 1 - m in the imaginary
        form, and at most 1/2
    """

    def __init__(self, mean: GaussMean, imaginary: bool) -> None:
        self.mean, self.imaginary = mean, imaginary
        self.nome = q = mean.nome()
        # Terms k, of size q^(k^2 - k/2) or less beside the first one, while they are above 1e-19.
        terms = next((k for k in range(2, MOST_TERMS)
                      if q ** (2 * k * k - k) < Decimal('1e-38')), MOST_TERMS)
        self._even = [ONE, *(2 * q ** (k * k) for k in range(1, terms))]
        self._odd = [q ** (k * (k + 1)) for k in range(terms)]

    def theta(self, number: int) -> Series:
        """Return theta1 .. theta4 of y, or what the transformation makes of them."""
        if self.imaginary:
            number = {1: 1, 2: 4, 3: 3, 4: 2}[number]
        if number == 1:
            return Series.of(SIN_ODD, _alternating(self._odd))
        if number == 2:
            return Series.of(COS_ODD, self._odd)
        return Series.of(COS_EVEN, self._even if number == 3 else _alternating(self._even))

    def at_zero(self, number: int) -> Decimal:
        """Return theta3 or theta4 at y = 0, or what the transformation makes of them."""
        if number == 3:
            return sum(self._even, ZERO)
        return sum(self._odd if self.imaginary else _alternating(self._even), ZERO)

    @property
    def odd_over_even(self) -> Decimal:
        """The transforms of theta1 and theta4 have lost a factor 2 q'^(1/4), of theta2 not."""
        return 4 * self.nome.sqrt() if self.imaginary else ONE

    def slopes_of_sn2(self) -> tuple[Decimal, Decimal]:
        """Return c with d(sn^2 chi)/dchi = c theta1(2y)/D(y)^4, for theta4 and theta3 as D."""
        # 2 sn cn dn by the quotients of DLMF 22.2 and the duplication of theta1 [DLMF 20.7.10];
        # c from the first term at y = 0, where chi = (2K/pi) y.
        slope = sum((2 * k + 1) * x for k, x in enumerate(_alternating(self._odd)))
        even = self.at_zero(4) ** 4 * self.mean.quarter_period / slope
        return even, -even * (16 * self.nome if self.imaginary else 1)

    def shifted(self, amplitude: Decimal) -> tuple[tuple[Series, Series], tuple[Series, Series]]:
        """
        Return the real and the imaginary part of i theta1(y - iA) and of theta2(y - iA).

        amplitude : sinh A, or, in the imaginary form, sin of its transform pi a/(2K')
        """
        if self.imaginary:
            sines, cosines = _multiples(amplitude, 2 * len(self._odd))
            weights = _alternating(self._odd), _alternating(self._even)
            return ((Series.of(COS_ODD, _products(weights[0], sines[1::2])),
                     Series.of(SIN_ODD, _products(weights[0], cosines[1::2]))),
                    (Series.of(COS_EVEN, _products(weights[1], cosines[::2])),
                     Series.of(SIN_EVEN, [-x for x in _products(weights[1], sines[::2])])))
        minus, plus = self._growing_weights(amplitude)
        return ((Series.of(COS_ODD, _alternating(minus)), Series.of(SIN_ODD, _alternating(plus))),
                (Series.of(COS_ODD, plus), Series.of(SIN_ODD, minus)))

    def _growing_weights(self, sinh: Decimal) -> tuple[list[Decimal], list[Decimal]]:
        """Return q^(k(k+1)) times sinh and cosh of (2k+1) A, both over exp(A)."""
        # exp((2k+1) A) q^(k(k+1)) = exp(A) q^(k^2) g^k with g = q exp(2A) <= 1: no large numbers.
        cosh = (1 + sinh * sinh).sqrt()
        growth = sinh + cosh
        g = self.nome * growth * growth
        sinh, cosh = sinh / growth, cosh / growth       # of (2k+1) A, over exp((2k+1) A)
        sinh2, cosh2 = 2 * sinh * cosh, sinh * sinh + cosh * cosh
        minus, plus = [], []
        for k in range(len(self._odd)):
            weight = self.nome ** (k * k) * g ** k
            minus.append(weight * sinh)
            plus.append(weight * cosh)
            sinh, cosh = sinh * cosh2 + cosh * sinh2, cosh * cosh2 + sinh * sinh2
        return minus, plus


def _multiples(sin: Decimal, count: int) -> tuple[list[Decimal], list[Decimal]]:
    """Return the sines and the cosines of 0, 1, 2... times an angle in [0, pi/2]."""
    cos = (1 - sin * sin).sqrt()
    sines, cosines = [ZERO], [ONE]
    for _ in range(count - 1):
        s, c = sines[-1], cosines[-1]
        sines.append(s * cos + c * sin)
        cosines.append(c * cos - s * sin)
    return sines, cosines


def _alternating(weights: Sequence[Decimal]) -> list[Decimal]:
    return [-x if k % 2 else x for k, x in enumerate(weights)]


def _products(one: Sequence[Decimal], other: Sequence[Decimal]) -> list[Decimal]:
    return [x * y for x, y in zip(one, other, strict=True)]
