# SPDX-License-Identifier: Apache-2.0
"""The lines and arrows that show a top, and its tilt, as numbers."""

import math

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.track import (
    ATTITUDE_TOPICS,
    FORCE,
    QUATERNION,
    RATE_TOPICS,
    RATES,
    Track,
)

TRACE_NS = 10 * NANOSECONDS     # length of the trace of the tip
TRACE_POINTS = 1500             # samples in the trace at most
REACH = 1.6                     # radius of the sphere of the trace / distance of the tip
LONGEST_CHORD = 0.5             # of a step of the trace / its radius; a longer step is a jump
TRACE_STEP_NS, MOST_STEPS = 10_000_000, 4       # interpolation of the trace between two samples
STEPS = 48                      # of a full circle
Stamps = NDArray[np.int64]
Vectors = NDArray[np.float64]
Lines = NDArray[np.float32]     # (n, 2, 3), as viser takes them


def axis_length(track: Track) -> float:
    """Return the signed length of the drawn axis along e3 [m]; it ends outside of most bodies."""
    return REACH * track.shape.tip


def lines_through(points: Vectors) -> Lines:
    """Return the lines (n - 1, 2, 3) from each point (n, 3) to the next."""
    return np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)


def circle(radius: float, theta: float) -> Lines:
    """Return the lines of the circle of all tips with this tilt."""
    phi = np.linspace(0.0, math.tau, 4 * STEPS + 1)
    return lines_through(radius * np.column_stack((
        math.sin(theta) * np.cos(phi), math.sin(theta) * np.sin(phi),
        np.full_like(phi, math.cos(theta)))))


def trace(track: Track, stamp_ns: int) -> Lines:
    """Return the lines along which the tip has moved, up to a stamp, from where the pivot is."""
    stamps_ns, axis, connected = trace_points(track, stamp_ns - TRACE_NS, stamp_ns)
    moved = track.places(stamps_ns) - track.places(np.array([stamp_ns]))
    return lines_through(axis_length(track) * axis + moved)[connected]


def trace_points(track: Track, begin_ns: int, end_ns: int,
                 ) -> tuple[Stamps, Vectors, NDArray[np.bool_]]:
    """
    Return stamps (n,) [ns] and the axis (n, 3) between two stamps, and which steps are no jumps.

    The third array, (n - 1,), is about the steps from one point to the next.  If samples are far
    apart, points between them are those of the cubic Hermite spline.
    """
    stamps_ns, rows = track.attitudes.part(begin_ns, end_ns).thinned(TRACE_POINTS)
    axis = axis_of(rows)
    steps = np.diff(axis, axis=0)
    longest_ns = int(np.max(np.diff(stamps_ns), initial=0))
    count = min(-(-longest_ns // TRACE_STEP_NS), MOST_STEPS)
    if count < 2 or np.isnan(rows[:, RATES]).any():
        return stamps_ns, axis, np.linalg.norm(steps, axis=1) < LONGEST_CHORD
    velocity = np.cross(in_world(rows[:, QUATERNION].T, rows[:, RATES].T), axis, axisa=0)
    span = 1e-9 * np.diff(stamps_ns)[:, np.newaxis]
    before, after = span * velocity[:-1], span * velocity[1:]
    connected = np.linalg.norm(steps - 0.5 * (before + after), axis=1) < LONGEST_CHORD
    s = np.arange(count)[:, np.newaxis, np.newaxis] / count
    between = (axis[:-1] + s * s * (3.0 - 2.0 * s) * steps
               + s * (1.0 - s) * ((1.0 - s) * before - s * after))
    fine_ns = stamps_ns[:-1] + (np.arange(count)[:, np.newaxis] * np.diff(stamps_ns)) // count
    return (np.append(fine_ns.T.ravel(), stamps_ns[-1]),
            np.vstack((between.transpose(1, 0, 2).reshape(-1, 3), axis[-1:])),
            np.repeat(connected, count))


def axis_of(rows: Vectors) -> Vectors:
    """Return the axis in the world (n, 3) of rows of a track, or of one."""
    x, y, z, w = np.atleast_2d(rows)[:, QUATERNION].T
    return np.column_stack(attitude.axis_in_world((x, y, z, w)))


def tilt(axis: Vectors) -> Vectors:
    """Return theta (n,) [deg] of an axis (n, 3)."""
    return np.degrees(np.arctan2(np.hypot(axis[:, 0], axis[:, 1]), axis[:, 2]))


def in_world(quaternion: Vectors, vector: Vectors) -> Vectors:
    """Return the components in the world of a vector in the body."""
    return np.array(attitude.rotated(tuple(quaternion), tuple(vector)))


def _momentum(track: Track, row: Vectors, stamp_ns: int) -> Vectors:
    moments = np.array([track.top.lambda1, track.top.lambda1, track.top.lambda3])
    return in_world(row[QUATERNION], moments * row[RATES]) / _usual_momentum(track, stamp_ns)


def _velocity(track: Track, row: Vectors, stamp_ns: int) -> Vectors:
    least = min(track.top.lambda1, track.top.lambda3)
    return least / _usual_momentum(track, stamp_ns) * in_world(row[QUATERNION], row[RATES])


def _usual_momentum(track: Track, stamp_ns: int) -> float:
    motion = track.motion_at(stamp_ns)
    present = max(abs(motion.l3), abs(motion.lz)) if motion else 0.0
    return max(natural_momentum(track.top), present, 1e-30)


def _torque(track: Track, row: Vectors, _: int) -> Vectors:
    ((x, y, _z),) = axis_of(row)        # r x m g: along the line of nodes
    return np.sign(track.top.gravity_torque) * np.array((-y, x, 0.0))


def _force(track: Track, row: Vectors, _: int) -> Vectors:
    return in_world(row[QUATERNION], row[FORCE]) / (abs(track.top.gravity) or 1.0)


# Of each arrow the colour, the topics of its samples, and its vector in the world.  The length of
# the axis, here 1, stands for the usual angular momentum or velocity, for 1 g, and for the torque
# of gravity when the axis is horizontal.
ARROWS = {
    'angular momentum': ((20, 120, 70), RATE_TOPICS, _momentum),
    'angular velocity': ((196, 50, 150), RATE_TOPICS, _velocity),
    'torque': ((20, 150, 180), ATTITUDE_TOPICS, _torque),
    'specific force': ((230, 130, 20), ('ground_truth/imu',), _force)}


def arrow(track: Track, name: str, stamp_ns: int) -> Vectors | None:
    """Return one of ARROWS as a vector (3,) in the world for drawing; None without a sample."""
    _, topics, vector = ARROWS[name]
    sample = track.first_of(topics).at(stamp_ns)
    if sample is None or not track.has_body:
        return None
    return abs(axis_length(track)) * vector(track, sample[1], stamp_ns)
