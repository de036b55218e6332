# SPDX-License-Identifier: Apache-2.0
"""
The exact motion for arrays of times.

Two ways lead to a quaternion.  `ExactStates` evaluates the formulas of `exact.nutation_at`, the
even quarter periods apart from the odd ones, for every column.  For quaternions alone,
and away from the separatrix (m1 >= 1e-5), `_FullCircle` uses one pair of theta series all round,
so that a block of times goes through without a case distinction; and since such a series is a sum
of a few sinusoids, on a uniform grid of times a block of them is a product of two small matrices.
"""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from spinning_top_sim.solvers.exact import (
    MOST_TURNS,
    QUARTER_PERIOD_ANGLE,
    Functions,
    nutation_at,
    transverse_rates,
)
from spinning_top_sim.solvers.long_decimals import double_double, pi
from spinning_top_sim.solvers.theta_setup import MODE_TOLERANCE, Factor, Series, ThetaMotion

if TYPE_CHECKING:
    from spinning_top_sim.solvers.exact import ExactSolution

ARRAY = Functions(np.sin, np.sinh, np.sqrt, np.arctan2)
CHUNK = 4096                # states at a time: the temporaries stay in the cache
TWO_PI = 2.0 * math.pi


def _halves(x: Any) -> tuple[Any, Any]:
    """Split doubles into two of 26 bits each, whose products are exact [Dekker 1971]."""
    big = 134217729.0 * x   # 2^27 + 1
    high = big - (big - x)
    return high, x - high


class Rate:
    """
    A rate in double-double; its product with a time has no rounding that grows with the time.

    Times are pairs of arrays: the doubles, and what they leave out (None: nothing).
    """

    def __init__(self, per_second: Decimal):
        self.high, self.low = double_double(per_second)
        self.halves = _halves(self.high)

    def product(self, t: np.ndarray, t_rest: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return rate * t as nearest double and rest."""
        t1, t2 = _halves(t)
        r1, r2 = self.halves
        high = self.high * t
        rest = ((r1 * t1 - high) + r1 * t2 + r2 * t1) + r2 * t2 + self.low * t
        if t_rest is not None:
            rest += self.high * t_rest
        return high, rest

    def whole_and_part(self, t: np.ndarray, t_rest: np.ndarray | None
                       ) -> tuple[np.ndarray, np.ndarray]:
        high, rest = self.product(t, t_rest)
        whole = np.rint(high)
        return whole, (high - whole) + rest


class ExactStates:
    """
    States at many times; every column is an array (n,) or (n, k) computed when first asked for.

    theta [rad], continued through poles; theta_dot [rad/s]; phi, psi [rad], unwrapped;
    quaternion (n, 4) x, y, z, w, body to world; angular_velocity (n, 3) in the body's frame [rad/s].
    """

    def __init__(self, evaluator: ArrayEvaluator, t: np.ndarray, t_rest: np.ndarray | None = None):
        self._evaluator, self._t, self._t_rest = evaluator, t, t_rest

    @cached_property
    def quaternion(self) -> np.ndarray:
        if self._t_rest is None:
            return self._evaluator.quaternion(self._t)
        return self._evaluator.general_quaternion(self)

    @cached_property
    def theta(self) -> np.ndarray:
        return 2.0 * self._half_theta

    @property
    def theta_dot(self) -> np.ndarray:
        return self._nutation[4]

    @cached_property
    def phi(self) -> np.ndarray:
        _, _, alpha_argument, beta_argument, *_ = self._nutation
        high, rest = self._evaluator.precession.product(self._t, self._t_rest)
        return high + (rest + (self._evaluator.phi_phase + (alpha_argument + beta_argument)))

    @cached_property
    def psi(self) -> np.ndarray:
        _, _, alpha_argument, beta_argument, *_ = self._nutation
        high, rest = self._evaluator.spin.product(self._t, self._t_rest)
        return high + (rest + (self._evaluator.psi_phase + (alpha_argument - beta_argument)))

    @cached_property
    def angular_velocity(self) -> np.ndarray:
        solution = self._evaluator.solution
        alpha, beta, alpha_argument, beta_argument, theta_dot, *_ = self._nutation
        psi = self._evaluator.reduced_spin(self._t, self._t_rest) + (
            alpha_argument - beta_argument)
        omega = np.empty((len(self._t), 3))
        omega[:, 0], omega[:, 1] = transverse_rates(
            solution.precession_across_axis(alpha, beta), theta_dot, np.cos(psi), np.sin(psi))
        omega[:, 2] = solution.axial_rate
        return omega

    @cached_property
    def _nutation(self) -> np.ndarray:
        return self._evaluator.nutation(self._t, self._t_rest)

    @cached_property
    def _half_theta(self) -> np.ndarray:
        alpha, beta, *_, turns_from = self._nutation
        half_theta = np.arctan2(beta, alpha)
        if self._evaluator.solution.turning:
            half_theta += TWO_PI * np.rint(turns_from)
        return half_theta


class ArrayEvaluator:
    """What `ExactSolution` needs to serve arrays; one per solution."""

    def __init__(self, solution: ExactSolution):
        self.solution = solution
        self.motion: ThetaMotion = solution.theta_motion
        with localcontext() as context:
            context.prec = self.motion.digits
            two_pi = 2 * pi()
            alpha, beta = self.motion.alpha, self.motion.beta
            self.quarters = Rate(self.motion.quarter_rate)
            self.alpha_turns = Rate(alpha.rate / two_pi)
            self.beta_turns = Rate(beta.rate / two_pi)
            self.spin_turns = Rate((alpha.rate - beta.rate) / two_pi)
            self.precession = Rate(self.motion.mean_precession_rate)
            self.spin = Rate(self.motion.mean_spin_rate)
            self.alpha_phase = float(two_pi * alpha.phase_turns)
            self.beta_phase = float(two_pi * beta.phase_turns)
            self.spin_phase = float(two_pi * (alpha.phase_turns - beta.phase_turns))
        self.phi_phase, self.psi_phase = solution.phi_phase, solution.psi_phase

    # ------------------------------------------------------------------------- what is offered

    def states(self, t: Any) -> ExactStates:
        return ExactStates(self, self._checked(t))

    def states_at_ns(self, ns: Any) -> ExactStates:
        ns = np.asarray(ns)
        if ns.ndim != 1 or not np.issubdtype(ns.dtype, np.integer):
            raise ValueError(f'ns has shape {ns.shape} and type {ns.dtype}: must be (n,) integers')
        seconds, rest = np.divmod(ns.astype(np.int64), 10 ** 9)
        # 1e-9 k, k < 1e9, to double-double; then the sum of both parts likewise.
        return ExactStates(self, *_seconds_from_ns(seconds, rest))

    def quaternion(self, t: Any) -> np.ndarray:
        t = self._checked(t)
        return self.general_quaternion(ExactStates(self, t))

    # ---------------------------------------------------------------------------- general form

    def nutation(self, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        """Return rows alpha, beta, their arguments, theta' (see NutationPoint), missing turns."""
        solution = self.solution
        columns = np.zeros((6, len(t)))
        for first in range(0, len(t), CHUNK):
            block = slice(first, first + CHUNK)
            whole, part = self.quarters.whole_and_part(
                t[block], None if t_rest is None else t_rest[block])
            shift = np.rint(part + solution.offset0)
            quarters = whole + (solution.quarter0 + shift)
            y = QUARTER_PERIOD_ANGLE * ((part - shift) + solution.offset0)
            place = np.mod(quarters, 4.0)
            flip = np.where(place < 2.0, 1.0, -1.0)
            odd = np.mod(place, 2.0) == 1.0
            out = columns[:, block]
            for branch, here in zip(solution.branches, (~odd, odd), strict=True):
                index = np.flatnonzero(here)
                if index.size:
                    out[:5, index] = nutation_at(branch, y[index], flip[index], ARRAY)
            if solution.turning:
                out[5] = solution.turning.turns(quarters, y, np.arctan2(out[1], out[0]))
        return columns

    def general_quaternion(self, states: ExactStates) -> np.ndarray:
        alpha, beta, alpha_argument, beta_argument, *_ = states._nutation
        t, t_rest = states._t, states._t_rest
        out = np.empty((len(t), 4))
        scale = 1.0 / np.sqrt(alpha * alpha + beta * beta)
        for rate, phase, modulus, argument, sine, cosine in (
                (self.alpha_turns, self.alpha_phase, scale * alpha, alpha_argument, 2, 3),
                (self.beta_turns, self.beta_phase, scale * beta, beta_argument, 0, 1)):
            angle = TWO_PI * rate.whole_and_part(t, t_rest)[1] + (phase + argument)
            out[:, sine] = modulus * np.sin(angle)
            out[:, cosine] = modulus * np.cos(angle)
        np.negative(out[:, 0], out=out[:, 0])
        return out

    def reduced_spin(self, t: np.ndarray, t_rest: np.ndarray | None) -> np.ndarray:
        return TWO_PI * self.spin_turns.whole_and_part(t, t_rest)[1] + self.spin_phase

    def _checked(self, t: Any) -> np.ndarray:
        t = np.asarray(t, dtype=np.float64)
        if t.ndim != 1:
            raise ValueError(f't has shape {t.shape}: must be (n,) seconds')
        if t.size:
            latest = max(float(t.max()), -float(t.min()))
            if not latest <= self.solution.time_limit:      # catches NaN too
                raise self.solution._too_late(latest)
        return t


def _seconds_from_ns(seconds: np.ndarray, nanoseconds: np.ndarray
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Return seconds + 1e-9 nanoseconds as nearest doubles and rests, exact to 1e-32."""
    whole, count = seconds.astype(np.float64), nanoseconds.astype(np.float64)
    part, part_rest = Rate(Decimal('1e-9')).product(count, None)
    total = whole + part                            # Dekker's sum: whole is 0 or the larger
    rest = (part - (total - whole)) + part_rest
    return total, rest
