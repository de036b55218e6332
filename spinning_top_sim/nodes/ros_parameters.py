# SPDX-License-Identifier: Apache-2.0
"""The parameter table as ROS parameters: descriptors, start values, and checked changes."""

from __future__ import annotations

import array
import contextlib
import difflib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameters import Effect, Parameter

SPIN = ('spin.l3', 'spin.lz')


def overrides(argv: Sequence[str]) -> list[str]:
    """
    Return the `-p NAME:=VALUE` of a command line, as arguments for the node alone.

    There they win.  Among those of the process, rcl drops a double that overrides an integer.
    """
    return ['--ros-args', *(word for flag, rule in pairwise(argv) if flag in {'-p', '--param'}
                            for word in (flag, rule))]


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows; dynamic types, as `Parameter.check` decides."""
    result = ParameterDescriptor(
        name=parameter.name, description=parameter.describe(range_too=False), dynamic_typing=True,
        read_only=parameter.effect is Effect.START)
    lowest = parameter.minimum if parameter.above is None else parameter.above
    if lowest is None or parameter.maximum is None:
        result.additional_constraints = parameter.allowed
        return result
    if parameter.above is not None:
        result.additional_constraints = f'must be > {parameter.above:g}'
    elif parameter.smallest is not None:
        result.additional_constraints = f'must be 0 or >= {parameter.smallest:g}'
    if isinstance(parameter.default, int):
        result.integer_range = [IntegerRange(
            from_value=int(lowest), to_value=int(parameter.maximum))]
    else:               # a list of numbers has the range of each
        result.floating_point_range = [FloatingPointRange(
            from_value=float(lowest), to_value=float(parameter.maximum))]
    return result


def declare(node: Node) -> dict[str, Any]:
    """
    Declare the table, warn of unknown parameters; return the start values or raise ValueError.

    The node was made with `automatically_declare_parameters_from_overrides`, the public way to
    learn of overrides that nobody declares.
    """
    given = {}
    for name in node.get_parameters_by_prefix(''):
        value = node.get_parameter(name).value
        if name == 'use_sim_time' and not isinstance(value, bool):
            raise ValueError(f'{name} = {value!r}: must be true or false')
        if name in {'use_sim_time', 'start_type_description_service'}:
            continue        # rclpy declares these itself
        if name in parameters.BY_NAME:
            given[name] = list(value) if isinstance(value, array.array) else value
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
    """Make doubles where the table has some: of integers, and of texts, as YAML 1.1 has 1e-9."""
    result = []
    for one in given:
        row, value = parameters.BY_NAME.get(one.name), one.value
        if row is not None and row.is_double:
            value = _as_double(value)
        elif row is not None and isinstance(value, list | array.array):
            of_doubles = isinstance(row.default, tuple) and isinstance(row.default[0], float)
            value = [_as_double(item) if of_doubles else item for item in value]
        result.append(one if value is one.value else RosParameter(one.name, value=value))
    return result


def _as_double(value: object) -> object:
    with contextlib.suppress(ValueError):
        return float(value) if type(value) in {int, str} else value     # type: ignore[arg-type]
    return value


def changed(values: Mapping[str, Any], changes: Mapping[str, Any],
            start_spin: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with changes put in, all validated.  Raises ValueError."""
    for name, value in changes.items():
        if value is None:
            raise ValueError(f'{name}: cannot be unset while the node runs')
    # A reset goes back to the start state with `start_spin`, so these are checked together.  The
    # present spin belongs to the present state: whether there is such a motion shows the command.
    checked = parameters.checked({**values, **changes, **start_spin})
    return {**checked, **{name: parameters.BY_NAME[name].check(changes.get(name, values[name]))
                          for name in SPIN}}
