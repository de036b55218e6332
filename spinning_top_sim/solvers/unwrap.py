# SPDX-License-Identifier: Apache-2.0
"""
Unwrapped angles of a stepped motion, from the phases of the Cayley-Klein parameters.

arg(alpha) - (Omega/2) t turns one way only, in the sense of Lz + L3, and arg(beta) + (Omega/2) t
in that of Lz - L3 (Omega = L3/lambda3 - L3/lambda1; each rate is its momentum over a square).  So
a phase follows from its value modulo 2 pi and from the phase at the begin of its step.  Where one
of these momenta vanishes, the axis may cross that pole exactly: then the parameter moves on a
straight line through zero, whose phase is known, and its modulus changes sign.
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


def turns_onward(phase: Column, before: Column, momentum: float) -> Column:
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
    return phases + math.tau * np.cumsum(turns_onward(phases, previous, momentum))


@dataclass(frozen=True)
class Winding:
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

    def modulus(self, real: Column, imag: Column, line: Column) -> Column:
        """Return the signed modulus; `line` is what the uniform spin adds to the phase [rad]."""
        if self.crosses:
            phase = self.start + line
            return real * np.cos(phase) + imag * np.sin(phase)
        return self.sign * np.hypot(real, imag)

    def argument(self, real: Column, imag: Column) -> Column:
        """Return the phase [rad], less whole turns, of a parameter with this sign."""
        return np.arctan2(self.sign * imag, self.sign * real)

    def phase(self, real: Column, imag: Column, before: Column, line: Column) -> Column:
        """Return the unwrapped phase [rad]; `before` is that of its step's begin, less `line`."""
        if self.crosses:
            return self.start + line
        argument = self.argument(real, imag)
        return argument + math.tau * turns_onward(argument, before + line, self.momentum)


class PhaseUnwrapper:
    """
    The windings of alpha and beta of a motion, and their phases at the begins of its steps.

    line_rate : what the uniform spin of the stepped frame adds to the phase of alpha [rad/s], and
        takes from that of beta
    """

    def __init__(self, start: State, line_rate: float) -> None:
        self.alpha = Winding(start.lz + start.l3, math.copysign(1.0, math.cos(0.5 * start.theta)),
                             0.5 * (start.phi + start.psi))
        self.beta = Winding(start.lz - start.l3, math.copysign(1.0, math.sin(0.5 * start.theta)),
                            0.5 * (start.phi - start.psi))
        self._line_rate = line_rate
        # Phases of alpha and beta less the line, and theta/2 [rad], at the begins of steps.
        self.begins = np.array([[self.alpha.start], [self.beta.start], [0.5 * start.theta]])

    def extend(self, t: Column, alpha: NDArray[np.complex128],
               beta: NDArray[np.complex128]) -> None:
        """Follow the phases over the begins of further steps at t [s]."""
        line = self._line_rate * t
        more = np.empty((3, len(t)))
        moduli = []
        for row, before, winding, z, its_line in zip(
                more, self.begins[:, -1], (self.alpha, self.beta), (alpha, beta), (line, -line),
                strict=False):
            real, imag = z.real.copy(), z.imag.copy()
            row[:] = winding.start if winding.crosses else unwrap(
                winding.argument(real, imag) - its_line, before, winding.momentum)
            moduli.append(winding.modulus(real, imag, its_line))
        cosine, sine = moduli
        more[2] = unwrap(np.arctan2(sine, cosine), self.begins[2, -1], 0.0)
        self.begins = np.concatenate((self.begins, more), axis=1)

    def forget(self, count: int) -> None:
        """Forget the oldest steps."""
        self.begins = self.begins[:, count:].copy()
