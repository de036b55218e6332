# SPDX-License-Identifier: Apache-2.0
"""
Unwrapped angles of a stepped motion, from the phases of the Cayley-Klein parameters.

phi + psi and phi - psi are twice the phases of alpha and beta, with the rates

    alpha:   Omega/2 + (Lz + L3)/(4 lambda1 cos^2(theta/2)),   Omega = L3/lambda3 - L3/lambda1,
    beta:   -Omega/2 + (Lz - L3)/(4 lambda1 sin^2(theta/2)).

The first term is the uniform part.  The second never changes its sign, and turns the phase by
little more than half a turn in a step, however near a pole the step passes.  So the phase of a
sample is, of all arctan2(..) + 2 pi k, the first one ahead of the phase at the begin of its step.

If Lz + L3 or Lz - L3 is 0, alpha or beta has the uniform part alone.  It then moves on a line
through zero, and its modulus changes sign where the axis passes that pole.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.top import State


def turns_to_follow(phase: Column, before: Column, momentum: float) -> Column:
    """
    Return the whole turns to add to `phase` so that it follows `before` [rad].

    In the sense of `momentum` it then lies within (-pi/2, 3 pi/2) from there: backwards by
    rounding at most.  Without a sense (momentum 0) it is the nearest.
    """
    ahead = 0.5 * math.pi * ((momentum > 0.0) - (momentum < 0.0))
    return 0.0 - np.rint((phase - before - ahead) / math.tau)


def unwrap(phases: Column, before: float, momentum: float) -> Column:
    """Return phases [rad], each a step after the one before it, unwrapped from `before` on."""
    previous = np.concatenate(([before], phases[:-1]))
    return phases + math.tau * np.cumsum(turns_to_follow(phases, previous, momentum))


class Phase(NamedTuple):
    """
    The phase and the signed modulus of alpha or beta.

    The methods take the real and the imaginary part in some frame, and `uniform`, the uniform part
    of the phase in that frame [rad].

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

    def modulus(self, real: Column, imag: Column, uniform: Column) -> Column:
        if self.crosses:
            phase = self.start + uniform
            return real * np.cos(phase) + imag * np.sin(phase)
        return self.sign * np.hypot(real, imag)

    def at(self, real: Column, imag: Column, uniform: Column, begin: Column) -> Column:
        """Return the phase [rad]; begin: that at the begin of the step, less its uniform part."""
        if self.crosses:
            return self.start + uniform
        argument = np.arctan2(self.sign * imag, self.sign * real)
        return argument + math.tau * turns_to_follow(argument, begin + uniform, self.momentum)

    def at_begins(self, real: Column, imag: Column, uniform: Column, before: float) -> Column:
        """Return the phases at the begins of steps after `before`, less their uniform parts."""
        if self.crosses:
            return np.full(len(real), self.start)
        argument = np.arctan2(self.sign * imag, self.sign * real)
        return unwrap(argument - uniform, before, self.momentum)

    def on_line(self, real: Column, imag: Column, uniform: Column) -> tuple[Column, Column]:
        """Return both parts; those of a parameter that crosses zero are moved onto its line."""
        if not self.crosses:
            return real, imag
        modulus, phase = self.modulus(real, imag, uniform), self.start + uniform
        return modulus * np.cos(phase), modulus * np.sin(phase)


class PhaseUnwrapper:
    """
    The phases of alpha and beta of a motion at the begins of its steps.

    uniform_rate : of alpha's phase in the frame that is stepped; minus that of beta's [rad/s]
    begins : (3, n) phases of alpha and beta, less their uniform parts, and theta/2 [rad]
    """

    def __init__(self, start: State, uniform_rate: float) -> None:
        half = 0.5 * start.theta
        self.of_alpha = Phase(start.lz + start.l3, math.copysign(1.0, math.cos(half)),
                              0.5 * start.phi + 0.5 * start.psi)
        self.of_beta = Phase(start.lz - start.l3, math.copysign(1.0, math.sin(half)),
                             0.5 * start.phi - 0.5 * start.psi)
        self._uniform_rate = uniform_rate
        self.begins = np.array([[self.of_alpha.start], [self.of_beta.start], [half]])

    def extend(self, t: Column, alpha: NDArray[np.complex128],
               beta: NDArray[np.complex128]) -> None:
        """Follow the phases over the begins of further steps at t [s]."""
        uniform = self._uniform_rate * t
        of_alpha = alpha.real.copy(), alpha.imag.copy(), uniform
        of_beta = beta.real.copy(), beta.imag.copy(), -uniform
        before = self.begins[:, -1]
        half_theta = np.arctan2(self.of_beta.modulus(*of_beta), self.of_alpha.modulus(*of_alpha))
        self.begins = np.concatenate((self.begins, (
            self.of_alpha.at_begins(*of_alpha, before[0]),
            self.of_beta.at_begins(*of_beta, before[1]),
            unwrap(half_theta, before[2], 0.0))), axis=1)

    def forget(self, count: int) -> None:
        """Forget the oldest steps."""
        self.begins = self.begins[:, count:].copy()
