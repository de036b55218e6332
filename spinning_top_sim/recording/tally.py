# SPDX-License-Identifier: Apache-2.0
"""Counts the messages that a scan finds and those that it misses."""

from __future__ import annotations

from mcap.records import Statistics

from spinning_top_sim.recording.chunks import time_span
from spinning_top_sim.recording.damage import Loss
from spinning_top_sim.recording.records import ChunkContents, StoredMessage


class MessageTally:
    """Messages by channel id."""

    def __init__(self) -> None:
        self.found: dict[int, int] = {}     # whole messages
        self.span = 0, 0                    # their earliest and latest log time [ns]
        self.unknown: dict[int, Loss] = {}  # of channels that are unknown, or whose schema is
        self._in_lost_chunks: dict[int, int] = {}
        self._next_sequence: dict[int, int] = {}
        self._gaps: dict[int, int] = {}     # by sequence numbers

    def add(self, contents: ChunkContents, *, numbered: bool) -> None:
        """Count whole messages; `numbered` ones have sequence numbers without gaps."""
        if not contents.messages:
            return
        start, end = time_span(contents.entries)
        if self.found:
            start, end = min(start, self.span[0]), max(end, self.span[1])
        self.span = start, end
        for number, entries in contents.entries.items():
            self.found[number] = self.found.get(number, 0) + len(entries) // 2
        if not numbered:
            return
        following = self._next_sequence
        for _, number, sequence, _, _, _ in contents.messages:
            gap = (sequence - following.get(number, 0)) & 0xFFFFFFFF
            if gap < 1 << 31:  # else it is out of order
                if gap:
                    self._gaps[number] = self._gaps.get(number, 0) + gap
                following[number] = sequence + 1

    def add_unknown(self, offset: int, message: StoredMessage) -> None:
        """Count a message of an unknown channel in the record at this offset."""
        number = message.channel_id
        loss = self.unknown.setdefault(number, Loss(
            offset, 0, f'messages of channel {number}',
            'the record of their channel or schema is lost', messages=0))
        loss.bytes += message.end - message.start
        loss.messages = (loss.messages or 0) + 1

    def add_lost(self, channel_id: int, messages: int) -> None:
        """Count messages of a lost chunk."""
        self._in_lost_chunks[channel_id] = self._in_lost_chunks.get(channel_id, 0) + messages

    def missing(self, statistics: Statistics | None, *, lossless: bool) -> dict[int, int]:
        """Return lost messages: exact with statistics, else a lower bound."""
        if statistics is None:
            missing = {number: max(self._gaps.get(number, 0), self._in_lost_chunks.get(number, 0))
                       for number in {*self._gaps, *self._in_lost_chunks}}
            for number, loss in self.unknown.items():
                missing[number] = missing.get(number, 0) + (loss.messages or 0)
            return missing
        missing = {number: total - self.found.get(number, 0)
                   for number, total in statistics.channel_message_counts.items()}
        if lossless:
            # A whole file that was made of a truncated one still tells what that had lost.
            for number, lost in self._gaps.items():
                missing[number] = missing.get(number, 0) + lost
        return missing
