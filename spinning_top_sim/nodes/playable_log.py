# SPDX-License-Identifier: Apache-2.0
"""A log as it is played: its topics, its span, and its messages in the order of their times."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Message, Schema

from spinning_top_sim.nodes.playback import Message as Played

# What mcap raises where a record is cut or is none.
NO_RECORD = (McapError, OSError, ValueError, StopIteration, struct.error)

Record = tuple[Schema | None, Channel, Message]


@dataclass(frozen=True)
class LogTopic:
    """
    What publishes the messages of one or more channels of a log.

    name, type_name, encoding: as recorded;  qos: `offered_qos_profiles`;  type_hash: maybe empty
    """

    name: str
    type_name: str
    encoding: str
    qos: str
    type_hash: str


class PlayableLog:
    """
    A log that can be read again and again.

    topics: all of them;  begin_ns, end_ns: times of the first and last message
    damage: what is wrong with a torn file that is played all the same, or None

    Raises ValueError naming the file for what is no MCAP, and for a torn one unless `partial`.
    """

    def __init__(self, path: Path, *, partial: bool = False) -> None:
        self._path = path
        self.damage: str | None = None
        self._records: list[Record] | None = None
        with path.open('rb') as file:
            try:
                reader = SeekingReader(file)
            except (McapError, ValueError) as error:
                raise ValueError(f'{path} is no MCAP file') from error
            try:
                summary = reader.get_summary()
            except NO_RECORD as error:
                if not partial:
                    raise ValueError(
                        f'{path} is torn: it has no end. `recover` makes a whole log of it, '
                        '--partial plays what is there') from error
                self.damage = 'torn: it has no end'
                self._records = _complete_records(path)
                summary = None
            if summary is None or summary.statistics is None:
                if self._records is None:
                    self._records = list(reader.iter_messages())
                times = [message.log_time for _, _, message in self._records]
                channels = {id(channel): (schema, channel)
                            for schema, channel, _ in self._records}.values()
                self.begin_ns, self.end_ns = (times[0], times[-1]) if times else (0, 0)
            else:
                channels = [(summary.schemas.get(channel.schema_id), channel)
                            for channel in summary.channels.values()]
                self.begin_ns = summary.statistics.message_start_time
                self.end_ns = summary.statistics.message_end_time
        self._index_of_channel: dict[int, int] = {}
        indexes: dict[LogTopic, int] = {}
        for schema, channel in channels:
            topic = LogTopic(channel.topic, schema.name if schema else '',
                             channel.message_encoding,
                             channel.metadata.get('offered_qos_profiles', ''),
                             channel.metadata.get('topic_type_hash', ''))
            self._index_of_channel[channel.id] = indexes.setdefault(topic, len(indexes))
        self.topics = list(indexes)

    def messages(self, topics: set[int], from_ns: int) -> Iterator[Played]:
        """Yield (time, index of the topic, CDR) in the order of time, of these topics' indexes."""
        if self._records is not None:
            yield from self._chosen(self._records, topics, from_ns)
            return
        names = {self.topics[index].name for index in topics}
        with self._path.open('rb') as file:
            yield from self._chosen(
                SeekingReader(file).iter_messages(names, starting_at=from_ns), topics, from_ns)

    def _chosen(self, records, topics, from_ns) -> Iterator[Played]:
        for _, channel, message in records:
            index = self._index_of_channel[channel.id]
            if index in topics and message.log_time >= from_ns:
                yield message.log_time, index, message.data


def _complete_records(path: Path) -> list[Record]:
    """Return the messages of the complete chunks of a torn file."""
    records: list[Record] = []
    with path.open('rb') as file, contextlib.suppress(*NO_RECORD):
        records.extend(NonSeekingReader(file).iter_messages(log_time_order=False))
    return sorted(records, key=lambda record: record[2].log_time)
