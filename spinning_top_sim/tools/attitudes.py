# SPDX-License-Identifier: Apache-2.0
"""Reads the attitude from serialized messages of other nodes (OMG DDS-XTypes, XCDR1)."""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.messages import EXACT_VARIANCE

NO_ORIENTATION = -1.0           # first variance of a sensor_msgs/Imu without orientation


# By type: how many strings and doubles are between the header and the quaternion, and the rows of
# the covariance matrix after it, of which the last three are for rotations; 0: none.
LAYOUTS = {
    'sensor_msgs/msg/Imu': (0, 0, 3),
    'geometry_msgs/msg/QuaternionStamped': (0, 0, 0),
    'geometry_msgs/msg/PoseStamped': (0, 3, 0),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (0, 3, 6),
    'nav_msgs/msg/Odometry': (1, 3, 6)}


class Attitude(NamedTuple):
    """Stamp [ns], quaternion x, y, z, w (4,) and covariance (3, 3) [rad^2], NaN if unknown."""

    stamp_ns: int
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]


def decode(data: bytes, type_name: str) -> Attitude:
    """
    Return the attitude in a serialized message of a type of LAYOUTS.

    Raises ValueError if the message is too short or has no orientation.
    """
    strings, skipped, size = LAYOUTS[type_name]
    order = '<' if data[1:2] == b'\1' else '>'
    try:
        seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
        at = 12
        for _ in range(1 + strings):         # the first one is the frame
            at += -at % 4
            at += 4 + struct.unpack_from(f'{order}I', data, at)[0]
    except struct.error as error:
        raise ValueError(str(error)) from error
    at += (4 - at) % 8 + 8 * skipped         # aligned after the encapsulation header
    quaternion = np.frombuffer(data, f'{order}f8', 4, at)
    covariance = np.full((3, 3), np.nan)
    if size:
        matrix = np.frombuffer(data, f'{order}f8', size * size, at + 32).reshape(size, size)
        # The first variance of a pose is that of the position.
        if size == 3 and matrix[0, 0] == NO_ORIENTATION:
            raise ValueError('it has no orientation')
        # A matrix of zeros means unknown (sensor_msgs); the streams of this package are exact.
        if np.max(np.abs(matrix[-3:, -3:])) > EXACT_VARIANCE:
            covariance = matrix[-3:, -3:]
    return Attitude(seconds * NANOSECONDS + nanoseconds, quaternion, covariance)
