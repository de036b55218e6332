# SPDX-License-Identifier: Apache-2.0
"""
Templates of the messages that the simulator sends.

Their parts are in the order of the .msg definitions (ROS 2 Jazzy, common_interfaces 5.3), their
fields have the names there; a test compares every template with the serializer of rclpy.
"""

from functools import lru_cache

from spinning_top_sim.streams.cdr import Field, Header, Numbers, Part, Template

UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
# A covariance of zeros means unknown (sensor_msgs/Imu), so that exact values have this variance.
EXACT_VARIANCE = 1e-18
CYLINDER, LINE_STRIP, LINE_LIST = 3, 4, 5       # visualization_msgs/Marker
BODY_COLOR = (0.20, 0.40, 0.70, 1.0)            # red, green, blue, alpha
AXIS_COLOR = (0.95, 0.75, 0.20, 1.0)
TRACE_COLOR = (0.90, 0.30, 0.20, 1.0)
ORIGIN, NO_ROTATION = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def diagonal(*variances: float) -> tuple[float, ...]:
    """Return a row-major covariance with these variances; 0 becomes EXACT_VARIANCE."""
    count = len(variances)
    return tuple(variances[row] or EXACT_VARIANCE if row == column else 0.0
                 for row in range(count) for column in range(count))


EXACT = diagonal(0.0, 0.0, 0.0)


# Ensembles make the same ones in every run.
message = lru_cache(256)(Template)


def imu(frame_id: str, orientation: tuple[float, ...], *covariances: tuple[float, ...],
        ) -> Template:
    """
    Return sensor_msgs/Imu.

    orientation, covariances : covariances of orientation, angular velocity and specific force;
        with UNKNOWN_ORIENTATION there is no orientation, and no field of it
    """
    rates, forces = covariances
    return message(
        Header(frame_id), Numbers('d', NO_ROTATION) if orientation == UNKNOWN_ORIENTATION
        else Field('orientation', 4), Numbers('d', orientation), Field('angular_velocity', 3),
        Numbers('d', rates), Field('linear_acceleration', 3), Numbers('d', forces))


def odometry(frame_id: str, child_frame_id: str) -> Template:
    """Return nav_msgs/Odometry with exact values; the twist is in the child frame."""
    exact = Numbers('d', diagonal(*6 * (0.0,)))
    return message(
        Header(frame_id), child_frame_id, Field('pose.pose.position', 3),
        Field('pose.pose.orientation', 4), exact, Field('twist.twist.linear', 3),
        Field('twist.twist.angular', 3), exact)


def float64_multi_array(labels: tuple[str, ...]) -> Template:
    """Return std_msgs/Float64MultiArray, one dimension labelled with its columns."""
    count = len(labels)
    # Number of dimensions; label, size and stride; offset of the data, their number.
    return message(Numbers('I', (1,)), ','.join(labels),
                   Numbers('I', (count, count, 0, count)), Field('data', count))


def markers(frame_id: str, size: tuple[float, ...], lines: tuple[float, ...], line_width: float,
            trace_points: int) -> Template:
    """
    Return visualization_msgs/MarkerArray: a cylinder, lines on it, and a trace if it has points.

    size : diameters and height of the cylinder [m]
    lines : x, y and z of begin and end of each line, in the body frame [m]
    line_width : [m]; the trace is half as wide
    """
    parts = [
        *_marker(0, frame_id, 'body', CYLINDER, size, BODY_COLOR, Numbers('I', (0,))),
        *_marker(1, frame_id, 'axis', LINE_LIST, (line_width, 0.0, 0.0), AXIS_COLOR,
                 Numbers('I', (len(lines) // 3,)), Numbers('d', lines))]
    if trace_points:
        parts += _marker(2, frame_id, 'trace', LINE_STRIP, (0.5 * line_width, 0.0, 0.0),
                         TRACE_COLOR, Numbers('I', (trace_points,)),
                         Field('markers[2].points', 3 * trace_points))
    return message(Numbers('I', (3 if trace_points else 2,)), *parts)


def _marker(number: int, frame_id: str, namespace: str, kind: int, scale: tuple[float, ...],
            color: tuple[float, ...], *points: Part) -> list[Part]:
    """Return a visualization_msgs/Marker; the points of a line strip are in the world."""
    place = f'markers[{number}].pose'
    pose: list[Part] = [Numbers('d', (*ORIGIN, *NO_ROTATION))] if kind == LINE_STRIP else [
        Field(f'{place}.position', 3), Field(f'{place}.orientation', 4)]
    return [
        Header(frame_id), namespace, Numbers('i', (0, kind, 0)),    # id, type, action: add
        *pose, Numbers('d', scale), Numbers('f', color),
        Numbers('I', (0, 0)), Numbers('?', (False,)),               # lifetime, frame_locked
        *points, Numbers('I', (0,)), '',                            # colors, texture_resource
        Numbers('I', (0, 0)), '', '', Numbers('I', (0, 0)),         # texture, uv_coordinates
        '', '', '', Numbers('I', (0,)),                             # text, mesh, its file and data
        Numbers('?', (False,))]                                     # mesh_use_embedded_materials


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    return Template(text).data
