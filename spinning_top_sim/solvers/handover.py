# SPDX-License-Identifier: Apache-2.0
"""A piece of a run, as the world sees it: one solution between two events or changes."""

from __future__ import annotations

import math
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.physics import integrals, pivot
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States, WorldStates
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import IntegrationError, SteppedMotion
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.solvers.vertical import Posture, PreciseState, Vertical, posture_at
from spinning_top_sim.times import NANOSECONDS, ns_array

if TYPE_CHECKING:
    from spinning_top_sim.solvers.exact import ExactSolution

# Stamps of ROS end at 2^31 s, and doubles hold phases up to 2^52.  The fastest one is that of the
# nutation in quarter periods: next to hanging it may nutate at twice the rate of its bound.
FASTEST_RATE = 0.5 * math.pi * 2.0 ** 52 / 2.0 ** 31    # [rad/s]

Times = NDArray[np.int64] | range
# A motion, and the vertical that it is about, if that is not the world's.
Solution = tuple['ExactSolution | SteppedMotion', Vertical | None]


class Piece:
    """
    A piece of a run: one solution, between two events or changes of the pivot's acceleration.

    Times are simulated times [ns].  While the pivot has always rested, angles are unwrapped; else
    they are those of `WorldStates`.

    top : in the gravity of the world
    start : about the vertical of the world, at `start_ns`
    ride : what the pivot does; REST where it has always rested at the origin
    method, equations, rtol, atol : as of `solve`

    l3, lz, energy : constants of the motion in the frame of the pivot; Lz about the line of
        effective gravity, which is positive upwards
    fastest_rate : bound on how fast the attitude and the body's rates change [rad/s]
    steps, evaluations : counts; 0 for the exact solution

    Raises ValueError, naming what is off, where no motion begins.
    """

    def __init__(self, top: Top, start: State | Posture, start_ns: int,
                 ride: pivot.Ride = pivot.REST, *, method: str = 'rk45',
                 equations: str = 'transport', rtol: float = 1e-11, atol: float = 1e-12) -> None:
        self.top, self.start_ns, self.ride, self._start = top, start_ns, ride, start
        try:
            with np.errstate(over='ignore', invalid='ignore'):
                self._posture = (PreciseState.of(start).posture(top) if isinstance(start, State)
                                 else start.in_doubles())
                self._solution = self._begun(method, equations=equations, rtol=rtol, atol=atol)
                self._motion, self._vertical = self._solution
                about, begun, across = (
                    self._motion.top, self._motion.start, abs(self._posture.transverse))
                self.l3, self.lz = begun.l3, begun.lz
                self.energy = 0.5 * (top.lambda1 * across * across + begun.l3 / top.lambda3
                                     * begun.l3) + about.gravity_torque * math.cos(begun.theta)
                self.fastest_rate = integrals.fastest_rate(about, self.l3, self.energy)
            if not self.fastest_rate <= FASTEST_RATE:
                raise ValueError(f'it turns at up to {self.fastest_rate:.3g} rad/s: must be at '
                                 f'most {FASTEST_RATE:.2g}')
        except (ArithmeticError, IntegrationError, ValueError) as error:
            whence = (f'theta = {start.theta!r} rad, theta_dot = {start.theta_dot!r} rad/s with '
                      f'l3 = {start.l3!r}, lz = {start.lz!r} kg m^2/s' if isinstance(start, State)
                      else f't = {start_ns / NANOSECONDS!r} s on')
            raise ValueError(f'no motion from {whence}, for {top}: {error}') from error

    def _begun(self, method: str, **settings: Any) -> Solution:
        top, start = self.top, self._start
        if self.ride is pivot.REST and isinstance(start, State):
            return motion_of(top, start, method=method, **settings), None
        if method == 'exact':
            with needed("method = 'exact'"):
                from spinning_top_sim.solvers.exact import exact_about  # noqa: PLC0415 - gmpy2
            return exact_about(top, start, self.ride.acceleration)
        vertical = Vertical.of(top, self.ride.acceleration, float)
        posture = vertical.to_frame(self._posture)
        state = PreciseState.of_posture(vertical.top, posture).rounded()
        return motion_of(vertical.top, state, method=method, posture=posture,
                         **settings), vertical

    @property
    def start(self) -> State:
        """The state at the start, about the line of effective gravity."""
        return self._motion.start

    @property
    def rests(self) -> bool:
        """Whether the pivot has always rested."""
        return self._vertical is None

    def describe(self) -> Description | None:
        """Return the motion in numbers; None if it has no closed form or the pivot moves."""
        return self._exact[0].describe() if self.rests and self._exact else None

    @property
    def steps(self) -> int:
        return self._motion.steps

    @property
    def evaluations(self) -> int:
        return self._motion.evaluations

    def states(self, t_ns: Times) -> States:
        """
        Return the states in the world, the pivot included, at ascending times from the start on.

        Raises IntegrationError where steps cannot go on; `reached_ns` says how far they do.
        """
        try:
            return self._in_world(self._solution, t_ns)
        except IntegrationError as error:
            error.reached_ns += self.start_ns
            raise

    def truth(self, t_ns: Times) -> States | None:
        """Return the exact states of the same piece; None where doubles cannot hold them."""
        return None if self._exact is None else self._in_world(self._exact, t_ns)

    @cached_property
    def _exact(self) -> tuple[ExactSolution, Vertical | None] | None:
        if not isinstance(self._motion, SteppedMotion):
            return self._motion, self._vertical
        with suppress(ImportError, ValueError):
            motion, vertical = self._begun('exact')
            return cast('ExactSolution', motion), vertical
        return None

    def posture(self, t_ns: int) -> Posture:
        """Return attitude and angular velocity in the world at a time, for what follows."""
        if isinstance(self._motion, SteppedMotion):
            return posture_at(self.states(np.array([t_ns])))
        return self._motion.posture(t_ns - self.start_ns, self._vertical)

    def forget(self, before_ns: int) -> None:
        """Forget the steps that only earlier times need."""
        if isinstance(self._motion, SteppedMotion):
            self._motion.forget(before_ns - self.start_ns)

    def with_ride(self, ride: pivot.Ride) -> Self:
        """Return this motion where the pivot has the same acceleration till another end."""
        changed = copy(self)
        changed.ride = ride
        return changed

    def _in_world(self, solution: Solution, t_ns: Times) -> States:
        (motion, vertical), times_ns = solution, ns_array(t_ns)
        states = motion.states(times_ns - self.start_ns)
        return states if vertical is None else WorldStates(
            self.top, states, vertical.rotation, self.ride, times_ns)
