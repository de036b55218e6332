# SPDX-License-Identifier: Apache-2.0
"""
The messages that the simulator sends, as templates.

Fields stand in the order of the installed .msg definitions (ROS 2 Jazzy, common_interfaces 5.3);
a test compares every template with what rclpy serializes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from spinning_top_sim.streams.cdr import CdrWriter, Template

UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
EXACT = 9 * (0.0,)
CYLINDER, LINE_STRIP, LINE_LIST = 3, 4, 5       # visualization_msgs/Marker
BODY_COLOR = (0.20, 0.40, 0.70, 1.0)            # red, green, blue, alpha
AXIS_COLOR = (0.95, 0.75, 0.20, 1.0)
TRACE_COLOR = (0.90, 0.30, 0.20, 1.0)


def diagonal(variance: float) -> tuple[float, ...]:
    """Return a row-major 3 x 3 covariance."""
    return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)


def _header(frame_id: str) -> tuple[CdrWriter, int]:
    writer = CdrWriter()
    stamp_at = writer.stamp()
    writer.string(frame_id)
    return writer, stamp_at


def pose_stamped(frame_id: str) -> Template:
    """geometry_msgs/PoseStamped at the origin; fields: orientation x, y, z, w."""
    writer, stamp_at = _header(frame_id)
    writer.doubles(0.0, 0.0, 0.0)
    return Template(writer, [stamp_at], [(writer.doubles(0.0, 0.0, 0.0, 1.0), 4)])


def joint_state(names: Sequence[str]) -> Template:
    """sensor_msgs/JointState without effort; fields: positions, velocities."""
    writer, stamp_at = _header('')
    writer.strings(names)
    zeros = len(names) * (0.0,)
    fields = [(writer.double_sequence(zeros), len(names)) for _ in ('position', 'velocity')]
    writer.double_sequence(())
    return Template(writer, [stamp_at], fields)


def imu(frame_id: str, orientation_covariance: Sequence[float],
        angular_velocity_covariance: Sequence[float],
        linear_acceleration_covariance: Sequence[float]) -> Template:
    """sensor_msgs/Imu; fields: orientation x, y, z, w, angular velocity, linear acceleration."""
    writer, stamp_at = _header(frame_id)
    fields = [(writer.doubles(0.0, 0.0, 0.0, 1.0), 4)]
    writer.doubles(*orientation_covariance)
    fields.append((writer.doubles(0.0, 0.0, 0.0), 3))
    writer.doubles(*angular_velocity_covariance)
    fields.append((writer.doubles(0.0, 0.0, 0.0), 3))
    writer.doubles(*linear_acceleration_covariance)
    return Template(writer, [stamp_at], fields)


def odometry(frame_id: str, child_frame_id: str) -> Template:
    """nav_msgs/Odometry of a fixed point, covariances zero; fields: orientation, body rates."""
    writer, stamp_at = _header(frame_id)
    writer.string(child_frame_id)
    writer.doubles(0.0, 0.0, 0.0)
    fields = [(writer.doubles(0.0, 0.0, 0.0, 1.0), 4)]
    writer.doubles(*(36 * (0.0,)))
    writer.doubles(0.0, 0.0, 0.0)                           # linear velocity: the pivot is fixed
    fields.append((writer.doubles(0.0, 0.0, 0.0), 3))
    writer.doubles(*(36 * (0.0,)))
    return Template(writer, [stamp_at], fields)


def float64_multi_array(labels: Sequence[str]) -> Template:
    """std_msgs/Float64MultiArray, one dimension labelled with its columns; fields: the data."""
    writer = CdrWriter()
    writer.append('I', 1)
    writer.string(','.join(labels))
    writer.append('I', len(labels))                         # size
    writer.append('I', len(labels))                         # stride
    writer.append('I', 0)                                   # data offset
    return Template(writer, [],
                    [(writer.double_sequence(len(labels) * (0.0,)), len(labels))])


def clock() -> Template:
    """rosgraph_msgs/Clock; no fields."""
    writer = CdrWriter()
    return Template(writer, [writer.stamp()], [])


def markers(frame_id: str, size: Sequence[float], lines: Sequence[float], line_width: float,
            trace_points: int) -> Template:
    """
    visualization_msgs/MarkerArray: a cylinder, lines on it, and the trace if it has points.

    Fields: position and orientation of the cylinder, orientation of the lines, the trace's points.

    size : diameters and height of the cylinder [m]
    lines : x, y and z of begin and end of each line, in the body frame [m]
    line_width : [m]; the trace is half as wide
    trace_points : how many, 0 for no trace
    """
    writer = CdrWriter()
    writer.append('I', 3 if trace_points else 2)
    body = _marker(writer, frame_id, 'body', CYLINDER, size, BODY_COLOR)
    axis = _marker(writer, frame_id, 'axis', LINE_LIST, (line_width, 0.0, 0.0), AXIS_COLOR, lines)
    placed = [body, axis]
    fields = [(body.position_at, 3), (body.orientation_at, 4), (axis.orientation_at, 4)]
    if trace_points:
        numbers = 3 * trace_points
        trace = _marker(writer, frame_id, 'trace', LINE_STRIP, (0.5 * line_width, 0.0, 0.0),
                        TRACE_COLOR, numbers * (0.0,))
        placed.append(trace)
        fields.append((trace.points_at, numbers))
    writer.end()
    return Template(writer, [marker.stamp_at for marker in placed], fields)


class _Marker(NamedTuple):
    """Where the parts of a marker stand that change."""

    stamp_at: int
    position_at: int
    orientation_at: int
    points_at: int


def _marker(writer: CdrWriter, frame_id: str, namespace: str, kind: int, scale: Sequence[float],
            color: Sequence[float], points: Sequence[float] = ()) -> _Marker:
    """
    Append a visualization_msgs/Marker of id 0 that stays until another takes its place.

    points: x, y, z of each [m]
    """
    stamp_at = writer.stamp()
    writer.string(frame_id)
    writer.string(namespace)
    writer.append('i', 0)                                   # id
    writer.append('i', kind)
    writer.append('i', 0)                                   # action: add, or modify
    position_at = writer.doubles(0.0, 0.0, 0.0)
    orientation_at = writer.doubles(0.0, 0.0, 0.0, 1.0)
    writer.doubles(*scale)
    writer.append('f', *color)
    writer.stamp()                                          # lifetime: for ever
    writer.append('?', False)                               # frame_locked
    writer.append('I', len(points) // 3)
    points_at = writer.doubles(*points)
    writer.append('I', 0)                                   # colors
    writer.string('')                                       # texture_resource
    writer.stamp()                                          # texture: header, format, data
    writer.string('')
    writer.string('')
    writer.append('I', 0)
    writer.append('I', 0)                                   # uv_coordinates
    writer.string('')                                       # text
    writer.string('')                                       # mesh_resource
    writer.string('')                                       # mesh_file: filename, data
    writer.append('I', 0)
    writer.append('?', False)                               # mesh_use_embedded_materials
    return _Marker(stamp_at, position_at, orientation_at, points_at)


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    writer = CdrWriter()
    writer.string(text)
    return bytes(writer.buffer)
