# SPDX-License-Identifier: Apache-2.0
"""What all tools share: start, exit codes, errors in one line, progress and tables."""

import argparse
import contextlib
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import version
from spinning_top_sim.recording.errors import reason_of, text_of

OK, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130         # argparse uses 2, too


class Parser(argparse.ArgumentParser):
    """The arguments of `spinning-top NAME`; wrong ones are refused in one line."""

    def __init__(self, name: str, description: str | None, epilog: str | None = None) -> None:
        super().__init__(f'spinning-top {name}'.strip(), description=description, epilog=epilog,
                         formatter_class=argparse.RawDescriptionHelpFormatter)
        self.add_argument('--version', action='version', version=f'%(prog)s {version()}')

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_USAGE, printable(f'{self.prog}: {message}; see --help') + '\n')


def run(name: str, help_text: str | None,
        add_arguments: Callable[[argparse.ArgumentParser], object],
        command: Callable[[argparse.Namespace], int], argv: Sequence[str] | None = None) -> int:
    """
    Run the command `spinning-top NAME`; return its exit code: the `main` of its module.

    argv : arguments, by default those of the program

    A ValueError is printed as one line, and the code is WRONG_USAGE; a RuntimeError,
    ArithmeticError, OSError or ImportError likewise, with FAILED.
    """
    parser = Parser(name, help_text)
    add_arguments(parser)
    arguments = parser.parse_args(argv)
    with contextlib.suppress(ValueError):       # not in the main thread
        signal.signal(signal.SIGTERM, signal.default_int_handler)       # as at Ctrl-C
    try:
        return command(arguments)
    except (ValueError, RuntimeError, ArithmeticError, OSError, ImportError) as error:
        print_line(f'{parser.prog}: {text_of(error)}', sys.stderr)
        return WRONG_USAGE if isinstance(error, ValueError) else FAILED
    except KeyboardInterrupt:
        print_line(f'{parser.prog}: interrupted', sys.stderr)
        return INTERRUPTED


@contextlib.contextmanager
def reader_may_end(file: TextIO | None = None) -> Iterator[None]:
    """Ignore, around printing, that the reader of a stream, such as a pager, ends before it."""
    stream = file or sys.stdout
    try:
        yield
        if stream:              # None where the shell has closed it
            stream.flush()
    except BrokenPipeError:     # Python flushes the output again
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def check_output(*paths: Path | None) -> None:
    """Raise ValueError or OSError if these files cannot be made, such as because one exists."""
    given = [path for path in paths if path is not None]
    if len({path.resolve() for path in given}) < len(given):
        raise ValueError(f'{", ".join(map(str, given))}: must be different files')
    for path in given:
        try:
            with new_file(path):
                path.unlink()
        except OSError as error:
            raise OSError(f'cannot write {path}: {reason_of(error)}') from error


def printable(text: str) -> str:
    """Return a text in which characters that are not printable are escaped."""
    return ''.join(character if character.isprintable() else
                   character.encode('unicode_escape').decode() for character in text)


def one_line(value: object) -> str:
    """Return the text of a value as one printable line."""
    return printable(' '.join(str(value).split()))


def print_line(text: str, file: TextIO | None = None) -> None:
    """Print a line, by default to the standard output; names in it cannot act on a terminal."""
    with reader_may_end(file):
        print(printable(text), file=file or sys.stdout)


@contextlib.contextmanager
def progress(what: str, total: float, unit: str, *, quiet: bool = False,
             ) -> Iterator[Callable[[float], None]]:
    """Show progress as a bar on a terminal; yield what takes what is done."""
    if quiet or not total > 0.0 or not sys.stderr.isatty():
        yield lambda done: None
        return
    from tqdm import tqdm  # noqa: PLC0415 - it takes 50 ms

    columns, rows = shutil.get_terminal_size()      # some terminals say 0, where tqdm is silent
    with tqdm(total=total, unit=unit, desc=what, ncols=columns, nrows=rows,
              bar_format='{desc} {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} {unit} '
                         '[{elapsed}<{remaining}]') as bar:
        yield lambda done: bar.update(min(done, total) - bar.n)


def table_lines(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table; all columns but the first are right-aligned."""
    cells = [[*map(printable, row)] for row in (head, *rows)]
    first, *widths = (max(map(len, column)) for column in zip(*cells, strict=True))
    yield from ('', title)
    for name, *numbers in cells:
        aligned = (number.rjust(wide) for number, wide in zip(numbers, widths, strict=True))
        yield '  '.join(('', name.ljust(first), *aligned)).rstrip()
