# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def new_file(path: str | Path, mode: str = 'x', *, partial: bool = False) -> Iterator[Any]:
    """
    Open a new file for writing.  If the block raises, it is removed; an OSError names it.

    partial : after another exception than OSError, keep what is written, such as the first rows
        of a table
    """
    try:
        file = open(path, mode, encoding=None if 'b' in mode else 'utf-8')  # noqa: SIM115
    except FileExistsError as error:
        raise FileExistsError(error.errno, f'{error.strerror}, and nothing is overwritten: choose '
                              'a new name', str(path)) from None
    try:
        with file:
            yield file
    except BaseException as error:
        if not partial or isinstance(error, OSError):
            Path(path).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.strerror:   # some have a text only
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
