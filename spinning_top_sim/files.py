# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def new_file(path: str | Path, mode: str = 'x') -> Iterator[Any]:
    """Open a new file.  An OSError in writing it names it, and removes it: it is not whole."""
    file = open(path, mode, encoding=None if 'b' in mode else 'utf-8')  # noqa: SIM115
    try:
        with file:
            yield file
    except OSError as error:
        Path(path).unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error
