#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write recording/definitions.json from the types of rosbags: `python docs/definitions.py`."""

import json
from pathlib import Path

from spinning_top_sim.recording.rosbag2 import generated_definition
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.tools.recorded_run import channels_of

FILE = Path(__file__).parent.parent / 'spinning_top_sim/recording/definitions.json'


def definitions() -> str:
    """Return schema and type hash of every type that a stream or an event has."""
    types = {channel.type_name for channel in channels_of(parameters.checked({}))}
    return json.dumps({name: generated_definition(name) for name in sorted(
        types | set(events.TOPICS.values()))}, indent=1) + '\n'


if __name__ == '__main__':
    FILE.write_text(definitions(), encoding='utf-8')
