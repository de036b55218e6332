# SPDX-License-Identifier: Apache-2.0
"""The status line on the terminal."""

import shutil
import sys

from spinning_top_sim.tools import cli


class Terminal:
    """Shows a status line; on a terminal each line overwrites the previous one."""

    def __init__(self) -> None:
        self._open = False              # whether the cursor is at the end of a status line

    def show(self, line: str) -> None:
        """Show a status line as far as it fits on the terminal."""
        if sys.stdout is None or not sys.stdout.isatty():
            self.tell(line)
            return
        with cli.reader_may_end(OSError):       # or whose disk is full: the node goes on
            print(f'\r\x1b[K{line[:max(shutil.get_terminal_size().columns - 1, 1)]}', end='')
        self._open = True

    def tell(self, line: str) -> None:
        self.end()
        with cli.reader_may_end(OSError):
            print(line)

    def end(self) -> None:
        if self._open:
            self._open = False
            self.tell('')
