# SPDX-License-Identifier: Apache-2.0
"""
Multiprecision numbers, `mpfr` and `mpc` of gmpy2, and what the closed form computes with them.

`precision` sets the precision of results.  L. Fousse et al., "MPFR: A multiple-precision binary
floating-point library with correct rounding", ACM Trans. Math. Softw. 33 (2007), 13.

`GaussMean`: elliptic integrals by Gauss' arithmetic-geometric mean.  One sequence of means of a_0
and g_0 gives the complete integral of the first kind and the nome, and, with one more square root
a step, an incomplete integral.  No step subtracts numbers of one size, and all converge
quadratically.

    a_(n+1) = (a_n + g_n)/2,  g_(n+1) = sqrt(a_n g_n),  c_n = sqrt(a_n^2 - g_n^2)    [DLMF 19.8(i)]

The modulus is k = c_0/a_0, its complement k' = g_0/a_0.  The arguments a_0, g_0, c_0 need no
common scale: the functions depend on their ratios only, but for the mean itself.

`cubic_roots`: the roots of the nutation's cubic and their distances, without cancellation.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple

import gmpy2
from gmpy2 import get_context, mpc, mpfr, sqrt

# Three words of 64 bits, or 57 decimal digits.
BITS = 192
# An infinity or a NaN raises ArithmeticError.
TRAPS = {f'trap_{name}': True for name in ('divzero', 'invalid', 'overflow')}
ZERO, ONE, IMAGINARY = mpfr(0), mpfr(1), mpc(1j)
# A double as it is, where 53 bits or more are set.  The constants of a top come again and again.
as_mpfr = lru_cache(64)(mpfr)


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


def argument(z: mpc) -> mpfr:
    """Return the argument in (-pi, pi]; 0 of 0."""
    return atan2(z.imag, z.real)


def phase(angle: mpfr) -> mpc:
    """Return exp(i angle)."""
    sine, cosine = gmpy2.sin_cos(angle)
    return cosine + IMAGINARY * sine


def double_double(x: mpfr) -> tuple[float, float]:
    """Return the nearest double, and the nearest double to what it leaves out."""
    high = float(x)
    return high, float(x - high)


# Coefficients of lambda, lambda^5, lambda^9 ... in the nome [DLMF 19.5.6; A002103 of oeis.org].
# The first one that is left out contributes less than 1e-44 for k^2 <= 1/2.
NOME_COEFFICIENTS = 1, 2, 15, 150, 1707, 20910, 268616, 3567400, 48555069, 673458874
NEGLIGIBLE = 1e-21      # a ratio whose square does not count


class GaussMean:
    """
    The arithmetic-geometric mean M of a_0 and g_0; the caller knows c_0 without cancellation.

    mean : M; the quarter period K(k) is (pi/2) a_0/M [DLMF 19.8.5]
    """

    def __init__(self, a: mpfr, g: mpfr, c: mpfr) -> None:
        self._start, self._squares = a, [c * c]
        self._means: list[tuple[mpfr, mpfr]] = []     # g_n and c_n
        while not self._means or c > a * NEGLIGIBLE:
            product, a = a * g, (a + g) / 2
            c = self._squares[-1] / (4 * a)         # [DLMF 19.8.3]
            g = sqrt(product) if c > a * NEGLIGIBLE else a
            self._means.append((g, c))
            self._squares.append(c * c)
        self.mean = a

    @property
    def quarter_period(self) -> mpfr:
        """2 K(k)/pi."""
        return self._start / self.mean

    def nome(self) -> mpfr:
        """Return q = exp(-pi K'/K) to 40 digits, for k^2 <= 1/2."""
        a, (g, c) = self._start, self._means[0]
        small = a * c / (a + g) ** 2                # (1 - sqrt(k'))/(1 + sqrt(k'))/2
        power, total = small ** 4, ZERO
        for coefficient in reversed(NOME_COEFFICIENTS):
            total = total * power + coefficient
        return small * total

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
            # Two terms of the root are enough where c is small.
            h2 = h * h
            h = (h + sign * c2 / (4 * h) if c2 < h2 * NEGLIGIBLE
                 else (h + sqrt(h2 + sign * c2)) / 2)
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
