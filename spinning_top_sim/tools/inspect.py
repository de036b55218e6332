# SPDX-License-Identifier: Apache-2.0
"""The executable `inspect`: what is in a log, how accurate it is, and pictures of it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools.cli import FAILED, OK, exit_code, print_line, print_report, progress

if TYPE_CHECKING:
    from spinning_top_sim.tools.survey import Survey


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return exit_code(_parser(), argv, _run, (LogError,))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='inspect', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Show what is in a log: topics, gaps, the motions measured from the data\n'
                    'beside the exact ones, drifts, errors.  Reads damaged logs too.',
        epilog='exit codes:\n'
               '  0    no fault was found\n'
               '  1    the file cannot be read or is damaged, --verify found a difference or\n'
               '       could not compute the run, or a picture could not be drawn\n'
               '  2    wrong arguments\n'
               '  130  interrupted\n'
               'The keys of --json are in docs/inspect.md.\n')
    add = parser.add_argument
    add('log', type=Path, help='an MCAP file, of this package or any other')
    add('--plot', type=Path, metavar='FILE',
        help='draw a page of figures (.png, .pdf, .svg); needs matplotlib')
    add('--animate', type=Path, metavar='GIF', help='draw the turning top; needs matplotlib')
    add('--verify', action='store_true',
        help='compute the run again and compare every message byte for byte')
    add('--json', action='store_true', help='print everything as JSON')
    return parser


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
            with progress('verified', (end_ns - begin_ns) / NANOSECONDS, 's',
                          quiet=arguments.json) as show:
                verdict = verify(reader, found.run, end_ns,
                                 lambda stamp_ns: show((stamp_ns - begin_ns) / NANOSECONDS))
    if arguments.json:
        print(json.dumps(as_json(arguments.log, found, verdict), indent=2, allow_nan=False))
    else:
        print_report(as_text(arguments.log, found, verdict))
    passed = found.whole and not found.damage.defects
    if arguments.verify:
        if verdict is None:
            print_line(f'inspect: --verify: {found.foreign_reason}', sys.stderr)
        passed = passed and verdict is not None and verdict.identical
    if arguments.plot is not None or arguments.animate is not None:
        passed = _draw(arguments, found) and passed
    return OK if passed else FAILED


def _draw(arguments: argparse.Namespace, found: Survey) -> bool:
    """Draw the pictures that are asked for; return whether that worked."""
    try:
        if found.shown is None:
            raise ValueError('nothing to draw: no attitude of a top in this log')
        from spinning_top_sim.tools import plots  # noqa: PLC0415

        shown = {}
        if arguments.plot is not None:
            shown[arguments.plot] = plots.draw_page(found, arguments.plot, arguments.log.name)
        if arguments.animate is not None:
            shown[arguments.animate] = plots.animate(found, arguments.animate)
        for path, what in shown.items():
            print_line(f'{path}: {what}', sys.stderr if arguments.json else None)
        return True
    except ImportError as error:
        print_line("inspect: pictures need matplotlib: pip install 'spinning_top_sim[plot]', or "
                   f'apt install python3-matplotlib ({error})', sys.stderr)
    except (OSError, ValueError) as error:
        print_line(f'inspect: {error}', sys.stderr)
    return False


if __name__ == '__main__':
    sys.exit(main())
