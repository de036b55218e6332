# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs, and in reading and recovering logs."""

from pathlib import Path


class RecordingError(Exception):
    """A recording cannot start; the text names the path or type and the reason."""


class DefinitionNotFoundError(RecordingError):
    """The definition of a message type is not installed; the text says where it was sought."""


class LogError(Exception):
    """A log cannot be read or recovered; the text names the path and the reason."""


def no_place_in(directory: Path) -> str:
    """Return why a file cannot be made there, where the system says that there is no such file."""
    # A directory such as /proc is there, and takes no files.
    reason = 'no files can be made in' if directory.is_dir() else 'there is no directory'
    return f'{reason} {directory}'
