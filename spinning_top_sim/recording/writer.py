# SPDX-License-Identifier: Apache-2.0
"""
Writes MCAP files that end after a whole record at any time, whatever happens to the disk.

mcap.Writer reports success after a failed write and cannot truncate.

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.
"""

import contextlib
import itertools
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from spinning_top_sim.installation import version
from spinning_top_sim.recording.definitions import find_definition
from spinning_top_sim.recording.errors import RecordingError, why_not_written
from spinning_top_sim.recording.provenance import METADATA_NAME, OUR_LIBRARY
from spinning_top_sim.recording.rosbag2 import (
    BAG_METADATA,
    RecordedTopic,
    bag_metadata_yaml,
    offered_qos_yaml,
)

CHUNK_BYTES = 1 << 20   # uncompressed, about

# The fastest level that compresses nearly as well as zstd's own default, 3.
ZSTD_LEVEL = -1
# The default window of the level is half a chunk; a whole one saves up to 20 %.
ZSTD_WINDOW_LOG = 20

INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries

# Message index entries of a chunk by channel id: (n, 2) log times and offsets in the chunk.
IndexEntries = Mapping[int, NDArray[np.uint64]]


class McapWriter:
    """
    A new MCAP file, which must not exist (FileExistsError), used by one thread at a time.

    `add` collects messages of a topic for a chunk, `flush` writes the chunk.  A topic is an index
    here, its channel has the id index + 1, and its messages are numbered.

    Every write goes to an explicit position behind the last whole record, so neither an OSError
    nor an interrupt can shift what follows.  After an OSError `finish` may still be tried.

    compression : of the chunks, 'zstd', 'lz4' or 'none'
    """

    def __init__(self, path: Path, *, header: records.Header, compression: str) -> None:
        self._path = path
        self._compression = compression
        self._zstd = zstandard.ZstdCompressor(
            compression_params=zstandard.ZstdCompressionParameters.from_level(
                ZSTD_LEVEL, window_log=ZSTD_WINDOW_LOG))
        self._next_sequence: defaultdict[int, int] = defaultdict(int)    # by channel id
        self._clear_chunk()

        self.message_counts: dict[int, int] = {}    # messages in the file by channel id
        self.chunk_count = 0
        self._times_ns: list[int] = []              # earliest and latest stamp of each chunk
        self._end = 0, 0    # size and checksum of the file; one assignment, so always consistent
        self._type_names: dict[int, str] = {}       # by schema id
        self._channels: dict[int, records.Channel] = {}
        # Records of the summary.  Serialized: thousands of objects would take memory.
        self._summary_records: dict[Opcode, list[bytes]] = {kind: [] for kind in (
            Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX,
            Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)}

        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
        with self.discarded_on_failure():
            self._write([MCAP0_MAGIC, record_bytes(header)])

    @property
    def size(self) -> int:
        """Size of the file [bytes]."""
        return self._end[0]

    @property
    def messages(self) -> int:
        """Number of messages in the file."""
        return sum(self.message_counts.values())

    @contextlib.contextmanager
    def discarded_on_failure(self) -> Iterator[None]:
        """Close and remove the file if the body of the `with` statement raises."""
        try:
            yield
        except BaseException:
            self._file.close()
            with contextlib.suppress(OSError):
                self._path.unlink()
            raise

    def write(self, record: records.McapRecord, raw: bytes = b'') -> None:
        """
        Write a schema, a channel (after its schema), metadata or an attachment.

        raw : the bytes of the record in another file
        """
        offset = self.size
        raw = raw or record_bytes(record)
        self._write([raw])
        if isinstance(record, records.Metadata):
            self._summary_records[Opcode.METADATA_INDEX].append(
                record_bytes(records.MetadataIndex(offset, len(raw), record.name)))
        elif isinstance(record, records.Attachment):
            self._summary_records[Opcode.ATTACHMENT_INDEX].append(
                record_bytes(records.AttachmentIndex(
                    offset, len(raw), record.log_time, record.create_time, len(record.data),
                    record.name, record.media_type)))
        elif isinstance(record, records.Schema):
            self._type_names[record.id] = record.name
            self._summary_records[Opcode.SCHEMA].append(raw)
        elif isinstance(record, records.Channel):
            self._channels[record.id] = record
            self._summary_records[Opcode.CHANNEL].append(raw)
            self.message_counts[record.id] = 0

    def add(self, topic_index: int, log_times_ns: NDArray[np.int64],
            rows: NDArray[np.uint8]) -> None:
        """
        Add messages of a topic to the chunk in memory.

        log_times_ns : log and publish times (n,), n >= 1, in any order
        rows : serialized messages (n, size)
        """
        channel_id, (count, size) = topic_index + 1, rows.shape
        messages = np.empty(count, _message_type(size))
        messages['opcode'] = Opcode.MESSAGE
        messages['length'] = messages.itemsize - 9
        messages['channel'] = channel_id
        messages['sequence'] = np.arange(count) + self._next_sequence[channel_id]
        messages['log_time'] = messages['publish_time'] = log_times_ns
        messages['data'] = rows
        entries = np.empty((count, 2), np.uint64)
        entries[:, 0] = log_times_ns
        entries[:, 1] = np.arange(count) * messages.itemsize + self.pending
        self._next_sequence[channel_id] += count
        self._parts.append(messages)
        self._entries[channel_id].append(entries)
        self.pending += messages.nbytes

    def flush(self) -> None:
        """Write the chunk in memory, if it holds anything.  After an OSError it is lost."""
        if not self.pending:
            return
        plain = b''.join(part.data for part in self._parts)
        entries = {channel_id: np.concatenate(parts)
                   for channel_id, parts in sorted(self._entries.items())}
        self._clear_chunk()
        self.write_chunk(self.chunk_of(plain, entries), entries)

    def _clear_chunk(self) -> None:
        self.pending = 0                            # bytes of the chunk in memory
        self._parts: list[NDArray[np.void]] = []
        self._entries: defaultdict[int, list[NDArray[np.uint64]]] = defaultdict(list)

    def chunk_of(self, plain: bytes, entries: IndexEntries) -> records.Chunk:
        """Return a chunk with these message records, compressed."""
        data = plain
        if self._compression == 'zstd':
            data = self._zstd.compress(plain)
        elif self._compression == 'lz4':
            data = lz4.frame.compress(plain)
        start_ns, end_ns = time_span(entries)
        return records.Chunk(
            compression='' if self._compression == 'none' else self._compression, data=data,
            uncompressed_size=len(plain), uncompressed_crc=zlib.crc32(plain),
            message_start_time=start_ns, message_end_time=end_ns)

    def write_chunk(self, chunk: records.Chunk, entries: IndexEntries) -> None:
        """Write a chunk with the indexes of its messages.  Raises OSError."""
        raw = record_bytes(chunk)
        indexes = {channel_id: _message_index(channel_id, numbers)
                   for channel_id, numbers in entries.items()}
        offsets = list(itertools.accumulate(
            map(len, indexes.values()), initial=self.size + len(raw)))
        chunk_index = record_bytes(records.ChunkIndex(
            chunk_start_offset=self.size, chunk_length=len(raw),
            message_index_offsets=dict(zip(indexes, offsets, strict=False)),
            message_index_length=offsets[-1] - offsets[0],
            compression=chunk.compression, compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time))
        self._write([raw, *indexes.values()])
        self._summary_records[Opcode.CHUNK_INDEX].append(chunk_index)
        self.chunk_count += 1
        if entries:
            self._times_ns += chunk.message_start_time, chunk.message_end_time
            for channel_id, numbers in entries.items():
                self.message_counts[channel_id] += len(numbers)

    def sync(self) -> None:
        """Bring what is in the file to the disk.  Raises OSError."""
        os.fsync(self._file.fileno())

    def check_disk(self, min_free_bytes: int) -> None:
        """Raise OSError if the disk has too little left, or the file was deleted."""
        descriptor = self._file.fileno()
        if os.fstat(descriptor).st_nlink == 0:
            raise OSError('the file was deleted')
        disk = os.fstatvfs(descriptor)
        free = disk.f_bavail * disk.f_frsize
        if free < min_free_bytes:
            raise OSError(f'{free} bytes are free on the disk, fewer than min_free_bytes = '
                          f'{min_free_bytes}')

    def finish(self, *, bag: bool = True) -> None:
        """
        Write the chunk in memory and the summary, bring all to the disk, close the file.

        bag : write rosbag2's metadata record, too
        """
        try:
            self.flush()
            if bag:
                topics = [(channel, self._type_names.get(channel.schema_id, ''),
                           self.message_counts[channel.id])
                          for channel in self._channels.values()]
                self.write(records.Metadata(BAG_METADATA, {
                    'serialized_metadata': bag_metadata_yaml(
                        topics, file_name=self._path.name,
                        start_ns=min(self._times_ns, default=0),
                        end_ns=max(self._times_ns, default=0))}))
            self._write([record_bytes(records.DataEnd(self._end[1]))])
            self._write([self._summary()])
            self.sync()
            sync_directory(self._path.parent)
        finally:
            self._file.close()

    def _summary(self) -> bytes:
        groups = self._summary_records
        groups[Opcode.STATISTICS] = [record_bytes(records.Statistics(
            message_count=self.messages,
            schema_count=len(groups[Opcode.SCHEMA]), channel_count=len(groups[Opcode.CHANNEL]),
            attachment_count=len(groups[Opcode.ATTACHMENT_INDEX]),
            metadata_count=len(groups[Opcode.METADATA_INDEX]), chunk_count=self.chunk_count,
            message_start_time=min(self._times_ns, default=0),
            message_end_time=max(self._times_ns, default=0),
            channel_message_counts=self.message_counts))]
        summary = bytearray()
        offsets = bytearray()
        for opcode, members in groups.items():
            group = b''.join(members)
            if group:
                offsets += record_bytes(records.SummaryOffset(
                    group_opcode=opcode, group_start=self.size + len(summary),
                    group_length=len(group)))
                summary += group
        footer = record_bytes(records.Footer(self.size, self.size + len(summary), 0))
        # The summary's checksum runs on into the footer, up to the checksum itself.
        summary += offsets + footer[:-4]
        return bytes(summary) + zlib.crc32(summary).to_bytes(4, 'little') + MCAP0_MAGIC

    def _write(self, blocks: Iterable[bytes]) -> None:
        """Write whole records that come in blocks, or none of them."""
        offset, crc = self._end
        descriptor = self._file.fileno()
        try:
            for block in blocks:
                rest = memoryview(block)
                while rest:
                    written = os.pwrite(descriptor, rest, offset)
                    offset += written
                    rest = rest[written:]
                crc = zlib.crc32(block, crc)
        except BaseException:
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, self.size)
            raise
        self._end = offset, crc


def create_file(path: Path, topics: Sequence[RecordedTopic], metadata: Mapping[str, str], *,
                compression: str, min_free_bytes: int = 0) -> McapWriter:
    """
    Create a log, which must not exist, and bring its head to the disk.

    topics : all stand before the first chunk, so that a truncated file tells them in any case
    metadata : the `spinning_top_sim` record at the head of the file
    compression : 'zstd', 'lz4' or 'none'
    min_free_bytes : a recording stops if the disk has less left than this, >= 0

    Raises ValueError for a topic that is listed twice, RecordingError naming path or type.
    """
    names = [topic.name for topic in topics]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'topic {name!r} is listed twice: once is allowed')
    definitions = {     # text and type hash
        name: find_definition(name) for name in dict.fromkeys(topic.type_name for topic in topics)}
    try:
        header = records.Header(profile='ros2', library=OUR_LIBRARY + version())
        file = McapWriter(path, header=header, compression=compression)
        with file.discarded_on_failure():
            file.check_disk(min_free_bytes)
            file.write(records.Metadata(METADATA_NAME, dict(metadata)))
            for number, (name, (text, _)) in enumerate(definitions.items(), start=1):
                file.write(records.Schema(id=number, name=name, encoding='ros2msg',
                                          data=text.encode()))
            for number, topic in enumerate(topics, start=1):
                file.write(records.Channel(
                    id=number, topic=topic.name, message_encoding='cdr',
                    schema_id=1 + list(definitions).index(topic.type_name),
                    metadata={'offered_qos_profiles': offered_qos_yaml(topic),
                              'topic_type_hash': definitions[topic.type_name][1]}))
            file.sync()
            sync_directory(path.parent)
    except (OSError, ValueError) as error:
        raise RecordingError(f'cannot record to {path}: {why_not_written(path, error)}') from error
    return file


def record_bytes(record: records.McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def time_span(entries: IndexEntries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    times = [numbers[:, 0] for numbers in entries.values()]
    return (min((int(column.min()) for column in times), default=0),
            max((int(column.max()) for column in times), default=0))


@lru_cache
def _message_type(size: int) -> np.dtype[np.void]:
    """Return the type of a message record with so many bytes of data."""
    return np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                     ('log_time', '<u8'), ('publish_time', '<u8'), ('data', 'u1', (size,))])


def _message_index(channel_id: int, entries: NDArray[np.uint64]) -> bytes:
    """Return the record; mcap's class would make Python objects of all numbers."""
    return INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, INDEX_HEAD.size - 9 + entries.nbytes, channel_id,
                           entries.nbytes) + entries.tobytes()


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
