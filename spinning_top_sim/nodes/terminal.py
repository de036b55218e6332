# SPDX-License-Identifier: Apache-2.0
"""The status line on the terminal."""

import os
import shutil
import sys


class Terminal:
    """Shows a status line; on a terminal each line overwrites the previous one."""

    def __init__(self) -> None:
        self._open = False              # whether the cursor is at the end of a status line

    def show(self, line: str) -> None:
        """Show a status line as far as it fits on the terminal."""
        if sys.stdout is None or not sys.stdout.isatty():
            self._write(f'{line}\n')
            return
        self._write(f'\r\x1b[K{line[:max(shutil.get_terminal_size().columns - 1, 1)]}')
        self._open = True

    def tell(self, line: str) -> None:
        self.end()
        self._write(f'{line}\n')

    def end(self) -> None:
        if self._open:
            self._open = False
            self._write('\n')

    @staticmethod
    def _write(text: str) -> None:
        try:
            print(text, end='', flush=True)
        except OSError:
            # Nobody reads any more, as in `sim_node | head`; the motion goes on.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)
