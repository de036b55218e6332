# SPDX-License-Identifier: Apache-2.0
"""
Writes MCAP files that end after a whole record at any time, whatever happens to the disk.

mcap's own Writer buffers what it cannot write, then reports success, and cannot go back.

Layout: header, metadata of the run, schemas, channels | chunk, its message indexes | ... |
`rosbag2` metadata, data end | summary, footer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from spinning_top_sim.recording import chunks
from spinning_top_sim.recording.rosbag2 import BAG_METADATA, bag_metadata_yaml


class McapWriter:
    """
    A new MCAP file, which must not exist (FileExistsError), written by one thread at a time.

    Every write goes to an explicit position behind the last whole record, so neither an OSError
    nor an interrupt can shift what follows.  After an OSError `finish` may still be tried.

    compression : of chunks that are made here, 'zstd', 'lz4' or 'none'
    """

    def __init__(self, path: Path, *, header: bytes, compression: str) -> None:
        self._path = path
        self._compression = '' if compression == 'none' else compression
        self._compress = chunks.compressor(compression)
        self._chunk = chunks.PlainChunk()           # of messages that come one by one
        self._spare_chunks: list[chunks.PlainChunk] = []    # for rows

        self.message_counts: dict[int, int] = {}    # messages in the file by channel id
        self.chunk_count = 0
        self._start_ns = self._end_ns = 0           # earliest and latest stamp; 0 without messages
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
            self._write([MCAP0_MAGIC, header])

    @property
    def size(self) -> int:
        """Size of the file, all of it whole records [bytes]."""
        return self._end[0]

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

    def write(self, record: records.Schema | records.Channel | records.Metadata,
              raw: bytes = b'') -> None:
        """Write a record, or its bytes `raw` from another file; schemas come before channels."""
        offset = self.size
        raw = raw or record_bytes(record)
        self._write([raw])
        if isinstance(record, records.Metadata):
            self._summary_records[Opcode.METADATA_INDEX].append(
                record_bytes(records.MetadataIndex(offset, len(raw), record.name)))
        elif isinstance(record, records.Schema) and record.id not in self._type_names:
            self._type_names[record.id] = record.name
            self._summary_records[Opcode.SCHEMA].append(raw)
        elif isinstance(record, records.Channel) and record.id not in self._channels:
            self._channels[record.id] = record
            self._summary_records[Opcode.CHANNEL].append(raw)
            self.message_counts[record.id] = self._next_sequence[record.id] = 0

    def copy_record(self, blocks: Iterable[bytes], index: records.McapRecord | None) -> None:
        """Write an attachment, or a record of unknown kind, in blocks of any size."""
        offset = self.size
        self._write(blocks)
        if isinstance(index, records.AttachmentIndex):
            self._summary_records[Opcode.ATTACHMENT_INDEX].append(
                record_bytes(dataclasses.replace(index, offset=offset)))

    def append(self, topic_index: int, log_time_ns: int, data: bytes) -> None:
        """Add the next message of channel `topic_index + 1`, as `add_message` does."""
        channel_id = topic_index + 1
        sequence = self._next_sequence[channel_id]
        self._next_sequence[channel_id] += 1
        self.add_message(channel_id, sequence, log_time_ns, log_time_ns, data)

    def add_message(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int,
                    data: bytes | bytearray | memoryview) -> None:
        """Add a message to the chunk in memory; write the chunk when it is full."""
        self._chunk.add(channel_id, sequence, log_time_ns, publish_time_ns, data)
        if self._chunk.size >= chunks.CHUNK_BYTES:
            self.write_chunk()

    def chunk_of_rows(self, blocks: Iterable[chunks.Rows]) -> chunks.PlainChunk:
        """Make a chunk for `write_chunk`, which another thread may be running."""
        chunk = self._spare_chunks.pop() if self._spare_chunks else chunks.PlainChunk()
        for topic_index, times_ns, rows in blocks:
            channel_id = topic_index + 1
            chunk.add_rows(channel_id, self._next_sequence[channel_id], times_ns, rows)
            self._next_sequence[channel_id] += len(rows)
        return chunk

    def write_chunk(self, rows: chunks.PlainChunk | None = None) -> None:
        """Compress and write a chunk of rows, or the one in memory if it holds anything."""
        chunk = rows or self._chunk
        if chunk.size:
            start_ns, end_ns = chunks.time_span(chunk.entries)
            self.copy_chunk(records.Chunk(
                compression=self._compression, data=self._compress(chunk.data),
                uncompressed_size=chunk.size, uncompressed_crc=zlib.crc32(chunk.data),
                message_start_time=start_ns, message_end_time=end_ns), chunk.entries)
            chunk.clear()
        if rows:
            self._spare_chunks.append(rows)

    def copy_chunk(self, chunk: records.Chunk, entries: chunks.Entries, raw: bytes = b'') -> None:
        """Write a compressed chunk and its message indexes; `raw` is as in `write`."""
        raw = raw or record_bytes(chunk)
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
            empty = not any(self.message_counts.values())
            start_ns = chunk.message_start_time
            self._start_ns = start_ns if empty else min(self._start_ns, start_ns)
            self._end_ns = max(self._end_ns, chunk.message_end_time)
            for channel_id in indexes:
                self.message_counts[channel_id] += len(entries[channel_id]) // 2

    def sync(self) -> None:
        """Wait until everything written is on the disk."""
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

    def finish(self, *, bag: bool = True, file_name: str = '', former_bag: str = '') -> None:
        """
        Write the summary, bring all to the disk and close the file.

        bag : whether to write a `rosbag2` record, which names `file_name`, default: this file
        former_bag : the bag metadata of the log that this one is made from
        """
        try:
            if bag:
                topics = [(channel, self._type_names.get(channel.schema_id, ''),
                           self.message_counts[channel.id])
                          for channel in self._channels.values()]
                self.write(records.Metadata(BAG_METADATA, {
                    'serialized_metadata': bag_metadata_yaml(
                        topics, file_name=file_name or self._path.name, start_ns=self._start_ns,
                        end_ns=self._end_ns, former=former_bag)}))
            self._write([record_bytes(records.DataEnd(self._end[1]))])
            self._write([self._summary()])
            self.sync()
            sync_directory(self._path.parent)
        finally:
            self._file.close()

    def _summary(self) -> bytes:
        """Return the summary section, the footer and the closing magic."""
        groups = self._summary_records
        groups[Opcode.STATISTICS] = [record_bytes(records.Statistics(
            message_count=sum(self.message_counts.values()),
            schema_count=len(groups[Opcode.SCHEMA]), channel_count=len(groups[Opcode.CHANNEL]),
            attachment_count=len(groups[Opcode.ATTACHMENT_INDEX]),
            metadata_count=len(groups[Opcode.METADATA_INDEX]), chunk_count=self.chunk_count,
            message_start_time=self._start_ns, message_end_time=self._end_ns,
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


def record_bytes(record: records.McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def sync_directory(directory: Path) -> None:
    """Bring the names in a directory to the disk, if the file system can and lets us."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
