# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones.

Everything that is provably whole is read (see `scanner.py`), and `damage` reports the rest.
Memory holds the chunks that overlap in time: one in a log that was written in order.
"""

from __future__ import annotations

import bisect
import functools
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.chunks import time_span
from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import NotMcapError
from spinning_top_sim.recording.records import (
    HEAD,
    MAX_BYTES,
    DamagedError,
    StoredMessage,
    open_chunk,
    parse_message,
)
from spinning_top_sim.recording.rosbag2 import Qos, parse_offered_qos
from spinning_top_sim.recording.scanner import Scanner
from spinning_top_sim.recording.summary import MAGIC_SIZE, McapSource, read_summary

_RUN_BYTES = 1 << 20  # of messages outside of chunks that are read at a time


@dataclass(frozen=True)
class LogTopic:
    """
    A channel of a log.

    Attributes
    ----------
    name : str
        Such as '/imu/data_raw'.
    type_name : str
        Such as 'sensor_msgs/msg/Imu'; '' without schema.
    schema, schema_encoding : str
        The definition with its dependencies, and its format, such as 'ros2msg'.
    encoding : str
        Of the messages, such as 'cdr'.
    qos : tuple of mappings
        Offered profiles, each as the `qos` of RecordedTopic; empty if there are none.
    metadata : mapping of str to str
        As it stands in the channel.
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
    """A message of a log; times in ns."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes
    channel_id: int


class _Span(NamedTuple):
    """A chunk, or adjacent messages outside of chunks, in the order of the log times."""

    start_ns: int
    offset: int
    length: int
    end_ns: int


class LogReader:
    """
    An MCAP file, open for reading; also a context manager.

    A file with a usable summary opens at once.  Any other is scanned before its topics, metadata
    or messages are returned, and so is every file for its `damage`.  Damage raises nothing.

    Parameters
    ----------
    path : path
        The file.
    max_bytes : int
        Largest record, and largest uncompressed chunk, that is read into memory.

    Attributes
    ----------
    left_out : int
        Damaged chunks that `messages` has skipped.

    Raises
    ------
    LogAccessError
        If the file cannot be opened or read; any method may raise it.
    NotMcapError
        If it is no MCAP file.

    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> None:
        self.path = Path(path)
        self.left_out = 0
        self._source = McapSource(self.path, max_bytes)
        try:
            self._header = self._check_beginning()
            self._summary = read_summary(self._source)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    @property
    def size(self) -> int:
        """Size of the file when it was opened [bytes]."""
        return self._source.size

    def __enter__(self) -> LogReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def mode(self) -> int:
        """Permission bits of the file."""
        return self._source.mode

    @property
    def profile(self) -> str:
        """The profile in the header; 'ros2' if the header is damaged."""
        return self._header.profile

    @property
    def library(self) -> str:
        """The library in the header; '' if the header is damaged."""
        return self._header.library

    @property
    def whole(self) -> bool:
        """Whether the file was closed and its summary, if any, is right; see also `damage`."""
        return self._summary.closed and not self._summary.problem

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        schemas, channels = self._declared
        found = []
        for number, channel in sorted(channels.items()):
            schema = schemas.get(channel.schema_id)
            found.append(LogTopic(
                name=channel.topic, type_name=schema.name if schema else '',
                schema=schema.data.decode(errors='replace') if schema else '',
                schema_encoding=schema.encoding if schema else '',
                encoding=channel.message_encoding, qos=qos_profiles(channel),
                metadata=channel.metadata, channel_id=number))
        return tuple(found)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; of several with one name, the last."""
        if self._survey_is_needed or '_survey' in self.__dict__:
            return dict(self._survey.metadata)
        found = {}
        for index in self._summary.metadata:
            try:
                record = self._source.record(index.offset, self._summary.data_limit)
            except DamagedError:
                continue
            if isinstance(record, Metadata):
                found[record.name] = record.metadata
        return found

    @property
    def damage(self) -> Damage:
        """What is wrong with the file; scans all of it at the first use."""
        return self._survey.damage

    @property
    def span(self) -> tuple[int, int]:
        """The earliest and the latest log time [ns]; both 0 without messages."""
        spans = [span for span in self._spans if span.end_ns]
        return (min((span.start_ns for span in spans), default=0),
                max((span.end_ns for span in spans), default=0))

    def messages(
        self, topics: Iterable[str] | None = None, start: int | None = None,
        end: int | None = None,
    ) -> Iterator[LogMessage]:
        """
        Yield the whole messages in the order of their log times, equal ones in file order.

        Parameters
        ----------
        topics : iterable of str or None
            Names; None for all.
        start, end : int or None
            Log times [ns]; `end` is exclusive.

        """
        schemas, known = self._declared
        names = None if topics is None else frozenset(topics)
        channels = {
            number: channel.topic for number, channel in known.items()
            if (names is None or channel.topic in names)
            and (channel.schema_id == 0 or channel.schema_id in schemas)}

        # Chunks that overlap in time are merged: log time, place in the file, message.
        pending: list[tuple[int, int, int, LogMessage]] = []
        for span in self._spans:
            if (start is not None and span.end_ns < start) or (
                    end is not None and span.start_ns >= end):
                continue
            pending.sort()
            ready = bisect.bisect_left(pending, span.start_ns, key=itemgetter(0))
            yield from map(itemgetter(3), pending[:ready])
            del pending[:ready]
            plain, stored = self._read(span)
            for number, (time_ns, channel, sequence, publish_ns, begin, stop) in enumerate(stored):
                if (channel in channels and (start is None or time_ns >= start)
                        and (end is None or time_ns < end)):
                    pending.append((time_ns, span.offset, number, LogMessage(
                        channels[channel], time_ns, publish_ns, sequence, plain[begin:stop],
                        channel)))
        pending.sort()
        yield from map(itemgetter(3), pending)

    def scan(self, former: Scanner | None = None) -> Scanner:
        """Begin a scan of all usable records in file order, with what a former scan knows."""
        scanner = Scanner(self._source, self._summary)
        if former is not None:
            scanner.schemas.update(former.schemas)
            scanner.channels.update(former.channels)
        return scanner

    def blocks(self, offset: int, length: int) -> Iterator[bytes]:
        """Yield a stretch of the file in blocks."""
        return self._source.blocks(offset, length)

    @functools.cached_property
    def _survey(self) -> _Survey:
        """What a scan of the whole file found, done at the first use."""
        survey = self._scan_all(self.scan())
        if survey.scanner.found_late:
            survey = self._scan_all(self.scan(survey.scanner))
        return survey

    def _scan_all(self, scanner: Scanner) -> _Survey:
        spans: list[_Span] = []
        metadata = {}
        run: _Span | None = None  # adjacent messages outside of chunks
        for scanned in scanner:
            if isinstance(scanned.record, Metadata):
                metadata[scanned.record.name] = scanned.record.metadata
            if scanned.contents is None or not scanned.contents.messages:
                continue
            start_ns, end_ns = time_span(scanned.contents.entries)
            span = _Span(start_ns, scanned.offset, scanned.length, end_ns)
            if scanned.record is not None:
                spans.append(span)
            elif (run is not None and run.offset + run.length == span.offset
                    and run.length < _RUN_BYTES):
                run = _Span(min(run.start_ns, span.start_ns), run.offset,
                            run.length + span.length, max(run.end_ns, span.end_ns))
                spans[-1] = run
            else:
                run = span
                spans.append(run)
        return _Survey(scanner, metadata, sorted(spans), scanner.damage())

    def _check_beginning(self) -> Header:
        """Return the header; raises NotMcapError if neither magic nor header is there."""
        if not self.size:
            raise NotMcapError(f'cannot read {self.path}: it is empty')
        magic = self._source.read(0, MAGIC_SIZE)
        if magic != MCAP0_MAGIC and len(magic) < MAGIC_SIZE and MCAP0_MAGIC.startswith(magic):
            raise NotMcapError(
                f'cannot read {self.path}: it ends after {self.size} bytes of an MCAP file')
        try:
            header = self._source.record(MAGIC_SIZE, self.size)
        except DamagedError:
            header = None
        if isinstance(header, Header):
            return header
        if magic != MCAP0_MAGIC:
            raise NotMcapError(f'cannot read {self.path}: it is no MCAP file')
        return Header(profile='ros2', library='')

    @property
    def _declared(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """Return schemas and channels by number."""
        source = self._survey.scanner if self._survey_is_needed else self._summary
        return source.schemas, source.channels

    @property
    def _spans(self) -> list[_Span]:
        if self._survey_is_needed or '_survey' in self.__dict__:
            return self._survey.spans
        return sorted(_Span(index.message_start_time, index.chunk_start_offset,
                            index.chunk_length, index.message_end_time)
                      for index in self._summary.chunks.values())

    @functools.cached_property
    def _survey_is_needed(self) -> bool:
        """Whether the summary does not lead to all messages, metadata and channels."""
        summary = self._summary
        statistics = summary.statistics
        if statistics is None:
            return True
        return (
            not summary.indexes_all_messages
            or len(summary.metadata) != statistics.metadata_count
            or len(summary.channels) != statistics.channel_count
            or any(channel.schema_id not in {0, *summary.schemas}
                   for channel in summary.channels.values()))

    def _read(self, span: _Span) -> tuple[bytes, list[StoredMessage]]:
        """Return the messages of a span and the bytes they are in; none if it is damaged."""
        try:
            if self._source.read(span.offset, 1) == bytes([Opcode.MESSAGE]):
                content = self._source.read(span.offset, span.length)
                return content, list(_single_messages(content))
            chunk = self._source.record(span.offset, span.offset + span.length)
            if isinstance(chunk, Chunk):
                contents = open_chunk(chunk, self._source.max_bytes)
                return contents.plain, contents.messages
        except DamagedError:
            pass
        self.left_out += 1
        return b'', []


@dataclass(frozen=True)
class _Survey:
    """What a scan of a file found."""

    scanner: Scanner
    metadata: dict[str, dict[str, str]]
    spans: list[_Span]
    damage: Damage


def _single_messages(records: bytes) -> Iterator[StoredMessage]:
    """Yield the messages of message records that stand one after the other."""
    offset = 0
    while offset < len(records):
        _, length = HEAD.unpack_from(records, offset)
        offset += HEAD.size
        yield parse_message(records, offset, offset + length)
        offset += length


def qos_profiles(channel: Channel) -> tuple[Qos, ...]:
    """Return the QoS profiles in the metadata of a channel."""
    return tuple(parse_offered_qos(channel.metadata.get('offered_qos_profiles', '')))
