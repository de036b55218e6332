# SPDX-License-Identifier: Apache-2.0
"""
Writes MCAP files that end after a whole record at any time, whatever happens to the disk.

mcap's own Writer buffers what it cannot write, then reports success, and cannot go back.  So the
file is laid out here, from mcap's record classes; only the records that grow with every message
are packed by hand, for speed (MCAP specification, "Message", "Chunk" and "Message Index").

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import mmap
import os
import struct
import sys
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording.rosbag2 import BAG_METADATA, BagTopic, Qos, bag_metadata_yaml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CHUNK_BYTES = 1 << 20   # uncompressed; a single larger message still makes a chunk of its own
BUFFER_BYTES = 2 << 20  # larger chunks are not made in reused memory

# Half the time of zstd's own default, 3, and less memory, for files that are 1 to 6 % larger:
# `python benchmark/compression.py`.
ZSTD_LEVEL = 1

_JOIN_BYTES = 1 << 16   # joined at a time before they are copied: they stay in the cache

# Message index entries of a chunk by channel id: log time, offset in the uncompressed chunk, log
# time, offset, .. (uint64).
Entries = Mapping[int, 'array[int]']

# Messages of one stamp: topic indices, log time [ns], CDR of each, size of all [bytes].
Messages = tuple[Sequence[int], int, Sequence[bytes], int]

MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
MESSAGE_FIELDS = 2 + 4 + 8 + 8      # what `length` counts besides the data
_MESSAGE_DTYPE = [('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                  ('log_time', '<u8'), ('publish_time', '<u8')]
_CHUNK = struct.Struct('<BQQQQI')   # opcode, length, span, size and crc of the plain data
_INDEX = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries


class PlainChunk(NamedTuple):
    """
    An uncompressed chunk.

    Attributes
    ----------
    data : bytes or memoryview
        The message records.  A memoryview of a `BufferPool` is recycled when it is written.
    entries : mapping of int to array of uint64
        The message index entries by channel id.
    span : (int, int)
        The earliest and the latest log time [ns].

    """

    data: bytes | memoryview
    entries: Entries
    span: tuple[int, int]


class BufferPool:
    """
    A compressor and memory for chunks, both reused: per-thread heaps fragment otherwise.

    Parameters
    ----------
    compression : {'zstd', 'lz4', 'none'}

    """

    _idle: ClassVar[list[BufferPool]] = []      # at most one, for the next file

    def __init__(self, compression: str) -> None:
        self.compression = compression
        self._buffers: list[memoryview] = []
        methods: dict[str, Callable[[bytes | memoryview], bytes]] = {
            'zstd': self._compress_zstd, 'lz4': _compress_lz4, 'none': bytes}
        self.compress = methods[compression]
        if compression == 'zstd':
            self._zstd = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
            self._compressed = _new_buffer()

    @classmethod
    def acquire(cls, compression: str) -> BufferPool:
        """Return the idle pool if its compression fits, else a new one."""
        with contextlib.suppress(IndexError):
            pool = cls._idle.pop()
            if pool.compression == compression:
                return pool
        return cls(compression)

    def release(self) -> None:
        """Keep this pool for the next file unless another one is idle."""
        if not self._idle:
            self._idle.append(self)

    def buffer(self, size: int) -> memoryview:
        """Return `size` bytes of uninitialized memory; see `recycle`."""
        if size > BUFFER_BYTES:
            return memoryview(bytearray(size))
        with contextlib.suppress(IndexError):
            return self._buffers.pop()[:size]
        return _new_buffer()[:size]

    def recycle(self, buffer: memoryview) -> None:
        """Take back a buffer that nobody reads any more."""
        if isinstance(buffer.obj, mmap.mmap):
            self._buffers.append(memoryview(buffer.obj))

    def _compress_zstd(self, plain: bytes | memoryview) -> bytes:
        # Incompressible data grow by 0.4 % at most, so half the buffer is a safe limit.
        if len(plain) > BUFFER_BYTES // 2:
            compressed: bytes = self._zstd.compress(plain)
            return compressed
        with self._zstd.stream_reader(plain, size=len(plain)) as reader:
            return bytes(self._compressed[:reader.readinto(self._compressed)])


class McapWriter:
    """
    A new MCAP file, written by one thread at a time.

    Every write goes to an explicit position behind the last whole record, so neither an OSError
    nor an interrupt can shift what follows.  After an OSError `finish` may still be tried.

    Parameters
    ----------
    path : Path
        The file.  It must not exist.
    profile, library : str
        What the header says.
    compression : {'zstd', 'lz4', 'none'}
        How chunks that are made here are compressed.

    Raises
    ------
    FileExistsError
        If the file exists.
    OSError
        If it cannot be written.  Every method that writes may raise it.

    """

    def __init__(self, path: Path, *, profile: str, library: str, compression: str) -> None:
        self._path = path
        self._compression = '' if compression == 'none' else compression

        self.message_counts: dict[int, int] = {}  # messages in the file by channel id
        self.chunk_count = 0
        self.start_ns = self.end_ns = 0           # earliest and latest stamp; 0 without messages
        self.synced_size = 0                      # bytes that are certainly on the disk
        self._end = 0, 0    # size and checksum of the file; one assignment, so always consistent
        self._schemas: dict[int, tuple[Schema, bytes]] = {}
        self._channels: dict[int, tuple[Channel, bytes]] = {}
        self._qos_profiles: dict[int, Sequence[Qos]] = {}
        self._next_sequence: dict[int, int] = {}
        self._chunk_indexes = bytearray()         # serialized: thousands of objects take memory
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._clear_chunk()

        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
        with self.discarded_on_failure():
            self._buffers = BufferPool.acquire(compression)
            self._write([MCAP0_MAGIC, record_bytes(Header(profile=profile, library=library))])

    @property
    def size(self) -> int:
        """Size of the file, all of it whole records [bytes]."""
        return self._end[0]

    @property
    def counts(self) -> list[int]:
        """Messages in the file by channel, in the order in which the channels were written."""
        return list(self.message_counts.values())

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

    def write_schema(self, schema: Schema, record: bytes = b'') -> None:
        """
        Write a schema; the summary repeats the first one of each id.

        `record` is the record as another file has it, by default it is made from `schema`.
        """
        record = record or record_bytes(schema)
        self._write([record])
        self._schemas.setdefault(schema.id, (schema, record))

    def write_channel(
        self, channel: Channel, record: bytes = b'', qos_profiles: Sequence[Qos] = (),
    ) -> None:
        """Write a channel and what its publishers offer; the rest is as in `write_schema`."""
        record = record or record_bytes(channel)
        self._write([record])
        self._channels.setdefault(channel.id, (channel, record))
        self._qos_profiles.setdefault(channel.id, qos_profiles)
        self.message_counts.setdefault(channel.id, 0)
        self._next_sequence.setdefault(channel.id, 0)

    def write_metadata(self, metadata: Metadata, record: bytes = b'') -> None:
        """Write a metadata record; `record` is as in `write_schema`."""
        record = record or record_bytes(metadata)
        index = MetadataIndex(offset=self.size, length=len(record), name=metadata.name)
        self._write([record])
        self._metadata_indexes.append(index)

    def copy_attachment(self, index: AttachmentIndex, blocks: Iterable[bytes]) -> None:
        """Write an attachment of another file; its record comes in blocks of any size."""
        index = dataclasses.replace(index, offset=self.size)
        self._write(blocks)
        self._attachment_indexes.append(index)

    def copy_record(self, blocks: Iterable[bytes]) -> None:
        """Write a record that nothing in the summary refers to, in blocks of any size."""
        self._write(blocks)

    def append(self, topic_index: int, log_time_ns: int, data: bytes) -> bool:
        """
        Add the next message of a topic to the chunk in memory.

        Parameters
        ----------
        topic_index : int
            Channel id - 1.
        log_time_ns : int
            Log and publish time [ns].
        data : bytes
            The message.

        Returns
        -------
        bool
            Whether the chunk is full.

        """
        sequence = self._number(topic_index, 1) & 0xFFFFFFFF
        return self.add_message(topic_index + 1, sequence, log_time_ns, log_time_ns, data)

    def add_message(
        self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int,
        data: bytes | memoryview,
    ) -> bool:
        """Add a message with a given sequence number; see `append`."""
        self._chunk_parts.append(MESSAGE.pack(
            Opcode.MESSAGE, MESSAGE_FIELDS + len(data), channel_id, sequence, log_time_ns,
            publish_time_ns))
        self._chunk_parts.append(data)
        entries = self._chunk_entries.get(channel_id)
        if entries is None:
            entries = self._chunk_entries[channel_id] = array('Q')
        entries.append(log_time_ns)
        entries.append(self._chunk_size)
        self._chunk_size += MESSAGE.size + len(data)
        return self._chunk_size >= CHUNK_BYTES

    def append_all(self, batch: Sequence[Messages]) -> None:
        """
        Write messages in as many chunks as they need; each topic keeps its order in the file.

        Parameters
        ----------
        batch : sequence of Messages
            Topic indices, log time [ns], CDR of each, size of all [bytes].

        """
        import numpy as np  # noqa: PLC0415 - rclpy's messages have imported it

        if not batch:
            return
        size = sum(size + MESSAGE.size * len(messages) for _, _, messages, size in batch)
        per_chunk = max(1, len(batch) * CHUNK_BYTES // size)
        for first in range(0, len(batch), per_chunk):
            times: dict[int, list[int]] = {}
            messages: dict[int, list[bytes]] = {}
            # Consecutive entries mostly have the same topics.
            for topic_indices, alike in groupby(batch[first:first + per_chunk], itemgetter(0)):
                _, alike_times, alike_messages, _ = zip(*alike, strict=True)
                for topic_index, data in zip(topic_indices, zip(*alike_messages, strict=True),
                                             strict=True):
                    times.setdefault(topic_index, []).extend(alike_times)
                    messages.setdefault(topic_index, []).extend(data)
            parts: list[tuple[int, NDArray[np.uint64], list[bytes]]] = []
            for topic_index, of_topic in messages.items():
                stamps = np.frombuffer(array('Q', times[topic_index]), np.uint64)
                start = 0
                for _, run in groupby(of_topic, len):
                    rows = list(run)
                    parts.append((topic_index, stamps[start:start + len(rows)], rows))
                    start += len(rows)
            self.write_chunk()
            self.put_plain_chunk(self.chunk_of_rows(parts))

    def chunk_of_rows(
        self, parts: Sequence[tuple[int, NDArray[np.integer], NDArray[np.uint8] | list[bytes]]],
    ) -> PlainChunk:
        """
        Make a chunk of runs of messages that have one topic and one length.

        A run is copied in a few numpy calls, in a tenth of the time that single messages take.

        Parameters
        ----------
        parts : sequence of (topic index, log times, messages)
            Log times of shape (n,) [ns], n >= 1; messages as n bytes or of shape (n, size).
            Times need no order: the message indexes have it (MCAP specification, "Message
            Index").

        """
        import numpy as np  # noqa: PLC0415 - recovery needs none

        sizes = [len(rows[0]) for _, _, rows in parts]
        buffer = self._buffers.buffer(sum(
            len(times) * (MESSAGE.size + size)
            for (_, times, _), size in zip(parts, sizes, strict=True)))
        data = np.frombuffer(buffer, 'u1')
        entries: dict[int, array[int]] = {}
        offset = 0
        for (topic_index, times, rows), size in zip(parts, sizes, strict=True):
            count, length = len(times), MESSAGE.size + size
            records = data[offset:offset + count * length].reshape(count, length)
            heads = records[:, :MESSAGE.size].view(np.dtype(_MESSAGE_DTYPE))[:, 0]
            heads['opcode'] = Opcode.MESSAGE
            heads['length'] = MESSAGE_FIELDS + size
            heads['channel'] = topic_index + 1
            heads['sequence'] = self._number(topic_index, count) + np.arange(count) & 0xFFFFFFFF
            heads['log_time'] = heads['publish_time'] = times
            _copy_rows(rows, records[:, MESSAGE.size:])
            index = np.empty((count, 2), 'u8')
            index[:, 0] = times
            index[:, 1] = offset + length * np.arange(count)
            entries.setdefault(topic_index + 1, array('Q')).frombytes(index.tobytes())
            offset += count * length
        return PlainChunk(buffer, entries, (min(int(times.min()) for _, times, _ in parts),
                                            max(int(times.max()) for _, times, _ in parts)))

    def _number(self, topic_index: int, count: int) -> int:
        """Return the sequence number of the next of `count` messages of a topic."""
        sequence = self._next_sequence[topic_index + 1]
        self._next_sequence[topic_index + 1] = sequence + count
        return sequence

    def write_chunk(self) -> None:
        """Compress and write the chunk in memory, if it holds anything."""
        if self._chunk_size:
            entries = self._chunk_entries
            self.put_plain_chunk(
                PlainChunk(b''.join(self._chunk_parts), entries, time_span(entries)))
            self._clear_chunk()

    def put_plain_chunk(self, plain: PlainChunk) -> None:
        """Compress and write a chunk, which holds at least one message."""
        start_ns, end_ns = plain.span
        self.copy_chunk(Chunk(
            compression=self._compression, data=self._buffers.compress(plain.data),
            uncompressed_size=len(plain.data), uncompressed_crc=zlib.crc32(plain.data),
            message_start_time=start_ns, message_end_time=end_ns), plain.entries, plain.span)
        if isinstance(plain.data, memoryview):
            self._buffers.recycle(plain.data)

    def copy_chunk(
        self, chunk: Chunk, entries: Entries, span: tuple[int, int], extra: bytes = b'',
    ) -> None:
        """
        Write a compressed chunk and its message indexes.

        `entries` and `span` are as in `PlainChunk`; `extra` stands behind the known fields.
        """
        head = _chunk_head(chunk, len(extra))
        chunk_length = len(head) + len(chunk.data) + len(extra)
        indexes = message_indexes(entries)
        index_offsets = {}
        offset = self.size + chunk_length
        for channel_id, index in indexes.items():
            index_offsets[channel_id] = offset
            offset += len(index)
        chunk_index = record_bytes(ChunkIndex(
            chunk_start_offset=self.size, chunk_length=chunk_length,
            message_index_offsets=index_offsets,
            message_index_length=offset - self.size - chunk_length,
            compression=chunk.compression, compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time))

        self._write([head, chunk.data, extra, *indexes.values()])
        self._chunk_indexes += chunk_index
        self.chunk_count += 1
        if indexes:
            empty = not any(self.message_counts.values())
            self.start_ns = span[0] if empty else min(self.start_ns, span[0])
            self.end_ns = max(self.end_ns, span[1])
            for channel_id in indexes:
                self.message_counts[channel_id] += len(entries[channel_id]) // 2

    def sync(self) -> None:
        """Wait until everything written is on the disk."""
        size = self.size
        os.fsync(self._file.fileno())
        self.synced_size = size

    def free_bytes(self) -> int:
        """Return how much of the disk is free for this user [bytes]."""
        disk = os.fstatvfs(self._file.fileno())
        return disk.f_bavail * disk.f_frsize

    def finish(self, *, bag: bool = True, file_name: str = '', former_bag: str = '') -> None:
        """
        Write the bag metadata and the summary, bring all to the disk and close the file.

        Parameters
        ----------
        bag : bool
            Whether the file has a `rosbag2` metadata record.
        file_name : str
            The name of the file in it, default: that of the file.
        former_bag : str
            The bag metadata of the log that this one is made from.

        """
        try:
            if bag:
                self.write_metadata(self._bag_metadata(file_name or self._path.name, former_bag))
            self._write([record_bytes(DataEnd(self._end[1]))])
            self._write([self._summary()])
            self.sync()
            sync_directory(self._path.parent)
        finally:
            if not self._file.closed:
                self._buffers.release()
                self._buffers = BufferPool('none')      # the other belongs to the next file
            self._file.close()

    def _bag_metadata(self, file_name: str, former: str) -> Metadata:
        topics = []
        for number, (channel, _) in self._channels.items():
            schema, _ = self._schemas.get(channel.schema_id, (None, b''))
            topics.append(BagTopic(
                channel.topic, schema.name if schema else '',
                channel.metadata.get('topic_type_hash', ''), self._qos_profiles[number],
                self.message_counts[number], channel.message_encoding))
        return Metadata(BAG_METADATA, {'serialized_metadata': bag_metadata_yaml(
            topics, file_name=file_name, start_ns=self.start_ns, end_ns=self.end_ns,
            former=former)})

    def _summary(self) -> bytes:
        """Return the summary section, the footer and the closing magic."""
        statistics = Statistics(
            message_count=sum(self.message_counts.values()), schema_count=len(self._schemas),
            channel_count=len(self._channels), attachment_count=len(self._attachment_indexes),
            metadata_count=len(self._metadata_indexes), chunk_count=self.chunk_count,
            message_start_time=self.start_ns, message_end_time=self.end_ns,
            channel_message_counts=self.message_counts)
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in (
            (Opcode.SCHEMA, b''.join(record for _, record in self._schemas.values())),
            (Opcode.CHANNEL, b''.join(record for _, record in self._channels.values())),
            (Opcode.STATISTICS, record_bytes(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, b''.join(map(record_bytes, self._attachment_indexes))),
            (Opcode.METADATA_INDEX, b''.join(map(record_bytes, self._metadata_indexes))),
        ):
            if group:
                offsets += record_bytes(SummaryOffset(
                    group_opcode=opcode, group_start=self.size + len(summary),
                    group_length=len(group)))
                summary += group
        offsets_start = self.size + len(summary)
        summary += offsets
        # The summary's checksum runs on into the footer, up to the checksum itself.
        footer = record_bytes(Footer(self.size, offsets_start, 0))
        summary += footer[:-4]
        return bytes(summary) + struct.pack('<I', zlib.crc32(summary)) + MCAP0_MAGIC

    def _clear_chunk(self) -> None:
        self._chunk_parts: list[bytes | memoryview] = []
        self._chunk_size = 0  # uncompressed
        self._chunk_entries: dict[int, array[int]] = {}

    def _write(self, blocks: Iterable[bytes]) -> None:
        """Write whole records that come in pieces, or none of them."""
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


def record_bytes(record: McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()
    return written


def message_indexes(entries: Entries) -> dict[int, bytes]:
    """Return the message index records behind a chunk by channel id, in ascending order."""
    return {
        channel_id: _INDEX.pack(
            Opcode.MESSAGE_INDEX, 2 + 4 + 8 * len(numbers), channel_id, 8 * len(numbers))
        + _little_endian(numbers)
        for channel_id, numbers in sorted(entries.items()) if numbers}


def time_span(entries: Entries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    times = [time for numbers in entries.values() for time in numbers[::2]]
    return min(times, default=0), max(times, default=0)


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _chunk_head(chunk: Chunk, extra: int) -> bytes:
    """Return what stands before the data in the record of a chunk."""
    compression = chunk.compression.encode()
    tail = struct.pack(f'<I{len(compression)}sQ', len(compression), compression, len(chunk.data))
    return _CHUNK.pack(
        Opcode.CHUNK, _CHUNK.size - 9 + len(tail) + len(chunk.data) + extra,
        chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size,
        chunk.uncompressed_crc) + tail


def _copy_rows(rows: NDArray[np.uint8] | list[bytes], to: NDArray[np.uint8]) -> None:
    """Copy messages of equal length into the rows of an array."""
    import numpy as np  # noqa: PLC0415

    if not isinstance(rows, list):
        to[:] = rows
        return
    size = to.shape[1]
    if not size:
        return
    step = max(1, _JOIN_BYTES // size)
    for first in range(0, len(rows), step):
        joined = b''.join(rows[first:first + step])
        to[first:first + step] = np.frombuffer(joined, 'u1').reshape(-1, size)


def _little_endian(numbers: array[int]) -> bytes:
    if sys.byteorder == 'big':
        numbers = array('Q', numbers)
        numbers.byteswap()
    return numbers.tobytes()


def _compress_lz4(plain: bytes | memoryview) -> bytes:
    return bytes(lz4.frame.compress(plain))


def _new_buffer() -> memoryview:
    # Private: a process that forks would share it with its children.
    private = ({'flags': mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS}
               if hasattr(mmap, 'MAP_PRIVATE') else {})
    return memoryview(mmap.mmap(-1, BUFFER_BYTES, **private))
