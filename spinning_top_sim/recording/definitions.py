# SPDX-License-Identifier: Apache-2.0
"""Definitions of message types as ROS 2 Jazzy has them, whether ROS is installed or not."""

from functools import cache
from typing import Any

from spinning_top_sim.recording.errors import RecordingError


@cache
def _types() -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 50 ms

    return get_typestore(Stores.ROS2_JAZZY)


def find_definition(type_name: str) -> tuple[str, str]:
    """
    Return schema (`ros2msg`) and type hash (REP-2011) of a type such as 'sensor_msgs/msg/Imu'.

    The schema is the definition followed by those it depends on, without comments.
    Raises RecordingError for a type that Jazzy's common interfaces do not have.
    """
    types = _types()
    if type_name not in types.fielddefs:
        raise RecordingError(f'there is no message type {type_name} in ROS 2 Jazzy')
    return types.generate_msgdef(type_name, ros_version=2)[0], types.hash_rihs01(type_name)
