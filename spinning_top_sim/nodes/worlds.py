# SPDX-License-Identifier: Apache-2.0
"""Scenes as worlds: parameter files with which a running node can start again."""

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from urllib.parse import unquote

from spinning_top_sim.nodes.simulation_standard import RefusedError
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import is_of_ros, known, parse_scene

# The parameters of a world.  Those of them that a file does not set get their defaults.
OF_A_WORLD = ('top.', 'initial.', 'spin.', 'solver.')
NOT_FOUND, UNSUPPORTED_FORMAT = 2, 101      # of Result and LoadWorld


def scene_files() -> dict[str, Path]:
    """Return the installed scenes by name."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    folders = [Path(prefix, 'share/spinning_top_sim') for prefix in filter(None, prefixes)]
    found = (sorted((folder / 'config').glob('*.yaml'))
             for folder in (*folders, Path(__file__).parents[2]))
    return {path.stem: path for path in next(filter(None, found), ())}


@dataclass(frozen=True)
class World:
    """
    A top and the start of its motion, as a parameter file describes them.

    name, uri : the stem of the file and its path, both '' without a file
    text : the content of the file
    given : its parameters, by name
    ignored : names in it that are not parameters of a running node
    """

    name: str
    uri: str
    text: str
    given: Mapping[str, object]
    ignored: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str, uri: str = '') -> Self:
        """Return the world that a text describes.  Raises ValueError for any other text."""
        source = uri or 'resource_string'
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

        Raises RefusedError for what is no parameter file, OSError, or ValueError for its content.
        """
        scenes = scene_files()
        path = scenes.get(uri) or Path(
            unquote(uri.removeprefix('file://')) if uri.startswith('file://') else uri)
        if not path.is_file():
            raise RefusedError(NOT_FOUND, f'{uri}: there is no such scene or file; there are the '
                               f'scenes {", ".join(scenes)}')
        if path.suffix not in ('.yaml', '.yml'):
            raise RefusedError(UNSUPPORTED_FORMAT,
                               f'{uri}: must be a parameter file of ROS 2, *.yaml')
        return cls.parse(path.read_text('utf-8'), str(path.absolute()))

    def values(self, present: Mapping[str, Any]) -> dict[str, Any]:
        """Return the present parameters with those of the world.  Raises ValueError."""
        defaults = {parameter.name: parameter.default for parameter in parameters.TABLE
                    if parameter.name.startswith(OF_A_WORLD)}
        return parameters.checked({**present, **defaults, **self.given})


def scenes() -> Iterator[World]:
    """Yield the installed scenes that can be read."""
    for path in scene_files().values():
        with contextlib.suppress(OSError, ValueError):      # somebody has changed the file
            yield World.read(str(path))
