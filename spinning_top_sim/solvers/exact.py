# SPDX-License-Identifier: Apache-2.0
"""The exact motion of the heavy symmetric top, at the same cost and accuracy for every time."""

from __future__ import annotations

import math

import numpy as np
from gmpy2 import mpfr, sin_cos

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.pivot import Fractions
from spinning_top_sim.physics.regimes import Description, axis_rests, precession_extremes, regime
from spinning_top_sim.physics.states import States, joined
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.constants import set_up
from spinning_top_sim.solvers.evaluate import ExactStates, ThetaArrays
from spinning_top_sim.solvers.motion import Motion
from spinning_top_sim.solvers.theta import precision
from spinning_top_sim.solvers.vertical import Posture, Vertical
from spinning_top_sim.times import NANOSECONDS, Times

# Beyond so many turns the product of rate and time has no exact fraction left.
MOST_TURNS = 2.0 ** 52
# Times that are evaluated together: the temporaries of more do not fit into the cache.
TIMES_TOGETHER = 8192


class ExactSolution(Motion):
    """
    The motion of `top` that is in the state `start` at t = 0, in closed form.

    theta goes smoothly through a pole that is passed exactly (and out of [0, pi]), phi and psi are
    unwrapped, the quaternion's sign is continuous.  On every motion each of them is within 5e-15,
    relative to the value or to its start where these are larger than 1.

    Raises ValueError for motions whose constants doubles cannot hold, and for bad times.

    Parameters
    ----------
    top, start : Top, State or Posture
        The top, and its state at t = 0; of a `ContinuedState` theta may be any number.
    gravity : mpfr, optional
        In place of that of the top, for a motion about another vertical [m/s^2].

    Attributes
    ----------
    nutation_period, mean_precession_rate, mean_spin_rate, theta_min, theta_max : float
        As in `Description`, but those of a nutation however small.
    time_limit : float
        The farthest time either way [s]: there a phase has made 2^52 turns.
    """

    is_exact = True

    def __init__(self, top: Top, start: State | Posture, gravity: mpfr | None = None) -> None:
        self._given = start
        with precision():
            super().__init__(top, start if isinstance(start, State) else start.state(top))
            self._motion = motion = set_up(top, start, gravity)
            alpha, beta = motion.alpha, motion.beta
            # 2 K/w, two quarter periods
            self.nutation_period = float(2 / motion.quarter_rate) if motion.quarter_rate else None
            self.mean_precession_rate = float(alpha.rate + beta.rate)
            self.mean_spin_rate = float(alpha.rate - beta.rate)
            self.time_limit = MOST_TURNS / max(
                abs(float(motion.quarter_rate)), 1e-290,
                (abs(self.mean_precession_rate) + abs(self.mean_spin_rate)) / (4.0 * math.pi))
            self.arrays = ThetaArrays(motion, self.start)
        self.theta_min, self.theta_max = sorted(one.tilt for one in motion.turning)

    def describe(self) -> Description:
        top, start = self.top, self.start
        low, rests = self.theta_min, axis_rests(top, start)
        high = low if rests else self.theta_max
        slowest, fastest = precession_extremes(top, start, low, high)
        weight = 4.0 * top.lambda1 * abs(top.gravity_torque)
        return Description(
            name=regime(top, start, low, high),
            nutation_period=None if rests else self.nutation_period,
            theta_min=low, theta_max=high, mean_precession_rate=self.mean_precession_rate,
            precession_min=slowest, precession_max=fastest, mean_spin_rate=self.mean_spin_rate,
            separatrix_distance=float(self._motion.m1),
            gyroscopic_ratio=start.l3 * start.l3 / weight if weight else math.inf)

    def states(self, t: Column | Times, per_second: int = 1) -> States:
        """Return the states at times (n,), in any order and of any sign."""
        t = t.astype(np.float64)
        latest = float(np.abs(t).max(initial=0.0)) / per_second
        if not latest <= self.time_limit:       # catches NaN too
            raise ValueError(
                f't = {latest!r} s: must be finite and within {self.time_limit:.6g} s, where a '
                'phase of this motion reaches 2^52 turns')
        return joined([ExactStates(self.top, self.start, self.arrays, per_second,
                                   t[k:k + TIMES_TOGETHER])
                       for k in range(0, len(t) or 1, TIMES_TOGETHER)])

    def precise_posture(self, t_ns: int, vertical: Vertical | None) -> Posture:
        """
        Return attitude and angular velocity in the world in multiprecision.

        They are right to 38 digits, times what the motion makes of such an error.
        """
        with precision():
            found = Posture.of(self.top, self._given, mpfr, sin_cos)
            if t_ns:                # perhaps at a pole, where the axis does not tell its rates
                found = Posture(*self._motion.at(mpfr(t_ns) / NANOSECONDS), found.l3)
            return vertical.to_world(found) if vertical else found


def exact_about(top: Top, start: State | Posture,
                acceleration: Fractions) -> tuple[ExactSolution, Vertical]:
    """Return the motion while the pivot accelerates so [m/s^2], and the vertical it is about."""
    with precision():
        vertical = Vertical.of(top, acceleration, mpfr)
        posture = vertical.to_frame(Posture.of(top, start, mpfr, sin_cos))
    return ExactSolution(vertical.top, posture, vertical.gravity), vertical
