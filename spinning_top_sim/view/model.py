# SPDX-License-Identifier: Apache-2.0
"""What is drawn of a top: shapes, lines, arrows and curves as numbers, in metres and seconds."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.view.track import (
    ENERGY_DRIFT,
    ORIENTATION_ERROR,
    PRECESSION,
    Columns,
    Rows,
    Track,
)

TRACE_NS = 10 * NANOSECONDS     # so far back goes the trace of the tip
TRACE_POINTS = 1500             # of it at most
REACH = 1.6                     # radius of the sphere of the trace, by the tip's distance
LONGEST_CHORD = 0.5             # of the trace, by its radius: what is longer is a jump
TRACE_STEP_NS, MOST_STEPS = 10_000_000, 4       # of the trace between two samples
CURVE_POINTS = 400              # of a curve at most
STEPS = 48                      # of a full circle
ARROWS = ('angular momentum', 'angular velocity', 'specific force')
CURVES = ('θ [deg]', "φ' [rad/s]", 'log10 |energy drift|', 'log10 orientation error [rad]')
LEAST = 1e-17                   # whose logarithm stands for 0
Floats = NDArray[np.float32]


def sector(radius: float, low: float, high: float, begin: float,
           end: float) -> tuple[Floats, NDArray[np.uint32]]:
    """
    Return vertices (n, 3) and triangles (m, 3) of a sector of a cylinder about the z axis.

    low, high : its ends along z;  begin, end : angles of its sides [rad], a turn apart for a
    whole cylinder.  The triangles are anticlockwise when seen from outside.
    """
    count = max(2, math.ceil(STEPS * (end - begin) / math.tau)) + 1
    angles = np.linspace(begin, end, count)
    rim = radius * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    rings = [np.column_stack((rim, np.full(count, z))) for z in (low, high)]
    vertices = np.vstack((*rings, (0.0, 0.0, low), (0.0, 0.0, high)))
    a = np.arange(count - 1)
    b, c, d = a + 1, a + count, a + count + 1       # the next one, and both on the upper ring
    bottom, top = np.full_like(a, 2 * count), np.full_like(a, 2 * count + 1)
    faces: list[tuple[ArrayLike, ArrayLike, ArrayLike]] = [
        (a, b, d), (a, d, c), (b, a, bottom), (c, d, top)]
    if end - begin < math.tau:          # the two plane sides
        last, low_centre, high_centre = count - 1, 2 * count, 2 * count + 1
        faces += [(low_centre, 0, count), (low_centre, count, high_centre),
                  (last, low_centre, high_centre), (last, high_centre, last + count)]
    return (vertices.astype(np.float32),
            np.vstack([np.column_stack(face) for face in faces]).astype(np.uint32))


def reach(track: Track) -> float:
    """Return how far out along e3 the axis is drawn, signed: outside of most bodies [m]."""
    return REACH * track.shape.tip


def segments(points: Rows) -> Floats:
    """Return the lines (n - 1, 2, 3) from each point (n, 3) to the next."""
    return np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)


def circle(radius: float, theta: float) -> Floats:
    """Return the lines of the circle on which a tip with this tilt moves."""
    phi = np.linspace(0.0, math.tau, 4 * STEPS + 1)
    return segments(radius * np.column_stack((
        math.sin(theta) * np.cos(phi), math.sin(theta) * np.sin(phi),
        np.full_like(phi, math.cos(theta)))))


def meridians(radius: float) -> Floats:
    """Return the lines of the sphere of the tip: four great circles and the equator."""
    angle = np.linspace(0.0, math.tau, 2 * STEPS + 1)
    x, z, zero = radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle)
    rings = [np.column_stack((x, z, zero))]
    for turn in np.arange(4) * math.pi / 4.0:
        rings.append(np.column_stack((x * math.cos(turn), x * math.sin(turn), z)))
    return np.concatenate([segments(ring) for ring in rings])


def trace(track: Track, stamp_ns: int) -> Floats:
    """Return the lines (n, 2, 3) along which the tip has come, up to a stamp."""
    _, axis, joined = path(track, stamp_ns - TRACE_NS, stamp_ns)
    return segments(reach(track) * axis)[joined]


def path(track: Track, begin_ns: int, end_ns: int
         ) -> tuple[NDArray[np.int64], Rows, NDArray[np.bool_]]:
    """
    Return stamps (n,) [ns] and the axis (n, 3) between two stamps, and where it has no jump.

    Samples that are far apart are joined by the cubic of their velocities (Hermite's), with its
    error of the fourth order.  The third array, (n - 1,), belongs to the steps between points.
    """
    stamps_ns, rows = track.attitudes.part(begin_ns, end_ns)
    stride = _stride(len(rows), TRACE_POINTS)
    last = (len(rows) - 1) % stride if len(rows) else 0         # with the last sample
    stamps_ns, rows = stamps_ns[last::stride], rows[last::stride]
    axis = np.column_stack(attitude.axis_in_world(_columns(rows)))
    steps = np.diff(axis, axis=0)
    longest_ns = int(np.max(np.diff(stamps_ns), initial=0))
    count = min(-(-longest_ns // TRACE_STEP_NS), MOST_STEPS)
    if count < 2 or rows.shape[1] < 7:          # near each other, or without a velocity
        return stamps_ns, axis, np.linalg.norm(steps, axis=1) < LONGEST_CHORD
    velocity = np.cross(in_world(rows[:, :4].T, rows[:, 4:7].T), axis, axisa=0)
    span = 1e-9 * np.diff(stamps_ns)[:, np.newaxis]
    before, after = span * velocity[:-1], span * velocity[1:]
    joined = np.linalg.norm(steps - 0.5 * (before + after), axis=1) < LONGEST_CHORD
    s = np.arange(count)[:, np.newaxis, np.newaxis] / count
    between = (axis[:-1] + s * s * (3.0 - 2.0 * s) * steps
               + s * (1.0 - s) * ((1.0 - s) * before - s * after))
    fine_ns = stamps_ns[:-1] + (np.arange(count)[:, np.newaxis] * np.diff(stamps_ns)) // count
    return (np.append(fine_ns.T.ravel(), stamps_ns[-1]),
            np.vstack((between.transpose(1, 0, 2).reshape(-1, 3), axis[-1:])),
            np.repeat(joined, count))


def _stride(count: int, most: int) -> int:
    return max(1, -(-count // most))


def _columns(rows: Rows) -> attitude.Quaternion:
    x, y, z, w = rows[:, :4].T
    return x, y, z, w


def in_world(quaternion: Rows, vector: Rows) -> Rows:
    """Return the components in the world of a vector given in the body, as an array."""
    return np.array(attitude.in_world(tuple(quaternion), tuple(vector)))


def arrow(track: Track, name: str, stamp_ns: int) -> Rows | None:
    """
    Return the drawn vector (3,) in the world; None where no sample has it.

    Angular momentum and velocity are as long as the axis where they are those of the spin, the
    specific force where it is 1 g.
    """
    columns = track.columns['ground_truth/imu'] if name == 'specific force' else track.rates
    sample = columns.at(stamp_ns)
    if sample is None:
        return None
    top, row, length = track.top, sample[1], abs(reach(track))
    if name == 'specific force':
        return length / (abs(top.gravity) or 1.0) * in_world(row[:4], row[7:10])
    omega = row[4:7]
    momentum = np.array([top.lambda1, top.lambda1, top.lambda3]) * omega
    motion = track.motion_at(stamp_ns)
    usual = max(math.sqrt(top.lambda1 * abs(top.gravity_torque)),
                *(abs(x) for x in ((motion.l3, motion.lz) if motion else (0.0,))), 1e-30)
    if name == 'angular velocity':
        return length * min(top.lambda1, top.lambda3) / usual * in_world(row[:4], omega)
    return length / usual * in_world(row[:4], momentum)


def curve(track: Track, name: str, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Rows]:
    """Return stamps (n,) [ns] and values (n,) of one of CURVES between two stamps."""
    if name == CURVES[0]:
        stamps_ns, axis, _ = path(track, begin_ns, end_ns)
        x, y, z = axis.T
        thin = slice(None, None, _stride(len(axis), CURVE_POINTS))
        return stamps_ns[thin], np.degrees(np.arctan2(np.hypot(x, y), z))[thin]
    if name == CURVES[1]:
        stamps_ns, rows = _thin(track.rates, begin_ns, end_ns)
        return stamps_ns, rows[:, PRECESSION]
    stamps_ns, rows = _thin(track.columns['~/invariants'], begin_ns, end_ns)
    values = rows[:, ENERGY_DRIFT if name == CURVES[2] else ORIENTATION_ERROR]
    return stamps_ns, np.log10(np.maximum(np.abs(values), LEAST))


def _thin(columns: Columns, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Rows]:
    stamps_ns, rows = columns.part(begin_ns, end_ns)
    stride = _stride(len(rows), CURVE_POINTS)
    return stamps_ns[::stride], rows[::stride]


def angle_apart(one: Rows, other: Rows) -> float:
    """Return the angle between two attitudes (4,) [rad]."""
    return float(attitude.angle_between(tuple(one[:4]), tuple(other[:4])))
