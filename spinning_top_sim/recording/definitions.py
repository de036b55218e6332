# SPDX-License-Identifier: Apache-2.0
"""Definitions of the message types of all streams, as ROS 2 Jazzy has them."""

import json
from functools import cache
from pathlib import Path

from spinning_top_sim.recording.errors import RecordingError


@cache
def definitions() -> dict[str, list[str]]:
    """Return schema and type hash (REP-2011) by type, such as 'sensor_msgs/msg/Imu'."""
    known: dict[str, list[str]] = json.loads(Path(__file__).with_suffix('.json').read_bytes())
    return known


def find_definition(type_name: str) -> tuple[str, str]:
    """
    Return schema and type hash of a type.  Raises RecordingError for one of no stream.

    The `ros2msg` schema is the definition followed by those it depends on: constants, then fields.
    """
    try:
        text, type_hash = definitions()[type_name]
    except KeyError:
        raise RecordingError(f'there is no definition of {type_name} in recording/definitions.json'
                             ) from None
    return text, type_hash
