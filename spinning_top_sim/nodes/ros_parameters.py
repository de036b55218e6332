# SPDX-License-Identifier: Apache-2.0
"""The parameter table as ROS parameters: descriptors, start values, and checked changes."""

import array
import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import Effect, Parameter
from spinning_top_sim.tools.scene_file import likely_name, parse_yaml

SPIN = ('spin.l3', 'spin.lz')


def declare(node: Node, defaults=()) -> dict[str, Any]:
    """
    Declare the table and return the start values.  Raises ValueError for a bad value.

    Unknown parameters are warned about.  The node must have been made with
    `automatically_declare_parameters_from_overrides`, the public way to learn of them.
    """
    given = {}
    for name in node.get_parameters_by_prefix(''):
        value = node.get_parameter(name).value
        if name == 'use_sim_time' and not isinstance(value, bool):
            raise ValueError(f'{name} = {value!r}: must be true or false')
        if name in {'use_sim_time', 'start_type_description_service'}:
            continue        # rclpy declares these itself
        if name in parameters.BY_NAME:
            given[name] = _as_doubles(parameters.BY_NAME[name], value)
        elif not name.startswith('qos_overrides.'):
            node.get_logger().warning(
                f'there is no parameter {name}: ignored{likely_name(name)}')
        # It is declared with its descriptor below, or by `create_publisher`.
        node.undeclare_parameter(name)
    values = parameters.checked(given)
    shown = {**values, 'spin.lz': parameters.start_state(values).lz}
    node.declare_parameters('', [
        (name, list(value) if isinstance(value, tuple) else value,
         _descriptor(parameters.BY_NAME[name])) for name, value in shown.items()],
        ignore_override=True)
    return values


def _last_given(argv: Sequence[str], node_name: str) -> dict[str, object]:
    """
    Return the last value that the command line gives to each parameter of a node.

    rcl keeps the last value of each type, and of these rclpy prefers an integer to a double.
    """
    last: dict[str, object] = {}
    for flag, text in pairwise(argv):
        tree: Any = {}
        if flag == '--params-file':
            tree = parse_yaml(Path(text).read_bytes(), text)
        elif flag in {'-p', '--param'}:
            rule, _, shown = text.partition(':=')
            node, _, name = rule.rpartition(':')
            tree = {node or '/**': {'ros__parameters': {name: parse_yaml(shown, text)}}}
        for path, value in _leaves(tree):
            nodes, _, name = path.partition('/ros__parameters/')
            pattern = re.escape(nodes).replace(r'/\*\*', r'(/\w+)*').replace(r'\*', r'\w+')
            if re.fullmatch(pattern, node_name):
                last[name.replace('/', '.')] = value
    return last


def _leaves(tree: object, path: str = '') -> Iterator[tuple[str, object]]:
    if isinstance(tree, Mapping):
        for key, below in tree.items():
            yield from _leaves(below, f'{path}/{str(key).strip("/")}')
    else:
        yield path, tree


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows.  Types are dynamic: `Parameter.check` decides."""
    result = ParameterDescriptor(
        name=parameter.name, description=parameter.describe(range_too=False), dynamic_typing=True,
        read_only=parameter.effect is Effect.START,
        additional_constraints=parameter.allowed)
    lowest = parameter.minimum if parameter.above is None else parameter.above
    if lowest is None or parameter.maximum is None:
        return result
    if isinstance(parameter.default, int):
        result.integer_range = [IntegerRange(
            from_value=int(lowest), to_value=int(parameter.maximum))]
    else:               # in a list, the range of each number
        result.floating_point_range = [FloatingPointRange(
            from_value=float(lowest), to_value=float(parameter.maximum))]
    return result


def with_doubles(given: Sequence[RosParameter]) -> list[RosParameter]:
    """Return parameters with doubles made from integers and, as 1e-9 is in YAML 1.1, strings."""
    return [RosParameter(one.name, value=_as_doubles(parameters.BY_NAME[one.name], one.value))
            if one.name in parameters.BY_NAME else one for one in given]


def _as_doubles(parameter: Parameter, value: Any) -> Any:
    if isinstance(value, list | array.array):
        return [_as_doubles(parameter, item) for item in value]
    first = (parameter.default or (0.0,))[0] if isinstance(parameter.default, tuple) else None
    with contextlib.suppress(ValueError):
        if type(value) in {int, str} and (parameter.is_double or isinstance(first, float)):
            return float(value)
    return value


def is_command(changes: Mapping[str, Any]) -> bool:
    """Return whether changes command the spin; beside `initial.*` it is that of the next start."""
    return not changes.keys().isdisjoint(SPIN) and not any(
        name.startswith('initial.') for name in changes)


def changed(values: Mapping[str, Any], changes: Mapping[str, Any],
            start_spin: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the changed values and the spin of the next start.  Raises ValueError."""
    for name, value in changes.items():
        if value is None:
            raise ValueError(f'{name}: cannot be unset while the node runs')
    spin = {name: value for name, value in changes.items() if name in SPIN}
    present, start = {name: values[name] for name in SPIN}, dict(start_spin)
    if is_command(changes):
        present.update(spin)
    else:
        start.update(spin)
    # A reset combines `start` with the other parameters, so they are checked together.  The
    # present spin belongs to the present state, and `TickLoop.command` checks it.
    checked = parameters.checked({**values, **changes, **start})
    return ({**checked, **{name: parameters.BY_NAME[name].check(present[name]) for name in SPIN}},
            {name: checked[name] for name in SPIN})


def disobeyed_overrides(node):
    return []
