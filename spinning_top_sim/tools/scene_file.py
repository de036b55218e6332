# SPDX-License-Identifier: Apache-2.0
"""Reads ROS 2 parameter files and assignments (NAME:=VALUE) without ROS."""

import argparse
import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.physics.top import shown
from spinning_top_sim.streams import parameters

# Sections of a file that apply to the node spinning_top.
NODES = ('/**', '/*', 'spinning_top', '/spinning_top', '/**/spinning_top')
# Parameters that rclpy declares for every node.
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


class _Loader(yaml.SafeLoader):
    """Resolves plain scalars as rcl does: 1e5 is a double, 1_000 and ~ are strings."""

    def compose_node(self, *place: object) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError('rcl supports no aliases')
        return super().compose_node(*place)


_Loader.bool_values = yaml.SafeLoader.bool_values | {'y': True, 'n': False}
_Loader.yaml_implicit_resolvers = {}
for _type, _pattern in (
        ('null', r''),
        ('bool', r'[yY]|yes|Yes|YES|[nN]|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|'
                 r'off|Off|OFF'),
        ('int', r'[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)'),
        ('float', r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|'
                  r'[-+]?\.?(inf|Inf|INF)|\.?(nan|NaN|NAN)')):
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{_type}', re.compile(f'({_pattern})$'), None)


class _Name(argparse.Action):
    """The name of an installed file; "help" prints the names and exits, as --help does."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 value: Any, option: str | None = None) -> None:
        if value == 'help':
            for stem, path in parameter_files(self.dest).items():
                # The first sentence of the comment at the head, behind the licence.
                text = ' '.join(line[2:] for line in path.read_text('utf-8').splitlines()[1:5]
                                if line.startswith('# '))
                print(f'{stem:20} {text.partition(". ")[0].rstrip(".")}')
            parser.exit()
        setattr(namespace, self.dest, value)


def add_arguments(parser: argparse.ArgumentParser, *kinds: str) -> None:
    """Add the options --scene and --imu, or one of them."""
    for kind, what in (('scene', 'top and start of a scene'), ('imu', 'errors of an IMU')):
        if kind in (kinds or ('scene', 'imu')):
            parser.add_argument(
                f'--{kind}', metavar='NAME', action=_Name, help=f'{what}: the name of one that is '
                'installed, or the path of a parameter file; "help" lists the names')


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the options --scene, --imu, --params and -p."""
    add_arguments(parser)
    parser.add_argument('--params', metavar='FILE', action='append', default=[],
                        help='parameter file as for the node; may be repeated')
    parser.add_argument('-p', '--param', metavar='NAME:=VALUE', action='append', default=[],
                        help='one parameter; may be repeated')


def given(arguments: argparse.Namespace) -> dict[str, object]:
    """Return the parameters that these options give, not checked.  Raises as `read_scene`."""
    values: dict[str, object] = {}
    for content in (*chosen_files(arguments).values(), *map(read_scene, arguments.params)):
        values.update(content)
    values.update((name, value) for name, value in map(parse_assignment, arguments.param)
                  if not is_of_ros(name))
    return values


def chosen_files(arguments: argparse.Namespace) -> dict[Path, dict[str, object]]:
    """Return the files of --scene and --imu with what is in them.  Raises ValueError, OSError."""
    paths = [file_of(kind, name) for kind in ('scene', 'imu')
             if (name := getattr(arguments, kind, None)) is not None]
    return {path: read_scene(path) for path in paths}


def file_of(kind: str, name: str) -> Path:
    """Return a file of the kind scene or imu, given by path or name.  Raises ValueError."""
    files = parameter_files(kind)
    if name not in files and '/' not in name and not name.endswith('.yaml'):
        raise ValueError(f'--{kind} {name}: must be the path of a file, or one of '
                         f'{", ".join(files)}')
    return files.get(name, Path(name))


def read_scene(path: str | Path) -> dict[str, object]:
    """
    Return the parameters of the node spinning_top in a ROS 2 parameter file, not checked.

    Raises OSError, or ValueError, which names the file.
    """
    source = str(path)
    content = parse_yaml(Path(path).read_bytes(), source)
    sections = [node['ros__parameters'] for name, node in content.items()
                if name in NODES and isinstance(node, Mapping) and isinstance(
                    node.get('ros__parameters'), Mapping)] if isinstance(content, Mapping) else []
    if not sections:
        raise ValueError(f'{source} has no parameters for the node spinning_top: it must have '
                         "'/**:' or 'spinning_top:', and 'ros__parameters:' in it")
    return {name: value for section in sections
            for name, value in parse_section(section, source).items()}


def parse_section(section: Mapping[object, object], source: str) -> dict[str, object]:
    """Return the parameters in a mapping, not checked.  Raises ValueError, as `read_scene`."""
    return _known(dict(_flatten(section)), source)


def parse_assignment(text: str) -> tuple[str, object]:
    """Return the name and the value, which is YAML, of NAME:=VALUE.  Raises ValueError."""
    name, separator, yaml_text = text.partition(':=')
    if not separator:
        raise ValueError(f'{text!r}: must be NAME:=VALUE')
    value = parse_yaml(yaml_text, text)
    _known({name: value}, text)
    return name, value


def parse_yaml(text: str | bytes, source: str) -> object:
    """Return the content of YAML with the types of rcl.  Raises ValueError, as `read_scene`."""
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f'{source} is not YAML: {" ".join(str(error).split())}') from error


def _flatten(section: Mapping[object, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    for name, value in section.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


def is_of_ros(name: str) -> bool:
    """Return whether rclpy declares a parameter of this name."""
    return name.partition('.')[0] in ROS_PARAMETERS


def likely_name(name: str) -> str:
    """Return what to say of the parameter whose name is most like an unknown one."""
    near = difflib.get_close_matches(name, parameters.BY_NAME, 1)
    return f'; did you mean {near[0]}?' if near else ''


def _known(values: Mapping[str, object], source: str) -> dict[str, object]:
    """Return the values without those of ROS.  Raises ValueError for unknown parameters."""
    ours = {name: value for name, value in values.items() if not is_of_ros(name)}
    for name, value in ours.items():
        if name not in parameters.BY_NAME:
            raise ValueError(f'{source}: there is no parameter {name}{likely_name(name)}')
        if value is None:
            raise ValueError(f'{source}: {name} has no value')
        if isinstance(value, list) and len(set(map(type, value))) > 1:
            raise ValueError(f'{source}: {name} = {shown(value)}: the items of a list must have '
                             'one type, such as [0.0, 1.5]')
    return ours
