# SPDX-License-Identifier: Apache-2.0
"""The parameter table as ROS parameters: descriptors, start values, and checked changes."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameters import Effect, Parameter

SPIN = ('spin.l3', 'spin.lz')
# Parameters that rclpy declares itself.
OF_RCLPY = ('use_sim_time', 'start_type_description_service')


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """
    Return what `ros2 param describe` shows.

    Typing is dynamic because an integer is accepted for a double; `Parameter.check` decides.
    """
    result = ParameterDescriptor(
        name=parameter.name, description=parameter.description, dynamic_typing=True,
        read_only=parameter.effect is Effect.START,
        additional_constraints=parameter.allowed)
    lowest = parameter.minimum if parameter.above is None else parameter.above
    bounds = {'from_value': lowest, 'to_value': parameter.maximum}
    given = {name: bound for name, bound in bounds.items() if bound is not None}
    if given and not isinstance(parameter.default, int):
        result.floating_point_range = [FloatingPointRange(
            **{'from_value': -sys.float_info.max, 'to_value': sys.float_info.max, **given})]
    elif given:
        result.integer_range = [IntegerRange(
            **{'from_value': -2 ** 63, 'to_value': 2 ** 63 - 1, **given})]
    return result


def declare(node: Node) -> dict[str, Any]:
    """
    Declare the whole table, warn of unknown parameters, and return the checked start values.

    The node was made with `automatically_declare_parameters_from_overrides`, the public way to
    learn of overrides that nobody declares.  Raises ValueError for a bad value.
    """
    given = {}
    for name in node.get_parameters_by_prefix(''):
        value = node.get_parameter(name).value
        if name == 'use_sim_time' and not isinstance(value, bool):
            raise ValueError(f'{name} = {value!r}: must be true or false')
        if name in OF_RCLPY:
            continue
        if name in parameters.BY_NAME:
            given[name] = value
        elif not name.startswith('qos_overrides.'):
            near = difflib.get_close_matches(name, parameters.BY_NAME, 1)
            hint = f'; did you mean {near[0]}?' if near else ''
            node.get_logger().warning(f'there is no parameter {name}: ignored{hint}')
        # It is declared with its descriptor, below or by `create_publisher`.
        node.undeclare_parameter(name)
    values = parameters.checked(given)
    shown = {**values, 'spin.lz': parameters.start_state(values).lz}
    node.declare_parameters('', [
        (name, list(value) if isinstance(value, tuple) else value,
         _descriptor(parameters.BY_NAME[name])) for name, value in shown.items()],
        ignore_override=True)
    return values


def with_doubles(given: Sequence[RosParameter]) -> list[RosParameter]:
    """Make doubles of integers where the table has doubles, before rclpy looks at ranges."""
    return [RosParameter(p.name, RosParameter.Type.DOUBLE, float(p.value))
            if p.type_ is RosParameter.Type.INTEGER and p.name in parameters.BY_NAME
            and parameters.BY_NAME[p.name].is_double else p for p in given]


def changed(values: Mapping[str, Any], changes: Mapping[str, Any],
            start_spin: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the values with changes put in, all validated.  Raises ValueError.

    A reset goes back to the start state with `start_spin`, so these are checked together.  The
    present spin belongs to the present state: whether there is such a motion shows the command.
    """
    for name, value in changes.items():
        if value is None:
            raise ValueError(f'{name}: cannot be unset while the node runs')
    checked = parameters.checked({**values, **changes, **start_spin})
    return {**checked, **{name: parameters.BY_NAME[name].check(changes.get(name, values[name]))
                          for name in SPIN}}
