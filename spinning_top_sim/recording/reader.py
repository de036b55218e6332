# SPDX-License-Identifier: Apache-2.0
"""
Reads MCAP logs of any writer, also truncated and damaged ones.

The summary of a whole file leads to its messages; any other file is read from record to record.
"""

import contextlib
import itertools
import os
import zlib
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from io import BytesIO, FileIO
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap import records
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import decoding, rosbag2
from spinning_top_sim.recording.decoding import HEAD, CompleteReads, LogMessage, Messages
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.writer import record_bytes, time_span

MAX_BYTES = 256 << 20       # of one record or one uncompressed chunk in memory
MOST_REASONS = 20           # of damage that are told
BLOCK = 16384               # messages that are read together
RUN_BYTES = 1 << 20         # of messages outside of chunks that are read together, about
MAGIC_SIZE = len(MCAP0_MAGIC)
FOOTER_SIZE, DATA_END_SIZE = HEAD.size + 8 + 8 + 4, HEAD.size + 4
FIRST_DATE = 10 ** 17       # [ns], in 1973
UNPACK = {b'\x28\xb5\x2f\xfd': 'zstd -d {} -o {}', b'\x04\x22\x4d\x18': 'lz4 -d {} {}'}


@dataclass(frozen=True)
class LogTopic:
    """A channel of a log."""

    name: str
    type_name: str              # such as 'sensor_msgs/msg/Imu', empty without schema
    schema: str                 # the definition with its dependencies
    schema_encoding: str        # such as 'ros2msg'
    encoding: str               # of the messages, such as 'cdr'
    qos: tuple[rosbag2.Qos, ...]    # offered profiles, with the keys of `rosbag2.DEFAULT_QOS`
    metadata: Mapping[str, str]
    channel_id: int


@dataclass
class Damage:
    """What is wrong with a log."""

    torn: bool                  # it does not end as an MCAP file ends
    lost_bytes: int = 0         # that cannot be read; indexes do not count
    reasons: list[str] = field(default_factory=list)

    def lose(self, offset: int, end: int, reason: str) -> None:
        self.lost_bytes += end - offset
        self.reasons.append(f'found: {end - offset} bytes at byte {offset}: {reason}')

    def lines(self) -> list[str]:
        """Return what is lost, and the first reasons."""
        lost = [f'lost: {self.lost_bytes} bytes'] if self.lost_bytes else []
        return lost + self.reasons[:MOST_REASONS]


class Part(NamedTuple):
    """A record, or adjacent messages outside of chunks."""

    record: records.McapRecord | None       # None for messages outside of chunks
    messages: Messages                      # these, or those of a chunk
    offset: int
    end: int


class LogReader(contextlib.AbstractContextManager['LogReader']):
    """
    An MCAP file, open for reading; a context manager.  Raises LogError if it is none.

    A file with a summary opens at once, any other is read through.  What is damaged is left out.

    Parameters
    ----------
    path : str or path
        The file, or a folder as `ros2 bag` makes it, which must hold exactly one.
    max_bytes : int
        Largest record, and largest uncompressed chunk, that is read into memory.

    Attributes
    ----------
    path, size : Path, int
        The file, of a folder the one in it, and its size when it was opened [bytes].
    profile, library : str
        What its header says: such as 'ros2', and the program that wrote it.
    whole : bool
        Whether the file was closed and its summary, if any, is right; see also `damage`.
    metadata : dict
        The metadata records by name; of several with one name, the last.
    schemas, channels : dict
        mcap's records by id.
    left_out : int
        Damaged chunks that `messages` has skipped so far.
    """

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> None:
        self.path, self._max_bytes, self.left_out = _file_of(Path(path)), max_bytes, 0
        self.metadata: dict[str, dict[str, str]] = {}
        self._small_bytes = 0       # of schemas, channels and metadata
        try:
            if self.path.exists() and not self.path.is_file():     # opening a pipe would block
                raise LogError(f'cannot read {self.path}: it is no regular file')
            self._file = CompleteReads(FileIO(self.path))
        except OSError as error:
            raise LogError(f'cannot read {self.path}: {error.strerror}') from error
        self.size = self._data_end = self._file.size
        try:
            header = self._read_header()
            self.profile, self.library = header.profile, header.library
            self._torn, self._summary, self._problem = True, Summary(), ''
            try:
                self._read_summary()
            except decoding.UNREADABLE as error:
                self._problem = f'found: no summary: {error or "the file is truncated"}'
            self.whole = not self._problem
            self.schemas, self.channels = self._summary.schemas, self._summary.channels
            self._damage: Damage | None = None
            self._chunks = self._find_chunks()
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
        none = records.Schema(id=0, data=b'', encoding='', name='')
        return tuple(LogTopic(
            name=channel.topic, type_name=schema.name,
            schema=schema.data.decode(errors='replace'), schema_encoding=schema.encoding,
            encoding=channel.message_encoding, qos=rosbag2.qos_profiles(channel),
            metadata=channel.metadata, channel_id=number)
            for number, channel in sorted(self.channels.items())
            for schema in [self.schemas.get(channel.schema_id, none)])

    @property
    def compression(self) -> rosbag2.Compression:
        """How rosbag2 has compressed the messages, by its record or the bag's metadata.yaml."""
        text = self.metadata.get(rosbag2.BAG_METADATA, {}).get('serialized_metadata', '')
        beside = self.path.with_name('metadata.yaml')
        if not text and beside.is_file():
            text = beside.read_text(errors='replace')
        return rosbag2.compression_of(text)

    @property
    def damage(self) -> Damage:
        """What is wrong with the file; reads all of it at the first use."""
        if self._damage is None:
            for _ in self.parts():
                pass
        assert self._damage is not None
        return self._damage

    @cached_property
    def span(self) -> tuple[int, int]:
        """
        The earliest and the latest log time [ns]; both 0 without messages.

        Beside dates, a time of 0 does not count: it says that there was no clock yet.
        """
        begin_ns = min((chunk.message_start_time for chunk in self._chunks), default=0)
        end_ns = max((chunk.message_end_time for chunk in self._chunks), default=0)
        if begin_ns == 0 and end_ns > FIRST_DATE:
            first = next(self.messages(start=1), None)
            begin_ns = first.log_time if first and first.log_time > FIRST_DATE else 0
        return begin_ns, end_ns

    def messages(self, topics: Iterable[str] | None = None, start: int | None = None,
                 end: int | None = None) -> Iterator[LogMessage]:
        """
        Yield the messages in the order of their log times, equal ones in file order.

        Those that rosbag2 has compressed one by one are decompressed.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default: all.
        start, end : int, optional
            Log times [ns]; `end` is exclusive.

        Raises
        ------
        LogError
            For a message that cannot be decompressed, and for chunks that overlap in time and do
            not fit into memory.
        """
        names = None if topics is None else frozenset(topics)
        wanted = {number: channel.topic for number, channel in self.channels.items()
                  if names is None or channel.topic in names}
        times = range(start or 0, 1 << 64 if end is None else end)
        mode, compression = self.compression
        # What is read and not yet passed: log time, chunk, offset there
        held: list[tuple[int, int, int, Messages]] = []
        opened: list[tuple[int, int]] = []      # latest log time and size of chunks
        for chunk in [*sorted(self._chunks, key=attrgetter('message_start_time')), None]:
            passed = len(held) if chunk is None else bisect_left(
                held, (chunk.message_start_time,))
            for time_ns, _, offset, messages in held[:passed]:
                if time_ns in times:
                    message = messages.message(wanted, offset)
                    yield message if mode != 'MESSAGE' else self._decompressed(
                        message, compression)
            del held[:passed]
            if (chunk is None or chunk.message_end_time < times.start
                    or chunk.message_start_time >= times.stop
                    or wanted.keys().isdisjoint(chunk.message_index_offsets)):
                continue
            place = chunk.chunk_start_offset
            try:
                messages = self._part(place, place + chunk.chunk_length).messages
            except decoding.UNREADABLE:
                self.left_out += 1
                continue
            opened = [one for one in opened if one[0] >= chunk.message_start_time]
            opened.append((chunk.message_end_time, len(messages.plain)))
            if sum(size for _, size in opened) > 2 * self._max_bytes:
                raise LogError(f'cannot read {self.path}: chunks that overlap in time have more '
                               f'than {2 * self._max_bytes} bytes')
            for number in wanted.keys() & messages.entries.keys():
                held += ((time_ns, place, offset, messages)
                         for time_ns, offset in messages.entries[number].tolist())
            held.sort()

    def groups(self, topics: Iterable[str] | None = None,
               ) -> Iterator[tuple[str, list[LogMessage]]]:
        """Yield some messages of a topic at a time, each topic's in the order of `messages`."""
        messages = self.messages(topics)
        while block := sorted(itertools.islice(messages, BLOCK), key=attrgetter('topic')):
            for topic, group in itertools.groupby(block, attrgetter('topic')):
                yield topic, list(group)

    def _decompressed(self, message: LogMessage, compression: str) -> LogMessage:
        try:
            data = decoding.decompress(message.data, compression or 'unknown', self._max_bytes)
        except McapError as error:
            raise LogError(f'cannot read {self.path}: a message of {message.topic}: {error}'
                           ) from None
        return message._replace(data=data)

    # ------------------------------------------------------------------------------ the records

    def parts(self) -> Iterator[Part]:
        """Yield what can be read, in file order; then `damage` tells what cannot."""
        damage = Damage(self._torn, reasons=[self._problem] * (not self.whole))
        offset, index_bytes, self._small_bytes = MAGIC_SIZE, 0, 0
        while offset < self._data_end:
            opcode, end = self._end_of(offset)
            if opcode == 0 or end > self._data_end:
                # Nothing is lost by a truncated index of the last chunk.
                if not self._torn or opcode not in (Opcode.MESSAGE_INDEX, Opcode.DATA_END) or (
                        self.size - offset > index_bytes + DATA_END_SIZE):
                    damage.lose(offset, self._data_end, 'no whole record')
                break
            try:
                # Opcodes that are unknown belong to an application.
                if opcode <= Opcode.DATA_END and opcode != Opcode.MESSAGE_INDEX:
                    part = self._part(offset, end)
                    self._declare(part.messages)
                    self._check_data(part, damage)
                    index_bytes = len(part.messages.plain)      # at most
                    yield part
            except decoding.UNREADABLE as error:
                damage.lose(offset, end, str(error))
            offset = end
            if opcode == Opcode.DATA_END:
                break
        else:
            damage.reasons += ['found: the data section has no end'] * (not self._torn)
        self._damage = damage

    def _end_of(self, offset: int) -> tuple[int, int]:
        """Return opcode and end of a record, or the end of adjacent messages, some if many."""
        opcode, end = self._head(offset)
        while opcode == Opcode.MESSAGE and end - offset < RUN_BYTES and end < self._data_end:
            following, its_end = self._head(end)
            if following != Opcode.MESSAGE or its_end > self._data_end:
                break
            end = its_end
        return opcode, end

    def _part(self, offset: int, end: int) -> Part:
        """Return what is there.  Raises UNREADABLE."""
        raw = self._raw(offset, end)
        if raw[:1] == bytes([Opcode.MESSAGE]):
            return Part(None, decoding.find_messages(raw), offset, end)
        record = decoding.parse(raw)
        return Part(record, decoding.open_chunk(record, self._max_bytes)
                    if isinstance(record, records.Chunk) else Messages(b'', {}, [record]),
                    offset, end)

    def _head(self, offset: int) -> tuple[int, int]:
        """Return opcode and end of the record there; a head that is not whole has no end."""
        head = self._file.at(offset, min(offset + HEAD.size, self.size))
        opcode, length = HEAD.unpack(head.ljust(HEAD.size, b'\xff'))
        return opcode, offset + HEAD.size + length

    def _raw(self, offset: int, end: int) -> bytes:
        if end - offset > self._max_bytes:
            raise McapError(f'more than {self._max_bytes} bytes are not read')
        return self._file.at(offset, end)

    def _check_data(self, end: Part, damage: Damage) -> None:
        """Compare the checksum of all data, if that is the data end and has one."""
        crc = 0
        if isinstance(end.record, records.DataEnd) and end.record.data_section_crc:
            for begin in range(0, end.offset, RUN_BYTES):
                crc = zlib.crc32(self._file.at(begin, min(begin + RUN_BYTES, end.offset)), crc)
            if crc != end.record.data_section_crc:
                damage.reasons.append('found: the checksum of the data section is wrong')

    def is_declared(self, channel_id: int) -> bool:
        """Return whether a channel and its schema, if it has one, are known."""
        channel = self.channels.get(channel_id)
        return channel is not None and channel.schema_id in {0, *self.schemas}

    def _declare(self, messages: Messages) -> None:
        """Note schemas, channels and metadata.  Raises McapError if messages lack a channel."""
        for record in messages.declared:
            known: Any
            if isinstance(record, records.Metadata):
                self.metadata[record.name] = record.metadata
            elif isinstance(record, records.Schema | records.Channel):
                known = self.schemas if isinstance(record, records.Schema) else self.channels
                if known.setdefault(record.id, record) != record:
                    raise McapError(f'it changes {type(record).__name__.lower()} {record.id}')
            else:
                continue
            self._small_bytes += len(record_bytes(record))
            if self._small_bytes > decoding.MAX_SMALL:
                raise McapError(f'more than {decoding.MAX_SMALL} bytes of schemas, channels and '
                                'metadata are not read')
        if not all(map(self.is_declared, messages.entries)):
            raise McapError('no whole record declares a channel of its messages')

    def _find_chunks(self) -> list[records.ChunkIndex]:
        """Return where messages are; adjacent ones outside of chunks are as a chunk here."""
        summary = self._summary
        if not summary.chunk_indexes or not all(
                one.message_index_offsets and all(map(self.is_declared, one.message_index_offsets))
                for one in summary.chunk_indexes):
            return [records.ChunkIndex(
                chunk_start_offset=part.offset, chunk_length=part.end - part.offset,
                message_start_time=start_ns, message_end_time=end_ns,
                message_index_offsets=dict.fromkeys(entries, 0), message_index_length=0,
                compression='', compressed_size=0, uncompressed_size=0)
                for part in self.parts() if (entries := part.messages.entries)
                for start_ns, end_ns in [time_span(entries)]]
        with contextlib.suppress(*decoding.UNREADABLE):
            for one in summary.metadata_indexes:
                record = decoding.parse(self._raw(one.offset, one.offset + one.length))
                self._declare(Messages(b'', {}, [record]))
        return sorted(summary.chunk_indexes, key=attrgetter('chunk_start_offset'))

    def _read_header(self) -> records.Header:
        """Return the header.  Raises LogError for no MCAP file."""
        magic = self._file.read(min(MAGIC_SIZE, self.size))
        with contextlib.suppress(*decoding.UNREADABLE):
            header = decoding.parse(self._raw(MAGIC_SIZE, self._head(MAGIC_SIZE)[1]))
            if magic == MCAP0_MAGIC and isinstance(header, records.Header):
                return header
        reason = 'it is no MCAP file' if magic else 'it is empty'
        if magic[:4] in UNPACK:
            reason = 'it is compressed as a whole, unpack it by ' + UNPACK[magic[:4]].format(
                self.path, self.path.with_suffix(''))
        raise LogError(f'cannot read {self.path}: {reason}')

    def _read_summary(self) -> None:
        """Read the summary, if there is one.  UNREADABLE if it is damaged or the file is torn."""
        footer_at = self.size - MAGIC_SIZE - FOOTER_SIZE
        footer = decoding.parse(self._file.at(footer_at, self.size - MAGIC_SIZE))
        if self._file.read(MAGIC_SIZE) != MCAP0_MAGIC or not isinstance(footer, records.Footer):
            raise McapError('the file does not end as an MCAP file ends')
        self._torn, start = False, footer.summary_start or footer_at
        section = self._file.at(start, self.size)
        if footer.summary_crc not in (0, zlib.crc32(section[:-MAGIC_SIZE - 4])):
            raise McapError('its checksum is wrong')
        self._data_end = start
        if len(section) <= decoding.MAX_SMALL:      # else it is read from record to record
            self._summary = NonSeekingReader(
                CompleteReads(BytesIO(MCAP0_MAGIC + section))).get_summary() or Summary()


def _file_of(path: Path) -> Path:
    """Return a file, or the one in a folder; raises LogError."""
    if not path.is_dir():
        return path
    files = sorted([*path.glob('*.mcap')] or path.glob('*.mcap.*'))
    if len(files) != 1:
        raise LogError(f'cannot read {path}: a folder must hold one .mcap file; in it: '
                       f'{", ".join(file.name for file in files) or "none"}')
    return files[0]
