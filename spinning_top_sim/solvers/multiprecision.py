# SPDX-License-Identifier: Apache-2.0
"""
Multiprecision numbers, `mpfr` and `mpc` of gmpy2, and the roots of a cubic in them.

L. Fousse et al., "MPFR: A multiple-precision binary floating-point library with correct rounding",
ACM Trans. Math. Softw. 33 (2007), 13.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import gmpy2
from gmpy2 import get_context, mpfr, sqrt

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
