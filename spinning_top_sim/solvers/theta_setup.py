# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in Klein's theta functions: everything that is done once for a trajectory.

The Cayley-Klein parameters are each a theta function of the nutation's phase over a common one,
times a uniform rotation, so that a state costs the same at every t:

    alpha = cos(theta/2) exp(i(phi+psi)/2) = (R + i s J)(y)/D(y) exp i(r t + c + s kappa y)
    beta  = sin(theta/2) exp(i(phi-psi)/2) = the same with R, J, s, r, c, kappa of its own

    u, P        cos(theta) and M g R;  u'^2 = (2P/lambda1)(u - u1)(u2 - u)(u3 - u)
    m, m1       (u2 - u1)/(u3 - u1) and 1 - m;  quarter periods K = K(m), K' = K(m1)
    w           u = u1 + (u2 - u1) sn^2(chi), where chi grows at the rate w [DLMF 22.2]
    Z = N + 2y/pi   the phase chi/K in quarter periods: N whole, |y| <= pi/4
    ia, K + ib  the chi at which alpha and beta vanish [DLMF 19.25(v)];  v0 = i pi a/(2K)
    s           the sign of Lz + L3 for alpha, of Lz - L3 for beta; 0: a pole is passed exactly
    R + i s J   of alpha i s theta1(y - s v0) at even N (u near u1), theta2(y - s v0) at odd N (u
                near u2); of beta, with b for a, the other way round [DLMF 20.2]
    D           theta4(y) at even N, theta3(y) at odd N;  R, J, D up to constant factors
    r, c        mean rate, with s w (pi/(2K) - d/da log theta2(v0)) in it, and phase at t = 0
    kappa       -1: s y is taken out of r t, since r t grows evenly and (R + i s J) holds the
                quarter turns.  In the imaginary form a/K' - 1, as that splits off
                exp(i s y a/K').

The work is done in long decimals, 60 digits and more if two roots of the cubic are close, because
everything that cancels, cancels here: close to a pole, to the separatrix, to steady precession.
(F. Klein, A. Sommerfeld, *Ueber die Theorie des Kreisels*, ch. VI;  E. T. Whittaker, *Analytical
Dynamics*, ch. VI;  DLMF: https://dlmf.nist.gov, ch. 19, 20 and 22)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from decimal import Decimal, DecimalException, getcontext, localcontext
from typing import NamedTuple

from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers import decimal_math
from spinning_top_sim.solvers.decimal_math import ONE, ZERO, atan2, carlson_rf, pi, precision
from spinning_top_sim.solvers.theta_series import Series, ThetaForm

FIRST_DIGITS = 60
MOST_DIGITS = 480
MOST_NEWTON_STEPS = 5000
KEPT_DIGITS = 40        # what must be left of the digits after the discriminant has cancelled
SAME = Decimal('1e-35')
DIGITS_OF_SUMS = 1400   # the sum of any two doubles is exact
NO_GRAVITY = Decimal('1e-1000')     # so small that u3 is infinite to all digits
FULL_CIRCLE_M1 = Decimal('2e-4')    # below, the series of the real form cancels too much


class _RootsTooCloseError(ArithmeticError):
    """Two roots of the cubic agree to most of the digits at hand."""


class FactorSeries(NamedTuple):
    """R and J of alpha or beta at even or at odd N."""

    real: Series
    imag: Series = Series('cos even', (ZERO,))      # where s = 0

    @property
    def has_zero(self) -> bool:
        """Whether it is proportional to sin y: an exact passage through a pole."""
        return self.real.kind == 'sin odd'

    def scaled(self, scale: Decimal) -> FactorSeries:
        return FactorSeries(self.real.scaled(scale), self.imag.scaled(scale))


@dataclass(frozen=True)
class Factor:
    """
    Alpha or beta: (R + i s J)/D exp i(r t + c + s kappa y).

    With s = 0, R is signed by `sign` and, if it `crosses`, by (-1)^floor(N/2).
    """

    sense: int                  # s
    rate: Decimal               # r [rad/s]
    phase_turns: Decimal        # c [turns]
    start_argument: Decimal     # of (R + i s J) exp(i drift y) at t = 0 [rad]
    drift: Decimal              # s kappa
    crosses: bool
    sign: int
    even: FactorSeries
    odd: FactorSeries
    full_circle: FactorSeries | None    # `even` in the real form, where few terms do for every y


@dataclass(frozen=True)
class ThetaMotion:
    """
    A trajectory, in long decimals.

    With P < 0 the same top is seen upside down: theta -> pi - theta, psi -> -psi, L3 -> -L3 leave
    P > 0, and exchange alpha and beta.  What is here is already exchanged back.
    """

    digits: int
    alpha: Factor
    beta: Factor
    imaginary: bool             # the form of `even` and `odd` of the factors
    stretch: Decimal            # x = stretch y in the imaginary form
    quarter_rate: Decimal       # quarter periods per second, w/K
    quarter0: int               # N at t = 0,
    offset0: Decimal            # and 2y/pi, accurate relative to itself
    u_dot: tuple[Decimal, Decimal]      # u' = u_dot u_dot_series(2y)/D^4 at even and odd N
    u_dot_series: Series
    # (i, j) if both poles are passed: theta/2 then follows (pi/2)(i + j Z)
    planar_rotation: tuple[int, int] | None
    m: Decimal
    m1: Decimal                 # 1 - m, without cancellation: the distance to the separatrix
    theta_bounds: tuple[Decimal, Decimal]


def set_up(top: Top, start: State) -> ThetaMotion:
    """
    Return alpha and beta of the motion through `start` at t = 0.

    Top and State are taken as exact doubles.  The precision is doubled until the closest roots of
    the cubic are told apart.  They are never equal: on the separatrix, or in steady precession
    with theta' != 0, cos(theta0) would be algebraic, and no double but 0 has an algebraic cosine.
    Raises ValueError beyond MOST_DIGITS.
    """
    digits = FIRST_DIGITS
    while digits <= MOST_DIGITS:
        with precision(digits):
            try:
                return _set_up(top, start)
            except _RootsTooCloseError:
                digits *= 2
            except (DecimalException, OverflowError) as error:
                raise ValueError(f'{top} from {start}: the constants are too far apart in size '
                                 f'for the exact solution ({type(error).__name__})') from error
    raise ValueError(f'{top} from {start}: closer to the separatrix or to steady precession than '
                     f'{MOST_DIGITS} digits can tell')


def _set_up(top: Top, start: State) -> ThetaMotion:
    torque = Decimal(top.mass) * Decimal(top.gravity) * Decimal(top.com_distance)
    # Rounded now (+): a sum rounds its result, and -L3 must cancel Lz = L3 to the last digit.
    theta, theta_dot, l3, lz = (
        +Decimal(x) for x in (start.theta, start.theta_dot, start.l3, start.lz))
    # Half of phi + psi and of phi - psi, the arguments of alpha and beta: exact sums.
    with precision(DIGITS_OF_SUMS):
        arguments = ((Decimal(start.phi) + Decimal(start.psi)) / 2,
                     (Decimal(start.phi) - Decimal(start.psi)) / 2)
    sin_half, cos_half = decimal_math.sin_cos(theta / 2)
    upside_down = torque < 0
    if upside_down:
        torque, theta_dot, l3 = -torque, -theta_dot, -l3
        sin_half, cos_half, arguments = cos_half, sin_half, arguments[::-1]
    lambda1, lambda3 = Decimal(top.lambda1), Decimal(top.lambda3)
    given = _Given(lambda1, l3, lz, theta_dot, sin_half, cos_half,
                   l3 * (1 / lambda3 - 1 / lambda1), *map(decimal_math.reduced_turns, arguments))
    cubic = nutation_cubic(lambda1, torque, l3, lz, theta_dot, sin_half, cos_half)
    motion = _nutating(given, cubic) if cubic[0] or cubic[1] else _resting(given)
    return _upside_down(motion) if upside_down else motion


def _upside_down(motion: ThetaMotion) -> ThetaMotion:
    low, high = motion.theta_bounds
    even, odd = motion.u_dot
    line = motion.planar_rotation
    return replace(
        motion, alpha=motion.beta, beta=motion.alpha, u_dot=(-even, -odd),
        planar_rotation=line and (1 - line[0], -line[1]),
        theta_bounds=(pi() - high, pi() - low))


class _Given(NamedTuple):
    """A top with P >= 0 and its start; theta0 as in `nutation_cubic`."""

    lambda1: Decimal
    l3: Decimal
    lz: Decimal
    theta_dot: Decimal
    sin_half: Decimal
    cos_half: Decimal
    excess_spin: Decimal        # turns the body and not its axis: L3 (1/lambda3 - 1/lambda1)
    alpha_turns: Decimal        # arguments of alpha and beta [turns]
    beta_turns: Decimal


def _resting(given: _Given) -> ThetaMotion:
    """
    Return alpha = cos(theta/2) exp i(r t + c), and beta so, where theta is constant.

    (phi + psi)' and (phi - psi)', twice r, have one pole each, where a 0/0 term is 0.
    """
    def factor(size: Decimal, spin: Decimal, momentum: Decimal, turns: Decimal) -> Factor:
        rate = spin / 2 + (momentum / (4 * given.lambda1 * size ** 2) if momentum else 0)
        series = FactorSeries(Series('cos even', (size,)))
        return Factor(0, rate, turns, ZERO, ZERO, False, 1, series, series, series)
    theta = 2 * atan2(given.sin_half, given.cos_half)
    return ThetaMotion(
        digits=getcontext().prec,
        alpha=factor(given.cos_half, given.excess_spin, given.lz + given.l3, given.alpha_turns),
        beta=factor(given.sin_half, -given.excess_spin, given.lz - given.l3, given.beta_turns),
        imaginary=False, stretch=ONE, quarter_rate=ZERO, quarter0=0, offset0=ZERO,
        u_dot=(ZERO, ZERO), u_dot_series=Series('sin odd', (ONE,)), planar_rotation=None,
        m=ZERO, m1=ONE, theta_bounds=(theta, theta))


class _Roots(NamedTuple):
    """u1, u2 and u3 less u0, y1 <= 0 <= y2 <= y3, and distances that do not cancel."""

    y1: Decimal
    y2: Decimal
    y3: Decimal
    gap21: Decimal
    gap32: Decimal

    @property
    def gap31(self) -> Decimal:
        return self.y3 - self.y1

    @property
    def m(self) -> Decimal:
        return self.gap21 / self.gap31

    @property
    def m1(self) -> Decimal:
        return self.gap32 / self.gap31

    def start_phase(self, falling: bool, K: Decimal) -> tuple[int, Decimal]:
        """Return N and 2y/pi at t = 0, negative while u falls."""
        # chi = sn R_F(cn^2, dn^2, 1) [DLMF 19.25.5]; K - chi likewise, with sn(K - chi) = cn/dn.
        sense = -1 if falling else 1
        sn2, cn2, dn2 = -self.y1 / self.gap21, self.y2 / self.gap21, self.y3 / self.gap31
        if sn2 * (1 + self.m1.sqrt()) < 1:
            return 0, sense * sn2.sqrt() * carlson_rf(cn2, dn2, ONE) / K
        from_quarter = (cn2 / dn2).sqrt() * carlson_rf(self.m1 * sn2 / dn2, self.m1 / dn2, ONE) / K
        return sense, -sense * from_quarter


def _quadratic_roots(total: Decimal, product: Decimal) -> tuple[Decimal, Decimal, Decimal]:
    """Return the roots x1 <= x2 of x^2 - total x + product, and x2 - x1."""
    discriminant = total * total - 4 * product
    if discriminant < total * total * Decimal(10) ** (KEPT_DIGITS - getcontext().prec):
        raise _RootsTooCloseError
    gap = discriminant.sqrt()
    large = (total + gap) / 2 if total > 0 else (total - gap) / 2
    small = product / large
    return min(large, small), max(large, small), gap


def _isolated_root(a2: Decimal, a1: Decimal, a0: Decimal) -> tuple[Decimal, int]:
    """
    Return that root of y^3 + a2 y^2 + a1 y + a0 which lies alone on its side of -a2/3, and the
    side.  Newton's method from beyond all roots (Fujiwara's bound) comes down monotonically.
    """
    centre = -a2 / 3
    side = -1 if ((centre + a2) * centre + a1) * centre + a0 > 0 else 1
    with localcontext(prec=8):
        y = side * Decimal('2.001') * max(abs(a2), abs(a1).sqrt(), abs(a0) ** (ONE / 3))
    resolution = Decimal(10) ** (3 - getcontext().prec)
    for _ in range(MOST_NEWTON_STEPS):
        step = (((y + a2) * y + a1) * y + a0) / ((3 * y + 2 * a2) * y + a1)
        y -= step
        if step * side <= abs(y) * resolution:
            return y, side
    raise _RootsTooCloseError


def _cubic_roots(f0: Decimal, f1: Decimal, f2: Decimal, f3: Decimal) -> _Roots:
    """Return u1 - u0, u2 - u0 and u3 - u0, the roots of f0 + f1 y + f2 y^2 + f3 y^3."""
    a2, a1, a0 = f2 / f3, f1 / f3, f0 / f3
    if not f0:                                  # turning point, cusp or pole: y = 0 is a root
        low, high, gap = _quadratic_roots(-a2, a1)
        if low > 0:
            return _Roots(ZERO, low, high, low, gap)
        return _Roots(low, ZERO, high, -low, high)
    y, side = _isolated_root(a2, a1, a0)
    product = -a0 / y
    # The sum of the others, without cancellation: near a pole -a2 - y would, with a small y the
    # other.
    total = -a2 - y if 2 * abs(y) < abs(a2) else (a1 - product) / y
    low, high, gap = _quadratic_roots(total, product)
    if side < 0:
        return _Roots(y, low, high, low - y, gap)
    return _Roots(low, high, y, gap, y - high)


def _check_roots(roots: _Roots, a0: Decimal, a1: Decimal, a2: Decimal) -> None:
    """Ask for more digits if the roots do not have the constants of the motion, by Vieta."""
    y1, y2, y3 = roots[:3]
    for wanted, terms in ((-a2, (y1, y2, y3)), (a1, (y1 * y2, y2 * y3, y3 * y1)),
                          (-a0, (y1 * y2 * y3,))):
        if abs(sum(terms) - wanted) > SAME * sum(map(abs, terms)):
            raise _RootsTooCloseError


class _Poles:
    """
    a and b, and the distances of u1 and u2 from the poles u = -1 and u = 1.

    b is None if u3 = 1 exactly: Lz is L3 then, and beta is a dn and has no zero.
    No subtraction cancels: u'^2 at u = -1 and u = 1 is -((Lz +- L3)/lambda1)^2, so the product of
    three distances is known, and the smallest of them needs no difference.
    """

    def __init__(self, given: _Given, roots: _Roots, f3: Decimal) -> None:
        s0, c0 = given.sin_half ** 2, given.cos_half ** 2
        self.one_plus_u2, self.one_minus_u1 = 2 * c0 + roots.y2, 2 * s0 - roots.y1
        one_minus_u2, u3_minus_one = 2 * s0 - roots.y2, roots.y3 - 2 * s0
        one_plus_u3 = roots.y3 + 2 * c0
        scale = given.lambda1 ** 2 * f3
        self.one_plus_u1 = (given.lz + given.l3) ** 2 / (scale * self.one_plus_u2 * one_plus_u3)
        at_top = (given.lz - given.l3) ** 2 / (scale * self.one_minus_u1)
        if one_minus_u2 <= u3_minus_one:
            one_minus_u2 = at_top / u3_minus_one
        else:
            u3_minus_one = at_top / one_minus_u2
        self.one_minus_u2 = one_minus_u2
        gap21, gap31, gap32 = roots.gap21, roots.gap31, roots.gap32
        self.a = (gap31 * self.one_plus_u1).sqrt() * carlson_rf(
            gap31 * gap21, gap21 * one_plus_u3, gap31 * self.one_plus_u2)
        self.b = (gap31 * one_minus_u2).sqrt() * carlson_rf(
            gap21 * u3_minus_one, gap21 * gap32,
            gap32 * self.one_minus_u1) if u3_minus_one else None


def _nutating(given: _Given, cubic: tuple[Decimal, Decimal, Decimal, Decimal]) -> ThetaMotion:
    f0, f1, f2, f3 = cubic
    f3 = f3 or NO_GRAVITY * abs(f2)
    roots = _cubic_roots(f0, f1, f2, f3)
    _check_roots(roots, f0 / f3, f1 / f3, f2 / f3)
    w = (f3 * roots.gap31 / 4).sqrt()
    poles = _Poles(given, roots, f3)
    form = ThetaForm.of(roots.m, roots.m1)
    full_form = form.real() if roots.m1 >= FULL_CIRCLE_M1 else None
    quarter0, offset0 = roots.start_phase(given.theta_dot > 0, form.K)
    y0 = pi() / 2 * offset0

    def factor(is_beta: bool, momentum: Decimal, spin: Decimal, zero: Decimal | None,
               distance: Decimal, turns: Decimal, derivative: Decimal) -> Factor:
        # zero: a or b;  distance: 2 |alpha|^2 or 2 |beta|^2 where it is largest;  derivative: of
        # the modulus at t = 0.
        s, size = int(momentum.compare(ZERO)), (distance / 2).sqrt()
        rate = spin / 2 + momentum / (2 * given.lambda1 * distance)
        pole = form.K_prime if zero is None else zero
        if s:
            rate += s * w * (pi() / (2 * form.K) - form.log_slope(pole))
        drift = s * (pole / form.K_prime - 1) if form.imaginary else Decimal(-s)
        even, odd = _factor_series(form, is_beta, s, zero, size)
        full_circle = _factor_series(full_form, is_beta, s, zero, size)[0] if full_form else None
        argument, start_sign = _at_start(form, (even, odd), quarter0, y0, s, derivative)
        argument += drift * y0
        return Factor(s, rate, turns - argument / (2 * pi()), argument, drift,
                      even.has_zero or odd.has_zero, start_sign, even, odd, full_circle)
    alpha = factor(False, given.lz + given.l3, given.excess_spin, poles.a, poles.one_plus_u2,
                   given.alpha_turns, -given.sin_half * given.theta_dot)
    beta = factor(True, given.lz - given.l3, -given.excess_spin, poles.b, poles.one_minus_u1,
                  given.beta_turns, given.cos_half * given.theta_dot)
    slope_even, slope_odd = form.slopes_of_sn2()
    return ThetaMotion(
        digits=getcontext().prec, alpha=alpha, beta=beta, imaginary=form.imaginary,
        stretch=form.stretch, quarter_rate=w / form.K, quarter0=quarter0, offset0=offset0,
        u_dot=(w * roots.gap21 * slope_even, w * roots.gap21 * slope_odd),
        u_dot_series=form.theta(1),
        planar_rotation=(beta.sign, -alpha.sign * beta.sign)
        if alpha.crosses and beta.crosses else None,
        m=roots.m, m1=roots.m1,
        theta_bounds=(2 * atan2(poles.one_minus_u2.sqrt(), poles.one_plus_u2.sqrt()),
                      2 * atan2(poles.one_minus_u1.sqrt(), poles.one_plus_u1.sqrt())))


def _factor_series(form: ThetaForm, is_beta: bool, s: int, zero: Decimal | None, size: Decimal,
                   ) -> tuple[FactorSeries, FactorSeries]:
    """Return R and J at even and at odd N, scaled to the largest modulus `size`; zero: a or b."""
    if zero is None:                # a dn
        theta1, theta2 = FactorSeries(form.theta(4)), FactorSeries(form.theta(3))
    elif s:
        theta1, theta2 = (FactorSeries(*x) for x in form.shifted(zero))
    else:
        theta1 = FactorSeries(form.theta(1).scaled(-ONE if is_beta else ONE))
        theta2 = FactorSeries(form.theta(2))
    denominator = form.theta(4) if is_beta else form.theta(3)
    scale = size * denominator.at_zero / theta2.real.at_zero
    if is_beta:
        return theta2.scaled(scale), theta1.scaled(scale * form.odd_over_even)
    return theta1.scaled(scale), theta2.scaled(scale)


def _at_start(form: ThetaForm, series: tuple[FactorSeries, FactorSeries], quarters: int,
              y: Decimal, s: int, derivative: Decimal) -> tuple[Decimal, int]:
    """Return the argument of R + i s J at t = 0 [rad] and, where s = 0, its sign."""
    here, point = series[quarters % 2], form.point(y)
    real = here.real(*point)
    if s:
        return s * atan2(here.imag(*point), real), 1
    if not any(x.has_zero for x in series):
        return ZERO, 1
    flip = 1 if quarters % 4 < 2 else -1
    growing = flip * here.real.weights[0]           # if it is zero now, it leaves with y
    return ZERO, -1 if (flip * real or growing * derivative) < 0 else 1
