# SPDX-License-Identifier: Apache-2.0
"""Definitions of ROS message types, from an installed ROS or from the library rosbags."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spinning_top_sim.installation import remedy
from spinning_top_sim.recording.errors import RecordingError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_PRIMITIVES = frozenset((
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
    'uint32', 'int64', 'uint64', 'string', 'wstring'))


@cache
def find_definition(type_name: str) -> tuple[str, str]:
    """
    Return schema and type hash (REP-2011) of a type such as 'sensor_msgs/msg/Imu'.

    The `ros2msg` schema is the definition followed by those it depends on.  It comes from the
    installed ROS, or else from rosbags (Jazzy), with the same text: constants, then fields,
    without comments and default values, which no reader needs.  Raises RecordingError.
    """
    if _installed_file(type_name, '.json') is None:
        return _of_rosbags(type_name)
    for entry in json.loads(_installed_text(type_name, '.json'))['type_hashes']:
        if entry['type_name'] == type_name:
            text = f'{"=" * 80}\nMSG: '.join(_definitions(type_name, set()))
            return text, entry['hash_string']
    raise RecordingError(f'the description of {type_name} does not hold its type hash')


def _of_rosbags(type_name: str) -> tuple[str, str]:
    try:
        store = _jazzy()
    except ImportError as error:
        raise RecordingError(
            f'no definition of {type_name} is installed: source the setup.bash of ROS 2, or '
            f'{remedy("rosbags")}') from error
    if type_name not in store.fielddefs:
        raise RecordingError(f'no definition of {type_name} is installed, and rosbags has none')
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return text, store.hash_rihs01(type_name)


@cache
def _jazzy() -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - it takes 0.3 s
    return get_typestore(Stores.ROS2_JAZZY)


def _definitions(type_name: str, seen: set[str]) -> Iterator[str]:
    """Yield a definition, then those it needs after their names: depth first, each once."""
    package = type_name.partition('/')[0]
    constants, fields, needed = [], [], []
    for line in _installed_text(type_name, '.msg').splitlines():
        kind, _, rest = ' '.join(line.partition('#')[0].split()).partition(' ')
        name, equals, value = (part.strip() for part in rest.partition('='))
        if equals:
            constants.append(f'{kind} {name}={value}\n')
        elif kind:
            base, bracket, size = kind.partition('[')
            if base.partition('<')[0] not in _PRIMITIVES:
                base = base if '/' in base else f'{package}/{base}'
                needed.append(base)
            fields.append(f'{base}{bracket}{size} {name.partition(" ")[0]}\n')
    yield ''.join(constants + fields)
    for base in needed:
        if base not in seen:
            seen.add(base)
            first, *others = _definitions(base, seen)
            yield f'{base}\n{first}'
            yield from others


def _installed_text(type_name: str, suffix: str) -> str:
    path = _installed_file(type_name, suffix)
    if path is None:
        raise RecordingError(f'no definition of {type_name} is installed')
    try:
        return path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f'{type_name}: cannot read {path}: {error}') from error


def _installed_file(type_name: str, suffix: str) -> Path | None:
    """Return share/<package>/msg/<Type><suffix> in the first place that has it."""
    package, _, name = type_name.replace('/msg/', '/').partition('/')
    for prefix in _prefixes(package):
        path = prefix / 'share' / package / 'msg' / f'{name}{suffix}'
        if path.is_file():
            return path
    return None


def _prefixes(package: str) -> Iterator[Path]:
    """Yield the installation prefixes that may hold a package, as ROS overlays them."""
    yield from map(Path, filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)))
    yield Path(sys.prefix)
    with contextlib.suppress(ValueError):   # of a module that tells no origin, such as __main__
        spec = importlib.util.find_spec(package)
        for location in (spec.submodule_search_locations or ()) if spec else ():
            # <prefix>/lib/python3.x/site-packages/<package>, or below <prefix>/local on Debian
            yield from Path(location).parents[3:5]
