# SPDX-License-Identifier: Apache-2.0
"""
An MCAP file that ends after a whole record at any time, whatever happens to the disk.

mcap's own Writer buffers what it could not write, then reports success, and cannot go back.  So
the file is laid out here, from mcap's record classes; only the two records that grow with every
message are packed by hand, for speed (MCAP specification, "Message" and "Message Index").

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.  Imported when a recording starts.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
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
    RecordedTopic,
    bag_metadata_yaml,
    offered_qos_yaml,
)
from spinning_top_sim.recording.schemas import MessageDefinition

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHUNK_BYTES = 1 << 20  # uncompressed; a single larger message still makes a chunk of its own

_MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
_MESSAGE_FIELDS = 2 + 4 + 8 + 8      # what `length` counts besides the data
_INDEX = struct.Struct('<BQHI')      # opcode, length, channel, length of the entries


def _compressor(compression: str) -> Callable[[bytes | memoryview], bytes]:
    """Return what compresses a chunk."""
    if compression == 'zstd':
        return zstandard.ZstdCompressor().compress
    if compression == 'lz4':
        return lambda plain: bytes(lz4.frame.compress(plain))
    return bytes


class McapFile:
    """
    A new file, written by one thread; every method that touches the disk may raise OSError.

    After an OSError the file ends behind the last whole chunk, and `finish` may still be tried.
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
        self._path = path
        self._topics = topics
        self._hashes = [definitions[topic.type_name].type_hash for topic in topics]
        self._compression = '' if compression == 'none' else compression
        self._compress = _compressor(compression)

        schema_ids = {name: number for number, name in enumerate(
            dict.fromkeys(topic.type_name for topic in topics), start=1)}
        self._schemas = [
            Schema(id=number, name=name, encoding='ros2msg', data=definitions[name].text.encode())
            for name, number in schema_ids.items()]
        self._channels = [
            Channel(
                id=number, topic=topic.name, message_encoding='cdr',
                schema_id=schema_ids[topic.type_name],
                metadata={'offered_qos_profiles': offered_qos_yaml(topic),
                          'topic_type_hash': definitions[topic.type_name].type_hash})
            for number, topic in enumerate(topics, start=1)]

        self.counts = [0] * len(topics)      # messages in the file, per topic
        self.size = 0                        # bytes in the file, all of them whole records
        self.synced_size = 0                 # how much of it is surely on the disk
        self._data_crc = 0
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._sequences = [0] * len(topics)
        self._clear_chunk()

        # Schemas and channels stand before the first chunk: a torn file tells them in any case.
        head = RecordBuilder()
        head.write(MCAP0_MAGIC)
        Header(profile='ros2', library=library).write(head)
        for name, record in metadata.items():
            self._add_metadata(head, 0, name, dict(record))
        for schema in self._schemas:
            schema.write(head)
        for channel in self._channels:
            channel.write(head)
        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115
        try:
            self._put(head.end())
            self.sync()
            _sync_directory(path.parent)
        except BaseException:
            self._file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise

    def append(self, topic_index: int, log_time_ns: int, data: bytes) -> bool:
        """Add a message to the chunk in memory; return whether the chunk is full."""
        sequence = self._sequences[topic_index]
        self._sequences[topic_index] = sequence + 1
        self._chunk_parts.append(_MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_FIELDS + len(data), topic_index + 1, sequence & 0xFFFFFFFF,
            log_time_ns, log_time_ns))
        self._chunk_parts.append(data)
        entries = self._chunk_entries[topic_index]
        entries.append(log_time_ns)
        entries.append(self._chunk_size)
        self._chunk_size += _MESSAGE.size + len(data)
        return self._chunk_size >= CHUNK_BYTES

    def write_chunk(self) -> None:
        """Compress and write the chunk in memory, if it holds anything."""
        if not self._chunk_size:
            return
        times = [time for entries in self._chunk_entries for time in entries[::2]]
        self._write_chunk(
            b''.join(self._chunk_parts), min(times), max(times),
            [(topic_index, len(entries) // 2, struct.pack(f'<{len(entries)}Q', *entries))
             for topic_index, entries in enumerate(self._chunk_entries) if entries])
        self._clear_chunk()

    def write_rows(self, parts: Sequence[tuple[int, NDArray[Any], NDArray[Any]]]) -> None:
        """
        Write a chunk of messages of equal length a topic, in a few numpy calls.

        parts: (topic index, log times (n,) int64 [ns], rows of CDR bytes (n, size) uint8), each
            topic at most once and not empty.  The messages of a chunk need no order of time: its
            message indexes have it (MCAP specification, "Message Index").
        """
        self.write_chunk()
        import numpy  # noqa: PLC0415 - a live recording needs none

        head = numpy.dtype([
            ('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
            ('log_time', '<u8'), ('publish_time', '<u8')])
        plain = numpy.empty(sum(len(times) * (head.itemsize + rows.shape[1])
                                for _, times, rows in parts), 'u1')
        at = 0
        indexes = []
        for topic_index, times, rows in parts:
            count, size = rows.shape
            length = head.itemsize + size
            records = plain[at:at + count * length].reshape(count, length)
            heads = records[:, :head.itemsize].view(head)[:, 0]
            heads['opcode'] = Opcode.MESSAGE
            heads['length'] = _MESSAGE_FIELDS + size
            heads['channel'] = topic_index + 1
            sequence = self._sequences[topic_index]
            heads['sequence'] = numpy.arange(sequence, sequence + count) & 0xFFFFFFFF
            heads['log_time'] = heads['publish_time'] = times
            records[:, head.itemsize:] = rows
            self._sequences[topic_index] = sequence + count
            entries = numpy.empty((count, 2), '<u8')
            entries[:, 0] = times
            entries[:, 1] = at + length * numpy.arange(count)
            indexes.append((topic_index, count, entries.tobytes()))
            at += count * length
        self._write_chunk(plain.data, min(int(times.min()) for _, times, _ in parts),
                          max(int(times.max()) for _, times, _ in parts), indexes)

    def _write_chunk(self, plain: bytes | memoryview, start_ns: int, end_ns: int,
                     indexes: Sequence[tuple[int, int, bytes]]) -> None:
        """Write a chunk and its message indexes: (topic index, message count, entries)."""
        packed = self._compress(plain)
        chunk = Chunk(
            compression=self._compression, data=packed, uncompressed_size=len(plain),
            uncompressed_crc=zlib.crc32(plain),
            message_start_time=start_ns, message_end_time=end_ns)
        records = RecordBuilder()
        chunk.write(records)
        chunk_length = records.count
        index_offsets = {}
        for topic_index, _, entries in indexes:
            index_offsets[topic_index + 1] = self.size + records.count
            records.write(_INDEX.pack(
                Opcode.MESSAGE_INDEX, 2 + 4 + len(entries), topic_index + 1, len(entries)))
            records.write(entries)
        index = ChunkIndex(
            chunk_start_offset=self.size, chunk_length=chunk_length,
            message_index_offsets=index_offsets,
            message_index_length=records.count - chunk_length,
            compression=self._compression, compressed_size=len(packed),
            uncompressed_size=len(plain),
            message_start_time=start_ns, message_end_time=end_ns)

        self._put(records.end())
        self._chunk_indexes.append(index)
        for topic_index, count, _ in indexes:
            self.counts[topic_index] += count

    def sync(self) -> None:
        """Wait until everything written is on the disk."""
        os.fsync(self._file.fileno())
        self.synced_size = self.size

    def free_bytes(self) -> int:
        """Return what is left for us on the disk [bytes]."""
        disk = os.fstatvfs(self._file.fileno())
        return disk.f_bavail * disk.f_frsize

    def finish(self) -> None:
        """Write the summary of the chunks that are in the file, bring it to disk and close it."""
        try:
            self._put(self._tail())
            self.sync()
            _sync_directory(self._path.parent)
        finally:
            self._file.close()

    def _tail(self) -> bytes:
        """Return everything behind the last chunk: bag metadata, summary, footer."""
        start_ns = min((index.message_start_time for index in self._chunk_indexes), default=0)
        end_ns = max((index.message_end_time for index in self._chunk_indexes), default=0)
        bag = bag_metadata_yaml(
            self._topics, self._hashes, self.counts, file_name=self._path.name,
            start_ns=start_ns, end_ns=end_ns)
        tail = RecordBuilder()
        self._add_metadata(tail, self.size, 'rosbag2', {'serialized_metadata': bag})
        data: bytes = tail.end()
        DataEnd(zlib.crc32(data, self._data_crc)).write(tail)
        data += tail.end()

        statistics = Statistics(
            message_count=sum(self.counts), schema_count=len(self._schemas),
            channel_count=len(self._channels), attachment_count=0,
            metadata_count=len(self._metadata_indexes), chunk_count=len(self._chunk_indexes),
            message_start_time=start_ns, message_end_time=end_ns,
            channel_message_counts=dict(enumerate(self.counts, start=1)))
        summary_start = self.size + len(data)
        offsets = []
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]
        for opcode, records in groups:
            group_start = tail.count
            for record in records:
                record.write(tail)
            if records:
                offsets.append(SummaryOffset(
                    group_opcode=opcode, group_start=summary_start + group_start,
                    group_length=tail.count - group_start))
        offsets_start = summary_start + tail.count
        for offset in offsets:
            offset.write(tail)
        summary: bytes = tail.end()

        # The summary's checksum runs on into the footer, up to the checksum itself.
        footer_head = struct.pack('<BQQQ', Opcode.FOOTER, 8 + 8 + 4, summary_start, offsets_start)
        Footer(
            summary_start=summary_start, summary_offset_start=offsets_start,
            summary_crc=zlib.crc32(footer_head, zlib.crc32(summary))).write(tail)
        footer: bytes = tail.end()
        return data + summary + footer + MCAP0_MAGIC

    def _add_metadata(
        self, records: RecordBuilder, offset: int, name: str, content: dict[str, str],
    ) -> None:
        """Append a metadata record; `offset` is where `records` will stand in the file."""
        start = records.count
        Metadata(name=name, metadata=content).write(records)
        self._metadata_indexes.append(MetadataIndex(
            offset=offset + start, length=records.count - start, name=name))

    def _clear_chunk(self) -> None:
        self._chunk_parts: list[bytes] = []
        self._chunk_size = 0  # uncompressed
        # per topic: stamp, offset in the chunk, stamp, offset, ...
        self._chunk_entries: list[list[int]] = [[] for _ in self._topics]

    def _put(self, records: bytes) -> None:
        """Write whole records, or none of them."""
        try:
            rest = memoryview(records)
            while rest:
                rest = rest[self._file.write(rest):]
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise
        self.size += len(records)
        self._data_crc = zlib.crc32(records, self._data_crc)


def _sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, where the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
