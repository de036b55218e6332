# SPDX-License-Identifier: Apache-2.0
"""
The path of a moving pivot: pieces of constant acceleration, without any rounding that adds up.

Boundaries are integer nanoseconds, and accelerations, velocities and positions at the boundaries
are fractions.  So a closed path that is repeated returns to its start exactly, however often.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.top import shown
from spinning_top_sim.times import NANOSECONDS, NEVER_NS

# x, y, z in the world; doubles are fractions, too.
Fractions = tuple[Fraction, Fraction, Fraction]
Given = Sequence[float | Fraction]
ZERO: Fractions = (Fraction(0), Fraction(0), Fraction(0))
SHORTEST_S = 1e-3               # mean time of the pieces of a path that is repeated
ROUNDING = 1e-12                # of velocities, relative


class Kinematics(NamedTuple):
    """What a pivot does at n times: (3, n) or (3, 1), in the world [m], [m/s], [m/s^2]."""

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]


AT_REST = Kinematics(*np.zeros((3, 3, 1)))


class Ride(NamedTuple):
    """What a pivot does while its acceleration is constant."""

    start_ns: int
    end_ns: int                         # the first time after it; NEVER_NS if it never ends
    acceleration: Fractions             # in the world [m/s^2]
    at_start: Kinematics


REST = Ride(0, NEVER_NS, ZERO, AT_REST)


def kinematics(ride: Ride, times_ns: NDArray[np.int64]) -> Kinematics:
    """Return what the pivot does at times (n,) [ns] of this ride."""
    start, velocity, acceleration = ride.at_start
    t = (times_ns - ride.start_ns) * 1e-9
    return Kinematics((0.5 * t * acceleration + velocity) * t + start,
                      velocity + t * acceleration, np.repeat(acceleration, len(t), axis=1))


class PivotPath:
    """
    The path of a pivot that accelerates piecewise uniformly, and then keeps its velocity.

    pieces : durations > 0 [ns], and accelerations (3,) [m/s^2]
    repeat : whether they are repeated for ever.  Then they must leave the velocity as it was, but
        for rounding, and last SHORTEST_S each on average
    position, velocity : (3,) at the start, in the world [m], [m/s]

    Raises ValueError for a path that cannot be repeated, and for a piece of 9e9 s or more.
    """

    def __init__(self, pieces: Iterable[tuple[int, Given]], *, repeat: bool = False,
                 position: Given = ZERO, velocity: Given = ZERO, start_ns: int = 0) -> None:
        self.start_ns = start_ns
        self._starts, self._accelerations = [0], []
        places, velocities = [_fractions(position)], [_fractions(velocity)]
        for duration_ns, given in pieces:
            t, v = Fraction(duration_ns, NANOSECONDS), velocities[-1]
            acceleration = _fractions(given)
            places.append(_sum((1, places[-1]), (t, v), (t * t / 2, acceleration)))
            velocities.append(_sum((1, v), (t, acceleration)))
            self._starts.append(self._starts[-1] + duration_ns)
            self._accelerations.append(acceleration)
        self._cycle_ns, self._per_cycle = 0, np.zeros((3, 3, 1))
        if repeat and any(any(one) for one in self._accelerations):
            change = _sum((1, velocities[-1]), (-1, velocities[0]))
            if _length(change) > ROUNDING * max(map(_length, velocities)):
                raise ValueError(f'a repeated path changes the velocity by {_length(change):g} '
                                 'm/s: it must end with the velocity that it starts with')
            self._cycle_ns = self._starts.pop()
            if self._cycle_ns < len(self._starts) * SHORTEST_S * NANOSECONDS:
                raise ValueError(f'a repeated path has {len(self._starts)} pieces in '
                                 f'{self._cycle_ns / NANOSECONDS!r} s: must last at least '
                                 f'{SHORTEST_S:g} s for each')
            self._per_cycle[0] = _doubles([_sum((1, places.pop()), (-1, places[0]))])
            velocities.pop()
        else:
            self._accelerations.append(ZERO)
        # Of each ride the `Kinematics` at its start
        self._at_starts = np.stack([*map(_doubles, (places, velocities, self._accelerations))], 1)

    @classmethod
    def through(cls, waypoints: Sequence[Given], *, speed: float, acceleration: float,
                repeat: bool = False) -> PivotPath:
        """
        Return the path along straight lines; on each the pivot accelerates, cruises and brakes.

        waypoints : two or more (3,) [m]; points that repeat their predecessor are passed over
        speed, acceleration : the greatest, > 0 [m/s], [m/s^2]; slightly smaller where a duration
            is rounded up to nanoseconds
        repeat : whether the path leads from the last waypoint to the first, and goes on for ever
        """
        points = [_fractions(point) for point in waypoints]
        if len(set(points)) < 2:
            raise ValueError(f'waypoints = {shown(waypoints)}: must be two different points or '
                             'more')
        pieces: list[tuple[int, Given]] = []
        ends = points[1:] + points[:1] if repeat else points[1:]
        for begin, end in zip(points, ends, strict=False):
            if begin != end:
                pieces += _leg(_sum((1, end), (-1, begin)), speed, acceleration)
        return cls(pieces, repeat=repeat, position=points[0])

    @classmethod
    def to_velocity(cls, target: Given, *, most_acceleration: float, position: Given = ZERO,
                    velocity: Given = ZERO, start_ns: int = 0,
                    stop_ns: int = NEVER_NS) -> PivotPath:
        """
        Return the path that changes the velocity into `target` uniformly, keeps it, and stops.

        most_acceleration : > 0 [m/s^2]; the acceleration is slightly smaller: whole nanoseconds
        stop_ns : when the pivot begins to brake, even if it has not reached the target [ns]
        """
        goal, now = _fractions(target), _fractions(velocity)
        pieces = list(_ramp(now, goal, most_acceleration))
        left_ns = stop_ns - start_ns - sum(duration_ns for duration_ns, _ in pieces)
        if stop_ns < NEVER_NS:
            if left_ns > 0:
                pieces.append((left_ns, ZERO))
            elif left_ns < 0:
                (duration_ns, acceleration), = pieces
                pieces = [(duration_ns + left_ns, acceleration)]
                goal = _sum((1, now), (Fraction(duration_ns + left_ns, NANOSECONDS),
                                       acceleration))
            pieces += _ramp(goal, ZERO, most_acceleration)
        return cls(pieces, position=position, velocity=velocity, start_ns=start_ns)

    def ride(self, t_ns: int) -> Ride:
        """Return the ride that a time [ns] from the start on belongs to."""
        since_ns = t_ns - self.start_ns
        cycle, phase = divmod(since_ns, self._cycle_ns) if self._cycle_ns else (0, since_ns)
        k = bisect_right(self._starts, phase) - 1
        if k < 0:
            raise ValueError(f't = {t_ns} ns: must not be before the start of the path at '
                             f'{self.start_ns} ns')
        offset = self.start_ns + cycle * self._cycle_ns
        end = (self._starts[k + 1] if k + 1 < len(self._starts)
               else self._cycle_ns or NEVER_NS - offset)
        return Ride(offset + self._starts[k], offset + end, self._accelerations[k],
                    Kinematics(*(self._at_starts[k] + cycle * self._per_cycle)))

    def lasting(self, t_ns: int) -> Ride:
        """Return the ride from a time [ns] on with those that have the same acceleration."""
        ride = self.ride(t_ns)
        while ride.end_ns < NEVER_NS and (
                after := self.ride(ride.end_ns)).acceleration == ride.acceleration:
            ride = ride._replace(end_ns=after.end_ns)
        return ride


def _ramp(begin: Fractions, end: Fractions,
          most_acceleration: float) -> Iterator[tuple[int, Fractions]]:
    """Yield the piece that leads from one velocity to another, none if they are equal."""
    change = _sum((1, end), (-1, begin))
    if any(change):
        duration_ns = _whole_ns(_length(change) / most_acceleration)
        yield duration_ns, _sum((Fraction(NANOSECONDS, duration_ns), change))


def _leg(way: Fractions, speed: float, acceleration: float) -> list[tuple[int, Given]]:
    """Return the pieces that lead a pivot at rest to rest again, displaced by `way`."""
    length = _length(way)
    ramp = min(speed / acceleration, math.sqrt(length / acceleration))
    ramp_ns = _whole_ns(ramp)
    cruise = length / speed - ramp
    cruise_ns = _whole_ns(cruise) if cruise > 0.0 else 0
    # The distance is acceleration * ramp * (ramp + cruise).
    scale = Fraction(NANOSECONDS ** 2, ramp_ns * (ramp_ns + cruise_ns))
    pieces: list[tuple[int, Given]] = [(ramp_ns, _sum((scale, way)))]
    if cruise_ns:
        pieces.append((cruise_ns, ZERO))
    return [*pieces, (ramp_ns, _sum((-scale, way)))]


def _whole_ns(seconds: float) -> int:
    """Return a duration in nanoseconds, rounded up to 1 or more; at most the range of int64."""
    if not seconds < 9e9:
        raise ValueError(f'a piece of the path lasts {seconds!r} s: must be less than 9e9 s')
    return max(1, math.ceil(seconds * 1e9))


def _length(v: Fractions) -> float:
    return math.hypot(*(float(x) for x in v))


def _sum(*terms: tuple[int | Fraction, Fractions]) -> Fractions:
    """Return the sum of factor * vector."""
    x, y, z = (sum((factor * v[k] for factor, v in terms), Fraction(0)) for k in range(3))
    return x, y, z


def _fractions(given: Given) -> Fractions:
    x, y, z = (Fraction(value) for value in given)
    return x, y, z


def _doubles(vectors: Sequence[Fractions]) -> NDArray[np.float64]:
    """Return vectors as columns, (n, 3, 1)."""
    return np.array([[float(x) for x in v] for v in vectors]).reshape(-1, 3, 1)
