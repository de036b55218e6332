# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in theta functions: what is computed once for a motion, in multiprecision.

The solution is Klein's: F. Klein, A. Sommerfeld, *Ueber die Theorie des Kreisels*, ch. VI;
E. T. Whittaker, *Analytical Dynamics*, 4th ed., sect. 71 and 72.  docs/theta_functions.md derives
it, with r+- for r - s pi w/(2K).  DLMF: https://dlmf.nist.gov, ch. 19, 20 and 22.

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

from collections.abc import Sequence
from typing import NamedTuple

from gmpy2 import asinh, const_pi, mpfr, sin_cos, sqrt
from gmpy2 import sign as sign_of

from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers import multiprecision as mp
from spinning_top_sim.solvers.vertical import PreciseState

BITS_TO_TRY = mp.BITS, 2 * mp.BITS, 4 * mp.BITS, 8 * mp.BITS
with mp.precision():
    NO_GRAVITY = mpfr('1e-1000')    # so small that u3 is infinite to all bits


class Factor(NamedTuple):
    """Alpha or beta, (R + i s J)/D exp i(r t + c + kappa y)."""

    rate: mpfr                      # r [rad/s]
    phase_turns: mpfr               # c [turns]
    drift: mpfr                     # kappa
    # R and s J at even and at odd N, less common factors.  If X changes its sign at a pole, R is a
    # sine series at one of them, and has the factor (-1)^floor(N/2).
    parts: tuple[mp.Parts, mp.Parts]
    scales: tuple[mpfr, mpfr]       # these factors
    pole_rate: mpfr                 # (Lz +- L3)/(2 lambda1) [rad/s]; its sign is s
    start_argument: mpfr            # of X exp(i kappa y) at t = 0 [rad]


class ThetaMotion(NamedTuple):
    """A motion in theta functions.  Pairs are at even and at odd N."""

    alpha: Factor
    beta: Factor
    stretch: mpfr | None = None     # K/K' if the series are in the imaginary form, of stretch y
    quarter_rate: mpfr = mp.ZERO    # quarter periods per second, w/K
    start_whole: int = 0            # N at t = 0
    start_offset: mpfr = mp.ZERO       # 2y/pi at t = 0, accurate relative to itself
    u_dot: tuple[mpfr, mpfr] = (mp.ZERO, mp.ZERO)   # c of u' = c theta1(2y)/D^4
    u_dot_series: mp.Series = mp.NOTHING           # theta1
    # p and q of (Lz - L3 u)/lambda1 = p + q theta1(y)^2/D^2
    precession: tuple[mpfr, mpfr] = (mp.ZERO, mp.ZERO)
    swing: tuple[mpfr, mpfr] = (mp.ZERO, mp.ZERO)
    m1: mpfr = mp.ONE
    size: int = mp.MOST_TERMS          # coefficients of each polynomial that doubles need


def precise(start: State | PreciseState) -> PreciseState:
    """Return a state in multiprecision."""
    return (start if isinstance(start, PreciseState)
            else PreciseState.of(start, mpfr, sin_cos))


def set_up(top: Top, start: State | PreciseState, gravity: mpfr | None = None) -> ThetaMotion:
    """
    Return alpha and beta of the motion through `start` at t = 0, for the numbers as they are.

    gravity : in multiprecision, instead of that of the top

    Raises ValueError if none of BITS_TO_TRY tell the roots of the cubic apart.  They are never
    equal: on the separatrix, or in steady precession with theta' != 0, cos(theta0) would be
    algebraic, and no double but 0 has an algebraic cosine.
    """
    for tried in BITS_TO_TRY:
        with mp.precision(tried):
            try:
                return _set_up(top, mpfr(top.gravity) if gravity is None else gravity, start)
            except mp.RootsTooCloseError:
                continue
    raise ValueError(f'{top} from {start}: closer to the separatrix or to steady precession than '
                     f'{BITS_TO_TRY[-1]} bits can tell')


class _Side(NamedTuple):
    """Alpha or beta at the start; momentum is Lz + L3 or Lz - L3, and x 1 + u or 1 - u."""

    momentum: mpfr          # its argument has the rate (spin + momentum/(lambda1 x))/2
    spin: mpfr
    argument: mpfr          # [rad]
    modulus: mpfr
    slope: mpfr             # twice the derivative of the modulus
    # The pole where it vanishes: whether it is the one at u = 1, x at u1 and at u2, and, with
    # c = (2K/pi) a or (2K/pi) b, sn^2(c, m1) in the imaginary form, -sn^2(ic, m) in the real one
    # [DLMF 22.6(iv)], or None if there is no zero
    is_beta: bool = False
    x1: mpfr = mp.ZERO
    x2: mpfr = mp.ZERO
    zero: mpfr | None = None


def _set_up(top: Top, gravity: mpfr, start: State | PreciseState) -> ThetaMotion:
    torque = mpfr(top.mass) * gravity * mpfr(top.com_distance)
    lambda1, lambda3 = mpfr(top.lambda1), mpfr(top.lambda3)
    sin_half, cos_half, theta_dot, alpha, beta, l3, lz = precise(start)
    spin = l3 * (1 / lambda3 - 1 / lambda1)
    arguments = [mp.atan2(z.imag, z.real) for z in (alpha, beta)]
    sides = (_Side(lz + l3, spin, arguments[0], cos_half, -sin_half * theta_dot),
             _Side(lz - l3, -spin, arguments[1], sin_half, cos_half * theta_dot))
    f0, f1, f2, f3 = nutation_cubic(lambda1, torque, l3, lz, theta_dot, sin_half, cos_half)
    if not f0 and not f1:
        return ThetaMotion(_resting(sides[0], lambda1), _resting(sides[1], lambda1))
    # theta -> pi - theta leaves M g R >= 0, and exchanges alpha and beta.
    mirror = -1 if torque < 0 else 1
    return _nutating(
        sides[::mirror], lambda1, mirror, l3, lz - l3 + 2 * l3 * sin_half ** 2,
        (f0, mirror * f1, f2, mirror * f3 or NO_GRAVITY * abs(f2)), falling=mirror * theta_dot > 0)


def _resting(side: _Side, lambda1: mpfr) -> Factor:
    """Return alpha = cos(theta/2) exp i(r t + c), or beta likewise, with constant theta."""
    rate = side.spin / 2
    if side.momentum:
        rate += side.momentum / (4 * lambda1 * side.modulus ** 2)
    parts = mp.Series(mp.COS_EVEN, (mp.ONE,)), mp.NOTHING
    return Factor(rate, side.argument / (2 * const_pi()), mp.ZERO, (parts, parts),
                  (side.modulus, side.modulus), side.momentum / (2 * lambda1), mp.ZERO)


def _nutating(sides: Sequence[_Side], lambda1: mpfr, mirror: int, l3: mpfr,
              precession_momentum: mpfr, cubic: tuple[mpfr, mpfr, mpfr, mpfr], falling: bool,
              ) -> ThetaMotion:
    """
    Return a motion with M g R >= 0, or with mirror = -1 that of which this is the mirror image.

    precession_momentum : Lz - L3 u at the start of the motion itself
    """
    roots, f3 = mp.cubic_roots(*cubic), cubic[3]
    imaginary = roots.gap21 > roots.gap32
    a, g, c = sqrt(roots.gap31), sqrt(roots.gap32), sqrt(roots.gap21)
    mean = mp.GaussMean(a, g, c)
    form = mp.ThetaForm(mp.GaussMean(a, c, g) if imaginary else mean, imaginary)
    start_whole, direction, square = _nearest_quarter(roots, g / a, falling, imaginary)
    stretch = form.mean.mean / mean.mean if imaginary else None
    sin = form.mean.amplitude(square, 1 if imaginary else -1)
    xi = -sin * sin if imaginary else sin * sin
    cos = sqrt(1 - xi)
    y0 = direction * (asinh(sin) / stretch if stretch else mp.atan2(sin, cos))
    root_f3 = sqrt(f3)
    # w = sqrt(f3 (u3 - u1))/2 and K = (pi/2) sqrt(u3 - u1)/M
    y_rate = root_f3 * mean.mean / 2
    factors = [_quotient(form, side, lambda1, y_rate * (stretch or 1), y_rate, start_whole, y0,
                         (direction * sin, cos, xi))
               for side in _with_poles(sides, roots, lambda1 ** 2 * f3, imaginary)]
    swing_rate = root_f3 * (mirror * a / 2 * roots.gap21)       # w (u2 - u1)
    even, odd = form.slopes_of_sn2()
    turn = mirror * l3 / lambda1
    swing = turn * roots.gap21 * (form.mean.quarter_period / form.slope1) ** 2
    alpha, beta = factors[::mirror]
    return ThetaMotion(
        alpha, beta, stretch=stretch, quarter_rate=2 * y_rate / const_pi(),
        start_whole=start_whole, start_offset=y0 * 2 / const_pi(),
        u_dot=(swing_rate * even, swing_rate * odd), u_dot_series=form.theta1,
        precession=(precession_momentum / lambda1 - turn * roots.y1,
                    precession_momentum / lambda1 - turn * roots.y2),
        swing=(-swing * form.middle4 ** 2,
               swing * form.middle3 ** 2 * roots.gap32 / roots.gap31),
        m1=roots.gap32 / roots.gap31, size=form.size)


def _with_poles(sides: Sequence[_Side], roots: mp.Roots, two_p_lambda1: mpfr,
                imaginary: bool) -> tuple[_Side, _Side]:
    """
    Return alpha and beta with their poles.

    Nothing cancels: u'^2 at u = -1 and u = 1 is -((Lz +- L3)/lambda1)^2.  So the product of
    three distances is known, and the smallest of them needs no difference.
    """
    alpha, beta = sides
    c0, s0 = 2 * alpha.modulus ** 2, 2 * beta.modulus ** 2          # 1 + u0 and 1 - u0
    below1, above2 = s0 - roots.y1, c0 + roots.y2
    above1 = alpha.momentum ** 2 / (two_p_lambda1 * above2 * (roots.y3 + c0))
    below2, u3_minus_one = s0 - roots.y2, roots.y3 - s0
    product = beta.momentum ** 2 / (two_p_lambda1 * below1)
    if below2 <= u3_minus_one:
        below2 = product / u3_minus_one
    else:
        u3_minus_one = product / below2
    scale = below1 * roots.gap32 if imaginary else u3_minus_one * roots.gap21
    zero = below2 * roots.gap31 / scale if u3_minus_one else None
    return (alpha._replace(x1=above1, x2=above2,
                           zero=above1 / (above2 if imaginary else roots.gap21)),
            beta._replace(is_beta=True, x1=below1, x2=below2, zero=zero))


def _nearest_quarter(roots: mp.Roots, complement: mpfr, falling: bool,
                     imaginary: bool) -> tuple[int, int, mpfr]:
    """
    Return N at t = 0, the sign of y, and sn^2 or sn^2/cn^2 of the distance of chi from N K.

    The latter, in the imaginary form, is -sn^2 of the distance times i, of the parameter m1
    [DLMF 22.6(iv)].  complement : sqrt(m1)
    """
    sign = -1 if falling else 1
    low, high = -roots.y1, roots.y2         # u0 - u1 and u2 - u0
    # sn^2 = low/gap21, and sn(K - chi) = cn/dn.  They are equal at sn^2 (1 + sqrt(m1)) = 1.
    if low * complement < high:
        return 0, sign, low / (high if imaginary else roots.gap21)
    return (sign, -sign, high * roots.gap31 / (
        low * roots.gap32 if imaginary else roots.gap21 * roots.y3))


def _quotient(form: mp.ThetaForm, side: _Side, lambda1: mpfr, x_rate: mpfr, y_rate: mpfr,
              quarters: int, y: mpfr, point: tuple[mpfr, mpfr, mpfr]) -> Factor:
    """
    Return alpha or beta as a quotient of theta functions.

    x_rate, y_rate : of x and y, the arguments of the imaginary and of the real form [rad/s]
    quarters, y, point : N, y and the arguments of `Series.at` at t = 0
    """
    sense, drift, rate = sign_of(side.momentum), mp.ZERO, side.spin / 2
    farthest, real, imag = max(side.x1, side.x2), mp.ONE, mp.ZERO
    scale = sqrt(farthest / 2)
    starts_in_first = quarters % 2 == side.is_beta       # where X is theta1
    if side.zero is None:           # proportional to dn
        first, second = (form.theta4, mp.NOTHING), (form.theta3, mp.NOTHING)
    elif not sense:
        sign = -1 if side.is_beta else 1
        first = mp.Series(mp.SIN_ODD, [sign * x for x in form.theta1.weights]), mp.NOTHING
        second = form.theta2, mp.NOTHING
        # The sign is that of cos(theta0/2) or sin(theta0/2), which are not negative.  Where they
        # vanish they leave 0 with the slope.
        series, _ = first if starts_in_first else second
        flip = 1 if quarters % 4 < 2 else -1
        if flip * (series.at(*point) or series.leading * side.slope) < 0:
            scale = -scale
    else:
        amplitude = form.mean.amplitude(side.zero, -1 if form.imaginary else 1)
        first, second = form.shifted(amplitude, sense)
        drift = -sense * mp.ONE
        if form.imaginary:
            drift += sense * 2 / const_pi() * mp.atan2(amplitude, sqrt(1 - amplitude * amplitude))
        rate += (side.momentum / (2 * lambda1 * farthest) - drift * y_rate
                 - second[1].leading / second[0].leading * x_rate)
        real, imag = (part.at(*point) for part in (first if starts_in_first else second))
    # alpha is largest at u2, where N is odd, and beta at u1: both at the centre of theta2.
    scale *= (form.middle4 if side.is_beta else form.middle3) / second[0].leading
    parts, scales = (((second, first), (scale, scale * form.odd_over_even)) if side.is_beta
                     else ((first, second), (scale, scale)))
    start_argument = drift * y + mp.atan2(imag, real)
    return Factor(rate, (side.argument - start_argument) / (2 * const_pi()), drift, parts, scales,
                  side.momentum / (2 * lambda1), start_argument)
