# SPDX-License-Identifier: Apache-2.0
"""A piece of a run, as the world sees it: one solution between two events or changes."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import integrals, pivot
from spinning_top_sim.physics.pivot import NANOSECONDS, REST
from spinning_top_sim.physics.regimes import Description
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.physics.world_states import WorldStates
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import ClosedForm, ExactSolution
from spinning_top_sim.solvers.propagator import Motion, propagate, propagate_accelerated
from spinning_top_sim.solvers.vertical import AcceleratedMotion, Posture, posture_at, posture_of

# The last stamp of ROS is 2^31 s; a double holds the phases of a motion up to 2^52 half turns.
FASTEST_RATE = math.pi * 2.0 ** 52 / 2.0 ** 31          # [rad/s]

Times = NDArray[np.int64] | range


class Piece:
    """
    A piece of a run: one solution, between two events or changes of the pivot's acceleration.

    Times are simulated times [ns].  While the pivot has always rested, phi and psi are unwrapped
    and theta goes on through the poles; else theta is in [0, pi], phi and psi in [-2 pi, 2 pi].

    Parameters
    ----------
    top : Top
        In the gravity of the world.
    start : State or Posture
        About the vertical of the world, at `start_ns`.
    start_ns : int
        When the piece begins [ns].
    ride : pivot.Piece
        What the pivot does; REST where it rests at the origin.
    method, equations, rtol, atol
        As of `solve`.

    Attributes
    ----------
    l3, lz, energy : float
        Constants of the motion in the frame of the pivot; Lz about the line of effective gravity.
    fastest_rate : float
        Bound on how fast the attitude and the body's rates change [rad/s].
    steps, evaluations : int
        Counts; 0 for the exact solution.

    Raises
    ------
    ValueError
        Naming what is off, where no motion begins.
    """

    def __init__(self, top: Top, start: State | Posture, start_ns: int, ride: pivot.Piece = REST,
                 *, method: str = 'rk45', equations: str = 'transport', rtol: float = 1e-11,
                 atol: float = 1e-12) -> None:
        self.top, self.start_ns, self.ride, self._start = top, start_ns, ride, start
        self._rests = ride is REST and isinstance(start, State)
        settings: dict[str, Any] = {'method': method, 'equations': equations, 'rtol': rtol,
                                    'atol': atol}
        whence = start if isinstance(start, State) else f't = {start_ns / NANOSECONDS!r} s on'
        try:
            with np.errstate(over='ignore', invalid='ignore'):
                if self._rests:
                    assert isinstance(start, State)
                    self._motion: Motion = propagate(top, start, **settings)
                    self._rotation = None
                else:
                    self._motion, vertical = propagate_accelerated(
                        top, start, ride.acceleration, **settings)
                    self._rotation = vertical.rotation
                self.l3, self.lz = self._motion.start.l3, self._motion.start.lz
                self.energy = float(self._motion.states(range(1)).energy[0])
                self.fastest_rate = integrals.fastest_rate(
                    self._motion.top, self.l3, self.energy)
            if not self.fastest_rate <= FASTEST_RATE:
                raise ValueError(f'it turns at up to {self.fastest_rate:.3g} rad/s: must be at '
                                 f'most {FASTEST_RATE:.2g}')
        except (ArithmeticError, IntegrationError, ValueError) as error:
            raise ValueError(f'no motion from {whence}, for {top}: {error}') from error

    @property
    def start(self) -> State:
        """The state at the start, about the line of effective gravity."""
        return self._motion.start

    @property
    def rests(self) -> bool:
        """Whether the pivot has always rested."""
        return self._rotation is None

    def describe(self) -> Description | None:
        """Return the motion in numbers; None if it has no closed form or the pivot moves."""
        return (self._exact.describe() if self.rests and isinstance(self._exact, ExactSolution)
                else None)

    @property
    def is_exact(self) -> bool:
        """Whether the states are those of `truth`."""
        return self._motion.closed_form is self._motion

    @property
    def steps(self) -> int:
        return self._motion.steps

    @property
    def evaluations(self) -> int:
        return self._motion.evaluations

    def states(self, t_ns: Times) -> States:
        """
        Return the states in the world, the pivot included, at ascending times from the start on.

        The steps that are missing are taken here, and kept until `forget`.

        Raises
        ------
        IntegrationError
            Where the equations cannot go on; its `reached_ns` says up to when they do [ns].
        """
        since_ns = self._since_start(t_ns)
        if len(since_ns):
            try:
                self._motion.reach(int(since_ns[-1]))
            except IntegrationError as error:
                error.reached_ns = self.start_ns + self._motion.reached_ns
                raise
        return self._in_world(self._motion.states(since_ns), t_ns)

    def truth(self, t_ns: Times) -> States | None:
        """Return the exact states of the same piece; None where doubles cannot hold them."""
        if self._exact is None:
            return None
        return self._in_world(self._exact.states(self._since_start(t_ns)), t_ns)

    @cached_property
    def _exact(self) -> ClosedForm | None:
        return self._motion.closed_form

    def posture(self, t_ns: int) -> Posture:
        """Return attitude and angular velocity in the world at a time, for what follows."""
        if isinstance(self._motion, AcceleratedMotion):
            return self._motion.posture(t_ns - self.start_ns)
        if t_ns == self.start_ns and isinstance(self._start, State):
            return posture_of(self.top, self._start)
        if isinstance(self._motion, ExactSolution) and isinstance(self._start, State):
            return AcceleratedMotion(self.top, posture_of(self.top, self._start),
                                     REST.acceleration).posture(t_ns - self.start_ns)
        return posture_at(self.states(range(t_ns, t_ns + 1)))

    def forget(self, before_ns: int) -> None:
        """Forget the steps that only earlier times need."""
        self._motion.release(before_ns - self.start_ns)

    def with_ride(self, ride: pivot.Piece) -> Self:
        """Return this motion where the pivot has the same acceleration till another end."""
        changed = object.__new__(type(self))
        changed.__dict__.update(self.__dict__, ride=ride)
        return changed

    def _since_start(self, t_ns: Times) -> Times:
        if isinstance(t_ns, np.ndarray):
            return t_ns - self.start_ns
        return range(t_ns.start - self.start_ns, t_ns.stop - self.start_ns, t_ns.step)

    def _in_world(self, states: States, t_ns: Times) -> States:
        if self._rotation is None:
            return states
        return WorldStates(self.top, states, self._rotation, self.ride, np.asarray(t_ns))
