# SPDX-License-Identifier: Apache-2.0
"""
Templates of the messages that the simulator sends.

Their parts are in the order of the .msg definitions (ROS 2 Jazzy, common_interfaces 5.3), their
fields have the names there; a test compares every template with the serializer of rclpy.
"""

from functools import lru_cache, partial

from spinning_top_sim.streams.cdr import CdrWriter, Template

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


@lru_cache(64)      # ensembles make it in every run
def pose(frame_id: str) -> Template:
    """geometry_msgs/PoseStamped; quaternions are x, y, z, w everywhere."""
    return Template(CdrWriter().header(frame_id).field('pose.position', 3)
                    .field('pose.orientation', 4))


@lru_cache(64)
def vector(frame_id: str) -> Template:
    """geometry_msgs/Vector3Stamped."""
    return Template(CdrWriter().header(frame_id).field('vector', 3))


@lru_cache(64)
def quaternion(frame_id: str) -> Template:
    """geometry_msgs/QuaternionStamped."""
    return Template(CdrWriter().header(frame_id).field('quaternion', 4))


@lru_cache(64)
def magnetic_field(frame_id: str) -> Template:
    """sensor_msgs/MagneticField."""
    return Template(CdrWriter().header(frame_id).field('magnetic_field', 3)
                    .field('magnetic_field_covariance', 9))


@lru_cache(64)
def joint_state(names: tuple[str, ...]) -> Template:
    """sensor_msgs/JointState without effort."""
    count = len(names)
    writer = CdrWriter().header('').append('I', count).string(*names)
    for field in ('position', 'velocity'):
        writer.append('I', count).field(field, count)
    return Template(writer.append('I', 0))


@lru_cache(64)
def imu(frame_id: str, orientation: tuple[float, ...], *covariances: tuple[float, ...],
        ) -> Template:
    """
    sensor_msgs/Imu.

    orientation, covariances : covariances of orientation, angular velocity and specific force;
        with UNKNOWN_ORIENTATION there is no orientation, and no field of it
    """
    writer = CdrWriter().header(frame_id)
    if orientation == UNKNOWN_ORIENTATION:
        writer.append('d', *NO_ROTATION)
    else:
        writer.field('orientation', 4)
    writer.append('d', *orientation)
    for field, covariance in zip(('angular_velocity', 'linear_acceleration'), covariances,
                                 strict=True):
        writer.field(field, 3).append('d', *covariance)
    return Template(writer)


@lru_cache(64)
def nav_sat_fix(frame_id: str) -> Template:
    """sensor_msgs/NavSatFix of GPS; latitude and longitude [deg], altitude [m]."""
    return Template(CdrWriter().header(frame_id).field('status.status', 1, 'b').append('H', 1)
                    .field('position', 3).field('position_covariance', 9)
                    .field('position_covariance_type', 1, 'B'))


@lru_cache(64)
def twist_with_covariance(frame_id: str, variances: tuple[float, ...]) -> Template:
    """
    geometry_msgs/TwistWithCovarianceStamped without angular velocity.

    variances : of the linear velocity; those of the angular one are -1, as ublox_gps has it
    """
    covariance = diagonal(*variances, *3 * (-1.0,))
    return Template(CdrWriter().header(frame_id).field('twist.twist.linear', 3)
                    .append('d', *ORIGIN, *covariance))


@lru_cache(64)
def odometry(frame_id: str, child_frame_id: str) -> Template:
    """nav_msgs/Odometry with exact values; the twist is in the child frame."""
    exact = diagonal(*6 * (0.0,))
    return Template(
        CdrWriter().header(frame_id).string(child_frame_id).field('pose.pose.position', 3)
        .field('pose.pose.orientation', 4).append('d', *exact).field('twist.twist.linear', 3)
        .field('twist.twist.angular', 3).append('d', *exact))


@lru_cache(64)
def transform(frame_id: str, child_frame_id: str) -> Template:
    """tf2_msgs/TFMessage with one transform."""
    return Template(CdrWriter().append('I', 1).header(frame_id).string(child_frame_id)
                    .field('transforms[0].transform.translation', 3)
                    .field('transforms[0].transform.rotation', 4))


@lru_cache(64)
def float64_multi_array(labels: tuple[str, ...]) -> Template:
    """std_msgs/Float64MultiArray, one dimension labelled with its columns."""
    count = len(labels)
    # Number of dimensions; label, size and stride; offset of the data, their number.
    return Template(CdrWriter().append('I', 1).string(','.join(labels))
                    .append('I', count, count, 0, count).field('data', count))


@lru_cache(64)
def clock() -> Template:
    """rosgraph_msgs/Clock; no fields."""
    return Template(CdrWriter().stamp())


@lru_cache(64)
def markers(frame_id: str, size: tuple[float, ...], lines: tuple[float, ...], line_width: float,
            trace_points: int) -> Template:
    """
    visualization_msgs/MarkerArray: a cylinder, lines on it, and a trace if it has points.

    size : diameters and height of the cylinder [m]
    lines : x, y and z of begin and end of each line, in the body frame [m]
    line_width : [m]; the trace is half as wide
    """
    writer = CdrWriter().append('I', 3 if trace_points else 2)
    marker = partial(_append_marker, writer, frame_id)
    marker(0, 'body', CYLINDER, size, BODY_COLOR, 0)
    marker(1, 'axis', LINE_LIST, (line_width, 0.0, 0.0), AXIS_COLOR, len(lines) // 3, lines)
    if trace_points:
        marker(2, 'trace', LINE_STRIP, (0.5 * line_width, 0.0, 0.0), TRACE_COLOR, trace_points)
    return Template(writer)


def _append_marker(writer: CdrWriter, frame_id: str, number: int, namespace: str, kind: int,
                   scale: tuple[float, ...], color: tuple[float, ...], count: int,
                   points: tuple[float, ...] = ()) -> None:
    """Append a visualization_msgs/Marker; `count` points that are not given: a field."""
    writer.header(frame_id).string(namespace).append('i', 0, kind, 0)   # id, type, action: add
    if kind == LINE_STRIP:
        writer.append('d', *ORIGIN, *NO_ROTATION)
    else:
        writer.field(f'markers[{number}].pose.position', 3)
        writer.field(f'markers[{number}].pose.orientation', 4)
    writer.append('d', *scale).append('f', *color)
    writer.append('I', 0, 0)                                # lifetime: for ever
    writer.append('?', False)                               # frame_locked
    writer.append('I', count)
    if points:
        writer.append('d', *points)
    elif count:
        writer.field(f'markers[{number}].points', 3 * count)
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
    return bytes(CdrWriter().string(text).buffer)
