# SPDX-License-Identifier: Apache-2.0
"""The motion of a run: segments of one solution each, joined by commands and by the pivot."""

import math
from bisect import bisect_right
from collections.abc import Callable
from functools import cached_property, reduce
from itertools import pairwise
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.pivot import REST, Kinematics, Piece, kinematics
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.physics.top import Top
from spinning_top_sim.physics.world_states import WorldStates
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import ClosedForm
from spinning_top_sim.solvers.propagator import Motion
from spinning_top_sim.solvers.vertical import (
    AcceleratedMotion,
    Posture,
    Vertical,
    posture_at,
)
from spinning_top_sim.streams.cdr import LAST_STAMP_NS


class Ride(NamedTuple):
    """
    What the pivot of a segment does.

    top : in the gravity of the world
    vertical : of the effective gravity, along which the segment's own frame stands
    piece : of the path of the pivot
    """

    top: Top
    vertical: Vertical
    piece: Piece


class Segment:
    """
    A motion from its start, or from a command, until the next command or change of the pivot's.

    Times are simulated times [ns]; those of `motion` count from `start_ns`.  Where the pivot
    moves, `motion`, `closed_form`, `start` and the constants are about the effective vertical.

    ride : what the pivot does; None while it rests at the origin
    jumps : whether the angular velocity jumps at its start, as by a command
    reached_ns : time up to which the motion needs no further steps
    start, energy, l3, lz : at its start
    chains : whether it can be evaluated together with others
    filter_state : of the low pass of the IMU at the start; None without one, or from t = 0 on
    """

    def __init__(self, motion: Motion, start_ns: int, ride: Ride | None = None, *,
                 jumps: bool) -> None:
        self.motion, self.start_ns, self.ride, self.jumps = motion, start_ns, ride, jumps
        self.start, self.l3, self.lz = motion.start, motion.start.l3, motion.start.lz
        self.chains = False
        self.filter_state: NDArray[np.float64] | None = None

    @cached_property
    def _first(self) -> States:
        return self.motion.states(range(1))

    @cached_property
    def energy(self) -> float:
        motion, start = self.motion, self.start
        if not isinstance(motion, AcceleratedMotion):
            return float(self._first.energy[0])
        top, omega = motion.top, motion.posture(0).transverse       # evaluates no states
        o1, o2 = float(omega.real), float(omega.imag)
        return (0.5 * top.lambda1 * (o1 * o1 + o2 * o2) + 0.5 * start.l3 * start.l3 / top.lambda3
                + top.gravity_torque * math.cos(start.theta))

    @cached_property
    def fastest_rate(self) -> float:
        return integrals.fastest_rate(self.motion.top, self.l3, self.energy)

    @property
    def closed_form(self) -> ClosedForm | None:
        """That of the motion; None where doubles cannot hold it, or not up to the last stamp."""
        form = self.motion.closed_form
        return form if form is not None and form.ns_limit >= LAST_STAMP_NS else None

    @property
    def piece(self) -> Piece:
        """The piece of the path of the pivot."""
        return self.ride.piece if self.ride else REST

    @property
    def end_ns(self) -> int:
        """When the acceleration of the pivot changes [ns]."""
        return self.piece.end_ns

    @property
    def reached_ns(self) -> int:
        return self.start_ns + self.motion.reached_ns

    def reach(self, t_ns: int, max_steps: int | None = None) -> bool:
        """
        Let the motion step up to a time [ns]; return False if that takes more steps.

        Raises IntegrationError if the equations cannot go on; `reached_ns` tells where they stop.
        """
        return self.motion.reach(t_ns - self.start_ns, max_steps)

    def states(self, times: range | NDArray[np.int64]) -> States:
        """Return the states in the world at ascending times [ns]."""
        return self._in_world(self.own_states(times), times)

    def own_states(self, times: range | NDArray[np.int64]) -> States:
        """Return the states about the vertical of the segment at ascending times [ns]."""
        return self.motion.states(self._since_start(times))

    def _in_world(self, states: States, times: range | NDArray[np.int64]) -> States:
        ride = self.ride
        return WorldStates(ride.top, states, ride.vertical.rotation, ride.piece,
                           np.asarray(times)) if ride else states

    def posture(self, t_ns: int) -> Posture:
        """Return attitude and angular velocity in the world at a time [ns]."""
        if isinstance(self.motion, AcceleratedMotion):
            return self.motion.posture(t_ns - self.start_ns)
        return posture_at(self.states(range(t_ns, t_ns + 1)))

    def pivot(self, times_ns: NDArray[np.int64]) -> Kinematics:
        """Return what the pivot does at times (n,) [ns]."""
        return kinematics([self.piece], [len(times_ns)], times_ns)

    def _since_start(self, times: range | NDArray[np.int64]) -> range | NDArray[np.int64]:
        if isinstance(times, np.ndarray):
            return times - self.start_ns
        return range(times.start - self.start_ns, times.stop - self.start_ns, times.step)

    def orientation_error(self, states: States, times: range) -> NDArray[np.float64]:
        """Return the angles (n,) [rad] to the exact attitudes, NaN where these are not known."""
        if self.closed_form is self.motion:
            return np.zeros(len(times))
        if self.closed_form is None:
            return np.full(len(times), math.nan)
        truth = self._in_world(self.closed_form.states(self._since_start(times)), times)
        return attitude.angle_between(states.rows_quaternion, truth.rows_quaternion)

    def exact_point(self, times_ns: NDArray[np.int64], along: float) -> attitude.Vector:
        """Return where a point of the axis is at times (n,) [ns]; the start's where not known."""
        states = (self._first if self.closed_form is None
                  else self.closed_form.states(times_ns - self.start_ns))
        # Of the first state alone, one value for all times.
        x, y, z = (along * np.broadcast_to(part, times_ns.shape)
                   for part in self._in_world(states, times_ns).rows_axis)
        if self.ride:
            a, b, c = self.pivot(times_ns).position
            x, y, z = x + a, y + b, z + c
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
        return self.gone_steps + sum(one.motion.steps for one in self._segments)

    @property
    def evaluations(self) -> int:
        """Evaluations of the right-hand side so far."""
        return self.gone_evaluations + sum(one.motion.evaluations for one in self._segments)

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
            self.gone_steps += one.motion.steps
            self.gone_evaluations += one.motion.evaluations

    def release(self, now_ns: int) -> None:
        """Forget the segments and integration steps that only times before this one [ns] need."""
        present = self._segments[self._number(now_ns)]
        oldest_ns = now_ns - max(self._keep_ns, self.keep_steps_ns)
        self._forget(self._segments[:self._number(oldest_ns - 1)])
        present.motion.release(now_ns - self.keep_steps_ns - present.start_ns)

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
        return kinematics([segment.piece for segment, _ in found],
                          [len(times) for _, times in found], times_ns)

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
