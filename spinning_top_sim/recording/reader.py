# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones, with mcap's records.

Lengths lead from record to record, so that no index is needed.
"""

import contextlib
import itertools
import os
import struct
import zlib
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, McapRecord, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import rosbag2
from spinning_top_sim.recording.errors import MAX_BYTES, Damage, LogError

HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows
MESSAGE = struct.Struct('<HIQQ')    # channel, sequence, log and publish time, before the data
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)
MESSAGE_BYTES = 300         # of memory that a message takes besides its data
MOST_INDEX = 1 << 20        # bytes behind the last chunk that may be torn without a loss
BLOCK = 16384               # messages that are grouped together
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


class Place(NamedTuple):
    """Where messages are: a chunk, or a message that is in none."""

    begin_ns: int               # earliest log time
    offset: int                 # in the file
    end: int
    end_ns: int                 # latest log time
    channels: frozenset[int]


class LogReader(contextlib.AbstractContextManager['LogReader']):
    """
    An MCAP file, open for reading; a context manager.

    Opening reads it through once.  What is damaged is left out from then on.

    Parameters
    ----------
    path : path
        The file, or a folder as `ros2 bag` makes it, which must hold exactly one.
    max_bytes : int
        Of the largest record, and the largest uncompressed chunk, that is read; and of the
        messages of other chunks that `messages` holds while it reads one.
    compressed : bool
        Read a log whose messages rosbag2 has compressed one by one, and leave them so.

    Raises
    ------
    LogError
        If it is no MCAP file, or its messages are compressed.

    Notes
    -----
    Attributes are `path` and `size` [bytes] of the file when it was opened; `profile` and
    `library`, which its header names; `damage`; `whole`, whether there is none; `metadata`, the
    last of each name; `schemas` and `channels`, mcap's records by id; `span`, the earliest and the
    latest log time [ns], both 0 without messages.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES, *,
                 compressed: bool = False) -> None:
        self.path, self._max_bytes = _file_of(Path(path)), max_bytes
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.damage = Damage()
        self._places: list[Place] = []
        self._attached: list[tuple[int, int]] = []      # begin and end of records
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
            self._read_through()
            if not compressed and rosbag2.has_compressed_messages(self.path, self.metadata):
                raise LogError(f'cannot read {self.path}: rosbag2 has compressed its messages one '
                               'by one; `ros2 bag convert` makes a bag without that')
        except BaseException:
            self.close()
            raise
        self._places.sort()
        self.span = (min((place.begin_ns for place in self._places), default=0),
                     max((place.end_ns for place in self._places), default=0))

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        self._file.close()

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def whole(self) -> bool:
        return self.damage == Damage()

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        return tuple(LogTopic(
            channel.topic, schema.name if schema else '', channel.message_encoding,
            rosbag2.qos_profiles(channel), number)
            for number, channel in sorted(self.channels.items())
            for schema in [self.schemas.get(channel.schema_id)])

    def messages(self, topics: Iterable[str] | None = None, start: int = 0,
                 end: int = 1 << 64) -> Iterator[LogMessage]:
        """
        Iterate over the messages in the order of their log times, equal ones in file order.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default: all.
        start, end : int
            Log times [ns]; `end` is exclusive.

        Yields
        ------
        LogMessage
            With its serialized bytes.

        Raises
        ------
        LogError
            For too many chunks of one time.
        """
        names = None if topics is None else frozenset(topics)
        wanted = {number for number, channel in self.channels.items()
                  if names is None or channel.topic in names}
        # Of the chunks that are read: log time, place in the file, and in the chunk; message
        waiting: list[tuple[int, int, int, LogMessage]] = []
        for place in [*self._places, Place(1 << 64, 0, 0, 1 << 64, frozenset())]:
            passed = bisect_left(waiting, place[:2])
            yield from (one[-1] for one in waiting[:passed])
            del waiting[:passed]
            if place.end_ns < start or place.begin_ns >= end or wanted.isdisjoint(place.channels):
                continue
            if sum(MESSAGE_BYTES + len(one[-1].data) for one in waiting) > self._max_bytes:
                raise LogError(f'cannot read {self.path}: its chunks overlap in time, and '
                               f'more than {self._max_bytes} bytes of them are not held')
            waiting += [(one.log_time, place.offset, number, one)
                        for number, one in enumerate(self._messages_in(place))
                        if one.channel_id in wanted and start <= one.log_time < end]
            waiting.sort()

    def groups(self, topics: Iterable[str] | None = None,
               ) -> Iterator[tuple[str, list[LogMessage]]]:
        """
        Iterate over messages as `messages` does, some of one topic at a time.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default: all.

        Yields
        ------
        (str, list of LogMessage)
            A topic, and messages in the order of `messages`.
        """
        messages = self.messages(topics)
        while block := sorted(itertools.islice(messages, BLOCK), key=attrgetter('topic')):
            for topic, group in itertools.groupby(block, attrgetter('topic')):
                yield topic, list(group)

    def in_file_order(self) -> Iterator[LogMessage]:
        """
        Iterate over all messages.

        Yields
        ------
        LogMessage
            In the order of the file.
        """
        for place in sorted(self._places, key=attrgetter('offset')):
            yield from self._messages_in(place)

    def attached(self) -> Iterator[Metadata | Attachment]:
        """
        Iterate over metadata and attachments.

        Yields
        ------
        Metadata or Attachment
            Records of mcap, in the order of the file.
        """
        for offset, end in self._attached:
            record = next(_records_in(self._at(offset, end)))
            if isinstance(record, Metadata | Attachment):
                yield record

    # -------------------------------------------------------------------------------- the bytes

    def _at(self, offset: int, end: int) -> bytes:
        """Return the bytes there.  Raises UNREADABLE if there are fewer, or too many."""
        if end > min(self.size, offset + self._max_bytes):
            raise McapError
        try:
            raw = os.pread(self._file.fileno(), end - offset, offset)
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error
        if len(raw) < end - offset:     # it has become shorter
            raise McapError
        return raw

    def _read_header(self) -> Header:
        """Return the header.  Raises LogError for no MCAP file."""
        magic = self._at(0, min(MAGIC_SIZE, self.size))
        with contextlib.suppress(*UNREADABLE):
            _, offset, end = next(self._heads(), (0, 0, 0))
            header = next(_records_in(self._at(offset, end)))
            if magic == MCAP0_MAGIC and isinstance(header, Header):
                return header
        reason = 'it is no MCAP file' if magic else 'it is empty'
        if form := COMPRESSED.get(magic[:4]):
            reason = f'it is compressed as a whole, unpack it by {form} -d'
        raise LogError(f'cannot read {self.path}: {reason}')

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

    def _read_through(self) -> None:
        """Note what is declared and where, and what is damaged."""
        damage, crc, opcode = self.damage, zlib.crc32(MCAP0_MAGIC), 0
        for opcode, offset, end in self._heads():
            try:
                raw = self._at(offset, end)
                self._note(raw, offset, end)
            except UNREADABLE:
                lost = min(end, self.size) - offset
                # What follows the last chunk of a log tells nothing new.
                if end <= self.size or lost > MOST_INDEX or opcode not in (
                        Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.DATA_END):
                    damage.lost_bytes += lost
                continue
            if opcode == Opcode.DATA_END and not damage.lost_bytes:
                damage.changed = int.from_bytes(raw[HEAD.size:][:4], 'little') not in (0, crc)
            crc = zlib.crc32(raw, crc)
        damage.torn = opcode != Opcode.DATA_END or not self._ends_at(end)

    def _note(self, raw: bytes, offset: int, end: int) -> None:
        """Note what is declared in a record or chunk, and its messages; UNREADABLE."""
        times_ns, channels = [], set()
        for opcode, record in _records(raw, self._max_bytes):
            if opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = MESSAGE.unpack_from(record)
                times_ns.append(log_time)
                channels.add(channel)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
                self._declare(next(_records_in(HEAD.pack(opcode, len(record)) + record)),
                              (offset, end))
        if not channels <= self.channels.keys():
            raise McapError
        if times_ns:
            self._places.append(
                Place(min(times_ns), offset, end, max(times_ns), frozenset(channels)))

    def _declare(self, record: McapRecord, place: tuple[int, int]) -> None:
        """Note a schema, a channel or metadata."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        else:
            self._attached.append(place)
            if isinstance(record, Metadata):
                self.metadata[record.name] = record.metadata

    def _ends_at(self, offset: int) -> bool:
        """Return whether a summary with the right checksum, and the end of the file are there."""
        with contextlib.suppress(*UNREADABLE):
            rest = self._at(offset, self.size)
            *_, footer = _records_in(rest)
            return isinstance(footer, Footer) and (
                footer.summary_crc in (0, zlib.crc32(rest[:-MAGIC_SIZE - 4])))
        return False

    def _messages_in(self, place: Place) -> Iterator[LogMessage]:
        try:
            for opcode, record in _records(self._at(place.offset, place.end), self._max_bytes):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(record)
                    yield LogMessage(self.channels[channel].topic, log_time, publish_time,
                                     sequence, record[MESSAGE.size:], channel)
        except UNREADABLE as error:
            raise LogError(f'cannot read {self.path}: it has changed meanwhile') from error


def _records_in(raw: bytes) -> Iterator[McapRecord]:
    """Iterate over the records in bytes as mcap reads them; UNREADABLE."""
    return StreamReader(BytesIO(raw), skip_magic=True, emit_chunks=True).records


def _records(raw: bytes, max_bytes: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of a record, or of each in it if it is a chunk; UNREADABLE."""
    # Objects of mcap for all messages would take twice the time of `inspect`.
    plain = _unpacked(raw, max_bytes) if raw[0] == Opcode.CHUNK else raw
    end = 0
    while end < len(plain):
        opcode, length = HEAD.unpack_from(plain, end)
        begin = end + HEAD.size
        end = begin + length
        if end > len(plain):
            raise McapError
        yield opcode, plain[begin:end]


def _unpacked(raw: bytes, max_bytes: int) -> bytes:
    """Return the records in a chunk, which mcap would unpack to any size; UNREADABLE."""
    chunk = next(_records_in(raw))
    assert isinstance(chunk, Chunk)
    if chunk.uncompressed_size > max_bytes:
        raise McapError
    stream: BinaryIO = BytesIO(chunk.data)
    if chunk.compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == 'lz4':
        stream = lz4.frame.open(stream)
    elif chunk.compression:
        raise McapError
    try:
        plain = stream.read(chunk.uncompressed_size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        raise McapError from None
    if len(plain) != chunk.uncompressed_size or (
            chunk.uncompressed_crc not in (0, zlib.crc32(plain))):
        raise McapError
    return plain


def _file_of(path: Path) -> Path:
    """Return a file, or the one in a folder; raises LogError."""
    if not path.is_dir():
        return path
    files = sorted([*path.glob('*.mcap')] or path.glob('*.mcap.*'))
    if len(files) != 1:
        raise LogError(f'cannot read {path}: a folder must hold one .mcap file; in it: '
                       f'{", ".join(file.name for file in files) or "none"}')
    return files[0]
