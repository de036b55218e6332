# SPDX-License-Identifier: Apache-2.0
"""The executable `recover`: make a whole log of what is whole in a torn or damaged one."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

ALL_KEPT = 0
FAILED = 1
SOME_LOST = 3
INTERRUPTED = 130
TERMINATED = 143

_PROGRESS_BYTES = 50_000_000  # smaller files are through before one could read it


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    arguments = _parser().parse_args(argv)
    # An exception, so that the unfinished output is removed.
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, previous)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='recover', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Write everything that is whole in a torn or damaged MCAP log into a new log\n'
                    'that every reader takes: chunks as they are, index and summary made anew.\n'
                    'The old file is only read.',
        epilog='exit codes:\n'
               '  0  everything was kept (index and summary do not count)\n'
               '  1  nothing was written: no whole message in it, no MCAP file, not readable, or\n'
               '     the output exists\n'
               '  2  wrong arguments\n'
               '  3  some was lost: what and how much is said\n')
    parser.add_argument('log', type=Path, help='the MCAP file, of this package or any other')
    parser.add_argument(
        '-o', '--output', type=Path, metavar='FILE',
        help='the new file; it must not exist (default: <log>_recovered.mcap beside the log)')
    return parser


def _run(arguments: argparse.Namespace) -> int:
    # Not before: --help needs none of it.
    from spinning_top_sim.recording.damage import count  # noqa: PLC0415
    from spinning_top_sim.recording.errors import LogError  # noqa: PLC0415
    from spinning_top_sim.recording.reader import LogReader  # noqa: PLC0415
    from spinning_top_sim.recording.salvage import recover  # noqa: PLC0415

    log: Path = arguments.log
    output: Path = arguments.output or log.with_name(f'{log.stem}_recovered.mcap')
    try:
        with LogReader(log) as reader:
            recovered = recover(reader, output, _progress(reader.size))
    except LogError as error:
        _say(f'recover: {error}', sys.stderr)
        return FAILED
    damage = recovered.damage
    for line in damage.lines():
        _say(line)
    kept = (f'{count(recovered.messages, "message")} in {count(recovered.chunks, "chunk")}, '
            f'{count(recovered.bytes, "byte")}')
    _say(f'{"kept all" if damage.lossless else "kept"}: {kept} in {recovered.path}')
    return ALL_KEPT if damage.lossless else SOME_LOST


def _say(text: str, stream=None) -> None:
    """Print a line, whatever bytes a file name holds."""
    print(text.encode(errors='backslashreplace').decode(), file=stream or sys.stdout)


def _progress(size: int) -> Callable[[int, int], None]:
    """Return what shows how far a recovery is: for big files, on a terminal, in percent."""
    shown = -1

    def show(done: int, total: int) -> None:
        nonlocal shown
        percent = 100 * done // total
        if percent != shown:
            shown = percent
            end = '\r\033[K' if done == total else ''
            print(f'\r{percent:3d} %{end}', end='', file=sys.stderr, flush=True)

    def be_silent(done: int, total: int) -> None:
        pass

    return show if size >= _PROGRESS_BYTES and sys.stderr.isatty() else be_silent


if __name__ == '__main__':
    sys.exit(main())
