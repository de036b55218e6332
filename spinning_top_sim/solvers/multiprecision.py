# SPDX-License-Identifier: Apache-2.0
"""
Multiprecision numbers: `mpfr` and `mpc` of gmpy2.  `precision` sets the precision of results.

L. Fousse et al., "MPFR: A multiple-precision binary floating-point library with correct rounding",
ACM Trans. Math. Softw. 33 (2007), 13.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import gmpy2
from gmpy2 import mpc, mpfr

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


def phase(angle: mpfr) -> mpc:
    """Return exp(i angle)."""
    sine, cosine = gmpy2.sin_cos(angle)
    return cosine + IMAGINARY * sine


def double_double(x: mpfr) -> tuple[float, float]:
    """Return the nearest double, and the nearest double to what it leaves out."""
    high = float(x)
    return high, float(x - high)
