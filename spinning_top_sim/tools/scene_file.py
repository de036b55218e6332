# SPDX-License-Identifier: Apache-2.0
"""Reads ROS 2 parameter files and assignments (NAME:=VALUE) without ROS."""

import argparse
import difflib
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial, partialmethod
from pathlib import Path
from typing import Any, NoReturn

import yaml

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli

KINDS = {'scene': 'top and start of a scene', 'imu': 'errors of an IMU'}
NODE = '/spinning_top'      # the full name of the node where no other is asked for
# What most people need comes first in lists.
MOST_USED = ('top.mass', 'top.com_distance', 'top.lambda1', 'top.lambda3', 'initial.theta',
             'spin.l3', 'spin.lz', 'solver.method', 'duration', 'time_scale', 'seed',
             'record.enabled', 'record.uri')


class _Loader(yaml.SafeLoader):
    """Finds the types that rcl finds: 1e5 is a double, 1_000 and ~ are strings."""

    bool_values = yaml.SafeLoader.bool_values | {'y': True, 'n': False}
    yaml_implicit_resolvers: Mapping[str, Any] = {}
    construct_object = partialmethod(yaml.SafeLoader.construct_object, deep=True)   # no recursion


for _type, _pattern in (
        ('null', ''), ('bool', 'y|yes|n|no|true|false|on|off'),
        ('int', r'[-+]?(0x[0-9a-f]+|0[0-7]*|[1-9][0-9]*)'),
        ('float', r'[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?|[-+]?\.?inf|\.?nan')):
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{_type}',
                                  re.compile(f'({_pattern})$', re.IGNORECASE), None)


def add_arguments(parser: argparse.ArgumentParser, *kinds: str) -> None:
    """Add the options --scene and --imu, or one of them."""
    for kind in kinds or KINDS:
        parser.add_argument(
            f'--{kind}', metavar='NAME', type=partial(_name, kind), help=f'{KINDS[kind]}: the '
            'name of one that is installed, or the path of a parameter file; "help" lists the '
            'names')


def _name(kind: str, text: str) -> str:
    """Return the text; "help" prints the names of the installed files and exits, as --help."""
    if text == 'help':
        for stem, path in parameter_files(kind).items():
            # The first sentence of the comment at the head, behind the licence.
            head = ' '.join(line[2:] for line in path.read_text('utf-8').splitlines()[1:5]
                            if line.startswith('# '))
            cli.print_line(f'{stem:20} {head.partition(". ")[0].rstrip(".")}')
        raise SystemExit(cli.OK)
    return text


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the options --scene, --imu, --params and -p."""
    add_arguments(parser)
    parser.add_argument('--params', metavar='FILE', action='append', default=[],
                        help='parameter file as for the node; may be repeated')
    parser.add_argument('-p', '--param', metavar='NAME:=VALUE', action='append', default=[],
                        help='one parameter; may be repeated')
    parser.add_argument('--help-parameters', action=_ListParameters, nargs=0,
                        help='list all parameters, and end')


class _ListParameters(argparse.Action):
    def __call__(self, *_: object) -> NoReturn:
        for name in dict.fromkeys((*MOST_USED, *parameters.BY_NAME)):
            cli.print_line(f'{name}  (default {default_text(name)})')
            for line in textwrap.wrap(parameters.BY_NAME[name].describe(), 74):
                cli.print_line(f'      {line}')
        raise SystemExit(cli.OK)


def default_text(name: str) -> object:
    """Return the default of a parameter as it is shown."""
    default = parameters.BY_NAME[name].default
    return 'unset' if default is None else list(default) if isinstance(default, tuple) else default


def given(arguments: argparse.Namespace, node: str = NODE) -> dict[str, object]:
    """
    Return the parameters that these options give to a node, each checked; the last value holds.

    A namespace is also the prefix of all frames but the world: several tops share one TF tree.

    node : its full name

    Raises as `read_scene`.
    """
    values: dict[str, object] = {}
    named = [file_of(kind, name) for kind in KINDS
             if (name := getattr(arguments, kind)) is not None]
    for path in (*named, *arguments.params):
        values |= read_scene(path, node)
    values |= map(parse_assignment, arguments.param)
    namespace = (getattr(arguments, 'namespace', None) or '').strip('/')
    for name in parameters.FRAMES[1:] if namespace else ():
        frame = str(values.get(name, parameters.BY_NAME[name].default))
        # With a prefix, what is no name of a frame would look like one.
        if frame and not frame.startswith('/'):
            values[name] = f'{namespace}/{frame}'
    return values


def file_of(kind: str, name: str) -> Path:
    """Return a file of the kind scene or imu, given by path or name.  Raises ValueError."""
    files = parameter_files(kind)
    if name not in files and '/' not in name and not name.endswith('.yaml'):
        raise ValueError(f'{kind} {name}: must be the path of a file, or one of '
                         f'{", ".join(files)}{likely_name(name, files)}')
    return files.get(name, Path(name))


def read_scene(path: str | Path, node: str = NODE) -> dict[str, object]:
    """
    Return the parameters of a node in a ROS 2 parameter file, each checked.

    Sections are matched as by rcl: `/**`, `/left/*`, `left: spinning_top:`.  A section
    `spinning_top` or with the last part of the node's name applies in any namespace.

    node : its full name

    Raises OSError, or ValueError, which names the file.
    """
    found, sections = {}, []
    for keys, value in _leaves(parse_yaml(Path(path).read_bytes(), str(path))):
        if 'ros__parameters' in keys[:-1]:
            at = keys.index('ros__parameters')
            sections.append(f'/{"/".join(keys[:at])}'.replace('//', '/'))
            if _fits(sections[-1], node):
                found['.'.join(keys[at + 1:])] = value
    if not found:
        raise ValueError(f"{path} has no parameters for the node {node}: it must have '/**:' or "
                         "'spinning_top:', and 'ros__parameters:' in it; its nodes: "
                         f'{", ".join(dict.fromkeys(sections)) or "none"}')
    return parse_section(found, str(path))


def _leaves(content: object, *keys: str) -> Iterator[tuple[Sequence[str], object]]:
    """Yield the keys that lead to each value in nested mappings, and the value."""
    if isinstance(content, Mapping):
        for key, below in content.items():
            yield from _leaves(below, *keys, str(key))
    else:
        yield keys, content


def _fits(section: str, node: str) -> bool:
    """Return whether a section of a file applies to a node (rcl_yaml_param_parser)."""
    pattern = re.escape(section).replace(r'/\*\*', r'(/\w+)*').replace(r'\*', r'\w+')
    return (re.fullmatch(pattern, node) is not None
            or section in (NODE, f'/{node.rpartition("/")[2]}'))


def parse_section(section: object, source: str) -> dict[str, object]:
    """Return the parameters in nested mappings, each checked.  Raises as `read_scene`."""
    try:
        return dict(_checked('.'.join(keys), value) for keys, value in _leaves(section))
    except ValueError as error:
        raise ValueError(f'{source}: {error}') from None


def parse_assignment(text: str) -> tuple[str, object]:
    """Return name and checked value, which is YAML, of NAME:=VALUE.  Raises ValueError."""
    name, separator, yaml_text = text.partition(':=')
    if not separator:
        raise ValueError(f'{text!r}: must be NAME:=VALUE')
    return _checked(name, parse_yaml(yaml_text, text))


def _checked(name: str, value: object) -> tuple[str, object]:
    """Return a parameter, checked unless rclpy declares it.  Raises ValueError."""
    if parameters.is_of_ros(name):
        return name, value
    if name not in parameters.BY_NAME:
        raise ValueError(f'there is no parameter {name}{likely_name(name)}')
    return name, parameters.BY_NAME[name].check(value)


def parse_yaml(text: str | bytes, source: str) -> object:
    """Return the content of YAML with the types of rcl.  Raises ValueError, as `read_scene`."""
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f'{source} is not YAML: {" ".join(str(error).split())}') from error


def likely_name(name: str, known: Iterable[str] = parameters.BY_NAME, prefix: str = '') -> str:
    """Return a hint at the known names, behind the prefix, that are most like an unknown one."""
    names, asked = list(known), name.removeprefix(prefix)
    near = [one for one in names if all(word in one for word in re.split('[._]', asked))][
        :3] or difflib.get_close_matches(asked, names, 1)
    return f'; did you mean {" or ".join(prefix + one for one in near)}?' if near else ''
