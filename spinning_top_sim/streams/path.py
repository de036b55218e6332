# SPDX-License-Identifier: Apache-2.0
"""The motion of a run: segments of one solution each, joined by commands."""

import math
from contextlib import suppress
from functools import cached_property, reduce
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.physics.top import State
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.propagator import Propagator
from spinning_top_sim.streams.cdr import LAST_STAMP_NS


class Segment:
    """
    A motion from its start, or from a command, until the next command.

    Times are simulated times [ns]; those of `solver` count from `start_ns`.

    reached_ns : time up to which the solver needs no further steps
    energy, l3, lz : constants of the motion, at its start
    """

    def __init__(self, solver: Propagator, start: State, start_ns: int) -> None:
        self.solver, self.start, self.start_ns = solver, start, start_ns
        self.reached_ns = start_ns + solver.reached_ns
        self._first = solver.states(range(1))
        self.energy, self.l3, self.lz = float(self._first.energy[0]), start.l3, start.lz

    @cached_property
    def exact(self) -> ExactSolution | None:
        """The closed form; None where doubles cannot hold it, or not up to the last stamp."""
        if isinstance(self.solver, ExactSolution):
            return self.solver
        with suppress(ValueError):
            exact = ExactSolution(self.solver.top, self.solver.start)
            if exact.ns_limit >= LAST_STAMP_NS:
                return exact
        return None

    def reach(self, t_ns: int, max_steps: int) -> bool:
        """
        Let the solver step up to a time [ns]; return False if that takes more steps.

        Raises IntegrationError if the equations cannot go on; `reached_ns` tells where they stop.
        """
        try:
            return self.solver.reach(t_ns - self.start_ns, max_steps)
        finally:
            self.reached_ns = self.start_ns + self.solver.reached_ns

    def states(self, times: range | NDArray[np.int64]) -> States:
        """Return the states at ascending times [ns]."""
        return self.solver.states(self._since_start(times))

    def _since_start(self, times: range | NDArray[np.int64]) -> range | NDArray[np.int64]:
        if isinstance(times, np.ndarray):
            return times - self.start_ns
        return range(times.start - self.start_ns, times.stop - self.start_ns, times.step)

    def orientation_error(self, states: States, times: range) -> NDArray[np.float64]:
        """Return the angles (n,) [rad] to the exact attitudes, NaN where these are not known."""
        if self.exact is self.solver:
            return np.zeros(len(times))
        if self.exact is None:
            return np.full(len(times), math.nan)
        truth = self.exact.states(self._since_start(times)).rows_quaternion
        return attitude.angle_between(states.rows_quaternion, truth)

    def exact_axis(self, times_ns: NDArray[np.int64]) -> attitude.Vector:
        """Return the exact axis in the world at times (n,) [ns]; its start where not known."""
        if self.exact is not None:
            return self.exact.states(times_ns - self.start_ns).rows_axis
        x, y, z = (np.full(len(times_ns), part[0]) for part in self._first.rows_axis)
        return x, y, z


class Path:
    """
    The segments of a run, in order; the last one is the present motion.

    keep_ns : how long a segment is kept after its end [ns]
    keep_steps_ns : `release` keeps the integration steps of this time before its argument [ns]
    """

    def __init__(self, first: Segment, *, keep_ns: int, keep_steps_ns: int) -> None:
        self._segments = [first]
        self._keep_ns, self.keep_steps_ns = keep_ns, keep_steps_ns

    @property
    def present(self) -> Segment:
        """The segment that goes on now."""
        return self._segments[-1]

    def go_on_with(self, segment: Segment) -> None:
        """End the present segment where another one starts."""
        oldest_ns = segment.start_ns - max(self._keep_ns, self.keep_steps_ns)
        ends = [later.start_ns for later in self._segments[1:]] + [segment.start_ns]
        self._segments = [one for one, end_ns in zip(self._segments, ends, strict=True)
                          if end_ns >= oldest_ns] + [segment]

    def release(self, before_ns: int) -> None:
        """Forget the integration steps that only times before this one [ns] need."""
        self.present.solver.release(before_ns - self.keep_steps_ns - self.present.start_ns)

    def exact_axis(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the exact axis in the world at ascending times (n,) [ns], (n, 3)."""
        # A segment ends with the command that begins the next one, that instant included.
        ends = np.searchsorted(times_ns, [one.start_ns for one in self._segments[1:]], 'right')
        return np.concatenate([
            np.stack(segment.exact_axis(times), axis=-1) for segment, times in zip(
                self._segments, np.split(times_ns, ends), strict=True) if len(times)])

    def pieces(self, begin_ns: int, end_ns: int) -> list[tuple[Segment, int, int]]:
        """Return the segments between two times [ns], and where each begins and ends there."""
        ends = [*(later.start_ns for later in self._segments[1:]), end_ns]
        return [(segment, max(begin_ns, segment.start_ns), until_ns)
                for segment, until_ns in zip(self._segments, ends, strict=True)
                if until_ns > begin_ns]

    def increments(self, begin_ns: int, end_ns: int, point: Point, count: int = 1,
                   step_ns: int = 1) -> Increments:
        """
        Return the increments of a point of the body over intervals of one length.

        The first interval is [begin_ns, end_ns), the next one begins `step_ns` later.  They may
        contain commands only if `count` is 1.  The impulsive torque of a command lets the velocity
        of the point jump; the jump counts toward the interval [begin, end) that contains it.
        """
        pieces: list[Increments] = []
        for before, segment, after in zip([None, *self._segments], self._segments,
                                          [*self._segments[1:], None], strict=False):
            start_ns = segment.start_ns
            if before is not None and start_ns >= begin_ns:
                moment = range(start_ns, start_ns + 1)
                (u1, u2, u3), (v1, v2, v3) = (
                    one.states(moment).velocity(point) for one in (before, segment))
                pieces.append(integrals.impulse((v1 - u1, v2 - u2, v3 - u3)))
            from_ns = max(begin_ns, start_ns)
            until_ns = end_ns if after is None else min(end_ns, after.start_ns)
            if from_ns < until_ns:
                begins = range(from_ns, from_ns + count * step_ns, step_ns)
                pieces += _within(segment, begins, until_ns - from_ns, point)
        return reduce(Increments.then, pieces or [integrals.impulse(3 * (np.zeros(1),))])


def _within(segment: Segment, begins: range, length_ns: int, point: Point) -> list[Increments]:
    """Return the increments over consecutive panels of intervals within a segment."""
    rate = integrals.fastest_rate(segment.solver.top, segment.l3, segment.energy)
    count = integrals.panels(rate, length_ns)
    edges = [length_ns * k // count for k in range(count + 1)]
    return [integrals.increments(
        segment.states, range(begins.start + begin, begins.stop + begin, begins.step),
        end - begin, point, rate) for begin, end in pairwise(edges)]
