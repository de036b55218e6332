# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs, and in reading and recovering logs."""


class RecordingError(Exception):
    """A recording cannot start; the text names the path or type and the reason."""


class DefinitionNotFoundError(RecordingError):
    """The definition of a message type is not installed; the text says where it was sought."""


class LogError(Exception):
    """A log cannot be read or recovered; the text names the path and the reason."""
