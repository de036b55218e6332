# SPDX-License-Identifier: Apache-2.0
"""A piece of a run, as the world sees it: one solution between two events or changes."""

from __future__ import annotations

import math
from contextlib import suppress
from copy import copy
from functools import cached_property
from typing import Any, Self

import numpy as np

from spinning_top_sim.installation import needed
from spinning_top_sim.physics import integrals, pivot
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States, WorldStates
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.motion import Motion
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.solvers.vertical import Posture, Vertical
from spinning_top_sim.times import NANOSECONDS, Times, ns_array

# Stamps of ROS end at 2^31 s, and doubles hold phases up to 2^52.  The fastest one is that of the
# nutation in quarter periods: next to hanging it may nutate at twice the rate of its bound.
FASTEST_RATE = 0.5 * math.pi * 2.0 ** 52 / 2.0 ** 31    # [rad/s]


class Piece:
    """
    A piece of a run: one solution, between two events or changes of the pivot's acceleration.

    Times are simulated times [ns].  While the pivot has always rested, angles are unwrapped; else
    they are those of `WorldStates`.

    top : in the gravity of the world
    start : about the vertical of the world, at `start_ns`
    ride : what the pivot does; REST where it has always rested at the origin
    method, settings : as of `motion_of`

    motion : the solution, in the frame of the pivot about the line of effective gravity
    rests : whether the pivot has always rested; behind a ride a motion begins with a Posture
    l3, lz, energy : constants of the motion; Lz about that line, which is positive upwards
    fastest_rate : bound on how fast the attitude and the body's rates change [rad/s]

    Raises ValueError, naming what is off, where no motion begins.
    """

    def __init__(self, top: Top, start: State | Posture, start_ns: int,
                 ride: pivot.Ride = pivot.REST, *, method: str = 'rk45', **settings: Any) -> None:
        self.top, self.start_ns, self.ride, self._start = top, start_ns, ride, start
        self.rests = ride is pivot.REST and isinstance(start, State)
        try:
            with np.errstate(over='ignore', invalid='ignore'):
                posture = Posture.of(top, start).in_doubles()
                self.motion, self._vertical = self._solution(posture, method, settings)
                top, begin = self.motion.top, self.motion.start     # in effective gravity
                self.l3, self.lz, transverse = begin.l3, begin.lz, abs(posture.transverse)
                self.energy = 0.5 * (
                    top.lambda1 * transverse * transverse + self.l3 / top.lambda3 * self.l3
                    ) + top.gravity_torque * math.cos(begin.theta)
                self.fastest_rate = integrals.fastest_rate(top, self.l3, self.energy)
            if not self.fastest_rate <= FASTEST_RATE:
                raise ValueError(f'it turns at up to {self.fastest_rate:.3g} rad/s: must be at '
                                 f'most {FASTEST_RATE:.2g}')
        except (ArithmeticError, IntegrationError, ValueError) as error:
            whence = start if isinstance(start, State) else f't = {start_ns / NANOSECONDS!r} s on'
            raise ValueError(f'no motion from {whence}, for {self.top}: {error}') from error

    def _solution(self, posture: Posture, method: str, settings: Any,
                  ) -> tuple[Motion, Vertical | None]:
        """Return the motion, and the vertical that it is about if that is not the world's."""
        top, start = self.top, self._start
        if self.rests and isinstance(start, State):
            return motion_of(top, start, method=method, **settings), None
        if method == 'exact':
            with needed("method = 'exact'"):
                from spinning_top_sim.solvers.exact import exact_about  # noqa: PLC0415 - gmpy2
            return exact_about(top, start, self.ride.acceleration)
        vertical = Vertical.of(top, self.ride.acceleration, float)
        return motion_of(vertical.top, vertical.to_frame(posture), method=method,
                         **settings), vertical

    def states(self, t_ns: Times | range) -> States:
        """
        Return the states in the world, the pivot included, at ascending times from the start on.

        Raises IntegrationError where steps cannot go on; `reached_ns` says how far they do.
        """
        times_ns = ns_array(t_ns)
        try:
            states = self.motion.states(times_ns - self.start_ns, NANOSECONDS)
        except IntegrationError as error:
            error.reached_ns += self.start_ns
            raise
        return states if self._vertical is None else WorldStates(
            self.top, states, self._vertical.rotation, self.ride, times_ns)

    @cached_property
    def exact(self) -> Piece | None:
        """This by the closed form, perhaps of an older ride; None where doubles cannot hold it."""
        if self.motion.is_exact:
            return self
        with suppress(ImportError, ValueError):
            return Piece(self.top, self._start, self.start_ns, self.ride, method='exact')
        return None

    def describe(self) -> Description | None:
        """Return the motion in numbers; None if it has no closed form or the pivot moves."""
        return self.exact.motion.describe() if self.rests and self.exact else None

    def posture(self, t_ns: int) -> Posture:
        """Return attitude and angular velocity in the world at a time, for what follows."""
        precise = self.motion.precise_posture(t_ns - self.start_ns, self._vertical)
        if precise is not None:
            return precise
        states = self.states(np.array([t_ns]))
        x, y, z, w, w1, w2 = (float(part[0]) for part in (
            *states.rows_quaternion, *states.transverse_velocity))
        return Posture(complex(w, z), complex(y, -x), complex(w1, w2), self.l3)

    def forget(self, before_ns: int) -> None:
        """Forget the steps that only earlier times need."""
        self.motion.forget(before_ns - self.start_ns)

    def with_ride(self, ride: pivot.Ride) -> Self:
        """Return this motion where the pivot has the same acceleration till another end."""
        changed = copy(self)
        changed.ride = ride
        return changed
