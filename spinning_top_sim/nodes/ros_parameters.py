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
# Parameters that rclpy declares itself.
OF_RCLPY = ('use_sim_time', 'start_type_description_service')
QOS_OVERRIDES = 'qos_overrides.'


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """
    Return what `ros2 param describe` shows.

    Typing is dynamic because an integer is accepted for a double; `Parameter.check` decides.
    """
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
    Return the checked parameters that a node was started with, and warn of unknown ones.

    Parameters
    ----------
    node
        Made with `automatically_declare_parameters_from_overrides`, the public way to learn of
        overrides that nobody declares.

    Raises
    ------
    ValueError
        For a bad value; the text names the parameter, its value and what is allowed.

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
        elif not name.startswith(QOS_OVERRIDES):
            near = difflib.get_close_matches(name, parameters.BY_NAME, 1)
            hint = f'; did you mean {near[0]}?' if near else ''
            node.get_logger().warning(f'there is no parameter {name}: ignored{hint}')
        # It is declared later, with its descriptor, by `declare` or `create_publisher`.
        node.undeclare_parameter(name)
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
    Validates changes while the node runs; applies all of them together or none.

    Parameters
    ----------
    node
        Has all parameters declared.
    values, start_spin
        The values now, and those of spin.* that the node was started with.
    apply
        Takes all values and the names of those that change; raises ValueError or RuntimeError to
        refuse.
    refused
        Takes the names of a refused change.
    failed
        Takes any other error of `apply`.

    Attributes
    ----------
    values : dict
        The values now, by name.

    """

    def __init__(self, node: Node, values: Mapping[str, Any], start_spin: Mapping[str, Any],
                 *, apply: Callable[[dict[str, Any], set[str]], None],
                 refused: Callable[[set[str]], None],
                 failed: Callable[[Exception], None]) -> None:
        self._node, self._apply, self._refused, self._failed = node, apply, refused, failed
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
            # A reset goes back to the start state with its own spin, so these are checked
            # together.  The present spin belongs to the present state: `apply` checks it.
            values = parameters.checked({**self.values, **ours, **self.start_spin})
            values.update({name: parameters.BY_NAME[name].check(ours.get(name, self.values[name]))
                           for name in SPIN})
            self._apply(values, set(ours))
        except (ValueError, RuntimeError) as error:
            self._refused(set(ours))
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            self._failed(error)
            return SetParametersResult(successful=False, reason=f'{type(error).__name__}: {error}')
        self.values = values
        return SetParametersResult(successful=True)

    def show_spin(self, l3: float, lz: float) -> None:
        """Show the spin [kg m^2/s] that a command or a reset has set."""
        spin = dict(zip(SPIN, (l3, lz), strict=True))
        self.values.update(spin)
        self._following = True
        try:
            self._node.set_parameters([RosParameter(name, RosParameter.Type.DOUBLE, value)
                                       for name, value in spin.items()])
        finally:
            self._following = False
