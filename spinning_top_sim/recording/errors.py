# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs, and in reading and recovering logs."""


class RecordingError(Exception):
    """A recording cannot start; the text names the path or type and the reason."""


class DefinitionNotFoundError(RecordingError):
    """The definition of a message type is not installed; the text says where it was sought."""


class LogError(Exception):
    """A log cannot be read or recovered; the text names the path and the reason."""


class LogAccessError(LogError):
    """The file is not there, is no regular file, may not be read, or the disk fails."""


class NotMcapError(LogError):
    """The file is empty or no MCAP file."""


class NothingToSaveError(LogError):
    """A damaged log holds no whole message."""


class OutputError(LogError):
    """The recovered log cannot be written, or its name is taken."""
