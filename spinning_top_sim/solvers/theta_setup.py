# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in Klein's theta functions: everything that is done once for a trajectory.

With u = cos(theta) and P = M g R the nutation obeys u'^2 = (2P/lambda1)(u-u1)(u2-u)(u3-u), and the
Cayley-Klein parameters

    alpha = w + iz = cos(theta/2) exp(i(phi+psi)/2)
    beta  = y - ix = sin(theta/2) exp(i(phi-psi)/2)

are each a theta function of the nutation's phase over a common one, times a uniform rotation:

    alpha = (R + i s J)(y)/D(y) exp i(rate t + phase + s kappa y),   R + i s J ~ theta(y - i s a)

(F. Klein, A. Sommerfeld, Ueber die Theorie des Kreisels, ch. VI;  E. T. Whittaker, Analytical
Dynamics, ch. VI;  theta functions, nome and quarter periods K, K' as in DLMF ch. 20 and 22, R_F
as in DLMF ch. 19: https://dlmf.nist.gov).  So a state costs the same at every t.  The phase
is counted in quarter periods, Z = N + 2y/pi with N whole and |y| <= pi/4: over even N (u near u1)
alpha is theta1 and beta theta2, over odd N (u near u2) the other way round.

The work is done in long decimals, 60 digits and more if two roots of the cubic are close, because
everything that cancels, cancels here: close to a pole, to the separatrix, to steady precession.
What comes out are coefficients, frequencies and phases for evaluation in doubles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from decimal import Decimal, DecimalException, getcontext, localcontext
from typing import NamedTuple

from spinning_top_sim.physics.regimes import nutation_cubic
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.decimal_math import (
    ONE,
    ZERO,
    atan2,
    carlson_rf,
    pi,
    precision,
    reduced_turns,
    sign,
    sin_cos,
    sinh_cosh,
)
from spinning_top_sim.solvers.theta_series import Series, ThetaForm

FIRST_DIGITS = 60
MOST_DIGITS = 480
MOST_NEWTON_STEPS = 5000
KEPT_DIGITS = 40        # what must be left of the digits after the discriminant has cancelled
DIGITS_OF_SUMS = 1400   # the sum of any two doubles is exact
FULL_CIRCLE_M1 = Decimal('2e-4')    # below, the series of the real form cancels too much


class _RootsTooCloseError(ArithmeticError):
    """Two roots of the cubic agree to most of the digits at hand."""


@dataclass(frozen=True)
class Branch:
    """A Cayley-Klein parameter, less its rotation and the denominator, near u1 or near u2."""

    real: Series
    imag: Series | None         # None: the factor is real, it goes through zero or is a dn

    @property
    def has_zero(self) -> bool:
        """Whether it is real and proportional to sin y: an exact passage through a pole."""
        return self.imag is None and self.real.kind == 'sin odd'


@dataclass(frozen=True)
class Factor:
    """
    Alpha or beta: branch value / D * exp i(rate t + phase + drift y).

    sense: s = +1 or -1, the sign of Lz + L3 (alpha) or Lz - L3 (beta).  0: a pole is passed
    exactly, the branches are real, and signed by `sign` and by (-1)^floor(N/2) if it `crosses`.
    """

    sense: int
    rate: Decimal               # [rad/s]
    phase_turns: Decimal        # [turns]
    start_argument: Decimal     # of (R + i s J) exp(i drift y) at t = 0 [rad]
    drift: Decimal              # s kappa
    crosses: bool
    sign: int
    even: Branch
    odd: Branch
    full_circle: Branch | None  # the even branch in the real form, where few terms do for every y


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
    imaginary: bool             # the form of the branches
    full_circle: Series | None  # D for the full_circle of the factors
    stretch: Decimal            # x = stretch y in the imaginary form
    quarter_rate: Decimal       # quarter periods per second, w/K
    quarter0: int               # phase at t = 0 in quarter periods: whole part,
    offset0: Decimal            # and a rest in [-1/2, 1/2], accurate relative to itself
    u_dot: tuple[Decimal, Decimal]      # u' = u_dot u_dot_series(2y)/D^4 over even and odd N
    u_dot_series: Series
    turning: tuple[int, int] | None     # planar rotation: theta/2 follows (pi/2)(i + j Z)
    m: Decimal
    m1: Decimal                 # 1 - m, without cancellation: the distance to the separatrix
    theta_bounds: tuple[Decimal, Decimal]


def set_up(top: Top, start: State) -> ThetaMotion:
    """
    Find the theta functions of the motion through `start` at t = 0.

    Top and State are taken as exact doubles, and P as the exact product M g R.  The precision is
    doubled until the closest roots of the cubic are told apart.  They are never equal: on the
    separatrix, or in steady precession with theta' != 0, cos(theta0) would be algebraic, and no
    double but 0 has an algebraic cosine.
    Raises ValueError if the motion is out of reach even so.
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
    lambda1, lambda3 = Decimal(top.lambda1), Decimal(top.lambda3)
    gravity_torque = Decimal(top.mass) * Decimal(top.gravity) * Decimal(top.com_distance)
    # Rounded now (+): a sum rounds its result, and -L3 must cancel Lz = L3 to the last digit.
    theta, theta_dot, l3, lz = (
        +Decimal(x) for x in (start.theta, start.theta_dot, start.l3, start.lz))
    sin_half, cos_half = sin_cos(theta / 2)
    upside_down = gravity_torque < 0
    if upside_down:
        gravity_torque, theta_dot, l3 = -gravity_torque, -theta_dot, -l3
        sin_half, cos_half = cos_half, sin_half
    # Half of phi + psi and of phi - psi, exact sums reduced to one turn; seen upside down they
    # change places.
    with precision(DIGITS_OF_SUMS):
        angles = ((Decimal(start.phi) + Decimal(start.psi)) / 2,
                  (Decimal(start.phi) - Decimal(start.psi)) / 2)
    alpha_turns, beta_turns = (reduced_turns(x) for x in (angles[::-1] if upside_down else angles))
    orbit = _Orbit(lambda1, lambda3, gravity_torque, l3, lz, sin_half, cos_half, theta_dot)
    cubic = nutation_cubic(lambda1, gravity_torque, l3, lz, theta_dot, sin_half, cos_half)
    motion = (orbit.nutating(cubic, alpha_turns, beta_turns) if cubic[0] or cubic[1] else
              orbit.resting(alpha_turns, beta_turns))
    return _upside_down(motion) if upside_down else motion


def _upside_down(motion: ThetaMotion) -> ThetaMotion:
    """Exchange alpha and beta, and all that goes with them: theta -> pi - theta."""
    low, high = motion.theta_bounds
    even, odd = motion.u_dot
    turning = motion.turning
    return replace(
        motion, alpha=motion.beta, beta=motion.alpha, u_dot=(-even, -odd),
        turning=turning and (1 - turning[0], -turning[1]),
        theta_bounds=(pi() - high, pi() - low))


class _Roots(NamedTuple):
    """
    The roots y1 <= 0 <= y2 <= y3 of u'^2 in y = u - u0, and their distances, none by subtraction.

    Without gravity y3 is at infinity; then what contains it is given relative to y3 - y1.
    """

    y1: Decimal
    y2: Decimal
    y3: Decimal | None
    gap21: Decimal
    gap32: Decimal


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
    with localcontext() as context:
        context.prec = 8
        y = side * Decimal('2.001') * max(abs(a2), abs(a1).sqrt(), abs(a0) ** (ONE / 3))
    resolution = Decimal(10) ** (3 - getcontext().prec)
    for _ in range(MOST_NEWTON_STEPS):
        step = (((y + a2) * y + a1) * y + a0) / ((3 * y + 2 * a2) * y + a1)
        y -= step
        if step * side <= abs(y) * resolution:
            return y, side
    raise _RootsTooCloseError


def _cubic_roots(f0: Decimal, f1: Decimal, f2: Decimal, f3: Decimal) -> _Roots:
    if not f3:                                  # free motion: a quadratic
        if not f0:
            low, high = min(ZERO, -f1 / f2), max(ZERO, -f1 / f2)
            return _Roots(low, high, None, high - low, ONE)
        low, high, gap = _quadratic_roots(-f1 / f2, f0 / f2)
        return _Roots(low, high, None, gap, ONE)
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


@dataclass(frozen=True)
class _Orbit:
    """
    The motion of a top with P >= 0.

    sin and cos of theta0/2 stand for theta0, so that nothing cancels at either pole.  Methods take
    alpha_turns and beta_turns, the arguments of alpha and beta at t = 0 [turns].
    """

    lambda1: Decimal
    lambda3: Decimal
    gravity_torque: Decimal
    l3: Decimal
    lz: Decimal
    sin_half: Decimal
    cos_half: Decimal
    theta_dot: Decimal

    @property
    def a_plus(self) -> Decimal:
        return self.lz + self.l3

    @property
    def a_minus(self) -> Decimal:
        return self.lz - self.l3

    @property
    def excess_spin(self) -> Decimal:
        """What turns the body and not its axis: L3 (1/lambda3 - 1/lambda1)."""
        return self.l3 * (1 / self.lambda3 - 1 / self.lambda1)

    def resting(self, alpha_turns: Decimal, beta_turns: Decimal) -> ThetaMotion:
        """
        Equilibrium of the nutation: sleeping, hanging, steady precession, no motion at all.

        theta is constant; (phi + psi)' and (phi - psi)' have one pole each, where a 0/0 term is 0.
        """
        def factor(size: Decimal, spin: Decimal, momentum: Decimal, turns: Decimal) -> Factor:
            rate = spin / 2 + (momentum / (4 * self.lambda1 * size ** 2) if momentum else 0)
            branch = Branch(Series('cos even', (size,)), None)
            return Factor(0, rate, turns, ZERO, ZERO, False, 1, branch, branch, branch)
        theta = 2 * atan2(self.sin_half, self.cos_half)
        return ThetaMotion(
            digits=getcontext().prec,
            alpha=factor(self.cos_half, self.excess_spin, self.a_plus, alpha_turns),
            beta=factor(self.sin_half, -self.excess_spin, self.a_minus, beta_turns),
            imaginary=False, full_circle=Series('cos even', (ONE,)),
            stretch=ONE, quarter_rate=ZERO, quarter0=0, offset0=ZERO,
            u_dot=(ZERO, ZERO), u_dot_series=Series('sin odd', (ONE,)), turning=None,
            m=ZERO, m1=ONE, theta_bounds=(theta, theta))

    def nutating(self, cubic: tuple[Decimal, Decimal, Decimal, Decimal], alpha_turns: Decimal,
                 beta_turns: Decimal) -> ThetaMotion:
        s0, c0 = self.sin_half ** 2, self.cos_half ** 2
        y1, y2, y3, gap21, gap32 = _cubic_roots(*cubic)
        # w is the frequency of sn(w t); `strength` is f3, with the factor u3 - u1 if that is
        # infinite.  `reach` = 1 + u3 and above_top = u3 - 1 then are 1, relative to u3 - u1.
        if y3 is None:
            gap31, m, m1 = ONE, ZERO, ONE
            strength, reach, above_top = -cubic[2], ONE, ONE
        else:
            gap31 = y3 - y1
            m, m1 = gap21 / gap31, gap32 / gap31
            strength, reach, above_top = cubic[3], y3 + 2 * c0, y3 - 2 * s0
        w = (strength * gap31 / 4).sqrt()
        # Distances to the poles.  u'^2 at u = -1 and u = 1 is -(A+-/lambda1)^2, so the product of
        # three distances is known, and the smallest of them needs no difference.
        from_bottom2, from_top1, from_top2 = 2 * c0 + y2, 2 * s0 - y1, 2 * s0 - y2
        scale = self.lambda1 ** 2 * strength
        from_bottom1 = self.a_plus ** 2 / (scale * from_bottom2 * reach)
        if from_top2 <= above_top:
            from_top2 = self.a_minus ** 2 / (scale * from_top1 * above_top)
        else:
            above_top = self.a_minus ** 2 / (scale * from_top1 * from_top2)
        beta_is_dn = above_top == 0     # u3 = 1 exactly: beta never vanishes

        form = ThetaForm.of(m, m1)
        # Poles: alpha = 0 at the imaginary phase i a, beta = 0 at K + i b [DLMF 19.25(v)].
        a = (gap31 * from_bottom1).sqrt() * carlson_rf(
            gap31 * gap21, gap21 * reach, gap31 * from_bottom2)
        b = form.K_prime if beta_is_dn else (gap31 * from_top2).sqrt() * carlson_rf(
            gap21 * above_top, gap21 * gap32, gap32 * from_top1)

        quarter0, offset0 = self.start_phase(
            -y1 / gap21, y2 / gap21, ONE if y3 is None else y3 / gap31, m1, form.K)
        start = form, quarter0, pi() / 2 * offset0
        size_alpha, size_beta = (from_bottom2 / 2).sqrt(), (from_top1 / 2).sqrt()
        beta_branches = _beta_dn if beta_is_dn else _beta
        s_alpha, s_beta = sign(self.a_plus), sign(self.a_minus)

        def rate(spin: Decimal, momentum: Decimal, distance: Decimal, pole: Decimal) -> Decimal:
            uniform = spin / 2 + momentum / (2 * self.lambda1 * distance)
            if not momentum:
                return uniform
            return uniform + sign(momentum) * w * (pi() / (2 * form.K) - form.log_slope(pole))

        slope_even, slope_odd = form.slopes_of_sn2()
        full_form = form.real() if m1 >= FULL_CIRCLE_M1 else None
        alpha = _factor(
            *start, s_alpha, a, _alpha(form, s_alpha, a, size_alpha),
            _alpha(full_form, s_alpha, a, size_alpha)[0] if full_form else None,
            rate=rate(self.excess_spin, self.a_plus, from_bottom2, a),
            turns=alpha_turns, derivative=-self.sin_half * self.theta_dot)
        beta = _factor(
            *start, s_beta, b, beta_branches(form, s_beta, b, size_beta),
            beta_branches(full_form, s_beta, b, size_beta)[0] if full_form else None,
            rate=rate(-self.excess_spin, self.a_minus, from_top1, b),
            turns=beta_turns, derivative=self.cos_half * self.theta_dot)
        return ThetaMotion(
            digits=getcontext().prec, alpha=alpha, beta=beta,
            imaginary=form.imaginary,
            full_circle=full_form.denominator_even() if full_form else None,
            stretch=form.K / form.K_prime if form.imaginary else ONE,
            quarter_rate=w / form.K, quarter0=quarter0, offset0=offset0,
            u_dot=(w * gap21 * slope_even, w * gap21 * slope_odd), u_dot_series=form.theta1(),
            turning=(beta.sign, -alpha.sign * beta.sign)
            if alpha.crosses and beta.crosses else None,
            m=m, m1=m1,
            theta_bounds=(2 * atan2(from_top2.sqrt(), from_bottom2.sqrt()),
                          2 * atan2(from_top1.sqrt(), from_bottom1.sqrt())))

    def start_phase(self, sn2: Decimal, cn2: Decimal, dn2: Decimal, m1: Decimal, K: Decimal
                    ) -> tuple[int, Decimal]:
        """
        Return the phase at t = 0 in quarter periods, as the nearest whole number and the rest.

        u = u1 + (u2 - u1) sn^2, so the phase is negative while u falls.  From
        F = sn R_F(cn^2, dn^2, 1) [DLMF 19.25.5], or the same from the quarter period K with
        sn(K - chi) = cn/dn.
        """
        falling = -1 if self.theta_dot > 0 else 1
        if sn2 * (1 + m1.sqrt()) < 1:
            return 0, falling * sn2.sqrt() * carlson_rf(cn2, dn2, ONE) / K
        from_quarter = (cn2 / dn2).sqrt() * carlson_rf(m1 * sn2 / dn2, m1 / dn2, ONE) / K
        return falling, -falling * from_quarter


def _branch(series: tuple[Series, Series], scale: Decimal, s: int, crossing: int) -> Branch:
    """Return R + i s J scaled; through a pole exactly (s = 0) R, or crossing * J, is all of it."""
    real, imag = series
    if s:
        return Branch(real.scaled(scale), imag.scaled(scale))
    return Branch(imag.scaled(crossing * scale) if crossing else real.scaled(scale), None)


def _alpha(form: ThetaForm, s: int, a: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta1 over even, theta2 over odd quarter periods; |alpha| = size at u = u2."""
    theta1, theta2 = form.shifted_theta1(a), form.shifted_theta2(a)
    scale = size * form.denominator_odd().at_zero / theta2[0].at_zero
    return _branch(theta1, scale, s, 1), _branch(theta2, scale, s, 0)


def _beta(form: ThetaForm, s: int, b: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta2 over even, theta1 over odd quarter periods; |beta| = size at u = u1."""
    theta1, theta2 = form.shifted_theta1(b), form.shifted_theta2(b)
    scale = size * form.denominator_even().at_zero / theta2[0].at_zero
    return _branch(theta2, scale, s, 0), _branch(theta1, scale * form.odd_over_even, s, -1)


def _beta_dn(form: ThetaForm, s: int, b: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta3 over even, theta4 over odd quarter periods: beta = sin(theta/2) is a dn."""
    even, odd = form.denominator_even(), form.denominator_odd()
    scale = size * even.at_zero / odd.at_zero
    return Branch(odd.scaled(scale), None), Branch(even.scaled(scale * form.odd_over_even), None)


def _factor(form: ThetaForm, quarters: int, y: Decimal, s: int, pole: Decimal,
            branches: tuple[Branch, Branch], full_circle: Branch | None, *, rate: Decimal,
            turns: Decimal, derivative: Decimal) -> Factor:
    """
    Return alpha or beta with its argument at t = 0.

    quarters, y : phase of the nutation at t = 0
    turns : argument at t = 0
    derivative : of a real factor that starts at zero
    """
    drift = s * (pole / form.K_prime - 1) if form.imaginary else Decimal(-s)
    branch = branches[quarters % 2]
    sin, cos = sinh_cosh(y * form.K / form.K_prime) if form.imaginary else sin_cos(y)
    xi = -sin * sin if form.imaginary else sin * sin
    real = branch.real(sin, cos, xi)
    crosses = any(x.has_zero for x in branches)
    start_sign = 1
    argument = ZERO
    if branch.imag is not None:
        argument = drift * y + s * atan2(branch.imag(sin, cos, xi), real)
    elif crosses:
        flip = 1 if quarters % 4 < 2 else -1
        growing = flip * branch.real.weights[0]     # if it is zero now, it leaves with y
        start_sign = sign(flip * real) or sign(growing) * sign(derivative) or 1
    return Factor(s, rate, turns - argument / (2 * pi()), argument, drift, crosses,
                  start_sign, *branches, full_circle)
