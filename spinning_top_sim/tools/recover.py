# SPDX-License-Identifier: Apache-2.0
"""
Write everything that is whole in a truncated or damaged MCAP log into a new
log that every reader takes; chunks, index and summary are made anew.
Damaged chunks are left out; where a record has no end, the rest of the file is.
The old file is only read.

exit codes:
  0    everything was kept (index and summary do not count)
  1    nothing was written: no whole message in it, no MCAP file, not readable,
       or the output exists
  2    wrong arguments
  3    some was lost: what and how much is printed
  130  interrupted: nothing was written
"""

import argparse
from functools import partial
from pathlib import Path

from spinning_top_sim.recording.reader import LogReader, recover
from spinning_top_sim.tools import cli


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('log', type=Path, help='the MCAP file, of this package or any other, or a '
                        'folder with one')
    parser.add_argument('-o', '--output', type=Path, metavar='FILE', required=True,
                        help='the new file; it must not exist')


def _run(arguments: argparse.Namespace) -> int:
    with LogReader(arguments.log) as reader:
        cli.check_output(arguments.output)
        messages = recover(reader, arguments.output)
    for line in reader.damage:
        cli.print_line(line)
    is_all = not (reader.lost_bytes or reader.changed)
    cli.print_line(f'{"kept all that it has" if is_all else "kept"}: {messages} messages, '
                   f'{arguments.output.stat().st_size} bytes in {arguments.output}')
    return cli.OK if is_all else 3     # some was lost


main = partial(cli.run, 'recover', __doc__, add_arguments, _run)
