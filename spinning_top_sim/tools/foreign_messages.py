# SPDX-License-Identifier: Apache-2.0
"""Reads the messages of other programs, and poses and readings in them, by rosbags."""

import math
from collections import defaultdict
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams.messages import EXACT_VARIANCE
from spinning_top_sim.times import NANOSECONDS

NO_ORIENTATION = -1.0           # first variance of a sensor_msgs/Imu without orientation
# By type: where the quaternion is, and the covariance matrix, whose last three rows are those of
# rotations.
LAYOUTS = {
    'sensor_msgs/msg/Imu': ('orientation', 'orientation_covariance'),
    'geometry_msgs/msg/QuaternionStamped': ('quaternion', ''),
    'geometry_msgs/msg/PoseStamped': ('pose.orientation', ''),
    'geometry_msgs/msg/PoseWithCovarianceStamped': ('pose.pose.orientation', 'pose.covariance'),
    'nav_msgs/msg/Odometry': ('pose.pose.orientation', 'pose.covariance')}
# By type: where positions, attitudes and readings are.
_POSE = {'positions': 'pose.pose.position', 'attitudes': 'pose.pose.orientation'}
_TRANSFORM = {'positions': 'transform.translation', 'attitudes': 'transform.rotation'}
PLACES = {
    'geometry_msgs/msg/PoseStamped': {'positions': 'pose.position',
                                      'attitudes': 'pose.orientation'},
    'geometry_msgs/msg/PoseWithCovarianceStamped': _POSE, 'nav_msgs/msg/Odometry': _POSE,
    'geometry_msgs/msg/TransformStamped': _TRANSFORM, 'tf2_msgs/msg/TFMessage': _TRANSFORM,
    'sensor_msgs/msg/Imu': {'gyroscope': 'angular_velocity',
                            'accelerations': 'linear_acceleration'},
    'sensor_msgs/msg/MagneticField': {'magnetometer': 'magnetic_field'}}


class Sample(NamedTuple):
    """Numbers in a message, and its stamp [ns]."""

    stamp_ns: int
    values: list[float]


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


def decode(data: bytes, type_name: str) -> tuple[int, list[float], NDArray[np.float64]]:
    """
    Return the attitude in a message of a type of LAYOUTS.  Raises ValueError without one.

    It is a stamp [ns], quaternion x, y, z, w and covariance (3, 3) [rad^2], NaN if unknown.
    """
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
    return stamp.sec * NANOSECONDS + stamp.nanosec, [q.x, q.y, q.z, q.w], covariance


def samples(reader: LogReader, end_ns: int) -> dict[str, dict[str, list[Sample]]]:
    """
    Return poses and readings by kind, as in PLACES, and topic, of transforms TOPIC:CHILD.

    end_ns : log time up to which they are read

    Raises LogError.
    """
    types = {topic.name: topic.type_name for topic in reader.topics if topic.type_name in PLACES}
    found: dict[str, dict[str, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    for message in reader.messages(types, end=end_ns):
        kind = types[message.topic]
        try:
            content = deserialized(message.data, kind)
        except ValueError as error:
            raise LogError(f'cannot read {reader.path}: a message of {message.topic} is '
                           f'{error}') from error
        for one in getattr(content, 'transforms', [content]):
            source = message.topic + (f':{one.child_frame_id}' if one is not content else '')
            stamp = one.header.stamp.sec * NANOSECONDS + one.header.stamp.nanosec
            for part, place in PLACES[kind].items():
                covariance = getattr(one, f'{place}_covariance', None)
                if covariance is None or covariance[0] != NO_ORIENTATION:   # there is a reading
                    vector = attrgetter(place)(one)
                    found[part][source].append(Sample(stamp, [
                        getattr(vector, axis) for axis in 'xyzw' if hasattr(vector, axis)]))
    return found
