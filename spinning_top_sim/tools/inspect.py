# SPDX-License-Identifier: Apache-2.0
"""
Show what is in a log: topics, gaps, the motions measured from the data beside
the exact ones, drifts, errors.  Reads damaged logs too.

exit codes:
  0    no fault was found
  1    the file cannot be read or is damaged, --verify found a difference or
       could not compute the run, or a picture could not be drawn
  2    wrong arguments
  130  interrupted
The keys of --json are in docs/inspect.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools import cli

if TYPE_CHECKING:
    from spinning_top_sim.tools.survey import Survey


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return cli.run('inspect', __doc__, argv, _add_arguments, _run, (LogError,))


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('log', type=Path, help='an MCAP file, of this package or any other')
    add('--plot', type=Path, metavar='FILE',
        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib')
    add('--animate', type=Path, metavar='GIF', help='draw the turning top; needs matplotlib')
    add('--verify', action='store_true',
        help='compute the run again and compare every message byte for byte')
    add('--json', action='store_true', help='print everything as JSON')


def _run(arguments: argparse.Namespace) -> int:
    # Not before: --help needs none of it.
    from spinning_top_sim.recording.reader import LogReader  # noqa: PLC0415
    from spinning_top_sim.tools.report import as_json, as_text  # noqa: PLC0415
    from spinning_top_sim.tools.survey import survey  # noqa: PLC0415
    from spinning_top_sim.tools.verify import verify  # noqa: PLC0415

    verdict = None
    with LogReader(arguments.log) as reader:
        found = survey(reader)
        if arguments.verify and found.run is not None:
            begin_ns, end_ns = found.damage.start_ns, found.end_ns
            with cli.progress('verified', (end_ns - begin_ns) / NANOSECONDS, 's',
                          quiet=arguments.json) as show:
                verdict = verify(reader, found.run, end_ns,
                                 lambda stamp_ns: show((stamp_ns - begin_ns) / NANOSECONDS))
    if arguments.json:
        print(json.dumps(as_json(found, verdict), indent=2, allow_nan=False))
    else:
        for line in as_text(found, verdict):
            cli.print_line(line)
    passed = found.whole and not found.damage.defects
    if arguments.verify:
        if verdict is None:
            cli.print_line(f'inspect: --verify: {found.foreign_reason}', sys.stderr)
        passed = passed and verdict is not None and verdict.identical
    if arguments.plot is not None or arguments.animate is not None:
        passed = _draw(arguments, found) and passed
    return cli.OK if passed else cli.FAILED


def _draw(arguments: argparse.Namespace, found: Survey) -> bool:
    """Draw the pictures that are asked for; return whether that worked."""
    try:
        if found.shown is None:
            raise ValueError('nothing to draw: no attitude of a top in this log')
        from spinning_top_sim.tools import plots  # noqa: PLC0415

        for path, draw in ((arguments.plot, plots.draw_page), (arguments.animate, plots.animate)):
            if path is not None:
                shown = draw(found, path)
                cli.print_line(f'{path}: {shown}', sys.stderr if arguments.json else None)
        return True
    except ImportError as error:
        reason = ("pictures need matplotlib: pip install 'spinning_top_sim[plot]', or "
                  f'apt install python3-matplotlib ({error})')
    except (OSError, ValueError) as error:
        reason = str(error)
    cli.print_line(f'inspect: {reason}', sys.stderr)
    return False


if __name__ == '__main__':
    sys.exit(main())
