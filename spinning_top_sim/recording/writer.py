# SPDX-License-Identifier: Apache-2.0
"""
Writes MCAP files that end after a whole record at any time, whatever happens to the disk.

mcap.Writer reports success after a failed write and cannot truncate.

Layout: header, schemas, channels, metadata of the run | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.
"""

import contextlib
import errno
import itertools
import os
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
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
from spinning_top_sim.recording.errors import LogError, reason_of
from spinning_top_sim.recording.provenance import METADATA_NAME, OUR_LIBRARY

CHUNK_BYTES = 1_000_000     # of messages that make a chunk, about
# The fastest level that compresses nearly as well as zstd's own default, 3, with a window of a
# whole chunk: its default, half of one, costs up to 20 %.
ZSTD = zstandard.ZstdCompressionParameters.from_level(-1, window_log=20)
# A record of a message, before its data.
MESSAGE = [('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
           ('log_time', '<u8'), ('publish_time', '<u8')]
MESSAGE_BYTES = np.dtype(MESSAGE).itemsize
INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries

# The next messages of a topic: its index, log times (n,) [ns], serialized messages (n, size).
LogRows = tuple[int, NDArray[np.int64], NDArray[np.uint8]]


class McapWriter:
    """
    A new log, for one thread at a time: `add` collects messages for a chunk, `flush` writes it.

    Every write goes to an explicit position behind the last whole record, so neither an OSError
    nor an interrupt can shift what follows.  After an OSError `finish` may still be tried.

    topics : the channel of a topic is its index + 1
    metadata : the `spinning_top_sim` record
    compression : of the chunks, 'zstd', 'lz4' or 'none'
    size : of the file [bytes]

    Raises LogError naming the path, ValueError for a topic that is listed twice.
    """

    def __init__(self, path: Path, topics: Sequence[rosbag2.RecordedTopic],
                 metadata: Mapping[str, str], *, compression: str,
                 min_free_bytes: int = 0) -> None:
        self._path, self._topics = path, topics
        self._compression = '' if compression == 'none' else compression
        self._rows: list[LogRows] = []                 # of the next chunk,
        self._chunk_bytes = 0                       # and its size
        self.message_counts = Counter(dict.fromkeys(range(1, len(topics) + 1), 0))   # by channel
        self._span: tuple[int, ...] = ()            # earliest and latest log time of all chunks
        self.size, self._crc = 0, 0     # of the file; one assignment, so always consistent
        # Records of the summary.  Serialized: thousands of objects would take memory.
        self._summary = [*map(record_bytes, _declarations(topics))]
        header = record_bytes(records.Header(profile='ros2', library=OUR_LIBRARY + version()))
        try:
            self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
            try:
                self.check_disk(min_free_bytes)
                self.size, self._crc = self._write([MCAP0_MAGIC, header, *self._summary])
                # In the head, so that a truncated file tells it in any case.
                self._write_metadata(METADATA_NAME, metadata)
                self.sync()
                _sync_directory(path.parent)
            except BaseException:
                self._file.close()
                path.unlink()
                raise
        except (OSError, ValueError) as error:
            raise LogError(f'cannot write {path}: {reason_of(error)}') from error

    def add(self, topic_index: int, log_times_ns: NDArray[np.int64],
            rows: NDArray[np.uint8]) -> None:
        """Add `LogRows`, n >= 1, times in any order.  The arrays must not change afterwards."""
        self._rows.append((topic_index, log_times_ns, rows))
        self._chunk_bytes += len(rows) * (MESSAGE_BYTES + rows.shape[1])

    def flush(self, if_full: bool = False) -> None:
        """
        Write the chunk in memory, or only if it is full, where no topic lags behind another.

        An exception loses the chunk, so that the file can be finished; an interrupt does not.
        """
        if self._chunk_bytes < (CHUNK_BYTES if if_full else 1):
            return
        try:
            self._write_chunk(*self._chunk())
        except Exception:
            self._rows, self._chunk_bytes = [], 0
            raise

    def _chunk(self) -> tuple[bytearray, dict[int, NDArray[np.uint64]], Counter[int]]:
        """Return messages, log times and offsets in them (n, 2), and counts, both by channel."""
        plain, offset, counts = bytearray(self._chunk_bytes), 0, self.message_counts.copy()
        index: defaultdict[int, list[NDArray[np.uint64]]] = defaultdict(list)
        for (topic, size), alike in itertools.groupby(
                sorted(self._rows, key=itemgetter(0)), lambda rows: (rows[0], rows[2].shape[1])):
            _, times, parts = zip(*alike, strict=True)
            times_ns, channel = np.concatenate(times), topic + 1
            record = np.dtype([*MESSAGE, ('data', 'u1', (size,))])
            numbers = np.arange(len(times_ns))
            messages = np.frombuffer(plain, record, len(numbers), offset)
            messages['opcode'], messages['length'] = Opcode.MESSAGE, record.itemsize - 9
            messages['channel'], messages['sequence'] = channel, numbers + counts[channel]
            messages['log_time'] = messages['publish_time'] = times_ns
            messages['data'] = np.concatenate(parts)
            index[channel].append(np.stack(
                [times_ns, numbers * record.itemsize + offset], axis=1).astype(np.uint64))
            counts[channel] += len(numbers)
            offset += messages.nbytes
        return plain, {channel: np.concatenate(parts) for channel, parts in index.items()}, counts

    def _write_chunk(self, plain: bytearray, index: Mapping[int, NDArray[np.uint64]],
                     counts: Counter[int]) -> None:
        times_ns = np.concatenate([entries[:, 0] for entries in index.values()])
        span = {'message_start_time': int(times_ns.min()), 'message_end_time': int(times_ns.max())}
        # A tenth of the time of `simulate` is all of this: not worth a thread.
        data = (zstandard.ZstdCompressor(compression_params=ZSTD).compress(plain)
                if self._compression == 'zstd' else
                lz4.frame.compress(plain) if self._compression else bytes(plain))
        # mcap's class of message indexes would make Python objects of all entries.
        blocks = [record_bytes(records.Chunk(
            compression=self._compression, data=data, uncompressed_crc=zlib.crc32(plain),
            uncompressed_size=len(plain), **span)), *(
                INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + entries.nbytes, channel, entries.nbytes)
                + entries.tobytes() for channel, entries in index.items())]
        first, *offsets, end = itertools.accumulate(map(len, blocks), initial=self.size)
        summary = record_bytes(records.ChunkIndex(
            chunk_start_offset=first, chunk_length=len(blocks[0]),
            message_index_offsets=dict(zip(index, offsets, strict=True)),
            message_index_length=end - offsets[0], compression=self._compression,
            compressed_size=len(data), uncompressed_size=len(plain), **span))
        times = [*self._span, *span.values()]
        whole_span = min(times), max(times)
        size, crc = self._write(blocks)
        # A KeyboardInterrupt comes behind a call, and none is between these assignments.
        self.size, self._crc, self.message_counts, self._span = size, crc, counts, whole_span
        self._rows, self._chunk_bytes = [], 0
        self._summary += [summary]

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

    def finish(self) -> None:
        """Write the chunk in memory and the summary, bring all to the disk, close the file."""
        try:
            self.flush()
            start_ns, end_ns = self._span or (0, 0)
            self._write_metadata(rosbag2.BAG_METADATA, rosbag2.bag_metadata(
                self._topics, [*self.message_counts.values()], self._path.name, start_ns, end_ns))
            self.size, self._crc = self._write([record_bytes(records.DataEnd(self._crc))])
            kinds = Counter(raw[0] for raw in self._summary)
            statistics = record_bytes(records.Statistics(
                attachment_count=0, channel_count=len(self._topics),
                channel_message_counts=self.message_counts,
                chunk_count=kinds[Opcode.CHUNK_INDEX], message_count=self.message_counts.total(),
                message_end_time=end_ns, message_start_time=start_ns,
                metadata_count=kinds[Opcode.METADATA_INDEX], schema_count=kinds[Opcode.SCHEMA]))
            # The summary's checksum runs on into the footer, up to the checksum itself.
            summary = b''.join([*sorted([*self._summary, statistics], key=itemgetter(0)),
                                record_bytes(records.Footer(self.size, 0, 0))[:-4]])
            self.size, self._crc = self._write(
                [summary, zlib.crc32(summary).to_bytes(4, 'little'), MCAP0_MAGIC])
            self.sync()
        except OSError as error:
            error.filename = str(self._path)
            raise
        finally:
            with contextlib.suppress(OSError):      # all is on the disk, or another error is told
                self._file.close()

    def _write_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        raw = record_bytes(records.Metadata(name, dict(metadata)))
        index = record_bytes(records.MetadataIndex(self.size, len(raw), name))
        self.size, self._crc = self._write([raw])
        self._summary.append(index)

    def _write(self, blocks: Iterable[bytes]) -> tuple[int, int]:
        """Write whole records that come in blocks, or none of them; return size and checksum."""
        offset, crc = self.size, self._crc
        descriptor = self._file.fileno()
        try:
            for block in blocks:
                rest = memoryview(block)
                while rest:
                    written = os.pwrite(descriptor, rest, offset)
                    offset += written
                    rest = rest[written:]
                crc = zlib.crc32(block, crc)
        except BaseException as error:
            if isinstance(error, OSError):
                error.filename = str(self._path)
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, self.size)
            raise
        return offset, crc


def _declarations(topics: Sequence[rosbag2.RecordedTopic]) -> list[records.McapRecord]:
    """Return schemas and channels; see `McapWriter`."""
    for name, number in Counter(topic.name for topic in topics).items():
        if number > 1:
            raise ValueError(f'topic {name!r} is listed twice: once is allowed')
    types = list(dict.fromkeys(topic.type_name for topic in topics))
    return [
        *(records.Schema(number, rosbag2.definition(name)[0].encode(), 'ros2msg', name)
          for number, name in enumerate(types, start=1)),
        *(records.Channel(
            id=number, topic=topic.name, message_encoding='cdr',
            schema_id=1 + types.index(topic.type_name),
            # In integers, as older releases of ROS read them, too.
            metadata={'offered_qos_profiles': rosbag2.as_yaml([topic.offered]),
                      'topic_type_hash': rosbag2.definition(topic.type_name)[1]})
          for number, topic in enumerate(topics, start=1))]


def record_bytes(record: records.McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    try:
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP):
            raise
