# SPDX-License-Identifier: Apache-2.0
"""
The messages that the simulator sends, as templates.

Fields stand in the order of the installed .msg definitions (ROS 2 Jazzy, common_interfaces 5.3);
a test compares every template with what rclpy serializes.
"""

from collections.abc import Sequence

from spinning_top_sim.streams.cdr import CdrWriter, Template

UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
# Stands for exact, in SI units: a covariance of zeros means unknown (sensor_msgs/Imu).
EXACT_VARIANCE = 1e-18
CYLINDER, LINE_STRIP, LINE_LIST = 3, 4, 5       # visualization_msgs/Marker
BODY_COLOR = (0.20, 0.40, 0.70, 1.0)            # red, green, blue, alpha
AXIS_COLOR = (0.95, 0.75, 0.20, 1.0)
TRACE_COLOR = (0.90, 0.30, 0.20, 1.0)


def diagonal(*variances: float) -> tuple[float, ...]:
    """Return a row-major covariance with these variances; 0 becomes EXACT_VARIANCE."""
    count = len(variances)
    return tuple(variances[row] or EXACT_VARIANCE if row == column else 0.0
                 for row in range(count) for column in range(count))


EXACT = diagonal(0.0, 0.0, 0.0)


def pose_stamped(frame_id: str) -> Template:
    """geometry_msgs/PoseStamped at the origin; fields: orientation x, y, z, w."""
    writer = CdrWriter()
    writer.header(frame_id)
    writer.append('d', 0.0, 0.0, 0.0)
    writer.field(4)
    return Template(writer)


def joint_state(names: Sequence[str]) -> Template:
    """sensor_msgs/JointState without effort; fields: positions, velocities."""
    writer = CdrWriter()
    writer.header('')
    writer.append('I', len(names))
    writer.string(*names)
    for _ in ('position', 'velocity'):
        writer.append('I', len(names))
        writer.field(len(names))
    writer.append('I', 0)
    return Template(writer)


def imu(frame_id: str, *covariances: Sequence[float]) -> Template:
    """sensor_msgs/Imu; fields: orientation x, y, z, w, angular velocity, linear acceleration."""
    writer = CdrWriter()
    writer.header(frame_id)
    for count, covariance in zip((4, 3, 3), covariances, strict=True):
        writer.field(count)
        writer.append('d', *covariance)
    return Template(writer)


def magnetic_field(frame_id: str) -> Template:
    """sensor_msgs/MagneticField; fields: the field, its covariance."""
    writer = CdrWriter()
    writer.header(frame_id)
    writer.field(3)
    writer.field(9)
    return Template(writer)


def odometry(frame_id: str, child_frame_id: str, *, moves: bool = False) -> Template:
    """
    nav_msgs/Odometry, exact.

    Fields: orientation, body rates; if the point `moves`: position, orientation, velocity in the
    child frame, body rates.
    """
    writer = CdrWriter()
    writer.header(frame_id)
    writer.string(child_frame_id)
    for count in (4, 3):
        if moves:
            writer.field(3)
        else:
            writer.append('d', 0.0, 0.0, 0.0)       # position, linear velocity: the pivot rests
        writer.field(count)
        writer.append('d', *diagonal(*(6 * (0.0,))))
    return Template(writer)


def stamped(frame_id: str, count: int) -> Template:
    """geometry_msgs/Vector3Stamped (count 3) or QuaternionStamped (4); fields: x, y, z(, w)."""
    writer = CdrWriter()
    writer.header(frame_id)
    writer.field(count)
    return Template(writer)


def float64_multi_array(labels: Sequence[str]) -> Template:
    """std_msgs/Float64MultiArray, one dimension labelled with its columns; fields: the data."""
    writer = CdrWriter()
    writer.append('I', 1)
    writer.string(','.join(labels))
    writer.append('I', len(labels), len(labels), 0, len(labels))    # size, stride, offset, size
    writer.field(len(labels))
    return Template(writer)


def clock() -> Template:
    """rosgraph_msgs/Clock; no fields."""
    writer = CdrWriter()
    writer.stamp()
    return Template(writer)


def markers(frame_id: str, size: Sequence[float], lines: Sequence[float], line_width: float,
            trace_points: int) -> Template:
    """
    visualization_msgs/MarkerArray: a cylinder, lines on it, and the trace if it has points.

    Fields: position and orientation of the cylinder, orientation of the lines, the trace's points.

    size : diameters and height of the cylinder [m]
    lines : x, y and z of begin and end of each line, in the body frame [m]
    line_width : [m]; the trace is half as wide
    """
    writer = CdrWriter()
    writer.append('I', 3 if trace_points else 2)
    _marker(writer, frame_id, 'body', CYLINDER, size, BODY_COLOR, 'position', 'orientation')
    _marker(writer, frame_id, 'axis', LINE_LIST, (line_width, 0.0, 0.0), AXIS_COLOR,
            'orientation', points=lines)
    if trace_points:
        _marker(writer, frame_id, 'trace', LINE_STRIP, (0.5 * line_width, 0.0, 0.0), TRACE_COLOR,
                'points', points=3 * trace_points * (0.0,))
    return Template(writer)


def _marker(writer: CdrWriter, frame_id: str, namespace: str, kind: int, scale: Sequence[float],
            color: Sequence[float], *fields: str, points: Sequence[float] = ()) -> None:
    """Append a visualization_msgs/Marker whose `fields` differ from message to message."""
    def numbers(name: str, *values: float) -> None:
        if name in fields:
            writer.field(len(values))
        else:
            writer.append('d', *values)

    writer.header(frame_id)
    writer.string(namespace)
    writer.append('i', 0, kind, 0)                          # id, type, action: add, or modify
    numbers('position', 0.0, 0.0, 0.0)
    numbers('orientation', 0.0, 0.0, 0.0, 1.0)
    writer.append('d', *scale)
    writer.append('f', *color)
    writer.append('I', 0, 0)                                # lifetime: for ever
    writer.append('?', False)                               # frame_locked
    writer.append('I', len(points) // 3)
    numbers('points', *points)
    writer.append('I', 0)                                   # colors
    writer.string('')                                       # texture_resource
    writer.append('I', 0, 0)                                # texture: stamp, frame, format, data
    writer.string('', '')
    writer.append('I', 0, 0)                                # and uv_coordinates
    writer.string('', '', '')                               # text, mesh_resource, mesh_file's name
    writer.append('I', 0)                                   # and data
    writer.append('?', False)                               # mesh_use_embedded_materials


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    writer = CdrWriter()
    writer.string(text)
    return bytes(writer.buffer)
