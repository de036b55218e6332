# SPDX-License-Identifier: Apache-2.0
"""Counts the messages that a scan of a log finds, and those that the log has lost."""

from collections import Counter

from spinning_top_sim.recording.chunks import time_span
from spinning_top_sim.recording.damage import Loss
from spinning_top_sim.recording.records import ChunkContents
from spinning_top_sim.recording.summary import Summary


class MessageCounts:
    """
    Messages by channel id, of a file with this summary.

    found : in what `count` was given, without those of unknown channels
    unknown : those of channels that nothing has declared so far, as losses
    in_lost_chunks : in damaged chunks, by their message indexes
    start_ns, end_ns : earliest and latest log time of those found
    """

    def __init__(self, summary: Summary, *, ours: bool) -> None:
        self._summary = summary
        self._ours = ours       # numbered without gaps
        self.found: Counter[int] = Counter()
        self.unknown: dict[int, Loss] = {}
        self.in_lost_chunks: Counter[int] = Counter()
        self.start_ns, self.end_ns = 1 << 64, 0
        self._gaps: Counter[int] = Counter()    # in the sequence numbers
        self._next_sequence: dict[int, int] = {}

    def count(self, offset: int, contents: ChunkContents) -> None:
        """Count messages, and remove those of unknown channels."""
        unknown = {number for number in contents.entries if not self._summary.knows(number)}
        for message in contents.messages() if unknown or self._ours else ():
            number = message.channel_id
            if number in unknown:
                loss = self.unknown.setdefault(number, Loss(
                    offset, 0, f'messages of channel {number}',
                    'the record of their channel or schema is lost', messages=0))
                loss.bytes += len(message.data)
                loss.messages = (loss.messages or 0) + 1
            elif self._ours:
                gap = (message.sequence - self._next_sequence.get(number, 0)) & 0xFFFFFFFF
                if gap < 1 << 31:  # else it is out of order
                    self._gaps[number] += gap
                    self._next_sequence[number] = message.sequence + 1
        for number in unknown:
            del contents.entries[number]
            contents.right = False
        for number, entries in contents.entries.items():
            self.found[number] += len(entries) // 2
        if contents.entries:
            start_ns, end_ns = time_span(contents.entries)
            self.start_ns = min(self.start_ns, start_ns)
            self.end_ns = max(self.end_ns, end_ns)

    def missing(self, *, lossless: bool) -> dict[str, int]:
        """Return the lost messages by topic; '' stands for topics that nothing declares."""
        if self._summary.statistics is None:
            lost = (self._gaps | self.in_lost_chunks) + Counter(
                {number: loss.messages or 0 for number, loss in self.unknown.items()})
        else:
            lost = Counter(self._summary.statistics.channel_message_counts)
            lost.subtract(self.found)
            if lossless:
                # A whole file that was made of a truncated one still tells what that had lost.
                lost.update(self._gaps)
        missing: Counter[str] = Counter()
        for number, messages in sorted((+lost).items()):
            known = self._summary.knows(number)
            missing[self._summary.channels[number].topic if known else ''] += messages
        return dict(missing)
