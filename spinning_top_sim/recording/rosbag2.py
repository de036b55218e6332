# SPDX-License-Identifier: Apache-2.0
"""
The two YAML texts that rosbag2 (jazzy) expects in a log: offered QoS and bag metadata.

Sources: rosbag2_storage, qos.cpp and yaml.hpp; rosbag2_storage_mcap, mcap_storage.cpp.  They are
few fixed lines, written by hand so that a recording imports no YAML package.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeGuard

# A profile: the keys of DEFAULT_QOS, integer policies as in rmw, durations as {'sec', 'nsec'}.
Qos = Mapping[str, Any]

BAG_METADATA = 'rosbag2'  # name of the metadata record

_METADATA_VERSION = 9  # of rosbag2_storage::BagMetadata in jazzy
_NEVER = {'sec': 9223372036, 'nsec': 854775807}  # RMW_DURATION_INFINITE

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
    'avoid_ros_namespace_conventions': False,
}

_POLICY_NAMES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
                   'best_available'),
}


@dataclass(frozen=True)
class RecordedTopic:
    """
    One topic of a recording.

    Parameters
    ----------
    name : str
        Resolved, such as '/imu/data_raw'.
    type_name : str
        'package/msg/Type'.
    qos : mapping
        What the publisher offers; a policy that is left out is as in DEFAULT_QOS.

    Raises
    ------
    ValueError
        Naming the key, its value and what is allowed.

    """

    name: str
    type_name: str
    qos: Qos = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, value in self.qos.items():
            if key not in DEFAULT_QOS:
                raise ValueError(f'qos of {self.name}: {key!r} is none of {list(DEFAULT_QOS)}')
            names = _POLICY_NAMES.get(key)
            if names is not None and not 0 <= value < len(names):
                raise ValueError(
                    f'qos of {self.name}: {key} = {value!r}: must be in [0, {len(names) - 1}]')


@dataclass(frozen=True)
class BagTopic:
    """What the bag metadata say of a topic."""

    name: str
    type_name: str
    type_hash: str              # 'RIHS01_...' or ''
    profiles: Sequence[Qos]     # what its publishers offer
    messages: int
    encoding: str = 'cdr'


def offered_qos_yaml(topic: RecordedTopic) -> str:
    """
    Return the `offered_qos_profiles` of a channel: a list of one profile, policies as integers.

    Names would do for jazzy; integers are what older releases read, and jazzy too.
    """
    return '\n'.join(_qos_lines(topic.qos, as_names=False))


def parse_offered_qos(text: str) -> list[Qos]:
    """
    Parse the `offered_qos_profiles` of a channel, with policies by number or name.

    A policy that is missing or not understood is as in DEFAULT_QOS; a text that is no list of
    profiles has none.
    """
    if not text:
        return []
    import yaml  # noqa: PLC0415 - a recording needs none

    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError):
        return []
    if not isinstance(profiles, list) or not all(isinstance(one, dict) for one in profiles):
        return []
    return [{key: _parsed_policy(key, profile.get(key)) for key in DEFAULT_QOS}
            for profile in profiles]


def _parsed_policy(key: str, value: object) -> int | bool | Mapping[str, int]:
    default, names = DEFAULT_QOS[key], _POLICY_NAMES.get(key)
    if isinstance(default, Mapping):
        parts = value if isinstance(value, Mapping) else {}
        right = all(_is_int64(parts.get(part)) for part in default)
        return {part: parts[part] for part in default} if right else default
    if names is not None and value in names:
        value = names.index(value)
    if names is not None and not (
            _is_int64(value) and 0 <= value < len(names) and names[value] != 'unknown'):
        return default
    if isinstance(default, bool):
        return value if isinstance(value, bool) else default
    return value if _is_int64(value) else default


def _is_int64(value: object) -> TypeGuard[int]:
    return type(value) is int and -1 << 63 <= value < 1 << 63


def bag_metadata_yaml(
    topics: Sequence[BagTopic],
    *,
    file_name: str,
    start_ns: int,
    end_ns: int,
    former: str = '',
) -> str:
    """
    Return the `serialized_metadata` of the `rosbag2` record.

    Parameters
    ----------
    topics : sequence of BagTopic
        In the order of the file.
    file_name : str
        Without its directory.
    start_ns, end_ns : int
        The earliest and the latest stamp [ns since the epoch]; both 0 in an empty log.
    former : str
        The metadata of the log that this one is made from, whose ROS distribution and custom
        data stay.

    """
    total = sum(topic.messages for topic in topics)
    lines = [
        f'version: {_METADATA_VERSION}',
        'storage_identifier: mcap',
        'duration:',
        f'  nanoseconds: {end_ns - start_ns}',
        'starting_time:',
        f'  nanoseconds_since_epoch: {start_ns}',
        f'message_count: {total}',
        'topics_with_message_count:' if topics else 'topics_with_message_count: []',
    ]
    for topic in topics:
        profiles = [line for profile in topic.profiles
                    for line in _qos_lines(profile, as_names=True)]
        lines += [
            '  - topic_metadata:',
            f'      name: {_quoted(topic.name)}',
            f'      type: {_quoted(topic.type_name)}',
            '      serialization_format: '
            + (topic.encoding if topic.encoding == 'cdr' else _quoted(topic.encoding)),
            '      offered_qos_profiles:' if profiles else '      offered_qos_profiles: []',
            *(f'        {line}' for line in profiles),
            f'      type_description_hash: {_quoted(topic.type_hash)}',
            f'    message_count: {topic.messages}',
        ]
    lines += [
        'compression_format: ""',
        'compression_mode: ""',
        'relative_file_paths:',
        f'  - {_quoted(file_name)}',
        'files:',
        f'  - path: {_quoted(file_name)}',
        '    starting_time:',
        f'      nanoseconds_since_epoch: {start_ns}',
        '    duration:',
        f'      nanoseconds: {end_ns - start_ns}',
        f'    message_count: {total}',
        _block(former, 'custom_data') or 'custom_data: ~',
        _block(former, 'ros_distro')
        or f'ros_distro: {_quoted(os.environ.get("ROS_DISTRO") or "jazzy")}',
    ]
    return '\n'.join(lines)


def _block(text: str, key: str) -> str:
    """Return the lines of a key at the top of a YAML text, as they are."""
    match = re.search(rf'^{key}:.*(?:\n[ \t].*)*', text, re.MULTILINE)
    return match.group() if match else ''


def _qos_lines(profile: Qos, *, as_names: bool) -> list[str]:
    """Return a profile as a YAML list of one, line by line."""
    lines = []
    for key, default in DEFAULT_QOS.items():
        value = profile.get(key, default)
        if isinstance(default, Mapping):
            lines += [f'{key}:', f'  sec: {int(value["sec"])}', f'  nsec: {int(value["nsec"])}']
        elif isinstance(default, bool):
            lines.append(f'{key}: {"true" if value else "false"}')
        elif as_names and key in _POLICY_NAMES:
            lines.append(f'{key}: {_POLICY_NAMES[key][value]}')
        else:
            lines.append(f'{key}: {int(value)}')
    return [('- ' if i == 0 else '  ') + line for i, line in enumerate(lines)]


def _quoted(text: str) -> str:
    """Return a double-quoted YAML scalar; JSON's escapes are a subset of YAML's."""
    # A file name may hold bytes that are no text: they must not spoil the closing of a log.
    printable = text.encode(errors='replace').decode()
    return json.dumps(printable, ensure_ascii=False)
