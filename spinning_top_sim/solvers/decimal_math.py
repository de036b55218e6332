# SPDX-License-Identifier: Apache-2.0
"""
Elementary and elliptic functions of `decimal.Decimal` numbers.

Every function works to the precision of the current `decimal` context, `atan2` to 110 digits at
most.  Results are accurate relative to themselves, also for small arguments; next to other
multiples of pi/2, `sin_cos` loses the digits that cancel.  The standard library offers sqrt, exp
and ln; the rest is here.  DLMF is the Digital Library of Mathematical Functions,
https://dlmf.nist.gov.
"""

import math
from contextlib import AbstractContextManager
from decimal import Context, Decimal, getcontext, localcontext
from functools import lru_cache

ZERO, ONE = Decimal(0), Decimal(1)
HALVINGS = 8


def precision(digits: int) -> AbstractContextManager[Context]:
    """Return a context manager: so many digits, and room for any exponent, whatever was set."""
    return localcontext(Context(prec=digits, Emin=-10 ** 12, Emax=10 ** 12))


def pi() -> Decimal:
    """Return pi to the current precision."""
    return +_pi(getcontext().prec)


@lru_cache
def _pi(digits: int) -> Decimal:
    """Gauss and Legendre: pi from the arithmetic-geometric mean."""
    with precision(digits + 10):
        a, b, t, power = ONE, 1 / Decimal(2).sqrt(), ONE / 4, 1
        while abs(a - b) > Decimal(10) ** -digits:
            a, b, t, power = (a + b) / 2, (a * b).sqrt(), t - power * ((a - b) / 2) ** 2, 2 * power
        return (a + b) ** 2 / (4 * t)


def _odd_power_series(x: Decimal, sense: int) -> Decimal:
    """Return sum_k sense^k x^(2k+1)/(2k+1)!: sin x (sense -1) or sinh x (+1), of a small x."""
    square = sense * x * x
    total = term = x
    n = 1
    while term and term.adjusted() >= total.adjusted() - getcontext().prec:
        term = term * square / ((n + 1) * (n + 2))
        n += 2
        total += term
    return total


def sin_cos(x: Decimal) -> tuple[Decimal, Decimal]:
    """Reduce to an eighth of a turn, halve the angle, sum the power series, double it again."""
    quarter_turn = pi() / 2
    quarters = (x / quarter_turn).to_integral_value()
    s = _odd_power_series((x - quarters * quarter_turn) / 2 ** HALVINGS, -1)
    c = (1 - s * s).sqrt()
    for _ in range(HALVINGS):
        s, c = 2 * s * c, 1 - 2 * s * s
    return [(s, c), (c, -s), (-s, -c), (-c, s)][int(quarters) % 4]


def sinh_cosh(x: Decimal) -> tuple[Decimal, Decimal]:
    """Return sinh x and cosh x."""
    if abs(x) < Decimal('0.1'):         # here exp(x) - exp(-x) would cancel
        s = _odd_power_series(x, 1)
        return s, (1 + s * s).sqrt()
    e = x.exp()
    return (e - 1 / e) / 2, (e + 1 / e) / 2


def atan2(y: Decimal, x: Decimal) -> Decimal:
    """Turn back by the angle in doubles; a short series of the small angle left is enough."""
    radius = (x * x + y * y).sqrt()
    if not radius:
        return ZERO
    y, x = y / radius, x / radius
    guess = Decimal(math.atan2(y, x))
    s, c = sin_cos(guess)
    rest = y * c - x * s                # sin of the rest, about 1e-16
    return guess + rest + rest ** 3 / 6 + 3 * rest ** 5 / 40


def carlson_rf(x: Decimal, y: Decimal, z: Decimal) -> Decimal:
    """Carlson's integral R_F by duplication, then the series in e2, e3 [DLMF 19.36.1]."""
    mean = (x + y + z) / 3
    dx, dy = mean - x, mean - y
    spread = max(abs(dx), abs(dy), abs(mean - z))
    scale = 1
    tolerance = Decimal(10) ** (-getcontext().prec // 8)    # the series leaves out order 8
    while spread > abs(mean) * scale * tolerance:
        root_x, root_y, root_z = x.sqrt(), y.sqrt(), z.sqrt()
        shift = root_x * root_y + root_y * root_z + root_z * root_x
        x, y, z = (x + shift) / 4, (y + shift) / 4, (z + shift) / 4
        mean = (mean + shift) / 4
        scale *= 4
    X, Y = dx / (mean * scale), dy / (mean * scale)
    Z = -X - Y
    e2, e3 = X * Y - Z * Z, X * Y * Z
    return (1 - e2 / 10 + e3 / 14 + e2 ** 2 / 24 - 3 * e2 * e3 / 44 - 5 * e2 ** 3 / 208
            + 3 * e3 ** 2 / 104 + e2 ** 2 * e3 / 16) / mean.sqrt()


def reduced_turns(radians: Decimal) -> Decimal:
    """Return an angle of any size in turns, less its whole turns: in [-1/2, 1/2]."""
    with localcontext(prec=getcontext().prec + max(0, radians.adjusted())):
        rest = (radians / (2 * pi())).remainder_near(ONE)
    return +rest


def double_double(x: Decimal) -> tuple[float, float]:
    """Split into the nearest double and the nearest double to the rest."""
    high = float(x)
    return high, float(x - Decimal(high))
