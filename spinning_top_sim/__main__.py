# SPDX-License-Identifier: Apache-2.0
"""The command `spinning-top`, which is `python -m spinning_top_sim` as well."""

import argparse
import io
import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from spinning_top_sim.installation import needed

# Name: the module with its `main`, and what it does.
COMMANDS = {
    'node': ('nodes.sim_node', 'simulate a top in real time as a ROS 2 node'),
    'replay': ('nodes.replay_node', 'publish the messages of a log as a ROS 2 node'),
    'simulate': ('tools.simulate', 'simulate a top as fast as possible and write a log or table'),
    'inspect': ('tools.inspect', 'say what is in a log; verify, plot or export it'),
    'recover': ('tools.recover', 'copy what is left of a damaged log'),
    'export': ('tools.export', 'write the top as a model for physics engines'),
    'ensemble': ('tools.ensemble', 'simulate many tops with sampled parameters'),
    'examine': ('exam.command', 'examine an attitude filter'),
    'grade': ('grade.command', 'compare an IMU with the motion of its body; grade a top'),
    'view': ('view.command', 'show a simulation, a running node or a log in the browser'),
}
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    argv = sys.argv[1:] if argv is None else argv
    # Ctrl-C ends it at once during imports, where a KeyboardInterrupt may be lost.
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:        # not where it is ignored
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    for stream in (sys.stdout, sys.stderr):     # they escape what their encoding lacks
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')
    try:
        name = _parser().parse_args(argv[:1]).command
        if name != 'examine':       # where filters of the user run
            # OpenBLAS starts no threads: nothing here multiplies large matrices.
            os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
        with needed('it'):
            command: Callable[[Sequence[str]], int] = import_module(
                f'spinning_top_sim.{COMMANDS[name][0]}').main
    except ImportError as error:
        print(f'spinning-top {name}: {error}', file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGINT, before)
    return command(argv[1:])


def _parser() -> argparse.ArgumentParser:
    from spinning_top_sim.tools.cli import Parser  # noqa: PLC0415
    parser = Parser('', 'Simulate the heavy symmetric top, with exact truth.',
                    'spinning-top COMMAND --help tells the options of a command.')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True,
                                     parser_class=argparse.ArgumentParser)
    for name, (_, what) in COMMANDS.items():
        commands.add_parser(name, help=what, add_help=False)
    return parser


if __name__ == '__main__':
    sys.exit(main())
