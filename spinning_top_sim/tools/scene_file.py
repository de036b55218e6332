# SPDX-License-Identifier: Apache-2.0
"""Reads ROS 2 parameter files and assignments (NAME:=VALUE) without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from spinning_top_sim.streams import parameters

# Names of nodes in a file that stand for the node spinning_top.
NODES = ('/**', 'spinning_top', '/spinning_top', '/**/spinning_top')
# Parameters that every node has; rclpy takes them.
ROS_PARAMETERS = ('use_sim_time', 'qos_overrides')


def read_scene(path: str | Path) -> dict[str, object]:
    """
    Return the parameters that a ROS 2 parameter file sets for the node spinning_top.

    Parameters
    ----------
    path : str or Path
        YAML file.

    Returns
    -------
    dict
        Values by the parameters' dotted names, not checked yet.

    Raises
    ------
    ValueError
        Names the file and what is wrong with it.
    """
    try:
        text = Path(path).read_text(encoding='utf-8')
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise ValueError(f'{path} is not YAML: {error}') from error
    content = _parse_yaml(text, str(path))
    values: dict[str, object] = {}
    for node, sections in content.items() if isinstance(content, Mapping) else ():
        section = sections.get('ros__parameters') if isinstance(sections, Mapping) else None
        if node in NODES and isinstance(section, Mapping):
            values.update(_flatten(section))
    if not values:
        raise ValueError(f'{path} has no parameters for the node spinning_top: it must have '
                         "'/**:' or 'spinning_top:', and 'ros__parameters:' in it")
    return values


def parse_assignment(text: str) -> tuple[str, object]:
    """Return name and value of NAME:=VALUE, the value read as YAML.  Raises ValueError."""
    name, separator, value = text.partition(':=')
    if not separator or name not in parameters.BY_NAME:
        raise ValueError(f'{text!r}: must be NAME:=VALUE with the name of a parameter')
    return name, _parse_yaml(value, text)


def _parse_yaml(text: str, name: str) -> object:
    """Return the content of a YAML text.  Raises ValueError, which begins with the name."""
    try:
        import yaml  # noqa: PLC0415
    except ImportError as error:
        raise ValueError(f'{name}: reading it needs the Python package PyYAML: {error}') from error
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f'{name} is not YAML: {" ".join(str(error).split())}') from error


def _flatten(section: Mapping[str, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    """Yield dotted names and values of the parameters in a section, those of ROS left out."""
    for name, value in section.items():
        full = f'{prefix}{name}'
        if full.split('.', maxsplit=1)[0] in ROS_PARAMETERS:
            continue
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{full}.')
        else:
            yield full, value
