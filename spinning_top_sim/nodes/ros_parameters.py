# SPDX-License-Identifier: Apache-2.0
"""The parameter table as ROS parameters: descriptors, start values, and checked changes."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import ANY, Effect, Parameter
from spinning_top_sim.tools.scene_file import likely_name

SPIN = ('spin.l3', 'spin.lz')


def take_overrides(node: Node) -> dict[str, Any]:
    """Return the parameters that a node was started with; these can then be declared."""
    # It was made with `automatically_declare_parameters_from_overrides`.
    found = {name: node.get_parameter(name).value for name in node.get_parameters_by_prefix('')}
    if not isinstance(found['use_sim_time'], bool):
        raise ValueError(f'use_sim_time = {found["use_sim_time"]!r}: must be true or false')
    given = {name: value for name, value in found.items() if name not in parameters.OF_ROS}
    for name in given:
        node.undeclare_parameter(name)
    return given


def declare(node: Node, given: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """
    Declare the table; return the start values.  Raises ValueError for a bad value.

    given : parameters of the command line
    overrides : those of ROS, which hold; unknown ones are warned about
    """
    values = dict(given)
    for name, value in overrides.items():
        if name in parameters.BY_NAME:
            values[name] = value
        elif not name.startswith('qos_overrides.'):
            node.get_logger().warning(f'there is no parameter {name}: ignored{likely_name(name)}')
    values = parameters.checked(values)
    shown = {**values, 'spin.lz': parameters.start_state(values).lz}
    node.declare_parameters('', [
        (name, list(value) if isinstance(value, tuple) else value,
         descriptor(parameters.BY_NAME[name])) for name, value in shown.items()],
        ignore_override=True)
    return values


def warn_of_disobeyed(node: Node, overrides: Iterable[str]) -> None:
    """Warn of each name of qos_overrides that no publisher of a node has used."""
    used = node.get_parameters_by_prefix('qos_overrides')
    for name in overrides:
        if name.startswith('qos_overrides.') and not node.has_parameter(name):
            node.get_logger().warning(
                f'{name} is not obeyed: no publisher has this topic and policy'
                f'{likely_name(name, used, "qos_overrides.")}')


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows.  Types are dynamic: `Parameter.check` decides."""
    numbers, ranges = parameter.range, {}
    if numbers is not ANY and isinstance(parameter.default, int):
        ranges['integer_range'] = [IntegerRange(
            from_value=int(numbers.lowest), to_value=int(numbers.highest))]
    elif numbers is not ANY:        # in a list, the range of each number
        lowest = 0.0 if numbers.has_zero else float(numbers.lowest)
        ranges['floating_point_range'] = [FloatingPointRange(
            from_value=lowest, to_value=float(numbers.highest))]
    return ParameterDescriptor(
        name=parameter.name, description=parameter.describe(range_too=False), dynamic_typing=True,
        read_only=parameter.effect is Effect.START, additional_constraints=parameter.allowed,
        **ranges)


def all_with_types(given: Sequence[RosParameter]) -> list[RosParameter]:
    """Return parameters with the types of the table; what is not allowed stays, to be refused."""
    return [RosParameter(one.name, value=_with_type(one.name, one.value)) for one in given]


def _with_type(name: str, value: Any) -> Any:
    with contextlib.suppress(KeyError, ValueError):
        value = parameters.BY_NAME[name].check(value)
    return list(value) if isinstance(value, tuple) else value
