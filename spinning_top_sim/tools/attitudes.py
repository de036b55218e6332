# SPDX-License-Identifier: Apache-2.0
"""The attitude in a message that another node has written, in CDR (OMG DDS-XTypes, XCDR1)."""

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.messages import EXACT_VARIANCE

NO_ORIENTATION = -1.0           # sensor_msgs/Imu has it in the covariance


class Layout(NamedTuple):
    """
    Where the attitude is in a message after its header.

    strings, skipped : that come before the quaternion; of the skipped ones each has 8 bytes
    covariance : rows of the matrix after the quaternion; the last three are of turns.  0: none
    """

    strings: int
    skipped: int
    covariance: int


LAYOUTS = {
    'sensor_msgs/msg/Imu': Layout(0, 0, 3),
    'geometry_msgs/msg/QuaternionStamped': Layout(0, 0, 0),
    'geometry_msgs/msg/PoseStamped': Layout(0, 3, 0),
    'geometry_msgs/msg/PoseWithCovarianceStamped': Layout(0, 3, 6),
    'nav_msgs/msg/Odometry': Layout(1, 3, 6)}


class Attitude(NamedTuple):
    """Stamp [ns], quaternion x, y, z, w (4,) and covariance (3, 3) [rad^2], NaN: unknown."""

    stamp_ns: int
    quaternion: NDArray[np.float64]
    covariance: NDArray[np.float64]


def decode(data: bytes, type_name: str) -> Attitude:
    """
    Return the attitude in a serialized message of a type of LAYOUTS.

    Raises ValueError for a message that is too short, or says that it has no orientation.
    """
    layout = LAYOUTS[type_name]
    order = '<' if data[1:2] == b'\1' else '>'
    try:
        seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
        at = 12
        for _ in range(1 + layout.strings):         # first the frame
            at += -at % 4
            at += 4 + struct.unpack_from(f'{order}I', data, at)[0]
    except struct.error as error:
        raise ValueError(str(error)) from error
    at += (4 - at) % 8 + 8 * layout.skipped         # aligned after the four bytes of the head
    quaternion = np.frombuffer(data, f'{order}f8', 4, at)
    covariance = np.full((3, 3), np.nan)
    if layout.covariance:
        size = layout.covariance
        matrix = np.frombuffer(data, f'{order}f8', size * size, at + 32).reshape(size, size)
        # Of a pose the first variance is that of the position.
        if size == 3 and matrix[0, 0] == NO_ORIENTATION:
            raise ValueError('it has no orientation')
        # 0 is unknown (sensor_msgs), and our own streams say so of what is exact.
        if np.max(np.abs(matrix[-3:, -3:])) > EXACT_VARIANCE:
            covariance = matrix[-3:, -3:]
    return Attitude(seconds * NANOSECONDS + nanoseconds, quaternion, covariance)
