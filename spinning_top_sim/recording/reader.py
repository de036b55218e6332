# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones, and recovers them.

Lengths lead from record to record, so that no index is needed.
"""

import contextlib
import itertools
import os
import re
import struct
import zlib
from bisect import bisect_left
from collections.abc import Collection, Container, Iterator
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.writer import MCAP0_MAGIC, Writer

from spinning_top_sim.files import new_file
from spinning_top_sim.recording import rosbag2
from spinning_top_sim.recording.errors import MAX_BYTES, LogError

HEAD = struct.Struct('<BQ')         # of every record: opcode, length of what follows
MESSAGE = struct.Struct('<HIQQ')    # channel, sequence, log and publish time, before the data
UNREADABLE = (McapError, ValueError, OverflowError, struct.error)
MESSAGE_BYTES = 300         # of memory that a message takes besides its data
MOST_INDEX = 1 << 20        # bytes behind the last chunk that may be torn without a loss
BLOCK = 16384               # messages that are grouped together
# Records besides messages and chunks that are read.
KINDS: dict[int, Any] = {
    Opcode.HEADER: Header, Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata, Opcode.ATTACHMENT: Attachment}
ATTACHED = (Opcode.METADATA, Opcode.ATTACHMENT)
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
    channel_id: int


class Place(NamedTuple):
    """Where messages or attached records are: a chunk, or a record that is in none."""

    begin_ns: int               # earliest log time of the messages
    offset: int                 # in the file
    end: int
    end_ns: int                 # latest log time
    channels: frozenset[int]    # of the messages


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

    Raises
    ------
    LogError
        If it is no MCAP file, or its messages are compressed.

    Notes
    -----
    Attributes are `path` and `size` [bytes] of the file when it was opened; `metadata`, the last
    of each name; `header`, `schemas` and `channels`, mcap's records, the latter two by id; `span`,
    the earliest and the latest log time [ns], both 0 without messages.  What is wrong with a log:
    `torn`, whether its summary is missing or wrong; `lost_bytes`, which cannot be read; `changed`,
    whether what can be read has another checksum than was written.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> None:
        self.path, self._max_bytes = _file_of(Path(path)), max_bytes
        self.header = Header('', '')
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.lost_bytes, self.changed = 0, False
        # Of messages; of metadata and attachments.
        self._places, self._attached = list[Place](), list[Place]()
        try:
            if self.path.exists() and not self.path.is_file():     # opening a pipe would block
                raise LogError(f'cannot read {self.path}: it is no regular file')
            self._file = open(self.path, 'rb', buffering=0)  # noqa: SIM115
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self._check_magic()
            self._read_through()
            if rosbag2.has_compressed_messages(self.path, self.metadata):
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
        return not self.damage

    @property
    def damage(self) -> list[str]:
        """A line about each kind of damage; none of a log that is whole."""
        return [text for text, is_there in (
            (f'lost: {self.lost_bytes} bytes', self.lost_bytes),
            ('found: the summary at the end is missing or wrong', self.torn),
            ('found: the checksum of the data section is wrong', self.changed)) if is_there]

    @property
    def topics(self) -> tuple[LogTopic, ...]:
        """The channels of the log, in the order of their ids."""
        return tuple(LogTopic(
            channel.topic, schema.name if schema else '', channel.message_encoding, number)
            for number, channel in sorted(self.channels.items())
            for schema in [self.schemas.get(channel.schema_id)])

    def messages(self, topics: Collection[str] | None = None, start: int = 0,
                 end: int = 1 << 64) -> Iterator[LogMessage]:
        """
        Iterate over the messages in the order of their log times, equal ones in file order.

        Parameters
        ----------
        topics : collection of str, optional
            Names; default: all.
        start, end : int
            Log times [ns]; `end` is exclusive.

        Yields
        ------
        LogMessage
            Raises LogError for too many chunks of one time.
        """
        wanted = {number for number, channel in self.channels.items()
                  if topics is None or channel.topic in topics}
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
                        for number, one in enumerate(self._contents(place))
                        if one.channel_id in wanted and start <= one.log_time < end]
            waiting.sort()

    def groups(self) -> Iterator[tuple[str, list[LogMessage]]]:
        """Yield topics and messages of each, some at a time, in the order of `messages`."""
        messages = self.messages()
        while block := sorted(itertools.islice(messages, BLOCK), key=attrgetter('topic')):
            for topic, group in itertools.groupby(block, attrgetter('topic')):
                yield topic, list(group)

    def recorded(self) -> Iterator[LogMessage | Metadata | Attachment]:
        """Yield messages, and metadata and attachments as records of mcap, in file order."""
        for place in sorted([*self._places, *self._attached], key=attrgetter('offset')):
            yield from self._contents(place, ATTACHED)

    def _at(self, offset: int, end: int) -> bytes:
        """Return the bytes there.  Raises UNREADABLE if there are fewer, or too many."""
        if not offset <= end <= min(self.size, offset + self._max_bytes):
            raise McapError
        try:
            raw = os.pread(self._file.fileno(), end - offset, offset)
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error
        if len(raw) < end - offset:     # it has become shorter
            raise McapError
        return raw

    def _check_magic(self) -> None:
        magic = self._at(0, min(MAGIC_SIZE, self.size))
        if magic != MCAP0_MAGIC:
            reason = 'it is no MCAP file' if magic else 'it is empty'
            if form := COMPRESSED.get(magic[:4]):
                reason = f'it is compressed as a whole, unpack it by {form} -d'
            raise LogError(f'cannot read {self.path}: {reason}')

    def _read_through(self) -> None:
        """Note what is declared and where, and what is damaged."""
        opcode, end, crc = 0, MAGIC_SIZE, zlib.crc32(MCAP0_MAGIC)
        while end < self.size and opcode not in (Opcode.DATA_END, Opcode.FOOTER):
            offset = end
            head = self._at(offset, min(offset + HEAD.size, self.size))
            opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\xff'))
            # A file system may leave zeros behind a tear.
            end = offset + HEAD.size + length if opcode else self.size + 1
            try:
                raw = self._at(offset, end)
                self._note(raw, offset, end)
            except UNREADABLE:
                lost = min(end, self.size) - offset
                # What follows the last chunk of a log tells nothing new.
                if end <= self.size or lost > MOST_INDEX or opcode not in (
                        Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.DATA_END):
                    self.lost_bytes += lost
                continue
            if opcode == Opcode.DATA_END and not self.lost_bytes:
                self.changed = int.from_bytes(raw[HEAD.size:][:4], 'little') not in (0, crc)
            crc = zlib.crc32(raw, crc)
        self.torn = opcode != Opcode.DATA_END or not self._ends_at(end)

    def _note(self, raw: bytes, offset: int, end: int) -> None:
        """Note what is in a record or chunk.  Raises UNREADABLE."""
        times_ns, channels = [], set()
        for opcode, content in _records(raw, self._max_bytes):
            if opcode == Opcode.MESSAGE:
                channel, _, log_time, _ = MESSAGE.unpack_from(content)
                times_ns.append(log_time)
                channels.add(channel)
            elif opcode in KINDS:
                record = _parsed(KINDS[opcode], content)
                if opcode == Opcode.HEADER:
                    self.header = record
                elif opcode == Opcode.SCHEMA:
                    self.schemas[record.id] = record
                elif opcode == Opcode.CHANNEL:
                    self.channels[record.id] = record
                elif opcode == Opcode.METADATA:
                    self.metadata[record.name] = record.metadata
        if not channels <= self.channels.keys():
            raise McapError
        if channels:
            self._places.append(
                Place(min(times_ns), offset, end, max(times_ns), frozenset(channels)))
        elif raw[0] in ATTACHED:
            self._attached.append(Place(0, offset, end, 0, frozenset()))

    def _ends_at(self, offset: int) -> bool:
        """Return whether a summary with the right checksum, and the end of the file are there."""
        with contextlib.suppress(*UNREADABLE):
            rest = self._at(offset, self.size)
            *_, footer = StreamReader(BytesIO(rest), skip_magic=True, emit_chunks=True).records
            return isinstance(footer, Footer) and (
                footer.summary_crc in (0, zlib.crc32(rest[:-MAGIC_SIZE - 4])))
        return False

    def _contents(self, place: Place, also: Container[int] = ()) -> Iterator[Any]:
        """Yield messages, and records of other opcodes."""
        try:
            for opcode, content in _records(self._at(place.offset, place.end), self._max_bytes):
                if opcode == Opcode.MESSAGE:
                    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(content)
                    yield LogMessage(self.channels[channel].topic, log_time, publish_time,
                                     sequence, content[MESSAGE.size:], channel)
                elif opcode in also:
                    yield _parsed(KINDS[opcode], content)
        except UNREADABLE as error:
            raise LogError(f'cannot read {self.path}: it has changed meanwhile') from error


def recover(reader: LogReader, output: Path) -> int:
    """
    Write all that can be read of a log into a new file; return the number of messages.

    Raises LogError or OSError, also if a torn file holds no whole message, and leaves no file.
    """
    count = 0
    with new_file(output, 'xb') as file:
        writer = Writer(file)
        writer.start(reader.header.profile, reader.header.library)
        schemas = {number: writer.register_schema(one.name, one.encoding, one.data)
                   for number, one in reader.schemas.items()}
        # In MCAP the schema id 0 means: no schema.
        channels = {number: writer.register_channel(
            one.topic, one.message_encoding, schemas.get(one.schema_id, 0), one.metadata)
            for number, one in reader.channels.items()}
        for one in reader.recorded():
            if isinstance(one, Metadata):
                writer.add_metadata(one.name, one.metadata)
            elif isinstance(one, Attachment):
                writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type,
                                      one.data)
            else:
                writer.add_message(channels[one.channel_id], one.log_time, one.data,
                                   one.publish_time, one.sequence)
                count += 1
        if reader.torn and not count:
            raise LogError(f'nothing to save in {reader.path}: there is no whole message in it')
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
    return count


def _parsed(kind: Any, content: bytes) -> Any:
    """Return a record of mcap.  Raises UNREADABLE."""
    return kind.read(ReadDataStream(BytesIO(content)))


def _records(raw: bytes, max_bytes: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of a record, or of each in a chunk.  Raises UNREADABLE."""
    # Objects of mcap for all messages would take twice the time of `inspect`.
    plain = raw
    if raw[0] == Opcode.CHUNK:
        plain = _unpacked(_parsed(Chunk, raw[HEAD.size:]), max_bytes)
    end = 0
    while end < len(plain):
        opcode, length = HEAD.unpack_from(plain, end)
        begin = end + HEAD.size
        end = begin + length
        if end > len(plain):
            raise McapError
        yield opcode, plain[begin:end]


def _unpacked(chunk: Chunk, max_bytes: int) -> bytes:
    """Return the records in a chunk, which mcap would unpack to any size.  Raises UNREADABLE."""
    stream: BinaryIO = BytesIO(chunk.data)
    if chunk.compression == 'zstd':
        stream = zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True)
    elif chunk.compression == 'lz4':
        stream = lz4.frame.open(stream)
    elif chunk.compression:
        raise McapError
    plain = b''
    with contextlib.suppress(zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        plain = stream.read(min(chunk.uncompressed_size, max_bytes) + 1)
    if len(plain) != chunk.uncompressed_size or (
            chunk.uncompressed_crc not in (0, zlib.crc32(plain))):
        raise McapError
    return plain


def _file_of(path: Path) -> Path:
    """Return a file, or the one in a folder, and in its metadata.yaml; raises LogError."""
    if not path.is_dir():
        return path
    files = sorted([*path.glob('*.mcap')] or path.glob('*.mcap.*'))
    text = ''.join(one.read_text(errors='replace') for one in path.glob('metadata.yaml'))
    count = max(len(files), len({*re.findall(r'[^\s/"\']+\.mcap', text)}))    # some may be missing
    if count != 1:
        raise LogError(f'cannot read {path}: the bag in a folder must have one .mcap file, not '
                       f'{count}: `ros2 bag convert` makes one')
    return files[0]
