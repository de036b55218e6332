# SPDX-License-Identifier: Apache-2.0
"""
The theta functions of a motion to 38 digits, for states that are handed over.

`theta_series` stops at 1e-19, which is enough for doubles.  A state that is handed over hundreds
of times needs more: motions between changes of the vertical can be chaotic, and every error grows.
"""

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import zip_longest

from spinning_top_sim.solvers.decimal_math import ONE, ZERO, pi
from spinning_top_sim.solvers.elliptic import GaussMean
from spinning_top_sim.solvers.theta_series import (
    COS_EVEN,
    COS_ODD,
    MULTIPLE_ANGLES,
    SIN_EVEN,
    SIN_ODD,
    Parts,
    Series,
    ThetaForm,
)
from spinning_top_sim.solvers.theta_setup import Factor, ThetaMotion

MOST_TERMS = 6
# A term k is at most the square root of q^(2k^2 - k) beside the first one.
LEAST_SQUARE = Decimal('1e-78')
# What doubles do not notice, relative to the first term of a polynomial.
NEGLIGIBLE = Decimal('1e-21')


class LongForm(ThetaForm):
    """`ThetaForm` with as many terms as 38 digits need."""

    def __init__(self, mean: GaussMean, imaginary: bool) -> None:
        self.mean, self.imaginary = mean, imaginary
        # q = exp(-pi K'/K), where a quarter period is (pi/2) a over the mean.
        (a, g), *_ = mean._means
        q = (-pi() * mean.mean / GaussMean(a, mean._c[0], g).mean).exp()
        terms = next((k for k in range(2, MOST_TERMS) if q ** (2 * k * k - k) < LEAST_SQUARE),
                     MOST_TERMS)
        self._even = [ONE, *(2 * q ** (k * k) for k in range(1, terms))]
        self._odd = [q ** (k * (k + 1)) for k in range(terms)]
        self.theta1 = _series(SIN_ODD, self._odd, alternate=True)
        self.theta2 = _series(COS_ODD, self._odd)
        self.theta3 = _series(COS_EVEN, self._even)
        self.theta4 = _series(COS_EVEN, self._even, alternate=True)
        if imaginary:
            self.theta2, self.theta4 = self.theta4, self.theta2
        self.odd_over_even = 4 * q.sqrt() if imaginary else ONE

    def shifted(self, amplitude: Decimal, sense: int) -> tuple[Parts, Parts]:
        sines, cosines = self._multiples(amplitude)
        odd, even = self._odd, self._even
        theta1 = (_series(COS_ODD, odd, sines[1::2], alternate=True),
                  _series(SIN_ODD, odd, cosines[1::2], alternate=True).scaled(Decimal(sense)))
        if self.imaginary:
            return theta1, (
                _series(COS_EVEN, even, cosines[::2], alternate=True),
                _series(SIN_EVEN, even, sines[::2], alternate=True).scaled(Decimal(-sense)))
        return theta1, (_series(COS_ODD, odd, cosines[1::2]),
                        _series(SIN_ODD, odd, sines[1::2]).scaled(Decimal(sense)))


def _shapes(prefactor: int) -> list[list[int]]:
    """Return more of MULTIPLE_ANGLES: f(n + 2) = (2 - 4 xi) f(n) - f(n - 2)."""
    rows = [list(row) for row in MULTIPLE_ANGLES[prefactor][:2]]
    while len(rows) < MOST_TERMS:
        rows.append([2 * a - 4 * b - c for a, b, c in zip_longest(
            rows[-1], [0, *rows[-1]], rows[-2], fillvalue=0)])
    return rows


SHAPES = [_shapes(prefactor) for prefactor in range(4)]


def _series(prefactor: int, terms: Sequence[Decimal], factors: Sequence[Decimal] = (), *,
            alternate: bool = False) -> Series:
    """Return the sum of terms[k] factors[k] cos(n y) or sin(n y), with alternating signs."""
    polynomial = [ZERO] * (MOST_TERMS + 1)
    for k, term in enumerate(terms):
        weight = term * factors[k] if factors else term
        for power, coefficient in enumerate(SHAPES[prefactor][k]):
            polynomial[power] += (-weight if alternate and k % 2 else weight) * coefficient
    return Series(prefactor, tuple(polynomial))


def short(motion: ThetaMotion) -> ThetaMotion:
    """Return a motion with as many coefficients as doubles need."""
    largest = Decimal('0.5')        # |xi| at |y| = pi/4
    if motion.stretch:
        x = motion.stretch * pi() / 4
        largest = ((x.exp() - (-x).exp()) / 2) ** 2
    alpha, beta = (_short_factor(factor, largest) for factor in (motion.alpha, motion.beta))
    # The series of u' takes 2 y.
    return replace(motion, alpha=alpha, beta=beta, u_dot_series=_short_series(
        motion.u_dot_series, 4 * largest * (1 + largest)))


def _short_factor(factor: Factor, largest: Decimal) -> Factor:
    even, odd = ((_short_series(real, largest), _short_series(imag, largest))
                 for real, imag in factor.parts)
    return replace(factor, parts=(even, odd))


def _short_series(series: Series, largest: Decimal) -> Series:
    first, *rest = series.polynomial
    while rest and abs(rest[-1]) * largest ** len(rest) <= NEGLIGIBLE * abs(first):
        rest.pop()
    return Series(series.prefactor, (first, *rest))
