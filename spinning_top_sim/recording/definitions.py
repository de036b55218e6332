# SPDX-License-Identifier: Apache-2.0
"""Definitions of ROS message types, as ROS 2 Jazzy has them."""

import json
from functools import cache
from pathlib import Path

from spinning_top_sim.installation import needed
from spinning_top_sim.recording.errors import RecordingError


@cache
def find_definition(type_name: str) -> tuple[str, str]:
    """
    Return schema and type hash (REP-2011) of a type such as 'sensor_msgs/msg/Imu'.

    The `ros2msg` schema is the definition followed by those it depends on: constants, then fields.
    Those of all streams are in definitions.json, any other comes from rosbags.
    Raises RecordingError.
    """
    known = json.loads(Path(__file__).with_suffix('.json').read_text('utf-8'))
    if type_name in known:
        text, type_hash = known[type_name]
        return text, type_hash
    try:
        with needed(f'a recording of {type_name}'):
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 0.3 s
    except ImportError as error:
        raise RecordingError(str(error)) from error
    store = get_typestore(Stores.ROS2_JAZZY)
    if type_name not in store.fielddefs:
        raise RecordingError(f'there is no definition of {type_name}')
    return store.generate_msgdef(type_name, ros_version=2)[0], store.hash_rihs01(type_name)
