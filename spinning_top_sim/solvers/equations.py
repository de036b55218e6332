# SPDX-License-Identifier: Apache-2.0
"""The equations of motion that rk45 steps: regular ones, and those of the Euler angles."""

import cmath
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.physics.attitude import Column, precession_rate
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import Equations, IntegrationError, Rows, Vector

# The energy corrects the nutation rate only where its square is at least this share of the
# largest |m|^2: at a turning point the energy does not tell the rate.
NUTATION_SHARE = 1e-6
# (sin(theta)/2)^2 below which rounding in L.e3 would spoil the momentum more than it mends it.
POLE_SHARE = 1e-4
# |sin(theta)| at which the rounding of cos(theta), 1.1e-16, costs phi' a millionth of L3/lambda1.
SMALLEST_SINE = math.sqrt(2.0 ** -53 / 1e-6)
ADVICE = "use the regular equations (equations = 'transport') or method = 'exact'"


# Real and imaginary parts of alpha, beta and m.
Parts = Sequence[Column]

# The functions sqrt, copysign and where of the projection, for columns and for one state, where
# numpy would take ten times as long.
COLUMNS = np.sqrt, np.copysign, np.where
ONE_STATE = math.sqrt, math.copysign, lambda condition, x, y: x if condition else y


class TransportEquations(Equations):
    """
    The default: regular at every attitude.

    Unknowns are the Cayley-Klein parameters and the horizontal angular momentum in the world,
    m = i (L_x + i L_y)/(2 lambda1).  From q' = (1/2) omega q and L' = torque,

        alpha' =  i (Lz - c)/(2 lambda1) alpha + m conj(beta)
        beta'  =  i (Lz + c)/(2 lambda1) beta  - m conj(alpha)
        m'     = -(P/lambda1) alpha beta

    with c the part of L3 that these equations carry.  They are those of a frame that turns about
    e3 with the body, less a known uniform rate chi = L3/lambda3 - (L3 - c)/lambda1.  The factor
    exp(+-i chi t/2) is put on when a state is read, so the step size follows the nutation and not
    the spin.  With c = L3/2 the spectrum of alpha and beta is centred about zero;
    docs/accuracy.md has the reasons for this choice.

    The invariants |q| = 1, L.e3 = L3 and the energy are restored after each step and in each
    sample (projection, Hairer, Lubich & Wanner, *Geometric Numerical Integration*, sect. IV.4).

    rtol, atol : tolerated error of a step; the unknowns are scaled to 1, so the two add up
    spin_rate : chi [rad/s]
    uniform_rates : rate of the uniform part of alpha's phase (see `unwrap`), in the frame that is
        stepped and in the body [rad/s].  They differ by chi/2.  Those of beta have the other sign.
    """

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        lambda1, l3, lz, torque = top.lambda1, start.l3, start.lz, top.gravity_torque
        self.top, self.l3, self.lz = top, l3, lz
        carried = 0.5 * l3                                              # c
        self.spin_rate = l3 / top.lambda3 - (l3 - carried) / lambda1
        self.uniform_rates = -0.5 * carried / lambda1, 0.5 * (l3 / top.lambda3 - l3 / lambda1)
        self._turn_alpha = 0.5j * (lz - carried) / lambda1
        self._turn_beta = 0.5j * (lz + carried) / lambda1
        self._fall = complex(-torque / lambda1)
        # What 2 lambda1 |m|^2 + P cos(theta) must stay; the rest of the energy is constant.
        alpha, beta, m = self._vector(start)
        self._energy = 2.0 * lambda1 * abs(m) ** 2 + torque * (abs(alpha) ** 2 - abs(beta) ** 2)
        # |m| never exceeds this: the scale of its error, as 1 is that of alpha and beta.  Close to
        # hanging the sum is what its rounding leaves.
        above_lowest = max(self._energy + abs(torque), 4.0 * math.ulp(1.0) * abs(torque))
        self._scale = math.sqrt(0.5 * above_lowest / lambda1) or 1.0
        self.tolerance = rtol + atol
        self.fastest_rate = (self._scale + (abs(l3) + abs(lz)) / lambda1
                             + math.sqrt(abs(torque) / lambda1))
        self._large_enough = NUTATION_SHARE * self._scale ** 2
        self.start = self.accepted((), (alpha, beta, m))

    def _vector(self, start: State) -> Vector:
        """Return alpha, beta and m of a state; L_x + i L_y by eq. (6), turned by exp(i phi)."""
        lambda1 = self.top.lambda1
        cosine, sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
        phi_dot = precession_rate(self.top, self.l3, self.lz, cosine * cosine, sine * sine)
        momentum = cmath.rect(1.0, start.phi) * complex(
            2.0 * sine * cosine * (self.l3 - lambda1 * phi_dot
                                   * (cosine * cosine - sine * sine)),
            lambda1 * start.theta_dot)
        return (cosine * cmath.rect(1.0, 0.5 * start.phi + 0.5 * start.psi),
                sine * cmath.rect(1.0, 0.5 * start.phi - 0.5 * start.psi),
                0.5j * momentum / lambda1)

    def derivative(self, alpha: complex, beta: complex, m: complex) -> Vector:
        return (self._turn_alpha * alpha + m * beta.conjugate(),
                self._turn_beta * beta - m * alpha.conjugate(),
                self._fall * (alpha * beta))

    def second_derivative(self, y: Rows, derivative: Rows) -> Rows:
        # The product rule in real parts: of complex columns the last bits depend on the block.
        a, a_imag, b, b_imag, m, m_imag = y
        da, da_imag, db, db_imag, dm, dm_imag = derivative
        turn_a, turn_b, fall = self._turn_alpha.imag, self._turn_beta.imag, self._fall.real
        return np.array((
            dm * b + dm_imag * b_imag + m * db + m_imag * db_imag - turn_a * da_imag,
            dm_imag * b - dm * b_imag + m_imag * db - m * db_imag + turn_a * da,
            -(dm * a + dm_imag * a_imag + m * da + m_imag * da_imag) - turn_b * db_imag,
            -(dm_imag * a - dm * a_imag + m_imag * da - m * da_imag) + turn_b * db,
            fall * (da * b - da_imag * b_imag + a * db - a_imag * db_imag),
            fall * (da * b_imag + da_imag * b + a * db_imag + a_imag * db)))

    def errors(self, y: Vector, y_new: Vector, difference: Vector) -> tuple[float, ...]:
        da, db, dm = difference
        tolerance = self.tolerance
        return abs(da) / tolerance, abs(db) / tolerance, abs(dm) / self._scale / tolerance

    def accepted(self, y: Vector, y_new: Vector) -> Vector:
        """Return y_new moved back onto the invariants; see `project_columns`."""
        alpha, beta, m = y_new
        projected = self._project((alpha.real, alpha.imag, beta.real, beta.imag, m.real, m.imag),
                                  ONE_STATE, POLE_SHARE)
        return complex(*projected[:2]), complex(*projected[2:4]), complex(*projected[4:])

    def project_columns(self, y: Parts, pole_share: float = POLE_SHARE) -> Parts:
        """Return y with |q| = 1, then L.e3 = L3, then the energy restored along theta'."""
        return self._project(y, COLUMNS, pole_share)

    def _project(self, y: Sequence[Any], functions: tuple[Callable[..., Any], ...],
                 pole_share: float) -> tuple[Any, ...]:
        # m conj(alpha beta) = u + i v, where v carries L.e3 and u the nutation rate: v follows
        # from L3 and Lz, and u^2 from |u + i v|^2, which the energy tells.
        sqrt, copysign, where = functions
        alpha_real, alpha_imag, beta_real, beta_imag, m_real, m_imag = y
        cos2 = alpha_real * alpha_real + alpha_imag * alpha_imag
        sin2 = beta_real * beta_real + beta_imag * beta_imag
        inverse_norm = 1.0 / sqrt(cos2 + sin2)
        alpha_real, alpha_imag = alpha_real * inverse_norm, alpha_imag * inverse_norm
        beta_real, beta_imag = beta_real * inverse_norm, beta_imag * inverse_norm
        inverse_square = inverse_norm * inverse_norm
        cos2, sin2 = cos2 * inverse_square, sin2 * inverse_square
        size = cos2 * sin2
        axis_real, axis_imag = half_axis(alpha_real, alpha_imag, beta_real, beta_imag)
        lambda1, l3, lz = self.top.lambda1, self.l3, self.lz
        # L3 - Lz cos(theta), without cancellation at the poles
        v = 0.25 / lambda1 * where(sin2 < cos2, (l3 - lz) + 2.0 * lz * sin2,
                                   (l3 + lz) - 2.0 * lz * cos2)
        u = m_real * axis_real + m_imag * axis_imag
        u_squared = size * (self._energy - self.top.gravity_torque * (cos2 - sin2)) / (
            2.0 * lambda1) - v * v
        # What rounding leaves of the energy does not tell u.
        is_known = (u * u > self._large_enough * size) & (u_squared > 0.0)
        u = where(is_known, copysign(sqrt(where(is_known, u_squared, 0.0)), u), u)
        at_pole = size <= pole_share
        divisor = where(at_pole, 1.0, size)
        return (
            alpha_real, alpha_imag, beta_real, beta_imag,
            where(at_pole, m_real, (u * axis_real - v * axis_imag) / divisor),
            where(at_pole, m_imag, (u * axis_imag + v * axis_real) / divisor))


def half_axis(a: Any, a_imag: Any, b: Any, b_imag: Any) -> tuple[Any, Any]:
    """Return alpha beta = (e3_x + i e3_y)/2, of length sin(theta)/2."""
    return a * b - a_imag * b_imag, a * b_imag + a_imag * b


class EulerEquations(Equations):
    """
    Equations (29)-(32) of "Analysis of Symmetric Spinning Top" (2023), to the letter, for study.

    They are singular where the axis is vertical, and near there wrong without a sign of it:
    cos(theta) rounds towards 1, Lz - L3 cos(theta) loses its digits, or a step leaps over the
    pole, and phi and psi drift off while every error estimate is small.  So these equations stop
    with an error there.
    """

    def __init__(self, top: Top, start: State, rtol: float, atol: float) -> None:
        self.top, self.l3, self.lz = top, start.l3, start.lz
        self._rtol, self._atol = rtol, atol
        self.start = (start.theta, start.theta_dot, start.phi, start.psi)
        self.tolerance = rtol + atol
        self.fastest_rate = (
            abs(start.theta_dot) + (abs(start.l3) + abs(start.lz)) / top.lambda1
            + abs(start.l3) / top.lambda3 + math.sqrt(abs(top.gravity_torque) / top.lambda1))

    def derivative(self, theta: float, theta_dot: float, phi: float, psi: float) -> Vector:
        """Return (theta', theta'', phi', psi'), eqs. (29)-(32); IntegrationError near a pole."""
        sine, cosine = math.sin(theta), math.cos(theta)
        if not abs(sine) > SMALLEST_SINE:
            raise IntegrationError(
                f'euler equations: the axis is at a pole (theta = {theta!r} rad): cos(theta) '
                f"rounds to {cosine!r} and eq. (31) loses phi'; {ADVICE}")
        top = self.top
        phi_dot = (self.lz - self.l3 * cosine) / (top.lambda1 * sine * sine)
        psi_dot = self.l3 / top.lambda3 - phi_dot * cosine
        return (theta_dot,
                phi_dot * phi_dot * sine * cosine
                - top.lambda3 / top.lambda1 * (psi_dot + phi_dot * cosine) * phi_dot * sine
                + top.gravity_torque / top.lambda1 * sine,
                phi_dot, psi_dot)

    def second_derivative(self, y: Rows, derivative: Rows) -> Rows:
        theta = y[0]
        theta_dot, theta_ddot, phi_dot, _ = derivative
        sine, cosine = np.sin(theta), np.cos(theta)
        lambda1 = self.top.lambda1
        phi_ddot = theta_dot * (self.l3 / lambda1 - 2.0 * phi_dot * cosine) / sine
        theta_dddot = (
            2.0 * phi_dot * phi_ddot * sine * cosine
            + theta_dot * phi_dot * phi_dot * (cosine * cosine - sine * sine)
            - self.l3 / lambda1 * (phi_ddot * sine + phi_dot * cosine * theta_dot)
            + self.top.gravity_torque / lambda1 * cosine * theta_dot)
        return np.array((theta_ddot, theta_dddot, phi_ddot,
                         phi_dot * sine * theta_dot - phi_ddot * cosine))

    def errors(self, y: Vector, y_new: Vector, difference: Vector) -> tuple[float, ...]:
        return tuple(
            abs(e) / (self._atol + self._rtol * max(abs(a), abs(b)) or math.ulp(0.0))
            for e, a, b in zip(difference, y, y_new, strict=True))

    def accepted(self, y: Vector, y_new: Vector) -> Vector:
        """Raise IntegrationError if the step leapt over a pole: phi and psi would be lost."""
        before, after = y[0].real, y_new[0].real
        if math.floor(before / math.pi) != math.floor(after / math.pi):
            raise IntegrationError(
                f'euler equations: a step leapt over a pole, from theta = {before!r} to '
                f'{after!r} rad, and lost phi and psi; {ADVICE}')
        return y_new
