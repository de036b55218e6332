# SPDX-License-Identifier: Apache-2.0
"""
Elementary functions of `decimal.Decimal` numbers, to the precision of the current context.

The standard library has exp and ln, and a slow sqrt.  Results are accurate relative to themselves,
also for small arguments; `sin_cos` loses the digits that cancel next to other multiples of pi/2.
"""

import math
from contextlib import AbstractContextManager
from decimal import Context, Decimal, getcontext, localcontext
from functools import lru_cache, reduce

ZERO, ONE = Decimal(0), Decimal(1)
Complex = tuple[Decimal, Decimal]
DIGITS = 40             # that are left of long decimals once nothing cancels any more
SMALL = Decimal('1e-9')
# Parts of a quarter turn whose sines and cosines are tabulated.
PARTS = 64
# Of doubles that are asked for again and again, as those of a top are.
exact = lru_cache(64)(Decimal)


def precision(digits: int) -> AbstractContextManager[Context]:
    """Return a context manager that sets the digits, and room for any exponent."""
    return localcontext(_context(digits))


@lru_cache
def _context(digits: int) -> Context:
    return Context(prec=digits, Emin=-10 ** 12, Emax=10 ** 12)


def root(x: Decimal) -> Decimal:
    """Return the square root of x >= 0."""
    shift = getcontext().prec - x.adjusted() // 2
    return Decimal(math.isqrt(int(x.scaleb(2 * shift)))).scaleb(-shift)


def pi() -> Decimal:
    """Return pi to the current precision."""
    return +_pi(getcontext().prec)


@lru_cache
def _pi(digits: int) -> Decimal:
    """Return pi from the arithmetic-geometric mean, by Gauss and Legendre [DLMF 19.8.6]."""
    with precision(digits + 10):
        a, b, t, power = ONE, 1 / root(Decimal(2)), ONE / 4, 1
        while abs(a - b) > Decimal(10) ** -digits:
            a, b, t, power = (a + b) / 2, root(a * b), t - power * ((a - b) / 2) ** 2, 2 * power
        return (a + b) ** 2 / (4 * t)


@lru_cache
def _tables(digits: int) -> tuple[Decimal, list[tuple[Decimal, Decimal]], list[Decimal],
                                  list[Decimal]]:
    """
    Return what `sin_cos` and `atan2` add angles from.

    The angle of a part, sine and cosine of the multiples below a quarter turn, and the series of
    sin(x)/x and of arctan(x)/x in x^2, which are short up to half of it, the last term first.
    """
    with precision(digits + 10):
        angle = pi() / (2 * PARTS)
        square = angle * angle / 4
        sine, arctan, size = [ONE], [ONE], ONE
        while (size * sine[0]).adjusted() > -digits - 5:
            n, size = 2 * len(sine), size * square
            sine.insert(0, -sine[0] / (n * (n + 1)))
        s = angle / 2 * reduce(lambda total, one: total * square + one, sine)
        s, c = 2 * s * root(1 - s * s), 1 - 2 * s * s
        while (square ** len(arctan)).adjusted() > -digits - 5:
            arctan.insert(0, (-1) ** len(arctan) / Decimal(2 * len(arctan) + 1))
        values = [(ZERO, ONE)]
        while len(values) < PARTS:
            a, b = values[-1]
            values.append((a * c + b * s, b * c - a * s))
    with precision(digits):
        return angle, [(+s, +c) for s, c in values], [+x for x in sine], [+x for x in arctan]


def sin_cos(x: Decimal) -> tuple[Decimal, Decimal]:
    """Return sin x and cos x."""
    angle, values, series, _ = _tables(getcontext().prec)
    count = round(x / angle)
    rest = x - count * angle
    square, total = rest * rest, ZERO
    for coefficient in series:
        total = total * square + coefficient
    s = rest * total
    c = (1 - s * s).sqrt()      # fast next to 1
    quarters, part = divmod(count, PARTS)
    if part:
        a, b = values[part]
        s, c = a * c + b * s, b * c - a * s
    if quarters & 2:
        s, c = -s, -c
    return (c, -s) if quarters & 1 else (s, c)


def atan2(y: Decimal, x: Decimal) -> Decimal:
    """Return the argument of x + iy; 0 at the origin."""
    if abs(y) <= abs(x):
        quarters, y, x = (0, y, x) if x >= 0 else (2 if y >= 0 else -2, -y, -x)
    else:
        quarters, y, x = (1, -x, y) if y > 0 else (-1, x, -y)
    if not x:
        return ZERO
    angle, values, _, series = _tables(getcontext().prec)
    tangent = y / x
    part = round(math.atan(tangent) * 2 * PARTS / math.pi)
    if part:
        s, c = values[abs(part)]
        s = s if part > 0 else -s
        tangent = (tangent * c - s) / (tangent * s + c)     # of the angle that is left
    square, total = tangent * tangent, ZERO
    for coefficient in series:
        total = total * square + coefficient
    return (PARTS * quarters + part) * angle + tangent * total


def asinh(x: Decimal) -> Decimal:
    """Return the inverse of sinh for x >= 0, to 30 digits of 40."""
    return x - x ** 3 / 6 if x < SMALL else (x + root(x * x + 1)).ln()


def half_turns(radians: float) -> Decimal:
    """Return half an angle of any size in turns, less whole turns: in [-1/2, 1/2]."""
    angle = Decimal(radians)
    with localcontext(prec=getcontext().prec + max(0, angle.adjusted())):
        rest = (angle / (4 * pi())).remainder_near(ONE)
    return +rest


def double_double(x: Decimal) -> tuple[float, float]:
    """Return the nearest double, and the nearest double to what it leaves out."""
    high = float(x)
    return high, float(x - Decimal(high))
