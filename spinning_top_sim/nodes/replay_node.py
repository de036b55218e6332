# SPDX-License-Identifier: Apache-2.0
"""The command `spinning-top replay`, the executable `replay_node`."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from spinning_top_sim.nodes.executable import run_node, split_ros_arguments
from spinning_top_sim.tools import cli

DESCRIPTION = """\
Publish the messages of a ROS 2 log (.mcap) with their recorded spacing.

  spinning-top replay run.mcap
  spinning-top replay run.mcap --rate 0.5 --loop --clock
  spinning-top replay run.mcap --ros-args -r /pose:=/old/pose
"""

EPILOG = """\
Topics keep their recorded names and QoS, which `--ros-args -r FROM:=TO` and
`-p qos_overrides.<topic>.publisher.<policy>:=...` change. Messages go out in
the order of their log times and with their recorded bytes, old stamps included.

With --clock, or a /clock in the log, time begins anew in each round of --loop.
Without it, stamps are later by the rounds before.

while playing:
  ros2 service call /replay/set_pause std_srvs/srv/SetBool '{data: true}'

exit code: 0 played (also in part: topics left out, ended by a signal),
2 cannot be played, or is damaged
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node with these arguments, by default the program's; return its exit code."""
    return run_node('replay', argv, _prepare)


def _prepare(argv: list[str]) -> tuple[list[str], Callable[[], Any]]:
    parser = cli.Parser('replay', DESCRIPTION, EPILOG)
    add_arguments(parser)
    options = parser.parse_args(split_ros_arguments(argv)[0])
    from spinning_top_sim.nodes.replayer import Replayer, open_log  # noqa: PLC0415
    log = open_log(options.file, options.partial)
    return argv, lambda: Replayer(log, options)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('file', type=Path, metavar='FILE', help='the log')
    add('-r', '--rate', type=float, default=1.0, metavar='R', help='recorded over real time')
    add('-l', '--loop', action='store_true', help='begin again at the end')
    add('--start', type=float, default=0.0, metavar='S',
        help='begin S seconds after the begin of the log')
    add('--topics', nargs='+', default=[], metavar='T',
        help='play these only, by their recorded names')
    add('--clock', type=float, nargs='?', const=40.0, metavar='HZ',
        help="publish the log's time on /clock, HZ times a second (default 40), instead of a "
        'recorded /clock')
    add('--partial', action='store_true', help='play what is whole of a damaged log')
    add('-p', '--start-paused', action='store_true', help='wait for ~/set_pause false')
