# SPDX-License-Identifier: Apache-2.0
"""
Unwrapped angles of a stepped motion, from the phases of the Cayley-Klein parameters.

With Omega = L3/lambda3 - L3/lambda1, arg(alpha) - (Omega/2) t turns one way only, at the rate
(Lz + L3)/(4 lambda1 cos^2(theta/2)), and arg(beta) + (Omega/2) t at (Lz - L3)/(4 lambda1
sin^2(theta/2)).  So a phase follows from its value modulo 2 pi and from the phase at the beginning
of its step.  Where Lz + L3 or Lz - L3 vanishes, the axis may cross that pole exactly: then the
parameter moves on a straight line through zero, whose phase is known, and its modulus changes
sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.top import State, Top


def spin_excess(top: Top, l3: float) -> float:
    """Return Omega = L3/lambda3 - L3/lambda1 [rad/s]: what turns the body and not its axis."""
    return l3 * (1.0 / top.lambda3 - 1.0 / top.lambda1)


def turns_to_follow(phase: Column, before: Column, momentum: float) -> Column:
    """
    Return the whole turns to add to `phase` so that it follows `before` [rad].

    In the sense of `momentum` it then lies within (-pi/2, 3 pi/2) from there: backwards by
    rounding at most, and forwards by half a turn where one step passes close by a pole.  Without
    a sense (momentum 0) it is the nearest.
    """
    turned = phase - before
    if momentum > 0.0:
        return 0.0 - np.floor((turned + 0.5 * math.pi) / math.tau)
    if momentum < 0.0:
        return 0.0 - np.ceil((turned - 0.5 * math.pi) / math.tau)
    return 0.0 - np.rint(turned / math.tau)


def unwrap(phases: Column, before: float, momentum: float) -> Column:
    """Return phases [rad], each a step after the one before it, unwrapped from `before` on."""
    previous = np.concatenate(([before], phases[:-1]))
    return phases + math.tau * np.cumsum(turns_to_follow(phases, previous, momentum))


@dataclass(frozen=True)
class CayleyKleinPhase:
    """
    How one Cayley-Klein parameter turns.

    momentum : Lz + L3 of alpha, Lz - L3 of beta; its sign is the sense of turning
    sign : of the modulus, where theta is continued out of [0, pi]
    start : phase at t = 0 [rad]
    """

    momentum: float
    sign: float
    start: float

    @property
    def crosses(self) -> bool:
        """Whether the parameter can vanish: it then moves on a line through zero."""
        return self.momentum == 0.0

    def modulus(self, real: Column, imag: Column, spin_phase: Column) -> Column:
        """Return the signed modulus; `spin_phase` is what the uniform spin adds to the phase."""
        if self.crosses:
            phase = self.start + spin_phase
            return real * np.cos(phase) + imag * np.sin(phase)
        return self.sign * np.hypot(real, imag)

    def argument(self, real: Column, imag: Column) -> Column:
        """Return the phase [rad], less whole turns, of a parameter with this sign."""
        return np.arctan2(self.sign * imag, self.sign * real)

    def phase(self, real: Column, imag: Column, before: Column, spin_phase: Column) -> Column:
        """
        Return the unwrapped phase [rad].

        before : the phase at the begin of the step, less that of the spin there [rad]
        spin_phase : what the uniform spin adds to the phase [rad]
        """
        if self.crosses:
            return self.start + spin_phase
        argument = self.argument(real, imag)
        return argument + math.tau * turns_to_follow(argument, before + spin_phase, self.momentum)


class PhaseUnwrapper:
    """
    The phases of alpha and beta of a motion at the begins of its steps.

    frame_rate : what the uniform spin of the stepped frame adds to the phase of alpha [rad/s], and
        takes from that of beta

    Attributes
    ----------
    alpha, beta : CayleyKleinPhase
    begins : (3, n) phases of alpha and beta, less that of the spin, and theta/2 [rad]
    """

    def __init__(self, start: State, frame_rate: float) -> None:
        half = 0.5 * start.theta
        self.alpha = CayleyKleinPhase(start.lz + start.l3, math.copysign(1.0, math.cos(half)),
                                      0.5 * (start.phi + start.psi))
        self.beta = CayleyKleinPhase(start.lz - start.l3, math.copysign(1.0, math.sin(half)),
                                     0.5 * (start.phi - start.psi))
        self._frame_rate = frame_rate
        self.begins = np.array([[self.alpha.start], [self.beta.start], [half]])

    def extend(self, t: Column, alpha: NDArray[np.complex128],
               beta: NDArray[np.complex128]) -> None:
        """Follow the phases over the begins of further steps at t [s]."""
        more = np.empty((3, len(t)))
        moduli = []
        turned = self._frame_rate * t
        for k, (parameter, z, spin_phase) in enumerate((
                (self.alpha, alpha, turned), (self.beta, beta, -turned))):
            real, imag = z.real.copy(), z.imag.copy()
            more[k] = parameter.start if parameter.crosses else unwrap(
                parameter.argument(real, imag) - spin_phase, self.begins[k, -1],
                parameter.momentum)
            moduli.append(parameter.modulus(real, imag, spin_phase))
        cosine, sine = moduli
        more[2] = unwrap(np.arctan2(sine, cosine), self.begins[2, -1], 0.0)
        self.begins = np.concatenate((self.begins, more), axis=1)

    def forget(self, count: int) -> None:
        """Forget the oldest steps."""
        self.begins = self.begins[:, count:].copy()
