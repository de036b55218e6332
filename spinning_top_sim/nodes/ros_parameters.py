# SPDX-License-Identifier: Apache-2.0
"""The parameter table as ROS parameters: descriptors, start values, and checked changes."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameters import Effect, Parameter

LARGEST = sys.float_info.max
SPIN = ('spin.l3', 'spin.lz')
# Parameters that a node has of itself.
FOREIGN = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows.  Types are checked by us: an int is a double."""
    result = ParameterDescriptor(
        name=parameter.name, description=parameter.description, dynamic_typing=True,
        read_only=parameter.effect is Effect.START,
        additional_constraints=parameter.allowed)
    lowest = parameter.above if parameter.above is not None else parameter.minimum
    if lowest is None and parameter.maximum is None:
        return result
    if parameter.is_double:
        result.floating_point_range = [FloatingPointRange(
            from_value=-LARGEST if lowest is None else float(lowest),
            to_value=LARGEST if parameter.maximum is None else float(parameter.maximum))]
    else:
        result.integer_range = [IntegerRange(
            from_value=-2 ** 63 if lowest is None else int(lowest),
            to_value=2 ** 63 - 1 if parameter.maximum is None else int(parameter.maximum))]
    return result


def start_values(node: Node) -> dict[str, Any]:
    """
    Return the checked parameters that the node was started with; log what is unknown.

    Raises ValueError naming the parameter, its value and what is allowed.
    """
    given = {}
    # rclpy tells the overrides of undeclared parameters nowhere in public.
    for name, override in node._parameter_overrides.items():
        if name in parameters.BY_NAME:
            given[name] = override.value
        elif not name.startswith(FOREIGN):
            near = difflib.get_close_matches(name, parameters.BY_NAME, 1)
            hint = f'; did you mean {near[0]}?' if near else ''
            node.get_logger().warning(f'there is no parameter {name}: ignored{hint}')
    return parameters.checked(given)


def as_ros_value(value: Any) -> Any:
    """Return a value of the table as rclpy takes it."""
    return list(value) if isinstance(value, tuple) else value


def declare(node: Node, values: Mapping[str, Any]) -> None:
    """Declare the whole table with these values."""
    node.declare_parameters('', [
        (name, as_ros_value(values[name]), descriptor(parameter))
        for name, parameter in parameters.BY_NAME.items()], ignore_override=True)


class ParameterChanges:
    """
    Validates changes while the node runs, and hands them over all together or not at all.

    values: as they are;  start_spin: spin.* as the node was started with
    apply(values, changed): called with every parameter's value and the names that changed;
    raises ValueError to refuse.  refused(names): called with what was not to be changed
    """

    def __init__(self, node: Node, values: Mapping[str, Any], start_spin: Mapping[str, Any],
                 apply: Callable[[dict[str, Any], set[str]], None],
                 refused: Callable[[set[str]], None]) -> None:
        self._node, self._apply, self._refused = node, apply, refused
        self.values = dict(values)
        self.start_spin = dict(start_spin)
        self._following = False
        node.add_pre_set_parameters_callback(self._convert)
        node.add_on_set_parameters_callback(self._change)

    def _convert(self, given: list[RosParameter]) -> list[RosParameter]:
        """Make doubles of integers, before rclpy looks at ranges."""
        return [RosParameter(p.name, RosParameter.Type.DOUBLE, float(p.value))
                if p.type_ is RosParameter.Type.INTEGER and p.name in parameters.BY_NAME
                and parameters.BY_NAME[p.name].is_double else p for p in given]

    def _change(self, given: list[RosParameter]) -> SetParametersResult:
        ours = {p.name: p.value for p in given if p.name in parameters.BY_NAME}
        if self._following or not ours:
            return SetParametersResult(successful=True)
        try:
            for name, value in ours.items():
                if value is None:
                    raise ValueError(f'{name}: cannot be unset while the node runs')
            # Whether there is a motion is asked of the start, with its own spin, to which a reset
            # goes back; the spin of now is a command's, and asked where the top is now.
            values = parameters.checked({**self.values, **ours, **self.start_spin})
            values.update({name: parameters.BY_NAME[name].check(ours.get(name, self.values[name]))
                           for name in SPIN})
            self._apply(values, set(ours))
        except (ValueError, RuntimeError) as error:
            self._refused(set(ours))
            return SetParametersResult(successful=False, reason=str(error))
        self.values = values
        return SetParametersResult(successful=True)

    def follow(self, **values: float) -> None:
        """Show values that changed by other ways (a command, a reset), `__` for the dot."""
        named = {name.replace('__', '.'): value for name, value in values.items()}
        self.values.update(named)
        self._following = True
        try:
            self._node.set_parameters([
                RosParameter(name, RosParameter.Type.DOUBLE, value)
                for name, value in named.items()])
        finally:
            self._following = False
