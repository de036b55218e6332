# SPDX-License-Identifier: Apache-2.0
"""The command `spinning-top node`, the executable `sim_node`."""

import argparse
import json
import textwrap
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

from spinning_top_sim.nodes import executable
from spinning_top_sim.streams import parameters

DESCRIPTION = """\
Simulate the heavy symmetric top in real time as a ROS 2 node.

  spinning-top node --scene looping --imu bmi088
  spinning-top node -p spin.l3:=2.0 --ros-args --params-file mine.yaml

Of several values for a parameter that of -p holds, before those of --params,
--imu and --scene; what follows --ros-args overrides all of them.

exit code: 0 ended, also by a signal; 2 cannot start; 130 interrupted before
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node with these arguments, by default the program's; return its exit code."""
    return executable.run_node('node', argv, _prepare)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    from spinning_top_sim.tools import scene_file  # noqa: PLC0415 - YAML takes 10 ms
    scene_file.add_parameters(parser)
    parser.add_argument('--namespace', metavar='NAME', help='of node, topics and frames')


def _prepare(argv: list[str]) -> tuple[list[str], Callable[[], Any]]:
    words, for_ros = executable.split_ros_arguments(argv)
    given: dict[str, object] = {}
    if words:
        from spinning_top_sim.tools import cli, scene_file  # noqa: PLC0415
        parser = cli.Parser('node', DESCRIPTION, textwrap.fill(
            f'Parameters used most (--help-parameters lists all): '
            f'{", ".join(scene_file.MOST_USED)}', 78, subsequent_indent='  '))
        add_arguments(parser)
        arguments = parser.parse_args(words)
        if arguments.namespace:
            for_ros += ['-r', f'__ns:=/{arguments.namespace.strip("/")}']
        given = scene_file.given(arguments, executable.node_name(for_ros))
        for_ros = [*(word for name, value in given.items() if parameters.is_of_ros(name)
                     for word in ('-p', f'{name}:={json.dumps(value)}')), *for_ros]
        argv = ['--ros-args', *for_ros]
    from spinning_top_sim.nodes.node import Simulator  # noqa: PLC0415

    def make_node() -> Any:
        node = Simulator(given)
        if node.values_next['simulation_interfaces'] and find_spec('simulation_interfaces'):
            from spinning_top_sim.nodes import simulation_handlers  # noqa: PLC0415
            simulation_handlers.offer(node)
        return node

    return argv, make_node
