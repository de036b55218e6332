# SPDX-License-Identifier: Apache-2.0
"""
The texts that rosbag2 (jazzy) writes into a log: definitions, offered QoS, bag metadata.

Sources: rosbag2_storage, qos.cpp and yaml.hpp; rosbag2_storage_mcap, mcap_storage.cpp.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from spinning_top_sim.installation import read_table

if TYPE_CHECKING:       # nodes need this module without mcap
    from mcap.records import Channel

# A profile: the keys of DEFAULT_QOS, integer policies as in rmw, durations as {'sec', 'nsec'}.
Qos = Mapping[str, Any]

BAG_METADATA = 'rosbag2'  # name of the metadata record

_NEVER = {'sec': 9223372036, 'nsec': 854775807}     # RMW_DURATION_INFINITE

# What a reliable publisher with a queue of ten offers, rmw's enum values.
DEFAULT_QOS: Qos = {
    'history': 1,                        # keep last
    'depth': 10,
    'reliability': 1,                    # reliable
    'durability': 2,                     # volatile
    'deadline': _NEVER,
    'lifespan': _NEVER,
    'liveliness': 1,                     # automatic
    'liveliness_lease_duration': _NEVER,
    'avoid_ros_namespace_conventions': False}

_POLICY_NAMES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
                   'best_available')}
_PLAYED = ('reliability', 'durability', 'history', 'depth')


class RecordedTopic(NamedTuple):
    """One topic of a recording."""

    name: str               # resolved, such as '/imu/data_raw'
    type_name: str          # 'package/msg/Type'
    qos: Qos = MappingProxyType({})     # offered; what is left out is as in DEFAULT_QOS

    @property
    def offered(self) -> Qos:
        return {**DEFAULT_QOS, **self.qos}


def definition(type_name: str) -> tuple[str, str]:
    """Return schema (`ros2msg`, without comments) and type hash (REP-2011) of a stream's type."""
    text, type_hash = read_table('recording/definitions.json')[type_name]
    return text, type_hash


def qos_profiles(channel: Channel) -> tuple[Qos, ...]:
    """Return the profiles that a channel offers, with _PLAYED; what is wrong is as by default."""
    text = channel.metadata.get('offered_qos_profiles', '')
    if len(text) > 1 << 16 or '<<' in text:     # merged keys may grow exponentially
        return ()
    try:
        return tuple({policy: _understood(policy, profile.get(policy)) for policy in _PLAYED}
                     for profile in yaml.safe_load(text))
    except Exception:   # PyYAML raises many kinds for what it does not understand
        return ()


def _understood(policy: str, value: Any) -> Any:
    names = _POLICY_NAMES.get(policy, ())
    number = names.index(value) if value in names else value
    allowed = [known for known, name in enumerate(names) if name != 'unknown'] or (
        range(-1 << 31, 1 << 31))
    return number if type(number) is int and number in allowed else DEFAULT_QOS[policy]


def has_compressed_messages(path: Path, metadata: Mapping[str, Mapping[str, str]]) -> bool:
    """Return whether rosbag2 has compressed the messages of a log one by one."""
    text = metadata.get(BAG_METADATA, {}).get('serialized_metadata') or ''.join(
        one.read_text(errors='replace') for one in path.parent.glob('metadata.yaml'))
    return bool(re.search(r'^[ \t]*compression_mode:[ \t]*["\']?message', text, re.M | re.I))


def bag_metadata(topics: Sequence[RecordedTopic], counts: Sequence[int], file_name: str,
                 start_ns: int, end_ns: int) -> dict[str, str]:
    """Return the `rosbag2` record; `counts` are numbers of messages by topic."""
    # A file name may hold bytes that are no text: they must not spoil the closing of a log.
    file_name = file_name.encode(errors='replace').decode()
    numbers = {'starting_time': {'nanoseconds_since_epoch': start_ns},
               'duration': {'nanoseconds': end_ns - start_ns}, 'message_count': sum(counts)}
    return {'serialized_metadata': as_yaml({
        'version': 9,   # of rosbag2_storage::BagMetadata in jazzy
        'storage_identifier': 'mcap', **numbers,
        'topics_with_message_count': [
            {'topic_metadata': {
                'name': topic.name, 'type': topic.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [
                    {key: _POLICY_NAMES[key][value] if key in _POLICY_NAMES else value
                     for key, value in topic.offered.items()}],
                'type_description_hash': definition(topic.type_name)[1]},
             'message_count': count} for topic, count in zip(topics, counts, strict=True)],
        'compression_format': '', 'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [{'path': file_name, **numbers}],
        'custom_data': None, 'ros_distro': os.environ.get('ROS_DISTRO', 'jazzy')})}


def as_yaml(value: object) -> str:
    """Return YAML as yaml-cpp writes it: what occurs twice stands there twice, without anchors."""
    return yaml.safe_dump(json.loads(json.dumps(value)), sort_keys=False, allow_unicode=True,
                          width=float('inf')).rstrip('\n')
