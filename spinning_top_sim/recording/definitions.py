# SPDX-License-Identifier: Apache-2.0
"""
Message definitions of the installed ROS 2 packages, as rosbag2 writes them into a log.

A log carries its own schemas so that it can be read where the packages are missing.  The text is
that of rosbag2's LocalMessageDefinitionSource (rosbag2_cpp, jazzy), byte for byte.
"""

import contextlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from spinning_top_sim.recording.errors import DefinitionNotFoundError

# rosbag2's own expression: it takes the word before white space at the start of a line.
_FIELD_TYPE = re.compile(r'(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+', re.ASCII)
_PRIMITIVES = frozenset({
    'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
    'uint32', 'int64', 'uint64', 'string'})


@dataclass(frozen=True)
class MessageDefinition:
    """What a log says about one message type."""

    text: str       # its `ros2msg` schema: the definition followed by those it depends on
    type_hash: str  # 'RIHS01_' and 64 hexadecimal digits (REP-2011)


def find_definition(type_name: str) -> MessageDefinition:
    """
    Look up a type such as 'geometry_msgs/msg/PoseStamped' in the installed packages.

    Raises DefinitionNotFoundError, naming the type and the places searched.
    """
    if not re.fullmatch(r'[a-zA-Z0-9_]+/msg/[a-zA-Z0-9_]+', type_name, re.ASCII):
        raise DefinitionNotFoundError(
            f'{type_name!r} is not the name of a message type: expected package/msg/Type')
    text = _with_dependencies(type_name, seen=set())
    for entry in json.loads(_read(type_name, '.json'))['type_hashes']:
        if entry['type_name'] == type_name:
            return MessageDefinition(text, entry['hash_string'])
    raise DefinitionNotFoundError(f'the description of {type_name} does not hold its type hash')


def _with_dependencies(type_name: str, seen: set[str]) -> str:
    """Return a definition followed by those it needs: depth first, sorted, each only once."""
    package = type_name.partition('/')[0]
    text = whole = _read(type_name, '.msg')
    names = set(_FIELD_TYPE.findall(text)) - _PRIMITIVES
    for name in sorted(name if '/' in name else f'{package}/{name}' for name in names):
        if name not in seen:
            seen.add(name)
            whole += f'\n{"=" * 80}\nMSG: {name}\n{_with_dependencies(name, seen)}'
    return whole


def _read(type_name: str, suffix: str) -> str:
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
            raise DefinitionNotFoundError(f'{type_name}: cannot read {path}: {error}') from error
    raise DefinitionNotFoundError(
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
