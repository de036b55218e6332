# SPDX-License-Identifier: Apache-2.0
"""
The messages that the simulator sends, as templates.

Fields stand in the order of the installed .msg definitions (ROS 2 Jazzy, common_interfaces 5.3);
a test compares every template with what rclpy serializes.
"""

from __future__ import annotations

from collections.abc import Sequence

from spinning_top_sim.streams.cdr import CdrWriter, Template

UNKNOWN_ORIENTATION = (-1.0,) + 8 * (0.0,)      # REP-145: no orientation in this message
EXACT = 9 * (0.0,)


def diagonal(variance: float) -> tuple[float, ...]:
    """Return a row-major 3 x 3 covariance."""
    return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)


def _header(frame_id: str) -> tuple[CdrWriter, int]:
    writer = CdrWriter()
    stamp_at = writer.stamp()
    writer.string(frame_id)
    return writer, stamp_at


def pose_stamped(frame_id: str) -> Template:
    """geometry_msgs/PoseStamped at the origin; runs: orientation x, y, z, w."""
    writer, stamp_at = _header(frame_id)
    writer.doubles((0.0, 0.0, 0.0))
    return Template(writer, stamp_at, [(writer.doubles((0.0, 0.0, 0.0, 1.0)), 4)])


def joint_state(names: Sequence[str]) -> Template:
    """sensor_msgs/JointState without effort; runs: positions, velocities."""
    writer, stamp_at = _header('')
    writer.strings(names)
    zeros = len(names) * (0.0,)
    runs = [(writer.double_sequence(zeros), len(names)) for _ in ('position', 'velocity')]
    writer.double_sequence(())
    return Template(writer, stamp_at, runs)


def imu(frame_id: str, orientation_covariance: Sequence[float],
        angular_velocity_covariance: Sequence[float],
        linear_acceleration_covariance: Sequence[float]) -> Template:
    """sensor_msgs/Imu; runs: orientation x, y, z, w, angular velocity, linear acceleration."""
    writer, stamp_at = _header(frame_id)
    runs = [(writer.doubles((0.0, 0.0, 0.0, 1.0)), 4)]
    writer.doubles(orientation_covariance)
    runs.append((writer.doubles(3 * (0.0,)), 3))
    writer.doubles(angular_velocity_covariance)
    runs.append((writer.doubles(3 * (0.0,)), 3))
    writer.doubles(linear_acceleration_covariance)
    return Template(writer, stamp_at, runs)


def odometry(frame_id: str, child_frame_id: str) -> Template:
    """nav_msgs/Odometry of a fixed point, covariances zero; runs: orientation, body rates."""
    writer, stamp_at = _header(frame_id)
    writer.string(child_frame_id)
    writer.doubles(3 * (0.0,))
    runs = [(writer.doubles((0.0, 0.0, 0.0, 1.0)), 4)]
    writer.doubles(36 * (0.0,))
    writer.doubles(3 * (0.0,))                              # linear velocity: the pivot is fixed
    runs.append((writer.doubles(3 * (0.0,)), 3))
    writer.doubles(36 * (0.0,))
    return Template(writer, stamp_at, runs)


def float64_multi_array(labels: Sequence[str]) -> Template:
    """std_msgs/Float64MultiArray, one dimension labelled with its columns; runs: the data."""
    writer = CdrWriter()
    writer.uint32(1)
    writer.string(','.join(labels))
    writer.uint32(len(labels))                              # size
    writer.uint32(len(labels))                              # stride
    writer.uint32(0)                                        # data offset
    return Template(writer, None,
                    [(writer.double_sequence(len(labels) * (0.0,)), len(labels))])


def clock() -> Template:
    """rosgraph_msgs/Clock; no runs."""
    writer = CdrWriter()
    return Template(writer, writer.stamp(), [])


def string(text: str) -> bytes:
    """Return a serialized std_msgs/String."""
    writer = CdrWriter()
    writer.string(text)
    return bytes(writer.buffer)
