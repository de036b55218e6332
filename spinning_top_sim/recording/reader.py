# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones, with mcap's records.

Lengths lead from record to record, so that no index is needed.
"""

import contextlib
import heapq
import itertools
import os
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from mcap import records
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Footer, Header, McapRecord, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import rosbag2
from spinning_top_sim.recording.errors import MAX_BYTES, Damage, LogError
from spinning_top_sim.recording.parsing import (
    HEAD,
    UNREADABLE,
    decompress,
    message_layout,
    records_in,
    unpacked,
)

MOST_INDEX = 1 << 20        # bytes behind the last chunk that may be torn without a loss
MESSAGE_BYTES = 300         # of memory that a message takes besides its data
BLOCK = 16384               # messages that are grouped together
NOTED = Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT
# Where log times stand: the earliest and the latest in a chunk, and that of a message
TIMES: dict[int, struct.Struct] = {
    Opcode.CHUNK: struct.Struct('<9xQQ'), Opcode.MESSAGE: struct.Struct('<15xQ')}
COMPRESSED = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}     # as a whole


class LogMessage(NamedTuple):
    """A message of a log."""

    topic: str
    log_time: int       # [ns]
    publish_time: int   # [ns]
    sequence: int       # number in its channel
    data: bytes         # the serialized message
    channel_id: int


class LogTopic(NamedTuple):
    """A channel of a log."""

    name: str
    type_name: str              # such as 'sensor_msgs/msg/Imu', empty without schema
    encoding: str               # of the messages, such as 'cdr'
    qos: tuple[rosbag2.Qos, ...]    # offered profiles, with the keys of `rosbag2.DEFAULT_QOS`
    channel_id: int


class LogReader(contextlib.AbstractContextManager['LogReader']):
    """
    An MCAP file, open for reading; a context manager.  Raises LogError if it is none.

    What is damaged is left out.  A file that was not closed is read through at once.

    Parameters
    ----------
    path : path
        The file, or a folder as `ros2 bag` makes it, which must hold exactly one.
    max_bytes : int
        Of the largest record, and the largest uncompressed chunk, that is read; and of the
        messages of other chunks that `messages` holds while it reads one.

    Notes
    -----
    Attributes are `path` and `size` [bytes] of the file when it was opened; `profile` and
    `library`, which its header names; `whole`, whether it was closed, and its summary, if any,
    describes it; `metadata`, the last of each name; `schemas` and `channels`, mcap's records by
    id; `span`, the earliest and the latest log time [ns], both 0 without messages; `left_out`,
    the number of damaged chunks that `messages` has skipped so far.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> None:
        self.path, self._max_bytes = _file_of(Path(path)), max_bytes
        self._left_out: set[int] = set()        # offsets of chunks
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        # By the summary: channels in the chunk at an offset, and the number of messages
        self._channels_in: dict[int, Collection[int]] = {}
        self._counted: int | None = None
        try:
            if self.path.exists() and not self.path.is_file():     # opening a pipe would block
                raise LogError(f'cannot read {self.path}: it is no regular file')
            self._file = open(self.path, 'rb', buffering=0)  # noqa: SIM115
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            header = self._read_header()
            self.profile, self.library = header.profile, header.library
            try:
                self._read_summary()
                closed = True
            except UNREADABLE:
                closed = False
            self._places = sorted(self._find_places())
            self.whole = closed and self._channels_in.keys() <= {
                offset for _, offset, _, _ in self._places}
            self.span = (self._places[0][0] if self._places else 0,
                         max((end_ns for _, _, end_ns, _ in self._places), default=0))
            if not self.whole or not self.channels:
                _ = self.damage     # notes what is declared in chunks
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        self._file.close()

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        return tuple(LogTopic(
            channel.topic, schema.name if schema else '', channel.message_encoding,
            rosbag2.qos_profiles(channel), number)
            for number, channel in sorted(self.channels.items())
            for schema in [self.schemas.get(channel.schema_id)])

    @property
    def left_out(self) -> int:
        return len(self._left_out)

    @cached_property
    def compression(self) -> tuple[str, str]:
        """Mode, as 'MESSAGE', and format of compression, if rosbag2 has compressed; LogError."""
        text = self.metadata.get(rosbag2.BAG_METADATA, {}).get('serialized_metadata', '')
        beside = self.path.with_name('metadata.yaml')
        try:
            if not text and beside.is_file():
                text = beside.read_text(errors='replace')
        except OSError as error:
            raise LogError(f'cannot read {beside}: {error.strerror}') from error
        return rosbag2.compression_of(text)

    @cached_property
    def damage(self) -> Damage:
        """What is wrong with the file; reads all of it."""
        for _ in self.parts():
            pass
        return self.damage

    def messages(self, topics: Iterable[str] | None = None, start: int | None = None,
                 end: int | None = None) -> Iterator[LogMessage]:
        """
        Iterate over the messages in the order of their log times, equal ones in file order.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default: all.
        start, end : int, optional
            Log times [ns]; `end` is exclusive.

        Yields
        ------
        LogMessage
            Decompressed, where rosbag2 has compressed messages one by one.

        Raises
        ------
        LogError
            For a message that cannot be decompressed, and for too many chunks of one time.
        """
        names = None if topics is None else frozenset(topics)
        wanted = {number for number, channel in self.channels.items()
                  if names is None or channel.topic in names}
        times = range(start or 0, 1 << 64 if end is None else end)
        # Of each chunk that is read and not yet passed: log time of its next message, place,
        # that message, those after it, and the bytes of memory of all
        held: list[tuple[int, int, LogMessage, Iterator[LogMessage], int]] = []
        held_bytes = 0
        mode, form = self.compression
        for start_ns, offset, end_ns, its_end in [*self._places, (1 << 64, 0, 0, 0)]:
            while held and held[0] < (start_ns, offset):
                _, place, message, others, size = held[0]
                if (following := next(others, None)) is None:
                    heapq.heappop(held)
                    held_bytes -= size
                else:
                    heapq.heapreplace(held, (following.log_time, place, following, others, size))
                yield self._decompressed(message, form) if mode == 'MESSAGE' else message
            if end_ns < times.start or start_ns >= times.stop or wanted.isdisjoint(
                    self._channels_in.get(offset) or wanted):
                continue
            if held_bytes > self._max_bytes:
                raise LogError(f'cannot read {self.path}: its chunks overlap in time, and '
                               f'more than {self._max_bytes} bytes of them are not held')
            try:
                messages, _ = self._records(self._at(offset, its_end))
            except UNREADABLE:
                self._left_out.add(offset)
                continue
            chosen = sorted((one for one in messages if one.channel_id in wanted
                             and one.log_time in times), key=attrgetter('log_time'))
            if chosen:
                size = sum(MESSAGE_BYTES + len(one.data) for one in chosen)
                held_bytes += size
                first, *later = chosen
                heapq.heappush(held, (first.log_time, offset, first, iter(later), size))

    def _decompressed(self, message: LogMessage, form: str) -> LogMessage:
        try:
            return message._replace(
                data=decompress(message.data, form or 'unknown', self._max_bytes))
        except McapError as error:
            raise LogError(f'cannot read {self.path}: a message of {message.topic}: '
                           f'{error}') from None

    def groups(self, topics: Iterable[str] | None = None,
               ) -> Iterator[tuple[str, list[LogMessage]]]:
        """
        Iterate over the messages of topics as `messages` does, some of one topic at a time.

        Yields
        ------
        (str, list of LogMessage)
            A topic, and messages in the order of `messages`.
        """
        messages = self.messages(topics)
        while block := sorted(itertools.islice(messages, BLOCK), key=attrgetter('topic')):
            for topic, group in itertools.groupby(block, attrgetter('topic')):
                yield topic, list(group)

    def parts(self) -> Iterator[tuple[int, list[LogMessage], list[McapRecord]]]:
        """
        Iterate over what can be read, in file order; then `damage` tells what cannot.

        Yields
        ------
        (int, list of LogMessage, list of McapRecord)
            The offset of a record or chunk, its messages, and what it declares or attaches.
        """
        damage = Damage(not self.whole)
        damage.reasons += ['found: the summary at the end is missing or wrong'] * damage.torn
        crc, count = zlib.crc32(MCAP0_MAGIC), 0
        for opcode, offset, end in self._heads():
            # What follows the last chunk is made anew.
            if damage.torn and end > self.size < offset + MOST_INDEX and opcode in (
                    Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.DATA_END):
                break
            try:
                raw = self._at(offset, end)
                messages, others = self._records(raw)
            except UNREADABLE as error:
                lost = min(end, self.size) - offset
                damage.lost_bytes += lost
                damage.reasons.append(f'found: {lost} bytes at byte {offset}: '
                                      f'{str(error) or "a length in it is wrong"}')
                continue
            if opcode == Opcode.DATA_END and not damage.lost_bytes and (
                    int.from_bytes(raw[9:13], 'little') not in (0, crc)):
                damage.reasons.append('found: the checksum of the data section is wrong')
            crc = zlib.crc32(raw, crc)
            count += len(messages)
            yield offset, messages, others
        if self._counted not in (None, count) and not damage.lost_bytes:
            damage.lost_messages = max(self._counted - count, 0)
            damage.reasons.append(f'found: {count} messages, where the summary counts '
                                  f'{self._counted}')
        self.damage = damage

    # -------------------------------------------------------------------------------- the bytes

    def _at(self, offset: int, end: int) -> bytes:
        """Return the bytes there.  Raises UNREADABLE if there are fewer, or too many."""
        if not 0 <= offset <= end <= self.size:
            raise EndOfFile('no whole record')
        if end - offset > self._max_bytes:
            raise McapError(f'more than {self._max_bytes} bytes are not read')
        try:
            return os.pread(self._file.fileno(), end - offset, offset)
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error

    def _heads(self) -> Iterator[tuple[int, int, int]]:
        """Yield opcode, begin and end of records, of which the last may end behind the file."""
        opcode, end = 0, MAGIC_SIZE
        while end < self.size and opcode not in (Opcode.DATA_END, Opcode.FOOTER):
            offset = end
            head = self._at(offset, min(offset + HEAD.size, self.size))
            opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\xff'))
            # A file system may leave zeros behind a tear.
            end = offset + HEAD.size + length if opcode else self.size + 1
            yield opcode, offset, end

    def _records(self, raw: bytes) -> tuple[list[LogMessage], list[McapRecord]]:
        """Return the messages, and after noting them the others, in a record; UNREADABLE."""
        plain = unpacked(raw, self._max_bytes) if raw[0] == Opcode.CHUNK else raw
        messages: list[LogMessage] = []
        others: list[McapRecord] = []
        at = 0
        while at < len(plain):
            opcode, length = HEAD.unpack_from(plain, at)
            end = at + HEAD.size + length
            if end > len(plain):
                raise McapError('a length in it is wrong')
            if opcode == Opcode.MESSAGE:
                end = self._add_messages(messages, plain, at, message_layout(length))
            elif opcode in NOTED:
                others.append(next(records_in(plain[at:end])))
                self._declare(others[-1])
            at = end
        return messages, others

    def _add_messages(self, found: list[LogMessage], plain: bytes, at: int,
                      layout: struct.Struct) -> int:
        """Add the messages of this layout that begin there; return where they end; UNREADABLE."""
        # Those of a topic, which follow one another in our chunks, are unpacked together.
        last = len(plain) - (len(plain) - at) % layout.size
        length = layout.size - HEAD.size
        try:
            for opcode, its_length, channel, sequence, log_time, publish_time, data in (
                    layout.iter_unpack(memoryview(plain)[at:last])):
                if opcode != Opcode.MESSAGE or its_length != length:
                    break
                found.append(LogMessage(self.channels[channel].topic, log_time, publish_time,
                                        sequence, data, channel))
                at += layout.size
        except KeyError:
            raise McapError('no whole record declares a channel of its messages') from None
        return at

    def _declare(self, record: McapRecord) -> None:
        """Note a schema, a channel or metadata; of several with an id, the first counts."""
        if isinstance(record, records.Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, records.ChunkIndex):
            self._channels_in[record.chunk_start_offset] = record.message_index_offsets
        elif isinstance(record, records.Statistics):
            self._counted = record.message_count

    def _find_places(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield (first time, offset, last time, end) of chunks and messages; note the others."""
        for opcode, offset, end in self._heads():
            with contextlib.suppress(*UNREADABLE):
                if opcode in TIMES and end <= self.size:
                    times = TIMES[opcode].unpack(self._at(offset, offset + TIMES[opcode].size))
                    yield times[0], offset, times[-1], end
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                    self._records(self._at(offset, end))

    def _read_summary(self) -> None:
        """Note what the summary declares.  UNREADABLE if it is damaged or the file is torn."""
        footer_at = self.size - FOOTER_SIZE - MAGIC_SIZE
        footer = next(records_in(self._at(footer_at, self.size)))
        if not isinstance(footer, Footer):
            raise McapError
        summary = self._at(footer.summary_start or footer_at, self.size)
        if footer.summary_crc not in (0, zlib.crc32(summary[:-MAGIC_SIZE - 4])):
            raise McapError
        for record in records_in(summary):     # to the footer, and the magic behind it
            self._declare(record)

    def _read_header(self) -> Header:
        """Return the header.  Raises LogError for no MCAP file."""
        magic = self._at(0, min(MAGIC_SIZE, self.size))
        with contextlib.suppress(*UNREADABLE):
            _, offset, end = next(self._heads(), (0, 0, 0))
            header = next(records_in(self._at(offset, end)))
            if magic == MCAP0_MAGIC and isinstance(header, Header):
                return header
        reason = 'it is no MCAP file' if magic else 'it is empty'
        if form := COMPRESSED.get(magic[:4]):
            reason = f'it is compressed as a whole, unpack it by {form} -d'
        raise LogError(f'cannot read {self.path}: {reason}')


def _file_of(path: Path) -> Path:
    """Return a file, or the one in a folder; raises LogError."""
    if not path.is_dir():
        return path
    files = sorted([*path.glob('*.mcap')] or path.glob('*.mcap.*'))
    if len(files) != 1:
        raise LogError(f'cannot read {path}: a folder must hold one .mcap file; in it: '
                       f'{", ".join(file.name for file in files) or "none"}')
    return files[0]
