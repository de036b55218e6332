# SPDX-License-Identifier: Apache-2.0
"""The equations of motion of the Euler angles, stepped by rk45."""

import math
from functools import cached_property

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
)
from spinning_top_sim.solvers.vertical import Posture

# lambda3/lambda1 at which the rounding of psi' + phi' cos(theta) costs eq. (29) a millionth.
LARGEST_RATIO = 1e-6 * 2.0 ** 53
# |sin(theta)| at which the rounding of cos(theta), 1.1e-16, costs phi' a millionth of L3/lambda1.
SMALLEST_SINE = math.sqrt(2.0 ** -53 / 1e-6)
ADVICE = "use the regular equations (equations = 'transport') or method = 'exact'"


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

    def accepted(self, y: Unknowns, y_new: Unknowns) -> Unknowns:
        """Raise IntegrationError if the step leapt over a pole: phi and psi would be lost."""
        before, after = y[0].real, y_new[0].real
        if math.floor(before / math.pi) != math.floor(after / math.pi):
            raise IntegrationError(
                f'euler equations: a step leapt over a pole, from theta = {before!r} to '
                f'{after!r} rad, and lost phi and psi; {ADVICE}')
        return y_new
