# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in theta functions: what is computed once for a motion, in long decimals.

The solution is Klein's.  F. Klein, A. Sommerfeld, *Ueber die Theorie des Kreisels*, ch. VI;
E. T. Whittaker, *Analytical Dynamics*, 4th ed., sect. 71 and 72; theta functions: Whittaker and
Watson, *Modern Analysis*, ch. XXI; D. F. Lawden, *Elliptic Functions and Applications*; DLMF,
https://dlmf.nist.gov, ch. 19, 20 and 22.

1. *Nutation.*  u = cos(theta) obeys u'^2 = (2P/lambda1) (u - u1) (u2 - u) (u3 - u), P = M g R.
   So u = u1 + (u2 - u1) sn^2(chi) [DLMF 22.13(i)], where chi grows at the constant rate w,
   w^2 = P (u3 - u1)/(2 lambda1), with the parameter m = (u2 - u1)/(u3 - u1); m1 = 1 - m.
   K = K(m) and K' = K(m1) are the quarter periods.

2. *Attitude.*  The Cayley-Klein parameters

       alpha = cos(theta/2) exp(i(phi+psi)/2),   beta = sin(theta/2) exp(i(phi-psi)/2)

   have |alpha|^2 = (1 + u)/2 and |beta|^2 = (1 - u)/2.  alpha vanishes where u = -1, at
   chi = ia; beta where u = 1, at chi = K + ib.  Here a and b are real [DLMF 22.6(iv)]:
   -sn^2(ia) = (1 + u1)/(u2 - u1), and b from the same quotient at K.  A quotient of theta
   functions with these zeros and the poles of u differs from alpha or beta by a factor
   exp(constant + constant * t).

3. *Phase.*  Z = chi/K counts quarter periods.  N is the nearest integer and y = (pi/2) (Z - N), so
   |y| <= pi/4.  By step 2, with the signs s of Lz + L3 for alpha and of Lz - L3 for beta,

       alpha = X(y)/D(y) exp i(r t + c + kappa y),   X = R + i s J,   beta likewise.

   D is theta4(y) at even N (u near u1) and theta3(y) at odd N (u near u2).  With A = pi a/(2K),
   X is i s theta1(y - i s A) at even and theta2(y - i s A) at odd N for alpha; for beta, with b
   for a, it is the other way round [DLMF 20.2(i), 20.2(iii)].  R and J are the series of
   `theta_series`.

4. *Rates.*  (phi + psi)' = Omega + (Lz + L3)/(lambda1 (1 + u)) and (phi - psi)' = -Omega +
   (Lz - L3)/(lambda1 (1 - u)), Omega = L3/lambda3 - L3/lambda1.  r is half of the mean of that
   over a nutation: a complete elliptic integral of the third kind (`GaussMean.mean_reciprocal`).

5. *Drift.*  X(y) turns by a quarter turn from one N to the next, which r t contains already.
   kappa = -s takes it out again.  The imaginary form has kappa = s (a/K' - 1), as Jacobi's
   transformation leaves a factor exp(i s y a/K') [DLMF 20.7(viii)].

6. *Poles.*  s = 0 means that the axis passes a pole exactly.  Then X is real and changes its sign
   there, and r has no term of the third kind.  If Lz = L3 and u3 = 1, beta has no zero: it is
   proportional to dn(chi), with theta4 and theta3 for X.

Everything that cancels, cancels here: next to a pole, to the separatrix, to steady precession.  So
there are 60 digits, and more if two roots are close.  What is needed in doubles only, the series,
takes 40.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from decimal import Decimal, DecimalException, getcontext
from typing import NamedTuple

from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.cubic import Roots, RootsTooCloseError, cubic_roots
from spinning_top_sim.solvers.decimal_math import (
    ONE,
    ZERO,
    atan2,
    pi,
    precision,
    reduced_turns,
    sin_cos,
)
from spinning_top_sim.solvers.elliptic import GaussMean
from spinning_top_sim.solvers.theta_series import COS_EVEN, SIN_ODD, Series, ThetaForm

FIRST_DIGITS = 60
MOST_DIGITS = 480
SERIES_DIGITS = 40
DIGITS_OF_SUMS = 1400   # the sum of any two doubles is exact
NO_GRAVITY = Decimal('1e-1000')     # so small that u3 is infinite to all digits

# R and J; J is None where s = 0
Parts = tuple[Series, Series | None]


@dataclass(frozen=True)
class Factor:
    """
    Alpha or beta: (R + i s J)/D exp i(r t + c + kappa y); the symbols are explained above.

    sense : s
    rate : r [rad/s]
    phase_turns : c [turns]
    drift : kappa
    parts : R and J at even and at odd N
    crosses : whether it changes its sign at a pole; R then has the factor (-1)^floor(N/2)
    sign : of R, where s = 0
    start_argument : argument of (R + i s J) exp(i kappa y) at t = 0 [rad]
    """

    sense: int
    rate: Decimal
    phase_turns: Decimal
    drift: Decimal
    parts: tuple[Parts, Parts]
    crosses: bool
    sign: int
    start_argument: Decimal


@dataclass(frozen=True)
class ThetaMotion:
    """
    A motion in theta functions; the symbols are explained above.

    digits : with which it was computed
    imaginary : whether the series are in the imaginary form, of x = stretch y
    quarter_rate : quarter periods per second, w/K
    quarter0, offset0 : N and 2y/pi at t = 0, offset0 accurate relative to itself
    u_dot : constants of u' = u_dot u_dot_series(2y)/D^4 at even and at odd N
    planar_rotation : (i, j) if both poles are passed: theta/2 then follows (pi/2) (i + j Z)
    half_angles : sine and cosine of theta/2, up to a scale, at its least and at its greatest
    """

    digits: int
    alpha: Factor
    beta: Factor
    imaginary: bool
    stretch: Decimal
    quarter_rate: Decimal
    quarter0: int
    offset0: Decimal
    u_dot: tuple[Decimal, Decimal]
    u_dot_series: Series
    planar_rotation: tuple[int, int] | None
    m: Decimal
    m1: Decimal
    half_angles: tuple[tuple[Decimal, Decimal], tuple[Decimal, Decimal]]


def set_up(top: Top, start: State) -> ThetaMotion:
    """
    Return alpha and beta of the motion through `start` at t = 0, for the doubles as they are.

    The digits are doubled until the closest roots of the cubic are told apart.  They are never
    equal: on the separatrix, or in steady precession with theta' != 0, cos(theta0) would be
    algebraic, and no double but 0 has an algebraic cosine.
    Raises ValueError beyond MOST_DIGITS.
    """
    digits = FIRST_DIGITS
    while digits <= MOST_DIGITS:
        with precision(digits):
            try:
                return _set_up(top, start)
            except RootsTooCloseError:
                digits *= 2
            except (DecimalException, OverflowError) as error:
                raise ValueError(f'{top} from {start}: the constants are too far apart in size '
                                 f'for the exact solution ({type(error).__name__})') from error
    raise ValueError(f'{top} from {start}: closer to the separatrix or to steady precession than '
                     f'{MOST_DIGITS} digits can tell')


class _Start(NamedTuple):
    """
    A top with P >= 0 and its start; sine and cosine of theta0/2 stand for theta0.

    excess_spin : Omega
    alpha_turns, beta_turns : arguments of alpha and beta [turns]
    """

    lambda1: Decimal
    l3: Decimal
    lz: Decimal
    theta_dot: Decimal
    sin_half: Decimal
    cos_half: Decimal
    excess_spin: Decimal
    alpha_turns: Decimal
    beta_turns: Decimal


def _set_up(top: Top, start: State) -> ThetaMotion:
    torque = Decimal(top.mass) * Decimal(top.gravity) * Decimal(top.com_distance)
    # Rounded now (+): a sum rounds its result, and -L3 must cancel Lz = L3 to the last digit.
    theta, theta_dot, l3, lz = (
        +Decimal(x) for x in (start.theta, start.theta_dot, start.l3, start.lz))
    with precision(DIGITS_OF_SUMS):
        arguments = ((Decimal(start.phi) + Decimal(start.psi)) / 2,
                     (Decimal(start.phi) - Decimal(start.psi)) / 2)
    sin_half, cos_half = sin_cos(theta / 2)
    upside_down = torque < 0
    if upside_down:
        # theta -> pi - theta, psi -> -psi, L3 -> -L3 leave P > 0, and exchange alpha and beta.
        torque, theta_dot, l3 = -torque, -theta_dot, -l3
        sin_half, cos_half, arguments = cos_half, sin_half, arguments[::-1]
    lambda1, lambda3 = Decimal(top.lambda1), Decimal(top.lambda3)
    given = _Start(lambda1, l3, lz, theta_dot, sin_half, cos_half,
                   l3 * (1 / lambda3 - 1 / lambda1), *map(reduced_turns, arguments))
    cubic = nutation_cubic(lambda1, torque, l3, lz, theta_dot, sin_half, cos_half)
    motion = _nutating(given, cubic) if cubic[0] or cubic[1] else _resting(given)
    return _turned_over(motion) if upside_down else motion


def _turned_over(motion: ThetaMotion) -> ThetaMotion:
    low, high = motion.half_angles
    even, odd = motion.u_dot
    line = motion.planar_rotation
    return replace(
        motion, alpha=motion.beta, beta=motion.alpha, u_dot=(-even, -odd),
        planar_rotation=line and (1 - line[0], -line[1]),
        half_angles=(high[::-1], low[::-1]))


def _resting(given: _Start) -> ThetaMotion:
    """Return alpha = cos(theta/2) exp i(r t + c), and beta likewise, with constant theta."""
    def factor(size: Decimal, spin: Decimal, momentum: Decimal, turns: Decimal) -> Factor:
        rate = spin / 2 + (momentum / (4 * given.lambda1 * size ** 2) if momentum else 0)
        parts = Series.of(COS_EVEN, (size,)), None
        return Factor(0, rate, turns, ZERO, (parts, parts), False, 1, ZERO)
    half_angle = given.sin_half, given.cos_half
    return ThetaMotion(
        digits=getcontext().prec,
        alpha=factor(given.cos_half, given.excess_spin, given.lz + given.l3, given.alpha_turns),
        beta=factor(given.sin_half, -given.excess_spin, given.lz - given.l3, given.beta_turns),
        imaginary=False, stretch=ONE, quarter_rate=ZERO, quarter0=0, offset0=ZERO,
        u_dot=(ZERO, ZERO), u_dot_series=Series.of(SIN_ODD, (ONE,)), planar_rotation=None,
        m=ZERO, m1=ONE, half_angles=(half_angle, half_angle))


def _nutating(given: _Start, cubic: tuple[Decimal, Decimal, Decimal, Decimal]) -> ThetaMotion:
    digits = getcontext().prec
    f0, f1, f2, f3 = cubic
    f3 = f3 or NO_GRAVITY * abs(f2)
    roots = cubic_roots(f0, f1, f2, f3)
    poles = _Distances.of(given, roots, f3)
    mean = GaussMean(roots.gap31, roots.gap32, roots.gap21)
    rates = (
        _mean_rate(given.excess_spin, given.lz + given.l3, given.lambda1,
                   mean, poles.one_plus_u1, poles.one_plus_u2),
        _mean_rate(-given.excess_spin, given.lz - given.l3, given.lambda1,
                   mean, poles.one_minus_u1, poles.one_minus_u2))
    imaginary = roots.gap21 > roots.gap32
    quarter0, direction, sin2, sinh2 = _nearest_quarter(roots, falling=given.theta_dot > 0)
    sin = mean.amplitude(sin2, -1)
    with precision(SERIES_DIGITS):
        form = ThetaForm(GaussMean(roots.gap31, roots.gap21, roots.gap32) if imaginary else mean,
                         imaginary)
        y0 = direction * atan2(sin, (1 - sin * sin).sqrt())
        sin = direction * (form.mean.amplitude(sinh2, 1) if imaginary else sin)
        xi = -sin * sin if imaginary else sin * sin
        start = _Place(quarter0, y0, (sin, (1 - xi).sqrt(), xi))
        alpha_zero, beta_zero = poles.zeros(roots, imaginary)
        alpha = _factor(form, False, given.lz + given.l3, rates[0], alpha_zero,
                        poles.one_plus_u2, given.alpha_turns, start,
                        -given.sin_half * given.theta_dot)
        beta = _factor(form, True, given.lz - given.l3, rates[1], beta_zero,
                       poles.one_minus_u1, given.beta_turns, start,
                       given.cos_half * given.theta_dot)
        scale = (f3 * roots.gap31).sqrt() / 2 * roots.gap21         # w (u2 - u1)
        slope_even, slope_odd = form.slopes_of_sn2()
        return ThetaMotion(
            digits=digits, alpha=alpha, beta=beta, imaginary=imaginary,
            stretch=form.mean.mean / mean.mean if imaginary else ONE,
            quarter_rate=_quarter_rate(f3, mean, digits), quarter0=quarter0,
            offset0=y0 * 2 / pi(),
            u_dot=(scale * slope_even, scale * slope_odd), u_dot_series=form.theta(1),
            planar_rotation=(beta.sign, -alpha.sign * beta.sign)
            if alpha.crosses and beta.crosses else None,
            m=roots.gap21 / roots.gap31, m1=roots.gap32 / roots.gap31,
            half_angles=poles.half_angles())


def _quarter_rate(f3: Decimal, mean: GaussMean, digits: int) -> Decimal:
    """Return w/K, where w = sqrt(f3 (u3 - u1))/2 and K = (pi/2) sqrt(u3 - u1)/M."""
    with precision(digits):
        return f3.sqrt() * mean.mean / pi()


def _mean_rate(spin: Decimal, momentum: Decimal, lambda1: Decimal, mean: GaussMean, x1: Decimal,
               x2: Decimal) -> Decimal:
    """Return half the mean of spin + momentum/(lambda1 x), x between x1 and x2."""
    if not momentum:
        return spin / 2
    return (spin + momentum / lambda1 * mean.mean_reciprocal(x1, x2)) / 2


class _Distances(NamedTuple):
    """
    The distances of the roots from u = -1 and u = 1.

    No subtraction cancels: u'^2 at u = -1 and u = 1 is -((Lz +- L3)/lambda1)^2.  So the product of
    three distances is known, and the smallest of them needs no difference.
    """

    one_plus_u1: Decimal
    one_plus_u2: Decimal
    one_minus_u1: Decimal
    one_minus_u2: Decimal
    u3_minus_one: Decimal

    @classmethod
    def of(cls, given: _Start, roots: Roots, f3: Decimal) -> _Distances:
        s0, c0 = given.sin_half ** 2, given.cos_half ** 2
        one_plus_u2, one_minus_u1 = 2 * c0 + roots.y2, 2 * s0 - roots.y1
        one_minus_u2, u3_minus_one = 2 * s0 - roots.y2, roots.y3 - 2 * s0
        scale = given.lambda1 ** 2 * f3
        one_plus_u1 = (given.lz + given.l3) ** 2 / (
            scale * one_plus_u2 * (roots.y3 + 2 * c0))
        at_top = (given.lz - given.l3) ** 2 / (scale * one_minus_u1)
        if one_minus_u2 <= u3_minus_one:
            one_minus_u2 = at_top / u3_minus_one
        else:
            u3_minus_one = at_top / one_minus_u2
        return cls(one_plus_u1, one_plus_u2, one_minus_u1, one_minus_u2, u3_minus_one)

    def half_angles(self) -> tuple[tuple[Decimal, Decimal], tuple[Decimal, Decimal]]:
        """Return sine and cosine of theta/2, up to a scale, at u2 and at u1."""
        return ((self.one_minus_u2.sqrt(), self.one_plus_u2.sqrt()),
                (self.one_minus_u1.sqrt(), self.one_plus_u1.sqrt()))

    def zeros(self, roots: Roots, imaginary: bool) -> tuple[Decimal, Decimal | None]:
        """
        Return what `GaussMean.amplitude` takes for a and b: -sn^2(ia, m), or sn^2(a, m1).

        The second is None if u3 = 1: then beta has no zero.
        """
        if imaginary:
            alpha = self.one_plus_u1 / self.one_plus_u2
            beta = self.one_minus_u2 * roots.gap31 / (self.one_minus_u1 * roots.gap32)
            return alpha, beta if self.u3_minus_one else None
        alpha = self.one_plus_u1 / roots.gap21
        if not self.u3_minus_one:
            return alpha, None
        return alpha, roots.gap31 * self.one_minus_u2 / (roots.gap21 * self.u3_minus_one)


def _nearest_quarter(roots: Roots, falling: bool) -> tuple[int, int, Decimal, Decimal]:
    """
    Return N at t = 0, the sign of y, and sn^2 and sn^2/cn^2 of the distance of chi from N K.

    The latter is -sn^2 of the distance times i, of the parameter m1 [DLMF 22.6(iv)].
    """
    sense = -1 if falling else 1
    low, high = -roots.y1, roots.y2         # u0 - u1 and u2 - u0
    # sn^2 = low/gap21, and sn(K - chi) = cn/dn.  They are equal at sn^2 (1 + sqrt(m1)) = 1.
    if low * (1 + (roots.gap32 / roots.gap31).sqrt()) < roots.gap21:
        return 0, sense, low / roots.gap21, low / high
    return (sense, -sense, high * roots.gap31 / (roots.gap21 * roots.y3),
            high * roots.gap31 / (low * roots.gap32))


class _Place(NamedTuple):
    """The phase at the start: N, y, and the arguments of `Series.at`."""

    quarters: int
    y: Decimal
    point: tuple[Decimal, Decimal, Decimal]


def _factor(form: ThetaForm, is_beta: bool, momentum: Decimal, rate: Decimal,
            zero: Decimal | None, distance: Decimal, turns: Decimal, start: _Place,
            derivative: Decimal) -> Factor:
    """
    Return alpha or beta.

    momentum : Lz + L3 or Lz - L3
    zero : see `_Distances.zeros`
    distance : the largest value of 2 |alpha|^2 or 2 |beta|^2
    turns : the argument at t = 0 [turns]
    derivative : of its modulus at t = 0
    """
    sense, drift = int(momentum.compare(ZERO)), ZERO
    amplitude = zero and form.mean.amplitude(zero, -1 if form.imaginary else 1)
    parts = _scaled_parts(form, is_beta, sense, amplitude, (distance / 2).sqrt())
    real, imag = (part and part.at(*start.point) for part in parts[start.quarters % 2])
    argument, sign, crosses = ZERO, 1, False
    if amplitude is not None and sense:
        drift = Decimal(-sense)
        if form.imaginary:
            drift += sense * 2 / pi() * atan2(amplitude, (1 - amplitude * amplitude).sqrt())
        argument = drift * start.y + sense * atan2(imag or ZERO, real or ZERO)
    elif amplitude is not None:
        # The sign is that of cos(theta0/2) or sin(theta0/2), which are not negative.  Where they
        # vanish they leave 0 with the derivative, and R with its polynomial times y.
        crosses, flip = True, 1 if start.quarters % 4 < 2 else -1
        leading = parts[start.quarters % 2][0].leading
        sign = -1 if (flip * (real or ZERO) or flip * leading * derivative) < 0 else 1
    return Factor(sense, rate, turns - argument / (2 * pi()), drift, parts, crosses, sign,
                  argument)


def _scaled_parts(form: ThetaForm, is_beta: bool, sense: int, amplitude: Decimal | None,
                  size: Decimal) -> tuple[Parts, Parts]:
    """Return R and J at even and at odd N; `size` is the largest modulus of alpha or beta."""
    theta1: Parts
    theta2: Parts
    if amplitude is None:           # proportional to dn
        theta1, theta2 = (form.theta(4), None), (form.theta(3), None)
    elif sense:
        theta1, theta2 = form.shifted(amplitude)
    else:
        theta1 = form.theta(1).scaled(-ONE if is_beta else ONE), None
        theta2 = form.theta(2), None
    # alpha is largest at u2, where N is odd, and beta at u1: both at the centre of theta2.
    scale = size * form.at_zero(4 if is_beta else 3) / theta2[0].leading
    scaled1, scaled2 = (
        (real.scaled(factor), imag and imag.scaled(factor))
        for (real, imag), factor in ((theta1, scale * form.odd_over_even if is_beta else scale),
                                     (theta2, scale)))
    return (scaled2, scaled1) if is_beta else (scaled1, scaled2)
