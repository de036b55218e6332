# SPDX-License-Identifier: Apache-2.0
"""The executable `sim_node`."""

import sys
import textwrap
from collections.abc import Callable
from importlib.util import find_spec

from spinning_top_sim.nodes.executable import RunnableNode, run

USAGE = """usage: sim_node [--help] [--version]
                [--ros-args -p NAME:=VALUE --params-file FILE ...]

Simulate the heavy symmetric top in real time.  Of several values for a
parameter, in files or not, the last one on the command line holds.

  ros2 run spinning_top_sim sim_node
  ros2 run spinning_top_sim sim_node --ros-args --params-file looping.yaml
  ros2 run spinning_top_sim sim_node --ros-args -p spin.l3:=2.0

exit code: 0 ended, also by a signal; 2 cannot start; 130 interrupted before

~ is /spinning_top.  Subscribes to:
  ~/commands (std_msgs/Float64MultiArray: [L3, Lz] in kg m^2/s)
Services:
  ~/set_pause, ~/record (std_srvs/SetBool); ~/step, ~/reset (std_srvs/Trigger)
  those of simulation_interfaces, where that package is installed
Publishes, where enabled:
  /diagnostics (diagnostic_msgs/DiagnosticArray), always"""


def main(argv: list[str] | None = None) -> int:
    """Run the node; return its exit code."""
    return run('sim_node', sys.argv if argv is None else argv, _prepare)


def _prepare(argv: list[str]) -> Callable[[], RunnableNode] | None:
    from spinning_top_sim.streams import parameters  # noqa: PLC0415
    if {'--help', '-h'}.intersection(argv[1:]):
        print(USAGE)
        for *_, text in parameters.STREAM_DEFAULTS:
            print(textwrap.fill(text, 78, initial_indent='  ', subsequent_indent=6 * ' '))
        print('Parameters:')
        for parameter in parameters.TABLE:
            default = parameter.default
            shown = list(default) if isinstance(default, tuple) else default
            print(f'  {parameter.name}  (default {"unset" if shown is None else shown})')
            print(textwrap.indent(textwrap.fill(parameter.describe(), 74), 6 * ' '))
        return None
    from rclpy.utilities import remove_ros_args  # noqa: PLC0415
    stray = ' '.join(remove_ros_args(argv)[1:])
    if stray:
        raise ValueError(f'{stray!r} is not expected here; the form is: sim_node --ros-args '
                         '-p NAME:=VALUE --params-file FILE')
    from spinning_top_sim.nodes.simulator import Simulator  # noqa: PLC0415

    def make_node() -> RunnableNode:
        node = Simulator(argv)
        if node.values['simulation_interfaces'] and find_spec('simulation_interfaces'):
            from spinning_top_sim.nodes import simulation_handlers  # noqa: PLC0415
            simulation_handlers.offer(node)
        return node

    return make_node


if __name__ == '__main__':
    sys.exit(main())
