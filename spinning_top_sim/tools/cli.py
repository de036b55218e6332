# SPDX-License-Identifier: Apache-2.0
"""What all tools share: start, exit codes, errors in one line, progress and tables."""

import argparse
import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TextIO

OK, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130         # argparse uses 2, too


def _start(module: str) -> int:
    """Import and run a tool; return its exit code, also if Ctrl-C interrupts the imports."""
    try:
        return importlib.import_module(f'spinning_top_sim.{module}').main()
    except KeyboardInterrupt:
        return INTERRUPTED


# The executables.
simulate, inspect, recover, ensemble, examine = (partial(_start, module) for module in (
    'tools.simulate', 'tools.inspect', 'tools.recover', 'tools.ensemble', 'exam.command'))


def add_version(parser: argparse.ArgumentParser) -> None:
    """Add the option `--version`."""
    from spinning_top_sim.recording.provenance import version  # noqa: PLC0415 - for a fast --help

    parser.add_argument('--version', action='version',
                        version=f'%(prog)s {version("spinning_top_sim")}')


def run(name: str, help_text: str | None, argv: Sequence[str] | None,
        add_arguments: Callable[[argparse.ArgumentParser], object],
        command: Callable[[argparse.Namespace], int], errors: tuple[type[Exception], ...]) -> int:
    """
    Run a command; return its exit code.

    errors : exceptions that are printed as one line; the exit code is then FAILED, or WRONG_USAGE
        for a ValueError
    """
    # If a stream is closed, the next file that is opened would take its descriptor.
    sys.stdout = sys.stdout or open(os.devnull, 'w')    # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, 'w')    # noqa: SIM115
    parser = argparse.ArgumentParser(prog=name, description=help_text,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    add_version(parser)
    arguments = parser.parse_args(argv)
    try:
        code = command(arguments)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of the output, such as a pager, has ended.  Python flushes the output again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except errors as error:
        what = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            what = f'{error.filename}: {error.strerror}'
        print_line(f'{name}: {what}', sys.stderr)
        return WRONG_USAGE if isinstance(error, ValueError) else FAILED
    except KeyboardInterrupt:
        print_line(f'{name}: interrupted', sys.stderr)
        return INTERRUPTED


def printable(text: str) -> str:
    """Return a text in which characters that are not printable are escaped."""
    return ''.join(character if character.isprintable() else
                   character.encode('unicode_escape').decode() for character in text)


def print_line(text: str, file: TextIO | None = None) -> None:
    """Print a line, by default to the standard output; names in it cannot act on a terminal."""
    print(printable(text), file=file or sys.stdout)


@contextlib.contextmanager
def progress(what: str, total: float, unit: str, *, quiet: bool = False,
             ) -> Iterator[Callable[[float], None]]:
    """Show progress as a bar on a terminal; yield what takes what is done."""
    if quiet or not total > 0.0 or not sys.stderr.isatty():
        yield lambda done: None
        return
    from tqdm import tqdm  # noqa: PLC0415 - it takes 50 ms

    with tqdm(total=total, unit=unit, desc=what,
              bar_format='{desc} {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} {unit} '
                         '[{elapsed}<{remaining}]') as bar:
        yield lambda done: bar.update(min(done, total) - bar.n)


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table; all columns but the first are right-aligned."""
    cells = [[*map(printable, row)] for row in (head, *rows)]
    first, *widths = (max(map(len, column)) for column in zip(*cells, strict=True))
    yield from ('', title)
    for name, *numbers in cells:
        aligned = (number.rjust(wide) for number, wide in zip(numbers, widths, strict=True))
        yield '  '.join(('', name.ljust(first), *aligned)).rstrip()
