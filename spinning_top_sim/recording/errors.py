# SPDX-License-Identifier: Apache-2.0
"""What can go wrong before a recording runs, and in reading and recovering logs."""

from dataclasses import dataclass
from pathlib import Path

# What values raise that are not as this package writes them.
MALFORMED = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
MOST_TEXT = 300             # of a reason
MAX_BYTES = 128 << 20       # of one record or one uncompressed chunk in memory


class LogError(RuntimeError):
    """A log cannot be read, written or recovered; the text names the path and the reason."""


@dataclass
class Damage:
    """What is wrong with a log."""

    torn: bool = False          # its summary is missing or wrong
    lost_bytes: int = 0         # that cannot be read; indexes do not count
    changed: bool = False       # what can be read has another checksum than was written

    def lines(self) -> list[str]:
        """Return a line about each kind of damage."""
        return [text for text, is_there in (
            (f'lost: {self.lost_bytes} bytes', self.lost_bytes),
            ('found: the summary at the end is missing or wrong', self.torn),
            ('found: the checksum of the data section is wrong', self.changed)) if is_there]


def text_of(error: BaseException) -> str:
    """Return the text of an error; that of an OSError as FILE: REASON."""
    if isinstance(error, OSError) and error.filename is not None:
        return f'{error.filename}: {error.strerror}'
    return str(error)


def reason_of(error: Exception) -> str:
    """Return a line about an error, with its kind."""
    text = f'{type(error).__name__}: {error}'
    return text if len(text) <= MOST_TEXT else f'{text[:MOST_TEXT]}...'


def why_not_written(path: Path, error: Exception) -> str:
    """Return why a new file cannot be made or written, without the path that OSError adds."""
    if isinstance(error, FileExistsError):
        return 'it exists, and nothing is overwritten'
    if isinstance(error, FileNotFoundError):
        # A directory such as /proc is there, and takes no files.
        reason = 'no files can be made in' if path.parent.is_dir() else 'there is no directory'
        return f'{reason} {path.parent}'
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return f'{type(error).__name__}: {error}'
