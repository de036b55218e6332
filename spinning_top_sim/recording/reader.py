# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones.

Everything that is provably whole is read (see `scanner.py`), and `damage` reports the rest.
Memory holds the chunks that overlap in time: one in a log that was written in order.
"""

import contextlib
import functools
import heapq
import os
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import records
from spinning_top_sim.recording.chunks import time_span
from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.records import HEAD, ChunkContents, DamagedError
from spinning_top_sim.recording.rosbag2 import Qos, qos_profiles
from spinning_top_sim.recording.scanner import Scanner
from spinning_top_sim.recording.source import MAGIC_SIZE, McapSource, messages_in, read_summary
from spinning_top_sim.recording.writer import OUR_LIBRARY

_FIRST_DATE = 10 ** 17       # [ns], in 1973
_STREAM_BYTES = 1 << 12     # that an open chunk costs besides its content, about
_RUN_BYTES = 1 << 20  # of messages outside of chunks that are read at a time


@dataclass(frozen=True)
class LogTopic:
    """
    A channel of a log.

    Parameters
    ----------
    name, type_name : str
        Of the topic and its type, such as 'sensor_msgs/msg/Imu', empty without schema.
    schema, schema_encoding : str
        The definition with its dependencies, and its format, such as 'ros2msg'.
    encoding : str
        Of the messages, such as 'cdr'.
    qos : tuple of mapping
        Offered profiles, each with the keys of `rosbag2.DEFAULT_QOS`.
    metadata : mapping of str to str
        Of the channel.
    channel_id : int
        Its number in the file.
    """

    name: str
    type_name: str
    schema: str
    schema_encoding: str
    encoding: str
    qos: tuple[Qos, ...]
    metadata: Mapping[str, str]
    channel_id: int


class LogMessage(NamedTuple):
    """
    A message of a log.

    Parameters
    ----------
    topic : str
        Name of the topic.
    log_time, publish_time : int
        Times of the record [ns].
    sequence : int
        Number in its channel.
    data : bytes
        The serialized message.
    channel_id : int
        Number of its channel.
    """

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes
    channel_id: int


class _Span(NamedTuple):
    """A chunk, or adjacent messages outside of chunks."""

    offset: int
    end: int        # offset
    start_ns: int   # the earliest log time
    end_ns: int     # the latest


# Where the messages are, in file order, and the metadata records by name.
_Index = tuple[list[_Span], dict[str, dict[str, str]]]


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
        self.source = McapSource(self.path, max_bytes)
        self.size = self.source.size
        try:
            header = self._read_header()
            self._summary = read_summary(self.source)
        except BaseException:
            self.close()
            raise
        self.profile, self.library = header.profile, header.library

    def close(self) -> None:
        """Close the file."""
        self.source.close()

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def whole(self) -> bool:
        """Whether the file was closed and its summary, if any, is right; see also `damage`."""
        return self._summary.closed and not self._summary.problem

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        self._index     # noqa: B018 - makes the channels known
        no_schema = Schema(id=0, data=b'', encoding='', name='')
        return tuple(LogTopic(
            name=channel.topic, type_name=schema.name,
            schema=schema.data.decode(errors='replace'), schema_encoding=schema.encoding,
            encoding=channel.message_encoding, qos=qos_profiles(channel),
            metadata=channel.metadata, channel_id=number)
            for number, channel in sorted(self._summary.channels.items())
            for schema in [self._summary.schemas.get(channel.schema_id, no_schema)])

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; of several with one name, the last."""
        return self._index[1]

    @property
    def damage(self) -> Damage:
        """What is wrong with the file; scans all of it at the first use."""
        return self._survey[1]

    @functools.cached_property
    def span(self) -> tuple[int, int]:
        """
        The earliest and the latest log time [ns]; both 0 without messages.

        Beside dates, a time of 0 does not count: it says that there was no clock yet.
        """
        spans, _ = self._index
        begin_ns = min((span.start_ns for span in spans), default=0)
        if begin_ns == 0:
            first_ns = min((span.start_ns or self._first_after_0(span) for span in spans
                            if span.end_ns), default=0)
            begin_ns = first_ns if first_ns > _FIRST_DATE else 0
        return begin_ns, max((span.end_ns for span in spans), default=0)

    def _first_after_0(self, span: _Span) -> int:
        """Return the earliest log time but 0 in a span, or 0 if that is no date."""
        if span.end_ns > _FIRST_DATE:
            with contextlib.suppress(DamagedError):
                return min((time for numbers in self._open(span).entries.values()
                            for time in numbers[::2] if time), default=0)
        return 0

    def messages(self, topics: Iterable[str] | None = None, start: int | None = None,
                 end: int | None = None) -> Iterator[LogMessage]:
        """
        Yield the whole messages in the order of their log times, equal ones in file order.

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
        spans, _ = self._index      # also makes the channels known
        names = None if topics is None else frozenset(topics)
        channels = {number: channel.topic for number, channel in self._summary.channels.items()
                    if (names is None or channel.topic in names) and self._summary.knows(number)}
        times = range(start or 0, 1 << 64 if end is None else end)
        held: list[int] = []        # bytes of each span that is read and not yet passed
        # A span is read when its time comes.
        streams = [self._stream(span, channels, held) for span in spans
                   if span.end_ns >= times.start and span.start_ns < times.stop
                   and not (names is not None and self._is_without(span, channels))]
        for message in heapq.merge(*streams, key=attrgetter('log_time')):
            if message.channel_id >= 0 and message.log_time in times:
                yield message

    def _stream(self, span: _Span, channels: Mapping[int, str], held: list[int],
                ) -> Iterator[LogMessage]:
        """Yield a placeholder at the span's first time, so that spans open in turn, then all."""
        yield LogMessage('', span.start_ns, 0, 0, b'', -1)
        contents = self._read(span)
        held_bytes = len(contents.plain) + _STREAM_BYTES
        held.append(held_bytes)
        if sum(held) > 2 * self.source.max_bytes:
            raise LogError(f'cannot read {self.path}: the messages of several chunks overlap in '
                           f'time, and these have more than {2 * self.source.max_bytes} bytes')
        for channel_id in contents.entries.keys() - channels:
            del contents.entries[channel_id]
        for message in contents.messages(by_time=True):
            yield LogMessage(
                channels[message.channel_id], message.log_time, message.publish_time,
                message.sequence, message.data, message.channel_id)
        held.remove(held_bytes)

    def _is_without(self, span: _Span, channels: Mapping[int, str]) -> bool:
        """Whether a chunk has message indexes by the summary, and none of these channels."""
        index = self._summary.chunks.get(span.offset)
        return bool(index and index.message_index_offsets
                    and index.message_index_offsets.keys().isdisjoint(channels))

    def scan(self) -> Scanner:
        """Begin a scan of all usable records in file order, with what former ones know."""
        return Scanner(self.source, self._summary, ours=self.library.startswith(OUR_LIBRARY))

    @functools.cached_property
    def _index(self) -> _Index:
        """What the summary indexes, if that is all and right, else what a scan found."""
        if not (self._summary.is_complete
                and all(map(self._leads_to_chunk, self._summary.chunks.values()))):
            return self._survey[0]
        metadata = {}
        metadata_bytes = 0
        for index in self._summary.metadata:
            metadata_bytes += index.length
            if metadata_bytes > records.MAX_DECLARED:
                break
            record = self.source.record(index.offset, self._summary.data_limit, Metadata)
            if record is not None:
                metadata[record.name] = record.metadata
        spans = [_Span(offset, offset + chunk.chunk_length, chunk.message_start_time,
                       chunk.message_end_time)
                 for offset, chunk in sorted(self._summary.chunks.items())
                 if messages_in(chunk)]
        return spans, metadata

    def _leads_to_chunk(self, index: ChunkIndex) -> bool:
        """Return whether the chunk there is the one that the summary tells of."""
        head = struct.pack(
            '<BQQQ', Opcode.CHUNK, (index.chunk_length - HEAD.size) % (1 << 64),
            index.message_start_time, index.message_end_time)
        return self.source.read(index.chunk_start_offset, len(head)) == head

    @functools.cached_property
    def _survey(self) -> tuple[_Index, Damage]:
        """What a scan of the whole file found, done at the first use."""
        for _ in range(2):
            scanner = self.scan()
            index = _scan_all(scanner)
            if not scanner.found_late:
                break
        return index, scanner.damage()

    def _read_header(self) -> Header:
        """Return the header; raises LogError if neither magic nor header is there."""
        magic = self.source.read(0, MAGIC_SIZE)
        if not magic:
            raise LogError(f'cannot read {self.path}: it is empty')
        if magic != MCAP0_MAGIC and MCAP0_MAGIC.startswith(magic):
            raise LogError(
                f'cannot read {self.path}: it ends after {self.size} bytes of an MCAP file')
        header = self.source.record(MAGIC_SIZE, self.size, Header)
        if header is None and magic != MCAP0_MAGIC:
            raise LogError(f'cannot read {self.path}: it is no MCAP file')
        return header or Header(profile='ros2', library='')

    def _read(self, span: _Span) -> ChunkContents:
        """Return the messages of a span; none if it is damaged."""
        with contextlib.suppress(DamagedError):
            return self._open(span)
        self.left_out += 1
        return ChunkContents(b'')

    def _open(self, span: _Span) -> ChunkContents:
        """Return the messages of a span.  Raises DamagedError."""
        if self.source.read(span.offset, 1) == bytes([Opcode.MESSAGE]):
            return records.break_up(self.source.read(span.offset, span.end - span.offset))
        chunk = self.source.record(span.offset, span.end, Chunk)
        if chunk is None:
            raise DamagedError('no chunk')
        return records.open_chunk(chunk, self.source.max_bytes)


def _scan_all(scanner: Scanner) -> _Index:
    spans: list[_Span] = []
    metadata = {}
    run_end = 0     # of adjacent messages outside of chunks, the last span
    for scanned in scanner:
        if isinstance(scanned.record, Metadata):
            metadata[scanned.record.name] = scanned.record.metadata
        if scanned.contents is None or not scanned.contents.entries:
            continue
        span = _Span(scanned.offset, scanned.end, *time_span(scanned.contents.entries))
        if scanned.record is None and run_end == span.offset < spans[-1].offset + _RUN_BYTES:
            run = spans.pop()
            span = _Span(run.offset, span.end, min(run.start_ns, span.start_ns),
                         max(run.end_ns, span.end_ns))
        spans.append(span)
        run_end = scanned.end if scanned.record is None else 0
    return spans, metadata
