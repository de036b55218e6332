# SPDX-License-Identifier: Apache-2.0
"""
Unwrapped angles from Cayley-Klein parameters, and the state that is read with them.

arg(alpha) - (Omega/2) t turns one way only, that of Lz + L3, and arg(beta) + (Omega/2) t that of
Lz - L3 (Omega = L3/lambda3 - L3/lambda1; each rate is its momentum over a square).  So a phase
can be told from its value modulo 2 pi, without being integrated.  Where one of these momenta
vanishes the axis may cross that pole exactly: then the phase is that straight line, and the
modulus changes sign instead, and with it theta goes on smoothly through the pole.
"""

from __future__ import annotations

import cmath
import math
from typing import Any, Protocol

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import Columns, OneState, lazy
from spinning_top_sim.physics.top import State, Top

# Modulus (signed) and phase [rad] of alpha and of beta.
Polar = tuple[tuple[float, float], tuple[float, float]]


class Phases(Protocol):
    """Continues the phases of alpha and beta, and theta, to the time t [s]."""

    def polar(self, alpha: complex, beta: complex, t: float) -> Polar:
        """Return ((modulus, phase) of alpha, (modulus, phase) of beta)."""

    def theta(self, half_theta: float, t: float) -> float:
        """Return theta [rad] from theta/2 modulo 2 pi."""


class Winding:
    """
    How one Cayley-Klein parameter winds: its sense, its sign, and the phase it began with.

    crosses: whether it can vanish; it then moves on a straight line through zero
    """

    def __init__(self, momentum: float, modulus: float, phase: float) -> None:
        """Take Lz +- L3, and the signed modulus and the phase at the start."""
        self.momentum, self.phase = momentum, phase
        self.sign = math.copysign(1.0, modulus)
        self.crosses = momentum == 0.0

    def moved_to(self, phase: float) -> Winding:
        """Return the same winding at another phase."""
        return Winding(self.momentum, self.sign, phase)

    def on_line(self, z: complex, phase: float) -> tuple[float, float]:
        """Return the signed modulus of a parameter that crosses, on its known phase."""
        return (z * cmath.rect(1.0, -phase)).real, phase

    def nearest(self, z: complex, expected: float) -> tuple[float, float]:
        """Return (signed modulus, phase) with the phase within half a turn of `expected`."""
        phase = cmath.phase(self.sign * z)
        return self.sign * abs(z), phase + math.tau * round((expected - phase) / math.tau)

    def onward(self, z: complex, before: float) -> tuple[float, float]:
        """
        Return (signed modulus, phase) with the phase onward from `before` in its own sense.

        It turns by (-pi/2, 3 pi/2) in that sense: backwards by rounding at most, and forwards by
        half a turn where one step passes close by a pole.
        """
        phase = cmath.phase(z if self.sign > 0.0 else -z)
        turned = phase - before
        if self.momentum > 0.0:
            turns = -math.floor((turned + 0.5 * math.pi) / math.tau)
        else:
            turns = -math.ceil((turned - 0.5 * math.pi) / math.tau)
        return self.sign * abs(z), phase + math.tau * turns


def windings(start: State) -> tuple[Winding, Winding]:
    """Return those of alpha and beta for a motion that begins at `start`."""
    return (Winding(start.lz + start.l3, math.cos(0.5 * start.theta),
                    0.5 * (start.phi + start.psi)),
            Winding(start.lz - start.l3, math.sin(0.5 * start.theta),
                    0.5 * (start.phi - start.psi)))


class StepPhases:
    """
    See `Phases`; t lies in a step that began with the phases and theta/2 that are given here.

    A state read in that step keeps this: its angles stay right when the steps go on.
    line_rate, alpha, beta, half_theta: as given
    crosses: whether one of the parameters, or both, can vanish
    """

    def __init__(self, line_rate: float, alpha: Winding, beta: Winding,
                 half_theta: float) -> None:
        """Take Omega/2 [rad/s], and the windings' phases less that line."""
        self.line_rate, self.alpha, self.beta = line_rate, alpha, beta
        self.half_theta = half_theta
        self.crosses = alpha.crosses or beta.crosses

    def polar(self, alpha: complex, beta: complex, t: float) -> Polar:
        """See `Phases`."""
        return self._continue(alpha, beta, self.line_rate * t)

    def theta(self, half_theta: float, t: float) -> float:
        """See `Phases`; theta/2 turns by less than pi within a step."""
        return 2.0 * (half_theta
                      + math.tau * round((self.half_theta - half_theta) / math.tau))

    def on_lines(self, alpha: complex, beta: complex, line: float) -> Polar:
        """Return alpha and beta as (modulus, phase), on the known line where one crosses."""
        a, b = self.alpha, self.beta
        return (a.on_line(alpha, a.phase + line) if a.crosses else cmath.polar(alpha),
                b.on_line(beta, b.phase - line) if b.crosses else cmath.polar(beta))

    def _continue(self, alpha: complex, beta: complex, line: float) -> Polar:
        a, b = self.alpha, self.beta
        return (a.on_line(alpha, a.phase + line) if a.crosses
                else a.onward(alpha, a.phase + line),
                b.on_line(beta, b.phase - line) if b.crosses
                else b.onward(beta, b.phase - line))

    def moved_to(self, alpha: complex, beta: complex, line: float) -> StepPhases:
        """Return those of the step that begins with alpha and beta, whose phases have `line`."""
        (cosine, phase_a), (sine, phase_b) = self._continue(alpha, beta, line)
        return StepPhases(
            self.line_rate, self.alpha.moved_to(phase_a - line),
            self.beta.moved_to(phase_b + line),
            0.5 * self.theta(math.atan2(sine, cosine), 0.0))


def spin_excess(top: Top, l3: float) -> float:
    """Return Omega = L3/lambda3 - L3/lambda1 [rad/s]."""
    return l3 * (1.0 / top.lambda3 - 1.0 / top.lambda1)


class ByMomentum(Columns):
    """What follows from alpha, beta and the momentum L_x + i L_y [kg m^2/s] in the world."""

    momentum: Any

    @lazy
    def l3(self) -> Any:
        """L . e3 [kg m^2/s], as the state has it."""
        axis, height = self.axis
        return (self.momentum * axis.conjugate()).real + self.lz * height

    @lazy
    def transverse_rate(self) -> Any:
        """omega_1 + i omega_2 [rad/s] from the momentum: regular at the poles."""
        return attitude.transverse_in_body(
            self.alpha, self.beta, self.momentum, self.lz) / self.top.lambda1


class MomentumState(ByMomentum, OneState):
    """One state known by alpha, beta and the momentum."""

    def __init__(self, top: Top, start: State, alpha: complex, beta: complex,
                 momentum: complex, t: float, phases: Phases) -> None:
        self.top, self.l3_start, self.lz_start, self.lz = top, start.l3, start.lz, start.lz
        self.alpha, self.beta, self.momentum = alpha, beta, momentum
        self._t, self._phases = t, phases

    @lazy
    def _polar(self) -> Polar:
        return self._phases.polar(self.alpha, self.beta, self._t)

    @lazy
    def half_sum(self) -> float:
        """(phi + psi)/2, unwrapped [rad]."""
        return self._polar[0][1]

    @lazy
    def half_difference(self) -> float:
        """(phi - psi)/2, unwrapped [rad]."""
        return self._polar[1][1]

    @lazy
    def phi(self) -> float:
        """Precession angle, unwrapped [rad]."""
        (_, half_sum), (_, half_difference) = self._polar
        return half_sum + half_difference

    @lazy
    def psi(self) -> float:
        """Spin angle, unwrapped [rad]."""
        (_, half_sum), (_, half_difference) = self._polar
        return half_sum - half_difference

    @lazy
    def theta(self) -> float:
        """Tilt, continued through the poles [rad]."""
        (cosine, _), (sine, _) = self._polar
        return self._phases.theta(math.atan2(sine, cosine), self._t)

    @lazy
    def theta_dot(self) -> float:
        """Nutation rate [rad/s]: the momentum along e2' over lambda1."""
        return (self.momentum * cmath.rect(1.0, -self.phi)).imag / self.top.lambda1

    # What is above and in `Columns`, to the last bit, in a third of the time.

    @property
    def euler_angles(self) -> tuple[float, float, float]:
        """See `Columns`."""
        (cosine, half_sum), (sine, half_difference) = self._polar
        return (half_sum + half_difference,
                self._phases.theta(math.atan2(sine, cosine), self._t),
                half_sum - half_difference)

    @property
    def euler_rates(self) -> tuple[float, float, float]:
        """See `Columns`."""
        top, l3, lz = self.top, self.l3_start, self.lz_start
        (_, half_sum), (_, half_difference) = self._polar
        cos2 = attitude.squared_modulus(self.alpha)
        sin2 = attitude.squared_modulus(self.beta)
        phi_dot = attitude.precession_rate(top, l3, lz, cos2, sin2)
        turned = self.momentum * cmath.rect(1.0, -(half_sum + half_difference))
        return (phi_dot, turned.imag / top.lambda1,
                l3 / top.lambda3 - phi_dot * (cos2 - sin2))
