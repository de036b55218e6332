# SPDX-License-Identifier: Apache-2.0
"""The layout of Foxglove: its topics and message paths are those of the node."""

import json
import re

from helpers.reference import ROOT

from spinning_top_sim.nodes.publishers import message_class
from spinning_top_sim.streams import parameters, topics
from spinning_top_sim.tools.recorded_run import channels_of

PANELS = json.loads((ROOT / 'foxglove/spinning_top_sim.json').read_text())['configById']
TYPES = {topics.resolve_topic(channel.topic, ''): channel.type_name
         for channel in channels_of(parameters.checked({}))}
TYPES |= {'/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
          '/robot_description': 'std_msgs/msg/String'}      # of robot_state_publisher
PART = re.compile(r'(\w+)(?:\[(\d+|:)\])?(?:\{\w+=="[^"]*"\})?')


def end_of(path):
    """Return topic and last index of a message path; fail where its type has no such field."""
    topic, *parts = re.split(r'\.(?![^{]*\})', path)
    type_name = TYPES[topic]
    for part in parts:
        name, index = PART.fullmatch(part).groups()
        field = message_class(type_name).get_fields_and_field_types()[name]
        sequence = re.fullmatch(r'sequence<(.+)>', field)
        assert bool(sequence) is (index is not None), part
        type_name = sequence[1] if sequence else field
    assert type_name in ('double', 'string'), path
    return topic, index


def test_each_path_and_topic_of_the_layout_is_there():
    for path in (path for panel in PANELS.values() for path in panel.get('paths', ())):
        topic, index = end_of(path['value'])
        if topic == f'/{topics.NODE_NAME}/invariants':
            assert topics.INVARIANTS[int(index)].replace('_', ' ') == path['label']
        if topic == '/joint_states':
            assert topics.JOINTS[int(index)] == {
                'θ': 'nutation_joint', "φ'": 'precession_joint'}[path['label']]
    scene = PANELS['3D!scene']
    assert {*scene['topics'], scene['layers']['urdf']['topic']} <= set(TYPES)
    assert scene['followTf'] == parameters.BY_NAME['world_frame'].default
