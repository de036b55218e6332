# SPDX-License-Identifier: Apache-2.0
"""
An MCAP file that ends after a whole record at any time, whatever happens to the disk.

mcap's own Writer buffers what it could not write, then reports success, and cannot go back.  So
the file is laid out here, from mcap's record classes; only the two records that grow with every
message are packed by hand, for speed (MCAP specification, "Message" and "Message Index").

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.  Recordings and recovered logs are written by the
same code.  Imported when a recording starts.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import struct
import sys
import zlib
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

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

from spinning_top_sim.recording.rosbag2 import (
    BagTopic,
    RecordedTopic,
    bag_metadata_yaml,
    offered_qos_yaml,
)
from spinning_top_sim.recording.schemas import MessageDefinition
from spinning_top_sim.recording.scratch import Scratch, keep, scratch_for

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHUNK_BYTES = 1 << 20  # uncompressed; a single larger message still makes a chunk of its own

FEW = 8                 # messages, of a topic: as quick one by one
JOINED_BYTES = 1 << 16  # of a topic's messages at a time, to be copied from there: it stays warm

# What a chunk holds, by channel: log time, offset in the uncompressed chunk, log time, offset, ..
# (uint64).
Entries = Mapping[int, 'array[int]']

MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
MESSAGE_FIELDS = 2 + 4 + 8 + 8      # what `length` counts besides the data
_MESSAGE_HEAD = [('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                 ('log_time', '<u8'), ('publish_time', '<u8')]
_CHUNK = struct.Struct('<BQQQQI')   # opcode, length, span, size and crc of the plain data
_INDEX = struct.Struct('<BQHI')      # opcode, length, channel, length of the entries


class PlainChunk(NamedTuple):
    """
    Messages that are to become a chunk.

    data: their records, which the file takes back once they are written
    span: earliest and latest stamp [ns]
    """

    data: bytes | memoryview
    entries: Entries
    span: tuple[int, int]


class IndexedFile:
    """
    A new MCAP file, written by one thread; every method that touches the disk may raise OSError.

    After an OSError the file ends behind the last whole record, and `finish` may still be tried.
    """

    def __init__(self, path: Path, *, profile: str, library: str, compression: str) -> None:
        """
        Create the file with its header.

        compression: of chunks made here: 'zstd', 'lz4' or 'none'

        Raises FileExistsError rather than overwrite anything, and other OSErrors.
        """
        self._path = path
        self._compression = '' if compression == 'none' else compression

        self.message_counts: dict[int, int] = {}  # messages in the file, by channel
        self.chunk_count = 0
        self.start_ns = self.end_ns = 0      # earliest and latest stamp; both 0 without messages
        self.size = 0                        # bytes in the file, all of them whole records
        self.synced_size = 0                 # how much of it is surely on the disk
        self._data_crc = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunk_indexes = bytearray()    # serialized: thousands of objects take room
        self._metadata_indexes: list[MetadataIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._clear_chunk()

        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
        with self.discarded_on_failure():
            self._scratch = scratch_for(compression)
            self._put(MCAP0_MAGIC + record_bytes(Header(profile=profile, library=library)))

    @contextlib.contextmanager
    def discarded_on_failure(self) -> Iterator[None]:
        """Close and remove the file when what is done meanwhile raises anything."""
        try:
            yield
        except BaseException:
            self._file.close()
            with contextlib.suppress(OSError):
                self._path.unlink()
            raise

    def put_schema(self, schema: Schema) -> None:
        """Write a schema; the first of an id is the one that the summary repeats."""
        self._put(record_bytes(schema))
        self._schemas.setdefault(schema.id, schema)

    def put_channel(self, channel: Channel) -> None:
        """Write a channel; the first of an id is the one that the summary repeats."""
        self._put(record_bytes(channel))
        self._channels.setdefault(channel.id, channel)
        self.message_counts.setdefault(channel.id, 0)

    def put_metadata(self, metadata: Metadata) -> None:
        """Write a metadata record."""
        record = record_bytes(metadata)
        index = MetadataIndex(offset=self.size, length=len(record), name=metadata.name)
        self._put(record)
        self._metadata_indexes.append(index)

    def put_attachment(self, index: AttachmentIndex, blocks: Iterable[bytes]) -> None:
        """
        Write an attachment.

        index: what the summary says of it; where it stands is filled in here
        blocks: the whole record, `index.length` bytes in pieces of any size
        """
        index = dataclasses.replace(index, offset=self.size)
        self._put_blocks(blocks)
        self._attachment_indexes.append(index)

    def add_message(
        self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes,
    ) -> bool:
        """Add a message to the chunk in memory; return whether the chunk is full."""
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

    def write_chunk(self) -> None:
        """Compress and write the chunk in memory, if it holds anything."""
        if not self._chunk_size:
            return
        entries = self._chunk_entries
        self.put_plain_chunk(PlainChunk(b''.join(self._chunk_parts), entries, time_span(entries)))
        self._clear_chunk()

    def put_plain_chunk(self, plain: PlainChunk) -> None:
        """Compress and write a chunk, which holds something."""
        start_ns, end_ns = plain.span
        self.put_chunk(Chunk(
            compression=self._compression, data=self._scratch.compress(plain.data),
            uncompressed_size=len(plain.data), uncompressed_crc=zlib.crc32(plain.data),
            message_start_time=start_ns, message_end_time=end_ns), plain.entries, plain.span)
        if isinstance(plain.data, memoryview):
            self._scratch.give_back(plain.data)

    def put_chunk(self, chunk: Chunk, entries: Entries, span: tuple[int, int] | None = None,
                  ) -> None:
        """
        Write a chunk as it is, and the message indexes that belong to its `entries`.

        span: the earliest and the latest stamp in `entries`, where they are known
        """
        head = _chunk_head(chunk)
        chunk_length = len(head) + len(chunk.data)
        indexes = message_indexes(entries)
        index_start = self.size + chunk_length
        index_offsets = {}
        for channel_id, index in indexes.items():
            index_offsets[channel_id] = index_start
            index_start += len(index)
        chunk_index = ChunkIndex(
            chunk_start_offset=self.size, chunk_length=chunk_length,
            message_index_offsets=index_offsets,
            message_index_length=index_start - self.size - chunk_length,
            compression=chunk.compression, compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time, message_end_time=chunk.message_end_time)

        self._put_blocks((head, chunk.data, b''.join(indexes.values())))
        self._chunk_indexes += record_bytes(chunk_index)
        self.chunk_count += 1
        if not indexes:
            return
        start_ns, end_ns = span or time_span(entries)
        first = not any(self.message_counts.values())
        self.start_ns = start_ns if first else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)
        for channel_id in indexes:
            self.message_counts[channel_id] += len(entries[channel_id]) // 2

    def sync(self) -> None:
        """Wait until everything written is on the disk."""
        os.fsync(self._file.fileno())
        self.synced_size = self.size

    def free_bytes(self) -> int:
        """Return what is left for us on the disk [bytes]."""
        disk = os.fstatvfs(self._file.fileno())
        return disk.f_bavail * disk.f_frsize

    def close(self, last_metadata: Metadata | None) -> None:
        """Write a last record and the summary, bring all to disk and close the file."""
        try:
            self._put(self._tail(last_metadata))
            self.sync()
            sync_directory(self._path.parent)
        finally:
            if not self._file.closed:
                keep(self._scratch)
                self._scratch = Scratch('none')     # the other belongs to the next file
            self._file.close()

    def _tail(self, last_metadata: Metadata | None) -> bytes:
        """Return everything behind the last chunk: the last record, summary, footer."""
        data = b''
        metadata_indexes = self._metadata_indexes
        if last_metadata is not None:
            data = record_bytes(last_metadata)
            metadata_indexes = [*metadata_indexes, MetadataIndex(
                offset=self.size, length=len(data), name=last_metadata.name)]
        data += record_bytes(DataEnd(zlib.crc32(data, self._data_crc)))

        statistics = Statistics(
            message_count=sum(self.message_counts.values()), schema_count=len(self._schemas),
            channel_count=len(self._channels), attachment_count=len(self._attachment_indexes),
            metadata_count=len(metadata_indexes), chunk_count=self.chunk_count,
            message_start_time=self.start_ns, message_end_time=self.end_ns,
            channel_message_counts=self.message_counts)
        summary_start = self.size + len(data)
        summary = bytearray()
        offsets = bytearray()
        for opcode, group in (
            (Opcode.SCHEMA, _joined(self._schemas.values())),
            (Opcode.CHANNEL, _joined(self._channels.values())),
            (Opcode.STATISTICS, record_bytes(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, _joined(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _joined(metadata_indexes)),
        ):
            if group:
                offsets += record_bytes(SummaryOffset(
                    group_opcode=opcode, group_start=summary_start + len(summary),
                    group_length=len(group)))
                summary += group
        offsets_start = summary_start + len(summary)
        summary += offsets

        # The summary's checksum runs on into the footer, up to the checksum itself.
        footer_head = struct.pack('<BQQQ', Opcode.FOOTER, 8 + 8 + 4, summary_start, offsets_start)
        footer = Footer(
            summary_start=summary_start, summary_offset_start=offsets_start,
            summary_crc=zlib.crc32(footer_head, zlib.crc32(summary)))
        return data + summary + record_bytes(footer) + MCAP0_MAGIC

    def _clear_chunk(self) -> None:
        self._chunk_parts: list[bytes] = []
        self._chunk_size = 0  # uncompressed
        self._chunk_entries: dict[int, array[int]] = {}

    def _put(self, records: bytes) -> None:
        """Write whole records, or none of them."""
        self._put_blocks((records,))

    def _put_blocks(self, blocks: Iterable[bytes]) -> None:
        """Write whole records that come in pieces, or none of them."""
        size, crc = self.size, self._data_crc
        try:
            for block in blocks:
                rest = memoryview(block)
                while rest:
                    rest = rest[self._file.write(rest):]
                size += len(block)
                crc = zlib.crc32(block, crc)
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise
        self.size, self._data_crc = size, crc


class McapFile(IndexedFile):
    """
    The file of a recording: its topics are known from the start.

    All topics stand before the first chunk, so that a torn file tells them in any case.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[RecordedTopic],
        definitions: Mapping[str, MessageDefinition],
        metadata: Mapping[str, Mapping[str, str]],
        *,
        library: str,
        compression: str,
    ) -> None:
        """
        Create the file and bring its head to the disk.

        definitions: by type name, for every topic
        metadata: metadata records by name
        compression: 'zstd', 'lz4' or 'none'

        Raises FileExistsError rather than overwrite anything, and other OSErrors.
        """
        super().__init__(path, profile='ros2', library=library, compression=compression)
        self._topics = topics
        self._sequences = [0] * len(topics)
        schema_ids = {name: number for number, name in enumerate(
            dict.fromkeys(topic.type_name for topic in topics), start=1)}
        with self.discarded_on_failure():
            for name, record in metadata.items():
                self.put_metadata(Metadata(name=name, metadata=dict(record)))
            for name, number in schema_ids.items():
                self.put_schema(Schema(
                    id=number, name=name, encoding='ros2msg',
                    data=definitions[name].text.encode()))
            for number, topic in enumerate(topics, start=1):
                self.put_channel(Channel(
                    id=number, topic=topic.name, message_encoding='cdr',
                    schema_id=schema_ids[topic.type_name],
                    metadata={'offered_qos_profiles': offered_qos_yaml(topic),
                              'topic_type_hash': definitions[topic.type_name].type_hash}))
            self.sync()
            sync_directory(path.parent)

    @property
    def counts(self) -> list[int]:
        """Messages in the file, per topic."""
        return [self.message_counts[number] for number in range(1, len(self._topics) + 1)]

    def append(self, topic_index: int, log_time_ns: int, data: bytes) -> bool:
        """Add a message to the chunk in memory; return whether the chunk is full."""
        sequence = self._sequences[topic_index]
        self._sequences[topic_index] = sequence + 1
        return self.add_message(
            topic_index + 1, sequence & 0xFFFFFFFF, log_time_ns, log_time_ns, data)

    def append_all(self, taken: Sequence[tuple[Sequence[int], int, Sequence[bytes], int]],
                   ) -> None:
        """
        Write many messages, those of one stamp together: topic indices, log time [ns], CDR, size.

        Those of a topic that are of one length go into their chunk as rows, for a tenth of the
        work.  Nothing is left in memory, so that the messages of a topic keep their order in the
        file.
        """
        if not taken:
            return
        size = sum(size + MESSAGE.size * len(messages) for _, _, messages, size in taken)
        count = max(1, len(taken) * CHUNK_BYTES // size)
        for first in range(0, len(taken), count):
            times: dict[int, list[int]] = {}
            rows: dict[int, list[bytes]] = {}
            # One after the other they are mostly of the same topics.
            for topic_indices, alike in groupby(taken[first:first + count], itemgetter(0)):
                _, alike_times, alike_messages, _ = zip(*list(alike), strict=True)
                for topic_index, data in zip(topic_indices, zip(*alike_messages, strict=True),
                                             strict=True):
                    times.setdefault(topic_index, []).extend(alike_times)
                    rows.setdefault(topic_index, []).extend(data)
            self._append_by_topic(times, rows)

    def _append_by_topic(self, times: dict[int, list[int]], rows: dict[int, list[bytes]]) -> None:
        import numpy  # noqa: PLC0415 - rclpy's messages have imported it

        parts: list[tuple[int, NDArray[Any], list[bytes]]] = []
        stamps, newest = numpy.empty(0, numpy.int64), None
        for topic_index, data in rows.items():
            if len(data) >= FEW and data[0] and len(set(map(len, data))) == 1:
                if times[topic_index] != newest:        # those of many topics are the same
                    newest = times[topic_index]
                    stamps = numpy.array(newest, numpy.int64)
                parts.append((topic_index, stamps, data))
                continue
            for time_ns, one in zip(times[topic_index], data, strict=True):
                if self.append(topic_index, time_ns, one):
                    self.write_chunk()
        if parts:
            rest = self._chunk_parts, self._chunk_entries
            self._clear_chunk()
            self.put_plain_chunk(self.chunk_of_rows(parts, *rest))
        else:
            self.write_chunk()

    def chunk_of_rows(
        self, parts: Sequence[tuple[int, NDArray[Any], NDArray[Any] | list[bytes]]],
        rest: Sequence[bytes] = (), rest_entries: Entries = MappingProxyType({}),
    ) -> PlainChunk:
        """
        Return a chunk of messages of equal length a topic, made in a few numpy calls.

        parts: (topic index, log times (n,) int64 [ns], CDR of each message, or rows of these
            (n, size) uint8), each topic at most once and not empty.  The messages of a chunk need
            no order of time: its message indexes have it (MCAP specification, "Message Index").
        rest: records of other topics, to stand behind these;  rest_entries: theirs, by themselves
        """
        import numpy  # noqa: PLC0415 - recovery needs none

        sizes = [len(rows[0]) for _, _, rows in parts]
        rest_at = sum(len(times) * (MESSAGE.size + size)
                      for (_, times, _), size in zip(parts, sizes, strict=True))
        room = self._scratch.room(rest_at + sum(map(len, rest)))
        data = numpy.frombuffer(room, 'u1')
        head = numpy.dtype(_MESSAGE_HEAD)
        at = 0
        entries = {}
        for (topic_index, times, rows), size in zip(parts, sizes, strict=True):
            count, length = len(times), MESSAGE.size + size
            records = data[at:at + count * length].reshape(count, length)
            heads = records[:, :MESSAGE.size].view(head)[:, 0]
            heads['opcode'] = Opcode.MESSAGE
            heads['length'] = MESSAGE_FIELDS + size
            heads['channel'] = topic_index + 1
            sequence = self._sequences[topic_index]
            heads['sequence'] = numpy.arange(sequence, sequence + count) & 0xFFFFFFFF
            heads['log_time'] = heads['publish_time'] = times
            _copy_rows(rows, records[:, MESSAGE.size:])
            self._sequences[topic_index] = sequence + count
            index = numpy.empty((count, 2), 'u8')
            index[:, 0] = times
            index[:, 1] = at + length * numpy.arange(count)
            entries[topic_index + 1] = array('Q', index.tobytes())
            at += count * length
        spans = [(int(times.min()), int(times.max())) for _, times, _ in parts]
        if rest:
            room[rest_at:] = b''.join(rest)
            for channel_id, numbers in rest_entries.items():
                entries[channel_id] = array('Q', numbers)
                for i in range(1, len(numbers), 2):
                    entries[channel_id][i] += rest_at
            spans.append(time_span(rest_entries))
        return PlainChunk(room, entries, (min(start for start, _ in spans),
                                          max(end for _, end in spans)))

    def finish(self) -> None:
        """Write the summary of the chunks that are in the file, bring it to disk and close it."""
        bag_topics = [
            BagTopic(topic.name, topic.type_name, channel.metadata['topic_type_hash'],
                     (topic.qos,), count)
            for topic, channel, count in zip(
                self._topics, self._channels.values(), self.counts, strict=True)]
        self.close(Metadata(name='rosbag2', metadata={'serialized_metadata': bag_metadata_yaml(
            bag_topics, file_name=self._path.name, start_ns=self.start_ns, end_ns=self.end_ns)}))


def record_bytes(record: McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()
    return written


def _joined(records: Iterable[McapRecord]) -> bytes:
    return b''.join(map(record_bytes, records))


def _chunk_head(chunk: Chunk) -> bytes:
    """Return what stands before the data in the record of a chunk."""
    compression = chunk.compression.encode()
    tail = struct.pack(f'<I{len(compression)}sQ', len(compression), compression, len(chunk.data))
    return _CHUNK.pack(
        Opcode.CHUNK, _CHUNK.size - 9 + len(tail) + len(chunk.data), chunk.message_start_time,
        chunk.message_end_time, chunk.uncompressed_size, chunk.uncompressed_crc) + tail


def _copy_rows(rows: NDArray[Any] | list[bytes], to: NDArray[Any]) -> None:
    """Copy messages of equal length into the rows of an array."""
    import numpy  # noqa: PLC0415

    if not isinstance(rows, list):
        to[:] = rows
        return
    size = to.shape[1]
    step = max(1, JOINED_BYTES // size)
    for first in range(0, len(rows), step):
        joined = b''.join(rows[first:first + step])
        to[first:first + step] = numpy.frombuffer(joined, 'u1').reshape(-1, size)


def message_indexes(entries: Entries) -> dict[int, bytes]:
    """Return the message index records behind a chunk, by channel and in its order."""
    return {
        channel_id: _INDEX.pack(
            Opcode.MESSAGE_INDEX, 2 + 4 + 8 * len(numbers), channel_id, 8 * len(numbers))
        + _little_endian(numbers)
        for channel_id, numbers in sorted(entries.items()) if numbers}


def _little_endian(numbers: array[int]) -> bytes:
    if sys.byteorder == 'big':
        numbers = array('Q', numbers)
        numbers.byteswap()
    return numbers.tobytes()


def time_span(entries: Entries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    times = [time for numbers in entries.values() for time in numbers[::2]]
    return min(times, default=0), max(times, default=0)


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, where the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
