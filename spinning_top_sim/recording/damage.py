# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a log, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class Loss:
    """
    A piece of a file that cannot be used.

    offset, bytes: where it is and its size
    what: the kind of record it was, as far as that is known;  reason: why it is lost
    start_ns, end_ns: between which log times its messages lay, None where nothing tells
    messages: how many it held, None where nothing tells
    refused: it may be right, but is larger than what is read into memory
    """

    offset: int
    bytes: int
    what: str
    reason: str
    start_ns: int | None = None
    end_ns: int | None = None
    messages: int | None = None
    refused: bool = False

    def __str__(self) -> str:
        text = f'{self.what} at byte {self.offset} ({self.bytes} bytes): {self.reason}'
        if self.start_ns is not None and self.end_ns is not None:
            text += f'; messages from {seconds(self.start_ns)} to {seconds(self.end_ns)}'
        if self.messages is not None:
            text += f'; {count(self.messages, "message")}'
        return text


@dataclass(frozen=True)
class Damage:
    """
    What a look at every byte of a file found.

    truncated: the file does not end as an MCAP file ends
    losses: what cannot be used, in file order
    defects: what is wrong but told by other parts of the file too (indexes, summary): nothing lost
    messages: whole messages by topic
    missing: messages known to have been in the log that are not whole, by topic, none left out
        where `missing_exactly`; by the statistics, else by gaps in the sequence numbers of our
        own files and by the indexes of lost chunks ('' where the topic is unknown)
    start_ns, end_ns: earliest and latest log time of the whole messages; both 0 without any
    """

    truncated: bool
    losses: tuple[Loss, ...] = ()
    defects: tuple[str, ...] = ()
    messages: Mapping[str, int] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    missing_exactly: bool = False
    start_ns: int = 0
    end_ns: int = 0

    @property
    def lossless(self) -> bool:
        """Whether everything that the log is known to have held is there."""
        return not self.losses

    @property
    def lost_bytes(self) -> int:
        """Bytes of the file that cannot be used."""
        return sum(loss.bytes for loss in self.losses)

    @property
    def lost_chunks(self) -> int:
        """Chunks that cannot be used."""
        return sum(loss.what == 'chunk' for loss in self.losses)

    @property
    def missing_messages(self) -> int:
        """Messages known to be missing: all of them where `missing_exactly`, else at least."""
        return sum(self.missing.values())

    @property
    def missing_spans(self) -> tuple[tuple[int, int], ...]:
        """Log times [ns], from and to, between which lost chunks held messages."""
        return tuple((loss.start_ns, loss.end_ns) for loss in self.losses
                     if loss.start_ns is not None and loss.end_ns is not None)

    def lines(self) -> list[str]:
        """Return the report for people: a line of sums where something is lost, then each."""
        lines = []
        if self.losses:
            sums = [count(self.lost_bytes, 'byte')]
            if self.lost_chunks:
                sums.append(count(self.lost_chunks, 'chunk'))
            if self.missing_exactly:
                sums.append(count(self.missing_messages, 'message'))
            elif self.missing_messages:
                sums.append(f'at least {count(self.missing_messages, "message")}')
            else:
                sums.append('an unknown number of messages')
            lines.append(f'lost: {", ".join(sums)}')
            lines += [f'lost: {loss}' for loss in self.losses]
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
