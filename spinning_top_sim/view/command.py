# SPDX-License-Identifier: Apache-2.0
"""The command `spinning-top view`."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spinning_top_sim.installation import needed
from spinning_top_sim.nodes.executable import run_node, split_ros_arguments
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, scene_file

if TYPE_CHECKING:
    from spinning_top_sim.view.page import Page

DESCRIPTION = """\
Show a top in the browser: its own simulation, that of a running node, or a log.

  spinning-top view --scene wavy             simulates a scene; needs no ROS
  spinning-top view --node                   the running node of a namespace
  spinning-top view run.mcap                 a log
  spinning-top view run.mcap --html a.html   a file that plays by itself

exit code: 0 ended, also by a signal; 1 a log cannot be read, or a file written;
2 wrong arguments, or a node that cannot start
"""
LOOPBACK = '127.0.0.1'
DEFAULT_SCENE = 'cusp'


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    own, for_ros = split_ros_arguments(argv)
    parser = cli.Parser('view', DESCRIPTION)
    add_arguments(parser)
    arguments = parser.parse_args(own)
    if not arguments.node:
        if for_ros:
            parser.error(f'--ros-args {" ".join(for_ros)}: must be with --node')
        return cli.run('view', DESCRIPTION, add_arguments, _show, own)

    def prepare(_: list[str]) -> tuple[list[str], Callable[[], Any]]:
        _check(arguments)
        from spinning_top_sim.view.node import NodeView  # noqa: PLC0415 - it needs ROS
        if arguments.namespace is not None:
            for_ros.extend(('-r', f'__ns:=/{arguments.namespace.strip("/")}'))
        return ['--ros-args', *for_ros], lambda: NodeView(_open_page(arguments, 'spinning_top'))
    return run_node('view', argv, prepare)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('log', nargs='?', type=Path, help='an MCAP file; without: a simulation')
    scene_file.add_parameters(parser)
    add('--node', action='store_true', help='show the running node instead')
    add('--namespace', metavar='NS', help='of the running node')
    add('--port', type=int, help='of the page (default: the first free one from 8080 on)')
    add('--host', default=LOOPBACK,
        help=f'address to serve at (default: {LOOPBACK}, which only this machine reaches)')
    add('--html', type=Path, metavar='FILE',
        help='write a file that plays the first minute of a log, or `duration` (20 s) of a '
             'simulation, without a server, and end')
    add('--no-browser', action='store_true', help='only print the address')


def _check(arguments: argparse.Namespace) -> None:
    """Raise ValueError for arguments that do not go together."""
    kind, foreign = (('a log', ('node', 'namespace', 'scene', 'imu', 'params', 'param'))
                     if arguments.log else
                     ('a node', ('html', 'scene', 'imu', 'params', 'param'))
                     if arguments.node else ('a simulation', ('namespace',)))
    for option in foreign:
        if getattr(arguments, option):
            raise ValueError(f'--{option}: cannot be given for {kind}')
    if arguments.port is not None and not 0 <= arguments.port <= 65535:
        raise ValueError(f'--port {arguments.port}: must be from 0 to 65535')


def _show(arguments: argparse.Namespace) -> int:
    """Show a simulation or a log, or write a file."""
    _check(arguments)
    if arguments.html is not None:
        cli.check_output(arguments.html)
    with needed('the page', 'view'):
        from spinning_top_sim.view import log, player, simulation  # noqa: PLC0415 - slow
    source: log.LogSource | simulation.OwnSimulation
    if arguments.log is not None:
        source = log.LogSource(arguments.log, lambda: _open_page(arguments, arguments.log.name))
    else:
        scene = str(arguments.scene or next(iter(arguments.params), DEFAULT_SCENE))
        values = parameters.checked({'solver.method': 'exact', **scene_file.given(arguments)})
        source = simulation.OwnSimulation(_open_page(arguments, 'spinning top'), scene, values)
    try:
        if arguments.html is None:
            with contextlib.suppress(KeyboardInterrupt):        # its usual end
                source.page.show(source, threading.Event())
        else:
            cli.print_line(f'{arguments.html}: ' + player.write_file(
                arguments.html, source.page, source.player, source.track))
    finally:
        source.page.close()
    return cli.OK


def _open_page(arguments: argparse.Namespace, title: str) -> Page:
    """Return the page, opened in the browser of a desktop.  Raises OSError without a server."""
    with needed('the page', 'view'):
        from spinning_top_sim.view.page import Page  # noqa: PLC0415
    if arguments.html is not None:
        return Page(title, LOOPBACK, 0)
    page = Page(title, arguments.host, arguments.port)
    who = ('only this machine reaches it' if arguments.host == LOOPBACK else
           'whoever reaches this address can watch and command')
    cli.print_line(f'view: {page.address} ({who}), until Ctrl-C')
    sys.stdout.flush()
    if not arguments.no_browser and (os.environ.get('DISPLAY') or os.environ.get(
            'WAYLAND_DISPLAY')):
        webbrowser.open(page.address)
    return page
