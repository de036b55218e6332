# SPDX-License-Identifier: Apache-2.0
"""
Multiprecision numbers, `mpfr` and `mpc` of gmpy2, and what the closed form computes with them.

`precision` sets the precision of results.  L. Fousse et al., "MPFR: A multiple-precision binary
floating-point library with correct rounding", ACM Trans. Math. Softw. 33 (2007), 13.

`cubic_roots`: the roots of the nutation's cubic and their distances, without cancellation.

`ThetaForm`: Jacobi's theta functions as short polynomials.  theta1 .. theta4 of y are used in the
real form, with the nome q = exp(-pi K'/K) [DLMF 20.2(i)], or in the imaginary form, after Jacobi's
transformation: with the nome q' = exp(-pi K/K') and hyperbolic functions of x = y K/K'
[DLMF 20.7(viii)].  The smaller nome is at most exp(-pi), so four terms reach 1e-19 and six 1e-39.
Positive constants that all series of a form share are left out.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from itertools import count, zip_longest
from operator import add, mul
from typing import NamedTuple

import gmpy2
from gmpy2 import agm, const_pi, exp, frexp, get_context, mpfr, sqrt

# Three words of 64 bits, or 57 decimal digits.
BITS = 192
# An infinity or a NaN raises ArithmeticError.
TRAPS = {f'trap_{name}': True for name in ('divzero', 'invalid', 'overflow')}
ZERO, ONE = mpfr(0), mpfr(1)


@contextmanager
def precision(bits: int = BITS) -> Iterator[None]:
    """Set the precision of results [bits] within a `with` statement, in this thread."""
    before = gmpy2.get_context()
    gmpy2.set_context(gmpy2.context(precision=bits, **TRAPS))
    try:
        yield
    finally:
        gmpy2.set_context(before)       # which `with gmpy2.context` of gmpy2 2.1 does not


def atan2(y: mpfr, x: mpfr) -> mpfr:
    """Return the argument of x + iy in (-pi, pi]; 0 at the origin, whatever the signs of zeros."""
    return gmpy2.atan2(y + ZERO, x + ZERO)


NEGLIGIBLE = 1e-21      # a ratio whose fourth power does not count


class GaussMean:
    """
    Gauss' arithmetic-geometric mean M of a_0 and g_0, for elliptic integrals [DLMF 19.8(i)].

    No step subtracts numbers of one size, and all converge quadratically.

        a_(n+1) = (a_n + g_n)/2,  g_(n+1) = sqrt(a_n g_n),  c_n = sqrt(a_n^2 - g_n^2)

    The modulus is k = c_0/a_0, its complement k' = g_0/a_0: only ratios count, but for M itself.

    mean : M; the quarter period K(k) is (pi/2) a_0/M [DLMF 19.8.5]
    """

    def __init__(self, a: mpfr, g: mpfr, c: mpfr) -> None:
        self._start, self._complement, self._squares = a, c, [c * c]
        while len(self._squares) == 1 or c > a * NEGLIGIBLE:
            a, g = (a + g) / 2, sqrt(a * g)
            c = self._squares[-1] / (4 * a)         # [DLMF 19.8.3]
            self._squares.append(c * c)
        self.mean = a

    @property
    def quarter_period(self) -> mpfr:
        """2 K(k)/pi."""
        return self._start / self.mean

    def nome(self) -> mpfr:
        """Return q = exp(-pi K'/K)."""
        return exp(-const_pi() * self.mean / agm(self._start, self._complement))

    def amplitude(self, square: mpfr, sign: int) -> mpfr:
        """
        Return sin(pi u/(2K)) from sn^2(u), or sinh(pi u/(2K)) from -sn^2(iu).

        By descending Gauss transformations [DLMF 19.8.18], which leave u/K as it is and end at
        k = 0.  In terms of h = a/sin or a/sinh of the amplitude a step is a mean too.

        square : sn^2(u) in [0, 1] with sign -1; -sn^2(iu) >= 0 with sign 1
        """
        if not square:
            return ZERO
        h = self._start / sqrt(square)
        for c2 in self._squares:
            h = (h + sqrt(h * h + sign * c2)) / 2
        amplitude = self.mean / h
        # The square may be 1 but for rounding: the sine is then 1.
        return min(amplitude, ONE) if sign < 0 else amplitude


MOST_NEWTON_STEPS = 50
KEPT_BITS = 136         # what must be left of the precision after the discriminant has cancelled


class RootsTooCloseError(ArithmeticError):
    """Two roots of the cubic agree to most of the digits at hand."""


class Roots(NamedTuple):
    """The roots y1 <= 0 <= y2 < y3 and the gaps y2 - y1 and y3 - y2."""

    y1: mpfr
    y2: mpfr
    y3: mpfr
    gap21: mpfr
    gap32: mpfr

    @property
    def gap31(self) -> mpfr:
        return self.y3 - self.y1


def cubic_roots(f0: mpfr, f1: mpfr, f2: mpfr, f3: mpfr) -> Roots:
    """
    Return the roots of f0 + f1 y + f2 y^2 + f3 y^3, all real, with f0 >= 0 and f3 > 0.

    Raises RootsTooCloseError if more digits are needed to tell two of them apart.
    """
    a2, a1, a0 = f2 / f3, f1 / f3, f0 / f3
    if not f0:                                  # turning point, cusp or pole: y = 0 is a root
        low, high, gap = _quadratic_roots(-a2, a1)
        return (Roots(ZERO, low, high, low, gap) if low > 0
                else Roots(low, ZERO, high, -low, high))
    y, side = _isolated_root(a2, a1, a0)
    product = -a0 / y
    # The sum of the other two.  Next to a pole one of them is small, and -a2 - y cancels.
    total = -a2 - y if 2 * abs(y) < abs(a2) else (a1 - product) / y
    low, high, gap = _quadratic_roots(total, product)
    return Roots(y, low, high, low - y, gap) if side < 0 else Roots(low, high, y, gap, y - high)


def _quadratic_roots(total: mpfr, product: mpfr) -> tuple[mpfr, mpfr, mpfr]:
    """Return the roots x1 <= x2 of x^2 - total x + product, and x2 - x1."""
    discriminant = total * total - 4 * product
    if discriminant < total * total / 2 ** (get_context().precision - KEPT_BITS):
        raise RootsTooCloseError
    gap = sqrt(discriminant)
    large = (total + gap) / 2 if total > 0 else (total - gap) / 2
    small = product / large
    return min(large, small), max(large, small), gap


def _isolated_root(a2: mpfr, a1: mpfr, a0: mpfr) -> tuple[mpfr, int]:
    """
    Return the root of y^3 + a2 y^2 + a1 y + a0 that lies alone on its side of -a2/3, and the side.

    It is 2 cos(arccos(|p|/(2 radius^3))/3) times `radius` from there, where p is the value of the
    cubic (Viete).  Newton's method from the nearest double converges quadratically.
    """
    centre, radius = -a2 / 3, sqrt(a2 * a2 - 3 * a1) / 3
    value = ((centre + a2) * centre + a1) * centre + a0
    side = -1 if value > 0 else 1
    ratio = min(1.0, float(abs(value / (2 * radius ** 3))))
    y = centre + side * radius * (2.0 * math.cos(math.acos(ratio) / 3.0))
    resolution = ONE / 2 ** (get_context().precision - 10)
    for _ in range(MOST_NEWTON_STEPS):
        step = (((y + a2) * y + a1) * y + a0) / ((3 * y + 2 * a2) * y + a1)
        y -= step
        if abs(step) <= abs(y) * resolution:
            return y, side
    raise RootsTooCloseError


# What the terms of a series have in common: one of the four prefactors 1, cos y, sin y and
# sin y cos y.  The rest of cos(n y) or sin(n y) is a polynomial in xi = sin^2 y [DLMF 4.21(iii)],
# of which these are the first two, for n = 0 and 2 or n = 1 and 3; f(n + 2) = (2 - 4 xi) f(n) -
# f(n - 2).
COS_EVEN, COS_ODD, SIN_ODD, SIN_EVEN = range(4)
FIRST_POLYNOMIALS = ([1], [1, -2]), ([1], [1, -4]), ([1], [3, -4]), ([0], [2, 0])
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


class Series:
    """
    The sum of weights[k] times cos(n y) or sin(n y): a prefactor times a polynomial in sin^2 y.

    In the imaginary form y stands for ix: cosh x for cos y, sinh x for sin y, xi = -sinh^2 x.
    """

    def __init__(self, prefactor: int, weights: Sequence[mpfr]) -> None:
        self.prefactor, self.weights = prefactor, weights

    def polynomial(self, terms: int | None = None) -> list[mpfr]:
        """Return the coefficients of xi^0, xi^1 ... of the first terms, or of all."""
        weights = self.weights[:terms]
        # A sum of -0 is -0.
        return [reduce(add, map(mul, weights[power:], shapes)) for power, shapes in zip(
            range(len(weights)), MULTIPLE_ANGLES[self.prefactor], strict=False)]

    def at(self, sin: mpfr, cos: mpfr, xi: mpfr) -> mpfr:
        """Return the sum."""
        (before, *_), (constant, slope) = FIRST_POLYNOMIALS[self.prefactor]
        now, factor, value = constant + slope * xi, 2 - 4 * xi, ZERO
        for weight in self.weights:
            value += weight * before
            before, now = now, factor * now - before
        return value * (ONE, cos, sin, sin * cos)[self.prefactor]

    @property
    def leading(self) -> mpfr:
        """At y = 0, the value of a cosine series, or the derivative of a sine series."""
        return reduce(add, map(mul, self.weights, MULTIPLE_ANGLES[self.prefactor][0]))


NOTHING = Series(COS_EVEN, [ZERO])
# A real and an imaginary part
Parts = tuple[Series, Series]


class ThetaForm:
    """
    The theta functions theta1 .. theta4 of y, or what Jacobi's transformation makes of them.

    mean : its k^2 is m in the real and 1 - m in the imaginary form, and at most 1/2
    size : coefficients of a polynomial that doubles need
    slope1, middle3, middle4 : the derivative of theta1, and theta3 and theta4, at y = 0
    odd_over_even : the square of the factor that theta1 and theta4 lack beside theta2 and theta3
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
                  Series(SIN_ODD, _alternating([sense * x for x in cosines])))
        if self.imaginary:
            sines = _weighted(self._even, -2 * amplitude * other, ZERO, twice)
            cosines = _weighted(self._even, twice / 2, ONE, twice)
            return theta1, (Series(COS_EVEN, _alternating(cosines)),
                            Series(SIN_EVEN, _alternating([-sense * x for x in sines])))
        return theta1, (Series(COS_ODD, cosines), Series(SIN_ODD, [sense * x for x in sines]))


def _alternating(weights: Sequence[mpfr]) -> list[mpfr]:
    return [-x if k % 2 else x for k, x in enumerate(weights)]


def _weighted(weights: Sequence[mpfr], before: mpfr, value: mpfr, twice: mpfr) -> list[mpfr]:
    """Return weights times sines or cosines of a, 3a ..., or of 0, 2a ..., from two of them."""
    products = []
    for weight in weights:
        products.append(weight * value)
        before, value = value, twice * value - before
    return products
