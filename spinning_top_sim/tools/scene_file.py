# SPDX-License-Identifier: Apache-2.0
"""Reads ROS 2 parameter files without ROS: the same scenes as the node's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from spinning_top_sim.streams import parameters

# Nodes whose parameters are ours.
NODES = ('/**', 'spinning_top', '/spinning_top', '/**/spinning_top')
# A node has more parameters than ours; those are for ROS alone.
FOREIGN = ('use_sim_time', 'qos_overrides')


def read_scene(path: str | Path) -> dict[str, Any]:
    """
    Return the parameters that a file sets, by their dotted names.

    Raises ValueError naming the file and what is wrong with it.
    """
    try:
        import yaml  # noqa: PLC0415
    except ImportError as error:
        raise ValueError(f'{path}: reading it needs the Python package PyYAML: {error}') from error
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ValueError(f'{path}: {error.strerror}') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f'{path} is no YAML: {" ".join(str(error).split())}') from error
    values: dict[str, Any] = {}
    for node, sections in (content or {}).items() if isinstance(content, Mapping) else ():
        if node in NODES and isinstance(sections, Mapping):
            values.update(_flatten(sections.get('ros__parameters') or {}))
    if not values:
        raise ValueError(f'{path} has no parameters for the node spinning_top: it must have '
                         "'/**:' or 'spinning_top:', and 'ros__parameters:' in it")
    return values


def _flatten(section: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in section.items():
        full = f'{prefix}{name}'
        if full.split('.', maxsplit=1)[0] in FOREIGN:
            continue
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{full}.')
        else:
            yield full, value


def parse_assignment(text: str) -> tuple[str, Any]:
    """Return name and value of NAME:=VALUE, the value read as YAML.  Raises ValueError."""
    import yaml  # noqa: PLC0415

    name, separator, value = text.partition(':=')
    if not separator or name not in parameters.BY_NAME:
        raise ValueError(f'{text!r}: must be NAME:=VALUE with the name of a parameter')
    return name, yaml.safe_load(value)
