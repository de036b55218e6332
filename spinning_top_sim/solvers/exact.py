# SPDX-License-Identifier: Apache-2.0
"""
The exact motion of the heavy symmetric top, at the same cost and accuracy for every time.

`theta_setup` finds the theta functions of a motion once, `theta_values` evaluates them in doubles.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Self

import numpy as np
from gmpy2 import const_pi, mpfr
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Number, Quaternion
from spinning_top_sim.physics.regimes import Description, axis_rests, precession_extremes, regime
from spinning_top_sim.physics.states import TIMES_TOGETHER, States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.multiprecision import as_mpfr, precision
from spinning_top_sim.solvers.theta_setup import ThetaMotion, set_up
from spinning_top_sim.solvers.theta_values import (
    LARGEST_NUMBER,
    ConstantArrays,
    MotionConstants,
    ThetaValues,
    in_range,
)
from spinning_top_sim.solvers.times import LARGEST_NS, Times

# Beyond so many turns the product of rate and time has no exact fraction left.
MOST_TURNS = 2.0 ** 52


class ClosedForm:
    """
    A motion in theta functions, from its start at t = 0.

    top, start : what moves, and from where
    time_limit, ns_limit : the farthest time either way [s], [ns]
    bottom_rate, top_rate : (Lz + L3)/(2 lambda1) and (Lz - L3)/(2 lambda1) [rad/s]
    constants : of the motion, in doubles

    Raises ValueError if doubles cannot hold the constants.
    """

    steps = evaluations = 0
    reached_ns = LARGEST_NS
    start: State

    def __init__(self, top: Top, motion: ThetaMotion, l3: mpfr, lz: mpfr) -> None:
        self.top = top
        with precision():
            alpha, beta, two_lambda1 = motion.alpha, motion.beta, 2 * as_mpfr(top.lambda1)
            bottom_rate, top_rate = (lz + l3) / two_lambda1, (lz - l3) / two_lambda1
            in_range('the fastest rate', max(map(abs, (
                motion.quarter_rate, alpha.rate, beta.rate, bottom_rate, top_rate,
                l3 / as_mpfr(top.lambda3)))))
            self.bottom_rate, self.top_rate = float(bottom_rate), float(top_rate)
            self.constants = MotionConstants(motion)
            fastest = max(abs(motion.quarter_rate), abs(alpha.rate) / (2 * const_pi()),
                          abs(beta.rate) / (2 * const_pi()), 1e-300)
            limit = min(MOST_TURNS / fastest, LARGEST_NUMBER)
            self.time_limit, self.ns_limit = float(limit), min(int(limit * 10 ** 9), LARGEST_NS)

    @cached_property
    def arrays(self) -> ConstantArrays:
        return ConstantArrays([self.constants])

    @property
    def closed_form(self) -> Self:
        return self

    def reach(self, ns: int, max_steps: int | None = None) -> bool:
        return True                     # there are no steps to take

    def release(self, before_ns: int) -> None:
        pass                            # nor to forget

    def states(self, times_ns: NDArray[np.int64] | range) -> States:
        """Return the states at integer nanoseconds (n,), in any order and of any sign."""
        return self._states(Times.from_ns(times_ns), self.ns_limit, 'ns')

    def states_at_seconds(self, t: Column) -> States:
        """Return the states at t (n,) [s], in any order and of any sign."""
        return self._states(Times.from_seconds(t), self.time_limit, 's')

    def _states(self, times: Times, limit: float, unit: str) -> States:
        if not times.latest <= float(limit):    # rounded as the times are; catches NaN too
            raise ValueError(
                f't = {times.latest!r} {unit}: must be finite and within {limit:.6g} {unit}, '
                'where a phase of this motion reaches 2^52 turns or int64 ends')
        return self._states_at(times)

    def _states_at(self, times: Times) -> States:
        raise NotImplementedError


class ExactSolution(ClosedForm):
    """
    The motion of `top` that is in the state `start` at t = 0, in closed form.

    theta goes smoothly through a pole that is passed exactly (and out of [0, pi]), phi and psi are
    unwrapped, the quaternion's sign is continuous.  On every motion each of them is within 5e-15,
    relative to the value or to its start where these are larger than 1.

    Parameters
    ----------
    top : Top
        The top to simulate.
    start : State
        The state at t = 0; of a `ContinuedState` theta may be any number.

    Attributes
    ----------
    nutation_period : float or None
        Period of theta [s], None if it is constant.
    mean_precession_rate, mean_spin_rate : float
        Means over a nutation [rad/s].
    theta_min, theta_max : float
        Bounds of theta folded into [0, pi] [rad].
    m, m1 : float
        Parameter of the elliptic functions and m1 = 1 - m, which is 0 on the separatrix.
    time_limit, ns_limit : float, int
        The farthest time either way [s], [ns].

    Raises
    ------
    ValueError
        For motions whose constants doubles cannot hold, and from every evaluation for bad times.
    """

    def __init__(self, top: Top, start: State) -> None:
        self.turns = round(start.theta / math.tau)
        theta = start.theta - self.turns * math.tau
        # A state continued through a pole is solved from the same attitude with theta in [0, pi].
        self.sign, half_turn = (-1.0, math.pi) if theta < 0.0 else (1.0, 0.0)
        self.start = State(
            theta=min(abs(theta), math.pi), theta_dot=self.sign * start.theta_dot,
            phi=start.phi + half_turn, psi=start.psi - half_turn,
            l3=start.l3, lz=start.lz)
        phi, psi = self.start.phi, self.start.psi
        with precision():
            motion = set_up(top, as_mpfr(top.gravity), self.start)
            super().__init__(top, motion, as_mpfr(start.l3), as_mpfr(start.lz))
            alpha, beta, self.m, self.m1 = (
                motion.alpha, motion.beta, float(motion.m), float(motion.m1))
            # 2 K/w, two quarter periods
            self.nutation_period = float(2 / motion.quarter_rate) if motion.quarter_rate else None
            self.mean_precession_rate = float(alpha.rate + beta.rate)
            self.mean_spin_rate = float(alpha.rate - beta.rate)
            # phi = precession rate * t + phase + alpha's and beta's arguments; psi with a minus.
            self.phi_phase = float(
                phi - alpha.start_argument - beta.start_argument) - half_turn
            self.psi_phase = float(
                psi - alpha.start_argument + beta.start_argument) + half_turn
        self._check_start()

    def _check_start(self) -> None:
        """Refuse constants so far apart that doubles lose the start among them."""
        start, first = self.start, self.at_start
        alpha, beta, theta_dot = (float(x[0]) for x in (*first.moduli, first.theta_dot))
        cosine, sine = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
        # Relative to the distance from either pole, and to a small velocity of the axis.
        across = axis_rate(self.bottom_rate, self.top_rate, cosine, sine)
        for name, error, size in (
                ('theta', beta * cosine - alpha * sine, alpha * sine),
                ('theta_dot', theta_dot - start.theta_dot,
                 min(math.hypot(start.theta_dot, across), max(1.0, abs(start.theta_dot))))):
            if not abs(error) <= 1e-14 * abs(size):
                raise ValueError(f'{name} = {getattr(start, name)!r} cannot be held in doubles: '
                                 f'the constants of {self.top} and {start} are too far apart in '
                                 'size')

    @cached_property
    def at_start(self) -> ThetaValues:
        return ThetaValues(self.arrays, Times.from_ns(range(1)))

    @property
    def theta_min(self) -> float:
        return self.arrays.bounds[0]

    @property
    def theta_max(self) -> float:
        return self.arrays.bounds[1]

    def describe(self) -> Description:
        """Return the motion in numbers."""
        top, start = self.top, self.start
        rests = axis_rests(top, start)
        low, high = 2 * (start.theta,) if rests else (self.theta_min, self.theta_max)
        slowest, fastest = precession_extremes(top, start, low, high)
        weight = 4.0 * top.lambda1 * abs(top.gravity_torque)
        return Description(
            name=regime(top, start), nutation_period=None if rests else self.nutation_period,
            theta_min=low, theta_max=high, mean_precession_rate=self.mean_precession_rate,
            precession_min=slowest, precession_max=fastest, mean_spin_rate=self.mean_spin_rate,
            separatrix_distance=self.m1,
            gyroscopic_ratio=start.l3 * start.l3 / weight if weight else math.inf)

    def _states_at(self, times: Times) -> States:
        return _ExactStates(self, times)


def axis_rate(bottom_rate: float, top_rate: float, cosine: Number, sine: Number) -> Number:
    """
    Return phi' sin(theta) = (Lz - L3 cos(theta))/(lambda1 sin(theta)) in half angles [rad/s].

    Nothing cancels, and at a pole that can be reached the singular term is absent.

    bottom_rate, top_rate : of `ClosedForm`
    """
    rate = 0.0 * cosine
    if bottom_rate:
        rate = rate + bottom_rate * (sine / cosine)
    if top_rate:
        rate = rate + top_rate * (cosine / sine)
    return rate


class ThetaStates(States):
    """States by the theta functions of a motion."""

    method = 'exact'

    def __init__(self, top: Top, start: State, arrays: ConstantArrays, times: Times) -> None:
        super().__init__(top, start, len(times))
        self._arrays, self._times = arrays, times

    @cached_property
    def t(self) -> Column:
        return self._times.seconds

    @cached_property
    def _block(self) -> ThetaValues:
        return ThetaValues(self._arrays, self._times)

    def _rows(self, name: str) -> NDArray[np.float64]:
        """Return an attribute (k, n) of `ThetaValues`, computed a block at a time."""
        blocks = (self._block,) if len(self) <= TIMES_TOGETHER else (
            ThetaValues(self._arrays, self._times[first:first + TIMES_TOGETHER])
            for first in range(0, len(self), TIMES_TOGETHER))
        rows: list[NDArray[np.float64]] = [getattr(block, name) for block in blocks]
        return rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        x, y, z, w = self._rows('quaternion')
        return x, y, z, w

    @cached_property
    def half_angle_squares(self) -> tuple[Column, Column]:
        cosine, sine = self._rows('half_theta')
        return cosine * cosine, sine * sine

    @cached_property
    def _axis_rates(self) -> NDArray[np.float64]:
        """Theta' of the motion with theta in [0, pi] at the start, cos(psi) and sin(psi)."""
        return self._rows('rates')

    def _across(self) -> Column:
        """Return phi' sin(theta) [rad/s]."""
        raise NotImplementedError

    @cached_property
    def transverse_velocity(self) -> tuple[Column, Column]:
        theta_dot, cos_psi, sin_psi = self._axis_rates
        return attitude.transverse(theta_dot, self._across(), cos_psi, sin_psi)


class _ExactStates(ThetaStates):
    """The states of an exact solution, on the branch of its start."""

    def __init__(self, solution: ExactSolution, times: Times) -> None:
        super().__init__(solution.top, solution.start, solution.arrays, times)
        self._solution = solution

    @cached_property
    def _block(self) -> ThetaValues:
        if len(self) == 1 and not self._times.latest:
            return self._solution.at_start
        return ThetaValues(self._arrays, self._times)

    @cached_property
    def rows_quaternion(self) -> Quaternion:
        x, y, z, w = super().rows_quaternion
        return (-x, -y, -z, -w) if self._solution.turns % 2 else (x, y, z, w)

    @cached_property
    def angles(self) -> tuple[Column, Column, Column]:
        solution = self._solution
        precession, phi, theta, spin, psi = self._rows('angles')
        return (precession + (phi + solution.phi_phase),
                solution.sign * theta + solution.turns * math.tau,
                spin + (psi + solution.psi_phase))

    @cached_property
    def theta_dot(self) -> Column:
        theta_dot: Column = self._solution.sign * self._axis_rates[0]
        return theta_dot

    def _across(self) -> Column:
        # `AcceleratedStates` chooses between two formulas.  Here there is only the first, until a
        # MINOR version: a choice would change the last bits of earlier logs.
        cosine, sine = self._rows('half_theta')
        return axis_rate(self._solution.bottom_rate, self._solution.top_rate, cosine, sine)
