# SPDX-License-Identifier: Apache-2.0
"""A motion between two commands, and the exact solution that it is compared with."""

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.propagator import Propagator

# A motion whose exact solution ends before three years is refused when it begins.
SHORTEST_RUN_NS = 10 ** 17


class Segment:
    """
    A motion from its start, or from a command, until the next command, in simulated time.

    solver : its t = 0 is `start_ns`; only the segment lets it step
    reached_ns, end_ns : simulated times up to which no further steps are needed, and up to which
        the solver goes at all [ns]
    energy, l3, lz : constants of the motion, as it began
    kept_ns : `release` keeps the steps of this time before its argument [ns]
    """

    kept_ns = 0

    def __init__(self, solver: Propagator, start: State, start_ns: int) -> None:
        self.solver, self.start, self.start_ns = solver, start, start_ns
        self.end_ns = start_ns + solver.ns_limit
        self.reached_ns = min(start_ns + solver.reached_ns, self.end_ns)
        first = solver.states(range(1))
        self.energy, self.l3, self.lz = float(first.energy[0]), start.l3, start.lz

    @cached_property
    def exact(self) -> ExactSolution | None:
        """
        The exact solution of the same motion; None where it ends before SHORTEST_RUN_NS.

        Its set-up takes milliseconds, and may be done in another thread than the simulation's.
        """
        exact = self.solver.exact_solution()
        return exact if exact and exact.ns_limit >= SHORTEST_RUN_NS else None

    def reach(self, t_ns: int, max_steps: int) -> bool:
        """
        Let the solver step up to a simulated time [ns]; return False if that takes more steps.

        Raises IntegrationError if the equations cannot go on; `reached_ns` has where they stop.
        """
        try:
            arrived = self.solver.reach(t_ns - self.start_ns, max_steps)
        finally:
            self.reached_ns = min(self.start_ns + self.solver.reached_ns, self.end_ns)
        if t_ns > self.end_ns:
            raise IntegrationError(f'the closed form ends at t = {self.reached_ns / 10 ** 9:.9g} '
                                   's, where a phase of the motion reaches 2^52 turns')
        return arrived

    def release(self, before_ns: int) -> None:
        """Forget the steps that only states before this simulated time [ns] need."""
        self.solver.release(before_ns - self.start_ns - self.kept_ns)

    def states(self, times: range) -> States:
        """Return the states at ascending simulated times [ns]."""
        return self.solver.states(self._since_start(times))

    def _since_start(self, times: range) -> range:
        return range(times.start - self.start_ns, times.stop - self.start_ns, times.step)

    def orientation_error(self, states: States, times: range) -> NDArray[np.float64]:
        """Return the angles (n,) [rad] to the exact attitudes, NaN where these are not known."""
        if self.exact is self.solver:
            return np.zeros(len(times))
        errors = np.full(len(times), math.nan)
        if self.exact is not None:
            end_ns = min(times.stop, self.start_ns + self.exact.ns_limit + 1)
            held = range(times.start, end_ns, times.step)
            truth = self.exact.states(self._since_start(held)).rows_quaternion
            x, y, z, w = (column[:len(held)] for column in states.rows_quaternion)
            errors[:len(held)] = attitude.angle_between((x, y, z, w), truth)
        return errors

    def exact_axis(self, times_ns: NDArray[np.int64]) -> attitude.Vector:
        """Return the exact axis in the world at times (n,) [ns]; its start where not known."""
        if self.exact is not None:
            return self.exact.states(
                np.minimum(times_ns - self.start_ns, self.exact.ns_limit)).rows_axis
        start, ones = self.start, np.ones(len(times_ns))
        across = math.sin(start.theta)
        return (across * math.cos(start.phi) * ones, across * math.sin(start.phi) * ones,
                math.cos(start.theta) * ones)
