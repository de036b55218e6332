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
from collections.abc import Sequence

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


class PhaseUnwrapper:
    """
    The phases of alpha and beta of a motion at the begins of its steps.

    uniform_rate : of alpha's phase in the frame that is stepped; minus that of beta's [rad/s]
    momenta : Lz + L3, Lz - L3 and 0: their signs are the senses of turning
    begins : (3, n) phases of alpha and beta, less their uniform parts, and theta/2 [rad]
    """

    def __init__(self, start: State, uniform_rate: float) -> None:
        half = 0.5 * start.theta
        self._uniform_rate = uniform_rate
        self.momenta = start.lz + start.l3, start.lz - start.l3, 0.0
        # Of the moduli, where theta is continued out of [0, pi].
        self._signs = math.copysign(1.0, math.cos(half)), math.copysign(1.0, math.sin(half))
        self._starts = 0.5 * start.phi + 0.5 * start.psi, 0.5 * start.phi - 0.5 * start.psi
        self.begins = np.array([*self._starts, half])[:, np.newaxis]

    def polar(self, y: Sequence[Column], uniform: Column) -> tuple[list[Column], list[Column]]:
        """
        Return the signed moduli of alpha and beta, and phases as in `begins`, up to whole turns.

        y : real and imaginary parts of alpha and beta, and more
        uniform : the uniform part of alpha's phase in the same frame [rad]
        """
        moduli, phases = [], []
        for k, part in enumerate((uniform, -uniform)):
            real, imag, sign, start = y[2 * k], y[2 * k + 1], self._signs[k], self._starts[k]
            if self.momenta[k]:
                moduli.append(sign * np.hypot(real, imag))
                phases.append(np.arctan2(sign * imag, sign * real) - part)
            else:       # it moves on a line through zero
                moduli.append(real * np.cos(start + part) + imag * np.sin(start + part))
                phases.append(np.full(len(part), start))
        return moduli, [*phases, np.arctan2(moduli[1], moduli[0])]

    def extend(self, t: Column, alpha: NDArray[np.complex128],
               beta: NDArray[np.complex128]) -> None:
        """Follow the phases over the begins of further steps at t [s]."""
        parts = [x.copy() for x in (alpha.real, alpha.imag, beta.real, beta.imag)]
        _, phases = self.polar(parts, self._uniform_rate * t)
        self.begins = np.concatenate((self.begins, [*map(
            unwrap, phases, self.begins[:, -1], self.momenta)]), axis=1)

    def forget(self, count: int) -> None:
        self.begins = self.begins[:, count:].copy()
