# SPDX-License-Identifier: Apache-2.0
"""What the executables share: exit codes, errors in one line, progress, and tables of text."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TextIO

from tqdm import tqdm

OK = 0
FAILED = 1
INTERRUPTED = 130

# Where there is no terminal to ask for its width.
TEXT_WIDTH = 118
# Between the columns of a table, and before the first.
GAP = '  '


def exit_code(name: str, command: Callable[[], int],
              errors: tuple[type[Exception], ...]) -> int:
    """
    Run a command; return its code, FAILED after one of `errors`, INTERRUPTED after Ctrl-C.

    name : of the executable, before each error that is printed
    errors : those of the user's input or of the system, told in one line
    """
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of the output, such as a pager, has ended.  Python flushes it once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except errors as error:
        what = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            what = f'{error.filename}: {error.strerror}'
        print_line(f'{name}: {what}', sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print_line(f'{name}: interrupted', sys.stderr)
        return INTERRUPTED


def print_line(text: str, file: TextIO | None = None) -> None:
    """Print a line, by default to the standard output, whatever bytes a file name holds."""
    print(text.encode(errors='backslashreplace').decode(), file=file or sys.stdout)


@contextlib.contextmanager
def progress(what: str, total: float, unit: str, *, quiet: bool = False,
             ) -> Iterator[Callable[[float], None]]:
    """
    Show a bar on a terminal, nothing elsewhere; yield what takes the amount done so far.

    what : what is being done, such as 'simulated'
    total : amount at the end, in `unit`
    """
    # None: no bar where there is no terminal.
    with tqdm(total=total, unit=unit, desc=what, disable=quiet or not total > 0.0 or None,
              bar_format='{desc} {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} {unit} '
                         '[{elapsed}<{remaining}]') as bar:
        yield lambda done: bar.update(min(done, total) - bar.n)


@dataclass(frozen=True)
class Table:
    """A table of text.  The first column is aligned to the left, the others to the right."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def lines(self, width: int) -> Iterator[str]:
        """Yield the table's lines, at most `width` characters long where its words allow it."""
        cells = [list(self.head), *map(list, self.rows)]
        columns = list(zip(*cells, strict=True))
        widths = [max(map(len, column)) for column in columns]
        least = [max(len(line) for cell in column for line in _wrapped(cell, 1))
                 for column in columns]
        excess = sum(widths) + len(GAP) * len(widths) - width
        # The columns that are wider than their longest word give way, the widest first.
        for number in sorted(range(len(widths)), key=lambda number: -widths[number]):
            narrowed = max(widths[number] - max(excess, 0), least[number])
            excess -= widths[number] - narrowed
            widths[number] = narrowed
        yield from ('', self.title)
        for row in cells:
            wrapped = [_wrapped(cell, wide) for cell, wide in zip(row, widths, strict=True)]
            for line in itertools.zip_longest(*wrapped, fillvalue=''):
                yield GAP + GAP.join(
                    cell.ljust(wide) if number == 0 else cell.rjust(wide)
                    for number, (cell, wide) in enumerate(zip(line, widths, strict=True))
                ).rstrip()


def _wrapped(text: str, width: int) -> list[str]:
    """Return the lines of a text, broken after slashes and spaces only."""
    lines = ['']
    for piece in re.split('(?<=[/ ])', text):
        if len(lines[-1] + piece.rstrip()) > width and lines[-1]:
            lines.append('')
        lines[-1] += piece
    return [line.rstrip() for line in lines]


def print_report(content: Iterable[str | Table]) -> None:
    """Print lines and tables, as wide as the terminal."""
    width = TEXT_WIDTH
    if sys.stdout.isatty():
        width = shutil.get_terminal_size((TEXT_WIDTH, 0)).columns
    for item in content:
        for line in [item] if isinstance(item, str) else item.lines(width):
            print_line(line)
