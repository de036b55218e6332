# SPDX-License-Identifier: Apache-2.0
"""Two forms of the equations of motion that rk45 steps, and their states."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import (
    IntegrationError,
    SteppedMotion,
    UnknownRows,
    Unknowns,
    components,
)
from spinning_top_sim.solvers.vertical import Posture

# The energy corrects the nutation rate only where its square is at least this share of the
# largest |m|^2: at a turning point the energy does not tell the rate.
NUTATION_SHARE = 1e-6
# (sin(theta)/2)^2 below which rounding in L.e3 would spoil the momentum more than it mends it.
POLE_SHARE = 1e-4
# lambda3/lambda1 at which the rounding of psi' + phi' cos(theta) costs eq. (29) a millionth.
LARGEST_RATIO = 1e-6 * 2.0 ** 53
# |sin(theta)| at which the rounding of cos(theta), 1.1e-16, costs phi' a millionth of L3/lambda1.
SMALLEST_SINE = math.sqrt(2.0 ** -53 / 1e-6)
ADVICE = "use the regular equations (equations = 'transport') or method = 'exact'"
# Real and imaginary parts of alpha, beta and m.
Components = Sequence[Column]
# What a projection computes with: sqrt, copysign and where.
Functions = tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]
COLUMNS: Functions = np.sqrt, np.copysign, np.where
# Of one state: numpy would take ten times as long.
ONE_STATE: Functions = math.sqrt, math.copysign, lambda condition, x, y: x if condition else y


def turns_to_follow(phase: Column, before: Column, sense: float) -> Column:
    """
    Return the whole turns to add to `phase` so that it follows `before` [rad].

    sense : 1: it becomes the least that is not behind, -1: the largest that is not ahead, but for
        rounding; 0: the nearest
    """
    return 0.0 - np.rint((phase - before - 0.5 * math.pi * sense) / math.tau)


class _TransportStates(States):
    """States known by what `TransportMotion._unknowns` returns."""

    method = 'rk45'

    def __init__(self, motion: 'TransportMotion', t: Column, rows: UnknownRows) -> None:
        super().__init__(motion.top, motion.start, len(t))
        self.t, self._motion = t, motion
        self._stepped: Components = tuple(rows[:6])
        self._phases_before = rows[6:]

    @cached_property
    def _projected(self) -> Components:
        """The unknowns on the invariants, in the body's own frame."""
        a, b, c, d, m_real, m_imag = self._motion.project(self._stepped)
        spin = 0.5 * self._motion.spin_rate * self.t
        cosine, sine = np.cos(spin), np.sin(spin)
        return (a * cosine - b * sine, b * cosine + a * sine,
                c * cosine + d * sine, d * cosine - c * sine, m_real, m_imag)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        alpha_real, alpha_imag, beta_real, beta_imag, *_ = self._projected
        return -beta_imag, beta_real, alpha_imag, alpha_real

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        uniform = self._motion.uniform_rates[1] * self.t
        phases = self._motion.phases(self._projected, uniform)
        # theta/2 turns by less than half a turn within a step.
        half_sum, half_difference, half = (
            phase + math.tau * turns_to_follow(phase, before, sense)
            for phase, before, sense in zip(
                phases, self._phases_before, self._motion.senses, strict=True))
        half_sum, half_difference = half_sum + uniform, half_difference - uniform
        return half_sum + half_difference, 2.0 * half, half_sum - half_difference

    @cached_property
    def _momentum(self) -> tuple[Column, Column]:
        """L_x and L_y in the world frame [kg m^2/s]."""
        unit, (*_, m_real, m_imag) = 2.0 * self.top.lambda1, self._projected
        return unit * m_imag, -unit * m_real

    @cached_property
    def theta_dot(self) -> Column:
        """The momentum across the meridian plane, over lambda1."""
        lx, ly = self._momentum
        return (ly * np.cos(self.phi) - lx * np.sin(self.phi)) / self.top.lambda1

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        momentum = *self._momentum, self.start.lz
        first, second, _ = attitude.rotated_back(self.rows_quaternion, momentum)
        return first / self.top.lambda1, second / self.top.lambda1

    @cached_property
    def l3(self) -> Column:
        x, y, z = self.rows_axis
        lx, ly = self._momentum
        return lx * x + ly * y + self.start.lz * z


class TransportMotion(SteppedMotion):
    """
    Equations of alpha, beta and m = i (L_x + i L_y)/(2 lambda1), regular at every attitude.

    docs/theta_functions.md derives them, and the rates of phi + psi and phi - psi.  They are those
    of a frame that turns with the body less chi = L3/lambda3 - (L3 - c)/lambda1: the factor
    exp(+-i chi t/2) is put on when a state is read, and steps need not follow the spin.

    The invariants |q| = 1, L.e3 = L3 and the energy are restored after each step and in each
    sample (projection, Hairer, Lubich & Wanner, *Geometric Numerical Integration*, sect. IV.4).

    phi + psi and phi - psi are twice the phases of alpha and beta, whose rates are +-Omega/2 and a
    term with Lz + L3 or Lz - L3.  This term never changes its sign, and turns the phase by little
    more than half a turn in a step, however near a pole.  So the phase of a sample is, of all
    arctan2(..) + 2 pi k, the first one ahead of that at the begin of its step.  Without this term
    the number moves on a line through zero, and its modulus changes sign where the axis passes
    that pole.

    posture : of `start`, in doubles that know more of it
    """

    columns = _TransportStates

    def __init__(self, top: Top, start: State, posture: Posture, rtol: float,
                 atol: float) -> None:
        lambda1, l3, lz, torque = top.lambda1, start.l3, start.lz, top.gravity_torque
        self.top, self._l3, self._lz = top, l3, lz
        carried = 0.5 * l3          # c: so the spectrum of alpha and beta is centred about zero
        self.spin_rate = l3 / top.lambda3 - (l3 - carried) / lambda1
        # Of the uniform part of alpha's phase, in the frame that is stepped and in the body.
        self.uniform_rates = -0.5 * carried / lambda1, 0.5 * (l3 / top.lambda3 - l3 / lambda1)
        self._turn_alpha = 0.5j * (lz - carried) / lambda1
        self._turn_beta = 0.5j * (lz + carried) / lambda1
        self._fall = complex(-torque / lambda1)
        # What 2 lambda1 |m|^2 + P cos(theta) must stay; the rest of the energy is constant.
        alpha, beta, transverse, *_ = posture
        # Of L in the body: lambda1 (omega_1 + i omega_2), L3.  e3 is (2 alpha beta, ...).
        m = 0.5j * (alpha * alpha * transverse - beta * beta * transverse.conjugate()
                    + 2.0 * alpha * beta * (l3 / lambda1))
        self._energy = 2.0 * lambda1 * abs(m) ** 2 + torque * (abs(alpha) ** 2 - abs(beta) ** 2)
        # |m| never exceeds this: the scale of its error, as 1 is that of alpha and beta.  Close to
        # hanging the sum is what its rounding leaves.
        above_lowest = max(self._energy + abs(torque), 4.0 * math.ulp(1.0) * abs(torque))
        self._scale = math.sqrt(0.5 * above_lowest / lambda1) or 1.0
        self._tolerance = rtol + atol               # the unknowns are scaled to 1
        self._large_enough = NUTATION_SHARE * self._scale ** 2
        # In which the phases of alpha and beta and theta/2 turn: 1, -1, or 0 for either.
        self.senses = *map(np.sign, (lz + l3, lz - l3)), 0.0
        half = 0.5 * start.theta
        # Of the moduli, where theta is continued out of [0, pi].
        self._signs = math.copysign(1.0, math.cos(half)), math.copysign(1.0, math.sin(half))
        self._phases_at_start = (0.5 * start.phi + 0.5 * start.psi,
                                 0.5 * start.phi - 0.5 * start.psi)
        # Phases of alpha and beta, less their uniform parts, and theta/2, at `_ends` [rad].
        self._phases_at_steps = [(*self._phases_at_start, half)]
        super().__init__(
            top, start, self.corrected((), (alpha, beta, m)), self._tolerance,
            self._scale + (abs(l3) + abs(lz)) / lambda1 + math.sqrt(abs(torque) / lambda1))

    def derivative(self, alpha: complex, beta: complex, m: complex) -> Unknowns:
        return (self._turn_alpha * alpha + m * beta.conjugate(),
                self._turn_beta * beta - m * alpha.conjugate(),
                self._fall * (alpha * beta))

    def second_derivative(self, y: UnknownRows, derivative: UnknownRows) -> UnknownRows:
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

    def errors(self, y: Unknowns, y_new: Unknowns, difference: Unknowns) -> tuple[float, ...]:
        da, db, dm = difference
        tolerance = self._tolerance
        return abs(da) / tolerance, abs(db) / tolerance, abs(dm) / self._scale / tolerance

    def corrected(self, y: Unknowns, y_new: Unknowns) -> Unknowns:
        """Return y_new moved back onto the invariants; see `project`."""
        alpha, beta, m = y_new
        projected = self.project(
            (alpha.real, alpha.imag, beta.real, beta.imag, m.real, m.imag), ONE_STATE)
        return complex(*projected[:2]), complex(*projected[2:4]), complex(*projected[4:])

    def project(self, y: Sequence[Any], functions: Functions = COLUMNS) -> tuple[Any, ...]:
        """Return y with |q| = 1, then L.e3 = L3, then the energy restored along theta'."""
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
        # alpha beta = (e3_x + i e3_y)/2
        axis_real = alpha_real * beta_real - alpha_imag * beta_imag
        axis_imag = alpha_real * beta_imag + alpha_imag * beta_real
        lambda1, l3, lz = self.top.lambda1, self._l3, self._lz
        # L3 - Lz cos(theta), without cancellation at the poles
        v = 0.25 / lambda1 * where(sin2 < cos2, (l3 - lz) + 2.0 * lz * sin2,
                                   (l3 + lz) - 2.0 * lz * cos2)
        u = m_real * axis_real + m_imag * axis_imag
        u_squared = size * (self._energy - self.top.gravity_torque * (cos2 - sin2)) / (
            2.0 * lambda1) - v * v
        # What rounding leaves of the energy does not tell u.
        is_known = (u * u > self._large_enough * size) & (u_squared > 0.0)
        u = where(is_known, copysign(sqrt(where(is_known, u_squared, 0.0)), u), u)
        at_pole = size <= POLE_SHARE
        divisor = where(at_pole, 1.0, size)
        return (
            alpha_real, alpha_imag, beta_real, beta_imag,
            where(at_pole, m_real, (u * axis_real - v * axis_imag) / divisor),
            where(at_pole, m_imag, (u * axis_imag + v * axis_real) / divisor))

    def phases(self, y: Sequence[Column], uniform: Column) -> list[Column]:
        """
        Return the phases of alpha and beta less the uniform parts, and theta/2, but for turns.

        uniform : the uniform part of alpha's phase in the frame of y [rad]
        """
        moduli, phases = [], []
        for k, part in enumerate((uniform, -uniform)):
            real, imag, sign = y[2 * k], y[2 * k + 1], self._signs[k]
            if self.senses[k]:
                moduli.append(sign * np.hypot(real, imag))
                phases.append(np.arctan2(sign * imag, sign * real) - part)
            else:       # it moves on a line through zero
                start = self._phases_at_start[k]
                moduli.append(real * np.cos(start + part) + imag * np.sin(start + part))
                phases.append(np.full(len(part), start))
        return [*phases, np.arctan2(moduli[1], moduli[0])]

    def _unwrap(self) -> None:
        """Follow the phases to the last of `_ends`."""
        known = len(self._phases_at_steps)
        if known < len(self._ends):
            t, y = np.array(self._ends[known:]), tuple(components(self._y[known:]))
            phases = self.phases(y, self.uniform_rates[0] * t)
            self._phases_at_steps.extend(zip(*(
                (phase + math.tau * np.cumsum(turns_to_follow(
                    phase, np.concatenate(([before], phase[:-1])), sense))).tolist()
                for phase, before, sense in zip(
                    phases, self._phases_at_steps[-1], self.senses, strict=True)), strict=True))

    def _forget(self, count: int) -> None:
        self._unwrap()
        super()._forget(count)
        del self._phases_at_steps[:count]

    def _unknowns(self, t: Column) -> UnknownRows:
        """Return the unknowns, and `_phases_at_steps` where the step of each time [s] begins."""
        self._unwrap()
        first, steps, unknowns = self._interpolated(t)
        phases = np.array(self._phases_at_steps[first:first + steps.max(initial=0) + 1])
        return np.concatenate((unknowns, phases.T.take(steps, axis=1)))


class _EulerStates(States):
    method = 'rk45'

    def __init__(self, motion: SteppedMotion, t: Column, unknowns: UnknownRows) -> None:
        super().__init__(motion.top, motion.start, len(t))
        theta, theta_dot, phi, psi = unknowns
        self.t, self.theta_dot, self.angles = t, theta_dot, (phi, theta, psi)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        return attitude.quaternion_of_angles(*self.angles)

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        return attitude.transverse(self.theta_dot, self.phi_dot * np.sin(self.theta),
                                   np.cos(self.psi), np.sin(self.psi))


class EulerMotion(SteppedMotion):
    """
    Equations (29)-(32) of "Analysis of Symmetric Spinning Top" (2023), to the letter, for study.

    They are singular where the axis is vertical, and near there wrong without a sign of it: see
    docs/theta_functions.md.  So they stop with an error there, and do not begin with a disc whose
    lambda3/lambda1 loses digits.
    """

    columns = _EulerStates

    def __init__(self, top: Top, start: State, _: Posture, rtol: float, atol: float) -> None:
        if top.lambda3 > LARGEST_RATIO * top.lambda1:
            raise ValueError(
                f'lambda3 = {top.lambda3!r} kg m^2: must be at most {LARGEST_RATIO:.2g} lambda1 '
                f"for the euler equations: eq. (29) loses psi' + phi' cos(theta); {ADVICE}")
        self.top, self._l3, self._lz = top, start.l3, start.lz
        self._rtol, self._atol = rtol, atol
        super().__init__(
            top, start, (start.theta, start.theta_dot, start.phi, start.psi), rtol + atol,
            abs(start.theta_dot) + (abs(start.l3) + abs(start.lz)) / top.lambda1
            + abs(start.l3) / top.lambda3 + math.sqrt(abs(top.gravity_torque) / top.lambda1))

    def derivative(self, theta: float, theta_dot: float, phi: float, psi: float) -> Unknowns:
        """Return (theta', theta'', phi', psi'), eqs. (29)-(32); IntegrationError near a pole."""
        sine, cosine = math.sin(theta), math.cos(theta)
        if not abs(sine) > SMALLEST_SINE:
            raise IntegrationError(
                f'euler equations: the axis is at a pole (theta = {theta!r} rad): cos(theta) '
                f"rounds to {cosine!r} and eq. (31) loses phi'; {ADVICE}")
        top = self.top
        phi_dot = (self._lz - self._l3 * cosine) / (top.lambda1 * sine * sine)
        psi_dot = self._l3 / top.lambda3 - phi_dot * cosine
        return (theta_dot,
                phi_dot * phi_dot * sine * cosine
                - top.lambda3 / top.lambda1 * (psi_dot + phi_dot * cosine) * phi_dot * sine
                + top.gravity_torque / top.lambda1 * sine,
                phi_dot, psi_dot)

    def second_derivative(self, y: UnknownRows, derivative: UnknownRows) -> UnknownRows:
        theta = y[0]
        theta_dot, theta_ddot, phi_dot, _ = derivative
        sine, cosine = np.sin(theta), np.cos(theta)
        lambda1 = self.top.lambda1
        phi_ddot = theta_dot * (self._l3 / lambda1 - 2.0 * phi_dot * cosine) / sine
        theta_dddot = (
            2.0 * phi_dot * phi_ddot * sine * cosine
            + theta_dot * phi_dot * phi_dot * (cosine * cosine - sine * sine)
            - self._l3 / lambda1 * (phi_ddot * sine + phi_dot * cosine * theta_dot)
            + self.top.gravity_torque / lambda1 * cosine * theta_dot)
        return np.array((theta_ddot, theta_dddot, phi_ddot,
                         phi_dot * sine * theta_dot - phi_ddot * cosine))

    def errors(self, y: Unknowns, y_new: Unknowns, difference: Unknowns) -> tuple[float, ...]:
        return tuple(
            abs(e) / (self._atol + self._rtol * max(abs(a), abs(b)) or math.ulp(0.0))
            for e, a, b in zip(difference, y, y_new, strict=True))

    def corrected(self, y: Unknowns, y_new: Unknowns) -> Unknowns:
        """Raise IntegrationError if the step leapt over a pole: phi and psi would be lost."""
        before, after = y[0].real, y_new[0].real
        if math.floor(before / math.pi) != math.floor(after / math.pi):
            raise IntegrationError(
                f'euler equations: a step leapt over a pole, from theta = {before!r} to '
                f'{after!r} rad, and lost phi and psi; {ADVICE}')
        return y_new
