# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a log, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class Loss:
    """
    A part of a file that is not used.

    Attributes
    ----------
    offset, bytes : int
        Where it is and its size.
    what : str
        The kind of record it was, as far as that is known.
    reason : str
        Why it is not used.
    start_ns, end_ns : int or None
        The earliest and the latest log time of its messages; None if unknown.
    messages : int or None
        How many it held; None if unknown.
    refused : bool
        It may be right, but it is larger than what is read into memory.

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
    What a scan of a whole file found.

    Attributes
    ----------
    truncated : bool
        The file does not end as an MCAP file ends.
    losses : tuple of Loss
        What is not used, in the order of the file.
    defects : tuple of str
        What is wrong but known from other parts of the file (indexes, summary): nothing is lost.
    messages : mapping of str to int
        Whole messages per topic.
    missing : mapping of str to int
        Lost messages per topic ('' if unknown): exact if `missing_exactly`, else a lower bound
        from gaps in sequence numbers and from the indexes of lost chunks.
    start_ns, end_ns : int
        The earliest and the latest log time of the whole messages; 0 without any.

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
        """Bytes of the file that are not used."""
        return sum(loss.bytes for loss in self.losses)

    @property
    def lost_chunks(self) -> int:
        """Chunks that are not used."""
        return sum(loss.what == 'chunk' for loss in self.losses)

    @property
    def missing_messages(self) -> int:
        """Lost messages: exact if `missing_exactly`, else a lower bound."""
        return sum(self.missing.values())

    @property
    def missing_spans(self) -> tuple[tuple[int, int], ...]:
        """The earliest and the latest log time of each lost chunk [ns]."""
        return tuple((loss.start_ns, loss.end_ns) for loss in self.losses
                     if loss.start_ns is not None and loss.end_ns is not None)

    def lines(self) -> list[str]:
        """Return a human-readable report: the sums if something is lost, then each loss."""
        lines = []
        if any(not loss.refused for loss in self.losses):
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
