# SPDX-License-Identifier: Apache-2.0
"""The motion of a run: segments of one solution each, joined by commands and by the pivot."""

import math
from bisect import bisect_right
from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.pivot import REST, Kinematics, Piece, kinematics
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.handover import Piece as SolvedPiece
from spinning_top_sim.solvers.vertical import Posture


class Segment:
    """
    A piece of the run, from its start or from a command until the next command or change.

    jumps : whether the angular velocity jumps at its start, as by a command
    filter_state : of the low pass of the IMU at the start; None without one, or from t = 0 on
    """

    chains = False

    def __init__(self, solution: SolvedPiece, *, jumps: bool) -> None:
        self.solution, self.start_ns, self.jumps = solution, solution.start_ns, jumps
        self.motion: Any = solution._motion
        self.start, self.l3, self.lz = self.motion.start, solution.l3, solution.lz
        self.energy, self.fastest_rate = solution.energy, solution.fastest_rate
        self.filter_state: NDArray[np.float64] | None = None

    @property
    def ride(self) -> Piece | None:
        return None if self.solution.ride is REST else self.solution.ride

    @property
    def piece(self) -> Piece:
        return self.solution.ride

    @property
    def closed_form(self) -> Any:
        exact = self.solution._exact
        return exact and exact[0]

    @property
    def end_ns(self) -> int:
        """When the acceleration of the pivot changes [ns]."""
        return self.piece.end_ns

    @property
    def reached_ns(self) -> int:
        return self.start_ns + getattr(self.motion, 'reached_ns', 2 ** 62 - self.start_ns)

    def reach(self, t_ns: int, max_steps: int | None = None) -> bool:
        if t_ns >= self.start_ns:
            self.solution.states(range(t_ns, t_ns + 1))
        return True

    def states(self, times: range | NDArray[np.int64]) -> States:
        """Return the states in the world at ascending times [ns]."""
        return self.solution.states(times)

    own_states = states

    def posture(self, t_ns: int) -> Posture:
        return self.solution.posture(t_ns)

    def pivot(self, times_ns: NDArray[np.int64]) -> Kinematics:
        """Return what the pivot does at times (n,) [ns]."""
        return kinematics(self.piece, times_ns)

    def orientation_error(self, states: States, times: range) -> NDArray[np.float64]:
        """Return the angles (n,) [rad] to the exact attitudes, NaN where these are not known."""
        truth = self.solution.truth(times)
        if truth is None:
            return np.full(len(times), math.nan)
        return attitude.angle_between(states.rows_quaternion, truth.rows_quaternion)

    def exact_point(self, times_ns: NDArray[np.int64], along: float) -> attitude.Vector:
        """Return where a point of the axis is at times (n,) [ns]; the start's where not known."""
        truth = self.solution.truth(times_ns)
        if truth is None:
            truth = self.solution.states(range(self.start_ns, self.start_ns + 1))
        x, y, z = (np.broadcast_to(part, times_ns.shape)
                   for part in truth.position((0.0, 0.0, along)))
        return x, y, z


class Path:
    """
    The segments of a run, in order.

    follow : returns the segment behind the end of one; raises ValueError if there is none
    carry : lets a segment begin with what the one before it leaves
    keep_ns : how long a segment is kept after its end [ns]
    keep_steps_ns : `release` keeps the integration steps of this time before its argument [ns]
    """

    def __init__(self, first: Segment, follow: Callable[[Segment], Segment],
                 carry: Callable[[Segment, Segment], None], *, keep_ns: int,
                 keep_steps_ns: int) -> None:
        self._segments, self._follow, self._carry = [first], follow, carry
        self.gone_steps = self.gone_evaluations = 0         # of segments that are forgotten
        self._keep_ns, self.keep_steps_ns = keep_ns, keep_steps_ns

    @property
    def steps(self) -> int:
        """Integration steps taken so far."""
        return self.gone_steps + sum(one.solution.steps for one in self._segments)

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self.gone_evaluations + sum(one.solution.evaluations for one in self._segments)

    def after(self, t_ns: int) -> Segment:
        """
        Return the segment in which the motion goes on after a time [ns].

        Raises IntegrationError where it does not.
        """
        while self._segments[-1].end_ns <= t_ns:
            try:
                self._append(self._follow(self._segments[-1]))
            except ValueError as error:
                raise IntegrationError(str(error)) from error
        return self._segments[self._number(t_ns)]

    def _number(self, t_ns: int) -> int:
        return max(bisect_right(self._segments, t_ns, key=attrgetter('start_ns')) - 1, 0)

    def go_on_with(self, segment: Segment) -> None:
        """Go on with another segment from its start; what was to come from there is dropped."""
        self.end_after(segment.start_ns)
        self._append(segment)
        self.release(segment.start_ns)

    def end_after(self, t_ns: int) -> bool:
        """Drop the segments that start later than a time [ns]; return whether there were any."""
        late = [one for one in self._segments if one.start_ns > t_ns]
        self._forget(late)
        return bool(late)

    def _append(self, segment: Segment) -> None:
        self._carry(self._segments[-1], segment)
        self._segments.append(segment)

    def _forget(self, segments: list[Segment]) -> None:
        for one in segments:
            self._segments.remove(one)
            self.gone_steps += one.solution.steps
            self.gone_evaluations += one.solution.evaluations

    def release(self, now_ns: int) -> None:
        """Forget the segments and integration steps that only times before this one [ns] need."""
        present = self._segments[self._number(now_ns)]
        oldest_ns = now_ns - max(self._keep_ns, self.keep_steps_ns)
        self._forget(self._segments[:self._number(oldest_ns - 1)])
        present.solution.forget(now_ns - self.keep_steps_ns)

    def exact_points(self, times_ns: NDArray[np.int64], along: float) -> NDArray[np.float64]:
        """Return where a point of the axis is at ascending times (n,) [ns], (n, 3)."""
        return np.concatenate([np.stack(segment.exact_point(times, along), axis=-1)
                               for segment, times in self._times_of_segments(times_ns)])

    def _times_of_segments(self, times_ns: NDArray[np.int64],
                           ) -> list[tuple[Segment, NDArray[np.int64]]]:
        """Return the segments at ascending times (n,) [ns], with those of each."""
        # A segment ends with the command that begins the next one, that instant included.
        ends = np.searchsorted(times_ns, [one.start_ns for one in self._segments[1:]], 'right')
        return [(segment, times) for segment, times in zip(
            self._segments, np.split(times_ns, ends), strict=True) if len(times)]

    def pivot(self, times_ns: NDArray[np.int64]) -> Kinematics:
        """Return what the pivot does at ascending times (n,) [ns], those before now too."""
        found = self._times_of_segments(times_ns) or [(self._segments[-1], times_ns)]
        return Kinematics(*(np.concatenate(rows, axis=1) for rows in zip(
            *(kinematics(segment.piece, times) for segment, times in found), strict=True)))

    def increments(self, begin_ns: int, end_ns: int, point: Point, count: int = 1,
                   step_ns: int = 1) -> Increments:
        """
        Return the increments of a point of the body over intervals of one length.

        The first interval is [begin_ns, end_ns), the next one begins `step_ns` later.  They may
        contain a jump, or reach into another segment, only if `count` is 1.  The impulsive torque
        of a command lets the velocity of the point jump; the jump counts toward the interval
        [begin, end) that contains it.
        """
        pieces: list[Increments] = []
        for before, segment, after in zip([None, *self._segments], self._segments,
                                          [*self._segments[1:], None], strict=False):
            start_ns = segment.start_ns
            if before is not None and segment.jumps and begin_ns <= start_ns < end_ns:
                moment = range(start_ns, start_ns + 1)
                (u1, u2, u3), (v1, v2, v3) = (
                    one.own_states(moment).velocity(point) for one in (before, segment))
                pieces.append(integrals.impulse((v1 - u1, v2 - u2, v3 - u3)))
            from_ns = max(begin_ns, start_ns)
            until_ns = end_ns if after is None else min(end_ns, after.start_ns)
            if from_ns < until_ns:
                begins = range(from_ns, from_ns + count * step_ns, step_ns)
                pieces += _within(segment, begins, until_ns - from_ns, point)
        return reduce(Increments.then, pieces or [integrals.impulse(3 * (np.zeros(1),))])


def _within(segment: Segment, begins: range, length_ns: int, point: Point) -> list[Increments]:
    """Return the increments over consecutive panels of intervals within a segment."""
    count = integrals.panels(segment.fastest_rate, length_ns)
    edges = [length_ns * k // count for k in range(count + 1)]
    return [integrals.increments(
        segment.own_states, range(begins.start + begin, begins.stop + begin, begins.step),
        end - begin, point, segment.fastest_rate) for begin, end in pairwise(edges)]
