# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs, and in reading and recovering logs."""

# What values raise that are not as this package writes them.
MALFORMED = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
MOST_TEXT = 300             # of a reason
MAX_BYTES = 128 << 20       # of one record or one uncompressed chunk in memory


class LogError(RuntimeError):
    """A log cannot be read, written or recovered; the text names the path and the reason."""


def text_of(error: BaseException) -> str:
    """Return the text of an error; that of an OSError as FILE: REASON."""
    if isinstance(error, OSError) and error.filename is not None:
        return f'{error.filename}: {error.strerror}'
    return str(error)


def reason_of(error: Exception) -> str:
    """Return a line about an error: what the system says, or its kind and text."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    text = f'{type(error).__name__}: {error}'
    return text if len(text) <= MOST_TEXT else f'{text[:MOST_TEXT]}...'
