# SPDX-License-Identifier: Apache-2.0
"""
Jacobi's theta functions as short series, in long decimals.

theta1..theta4 of y in the real form, with nome q = exp(-pi K'/K) [DLMF 20.2], or in the imaginary
form, after Jacobi's transformation, with nome q' = exp(-pi K/K') and hyperbolic functions of
x = y K/K' [DLMF 20.7(viii)].  The smaller nome is at most exp(-pi): four terms reach 1e-21.
Each series is a prefactor times a polynomial in sin^2 y, which is what is evaluated in doubles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from decimal import Decimal, getcontext
from itertools import count, zip_longest

from spinning_top_sim.solvers.decimal_math import ONE, ZERO, carlson_rf, pi, sin_cos, sinh_cosh

TERMS = 4               # the nome is <= exp(-pi): the fifth term is below 1e-21
NEGLIGIBLE = Decimal('1e-19')   # beside 1; ends the series of a form with a larger nome


@dataclass(frozen=True)
class Series:
    """
    A sum of weights[k] times cos or sin of n y, n = 1, 3, 5... or 0, 2, 4...

    In the imaginary form y stands for ix: cosh for cos, sinh for sin.
    """

    kind: str
    weights: tuple[Decimal, ...]

    @property
    def prefactor(self) -> int:
        """Index of what the terms have in common in (1, cos y, sin y, sin y cos y)."""
        return ('cos even', 'cos odd', 'sin odd', 'sin even').index(self.kind)

    def polynomial(self) -> list[Decimal]:
        """Return c[i] with sum = prefactor * sum_i c[i] xi^i, xi = sin^2 y (or -sinh^2 x)."""
        total = [ZERO] * len(self.weights)
        for weight, shape in zip(self.weights, _multiple_angles(self.kind), strict=False):
            for i, coefficient in enumerate(shape):
                if coefficient:         # 'sin even' has one coefficient more than its degree
                    total[i] += weight * coefficient
        return total

    @property
    def at_zero(self) -> Decimal:
        """The value of a cosine series at y = 0."""
        return sum(self.weights, ZERO)

    @property
    def multiples(self) -> range:
        """The n of the terms."""
        return range(self.kind.endswith('odd'), 2 * len(self.weights), 2)

    @property
    def slope_at_zero(self) -> Decimal:
        """The derivative of a sine series at y = 0."""
        return sum((n * x for n, x in zip(self.multiples, self.weights, strict=True)), ZERO)

    def __call__(self, sin: Decimal, cos: Decimal, xi: Decimal) -> Decimal:
        """Return the sum at the y of these sine and cosine."""
        value = ZERO
        for coefficient in reversed(self.polynomial()):
            value = value * xi + coefficient
        return value * (ONE, cos, sin, sin * cos)[self.prefactor]

    def scaled(self, scale: Decimal) -> Series:
        return Series(self.kind, tuple(scale * weight for weight in self.weights))


def _multiple_angles(kind: str) -> Iterator[list[int]]:
    """Yield cos n y or sin n y, less the common prefactor, as polynomials in xi = sin^2 y."""
    # f(n+2) = (2 - 4 xi) f(n) - f(n-2) [DLMF 4.21(iii)].
    before, now = {'cos odd': ([1], [1]), 'sin odd': ([-1], [1]),
                   'cos even': ([1, -2], [1]), 'sin even': ([-2], [0])}[kind]
    while True:
        yield now
        before, now = now, [2 * x - 4 * lower - y for x, lower, y in
                            zip_longest(now, [0, *now], before, fillvalue=0)]


def _alternating(weights: Iterable[Decimal]) -> tuple[Decimal, ...]:
    return tuple(-x if k % 2 else x for k, x in enumerate(weights))


@dataclass(frozen=True)
class ThetaForm:
    """
    The theta series in the real or in the imaginary form.

    Positive constants that all series of a Cayley-Klein parameter share are left out.
    """

    K: Decimal
    K_prime: Decimal
    imaginary: bool
    nome: Decimal
    terms: int = TERMS

    @classmethod
    def of(cls, m: Decimal, m1: Decimal) -> ThetaForm:
        """Choose the form with the smaller nome, at most exp(-pi)."""
        K, K_prime = (carlson_rf(ZERO, x, ONE) for x in (m1, m))         # DLMF 19.25.1
        imaginary = m > m1
        return cls(K, K_prime, imaginary,
                   (-pi() * (K / K_prime if imaginary else K_prime / K)).exp())

    def real(self) -> ThetaForm:
        """Return the real form whatever the nome, with all the terms it takes."""
        nome = (-pi() * self.K_prime / self.K).exp()
        most = next(k for k in count(1) if nome ** (k * k) <= NEGLIGIBLE)
        return ThetaForm(self.K, self.K_prime, False, nome, most + 1)

    @property
    def stretch(self) -> Decimal:
        """What y is multiplied with: x = stretch y in the imaginary form."""
        return self.K / self.K_prime if self.imaginary else ONE

    def point(self, y: Decimal) -> tuple[Decimal, Decimal, Decimal]:
        """Return the arguments of a `Series` at y: sine, cosine and xi."""
        sin, cos = sinh_cosh(self.stretch * y) if self.imaginary else sin_cos(y)
        return sin, cos, -sin * sin if self.imaginary else sin * sin

    def theta(self, number: int) -> Series:
        """Return theta1 .. theta4 of y, less constants [DLMF 20.2(i)], or their transforms."""
        if self.imaginary:
            number = {1: 1, 2: 4, 3: 3, 4: 2}[number]
        kind = {1: 'sin odd', 2: 'cos odd', 3: 'cos even', 4: 'cos even'}[number]
        if number in (1, 2):
            powers = tuple(self.nome ** (k * (k + 1)) for k in range(self.terms))
        else:
            powers = ONE, *(2 * self.nome ** (k * k) for k in range(1, self.terms))
        return Series(kind, _alternating(powers) if number in (1, 4) else powers)

    @property
    def odd_over_even(self) -> Decimal:
        """The transforms of theta1 and theta4 have lost a factor 2 q'^(1/4), of theta2 not."""
        return 4 * self.nome.sqrt() if self.imaginary else ONE

    def slopes_of_sn2(self) -> tuple[Decimal, Decimal]:
        """Return c with d(sn^2 chi)/dchi = 2 sn cn dn = c theta1(2y)/D(y)^4 at even and odd N."""
        # By duplication [DLMF 20.7.10] and the quotients of DLMF 22.2.
        theta2, theta3, theta4 = (self.theta(number).at_zero for number in (2, 3, 4))
        if not self.imaginary:
            even = theta3 * theta4 ** 3 / theta2
            return even, -even
        even = 2 * theta4 ** 4 * self.K_prime / (pi() * self.theta(1).slope_at_zero)
        return even, -16 * self.nome * even

    def shifted(self, a: Decimal) -> tuple[tuple[Series, Series], tuple[Series, Series]]:
        """R and J of i theta1(y - ia), and of theta2(y - ia), less positive constants."""
        if self.imaginary:
            (sines1, cosines1), (sines2, cosines2) = (
                self._turned_weights(number, a) for number in (1, 2))
            return ((Series('cos odd', sines1), Series('sin odd', cosines1)),
                    (Series('cos even', cosines2), Series('sin even', sines2).scaled(-ONE)))
        minus, plus = self._growing_weights(a)
        return ((Series('cos odd', _alternating(minus)), Series('sin odd', _alternating(plus))),
                (Series('cos odd', tuple(plus)), Series('sin odd', tuple(minus))))

    def _turned_weights(self, number: int, a: Decimal) -> tuple[tuple[Decimal, ...], ...]:
        """Return the weights of a transformed theta times sin, and cos, of n pi a/(2K')."""
        series = self.theta(number)
        waves = [sin_cos(n * pi() * a / (2 * self.K_prime)) for n in series.multiples]
        return tuple(tuple(x * wave[k] for x, wave in zip(series.weights, waves, strict=True))
                     for k in (0, 1))

    def _growing_weights(self, a: Decimal) -> tuple[list[Decimal], list[Decimal]]:
        """Return 2 q^(k(k+1)) exp(-A) times sinh, and cosh, of (2k+1) A, with A = pi a/(2K)."""
        # Over exp((2k+1) A) times q^(k^2) g^k with g = q exp(2A) <= 1: no large numbers.
        depth = pi() * a / self.K
        g = (depth - pi() * self.K_prime / self.K).exp()
        sinh, cosh = sinh_cosh(depth / 2)
        sinh2, cosh2 = 2 * sinh * cosh, 1 + 2 * sinh * sinh
        minus, plus = [], []
        for k in range(self.terms):
            growth = 2 * self.nome ** (k * k) * g ** k / (sinh + cosh)
            minus.append(growth * sinh)
            plus.append(growth * cosh)
            sinh, cosh = sinh * cosh2 + cosh * sinh2, cosh * cosh2 + sinh * sinh2
        return minus, plus

    def log_slope(self, a: Decimal) -> Decimal:
        """d/da log theta2(i pi a/(2K)), to full precision: it sets the mean rates."""
        # Every term that reaches the working precision.
        digits_per_square = -self.nome.adjusted() - 1           # at least 1
        form = replace(self, terms=2 + math.isqrt(getcontext().prec // digits_per_square))
        _, (real, imag) = form.shifted(a)
        slope = imag.slope_at_zero / real.at_zero       # Cauchy-Riemann
        if self.imaginary:
            return pi() / (2 * self.K_prime) * (a / self.K + slope)
        return pi() / (2 * self.K) * slope
