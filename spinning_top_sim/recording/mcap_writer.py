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
import queue
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import chunks
from spinning_top_sim.recording.chunks import ChunkBuilder, record_bytes
from spinning_top_sim.recording.rosbag2 import BAG_METADATA, bag_metadata_yaml

_COMPRESSING = 2    # chunks of rows that are compressed at once
_NOTHING: Future[None] = Future()
_NOTHING.set_result(None)


class McapWriter:
    """
    A new MCAP file, which must not exist (FileExistsError), used by one thread at a time.

    Messages come one by one into a chunk in memory (`append`, `append_all`), or as arrays that
    make a chunk (`append_rows`).  A topic is an index here, its channel has the id index + 1, and
    its messages are numbered; `copy_message` takes one with channel and number of another file.
    `flush` writes the chunk in memory, `write_chunk` another one, `write` any other record.

    Every write goes to an explicit position behind the last whole record, so neither an OSError
    nor an interrupt can shift what follows.  After an OSError `finish` may still be tried.

    compression : of the chunks, 'zstd', 'lz4' or 'none'
    """

    def __init__(self, path: Path, *, header: records.Header, compression: str) -> None:
        self._path = path
        self._chunk = ChunkBuilder(compression)       # of messages that come one by one
        # Chunks of rows: one is filled while the others are compressed.
        self._spare_chunks: queue.SimpleQueue[ChunkBuilder] = queue.SimpleQueue()
        for _ in range(_COMPRESSING + 1):
            self._spare_chunks.put(ChunkBuilder(compression))
        self._pool = ThreadPoolExecutor(_COMPRESSING, 'chunks')     # has no threads before rows
        self._queued = _NOTHING                     # the last chunk of rows

        self.message_counts: dict[int, int] = {}    # messages in the file by channel id
        self.chunk_count = 0
        self._times_ns: list[int] = []              # earliest and latest stamp of each chunk
        self._end = 0, 0    # size and checksum of the file; one assignment, so always consistent
        self._next_sequence: dict[int, int] = {}
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
            self.message_counts[record.id] = self._next_sequence[record.id] = 0

    def append(self, topic_index: int, log_time_ns: int, data: bytes) -> None:
        """Add the next message of a topic to the chunk in memory; write it when it is full."""
        self.copy_message(*self._numbered(topic_index, 1), log_time_ns, log_time_ns, data)

    def _numbered(self, topic_index: int, count: int) -> tuple[int, int]:
        """Return a topic's channel, and the sequence number of the first of `count` messages."""
        channel_id = topic_index + 1
        sequence = self._next_sequence[channel_id]
        self._next_sequence[channel_id] += count
        return channel_id, sequence

    def append_all(self, messages: Iterable[tuple[int, int, bytes]], size: int) -> None:
        """Add messages as `append` does, in less time; they take `size` bytes at most."""
        if self._chunk.size + size > chunks.CHUNK_BYTES:
            self.flush()
        by_topic: defaultdict[int, list[tuple[int, int, bytes]]] = defaultdict(list)
        for message in messages:
            by_topic[message[0]].append(message)
        for topic_index, group in by_topic.items():
            _, times_ns, data = zip(*group, strict=True)
            if len(set(map(len, data))) > 1:
                for message in group:
                    self.append(*message)
                continue
            self._chunk.add_rows(
                *self._numbered(topic_index, len(data)), np.array(times_ns, np.uint64),
                np.frombuffer(b''.join(data), np.uint8).reshape(len(data), len(data[0])))

    def copy_message(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int,
                     data: bytes | bytearray | memoryview) -> None:
        """Add a message to the chunk in memory, with these numbers; write it when it is full."""
        self._chunk.add(channel_id, sequence, log_time_ns, publish_time_ns, data)
        if self._chunk.size >= chunks.CHUNK_BYTES:
            self.flush()

    def append_rows(self, blocks: Iterable[chunks.RowBlock]) -> None:
        """
        Add a chunk of messages that come as arrays, after the messages that came one by one.

        The arrays are copied before this returns.  Two threads compress and write the chunks in
        the order in which they came.  This waits while both are busy, and raises the OSError of
        an earlier chunk.
        """
        if self._queued.done():
            self._wait()
        if self._chunk.size:
            self._queue(self._chunk)
            self._chunk = self._spare_chunks.get()
        chunk = self._spare_chunks.get()
        for topic_index, times_ns, rows in blocks:
            chunk.add_rows(*self._numbered(topic_index, len(rows)), times_ns, rows)
        if chunk.size:
            self._queue(chunk)
        else:                   # nothing was due
            self._spare_chunks.put(chunk)

    def flush(self) -> None:
        """Write the chunk in memory, if it holds anything, after those of `append_rows`."""
        self._wait()
        if self._chunk.size:
            self.write_chunk(self._chunk.record(), self._chunk.entries)
            self._chunk.clear()

    def write_chunk(self, chunk: records.Chunk, entries: chunks.IndexEntries) -> None:
        """Write a chunk with the indexes of its messages.  Raises OSError."""
        raw = record_bytes(chunk)
        indexes = chunks.message_indexes(entries)
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
        if indexes:
            self._times_ns += chunk.message_start_time, chunk.message_end_time
            for channel_id in indexes:
                self.message_counts[channel_id] += len(entries[channel_id]) // 2

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

    def finish(self, *, bag: bool = True) -> None:
        """Write the `rosbag2` record and the summary, bring all to the disk, close the file."""
        try:
            self._pool.shutdown()
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

    def _queue(self, chunk: ChunkBuilder) -> None:
        """Have a chunk compressed in a thread, and written after those queued before."""
        self._queued = self._pool.submit(self._write_in_turn, chunk, self._queued)

    def _wait(self) -> None:
        """Wait for the chunks that are queued.  Raises the OSError of one, but only once."""
        queued = self._queued
        if queued.exception() is not None:
            self._queued = _NOTHING
        queued.result()

    def _write_in_turn(self, chunk: ChunkBuilder, before: Future[None]) -> None:
        try:
            record = chunk.record()
            before.result()
            self.write_chunk(record, chunk.entries)
        finally:
            chunk.clear()
            self._spare_chunks.put(chunk)

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


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
