# SPDX-License-Identifier: Apache-2.0
"""The executable `sim_node`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from spinning_top_sim.nodes import executable

if TYPE_CHECKING:
    from spinning_top_sim.nodes.simulator import Simulator

USAGE = """usage: sim_node [--help] [--ros-args -p NAME:=VALUE --params-file FILE ...]

Simulate the heavy symmetric top in real time, in namespace and with parameters as usual:

  ros2 run spinning_top_sim sim_node
  ros2 run spinning_top_sim sim_node --ros-args --params-file config/looping.yaml
  ros2 run spinning_top_sim sim_node --ros-args -p spin.l3:=2.0 -p record.enabled:=true

Parameters (a change by `ros2 param set` takes effect as said there):
"""


def main(argv: list[str] | None = None) -> int:
    """Run the node; return 0 after an ordinary end, 2 for what could not be started."""
    return executable.run('sim_node', sys.argv if argv is None else argv, _prepare)


def _prepare(argv: list[str]) -> Callable[[], Simulator] | None:
    if not {'--help', '-h'}.intersection(argv[1:]):
        from spinning_top_sim.nodes.simulator import Simulator  # noqa: PLC0415
        return Simulator
    from spinning_top_sim.streams import parameters  # noqa: PLC0415
    print(USAGE)
    for parameter in parameters.TABLE:
        default = parameter.default
        shown = list(default) if isinstance(default, tuple) else default
        print(f'  {parameter.name}  (default {"unset" if shown is None else shown})\n'
              f'      {parameter.description}')
    return None


if __name__ == '__main__':
    sys.exit(main())
