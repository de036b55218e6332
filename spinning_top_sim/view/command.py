# SPDX-License-Identifier: Apache-2.0
"""The command `spinning-top view`."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from spinning_top_sim.installation import needed
from spinning_top_sim.nodes.executable import (
    RunnableNode,
    node_name,
    run_node,
    split_ros_arguments,
)
from spinning_top_sim.tools import cli, scene_file

if TYPE_CHECKING:
    from spinning_top_sim.view.page import Page

DESCRIPTION = """\
Show a top in the browser: the one that a node simulates, or those of logs.

  spinning-top view --scene wavy             starts a node, and shows it
  spinning-top view                          a running node of this namespace
  spinning-top view run.mcap                 a log; needs no ROS, and may be of another program
  spinning-top view rk45.mcap exact.mcap     side by side, or one over the other
  spinning-top view run.mcap --html a.html   a file that opens without this program

exit code: 0 ended, also by a signal; 1 a log cannot be read, or a file written;
2 cannot be started, or wrong arguments; 130 interrupted before
"""
LOOPBACK = '127.0.0.1'
LAST_PORT = 65535


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    words, for_ros = split_ros_arguments(argv)
    parser = cli.Parser('view', DESCRIPTION)
    add_arguments(parser)
    arguments = parser.parse_args(words)
    if arguments.log:
        return cli.run('view', DESCRIPTION, add_arguments, _show_logs, words)
    with contextlib.ExitStack() as stack:
        return run_node('view', argv, partial(_prepare, stack, arguments, for_ros))


@contextlib.contextmanager
def _node(options: Sequence[str], for_ros: Sequence[str]) -> Iterator[None]:
    """Run a node with these options while the page is shown."""
    node = subprocess.Popen([
        sys.executable, '-m', 'spinning_top_sim', 'node', *options,
        '--ros-args', *for_ros, '-p', 'status_period:=0.0'])
    try:
        yield
    finally:
        node.terminate()
        try:
            node.wait(10.0)
        except subprocess.TimeoutExpired:
            node.kill()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add('log', nargs='*', type=Path, help='one or two MCAP files; without: a running node')
    scene_file.add_parameters(parser)
    add('--port', type=int, help='of the page (default: the first free one from 8080 on)')
    add('--host', default=LOOPBACK,
        help=f'address to serve at (default: {LOOPBACK}, which only this machine reaches)')
    add('--html', type=Path, metavar='FILE',
        help='write the first minute of the logs, up to a reset to another top, as a page that '
             'needs no server, and end')
    add('--no-browser', action='store_true', help='only print the address')


def _show_logs(arguments: argparse.Namespace) -> int:
    if len(arguments.log) > 2:
        raise ValueError(f'{len(arguments.log)} logs: must be one or two')
    for option, values in (('--scene', [arguments.scene]), ('--imu', [arguments.imu]),
                           ('--params', arguments.params), ('-p', arguments.param)):
        for value in filter(None, values):
            raise ValueError(f'{option} {value}: must be without a log, which has its own')
    if arguments.html is not None:
        cli.check_output(arguments.html)
    with needed('the page', 'view'):
        from spinning_top_sim.view.log import Player, read_logs  # noqa: PLC0415
    logs = read_logs(arguments.log)
    page = _open_page(arguments, ' and '.join(log.name for log in arguments.log))
    try:
        player = Player(page, logs)
        if arguments.html is not None:
            cli.print_line(f'{arguments.html}: {player.write_html(arguments.html)}')
        else:
            with contextlib.suppress(KeyboardInterrupt):
                player.play()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        page.close()
    return cli.OK


def _open_page(arguments: argparse.Namespace, title: str) -> Page:
    """
    Return the page; print its address, and open it in the browser if there is a desktop.

    Raises ValueError for a wrong port, and OSError if the server cannot start.
    """
    if arguments.port is not None and not 0 <= arguments.port <= LAST_PORT:
        raise ValueError(f'--port {arguments.port}: must be from 0 to {LAST_PORT}')
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


def _prepare(stack: contextlib.ExitStack, arguments: argparse.Namespace, for_ros: Sequence[str],
             argv: list[str]) -> tuple[list[str], Callable[[], RunnableNode]]:
    """Return what opens the page; a node of a scene or IMU runs until `stack` is closed."""
    if arguments.html is not None:
        raise ValueError(f'--html {arguments.html}: must have a log')
    scene_file.given(arguments, node_name(for_ros))     # raises for what the node would refuse
    options = [word for option, values in (
        ('--params', scene_file.chosen_files(arguments)), ('-p', arguments.param))
        for value in values for word in (option, str(value))]
    from spinning_top_sim.view.live import LiveView  # noqa: PLC0415

    def make_node() -> RunnableNode:
        view = LiveView(_open_page(arguments, 'spinning_top'))
        if options:
            stack.enter_context(_node(options, for_ros))
        return view
    return argv, make_node
