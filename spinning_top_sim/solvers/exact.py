# SPDX-License-Identifier: Apache-2.0
"""
The exact motion of the heavy symmetric top, state by state.

`theta_setup` finds the theta functions of a trajectory once; here they are evaluated, in doubles,
at the same cost and accuracy for every t.  Three things keep the error at a few roundings after
years: the rates come from long decimals, the time that multiplies them is an integer of
nanoseconds (or a double, without rounding the product), and the phase of the nutation is
counted from the nearest quarter period, where the theta functions are short polynomials.

This module does one state at a time with `math`; `exact_arrays`, imported when an array is asked
for, does many with numpy.  The formulas that both need stand here, in `nutation_at` and in the
functions after it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal
from math import cos, sin, sinh, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact_attitude import (
    HALF_TURN,
    Quaternion,
    attitude_by_waves,
    too_late,
)
from spinning_top_sim.solvers.long_decimals import (
    FIXED_BITS,
    FIXED_HALF,
    FIXED_ONE,
    FIXED_UNIT,
    FRACTION_MASK,
    RADIANS_PER_UNIT,
    ZERO,
    FixedRate,
    pi,
    precision,
)
from spinning_top_sim.solvers.theta_series import TERMS, Series
from spinning_top_sim.solvers.theta_setup import Branch, ThetaMotion, set_up

if TYPE_CHECKING:
    import numpy as np

    from spinning_top_sim.solvers.exact_arrays import ArrayEvaluator, ExactStates

QUARTER_PERIOD_ANGLE = 0.5 * math.pi

# Beyond so many turns the product of rate and time has no exact fraction left.
MOST_TURNS = 2.0 ** 52
# Smaller amplitudes leave no room for their products in doubles.
LEAST_AMPLITUDE = Decimal('1e-290')
# Larger numbers leave none for splitting them.
MOST = Decimal('1e290')
# Closer to the separatrix hyperbolic functions overflow.
LEAST_M1 = Decimal('1e-290')


class ExactSolution:
    """
    The motion of `top` that is in the state `start` at t = 0.

    Quaternions turn body into world, (x, y, z, w), their sign continuous in time.  theta goes
    smoothly through a pole that is passed exactly (and out of [0, pi]), phi and psi are unwrapped.
    On every motion each of them, over max(1, |value|), is within 5e-15.

    Attributes: nutation_period [s], None if the nutation rests; mean_precession_rate and
    mean_spin_rate [rad/s]; theta_min and theta_max [rad], of theta folded into [0, pi];
    m and m1 = 1 - m, the parameter of the elliptic functions: m1 -> 0 on the separatrix;
    time_limit [s] and ns_limit [ns], the farthest time either way.

    Raises ValueError for motions whose constants doubles cannot hold, and, from every evaluation,
    for times at which a phase exceeds 2^52 turns.
    """

    def __init__(self, top: Top, start: State):
        self.top, self.start = top, start
        self.theta_motion = motion = set_up(top, start)
        with precision(motion.digits):
            self._take_over(motion, top, start)
            by_waves = attitude_by_waves(motion, self.ns_limit, self.time_limit)
        # No reference to self in it: a solution goes when its motion ends, not when Python next
        # looks for cycles.
        if by_waves is not None:
            self.quaternion_at = by_waves       # type: ignore[assignment, method-assign]
        self._check_start()
        self._arrays: ArrayEvaluator | None = None

    def _check_start(self) -> None:
        """Refuse constants so far apart that doubles lose the start among them."""
        theta, theta_dot, *_ = self.state_at(0)
        for name, value, wanted in (('theta', theta, self.start.theta),
                                    ('theta_dot', theta_dot, self.start.theta_dot)):
            if not abs(value - wanted) <= 1e-14 * max(1.0, abs(wanted)):
                raise ValueError(f'{name} = {wanted!r} cannot be held in doubles: the constants '
                                 f'of {self.top} and {self.start} are too far apart in size')

    def _take_over(self, motion: ThetaMotion, top: Top, start: State) -> None:
        if motion.m1 < LEAST_M1:
            raise ValueError(f'm1 = {motion.m1:.3e} for {top} from {start}: the motion is closer '
                             f'to the separatrix than {LEAST_M1}')
        self.m, self.m1 = float(motion.m), float(motion.m1)
        period = motion.nutation_period
        self.nutation_period = None if period is None else float(period)
        for name, value in (('the rate of the nutation', motion.quarter_rate),
                            ('the rate of (phi + psi)/2', motion.alpha.rate),
                            ('the rate of (phi - psi)/2', motion.beta.rate)):
            _in_range(name, value)
        self.mean_precession_rate = _in_range('mean precession rate', motion.mean_precession_rate)
        self.mean_spin_rate = _in_range('mean spin rate', motion.mean_spin_rate)
        self.theta_min, self.theta_max = (float(x) for x in motion.theta_bounds)

        # phi = precession rate * t + phase + alpha's and beta's arguments; psi with a minus.
        alpha, beta = motion.alpha, motion.beta
        self.phi_phase = float(
            Decimal(start.phi) - alpha.start_argument - beta.start_argument)
        self.psi_phase = float(
            Decimal(start.psi) - alpha.start_argument + beta.start_argument)
        two_lambda1 = 2 * Decimal(top.lambda1)
        self.bottom_rate = _in_range('(lz + l3)/(2 lambda1)', motion.a_plus / two_lambda1)
        self.top_rate = _in_range('(lz - l3)/(2 lambda1)', motion.a_minus / two_lambda1)
        self.axial_rate = _in_range('l3/lambda3', Decimal(start.l3) / Decimal(top.lambda3))
        self.quarter0 = motion.quarter0
        self.branches = _nutation_branch(motion, 0), _nutation_branch(motion, 1)
        self._flat_branches = tuple(_flat(x) for x in self.branches)
        self.turning = _Turning.of(motion, start.theta) if motion.turning else None

        two_pi = 2 * pi()
        fastest = max(abs(motion.quarter_rate), abs(alpha.rate / two_pi), abs(beta.rate / two_pi),
                      Decimal('1e-300'))
        self.time_limit = min(float(Decimal(MOST_TURNS) / fastest), 1e300)   # [s]
        self.ns_limit = min(int(Decimal(MOST_TURNS) / fastest * 10 ** 9), 2 ** 63 - 1)
        self._quarter_rate, self._offset0 = FixedRate.of(motion.quarter_rate, motion.offset0)
        self._offset_rest = float(motion.offset0 - Decimal(self._offset0) / FIXED_ONE)
        self._alpha_turns = FixedRate.of(alpha.rate / two_pi, alpha.phase_turns + HALF_TURN)
        self._beta_turns = FixedRate.of(beta.rate / two_pi, beta.phase_turns + HALF_TURN)
        self._phi = FixedRate.of(motion.mean_precession_rate, ZERO)
        self._psi = FixedRate.of(motion.mean_spin_rate, ZERO)

    # ------------------------------------------------------------------------------ one state

    def quaternion_at(self, ns: int) -> Quaternion:
        """
        Return the attitude (x, y, z, w) at `ns`, a Python int of nanoseconds after the start.

        The formulas of `nutation_at`, with alpha and beta as complex numbers: no angles.  Most
        motions have a faster function in its place, see `exact_attitude`.
        Raises ValueError for a time too far away.
        """
        if not -self.ns_limit <= ns <= self.ns_limit:
            raise too_late(f'{ns} ns', self.time_limit)
        # As in _nutation_phase, without the call.
        phase = ns * self._quarter_rate + self._offset0
        whole = phase + FIXED_HALF >> FIXED_BITS
        quarters = self.quarter0 + whole
        part = (phase - (whole << FIXED_BITS)) * FIXED_UNIT + self._offset_rest
        y = QUARTER_PERIOD_ANGLE * part
        (alpha_real_prefactor, a3, a2, a1, a0, alpha_imag_prefactor, b3, b2, b1, b0,
         alpha_drift, alpha_crosses,
         beta_real_prefactor, c3, c2, c1, c0, beta_imag_prefactor, d3, d2, d1, d0,
         beta_drift, beta_crosses, imaginary, stretch) = self._flat_branches[quarters & 1]
        if imaginary:
            s = sinh(y * stretch)
            xi = -s * s
        else:
            s = sin(y)
            xi = s * s
        c = sqrt(1.0 - xi)
        prefactors = (1.0, c, s, s * c)
        alpha_real = prefactors[alpha_real_prefactor] * (((a3 * xi + a2) * xi + a1) * xi + a0)
        alpha_imag = prefactors[alpha_imag_prefactor] * (((b3 * xi + b2) * xi + b1) * xi + b0)
        beta_real = prefactors[beta_real_prefactor] * (((c3 * xi + c2) * xi + c1) * xi + c0)
        beta_imag = prefactors[beta_imag_prefactor] * (((d3 * xi + d2) * xi + d1) * xi + d0)
        if quarters & 2:
            if alpha_crosses:
                alpha_real = -alpha_real
            if beta_crosses:
                beta_real = -beta_real
        scale = 1.0 / sqrt(alpha_real * alpha_real + alpha_imag * alpha_imag
                           + beta_real * beta_real + beta_imag * beta_imag)
        rate, start = self._alpha_turns
        angle = (((ns * rate + start & FRACTION_MASK) - FIXED_HALF) * RADIANS_PER_UNIT
                 + alpha_drift * y)
        s, c = scale * sin(angle), scale * cos(angle)
        z = alpha_real * s + alpha_imag * c
        w = alpha_real * c - alpha_imag * s
        rate, start = self._beta_turns
        angle = (((ns * rate + start & FRACTION_MASK) - FIXED_HALF) * RADIANS_PER_UNIT
                 + beta_drift * y)
        s, c = scale * sin(angle), scale * cos(angle)
        return -beta_real * s - beta_imag * c, beta_real * c - beta_imag * s, z, w

    def _nutation_phase(self, ns: int) -> tuple[int, float]:
        """
        Return the nearest whole number of quarter periods, and the angle y from there.

        y keeps its relative accuracy when it is small: a top races past a pole that it misses by
        little.  What fixed point leaves out of a tiny offset at t = 0 is added as a double.
        """
        phase = ns * self._quarter_rate + self._offset0
        whole = phase + FIXED_HALF >> FIXED_BITS
        part = (phase - (whole << FIXED_BITS)) * FIXED_UNIT + self._offset_rest
        return self.quarter0 + whole, QUARTER_PERIOD_ANGLE * part

    def state_at(self, ns: int) -> tuple[float, float, float, float, float, float, float, float]:
        """Return (theta, theta_dot, phi, psi, x, y, z, w) at `ns`, an int [rad, rad/s]."""
        return self.full_state_at(ns)[:8]

    def full_state_at(self, ns: int) -> tuple[
            float, float, float, float, float, float, float, float, float, float, float]:
        """Return what `state_at` does, and the body's angular velocity in its frame [rad/s]."""
        if not -self.ns_limit <= ns <= self.ns_limit:
            raise too_late(f'{ns} ns', self.time_limit)
        quarters, y = self._nutation_phase(ns)
        point = nutation_at(self.branches[quarters & 1], y, -1.0 if quarters & 2 else 1.0, SCALAR)
        alpha, beta, alpha_argument, beta_argument, theta_dot = point
        half_theta = math.atan2(beta, alpha)
        if self.turning:
            half_theta += 2.0 * math.pi * round(self.turning.turns(quarters, y, half_theta))

        rate, start = self._alpha_turns
        angle = (((ns * rate + start & FRACTION_MASK) - FIXED_HALF) * RADIANS_PER_UNIT
                 + alpha_argument)
        sin_alpha, cos_alpha = sin(angle), cos(angle)
        rate, start = self._beta_turns
        angle = (((ns * rate + start & FRACTION_MASK) - FIXED_HALF) * RADIANS_PER_UNIT
                 + beta_argument)
        sin_beta, cos_beta = sin(angle), cos(angle)
        scale = 1.0 / sqrt(alpha * alpha + beta * beta)
        cos_half, sin_half = scale * alpha, scale * beta
        omega1, omega2 = transverse_rates(
            self.precession_across_axis(alpha, beta), theta_dot,
            cos_alpha * cos_beta + sin_alpha * sin_beta,
            sin_alpha * cos_beta - cos_alpha * sin_beta)
        return (2.0 * half_theta, theta_dot,
                ns * self._phi.rate * FIXED_UNIT
                + (self.phi_phase + (alpha_argument + beta_argument)),
                ns * self._psi.rate * FIXED_UNIT
                + (self.psi_phase + (alpha_argument - beta_argument)),
                -sin_half * sin_beta, sin_half * cos_beta,
                cos_half * sin_alpha, cos_half * cos_alpha,
                omega1, omega2, self.axial_rate)

    def precession_across_axis(self, alpha: Any, beta: Any) -> Any:
        """
        Return phi' sin(theta) from two numbers in the ratio of cos(theta/2) and sin(theta/2).

        Lz - L3 cos(theta) over lambda1 sin(theta), in half angles: nothing cancels, and at a pole
        that can be reached the singular term is absent.
        """
        precession = 0.0 * alpha
        if self.bottom_rate:
            precession = precession + self.bottom_rate * (beta / alpha)
        if self.top_rate:
            precession = precession + self.top_rate * (alpha / beta)
        return precession

    # ---------------------------------------------------------------------------- many states

    def states(self, t: np.ndarray) -> ExactStates:
        """
        Return the states at t, (n,) float64 seconds after the start, in any order and sign.

        Columns of the result are computed when asked for.
        Raises ValueError for a time that is not finite or too far.
        """
        return self.arrays.states(t)

    def states_at_ns(self, ns: np.ndarray) -> ExactStates:
        """
        Return the states at ns, (n,) int64 nanoseconds: exact where seconds would be rounded.

        Raises ValueError for an array of another kind, or a time too far away.
        """
        return self.arrays.states_at_ns(ns)

    def quaternion(self, t: np.ndarray) -> np.ndarray:
        """
        Return the attitudes (n, 4) x, y, z, w at t, (n,) float64 seconds, in any order.

        Raises ValueError for a time that is not finite or too far.
        """
        return self.arrays.quaternion(t)

    def quaternion_grid(self, start_ns: int, step_ns: int, count: int) -> np.ndarray:
        """
        Return the attitudes (count, 4) x, y, z, w at start_ns + k step_ns, in nanoseconds.

        Several times faster than `quaternion`, most so when called again with the same step;
        near the separatrix (m1 < 2e-4) as fast as that.
        Raises ValueError for a negative count, or a time too far away.
        """
        return self.arrays.quaternion_grid(start_ns, step_ns, count)

    @property
    def arrays(self) -> ArrayEvaluator:
        """The numpy half, imported and prepared when first asked for."""
        if self._arrays is None:
            from spinning_top_sim.solvers.exact_arrays import ArrayEvaluator  # noqa: PLC0415
            self._arrays = ArrayEvaluator(self)
        return self._arrays


class Functions(NamedTuple):
    """The functions that `nutation_at` takes from `math` or from numpy."""

    sin: Callable[[Any], Any]
    sinh: Callable[[Any], Any]
    sqrt: Callable[[Any], Any]
    hypot: Callable[[Any, Any], Any]
    atan2: Callable[[Any, Any], Any]


SCALAR = Functions(sin, sinh, sqrt, math.hypot, math.atan2)


class FactorBranch(NamedTuple):
    """
    Alpha or beta over even or odd quarter periods, in doubles.

    real, imag: coefficients in xi, highest first.  Their prefactors are indices into
    (1, cos y, sin y, sin y cos y), or the hyperbolic ones.  A real factor has sense 0.
    """

    real_prefactor: int
    real: tuple[float, ...]
    imag_prefactor: int
    imag: tuple[float, ...]
    sense: int
    drift: float
    crosses: bool
    has_zero: bool


class NutationBranch(NamedTuple):
    """Both factors and cos(theta)' over even or odd quarter periods."""

    alpha: FactorBranch
    beta: FactorBranch
    u_dot: float                    # times `magnifier`, a power of 2: near a pole all is small
    magnifier: float
    u_dot_series: tuple[float, ...]
    imaginary: bool
    stretch: float


class NutationPoint(NamedTuple):
    """Moduli of alpha D and beta D (signed if real), their arguments less rotations, theta'."""

    alpha: Any
    beta: Any
    alpha_argument: Any
    beta_argument: Any
    theta_dot: Any


def nutation_at(branch: NutationBranch, y: Any, flip: Any, functions: Functions) -> NutationPoint:
    """
    Evaluate the theta functions at the phase y from the nearest quarter period, |y| <= pi/4.

    y and flip = (-1)^floor(N/2) are floats, or arrays together with numpy's functions.
    D = hypot(alpha, beta).
    """
    if branch.imaginary:
        s = functions.sinh(y * branch.stretch)
        xi = -s * s
    else:
        s = functions.sin(y)
        xi = s * s
    c = functions.sqrt(1.0 - xi)        # cos y > 0, or cosh x
    prefactors = (1.0, c, s, s * c)
    alpha, alpha_argument, alpha_slope = _factor_at(
        branch.alpha, y, flip, xi, prefactors, functions=functions)
    beta, beta_argument, beta_slope = _factor_at(
        branch.beta, y, flip, xi, prefactors, functions=functions)
    if not branch.u_dot:                # resting, perhaps at a pole
        return NutationPoint(alpha, beta, alpha_argument, beta_argument, 0.0 * y)
    # theta' = -u'/sin(theta), with the zero that u' shares with a factor at a pole divided out.
    c3, c2, c1, c0 = branch.u_dot_series
    has_zero = branch.alpha.has_zero or branch.beta.has_zero
    sin_2y = 2.0 * c if has_zero else 2.0 * s * c
    xi_2y = 4.0 * xi * (1.0 - xi)
    theta1 = sin_2y * (((c3 * xi_2y + c2) * xi_2y + c1) * xi_2y + c0)
    # In this order nothing overflows on the separatrix, where all grow like cosh x.
    theta_dot = (-0.5 * branch.u_dot * (theta1 / (alpha * alpha + beta * beta))
                 / (branch.magnifier * alpha_slope * beta_slope))
    return NutationPoint(alpha, beta, alpha_argument, beta_argument, theta_dot)


def _factor_at(factor: FactorBranch, y: Any, flip: Any, xi: Any, prefactors: tuple[Any, ...],
               *, functions: Functions) -> tuple[Any, Any, Any]:
    """Return modulus (signed if real), argument, and the modulus less the factor sin y."""
    a3, a2, a1, a0 = factor.real
    polynomial = ((a3 * xi + a2) * xi + a1) * xi + a0
    if not factor.sense:
        if factor.crosses:
            polynomial = flip * polynomial
        real = prefactors[factor.real_prefactor] * polynomial
        return real, 0.0 * y, polynomial if factor.has_zero else real
    real = prefactors[factor.real_prefactor] * polynomial
    b3, b2, b1, b0 = factor.imag
    imag = prefactors[factor.imag_prefactor] * (((b3 * xi + b2) * xi + b1) * xi + b0)
    modulus = functions.hypot(real, imag)       # its square may be too small for a double
    return modulus, factor.drift * y + factor.sense * functions.atan2(imag, real), modulus


def transverse_rates(precession: Any, theta_dot: Any, cos_psi: Any, sin_psi: Any
                     ) -> tuple[Any, Any]:
    """omega1 + i omega2 = (-phi' sin(theta) + i theta') exp(-i psi), in the body's frame."""
    return (theta_dot * sin_psi - precession * cos_psi,
            theta_dot * cos_psi + precession * sin_psi)


class _Turning(NamedTuple):
    """
    Whole turns of theta/2 in a planar rotation, which passes both poles.

    theta/2 stays within a quarter turn of (pi/2) (intercept + slope Z), Z in quarter periods.
    """

    intercept: int
    slope: int
    at_start: int

    @classmethod
    def of(cls, motion: ThetaMotion, theta: float) -> _Turning:
        assert motion.turning is not None
        y = QUARTER_PERIOD_ANGLE * float(motion.offset0)
        at_start = cls(*motion.turning, 0).turns(motion.quarter0, y, 0.5 * theta)
        return cls(*motion.turning, round(at_start))

    def turns(self, quarters: Any, y: Any, half_theta: Any) -> Any:
        """Return how many turns half_theta, known up to a turn, lacks: near a whole number."""
        steady = QUARTER_PERIOD_ANGLE * (self.intercept + self.slope * quarters) + self.slope * y
        return (steady - half_theta) / (2.0 * math.pi) - self.at_start


def _nutation_branch(motion: ThetaMotion, odd: int) -> NutationBranch:
    """Round one branch to doubles."""
    def factor(which: str) -> FactorBranch:
        factor = getattr(motion, which)
        branch: Branch = factor.odd if odd else factor.even
        real = _coefficients(branch.real.scaled(Decimal(factor.sign)), which)
        # A real factor keeps a second series that is 0, for the complex arithmetic.
        imag_series = branch.imag or Series('cos even', (Decimal(0),))
        return FactorBranch(branch.real.prefactor, real,
                            imag_series.prefactor, _coefficients(imag_series),
                            factor.sense, float(factor.drift), factor.crosses, branch.has_zero)
    alpha, beta = factor('alpha'), factor('beta')
    smallest = min(max(map(abs, x.real + x.imag)) for x in (alpha, beta))
    magnifier = 2.0 ** -math.frexp(smallest)[1] if smallest else 1.0
    u_dot = _in_range("cos(theta)'", motion.u_dot[odd] * Decimal(magnifier))
    return NutationBranch(alpha, beta, u_dot, magnifier, _coefficients(motion.u_dot_series),
                          motion.imaginary, float(motion.stretch))


def _in_range(name: str, value: Decimal) -> float:
    if abs(value) > MOST:
        raise ValueError(f'{name} is {value:.3e}: must be at most {MOST} for doubles to hold '
                         f'the motion; the constants of the top are too far apart in size')
    return float(value)


def _flat(branch: NutationBranch) -> tuple[Any, ...]:
    """Return what `quaternion_at` unpacks at once, the sense taken into the imaginary part."""
    flat: list[Any] = []
    for factor in (branch.alpha, branch.beta):
        flat += (factor.real_prefactor, *factor.real,
                 factor.imag_prefactor, *(factor.sense * x for x in factor.imag),
                 factor.drift, factor.crosses)
    return (*flat, branch.imaginary, branch.stretch)


def _coefficients(series: Series, checked: str = '') -> tuple[float, ...]:
    """Return the polynomial's coefficients as doubles, highest of TERMS first."""
    exact = series.polynomial()
    largest = max(abs(x) for x in exact)
    if checked and 0 < largest < LEAST_AMPLITUDE:
        raise ValueError(f'the amplitude of {checked} is {largest:.3e}: the start is too close to '
                         f'a pole or to rest there; must be 0 or at least {LEAST_AMPLITUDE}')
    return (0.0,) * (TERMS - len(exact)) + tuple(float(x) for x in reversed(exact))
