# SPDX-License-Identifier: Apache-2.0
"""The executable `recover`: write what is whole in a truncated or damaged log anew."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from spinning_top_sim.recording.damage import count
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.salvage import recover
from spinning_top_sim.tools.cli import OK, exit_code, print_line, progress

SOME_LOST, TERMINATED = 3, 143
# Smaller files are done before one could read the progress.
PROGRESS_BYTES = 50_000_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    # An exception, so that the unfinished output is removed.
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    try:
        return exit_code(_parser(), argv, _run, (LogError,))
    finally:
        signal.signal(signal.SIGTERM, previous)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='recover', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Write everything that is whole in a truncated or damaged MCAP log into a\n'
                    'new log that every reader takes: chunks as they are, index and summary\n'
                    'made anew.  The old file is only read.',
        epilog='exit codes:\n'
               '  0    everything was kept (index and summary do not count)\n'
               '  1    nothing was written: no whole message in it, no MCAP file, not readable,\n'
               '       or the output exists\n'
               '  2    wrong arguments\n'
               '  3    some was lost: what and how much is printed\n'
               '  130  interrupted: nothing was written\n')
    parser.add_argument('log', type=Path, help='the MCAP file, of this package or any other')
    parser.add_argument(
        '-o', '--output', type=Path, metavar='FILE',
        help='the new file; it must not exist (default: <log>_recovered.mcap beside the log)')
    return parser


def _run(arguments: argparse.Namespace) -> int:
    log: Path = arguments.log
    output: Path = arguments.output or log.with_name(f'{log.stem}_recovered.mcap')
    with LogReader(log) as reader, progress(
            'recovered', reader.size, 'bytes', quiet=reader.size < PROGRESS_BYTES) as show:
        recovered = recover(reader, output, lambda done, total: show(done))
    lossless = recovered.damage.lossless
    for line in recovered.damage.lines():
        print_line(line)
    print_line(f'kept{" all" * lossless}: {count(recovered.messages, "message")} in '
               f'{count(recovered.chunks, "chunk")}, {count(recovered.bytes, "byte")} in '
               f'{recovered.path}')
    return OK if lossless else SOME_LOST


if __name__ == '__main__':
    sys.exit(main())
