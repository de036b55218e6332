# SPDX-License-Identifier: Apache-2.0
"""
Templates of the messages that the simulator sends.

Their parts are in the order of the .msg definitions (ROS 2 Jazzy, common_interfaces 5.3); a test
compares every template with the serializer of rclpy.
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
# Names in the message definitions of the fields of a template, by type.
FIELDS = {
    'geometry_msgs/msg/PoseStamped': ('pose.position', 'pose.orientation'),
    'tf2_msgs/msg/TFMessage': ('transforms[0].transform.translation',
                               'transforms[0].transform.rotation'),
    'sensor_msgs/msg/JointState': ('position', 'velocity'),
    'sensor_msgs/msg/Imu': ('orientation', 'angular_velocity', 'linear_acceleration'),
    'sensor_msgs/msg/MagneticField': ('magnetic_field', 'magnetic_field_covariance'),
    'sensor_msgs/msg/NavSatFix': ('position',),
    'geometry_msgs/msg/TwistWithCovarianceStamped': ('twist.twist.linear',),
    'nav_msgs/msg/Odometry': ('pose.pose.position', 'pose.pose.orientation',
                              'twist.twist.linear', 'twist.twist.angular'),
    'geometry_msgs/msg/QuaternionStamped': ('quaternion',),
    'geometry_msgs/msg/Vector3Stamped': ('vector',),
    'rosgraph_msgs/msg/Clock': (),
    'std_msgs/msg/Float64MultiArray': ('data',),
    'visualization_msgs/msg/MarkerArray': (
        'markers[0].pose.position', 'markers[0].pose.orientation',
        'markers[1].pose.position', 'markers[1].pose.orientation', 'markers[2].points'),
}


def diagonal(*variances: float) -> tuple[float, ...]:
    """Return a row-major covariance with these variances; 0 becomes EXACT_VARIANCE."""
    count = len(variances)
    return tuple(variances[row] or EXACT_VARIANCE if row == column else 0.0
                 for row in range(count) for column in range(count))


EXACT = diagonal(0.0, 0.0, 0.0)


@lru_cache(64)      # ensembles make it in every run
def stamped(frame_id: str, *counts: int) -> Template:
    """
    A header and fields with so many numbers.

    geometry_msgs/PoseStamped (3, 4), Vector3Stamped (3) and QuaternionStamped (4), and
    sensor_msgs/MagneticField (3, 9): the field and its covariance; quaternions are x, y, z, w.
    """
    return Template(CdrWriter().header(frame_id).field(*counts))


@lru_cache(64)
def joint_state(names: tuple[str, ...]) -> Template:
    """sensor_msgs/JointState without effort; fields: positions, velocities."""
    count = len(names)
    writer = CdrWriter().header('').append('I', count).string(*names)
    for _ in ('position', 'velocity'):
        writer.append('I', count).field(count)
    return Template(writer.append('I', 0))


@lru_cache(64)
def imu(frame_id: str, *covariances: tuple[float, ...]) -> Template:
    """sensor_msgs/Imu; fields: orientation x, y, z, w, angular velocity, linear acceleration."""
    writer = CdrWriter().header(frame_id)
    for count, covariance in zip((4, 3, 3), covariances, strict=True):
        writer.field(count).append('d', *covariance)
    return Template(writer)


@lru_cache(64)
def nav_sat_fix(frame_id: str, covariance: tuple[float, ...] | None) -> Template:
    """
    sensor_msgs/NavSatFix of GPS; fields: latitude and longitude [deg], altitude [m].

    covariance : east, north, up [m^2]; None: there is no fix
    """
    status, kind = (-1, 0) if covariance is None else (0, 2)    # 2: the diagonal is known
    writer = CdrWriter().header(frame_id).append('b', status).append('H', 1).field(3)
    return Template(writer.append('d', *(covariance or 9 * (0.0,))).append('B', kind))


@lru_cache(64)
def twist_with_covariance(frame_id: str, variances: tuple[float, ...]) -> Template:
    """
    geometry_msgs/TwistWithCovarianceStamped; fields: linear velocity.

    variances : of the linear velocity; those of the angular one are -1, as ublox_gps has it
    """
    covariance = diagonal(*variances, *3 * (-1.0,))
    return Template(CdrWriter().header(frame_id).field(3).append('d', *ORIGIN, *covariance))


@lru_cache(64)
def odometry(frame_id: str, child_frame_id: str) -> Template:
    """
    nav_msgs/Odometry with exact values.

    Fields: position, orientation; velocity and angular velocity in the child frame.
    """
    writer = CdrWriter().header(frame_id).string(child_frame_id)
    for count in (4, 3):
        writer.field(3, count).append('d', *diagonal(*6 * (0.0,)))
    return Template(writer)


@lru_cache(64)
def transform(frame_id: str, child_frame_id: str) -> Template:
    """tf2_msgs/TFMessage with one transform; fields: translation, rotation x, y, z, w."""
    return Template(CdrWriter().append('I', 1).header(frame_id).string(child_frame_id)
                    .field(3, 4))


@lru_cache(64)
def float64_multi_array(labels: tuple[str, ...]) -> Template:
    """std_msgs/Float64MultiArray, one dimension labelled with its columns; fields: the data."""
    count = len(labels)
    # Number of dimensions; label, size and stride; offset of the data, their number.
    return Template(CdrWriter().append('I', 1).string(','.join(labels))
                    .append('I', count, count, 0, count).field(count))


@lru_cache(64)
def clock() -> Template:
    """rosgraph_msgs/Clock; no fields."""
    return Template(CdrWriter().stamp())


@lru_cache(64)
def markers(frame_id: str, size: tuple[float, ...], lines: tuple[float, ...], line_width: float,
            trace_points: int) -> Template:
    """
    visualization_msgs/MarkerArray: a cylinder, lines on it, and a trace if it has points.

    Fields: position and orientation of the cylinder, and of the lines; points of the trace.

    size : diameters and height of the cylinder [m]
    lines : x, y and z of begin and end of each line, in the body frame [m]
    line_width : [m]; the trace is half as wide
    """
    writer = CdrWriter().append('I', 3 if trace_points else 2)
    marker = partial(_append_marker, writer, frame_id)
    marker('body', CYLINDER, size, BODY_COLOR, 0)
    marker('axis', LINE_LIST, (line_width, 0.0, 0.0), AXIS_COLOR, len(lines) // 3, lines)
    if trace_points:
        marker('trace', LINE_STRIP, (0.5 * line_width, 0.0, 0.0), TRACE_COLOR, trace_points)
    return Template(writer)


def _append_marker(writer: CdrWriter, frame_id: str, namespace: str, kind: int,
                   scale: tuple[float, ...], color: tuple[float, ...], count: int,
                   points: tuple[float, ...] = ()) -> None:
    """Append a visualization_msgs/Marker; `count` points that are not given: a field."""
    writer.header(frame_id).string(namespace).append('i', 0, kind, 0)   # id, type, action: add
    if kind == LINE_STRIP:
        writer.append('d', *ORIGIN, *NO_ROTATION)
    else:
        writer.field(3, 4)
    writer.append('d', *scale).append('f', *color)
    writer.append('I', 0, 0)                                # lifetime: for ever
    writer.append('?', False)                               # frame_locked
    writer.append('I', count)
    if points:
        writer.append('d', *points)
    elif count:
        writer.field(3 * count)
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
