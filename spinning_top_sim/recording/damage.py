# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a log, in numbers and in words."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass
class Loss:
    """A part of a file that is not used, as far as is known what it was."""

    offset: int
    bytes: int
    what: str                       # the kind of record
    reason: str
    start_ns: int | None = None     # the earliest log time of its messages
    end_ns: int | None = None       # the latest
    messages: int | None = None     # how many it held
    refused: bool = False           # not read, as it is larger than `max_bytes`; may be right

    def __str__(self) -> str:
        text = f'{self.what} at byte {self.offset} ({self.bytes} bytes): {self.reason}'
        if self.start_ns is not None and self.end_ns is not None:
            text += f'; messages from {seconds(self.start_ns)} to {seconds(self.end_ns)}'
        if self.messages is not None:
            text += f'; {count(self.messages, "message")}'
        return text


@dataclass(frozen=True)
class Damage:
    """What a scan of a whole file found."""

    truncated: bool                 # the file does not end as an MCAP file ends
    losses: tuple[Loss, ...]        # in the order of the file
    defects: tuple[str, ...]        # what is wrong but known from elsewhere in the file
    # Lost messages per topic ('' if unknown): exact if `missing_exactly`, else a lower bound from
    # gaps in sequence numbers and from the indexes of lost chunks.
    missing: Mapping[str, int]
    missing_exactly: bool
    # The earliest and the latest log time of the whole messages; 0 without any.
    start_ns: int
    end_ns: int

    @property
    def lossless(self) -> bool:
        """Whether everything that the log is known to have held is there."""
        return not self.losses

    @property
    def lost_bytes(self) -> int:
        return sum(loss.bytes for loss in self.losses)

    @property
    def lost_chunks(self) -> int:
        return sum(loss.what == 'chunk' for loss in self.losses)

    @property
    def missing_messages(self) -> int:
        return sum(self.missing.values())

    def lines(self) -> list[str]:
        """Return a human-readable report: the sums if something is lost, then each loss."""
        lines = []
        if any(not loss.refused for loss in self.losses):
            sums = [count(self.lost_bytes, 'byte')]
            if self.lost_chunks:
                sums.append(count(self.lost_chunks, 'chunk'))
            if self.missing_exactly or self.missing_messages:
                least = '' if self.missing_exactly else 'at least '
                sums.append(least + count(self.missing_messages, 'message'))
            else:
                sums.append('an unknown number of messages')
            lines.append(f'lost: {", ".join(sums)}')
        lines += [f'{"refused" if loss.refused else "lost"}: {loss}' for loss in self.losses]
        if self.losses:
            lines += [f'lost: {count(number, "message")} of {topic or "unknown topics"}'
                      for topic, number in self.missing.items() if number]
        elif self.missing_messages:
            lines.append(f'lost before: {count(self.missing_messages, "message")} '
                         f'by the gaps in their sequence numbers')
        lines += [f'found: {defect}' for defect in self.defects]
        return lines


def count(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f'{number} {noun}{"" if number == 1 else "s"}'


def seconds(time_ns: int) -> str:
    """Return a stamp in seconds to the nanosecond, exactly."""
    return f'{time_ns // 10 ** 9}.{time_ns % 10 ** 9:09d} s'
