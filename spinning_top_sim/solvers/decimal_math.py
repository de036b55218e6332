# SPDX-License-Identifier: Apache-2.0
"""
Elementary functions of `decimal.Decimal` numbers, to the precision of the current context.

The standard library has sqrt, exp and ln only.  Results are accurate relative to themselves, also
for small arguments; `sin_cos` loses the digits that cancel next to other multiples of pi/2.
"""

import math
from contextlib import AbstractContextManager
from decimal import Context, Decimal, getcontext, localcontext
from functools import lru_cache

ZERO, ONE = Decimal(0), Decimal(1)
HALVINGS = 5
SMALL = Decimal('1e-9')


def precision(digits: int) -> AbstractContextManager[Context]:
    """Return a context manager that sets the digits, and room for any exponent."""
    return localcontext(Context(prec=digits, Emin=-10 ** 12, Emax=10 ** 12))


def pi() -> Decimal:
    """Return pi to the current precision."""
    return +_pi(getcontext().prec)


@lru_cache
def _pi(digits: int) -> Decimal:
    """Return pi from the arithmetic-geometric mean, by Gauss and Legendre [DLMF 19.8.6]."""
    with precision(digits + 10):
        a, b, t, power = ONE, 1 / Decimal(2).sqrt(), ONE / 4, 1
        while abs(a - b) > Decimal(10) ** -digits:
            a, b, t, power = (a + b) / 2, (a * b).sqrt(), t - power * ((a - b) / 2) ** 2, 2 * power
        return (a + b) ** 2 / (4 * t)


def sin_cos(x: Decimal) -> tuple[Decimal, Decimal]:
    """Return sin x and cos x: the power series of a part of x, then angles are doubled."""
    quarter_turn = pi() / 2
    quarters = (x / quarter_turn).to_integral_value()
    part = (x - quarters * quarter_turn) / 2 ** HALVINGS
    square = part * part
    s = term = part
    n = 1
    while term and term.adjusted() >= s.adjusted() - getcontext().prec:
        n += 2
        term = -term * square / (n * (n - 1))
        s += term
    c = (1 - s * s).sqrt()
    for _ in range(HALVINGS):
        s, c = 2 * s * c, 1 - 2 * s * s
    return [(s, c), (c, -s), (-s, -c), (-c, s)][int(quarters) % 4]


def atan2(y: Decimal, x: Decimal) -> Decimal:
    """Return the argument of x + iy, to 80 digits at most; 0 at the origin."""
    size = max(abs(x), abs(y))
    if not size:
        return ZERO
    y, x = y / size, x / size
    guess = Decimal(math.atan2(y, x))
    s, c = sin_cos(guess)
    rest = (y * c - x * s) / (x * c + y * s)    # tangent of the angle that is left, about 1e-16
    return guess + rest - rest ** 3 / 3 + rest ** 5 / 5


def asinh(x: Decimal) -> Decimal:
    """Return the inverse of sinh for x >= 0, to 30 digits of 40."""
    return x - x ** 3 / 6 if x < SMALL else (x + (x * x + 1).sqrt()).ln()


def half_turns(radians: float) -> Decimal:
    """Return half an angle of any size in turns, less whole turns: in [-1/2, 1/2]."""
    exact = Decimal(radians)
    with localcontext(prec=getcontext().prec + max(0, exact.adjusted())):
        rest = (exact / (4 * pi())).remainder_near(ONE)
    return +rest


def double_double(x: Decimal) -> tuple[float, float]:
    """Return the nearest double, and the nearest double to what it leaves out."""
    high = float(x)
    return high, float(x - Decimal(high))
