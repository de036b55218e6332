# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a log, and what is lost of it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Loss:
    """A range of a file that cannot be decoded, or, of 0 bytes, what cannot be understood."""

    offset: int
    bytes: int
    what: str                       # the kind of the record at the offset
    reason: str
    is_chunk: bool = False

    def __str__(self) -> str:
        place = f' at byte {self.offset} ({count(self.bytes, "byte")})' if self.bytes else ''
        return f'lost: {self.what}{place}: {self.reason}'


@dataclass(frozen=True)
class Damage:
    """What a scan of a whole file found."""

    # The file does not end as an MCAP file ends; `torn` in the JSON of `inspect`.
    truncated: bool
    losses: tuple[Loss, ...]        # in the order of the file
    defects: tuple[str, ...]        # what is wrong but costs nothing
    # Exact if `missing_exactly`, by the statistics of the file; else a lower bound, by the message
    # indexes of lost chunks.
    missing_messages: int
    missing_exactly: bool
    # The earliest and the latest log time of the messages that are there; 0 without any.
    start_ns: int
    end_ns: int

    @property
    def lossless(self) -> bool:
        """Whether everything that the log is known to have held is there."""
        return not self.losses and not self.missing_messages

    @property
    def lost_bytes(self) -> int:
        return sum(loss.bytes for loss in self.losses)

    @property
    def lost_chunks(self) -> int:
        return sum(loss.is_chunk for loss in self.losses)

    def lines(self) -> list[str]:
        """Return a human-readable report: the sums if something is lost, then each loss."""
        lines = []
        if not self.lossless:
            number = count(self.missing_messages, 'message')
            lines.append(f'lost: {count(self.lost_bytes, "byte")}, ' + (
                number if self.missing_exactly else f'at least {number}' if self.missing_messages
                else 'an unknown number of messages'))
        return [*lines, *map(str, self.losses), *(f'found: {defect}' for defect in self.defects)]


def count(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f'{number} {noun}{"" if number == 1 else "s"}'
