# SPDX-License-Identifier: Apache-2.0
"""
Templates of the messages that the simulator sends.

Their parts are in the order of the .msg definitions (ROS 2 Jazzy, common_interfaces 5.3), their
fields have the names there; a test compares every template with the serializer of rclpy.
"""

from functools import lru_cache

from spinning_top_sim.streams.cdr import Field, Header, Numbers, Template

UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
# A covariance of zeros means unknown (sensor_msgs/Imu), so that exact values have this variance.
EXACT_VARIANCE = 1e-18
ORIGIN, NO_ROTATION = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def diagonal(*variances: float) -> tuple[float, ...]:
    """Return a row-major covariance with these variances; 0 becomes EXACT_VARIANCE."""
    count = len(variances)
    return tuple(variances[row] or EXACT_VARIANCE if row == column else 0.0
                 for row in range(count) for column in range(count))


EXACT = diagonal(0.0, 0.0, 0.0)


# Ensembles make the same ones in every run.
message = lru_cache(256)(Template)


def imu(frame_id: str, rates: tuple[float, ...], forces: tuple[float, ...],
        orientation: tuple[float, ...] = ()) -> Template:
    """Return sensor_msgs/Imu with these covariances; without an orientation where it has none."""
    return message(
        Header(frame_id), Field('orientation', 4) if orientation else Numbers('d', NO_ROTATION),
        Numbers('d', orientation or UNKNOWN_ORIENTATION), Field('angular_velocity', 3),
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


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    return Template(text).data
