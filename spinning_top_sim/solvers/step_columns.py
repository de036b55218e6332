# SPDX-License-Identifier: Apache-2.0
"""Many samples of the transport form at once: `MomentumState`, to the last bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import lazy
from spinning_top_sim.physics.pairs import Pairs
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.phases import ByMomentum, StepPhases, Winding

if TYPE_CHECKING:
    from spinning_top_sim.solvers.dormand_prince import DenseStep

Column = NDArray[Any]


class Samples(NamedTuple):
    """
    Where steps are read, at n times.

    t: the times (n,) [s];  unknowns: alpha, beta and m there, (n,) each, not projected
    half_theta, phases: theta/2 and the phases of alpha and beta, as `StepPhases` has them, at the
        begin of the step that a sample lies in;  windings, line_rate: see there
    ended: numbers of the samples that lie at the end of a step
    """

    t: Column
    unknowns: tuple[Pairs, Pairs, Pairs]
    half_theta: Column
    phases: tuple[Column, Column]
    windings: tuple[Winding, Winding]
    line_rate: float
    ended: list[int]


def read(kept: Sequence[tuple[DenseStep, StepPhases]], times: Sequence[float]) -> Samples:
    """
    Return steps that follow one another, read at ascending times [s] within them.

    A time at which two meet is that of the earlier one.
    """
    t = np.array(times)
    used, number = np.unique(np.array([step.t1 for step, _ in kept]).searchsorted(t),
                             return_inverse=True)
    kept = [kept[k] for k in used.tolist()]
    begins = np.array([(step.t1, step.t0, step.t1 - step.t0 or 1.0, begin.half_theta,
                        begin.alpha.phase, begin.beta.phase)
                       for step, begin in kept]).T
    ends, starts, lengths, half_theta, alpha_phase, beta_phase = begins.take(number, 1)
    polynomials = np.array([step.coefficients for step, _ in kept])     # (steps, 3, 6), complex
    # By power, then by unknown, real and imaginary part apart.
    c = polynomials.view(np.float64).reshape(-1, 3, 6, 2).transpose(2, 1, 3, 0).take(number, 3)
    s = (t - starts) / lengths
    y = ((((c[5] * s + c[4]) * s + c[3]) * s + c[2]) * s + c[1]) * s + c[0]
    _, newest = kept[-1]
    return Samples(t, (Pairs(*y[0]), Pairs(*y[1]), Pairs(*y[2])), half_theta,
                   (alpha_phase, beta_phase), (newest.alpha, newest.beta), newest.line_rate,
                   (t >= ends).nonzero()[0].tolist())


def rotations(angles: Column) -> Pairs:
    """Return exp(i angle): by the functions of the standard library, as for one."""
    each = angles.tolist()
    return Pairs(np.array(list(map(math.cos, each))), np.array(list(map(math.sin, each))))


def _arctan2(y: Column, x: Column) -> Column:
    return np.array(list(map(math.atan2, y.tolist(), x.tolist())))


def _onward(winding: Winding, z: Pairs, before: Column) -> Column:
    """Return the phases as `Winding.onward` does."""
    if winding.sign < 0.0:
        z = -z
    phase = _arctan2(z.imag, z.real)
    turned = phase - before
    if winding.momentum > 0.0:
        turns = 0.0 - np.floor((turned + 0.5 * math.pi) / math.tau)
    else:
        turns = 0.0 - np.ceil((turned - 0.5 * math.pi) / math.tau)
    return phase + math.tau * turns


class StepColumns(ByMomentum):
    """
    States known by alpha, beta and the momentum L_x + i L_y [kg m^2/s] in the world.

    For motions that pass no pole: where neither parameter crosses zero (`StepPhases.crosses`).
    """

    def __init__(self, top: Top, start: State, samples: Samples,
                 on_invariants: Callable[[Samples], tuple[Pairs, Pairs, Pairs]]) -> None:
        """Take where steps were read, and what makes alpha, beta and the momentum of that."""
        self.top, self.l3_start, self.lz_start, self.lz = top, start.l3, start.lz, start.lz
        self._samples, self._line = samples, samples.line_rate * samples.t
        self._on_invariants = on_invariants

    @lazy
    def _unknowns(self) -> tuple[Pairs, Pairs, Pairs]:
        return self._on_invariants(self._samples)

    @lazy
    def alpha(self) -> Pairs:
        """cos(theta/2) exp(i (phi + psi)/2)."""
        return self._unknowns[0]

    @lazy
    def beta(self) -> Pairs:
        """sin(theta/2) exp(i (phi - psi)/2)."""
        return self._unknowns[1]

    @lazy
    def momentum(self) -> Pairs:
        """L_x + i L_y [kg m^2/s] in the world."""
        return self._unknowns[2]

    @lazy
    def quaternion(self) -> tuple[Column, Column, Column, Column]:
        """Attitude q(world <- body): columns x, y, z, w."""
        return attitude.quaternion(self.alpha, self.beta)

    @lazy
    def norm_error(self) -> Column:
        """|q| - 1 (n,)."""
        return np.array(list(map(math.hypot, *map(np.ndarray.tolist, self.quaternion)))) - 1.0

    @lazy
    def half_sum(self) -> Column:
        """(phi + psi)/2, unwrapped [rad]."""
        samples = self._samples
        return _onward(samples.windings[0], self.alpha, samples.phases[0] + self._line)

    @lazy
    def half_difference(self) -> Column:
        """(phi - psi)/2, unwrapped [rad]."""
        samples = self._samples
        return _onward(samples.windings[1], self.beta, samples.phases[1] - self._line)

    @lazy
    def theta(self) -> Column:
        """Tilt, continued through the poles [rad]."""
        alpha, beta = self._samples.windings
        half = _arctan2(beta.sign * np.hypot(self.beta.real, self.beta.imag),
                        alpha.sign * np.hypot(self.alpha.real, self.alpha.imag))
        return 2.0 * (half + math.tau * np.rint((self._samples.half_theta - half) / math.tau))

    @lazy
    def theta_dot(self) -> Column:
        """Nutation rate [rad/s]: the momentum along e2' over lambda1."""
        return (self.momentum * rotations(-self.phi)).imag / self.top.lambda1
