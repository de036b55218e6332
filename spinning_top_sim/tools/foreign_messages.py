# SPDX-License-Identifier: Apache-2.0
"""Reads the messages of other programs, and the attitude in them, by rosbags."""

import math
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.messages import EXACT_VARIANCE

NO_ORIENTATION = -1.0           # first variance of a sensor_msgs/Imu without orientation
# By type: where the quaternion is, and the covariance matrix, whose last three rows are those of
# rotations.
LAYOUTS = {
    'sensor_msgs/msg/Imu': ('orientation', 'orientation_covariance'),
    'geometry_msgs/msg/QuaternionStamped': ('quaternion', ''),
    'geometry_msgs/msg/PoseStamped': ('pose.orientation', ''),
    'geometry_msgs/msg/PoseWithCovarianceStamped': ('pose.pose.orientation', 'pose.covariance'),
    'nav_msgs/msg/Odometry': ('pose.pose.orientation', 'pose.covariance')}


class Attitude(NamedTuple):
    """Stamp [ns], quaternion x, y, z, w (4,) and covariance (3, 3) [rad^2], NaN if unknown."""

    stamp_ns: int
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]


@cache
def _types() -> Any:
    with needed('a log', 'rosbags'):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 0.3 s
    return get_typestore(Stores.ROS2_JAZZY)


def deserialized(data: bytes, type_name: str) -> Any:
    """Return a message of a type of ROS 2 Jazzy.  Raises ValueError."""
    types = _types()
    try:
        return types.deserialize_cdr(data, type_name)
    except Exception as error:      # whatever rosbags raises
        raise ValueError(f'no {type_name}: {error}') from error


def decode(data: bytes, type_name: str) -> Attitude:
    """Return the attitude in a message of a type of LAYOUTS.  Raises ValueError without one."""
    message, (place, matrix_place) = deserialized(data, type_name), LAYOUTS[type_name]
    stamp, q = message.header.stamp, attrgetter(place)(message)
    covariance = np.full((3, 3), np.nan)
    if matrix_place:
        numbers = attrgetter(matrix_place)(message)
        # The first variance of a pose is that of the position.
        if len(numbers) == 9 and numbers[0] == NO_ORIENTATION:
            raise ValueError('it has no orientation')
        matrix = numbers.reshape(math.isqrt(len(numbers)), -1)[-3:, -3:]
        # A matrix of zeros means unknown (sensor_msgs); the streams of this package are exact.
        if np.max(np.abs(matrix)) > EXACT_VARIANCE:
            covariance = matrix
    return Attitude(stamp.sec * NANOSECONDS + stamp.nanosec, np.array((q.x, q.y, q.z, q.w)),
                    covariance)
