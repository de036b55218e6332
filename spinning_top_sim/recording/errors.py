# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs; later trouble is told by the recorder's `error`."""


class RecordingError(Exception):
    """A recording cannot start; the text names the path or type and the reason."""


class DefinitionNotFoundError(RecordingError):
    """The definition of a message type is not installed; the text says where it was sought."""
