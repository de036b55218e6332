# SPDX-License-Identifier: Apache-2.0
"""
The texts that rosbag2 (jazzy) writes into a log: message definitions, offered QoS, bag metadata.

With the definitions, which are rosbag2's byte for byte, a log can be read where the packages of
its messages are missing.  Sources: rosbag2_cpp, LocalMessageDefinitionSource; rosbag2_storage,
qos.cpp and yaml.hpp; rosbag2_storage_mcap, mcap_storage.cpp.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import yaml

from spinning_top_sim.recording.errors import RecordingError

if TYPE_CHECKING:
    from mcap.records import Channel

# rosbag2's own expression: it takes the word before white space at the start of a line.
_FIELD_TYPE = re.compile(r'(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+', re.ASCII)
_PRIMITIVES = frozenset({
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
    'uint32', 'int64', 'uint64', 'string'})

# A profile: the keys of DEFAULT_QOS, integer policies as in rmw, durations as {'sec', 'nsec'}.
Qos = Mapping[str, Any]

BAG_METADATA = 'rosbag2'  # name of the metadata record

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


def find_definition(type_name: str) -> tuple[str, str]:
    """
    Return schema and type hash (REP-2011) of a type such as 'sensor_msgs/msg/Imu'.

    The `ros2msg` schema is the definition followed by those it depends on.  Raises RecordingError.
    """
    if not re.fullmatch(r'[a-zA-Z0-9_]+/msg/[a-zA-Z0-9_]+', type_name, re.ASCII):
        raise RecordingError(
            f'{type_name!r} is not the name of a message type: expected package/msg/Type')
    text = _with_dependencies(type_name, seen=set())
    for entry in json.loads(_installed_text(type_name, '.json'))['type_hashes']:
        if entry['type_name'] == type_name:
            return text, entry['hash_string']
    raise RecordingError(f'the description of {type_name} does not hold its type hash')


def _with_dependencies(type_name: str, seen: set[str]) -> str:
    """Return a definition followed by those it needs: depth first, sorted, each only once."""
    package = type_name.partition('/')[0]
    text = whole = _installed_text(type_name, '.msg')
    names = set(_FIELD_TYPE.findall(text)) - _PRIMITIVES
    for name in sorted(name if '/' in name else f'{package}/{name}' for name in names):
        if name not in seen:
            seen.add(name)
            whole += f'\n{"=" * 80}\nMSG: {name}\n{_with_dependencies(name, seen)}'
    return whole


def _installed_text(type_name: str, suffix: str) -> str:
    """Return the text of share/<package>/msg/<Type><suffix>, from the first place that has it."""
    package, _, name = type_name.replace('/msg/', '/').partition('/')
    searched = []
    for prefix in _prefixes(package):
        path = prefix / 'share' / package / 'msg' / f'{name}{suffix}'
        try:
            # Bytes, because a text file's newlines would be translated.
            return path.read_bytes().decode()
        except (FileNotFoundError, NotADirectoryError):
            searched.append(str(path))
        except (OSError, UnicodeDecodeError) as error:
            raise RecordingError(f'{type_name}: cannot read {path}: {error}') from error
    raise RecordingError(
        f'no definition of {type_name} is installed; searched {", ".join(searched)}')


def _prefixes(package: str) -> Iterator[Path]:
    """Yield the installation prefixes that may hold a package, as ROS overlays them."""
    yield from map(Path, filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)))
    yield Path(sys.prefix)
    with contextlib.suppress(ValueError):   # of a module that tells no origin, such as __main__
        spec = importlib.util.find_spec(package)
        for location in (spec.submodule_search_locations or ()) if spec else ():
            # <prefix>/lib/python3.x/site-packages/<package>, or below <prefix>/local on Debian
            yield from Path(location).parents[3:5]


class RecordedTopic(NamedTuple):
    """One topic of a recording."""

    name: str               # resolved, such as '/imu/data_raw'
    type_name: str          # 'package/msg/Type'
    qos: Qos = MappingProxyType({})     # offered; what is left out is as in DEFAULT_QOS


def offered_qos_yaml(topic: RecordedTopic) -> str:
    """Return the `offered_qos_profiles` of a channel, in integers as older releases read too."""
    return _dump([{**DEFAULT_QOS, **topic.qos}])


def qos_profiles(channel: Channel) -> tuple[Qos, ...]:
    """
    Return the QoS profiles in the metadata of a channel, with policies by number or name.

    A policy that is missing or not understood is as in DEFAULT_QOS; a text that is no list of
    profiles has none.
    """
    text = channel.metadata.get('offered_qos_profiles', '')
    if len(text) > 1 << 16 or '<<' in text:     # merged keys may grow exponentially
        return ()
    try:
        profiles = yaml.safe_load(text)
    except Exception:   # PyYAML raises many kinds for what it does not understand
        return ()
    if not isinstance(profiles, list) or not all(isinstance(one, dict) for one in profiles):
        return ()
    return tuple({key: _parsed_policy(key, profile.get(key)) for key in DEFAULT_QOS}
                 for profile in profiles)


def _parsed_policy(key: str, value: object) -> int | bool | Mapping[str, int]:
    default, names = DEFAULT_QOS[key], _POLICY_NAMES.get(key)
    if isinstance(default, Mapping):
        parts = value if isinstance(value, Mapping) else {}
        right = all(_is_int64(parts.get(part)) for part in default)
        return {part: parts[part] for part in default} if right else default
    if isinstance(default, bool):
        return value if isinstance(value, bool) else default
    if names is not None:
        if value in names:
            value = names.index(value)
        if value not in range(len(names)) or value == names.index('unknown'):
            return default
    return value if _is_int64(value) else default


def _is_int64(value: object) -> TypeGuard[int]:
    return type(value) is int and -1 << 63 <= value < 1 << 63


def bag_metadata_yaml(topics: Sequence[tuple[Channel, str, int]], *, file_name: str,
                      start_ns: int, end_ns: int) -> str:
    """
    Return the `serialized_metadata` of the `rosbag2` record.

    topics : channels with their type and the number of their messages, in the order of the file
    """
    # A file name may hold bytes that are no text: they must not spoil the closing of a log.
    file_name = file_name.encode(errors='replace').decode()
    start = {'nanoseconds_since_epoch': start_ns}
    duration = {'nanoseconds': end_ns - start_ns}
    total = sum(messages for _, _, messages in topics)
    return _dump({
        'version': 9,   # of rosbag2_storage::BagMetadata in jazzy
        'storage_identifier': 'mcap',
        'duration': duration,
        'starting_time': start,
        'message_count': total,
        'topics_with_message_count': [
            {'topic_metadata': {
                'name': channel.topic,
                'type': type_name,
                'serialization_format': channel.message_encoding,
                'offered_qos_profiles': [
                    {key: _POLICY_NAMES[key][value] if key in _POLICY_NAMES else value
                     for key, value in qos.items()} for qos in qos_profiles(channel)],
                'type_description_hash': channel.metadata.get('topic_type_hash', '')},
             'message_count': messages} for channel, type_name, messages in topics],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file_name],
        'files': [{'path': file_name, 'starting_time': start, 'duration': duration,
                   'message_count': total}],
        'custom_data': None,
        'ros_distro': os.environ.get('ROS_DISTRO') or 'jazzy'})


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        """Write what occurs twice twice: yaml-cpp writes no anchors."""
        return True


def _dump(value: object) -> str:
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True,
                     width=float('inf')).rstrip('\n')
