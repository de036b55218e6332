# SPDX-License-Identifier: Apache-2.0
"""Scenes as worlds: parameter files that a running node can start again with."""

import contextlib
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import unquote, urlsplit

import yaml
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import is_of_ros, known, parse_scene

# What a world sets: a parameter of these that it does not have gets its default.
OF_A_WORLD = ('top.', 'initial.', 'spin.', 'solver.')
LARGEST_FILE = 1_000_000        # [bytes], and characters of a text


class FormatError(ValueError):
    """A resource is no parameter file."""


def scene_files() -> dict[str, Path]:
    """Return the installed scenes by name."""
    folders = [Path(sys.prefix) / 'share/spinning_top_sim', Path(__file__).parents[2]]
    # OSError: AMENT_PREFIX_PATH is not set, as in an environment of pip.
    with contextlib.suppress(PackageNotFoundError, OSError):
        folders.insert(0, Path(get_package_share_directory('spinning_top_sim')))
    found = (sorted((folder / 'config').glob('*.yaml')) for folder in folders)
    return {path.stem: path for path in next(filter(None, found), ())}


@dataclass(frozen=True)
class World:
    """
    A top and the start of its motion, as a parameter file has it.

    name, uri : the stem of the file and its path, both '' without a file
    text : what the file says
    given : its parameters, by name
    ignored : names in it that are no parameters of a running node
    """

    name: str
    uri: str
    text: str
    given: Mapping[str, object]
    ignored: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str, uri: str = '') -> Self:
        """Return the world of a text.  Raises ValueError, which says what is wrong with it."""
        source = uri or 'resource_string'
        if len(text) > LARGEST_FILE:
            raise FormatError(f'{source}: {len(text)} characters; must be at most {LARGEST_FILE}')
        found = parse_scene(text, source)
        usable = {name: value for name, value in found.items() if name in parameters.BY_NAME
                  and parameters.BY_NAME[name].effect is not parameters.Effect.START}
        if not any(name.startswith(OF_A_WORLD) for name in usable):
            raise ValueError(f'{source} is no world: it must set a parameter of '
                             f'{", ".join(f"{prefix}*" for prefix in OF_A_WORLD)}')
        world = cls(Path(uri).stem, uri, text, known(usable, source), tuple(
            name for name in found if name not in usable and not is_of_ros(name)))
        world.values({})
        return world

    @classmethod
    def read(cls, uri: str) -> Self:
        """
        Return the world of a scene's name, a path or a file URI.

        Raises FileNotFoundError, FormatError for what is no parameter file, and OSError or
        ValueError where it cannot be read.
        """
        path = local_path(uri)
        if re.search('[\ud800-\udfff]', str(path.absolute())):      # no message can hold these
            raise FormatError(f'{uri!r}: must be a path in UTF-8')
        if uri in (scenes := scene_files()):
            path = scenes[uri]
        if path.suffix not in ('.yaml', '.yml') and not path.is_file():
            raise FileNotFoundError(f'{uri}: there is no such scene or file; there are the scenes '
                                    f'{", ".join(scenes)}')
        if path.suffix not in ('.yaml', '.yml'):
            raise FormatError(f'{uri}: must be a parameter file of ROS 2, *.yaml')
        if not path.is_file():
            raise FileNotFoundError(f'{uri}: there is no such file')
        if path.stat().st_size > LARGEST_FILE:
            raise FormatError(f'{uri}: {path.stat().st_size} bytes; must be at most '
                              f'{LARGEST_FILE}')
        try:
            text = path.read_text(encoding='utf-8')
        except UnicodeDecodeError as error:
            raise FormatError(f'{uri}: must be in UTF-8: {error}') from error
        return cls.parse(text, str(path.absolute()))

    def values(self, present: Mapping[str, Any]) -> dict[str, Any]:
        """Return the present parameters with those of the world.  Raises ValueError."""
        defaults = {parameter.name: parameter.default for parameter in parameters.TABLE
                    if parameter.name.startswith(OF_A_WORLD)}
        return parameters.checked({**present, **defaults, **self.given})

    def is_that_of(self, values: Mapping[str, Any]) -> bool:
        """Return whether a motion with these parameters starts as this world does."""
        try:
            wanted = self.values(values)
        except ValueError:      # its parameters do not go with those outside of a world
            return False
        return all(values[name] == value for name, value in wanted.items())

    @property
    def description(self) -> str:
        """The comment at the head of the file, in one line."""
        lines = []
        for line in self.text.splitlines():
            if not line.startswith('#'):
                break
            if 'SPDX-License-Identifier' not in line:
                lines.append(line.lstrip('# ').rstrip())
        return ' '.join(lines)


def present_world(values: Mapping[str, Any], loaded: World | None) -> World:
    """
    Return the world whose start these parameters are.

    It is the one loaded last or an installed scene, or else a text of the parameters.
    """
    if loaded is not None and loaded.is_that_of(values):
        return loaded
    for path in scene_files().values():
        # A file that somebody has put there or changed may be anything.
        with contextlib.suppress(OSError, ValueError):
            if (scene := World.read(str(path))).is_that_of(values):
                return scene
    given = {name: value for name, value in values.items()
             if name.startswith(OF_A_WORLD) and value is not None}
    return World.parse(yaml.safe_dump({'/**': {'ros__parameters': given}}))


def worlds_in(source: str) -> list[World]:
    """Return the worlds of a file or folder.  Raises OSError or ValueError if it is none."""
    path = local_path(source)
    if not path.is_dir():
        return [World.read(source)]
    found = []
    for file in sorted(path.glob('*.yaml')):
        with contextlib.suppress(OSError, ValueError):      # other files of the folder
            found.append(World.read(str(file)))
    return found


def local_path(uri: str) -> Path:
    """Return the path of a file URI, or of a path.  Raises FormatError for others."""
    parts = urlsplit(uri)
    if '\0' in uri or (parts.scheme and not (parts.scheme == 'file'
                                             and parts.netloc in ('', 'localhost'))):
        raise FormatError(f'{uri!r}: must be the name of a scene, a path or a file:// URI')
    path = Path(unquote(parts.path) if parts.scheme else uri)
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise FormatError(f'{uri!r}: there is no such user') from error
