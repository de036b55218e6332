# SPDX-License-Identifier: Apache-2.0
"""
Writes MCAP files that end after a whole record at any time, whatever happens to the disk.

mcap's own Writer buffers what it cannot write, then reports success, and cannot go back.  So the
file is laid out here, from mcap's record classes.

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

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

from spinning_top_sim.recording.chunks import (
    CHUNK_BYTES,
    MESSAGE,
    MESSAGE_FIELDS,
    BufferPool,
    Entries,
    Messages,
    PlainChunk,
    Run,
    chunk_of_runs,
    message_indexes,
    split_by_topic,
    time_span,
)
from spinning_top_sim.recording.rosbag2 import BAG_METADATA, BagTopic, Qos, bag_metadata_yaml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_CHUNK = struct.Struct('<BQQQQI')   # opcode, length, span, size and crc of the plain data


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
    header : bytes
        The header as another file has it, default: made from `profile` and `library`.

    Raises
    ------
    FileExistsError
        If the file exists.
    OSError
        If it cannot be written.  Every method that writes may raise it.

    """

    def __init__(self, path: Path, *, profile: str, library: str, compression: str,
                 header: bytes = b'') -> None:
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
            self._write([MCAP0_MAGIC, header or record_bytes(Header(profile, library))])

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
        if not batch:
            return
        size = sum(size + MESSAGE.size * len(messages) for _, _, messages, size in batch)
        per_chunk = max(1, len(batch) * CHUNK_BYTES // size)
        self.write_chunk()
        for first in range(0, len(batch), per_chunk):
            self.put_plain_chunk(self.chunk_of_rows(
                list(split_by_topic(batch[first:first + per_chunk]))))

    def chunk_of_rows(
        self, parts: Sequence[tuple[int, NDArray[np.integer], NDArray[np.uint8] | list[bytes]]],
    ) -> PlainChunk:
        """
        Make a chunk of the next messages of some topics.

        Parameters
        ----------
        parts : sequence of (topic index, log times, messages)
            As in `Run`.

        """
        return chunk_of_runs(
            [Run(topic_index + 1, self._number(topic_index, len(times)), times, messages)
             for topic_index, times, messages in parts], self._buffers)

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
        self, chunk: Chunk, entries: Entries, span: tuple[int, int], record: bytes = b'',
    ) -> None:
        """
        Write a compressed chunk and its message indexes.

        `entries` and `span` are as in `PlainChunk`, `record` is as in `write_schema`.
        """
        blocks = [record] if record else [_chunk_head(chunk), chunk.data]
        chunk_length = sum(map(len, blocks))
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

        self._write([*blocks, *indexes.values()])
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


def record_bytes(record: McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    written: bytes = builder.end()
    return written


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _chunk_head(chunk: Chunk) -> bytes:
    """Return what stands before the data, which mcap's record class would copy."""
    compression = chunk.compression.encode()
    tail = struct.pack(f'<I{len(compression)}sQ', len(compression), compression, len(chunk.data))
    return _CHUNK.pack(
        Opcode.CHUNK, _CHUNK.size - 9 + len(tail) + len(chunk.data), chunk.message_start_time,
        chunk.message_end_time, chunk.uncompressed_size, chunk.uncompressed_crc) + tail
