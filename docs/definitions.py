#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write recording/definitions.json from the types of rosbags: `python docs/definitions.py`."""

import json
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.streams import events, parameters
from spinning_top_sim.tools.recorded_run import channels_of

FILE = Path(__file__).parent.parent / 'spinning_top_sim/recording/definitions.json'


def definitions() -> str:
    """Return schema and type hash of every type that a stream or an event has."""
    types, store = {channel.type_name for channel in channels_of(parameters.checked({}))}, (
        get_typestore(Stores.ROS2_JAZZY))
    return json.dumps({name: (store.generate_msgdef(name, ros_version=2)[0],
                              store.hash_rihs01(name)) for name in sorted(
        types | set(events.TOPICS.values()))}, indent=1) + '\n'


if __name__ == '__main__':
    FILE.write_text(definitions(), encoding='utf-8')
