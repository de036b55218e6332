# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in theta functions: what is computed once for a motion, in multiprecision.

The solution is Klein's: F. Klein, A. Sommerfeld, *Ueber die Theorie des Kreisels*, ch. VI;
E. T. Whittaker, *Analytical Dynamics*, 4th ed., sect. 71 and 72.  docs/theta_functions.md derives
it, with r+- for r - s pi w/(2K).

The last four lines of the symbols are of alpha; beta has its own.

    u, u1, u2, u3   cos(theta), and the zeros of its cubic: u1 <= u <= u2 <= 1 <= u3
    chi, w          argument of the elliptic functions, and its constant rate
    m, m1           their parameter (u2 - u1)/(u3 - u1), and 1 - m
    K, K'           the quarter periods K(m) and K(m1)
    N, y            the integer nearest to chi/K, and (pi/2) (chi/K - N)
    s               the sign of Lz + L3; beta: of Lz - L3
    a               the place of its zero; beta: b
    X, R, J, D      numerator R + i s J and denominator of its quotient of theta functions
    r, c, kappa     its phase is r t + c + kappa y besides that of X; r is a mean rate

    u = u1 + (u2 - u1) sn^2(chi),  w^2 = M g R (u3 - u1)/(2 lambda1)    [DLMF 22.13(i)]
    alpha = X(y)/D(y) exp i(r t + c + kappa y),  beta likewise

D is theta4(y) at even N (u near u1) and theta3(y) at odd N (u near u2).  X is i s theta1(y - isa)
at even and theta2(y - isa) at odd N for alpha; for beta, with b for a, it is the other way round
[DLMF 20.2(i), 20.2(iii)].  X turns by a quarter turn from one N to the next, which r t contains
already: kappa = -s takes it out again.  The imaginary form has kappa = s (2 K a/(pi K') - 1)
[DLMF 20.7(viii)].  If s = 0 the axis passes a pole exactly: X is real and changes its sign.  If
Lz = L3 and u3 = 1, beta has no zero: it is proportional to dn(chi), with theta4 and theta3 as X.

Everything that cancels, cancels here: next to a pole, to the separatrix, to steady precession.  So
there are 57 digits, and more if two roots are close; some 40 are left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from gmpy2 import const_pi, mpc, mpfr, rint, sin_cos, sinh, sqrt
from gmpy2 import sign as sign_of

from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers import theta
from spinning_top_sim.solvers.theta import BITS, ONE, ZERO, ThetaForm, atan2
from spinning_top_sim.solvers.vertical import Posture

BITS_TO_TRY = BITS, 2 * BITS, 4 * BITS, 8 * BITS
# Smaller amplitudes leave no room for their squares in doubles.
LEAST_AMPLITUDE = 1e-145
with theta.precision():
    NO_GRAVITY = mpfr('1e-1000')    # so small that u3 is infinite to all bits


class Factor(NamedTuple):
    """Alpha or beta, (R + i s J)/D exp i(r t + c + kappa y)."""

    pole_rate: mpfr                 # (Lz +- L3)/(2 lambda1) [rad/s]; its sign is s
    rate: mpfr                      # r [rad/s]
    phase: mpfr                     # c [rad]
    # R and s J at even and at odd N.  If X changes its sign at a pole, R is a sine series at one
    # of them, and lacks the factor (-1)^floor(N/2).
    parts: tuple[theta.Parts, theta.Parts]
    drift: mpfr = ZERO              # kappa
    start_argument: mpfr = ZERO     # of X exp(i kappa y) at t = 0 [rad]


class TurningPoint(NamedTuple):
    """The turning point at even N, where u = u1, or at odd N, where u = u2."""

    tilt: float                     # theta in [0, pi] [rad]
    # Nearby, (Lz - L3 u)/lambda1 is momentum_rate + swing theta1(y)^2/D^2, and u' is
    # u_dot theta1(2y)/D^4 [rad/s]
    momentum_rate: mpfr
    swing: mpfr = ZERO
    u_dot: mpfr = ZERO


class ThetaMotion(NamedTuple):
    """A motion in theta functions; one with constant theta has the defaults."""

    alpha: Factor
    beta: Factor
    turning: tuple[TurningPoint, TurningPoint]
    theta1: theta.Series = theta.NOTHING
    stretch: mpfr = ZERO            # K/K' if the series are in the imaginary form, else 0
    quarter_rate: mpfr = ZERO       # quarter periods per second, w/K
    start_whole: int = 0            # N at t = 0
    start_offset: mpfr = ZERO       # 2y/pi at t = 0, accurate relative to itself
    m1: mpfr = ONE
    size: int = theta.MOST_TERMS    # coefficients of each polynomial that doubles need

    def at(self, t: mpfr) -> tuple[mpc, mpc, mpc]:
        """Return alpha, beta and omega_1 + i omega_2 at t [s], in multiprecision."""
        quarters = self.start_whole + self.start_offset + self.quarter_rate * t
        whole = int(rint(quarters))
        y = const_pi() / 2 * (
            (self.start_whole - whole) + self.quarter_rate * t + self.start_offset)
        point, twice = (
            theta.point(sinh(self.stretch * angle) if self.stretch else sin_cos(angle)[0],
                        bool(self.stretch)) for angle in (y, 2 * y))

        def times_d(factor: Factor) -> mpc:
            real, imag = (part.at(point) for part in factor.parts[whole % 2])
            if whole & 2 and any(one.prefactor == theta.SIN_ODD for one, _ in factor.parts):
                real = -real
            sin, cos = sin_cos(factor.rate * t + factor.phase + factor.drift * y)
            return (real + 1j * imag) * (cos + 1j * sin)

        alpha, beta = times_d(self.alpha), times_d(self.beta)
        alpha2, beta2 = abs(alpha) ** 2, abs(beta) ** 2
        d2, product = alpha2 + beta2, alpha * beta.conjugate()
        # -((Lz - L3 u)/lambda1 + i u')/(2 alpha conj(beta)); 0 where the axis rests at a pole
        # (`abs`, as a zero mpc is true)
        u_dot = self.turning[whole % 2].u_dot * self.theta1.at(twice) / d2
        momentum = self.alpha.pole_rate * beta2 + self.beta.pole_rate * alpha2
        transverse = -(momentum + 0.5j * u_dot) / product if abs(product) else mpc(0)
        return alpha / sqrt(d2), beta / sqrt(d2), transverse


def set_up(top: Top, start: State | Posture, gravity: mpfr | None = None) -> ThetaMotion:
    """
    Return alpha and beta of the motion through `start` at t = 0, for the numbers as they are.

    gravity : in multiprecision, instead of that of the top

    Raises ValueError if none of BITS_TO_TRY tell the roots of the cubic apart.  They are never
    equal: on the separatrix, or in steady precession with theta' != 0, cos(theta0) would be
    algebraic, and no double but 0 has an algebraic cosine.  And if alpha or beta is too small.
    """
    for tried in BITS_TO_TRY:
        with theta.precision(tried), suppress(theta.DigitsLostError):
            return _set_up(top, mpfr(top.gravity) if gravity is None else gravity, start)
    raise ValueError(f'{top} from {start}: closer to the separatrix or to steady precession than '
                     f'{BITS_TO_TRY[-1]} bits can tell')


class _Side(NamedTuple):
    """
    Alpha or beta at the start.

    It is 0 where the axis passes its pole: x = 1 + u of alpha, x = 1 - u of beta.
    """

    pole_rate: mpfr         # (Lz + L3)/(2 lambda1) or (Lz - L3)/(2 lambda1) [rad/s]
    half_spin: mpfr         # +- L3 (1/lambda3 - 1/lambda1)/2 [rad/s]
    argument: mpfr          # [rad]
    modulus: mpfr
    slope: mpfr             # twice the derivative of the modulus

    def rate(self, x: mpfr) -> mpfr:
        """Return that of the argument [rad/s]."""
        return self.half_spin + self.pole_rate / x if self.pole_rate else self.half_spin


def _set_up(top: Top, gravity: mpfr, start: State | Posture) -> ThetaMotion:
    torque = mpfr(top.mass) * gravity * mpfr(top.com_distance)
    lambda1, lambda3 = mpfr(top.lambda1), mpfr(top.lambda3)
    posture = Posture.of(top, start, mpfr, sin_cos)
    sin_half, cos_half, theta_dot, lz, alpha, beta = posture.polar(top)
    l3 = mpfr(posture.l3)
    half_spin = l3 * (1 / lambda3 - 1 / lambda1) / 2
    arguments = [atan2(z.imag, z.real) for z in (alpha, beta)]
    sides = (
        _Side((lz + l3) / (2 * lambda1), half_spin, arguments[0], cos_half, -sin_half * theta_dot),
        _Side((lz - l3) / (2 * lambda1), -half_spin, arguments[1], sin_half, cos_half * theta_dot))
    f0, f1, f2, f3 = nutation_cubic(lambda1, torque, l3, lz, theta_dot, sin_half, cos_half)
    if not f0 and not f1:
        return _resting(*sides)
    # theta -> pi - theta leaves M g R >= 0, and exchanges alpha and beta.
    mirror = -1 if torque < 0 else 1
    return _nutating(sides, (f0, mirror * f1, f2, mirror * f3 or NO_GRAVITY * abs(f2)), mirror,
                     falling=mirror * theta_dot > 0)


def _resting(*sides: _Side) -> ThetaMotion:
    """Return the motion with constant theta: alpha = cos(theta/2) exp i(r t + c)."""
    x = [2 * side.modulus ** 2 for side in sides]
    alpha, beta = (
        Factor(side.pole_rate, side.rate(one), side.argument, (parts, parts))
        for side, one in zip(sides, x, strict=True)
        for parts in [(theta.Series(theta.COS_EVEN, [side.modulus]), theta.NOTHING)])
    turning = _turning_point(sides, x)
    return ThetaMotion(alpha, beta, (turning, turning))


def _turning_point(sides: Sequence[_Side], x: Sequence[mpfr], swing: mpfr = ZERO,
                   u_dot: mpfr = ZERO) -> TurningPoint:
    """Return the turning point with this 1 + u and 1 - u."""
    (alpha, beta), (plus, minus) = sides, x
    return TurningPoint(2.0 * math.atan2(sqrt(minus), sqrt(plus)),
                        alpha.pole_rate * minus + beta.pole_rate * plus, swing, u_dot)


def _nutating(sides: Sequence[_Side], cubic: tuple[mpfr, mpfr, mpfr, mpfr], mirror: int, *,
              falling: bool) -> ThetaMotion:
    """Return a motion; the cubic is its own, with M g R >= 0, or that of its mirror image (-1)."""
    roots, f3, mirrored = theta.cubic_roots(*cubic), cubic[3], sides[::mirror]
    form = ThetaForm(roots, sqrt(f3), falling=falling)
    poles = _poles(mirrored, roots, f3)
    alpha, beta = [_quotient(form, side, pole, is_beta) for side, pole, is_beta in zip(
        mirrored, poles, (False, True), strict=True)][::mirror]
    turn = mirrored[1].pole_rate - mirrored[0].pole_rate        # -L3/lambda1
    even, odd = (
        _turning_point(sides, [abs(pole[k]) for pole in poles][::mirror], turn * rise,
                       rise * middle ** 2 * form.slope1 * mirror * form.x_rate)
        for k, middle, rise in zip((0, 1), (form.middle4, form.middle3), form.rises, strict=True))
    return ThetaMotion(
        alpha, beta, (even, odd), form.theta1, form.stretch, 2 * form.y_rate / const_pi(),
        form.start_whole, 2 * form.y0 / const_pi(), roots.gap32 / roots.gap31, form.size)


def _poles(pair: Sequence[_Side], roots: theta.Roots, f3: mpfr) -> tuple[theta.Place, theta.Place]:
    """
    Return the places of the pole of either number, at u = -1 and u = 1.

    Nothing cancels: u'^2 at u = -1 and u = 1 is -((Lz +- L3)/lambda1)^2.  So the product of
    three distances is known, and the smallest of them needs no difference.
    """
    alpha, beta = pair
    c0, s0 = 2 * alpha.modulus ** 2, 2 * beta.modulus ** 2          # 1 + u0 and 1 - u0
    below1, above2, above3 = s0 - roots.y1, c0 + roots.y2, c0 + roots.y3
    above1 = 4 * alpha.pole_rate ** 2 / (f3 * above2 * above3)
    below2, u3_minus_one = s0 - roots.y2, roots.y3 - s0
    product = 4 * beta.pole_rate ** 2 / (f3 * below1)
    if below2 <= u3_minus_one:
        below2 = product / u3_minus_one
    else:
        u3_minus_one = product / below2
    return (-above1, above2, above3), (below1, -below2, u3_minus_one)


def _quotient(form: ThetaForm, side: _Side, pole: theta.Place, is_beta: bool) -> Factor:
    """Return alpha or beta as a quotient of theta functions."""
    sense, drift, to_pole = sign_of(side.pole_rate), ZERO, max(abs(pole[0]), abs(pole[1]))
    rate, scale = side.half_spin, sqrt(to_pole / 2)
    if 0 < scale < LEAST_AMPLITUDE:
        raise ValueError(f'the amplitude of the motion is {float(scale):.3e}: the start is too '
                         f'close to rest at a pole; must be 0 or at least {LEAST_AMPLITUDE}')
    if sense:
        amplitude = form.amplitude(is_beta, *pole)
        first, second = form.shifted(amplitude, sense)
        drift = -sense * ONE
        if form.stretch:
            drift += sense * 2 / const_pi() * atan2(amplitude, sqrt(1 - amplitude * amplitude))
        rate = (side.rate(to_pole) - drift * form.y_rate
                - second[1].leading / second[0].leading * form.x_rate)
    elif pole[2]:
        first = form.theta1.scaled(-ONE if is_beta else ONE), theta.NOTHING
        second = form.theta2, theta.NOTHING
    else:                       # proportional to dn
        first, second = (form.theta4, theta.NOTHING), (form.theta3, theta.NOTHING)
    # alpha is largest at u2, where N is odd, and beta at u1: both at the centre of theta2.
    scale *= (form.middle4 if is_beta else form.middle3) / second[0].leading
    at_even, at_odd = (second, first) if is_beta else (first, second)
    here, argument = (at_odd if form.start_whole % 2 else at_even), drift * form.y0
    if sense:
        real, imag = (part.at(form.start) for part in here)
        argument += atan2(imag, real)
    elif pole[2]:
        # The sign is that of cos(theta0/2) or sin(theta0/2), which are not negative.  Where they
        # vanish they leave 0 with the slope.
        flip = 1 if form.start_whole % 4 < 2 else -1
        if flip * (here[0].at(form.start) or here[0].leading * side.slope) < 0:
            scale = -scale
    even, odd = ((real.scaled(x), imag.scaled(x)) for (real, imag), x in (
        (at_even, scale), (at_odd, scale * form.odd_over_even if is_beta else scale)))
    return Factor(side.pole_rate, rate, side.argument - argument, (even, odd), drift, argument)
