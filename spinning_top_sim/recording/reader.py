# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones.

Every message that can be decoded is read, and `damage` tells the rest.  Memory holds the chunks
that overlap in time: one in a log that was written in order.
"""

import contextlib
import functools
import heapq
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import records
from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.log_file import MAGIC_SIZE, LogFile, known_channels, read_summary
from spinning_top_sim.recording.records import HEAD, DamagedError, Messages
from spinning_top_sim.recording.rosbag2 import Qos, qos_profiles
from spinning_top_sim.recording.scan import Part, Scan
from spinning_top_sim.recording.writer import OUR_LIBRARY

_FIRST_DATE = 10 ** 17      # [ns], in 1973
_STREAM_BYTES = 1 << 12     # that an open chunk costs besides its content, about


@dataclass(frozen=True)
class LogTopic:
    """A channel of a log."""

    name: str                   # of the topic
    type_name: str              # such as 'sensor_msgs/msg/Imu', empty without schema
    schema: str                 # the definition with its dependencies
    schema_encoding: str        # its format, such as 'ros2msg'
    encoding: str               # of the messages, such as 'cdr'
    qos: tuple[Qos, ...]        # offered profiles, each with the keys of `rosbag2.DEFAULT_QOS`
    metadata: Mapping[str, str]     # of the channel
    channel_id: int             # its number in the file


class LogMessage(NamedTuple):
    """A message of a log."""

    topic: str
    log_time: int               # [ns]
    publish_time: int           # [ns]
    sequence: int               # number in its channel
    data: bytes                 # the serialized message
    channel_id: int


class LogReader(contextlib.AbstractContextManager['LogReader']):
    """
    An MCAP file, open for reading; a context manager.

    A file with a usable summary opens at once.  Any other is scanned before its topics, metadata
    or messages are returned, and so is every file for its `damage`.  Damage raises nothing.

    Parameters
    ----------
    path : str or path
        The file.
    max_bytes : int
        Largest record, and largest uncompressed chunk, that is read into memory.

    Raises
    ------
    LogError
        For what is no MCAP file, or cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = records.MAX_BYTES) -> None:
        self.path = Path(path)
        self.left_out = 0       # damaged chunks that `messages` has skipped
        self.file = LogFile(self.path, max_bytes)
        self.size = self.file.size
        self._scanned: Scan | None = None
        try:
            header = self._read_header()
            self._summary = read_summary(self.file)
        except BaseException:
            self.close()
            raise
        self.profile, self.library = header.profile, header.library

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def whole(self) -> bool:
        """Whether the file was closed and its summary, if any, is right; see also `damage`."""
        return self._summary.closed and not self._summary.problem

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        no_schema = Schema(id=0, data=b'', encoding='', name='')
        schemas, channels = self._declared
        return tuple(LogTopic(
            name=channel.topic, type_name=schema.name,
            schema=schema.data.decode(errors='replace'), schema_encoding=schema.encoding,
            encoding=channel.message_encoding, qos=qos_profiles(channel),
            metadata=channel.metadata, channel_id=number)
            for number, channel in sorted(channels.items())
            for schema in [schemas.get(channel.schema_id, no_schema)])

    @functools.cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; of several with one name, the last."""
        if not self._index_is_right:
            return self.scan().metadata
        found = {}
        size = 0
        for index in self._summary.metadata:
            size += index.length
            with contextlib.suppress(DamagedError):
                records.check_size(size, records.MAX_DECLARED)
                record = self.file.record(index.offset, self._summary.data_limit)
                if isinstance(record, Metadata):
                    found[record.name] = record.metadata
        return found

    @property
    def damage(self) -> Damage:
        """What is wrong with the file; scans all of it at the first use."""
        return self.scan().damage

    @functools.cached_property
    def span(self) -> tuple[int, int]:
        """
        The earliest and the latest log time [ns]; both 0 without messages.

        Beside dates, a time of 0 does not count: it says that there was no clock yet.
        """
        begin_ns = min((part.start_ns for part in self._parts), default=0)
        end_ns = max((part.end_ns for part in self._parts), default=0)
        if begin_ns == 0 and end_ns > _FIRST_DATE:
            first = next(self.messages(start=1), None)
            begin_ns = first.log_time if first and first.log_time > _FIRST_DATE else 0
        return begin_ns, end_ns

    def messages(self, topics: Iterable[str] | None = None, start: int | None = None,
                 end: int | None = None) -> Iterator[LogMessage]:
        """
        Yield the messages in the order of their log times, equal ones in file order.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default: all.
        start, end : int, optional
            Log times [ns]; `end` is exclusive.

        Yields
        ------
        LogMessage
            A message that is read completely.
        """
        names = None if topics is None else frozenset(topics)
        schemas, channels = self._declared
        wanted = {number: channels[number].topic for number in known_channels(schemas, channels)
                  if names is None or channels[number].topic in names}
        times = range(start or 0, 1 << 64 if end is None else end)
        held: list[int] = []        # bytes of each part that is read and not yet passed
        # A part is read when its time comes.
        streams = [self._stream(part, wanted, held) for part in self._parts
                   if part.end_ns >= times.start and part.start_ns < times.stop
                   and not part.channel_ids.isdisjoint(wanted)]
        for message in heapq.merge(*streams, key=attrgetter('log_time')):
            if message.channel_id >= 0 and message.log_time in times:
                yield message

    def scan(self, progress: Callable[[int], object] = lambda offset: None) -> Scan:
        """Return what a scan of the whole file finds, done at the first use."""
        if self._scanned is None:
            self._scanned = Scan(self.file, self._summary, progress=progress,
                                 ours=self.library.startswith(OUR_LIBRARY))
        return self._scanned

    def open_part(self, part: Part) -> Messages:
        """Return the messages of a part.  Raises DamagedError."""
        if part.opcode == Opcode.MESSAGE:
            return records.find_messages(self.file.read(part.offset, part.end - part.offset))
        chunk = self.file.record(part.offset, part.end)
        if not isinstance(chunk, Chunk):
            raise DamagedError('it is no chunk')
        return records.open_chunk(chunk, self.file.max_bytes)

    def _stream(self, part: Part, wanted: Mapping[int, str], held: list[int],
                ) -> Iterator[LogMessage]:
        """Yield a placeholder at the part's first time, so that parts open in turn, then all."""
        yield LogMessage('', part.start_ns, 0, 0, b'', -1)
        try:
            messages = self.open_part(part)
        except DamagedError:
            self.left_out += 1
            return
        held_bytes = len(messages.plain) + _STREAM_BYTES
        held.append(held_bytes)
        most = 2 * self.file.max_bytes
        if sum(held) > most:
            raise LogError(f'cannot read {self.path}: the messages of several chunks overlap in '
                           f'time, and these have more than {most} bytes')
        for channel_id in messages.entries.keys() - wanted:
            del messages.entries[channel_id]
        for message in messages.in_order(by_time=True):
            yield LogMessage(
                wanted[message.channel_id], message.log_time, message.publish_time,
                message.sequence, message.data, message.channel_id)
        held.remove(held_bytes)

    @functools.cached_property
    def _index_is_right(self) -> bool:
        """Whether the summary indexes all messages, and its indexes lead to chunks."""
        return self._summary.is_complete and all(
            map(self._leads_to_chunk, self._summary.chunks.values()))

    def _leads_to_chunk(self, index: ChunkIndex) -> bool:
        head = struct.pack(
            '<BQQQ', Opcode.CHUNK, (index.chunk_length - HEAD.size) % (1 << 64),
            index.message_start_time, index.message_end_time)
        return self.file.read(index.chunk_start_offset, len(head)) == head

    @functools.cached_property
    def _parts(self) -> list[Part]:
        """What the summary indexes, if that is all and right, else what a scan found."""
        if not self._index_is_right:
            return [part for part in self.scan().parts if part.channel_ids]
        return [Part(Opcode.CHUNK, offset, offset + index.chunk_length,
                     frozenset(index.message_index_offsets), index.message_start_time,
                     index.message_end_time)
                for offset, index in sorted(self._summary.chunks.items())
                if index.message_index_offsets]

    @property
    def _declared(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """The schemas and channels by id."""
        found = self._summary if self._index_is_right else self.scan()
        return found.schemas, found.channels

    def _read_header(self) -> Header:
        """Return the header; raises LogError if neither magic nor header is there."""
        magic = self.file.read(0, MAGIC_SIZE)
        if not magic:
            raise LogError(f'cannot read {self.path}: it is empty')
        if magic != MCAP0_MAGIC and MCAP0_MAGIC.startswith(magic):
            raise LogError(
                f'cannot read {self.path}: it ends after {self.size} bytes of an MCAP file')
        with contextlib.suppress(DamagedError):
            header = self.file.record(MAGIC_SIZE, self.size)
            if isinstance(header, Header):
                return header
        if magic != MCAP0_MAGIC:
            raise LogError(f'cannot read {self.path}: it is no MCAP file')
        return Header(profile='ros2', library='')
