# SPDX-License-Identifier: Apache-2.0
"""Writes definitions.json: PYTHONPATH=.:test python -m helpers.definitions."""

import json
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.recording import definitions
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.topics import all_streams

FILE = Path(__file__).parents[2] / 'spinning_top_sim/recording/definitions.json'
TYPES = sorted({stream.type_name for stream in all_streams(parameters.checked({}))}
               | {type_name for _, type_name in journal.TOPICS.items()})
JAZZY = get_typestore(Stores.ROS2_JAZZY)


def definition(type_name):
    return [JAZZY.generate_msgdef(type_name, ros_version=2)[0], JAZZY.hash_rihs01(type_name)]


def add_definitions(*type_names):
    """Let logs have these types for the rest of the tests."""
    definitions.definitions().update({name: definition(name) for name in type_names})


if __name__ == '__main__':
    FILE.write_text(json.dumps({name: definition(name) for name in TYPES}, indent=1) + '\n',
                    encoding='utf-8')
