# SPDX-License-Identifier: Apache-2.0
"""
The heavy symmetric top in Klein's theta functions: everything that is done once for a trajectory.

With u = cos(theta) and P = M g R the nutation obeys u'^2 = (2P/lambda1)(u-u1)(u2-u)(u3-u), and the
Cayley-Klein parameters

    alpha = w + iz = cos(theta/2) exp(i(phi+psi)/2)
    beta  = y - ix = sin(theta/2) exp(i(phi-psi)/2)

are each a theta function of the nutation's phase over a common one, times a uniform rotation:

    alpha = (A_alpha/D(y)) (R + i s J)(y) exp i(rate t + phase + s kappa y),     R + i s J = theta(y - i s a)

(F. Klein, A. Sommerfeld, Ueber die Theorie des Kreisels, ch. VI;  E. T. Whittaker, Analytical
Dynamics, sect. 72-76;  theta functions, nome q and quarter periods K, K' as in DLMF ch. 20 and 22,
R_F as in DLMF ch. 19).  So a state costs the same at every t.  The phase is counted in quarter
periods, Z = N + 2y/pi with N whole and |y| <= pi/4: over even N (u near u1) alpha is theta1 and
beta theta2, over odd N (u near u2) the other way round.

The work is done in long decimals, 60 digits and more if two roots of the cubic are close, because
everything that cancels, cancels here: close to a pole, to the separatrix, to steady precession.
What comes out are coefficients, frequencies and phases for evaluation in doubles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from decimal import Context, Decimal, DecimalException, getcontext, localcontext

from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.long_decimals import (
    ONE,
    ZERO,
    atan2,
    carlson_rf,
    complete_integral,
    one_minus_exp,
    pi,
    reduced_turns,
    sign,
    sin_cos,
    sinh_cosh,
)

FIRST_DIGITS = 60
MOST_DIGITS = 480
KEPT_DIGITS = 40        # what must be left of the digits after the discriminant has cancelled
TERMS = 4               # the nome is <= exp(-pi) here: the fifth term is below 1e-21
MODE_TOLERANCE = Decimal('1e-19')


class _RootsTooClose(ArithmeticError):
    """Two roots of the cubic agree to most of the digits at hand."""


# ------------------------------------------------------------------------------- what is handed on


@dataclass(frozen=True)
class Series:
    """
    A sum of weights[k] times cos or sin of n y, n = 1, 3, 5... or 0, 2, 4...

    In the imaginary form y stands for ix: cosh for cos, sinh for sin.
    """

    kind: str
    weights: tuple[Decimal, ...]

    # What every term has in common, as an index into (1, cos y, sin y, sin y cos y).
    PREFACTORS = {'cos even': 0, 'cos odd': 1, 'sin odd': 2, 'sin even': 3}  # noqa: RUF012

    @property
    def prefactor(self) -> int:
        return self.PREFACTORS[self.kind]

    def polynomial(self) -> list[Decimal]:
        """Return c[i] with sum = prefactor * sum_i c[i] xi^i, xi = sin^2 y (or -sinh^2 x)."""
        total = [ZERO] * len(self.weights)
        for weight, shape in zip(self.weights, _multiple_angles(self.kind), strict=False):
            for i, coefficient in enumerate(shape):
                if coefficient:         # 'sin even' has one coefficient more than its degree
                    total[i] += weight * coefficient
        return total

    def __call__(self, sin: Decimal, cos: Decimal, xi: Decimal) -> Decimal:
        value = ZERO
        for coefficient in reversed(self.polynomial()):
            value = value * xi + coefficient
        return value * (ONE, cos, sin, sin * cos)[self.prefactor]

    def scaled(self, scale: Decimal) -> Series:
        return Series(self.kind, tuple(scale * weight for weight in self.weights))


def _multiple_angles(kind: str) -> Iterator[list[int]]:
    """
    Yield the polynomials in xi = sin^2 y that cos n y or sin n y are, less the common prefactor.

    From f(n+2) = (2 - 4 xi) f(n) - f(n-2) [DLMF 4.21(iii)].
    """
    before, now = {'cos odd': ([1], [1]), 'sin odd': ([-1], [1]),
                   'cos even': ([1, -2], [1]), 'sin even': ([-2], [0])}[kind]
    while True:
        yield now
        after = [2 * x for x in now] + [0]
        for i, x in enumerate(now):
            after[i + 1] -= 4 * x
        for i, x in enumerate(before):
            after[i] -= x
        before, now = now, after


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
    full_circle: Branch | None  # the even branch in the real form, good for every y; see `modes`


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
    stretch: Decimal            # x = stretch y in the imaginary form
    quarter_rate: Decimal       # quarter periods per second, w/K
    quarter0: int               # phase at t = 0 in quarter periods: whole part,
    offset0: Decimal            # and a rest in [-1/2, 1/2], accurate relative to itself
    u_dot: tuple[Decimal, Decimal]      # cos(theta)' = u_dot * u_dot_series(2y)/D^4 over even, odd N
    u_dot_series: Series
    turning: tuple[int, int] | None     # planar rotation: see ThetaMotion.line
    a_plus: Decimal             # Lz + L3
    a_minus: Decimal            # Lz - L3
    m: Decimal
    m1: Decimal                 # 1 - m, without cancellation: the distance to the separatrix
    theta_bounds: tuple[Decimal, Decimal]

    @property
    def nutation_period(self) -> Decimal | None:
        """2K/w [s]; None if the nutation rests."""
        return 2 / self.quarter_rate if self.quarter_rate else None

    @property
    def mean_precession_rate(self) -> Decimal:
        return self.alpha.rate + self.beta.rate

    @property
    def mean_spin_rate(self) -> Decimal:
        return self.alpha.rate - self.beta.rate


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
        with localcontext(Context(prec=digits, Emin=-10 ** 12, Emax=10 ** 12)):
            try:
                return _set_up(top, start)
            except _RootsTooClose:
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
    with localcontext() as context:
        context.prec = 2000
        angles = ((Decimal(start.phi) + Decimal(start.psi)) / 2,
                  (Decimal(start.phi) - Decimal(start.psi)) / 2)
    alpha_turns, beta_turns = (reduced_turns(x) for x in (angles[::-1] if upside_down else angles))
    motion = _Orbit(lambda1, lambda3, gravity_torque, l3, lz, sin_half, cos_half,
                    theta_dot).motion(alpha_turns, beta_turns)
    return _upside_down(motion) if upside_down else motion


def _upside_down(motion: ThetaMotion) -> ThetaMotion:
    values = dict(vars(motion))
    low, high = motion.theta_bounds
    values.update(
        alpha=motion.beta, beta=motion.alpha,
        a_plus=motion.a_minus, a_minus=motion.a_plus,
        u_dot=(-motion.u_dot[0], -motion.u_dot[1]),
        theta_bounds=(pi() - high, pi() - low))
    if motion.turning:
        intercept, slope = motion.turning
        values.update(turning=(1 - intercept, -slope))
    return ThetaMotion(**values)


# -------------------------------------------------------------------------------------- the cubic


@dataclass(frozen=True)
class _Roots:
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
        raise _RootsTooClose
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
    while True:
        step = (((y + a2) * y + a1) * y + a0) / ((3 * y + 2 * a2) * y + a1)
        y -= step
        if step * side <= abs(y) * resolution:
            return y, side


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
    low, high, gap = _quadratic_roots((a1 - product) / y, product)  # near a pole -a2 - y cancels
    if side < 0:
        return _Roots(y, low, high, low - y, gap)
    return _Roots(low, high, y, gap, y - high)


# ------------------------------------------------------------------------ theta functions and nome


@dataclass(frozen=True)
class _ThetaForm:
    """
    The theta series in the real form (nome q, circular functions of y) or in the imaginary form
    (Jacobi's transformation [DLMF 20.7(viii)]: nome q', hyperbolic functions of x = y K/K').
    """

    K: Decimal
    K_prime: Decimal            # infinite for m = 0
    imaginary: bool
    nome: Decimal
    terms: int = TERMS

    @classmethod
    def of(cls, m: Decimal, m1: Decimal) -> _ThetaForm:
        """Choose the form with the smaller nome, at most exp(-pi)."""
        K = complete_integral(m1)
        K_prime = complete_integral(m) if m else Decimal('Infinity')
        imaginary = m > m1
        return cls(K, K_prime, imaginary,
                   (-pi() * (K / K_prime if imaginary else K_prime / K)).exp())

    def real(self) -> _ThetaForm:
        """Return the real form whatever the nome, with all the terms it takes."""
        nome = (-pi() * self.K_prime / self.K).exp()
        terms = 1
        while nome ** (terms * terms) > MODE_TOLERANCE:
            terms += 1
        return _ThetaForm(self.K, self.K_prime, False, nome, terms + 1)

    def _weights(self, weight: Callable[[int], Decimal], alternating: bool = False
                 ) -> tuple[Decimal, ...]:
        return tuple((-1) ** (k * alternating) * weight(k) for k in range(self.terms))

    def _power(self, exponent: int) -> Decimal:
        return self.nome ** exponent if exponent else ONE

    def _square(self, k: int) -> Decimal:
        """Weights of theta3, and alternating of theta4 [DLMF 20.2.3, 20.2.4]."""
        return (2 if k else 1) * self._power(k * k)

    def _pronic(self, k: int) -> Decimal:
        """Weights of theta2, and alternating of theta1, less 2 nome^(1/4) [DLMF 20.2.1, 2]."""
        return self._power(k * (k + 1))

    def denominator_even(self) -> Series:
        """theta4(y), D over even quarter periods."""
        if self.imaginary:
            return Series('cos odd', self._weights(self._pronic))
        return Series('cos even', self._weights(self._square, alternating=True))

    def denominator_odd(self) -> Series:
        """theta3(y), D over odd quarter periods."""
        return Series('cos even', self._weights(self._square))

    def theta1(self) -> Series:
        return Series('sin odd', self._weights(self._pronic, alternating=True))

    def shifted_theta1(self, a: Decimal) -> tuple[Series, Series]:
        """R and J of i theta1(y - ia), less positive constants."""
        if self.imaginary:
            angle = pi() * a / (2 * self.K_prime)
            sines, cosines = zip(*(sin_cos((2 * k + 1) * angle) for k in range(self.terms)),
                                 strict=True)
            return (Series('cos odd', self._weights(lambda k: self._pronic(k) * sines[k], True)),
                    Series('sin odd', self._weights(lambda k: self._pronic(k) * cosines[k], True)))
        minus, plus = self._growing_weights(a)
        return (Series('cos odd', self._weights(lambda k: minus[k], True)),
                Series('sin odd', self._weights(lambda k: plus[k], True)))

    def shifted_theta2(self, a: Decimal) -> tuple[Series, Series]:
        """R and J of theta2(y - ia), less positive constants."""
        if self.imaginary:
            angle = pi() * a / (2 * self.K_prime)
            sines, cosines = zip(*(sin_cos(2 * k * angle) for k in range(self.terms)), strict=True)
            return (Series('cos even', self._weights(lambda k: self._square(k) * cosines[k], True)),
                    Series('sin even', self._weights(lambda k: -self._square(k) * sines[k], True)))
        minus, plus = self._growing_weights(a)
        return Series('cos odd', tuple(plus)), Series('sin odd', tuple(minus))

    def _growing_weights(self, a: Decimal) -> tuple[list[Decimal], list[Decimal]]:
        """
        Return 2 q^(k(k+1)) exp(-A) times sinh, and cosh, of (2k+1) A, with A = pi a/(2K).

        That is q^(k^2) g^k (1 -+ E^(2k+1)) with E = exp(-2A), g = q/E <= 1: no large numbers.
        """
        depth = pi() * a / self.K
        g = (depth - pi() * self.K_prime / self.K).exp()
        E, one_minus_E = (-depth).exp(), one_minus_exp(depth)
        minus, plus = [], []
        for k in range(self.terms):
            growth = self._power(k * k) * (g ** k if k else 1)
            one_minus_power = one_minus_E * sum((E ** j for j in range(1, 2 * k + 1)), ONE)
            minus.append(growth * one_minus_power)
            plus.append(growth * (2 - one_minus_power))
        return minus, plus

    def log_slope(self, a: Decimal) -> Decimal:
        """tau(a) = d/da log theta2(ia), to full precision: it sets the mean rates."""
        if self.imaginary:
            angle = pi() * a / (2 * self.K_prime)
            waves = [sin_cos(2 * k * angle) for k in range(self.with_all_terms().terms)]
            slope = sum((-1) ** k * 2 * k * self._square(k) * s for k, (s, _) in enumerate(waves))
            value = sum((-1) ** k * self._square(k) * c for k, (_, c) in enumerate(waves))
            return (pi() / (2 * self.K_prime) * (a / self.K - slope / value))
        minus, plus = self.with_all_terms()._growing_weights(a)
        slope = sum((2 * k + 1) * x for k, x in enumerate(minus))
        return pi() / (2 * self.K) * slope / sum(plus)

    def with_all_terms(self) -> _ThetaForm:
        """Return the same form with every term that reaches the working precision."""
        if not self.nome:
            return self
        digits_per_square = -self.nome.adjusted() - 1           # at least 1
        return replace(self, terms=2 + math.isqrt(getcontext().prec // digits_per_square))


# --------------------------------------------------------------------------------------- the orbit


class _Orbit:
    """
    The motion of a top with P >= 0.

    Squares of sin and cos of theta0/2 stand for theta0, so that nothing cancels at either pole.
    """

    def __init__(self, lambda1: Decimal, lambda3: Decimal, gravity_torque: Decimal,
                 l3: Decimal, lz: Decimal, sin_half: Decimal, cos_half: Decimal,
                 theta_dot: Decimal):
        self.lambda1 = lambda1
        self.gravity_torque = gravity_torque
        self.l3 = l3
        self.sin_half, self.cos_half = sin_half, cos_half
        self.s0, self.c0 = sin_half ** 2, cos_half ** 2
        self.theta_dot = theta_dot
        self.a_plus, self.a_minus = lz + l3, lz - l3
        self.excess_spin = l3 * (1 / lambda3 - 1 / lambda1)     # turns the body, not its axis

    def motion(self, alpha_turns: Decimal, beta_turns: Decimal) -> ThetaMotion:
        coefficients = self.cubic()
        if coefficients[0] == 0 and coefficients[1] == 0:
            return self.resting(alpha_turns, beta_turns)
        return self.nutating(_cubic_roots(*coefficients), coefficients, alpha_turns, beta_turns)

    def cubic(self) -> tuple[Decimal, Decimal, Decimal, Decimal]:
        """Coefficients of u'^2 in powers of u - u0."""
        lambda1, P, l3, s0, c0 = self.lambda1, self.gravity_torque, self.l3, self.s0, self.c0
        u0 = c0 - s0
        momentum = self.a_minus + 2 * l3 * s0 if s0 < c0 else self.a_plus - 2 * l3 * c0  # Lz - L3 u0
        sin_squared = 4 * s0 * c0
        precession_squared = (momentum / lambda1) ** 2 / sin_squared if sin_squared else ZERO
        energy = lambda1 * (self.theta_dot ** 2 + precession_squared) / 2   # of the axis' motion
        return (sin_squared * self.theta_dot ** 2,
                -2 / lambda1 * (2 * u0 * energy + P * sin_squared)
                + 2 * momentum * l3 / lambda1 ** 2,
                2 / lambda1 * (2 * u0 * P - energy) - (l3 / lambda1) ** 2,
                2 * P / lambda1)

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
            imaginary=False, stretch=ONE, quarter_rate=ZERO, quarter0=0, offset0=ZERO,
            u_dot=(ZERO, ZERO), u_dot_series=Series('sin odd', (ONE,)), turning=None,
            a_plus=self.a_plus, a_minus=self.a_minus, m=ZERO, m1=ONE,
            theta_bounds=(theta, theta))

    def nutating(self, roots: _Roots, coefficients: tuple[Decimal, ...],
                 alpha_turns: Decimal, beta_turns: Decimal) -> ThetaMotion:
        y1, y2, y3 = roots.y1, roots.y2, roots.y3
        gap21, gap32 = roots.gap21, roots.gap32
        # w is the frequency of sn(w t); `strength` is f3, with the factor u3 - u1 if that is
        # infinite.  `reach` = 1 + u3 and above_top = u3 - 1 then are 1, relative to u3 - u1.
        if y3 is None:
            gap31, m, m1 = ONE, ZERO, ONE
            strength, reach, above_top = -coefficients[2], ONE, ONE
        else:
            gap31 = y3 - y1
            m, m1 = gap21 / gap31, gap32 / gap31
            strength, reach, above_top = coefficients[3], y3 + 2 * self.c0, y3 - 2 * self.s0
        w = (strength * gap31 / 4).sqrt()
        # Distances to the poles.  u'^2 at u = -1 and u = 1 is -(A+-/lambda1)^2, so the product of
        # three distances is known, and the smallest of them needs no difference.
        from_bottom2, from_top1, from_top2 = 2 * self.c0 + y2, 2 * self.s0 - y1, 2 * self.s0 - y2
        scale = self.lambda1 ** 2 * strength
        from_bottom1 = self.a_plus ** 2 / (scale * from_bottom2 * reach)
        if from_top2 <= above_top:
            from_top2 = self.a_minus ** 2 / (scale * from_top1 * above_top)
        else:
            above_top = self.a_minus ** 2 / (scale * from_top1 * from_top2)
        beta_is_dn = above_top == 0     # u3 = 1 exactly: beta never vanishes

        form = _ThetaForm.of(m, m1)
        # Poles: alpha = 0 at the imaginary phase i a, beta = 0 at K + i b [DLMF 19.25(v)].
        a = (gap31 * from_bottom1).sqrt() * carlson_rf(
            gap31 * gap21, gap21 * reach, gap31 * from_bottom2)
        b = form.K_prime if beta_is_dn else (gap31 * from_top2).sqrt() * carlson_rf(
            gap21 * above_top, gap21 * gap32, gap32 * from_top1)

        quarter0, offset0 = self.start_phase(
            -y1 / gap21, y2 / gap21, ONE if y3 is None else y3 / gap31, m1, form.K)
        clock = _StartPhase(form, quarter0, pi() / 2 * offset0)
        size_alpha, size_beta = (from_bottom2 / 2).sqrt(), (from_top1 / 2).sqrt()
        beta_forms = _beta_dn if beta_is_dn else _beta
        s_alpha, s_beta = sign(self.a_plus), sign(self.a_minus)

        def rate(spin: Decimal, momentum: Decimal, distance: Decimal, pole: Decimal) -> Decimal:
            uniform = spin / 2 + momentum / (2 * self.lambda1 * distance)
            if not momentum:
                return uniform
            return uniform + sign(momentum) * w * (pi() / (2 * form.K) - form.log_slope(pole))

        full_form = form.real() if m1 >= FULL_CIRCLE_M1 else None
        alpha = clock.factor(
            s_alpha, a, rate(self.excess_spin, self.a_plus, from_bottom2, a), alpha_turns,
            -self.sin_half * self.theta_dot, _alpha(form, s_alpha, a, size_alpha),
            _alpha(full_form, s_alpha, a, size_alpha)[0] if full_form else None)
        beta = clock.factor(
            s_beta, b, rate(-self.excess_spin, self.a_minus, from_top1, b), beta_turns,
            self.cos_half * self.theta_dot, beta_forms(form, s_beta, b, size_beta),
            beta_forms(full_form, s_beta, b, size_beta)[0] if full_form else None)
        return ThetaMotion(
            digits=getcontext().prec, alpha=alpha, beta=beta,
            imaginary=form.imaginary,
            stretch=form.K / form.K_prime if form.imaginary else ONE,
            quarter_rate=w / form.K, quarter0=quarter0, offset0=offset0,
            u_dot=_u_dot_scales(form, w * gap21), u_dot_series=form.theta1(),
            turning=(beta.sign, -alpha.sign * beta.sign)
            if alpha.crosses and beta.crosses else None,
            a_plus=self.a_plus, a_minus=self.a_minus, m=m, m1=m1,
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
        return falling, -falling * (cn2 / dn2).sqrt() * carlson_rf(m1 * sn2 / dn2, m1 / dn2, ONE) / K


FULL_CIRCLE_M1 = Decimal('1e-5')    # below, the real form takes too many terms and cancels


def _alpha(form: _ThetaForm, s: int, a: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta1 over even, theta2 over odd quarter periods; |alpha| = size at u = u2."""
    (R1, J1), (R2, J2) = form.shifted_theta1(a), form.shifted_theta2(a)
    scale = size * _at_zero(form.denominator_odd()) / _at_zero(R2)
    if not s:                           # through the bottom pole exactly: alpha is real
        return Branch(J1.scaled(scale), None), Branch(R2.scaled(scale), None)
    return (Branch(R1.scaled(scale), J1.scaled(scale)),
            Branch(R2.scaled(scale), J2.scaled(scale)))


def _beta(form: _ThetaForm, s: int, b: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta2 over even, theta1 over odd quarter periods; |beta| = size at u = u1."""
    (R1, J1), (R2, J2) = form.shifted_theta1(b), form.shifted_theta2(b)
    scale = size * _at_zero(form.denominator_even()) / _at_zero(R2)
    odd_scale = scale * _odd_over_even(form)
    if not s:                           # through the top pole exactly: beta is real
        return Branch(R2.scaled(scale), None), Branch(J1.scaled(-odd_scale), None)
    return (Branch(R2.scaled(scale), J2.scaled(scale)),
            Branch(R1.scaled(odd_scale), J1.scaled(odd_scale)))


def _beta_dn(form: _ThetaForm, s: int, b: Decimal, size: Decimal) -> tuple[Branch, Branch]:
    """theta3 over even, theta4 over odd quarter periods: beta = sin(theta/2) is a dn."""
    even, odd = form.denominator_even(), form.denominator_odd()
    scale = size * _at_zero(even) / _at_zero(odd)
    return Branch(odd.scaled(scale), None), Branch(even.scaled(scale * _odd_over_even(form)), None)


def _odd_over_even(form: _ThetaForm) -> Decimal:
    """theta1 and theta4 have lost a factor 2 q'^(1/4) that theta2 and theta3 then lack."""
    return 4 * form.nome.sqrt() if form.imaginary else ONE


def _u_dot_scales(form: _ThetaForm, scale: Decimal) -> tuple[Decimal, Decimal]:
    """cos(theta)' = scale * 2 sn cn dn, as one theta function [DLMF 20.7.10, 22.2]."""
    theta3, theta4 = _at_zero(form.denominator_odd()), _at_zero(form.denominator_even())
    pronics = [form._pronic(k) for k in range(form.terms)]
    if not form.imaginary:
        cu = scale * theta3 * theta4 ** 3 / sum(pronics)
        return cu, -cu
    slope = sum((-1) ** k * (2 * k + 1) * x for k, x in enumerate(pronics))
    cu = 2 * scale * theta4 ** 4 * form.K_prime / (pi() * slope)
    return cu, -16 * form.nome * cu


def _at_zero(series: Series) -> Decimal:
    return sum(series.weights, ZERO)


@dataclass(frozen=True)
class _StartPhase:
    """Where the nutation is at t = 0: alpha and beta must have the start's arguments there."""

    form: _ThetaForm
    quarters: int
    y: Decimal

    def factor(self, s: int, pole: Decimal, rate: Decimal, turns: Decimal, derivative: Decimal,
               branches: tuple[Branch, Branch], full_circle: Branch | None) -> Factor:
        """`turns`: the argument at t = 0; `derivative`: of a real factor that starts at zero."""
        drift = s * (pole / self.form.K_prime - 1) if self.form.imaginary else Decimal(-s)
        branch = branches[self.quarters % 2]
        if self.form.imaginary:
            sin, cos = sinh_cosh(self.y * self.form.K / self.form.K_prime)
            xi = -sin * sin
        else:
            sin, cos = sin_cos(self.y)
            xi = sin * sin
        real = branch.real(sin, cos, xi)
        crosses = any(x.has_zero for x in branches)
        start_sign = 1
        argument = ZERO
        if branch.imag is not None:
            argument = drift * self.y + s * atan2(branch.imag(sin, cos, xi), real)
        elif crosses:
            flip = 1 if self.quarters % 4 < 2 else -1
            growing = flip * branch.real.weights[0]     # if it is zero now, it leaves with y
            start_sign = sign(flip * real) or sign(growing) * sign(derivative) or 1
        return Factor(s, rate, turns - argument / (2 * pi()), argument, drift, crosses,
                      start_sign, *branches, full_circle)
