# SPDX-License-Identifier: Apache-2.0
"""
Theta functions of a cubic in multiprecision: numbers are `mpfr` of gmpy2.

They are Jacobi's theta1 .. theta4 of y for a cubic with three real roots [DLMF 20.2(i)].  In the
*real form* they are Fourier series in y, with the nome q = exp(-pi K'/K).  The *imaginary form* is
what Jacobi's transformation makes of them [DLMF 20.7(viii)]: series of hyperbolic functions of
x = y K/K', with the nome q' = exp(-pi K/K').  The smaller nome is at most exp(-pi): four terms
reach 1e-19 and six 1e-39.  Positive constants that all series of a form share are left out.

DLMF: https://dlmf.nist.gov, ch. 19, 20 and 22.  MPFR: L. Fousse et al., ACM Trans. Math. Softw. 33
(2007), 13.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from itertools import count, zip_longest
from operator import add, mul
from typing import NamedTuple

import gmpy2
from gmpy2 import agm, asin, asinh, const_pi, exp, frexp, get_context, mpfr, sqrt

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


MOST_NEWTON_STEPS = 50
KEPT_BITS = 136         # what must be left of the precision after the discriminant has cancelled


class DigitsLostError(ArithmeticError):
    """Two numbers agree in so many digits that too few of their difference are left."""


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

    Raises DigitsLostError if more digits are needed to tell two of them apart.
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
        raise DigitsLostError
    gap = sqrt(discriminant)
    large = (total + gap) / 2 if total > 0 else (total - gap) / 2
    small = product / large
    return min(large, small), max(large, small), gap


def _isolated_root(a2: mpfr, a1: mpfr, a0: mpfr) -> tuple[mpfr, int]:
    """
    Return the root of y^3 + a2 y^2 + a1 y + a0 that lies alone on its side of -a2/3, and the side.

    It is between sqrt(3) and 2 times `radius` from there.  From the outside Newton's method comes
    closer with every step, in the end quadratically.
    """
    centre, radius = -a2 / 3, sqrt(a2 * a2 - 3 * a1) / 3
    side = -1 if ((centre + a2) * centre + a1) * centre + a0 > 0 else 1
    y = centre + 2 * side * radius
    resolution = ONE / 2 ** (get_context().precision - 10)
    for _ in range(MOST_NEWTON_STEPS):
        step = (((y + a2) * y + a1) * y + a0) / ((3 * y + 2 * a2) * y + a1)
        y -= step
        if abs(step) <= abs(y) * resolution:
            return y, side
    raise DigitsLostError


# What the terms of a series have in common: one of the four prefactors 1, cos y, sin y and
# sin y cos y.  The rest of cos(n y) or sin(n y) is a polynomial in xi = sin^2 y [DLMF 4.21(iii)],
# of which these are the first two, for n = 0 and 2 or n = 1 and 3; f(n + 2) = (2 - 4 xi) f(n) -
# f(n - 2).
COS_EVEN, COS_ODD, SIN_ODD, SIN_EVEN = range(4)
FIRST_POLYNOMIALS = ([1], [1, -2]), ([1], [1, -4]), ([1], [3, -4]), ([0], [2, 0])
MOST_TERMS = 6
NEGLIGIBLE = 1e-21      # a ratio whose fourth power does not count
LEAST_COSINE_SQUARE = 1e-18
# Of the polynomials in doubles, and of rates, and states that are handed over: motions between
# changes of the vertical can be chaotic, and every error grows.
DIGITS_OF_DOUBLES, DIGITS_OF_SERIES = 19, 39


def _multiple_angles(first: Sequence[int], second: Sequence[int]) -> list[list[mpfr]]:
    """Return by power of xi the coefficients of the multiples that have such a power."""
    rows = [first, second]
    while len(rows) < MOST_TERMS:
        rows.append([2 * a - 4 * b - c for a, b, c in zip_longest(
            rows[-1], [0, *rows[-1]], rows[-2], fillvalue=0)])
    return [[mpfr(row[power]) for row in rows[power:]] for power in range(MOST_TERMS)]


MULTIPLE_ANGLES = [_multiple_angles(*pair) for pair in FIRST_POLYNOMIALS]


# Sin y, cos y and xi = sin^2 y; in the imaginary form sinh x, cosh x and xi = -sinh^2 x
Point = tuple[mpfr, mpfr, mpfr]


def point(sin: mpfr, imaginary: bool) -> Point:
    """Return the point with this sin y, |y| <= pi/2, or sinh x."""
    xi = -sin * sin if imaginary else sin * sin
    return sin, sqrt(1 - xi), xi


class Series:
    """The sum of weights[k] times cos(n y) or sin(n y): a prefactor and a polynomial in xi."""

    def __init__(self, prefactor: int, weights: Sequence[mpfr]) -> None:
        self.prefactor, self._weights = prefactor, weights

    def scaled(self, factor: mpfr) -> 'Series':
        return Series(self.prefactor, [factor * x for x in self._weights])

    def polynomial(self, terms: int) -> list[mpfr]:
        """Return the coefficients of xi^0, xi^1 ... of the first terms."""
        weights = self._weights[:terms]
        # A sum of -0 is -0.
        return [reduce(add, map(mul, weights[power:], shapes)) for power, shapes in zip(
            range(len(weights)), MULTIPLE_ANGLES[self.prefactor], strict=False)]

    @property
    def leading(self) -> mpfr:
        """At y = 0, the value of a cosine series, or the derivative of a sine series."""
        return reduce(add, map(mul, self._weights, MULTIPLE_ANGLES[self.prefactor][0]))

    def at(self, point: Point) -> mpfr:
        """Return the sum."""
        sin, cos, xi = point
        (before, *_), (constant, slope) = FIRST_POLYNOMIALS[self.prefactor]
        now, factor, value = constant + slope * xi, 2 - 4 * xi, ZERO
        for weight in self._weights:
            value += weight * before
            before, now = now, factor * now - before
        return value * (ONE, cos, sin, sin * cos)[self.prefactor]


NOTHING = Series(COS_EVEN, [ZERO])
# A real and an imaginary part
Parts = tuple[Series, Series]
# u - u1, u2 - u and u3 - u of some u
Place = tuple[mpfr, mpfr, mpfr]


class ThetaForm:
    """
    The theta functions of the cubic with these roots, in the form with the smaller nome.

    Moduli of elliptic functions are c/a with the complement g/a, by Gauss' means M of a and g: the
    quarter period K is (pi/2) a/M [DLMF 19.8.5].  No step of a mean subtracts numbers of one size.

    stretch : K/K' in the imaginary form, where x = stretch y; 0 in the real form
    y_rate, x_rate : of y, and of x or, in the real form, y again [rad/s]
    start_whole, y0, start : N and y where the roots are counted from, and its point
    size : coefficients of a polynomial that doubles need
    slope1, middle3, middle4 : the derivative of theta1, and theta3 and theta4, at y = 0
    rises : c of u - u1 = c theta1(y)^2/D(y)^2 at even N, or u - u2 at odd N
    odd_over_even : the square of the factor that theta1 and theta4 lack beside theta2 and theta3
    """

    def __init__(self, roots: Roots, root_f3: mpfr, *, falling: bool) -> None:
        self._roots = roots
        a, g, c = sqrt(roots.gap31), sqrt(roots.gap32), sqrt(roots.gap21)
        # w = root_f3 sqrt(u3 - u1)/2 and K = (pi/2) sqrt(u3 - u1)/M
        real_mean, imaginary_mean = agm(a, g), agm(a, c)
        self.y_rate = root_f3 * real_mean / 2
        imaginary = g < c
        if imaginary:
            g, c = c, g
        self.stretch = imaginary_mean / real_mean if imaginary else ZERO
        self.x_rate = self.y_rate * (self.stretch or ONE)
        q = exp(-const_pi() * (self.stretch or real_mean / imaginary_mean))
        self._a, self._c_squares = a, [c * c]
        self._mean = imaginary_mean if imaginary else real_mean
        while len(self._c_squares) == 1 or c > a * NEGLIGIBLE:
            a, g = (a + g) / 2, sqrt(a * g)
            c = self._c_squares[-1] / (4 * a)       # [DLMF 19.8.3]
            self._c_squares.append(c * c)
        self._make_series(q)
        # chi is (2K/pi) y
        rise = roots.gap21 * (self._a / (self._mean * self.slope1)) ** 2
        self.rises = (rise * self.middle4 ** 2,
                      -rise * self.middle3 ** 2 * roots.gap32 / roots.gap31)
        # sn^2(chi) = low/gap21 and sn^2(K - chi) are equal at sn^2 (1 + sqrt(m1)) = 1.
        low, high = -roots.y1, roots.y2
        odd = low * sqrt(roots.gap32 / roots.gap31) >= high
        sin = self.amplitude(odd, low, high, roots.y3)
        if odd != falling:
            sin = -sin
        self.start = point(sin, imaginary)
        self.y0 = asinh(sin) / self.stretch if imaginary else asin(sin)
        self.start_whole = (-1 if falling else 1) if odd else 0

    def _make_series(self, q: mpfr) -> None:
        """Set the series by their nome."""
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
        self.theta2, self.theta4 = pair[::-1] if self.stretch else pair
        self.slope1, self.middle3, self.middle4 = (
            one.leading for one in (self.theta1, self.theta3, self.theta4))
        self.odd_over_even = 4 * sqrt(q) if self.stretch else ONE

    def amplitude(self, odd: bool, above1: mpfr, below2: mpfr, below3: mpfr) -> mpfr:
        """
        Return |sin y|, or |sinh x|, where cos(theta) is above u1 and below u2 and u3 by so much.

        y is counted from the even quarter period with u1, or the odd one with u2.  Where u does
        not lie between these, y is imaginary: it is sinh |y| then, or sin |x|.
        """
        # sn^2(chi) is above1/gap21, and sn(K - chi) = cn/dn.  In the imaginary form it is that
        # of i chi, with the parameter m1: -sn^2/cn^2 [DLMF 22.6(iv)].
        roots = self._roots
        if odd:
            square = below2 * roots.gap31 / (
                -above1 * roots.gap32 if self.stretch else below3 * roots.gap21)
        else:
            square = above1 / (-below2 if self.stretch else roots.gap21)
        if not square:
            return ZERO
        if 1 - square < LEAST_COSINE_SQUARE and get_context().precision == BITS:
            raise DigitsLostError       # half of those of the cosine: twice as many do for it
        # By descending Gauss transformations [DLMF 19.8.18], which leave chi/K as it is and end at
        # m = 0.  In terms of h = a/sin or a/sinh of the amplitude a step is a mean too.
        h = self._a / sqrt(abs(square))
        for c2 in self._c_squares:
            h = (h + sqrt(h * h - c2 if square > 0 else h * h + c2)) / 2
        # The square may be 1 but for rounding: the sine is then 1.
        return min(self._mean / h, ONE) if square > 0 else self._mean / h

    def shifted(self, amplitude: mpfr, sense: int) -> tuple[Parts, Parts]:
        """
        Return the parts R and s J of i s theta1(y - i s a) and of theta2(y - i s a).

        amplitude : sinh a, or, in the imaginary form, sin of its transform a K/K'
        sense : s
        """
        square = -amplitude * amplitude if self.stretch else amplitude * amplitude
        other, twice = sqrt(1 + square), 2 + 4 * square      # twice: 2 cosh 2a, or 2 cos 2a
        sines = _weighted(self._odd, -amplitude, amplitude, twice)
        cosines = _weighted(self._odd, other, other, twice)
        theta1 = (Series(COS_ODD, _alternating(sines)),
                  Series(SIN_ODD, _alternating([sense * x for x in cosines])))
        if self.stretch:
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
