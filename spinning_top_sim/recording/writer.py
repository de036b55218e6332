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
import threading
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
from spinning_top_sim.recording import rosbag2
from spinning_top_sim.recording.errors import RecordingError, why_not_written
from spinning_top_sim.recording.provenance import METADATA_NAME, OUR_LIBRARY

# The fastest level that compresses nearly as well as zstd's own default, 3, with a window of a
# whole chunk: its default, half of one, costs up to 20 %.
ZSTD = zstandard.ZstdCompressionParameters.from_level(-1, window_log=20)
INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries

# Message index entries of a chunk by channel id: (n, 2) log times and offsets in the chunk.
Entries = Mapping[int, NDArray[np.uint64]]


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
        self._compression = '' if compression == 'none' else compression
        self._zstd = zstandard.ZstdCompressor(compression_params=ZSTD)
        self._chunk, self._spare = _ChunkMemory(), _ChunkMemory()
        self._beside: threading.Thread | None = None    # writes the chunk before
        self._beside_error: Exception | None = None
        self._next_sequence: dict[int, int] = {}    # by channel id
        self.message_counts: dict[int, int] = {}    # messages in the file by channel id
        self.chunk_count = 0
        self._times_ns: list[int] = []              # earliest and latest stamp of each chunk
        self._end = 0, 0    # size and checksum of the file; one assignment, so always consistent
        self._type_names = {0: ''}                  # by schema id
        self._channels: dict[int, records.Channel] = {}
        # Records of the summary by opcode.  Serialized: thousands of objects would take memory.
        self._summary: defaultdict[int, list[bytes]] = defaultdict(list)
        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
        with self.discarded_on_failure():
            self._write([MCAP0_MAGIC, record_bytes(header)])

    @property
    def size(self) -> int:
        return self._end[0]

    @property
    def messages(self) -> int:
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

    def write(self, record: records.McapRecord) -> None:
        """Write metadata, an attachment, or a schema or channel that is not there already."""
        if isinstance(record, records.Schema):
            if record.id in self._type_names:
                return
            self._type_names[record.id] = record.name
        elif isinstance(record, records.Channel):
            if record.id in self._channels:
                return
            self._channels[record.id] = record
            self.message_counts[record.id] = self._next_sequence[record.id] = 0
        offset, raw = self.size, record_bytes(record)
        self._write([raw])
        if isinstance(record, records.Metadata):
            record = records.MetadataIndex(offset, len(raw), record.name)
        elif isinstance(record, records.Attachment):
            record = records.AttachmentIndex(
                offset, len(raw), record.log_time, record.create_time, len(record.data),
                record.name, record.media_type)
        self._summarize(record)

    def _summarize(self, record: records.McapRecord) -> None:
        raw = record_bytes(record)
        self._summary[raw[0]].append(raw)

    def add(self, topic_index: int, log_times_ns: NDArray[np.int64],
            rows: NDArray[np.uint8]) -> None:
        """
        Add messages of a topic to the chunk in memory.

        log_times_ns : log and publish times (n,), n >= 1, in any order
        rows : serialized messages (n, size)
        """
        channel_id = topic_index + 1
        self._chunk.add(channel_id, self._next_sequence[channel_id], log_times_ns, rows)
        self._next_sequence[channel_id] += len(rows)

    def flush(self, *, beside: bool = False) -> None:
        """
        Write the chunk in memory, if it holds anything.

        beside : in another thread, while the next chunk is filled: a seventh of the time of a
            run of `simulate` is compression

        An OSError, also that of the chunk written beside, loses its chunk, so that the file can
        be finished; an interrupt does not.
        """
        if self._beside is not None:
            self._beside.join()
            self._beside, error, self._beside_error = None, self._beside_error, None
            if error is not None:
                raise error
        if beside:
            self._beside = threading.Thread(target=self._write_beside, args=(self._chunk,))
            self._beside.start()
            self._chunk, self._spare = self._spare, self._chunk
        else:
            self._write_out(self._chunk)

    def _write_beside(self, chunk: '_ChunkMemory') -> None:
        try:
            self._write_out(chunk)
        except Exception as error:
            self._beside_error = error

    def _write_out(self, chunk: '_ChunkMemory') -> None:
        try:
            if chunk.size:
                self.write_messages(chunk.plain, {
                    number: np.concatenate(parts) for number, parts in chunk.entries.items()})
        except OSError:
            chunk.clear()
            raise
        chunk.clear()

    def write_messages(self, plain: bytes | memoryview, entries: Entries) -> None:
        """Write a chunk of these message records.  Raises OSError."""
        data = (self._zstd.compress(plain) if self._compression == 'zstd'
                else lz4.frame.compress(plain) if self._compression else bytes(plain))
        start_ns, end_ns = time_span(entries)
        self.write_chunk(records.Chunk(
            compression=self._compression, data=data, message_start_time=start_ns,
            message_end_time=end_ns, uncompressed_crc=zlib.crc32(plain),
            uncompressed_size=len(plain)), entries)

    def write_chunk(self, chunk: records.Chunk, entries: Entries) -> None:
        """Write a chunk with the indexes of its messages.  Raises OSError."""
        raw = record_bytes(chunk)
        # mcap's class would make Python objects of all entries.
        indexes = [INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + numbers.nbytes, channel_id,
                                   numbers.nbytes) + numbers.tobytes()
                   for channel_id, numbers in sorted(entries.items())]
        offsets = list(itertools.accumulate(map(len, indexes), initial=self.size + len(raw)))
        index = records.ChunkIndex(
            chunk_start_offset=self.size, chunk_length=len(raw),
            message_index_offsets=dict(zip(sorted(entries), offsets, strict=False)),
            message_index_length=offsets[-1] - offsets[0],
            compression=chunk.compression, compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time)
        self._write([raw, *indexes])
        self._summarize(index)
        self.chunk_count += 1
        if entries:
            self._times_ns += chunk.message_start_time, chunk.message_end_time
            for channel_id, numbers in entries.items():
                self.message_counts[channel_id] += len(numbers)

    def sync(self) -> None:
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

    def finish(self, bag: rosbag2.Compression | None = rosbag2.NOT_COMPRESSED) -> None:
        """
        Write the chunk in memory and the summary, bring all to the disk, close the file.

        bag : how the messages are compressed, for a `rosbag2` record; None: there is none
        """
        try:
            self.flush()
            span = min(self._times_ns, default=0), max(self._times_ns, default=0)
            if bag is not None:
                topics = [(channel, self._type_names[channel.schema_id], count) for channel, count
                          in zip(self._channels.values(), self.message_counts.values(),
                                 strict=True)]
                self.write(records.Metadata(rosbag2.BAG_METADATA, {
                    'serialized_metadata': rosbag2.bag_metadata_yaml(
                        topics, self._path.name, *span, bag)}))
            self._write([record_bytes(records.DataEnd(self._end[1]))])
            self._write([self._summary_section(*span)])
            self.sync()
            sync_directory(self._path.parent)
        finally:
            self._file.close()

    def _summary_section(self, start_ns: int, end_ns: int) -> bytes:
        counts = {f'{name}_count': len(self._summary[kind]) for name, kind in (
            ('schema', Opcode.SCHEMA), ('channel', Opcode.CHANNEL), ('chunk', Opcode.CHUNK_INDEX),
            ('attachment', Opcode.ATTACHMENT_INDEX), ('metadata', Opcode.METADATA_INDEX))}
        self._summarize(records.Statistics(
            message_count=self.messages, message_start_time=start_ns, message_end_time=end_ns,
            channel_message_counts=self.message_counts, **counts))
        summary, offsets = bytearray(), bytearray()
        for opcode, group in sorted(self._summary.items()):
            if group:
                start = self.size + len(summary)
                summary += b''.join(group)
                offsets += record_bytes(records.SummaryOffset(
                    opcode, start, self.size + len(summary) - start))
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


class _ChunkMemory:
    """
    Message records of a chunk, uncompressed.

    The memory is used again: new pages for each chunk cost a tenth of the time of `simulate`.
    """

    def __init__(self) -> None:
        self._memory = bytearray(1 << 21)
        self.size = 0
        # By channel id arrays of log times and offsets
        self.entries: defaultdict[int, list[NDArray[np.uint64]]] = defaultdict(list)

    @property
    def plain(self) -> memoryview:
        """The records, valid until the chunk changes."""
        return memoryview(self._memory)[:self.size]

    def clear(self) -> None:
        self.size = 0
        self.entries.clear()

    def add(self, channel_id: int, sequence: int, log_times_ns: NDArray[np.int64],
            rows: NDArray[np.uint8]) -> None:
        """Add messages, the first of which has this sequence number."""
        numbers, record = np.arange(len(rows)), _message_type(rows.shape[1])
        size = self.size + len(rows) * record.itemsize
        if size > len(self._memory):
            self._memory = self._memory[:self.size] + bytearray(size)
        messages = np.frombuffer(self._memory, record, len(rows), self.size)
        messages['opcode'], messages['length'] = Opcode.MESSAGE, record.itemsize - 9
        messages['channel'], messages['sequence'] = channel_id, numbers + sequence
        messages['log_time'] = messages['publish_time'] = log_times_ns
        messages['data'] = rows
        entries = np.empty((len(rows), 2), np.uint64)
        entries[:, 0], entries[:, 1] = log_times_ns, numbers * record.itemsize + self.size
        self.entries[channel_id].append(entries)
        self.size = size


def create_file(path: Path, topics: Sequence[rosbag2.RecordedTopic], metadata: Mapping[str, str],
                *, compression: str, min_free_bytes: int = 0) -> McapWriter:
    """
    Create a log, which must not exist, and bring its head to the disk.

    topics : all stand before the first chunk, so that a truncated file tells them in any case
    metadata : the `spinning_top_sim` record at the head of the file

    Raises ValueError for a topic that is listed twice, RecordingError naming path or type.
    """
    names = [topic.name for topic in topics]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'topic {name!r} is listed twice: once is allowed')
    types = list(dict.fromkeys(topic.type_name for topic in topics))
    definitions = {name: rosbag2.find_definition(name) for name in types}
    try:
        header = records.Header(profile='ros2', library=OUR_LIBRARY + version())
        file = McapWriter(path, header=header, compression=compression)
        with file.discarded_on_failure():
            file.check_disk(min_free_bytes)
            file.write(records.Metadata(METADATA_NAME, dict(metadata)))
            for number, (name, (text, _)) in enumerate(definitions.items(), start=1):
                file.write(records.Schema(number, text.encode(), 'ros2msg', name))
            for number, topic in enumerate(topics, start=1):
                file.write(records.Channel(
                    id=number, topic=topic.name, message_encoding='cdr',
                    schema_id=1 + types.index(topic.type_name),
                    metadata={'offered_qos_profiles': rosbag2.offered_qos_yaml(topic),
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


def time_span(entries: Entries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    if not entries:
        return 0, 0
    times = np.concatenate([numbers[:, 0] for numbers in entries.values()])
    return int(times.min()), int(times.max())


@lru_cache
def _message_type(size: int) -> np.dtype[np.void]:
    """Return the type of a message record with so many bytes of data."""
    return np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                     ('log_time', '<u8'), ('publish_time', '<u8'), ('data', 'u1', (size,))])


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
