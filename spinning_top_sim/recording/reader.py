# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones.

Every message that can be decoded is read, and `damage` tells the rest.  Memory holds the chunks
that overlap in time: one in a log that was written in order.
"""

import contextlib
import functools
import heapq
import itertools
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import parsing
from spinning_top_sim.recording.damage import Damage
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.log_file import MAGIC_SIZE, LogFile, read_summary
from spinning_top_sim.recording.parsing import HEAD, DamagedError, LogMessage, Messages
from spinning_top_sim.recording.provenance import OUR_LIBRARY
from spinning_top_sim.recording.rosbag2 import Qos, qos_profiles
from spinning_top_sim.recording.scan import Index, Part, Scan

BLOCK = 16384               # messages that are read together
_FIRST_DATE = 10 ** 17      # [ns], in 1973
_STREAM_BYTES = 1 << 12     # that an open chunk costs besides its content, about


@dataclass(frozen=True)
class LogTopic:
    """
    A channel of a log.

    Parameters
    ----------
    name : str
        Name of the topic.
    type_name : str
        Such as 'sensor_msgs/msg/Imu', empty without schema.
    schema, schema_encoding : str
        The definition with its dependencies, and its format, such as 'ros2msg'.
    encoding : str
        Encoding of the messages, such as 'cdr'.
    qos : tuple of mapping
        Offered profiles, each with the keys of `rosbag2.DEFAULT_QOS`.
    metadata : mapping
        Metadata of the channel.
    channel_id : int
        Number of the channel in the file.
    """

    name: str
    type_name: str
    schema: str
    schema_encoding: str
    encoding: str
    qos: tuple[Qos, ...]
    metadata: Mapping[str, str]
    channel_id: int


def _file_of(path: Path) -> Path:
    """Return a file, or the one in a folder; raises LogError."""
    if not path.is_dir():
        return path
    files = sorted(file.name for file in path.glob('*.mcap'))
    if len(files) != 1:
        raise LogError(f'cannot read {path}: a folder must hold one .mcap file; in it: '
                       f'{", ".join(files) or "none"}')
    return path / files[0]


class LogReader(contextlib.AbstractContextManager['LogReader']):
    """
    An MCAP file, open for reading; a context manager.

    A file with a usable summary opens at once.  Any other is scanned before its topics, metadata
    or messages are returned, and so is every file for its `damage`.  Damage raises nothing.

    Parameters
    ----------
    path : str or path
        The file, or a folder as `ros2 bag` makes it, which must hold exactly one.
    max_bytes : int
        Largest record, and largest uncompressed chunk, that is read into memory.

    Attributes
    ----------
    path : Path
        The file; of a folder, the one in it.
    size : int
        Its size when it was opened [bytes]: what is written later is not read.
    profile, library : str
        What its header says: such as 'ros2', and the program that wrote it.
    left_out : int
        Damaged chunks that `messages` has skipped so far.
    file : LogFile
        Its bytes and records, for recovery.

    Raises
    ------
    LogError
        For what is no MCAP file, or cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = parsing.MAX_BYTES) -> None:
        self.path = _file_of(Path(path))
        self.left_out = 0
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
        """Close the file; nothing can be read any more."""
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
        schemas, channels = self._index.schemas, self._index.channels
        return tuple(LogTopic(
            name=channel.topic, type_name=schema.name,
            schema=schema.data.decode(errors='replace'), schema_encoding=schema.encoding,
            encoding=channel.message_encoding, qos=qos_profiles(channel),
            metadata=channel.metadata, channel_id=number)
            for number, channel in sorted(channels.items())
            for schema in [schemas.get(channel.schema_id, no_schema)])

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; of several with one name, the last."""
        return self._index.metadata

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
        begin_ns = min((part.start_ns for part in self._message_parts), default=0)
        end_ns = max((part.end_ns for part in self._message_parts), default=0)
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
        wanted = {number: topic for number, topic in self._index.topics.items()
                  if names is None or topic in names}
        times = range(start or 0, 1 << 64 if end is None else end)
        held: list[int] = []        # bytes of each part that is read and not yet passed
        # A part is read when its time comes.
        streams = [self._stream(part, wanted, held) for part in self._message_parts
                   if part.end_ns >= times.start and part.start_ns < times.stop
                   and not part.channel_ids.isdisjoint(wanted)]
        for message in heapq.merge(*streams, key=attrgetter('log_time')):
            if message.channel_id >= 0 and message.log_time in times:
                yield message

    def groups(self, topics: Iterable[str] | None = None,
               ) -> Iterator[tuple[str, list[LogMessage]]]:
        """Yield some messages of a topic at a time, each topic's in the order of `messages`."""
        messages = self.messages(topics)
        while block := sorted(itertools.islice(messages, BLOCK), key=attrgetter('topic')):
            for topic, group in itertools.groupby(block, attrgetter('topic')):
                yield topic, list(group)

    def scan(self, progress: Callable[[int], object] = lambda offset: None) -> Scan:
        """Return what a scan of the whole file finds, done at the first use."""
        if self._scanned is None:
            self._scanned = Scan(self.file, self._summary, progress=progress,
                                 ours=self.library.startswith(OUR_LIBRARY))
        return self._scanned

    def open_part(self, part: Part) -> Messages:
        """Return the messages of a part.  Raises DamagedError."""
        if part.opcode == Opcode.MESSAGE:
            return parsing.find_messages(self.file.read(part.offset, part.end - part.offset))
        chunk = self.file.record(part.offset, part.end)
        if not isinstance(chunk, Chunk):
            raise DamagedError('it is no chunk')
        return parsing.open_chunk(chunk, self.file.max_bytes)

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
        yield from messages.in_order(wanted, by_time=True)
        held.remove(held_bytes)

    @functools.cached_property
    def _index(self) -> Index:
        """What the summary tells, if that is all and right, else what a scan finds."""
        summary = self._summary
        if not (summary.is_complete and all(map(self._leads_to_chunk, summary.chunks.values()))):
            return self.scan().index
        metadata = {}
        for index in summary.metadata:
            with contextlib.suppress(DamagedError):
                record = self.file.record(index.offset, summary.data_limit)
                if isinstance(record, Metadata):
                    metadata[record.name] = record.metadata
        parts = [Part(Opcode.CHUNK, offset, offset + chunk.chunk_length,
                      frozenset(chunk.message_index_offsets), chunk.message_start_time,
                      chunk.message_end_time) for offset, chunk in sorted(summary.chunks.items())]
        return Index(parts, metadata, summary.schemas, summary.channels)

    @property
    def _message_parts(self) -> list[Part]:
        return [part for part in self._index.parts if part.channel_ids]

    def _leads_to_chunk(self, index: ChunkIndex) -> bool:
        head = struct.pack(
            '<BQQQ', Opcode.CHUNK, (index.chunk_length - HEAD.size) % (1 << 64),
            index.message_start_time, index.message_end_time)
        return self.file.read(index.chunk_start_offset, len(head)) == head

    def _read_header(self) -> Header:
        """Return the header; raises LogError if neither magic nor header is there."""
        magic = self.file.read(0, MAGIC_SIZE)
        with contextlib.suppress(DamagedError):
            header = self.file.record(MAGIC_SIZE, self.size)
            if isinstance(header, Header):
                return header
        if magic != MCAP0_MAGIC:
            reason = 'it is no MCAP file' if magic else 'it is empty'
            raise LogError(f'cannot read {self.path}: {reason}')
        return Header(profile='ros2', library='')
