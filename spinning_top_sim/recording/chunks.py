# SPDX-License-Identifier: Apache-2.0
"""Builds chunks, of single messages or of whole arrays of them, in memory that is reused."""

import struct
import zlib
from array import array
from collections import defaultdict
from collections.abc import Mapping

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord
from numpy.typing import NDArray

CHUNK_BYTES = 1 << 20   # uncompressed; a single larger message still makes a chunk of its own

# The fastest level that compresses nearly as well as zstd's own default, 3.
ZSTD_LEVEL = -1

# The next messages of a topic: its index, log times (n,) [ns], messages (n, size).
RowBlock = tuple[int, NDArray[np.integer], NDArray[np.uint8]]

# Message index entries of a chunk by channel id: log time, offset in the uncompressed chunk, log
# time, offset, .. (uint64), as in the file: no platform of ROS 2 Jazzy is big-endian.
IndexEntries = Mapping[int, 'array[int]']

# Only what grows with every message is packed here (MCAP specification, "Message" and "Message
# Index"); mcap's record classes do the rest.
MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
HEAD_TYPE = [('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
             ('log_time', '<u8'), ('publish_time', '<u8')]      # the same, for arrays
MESSAGE_FIELDS = 2 + 4 + 8 + 8      # what `length` counts besides the data
_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # is packed faster
INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries
ENTRY_SIZE = 8 + 8                      # of a message index


class ChunkBuilder:
    """The messages of a chunk, uncompressed; `compression` is 'zstd', 'lz4' or 'none'."""

    def __init__(self, compression: str = 'none') -> None:
        self._compression = compression
        if compression == 'zstd':
            # The default window of the level is half a chunk; a whole one saves up to 20 %.
            self._zstd = zstandard.ZstdCompressor(
                compression_params=zstandard.ZstdCompressionParameters.from_level(
                    ZSTD_LEVEL, window_log=CHUNK_BYTES.bit_length() - 1))
        self.clear()
        self._memory = memoryview(b'')
        self._enlarge(2 * CHUNK_BYTES)

    def clear(self) -> None:
        """Remove all messages but keep the memory: freeing it each time fragments the heap."""
        self.size = 0       # [bytes]
        self.entries: dict[int, array[int]] = defaultdict(lambda: array('Q'))

    @property
    def data(self) -> memoryview:
        """The message records, valid until the chunk changes."""
        return self._memory[:self.size]

    def record(self) -> Chunk:
        """Return the chunk record of all messages, compressed."""
        start_ns, end_ns = time_span(self.entries)
        return Chunk(
            compression='' if self._compression == 'none' else self._compression,
            data=self._compressed(), uncompressed_size=self.size,
            uncompressed_crc=zlib.crc32(self.data), message_start_time=start_ns,
            message_end_time=end_ns)

    def add(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int,
            data: bytes | bytearray | memoryview) -> None:
        """Add a message; its sequence number is taken modulo 2^32, its times are in [0, 2^64)."""
        offset = self.size
        start = offset + MESSAGE.size
        end = start + len(data)
        if end > len(self._memory):
            self._enlarge(end)
        MESSAGE.pack_into(
            self._memory, offset, _MESSAGE_OPCODE, MESSAGE_FIELDS + len(data), channel_id,
            sequence & 0xFFFFFFFF, log_time_ns, publish_time_ns)
        self._memory[start:end] = data
        entries = self.entries[channel_id]
        entries.append(log_time_ns)
        entries.append(offset)
        self.size = end

    def add_rows(self, channel_id: int, sequence: int, times_ns: NDArray[np.integer],
                 rows: NDArray[np.uint8]) -> None:
        """
        Add messages of one length.

        sequence : sequence number of the first
        times_ns : log and publish times (n,), n >= 1, in any order
        rows : (n, size of a message)
        """
        count, size = rows.shape
        record_size = MESSAGE.size + size
        offset, end = self.size, self.size + count * record_size
        if end > len(self._memory):
            self._enlarge(end)
        messages = np.frombuffer(self._memory[offset:end], np.dtype([
            *HEAD_TYPE, ('data', 'u1', (size,))]))
        messages['opcode'], messages['length'] = Opcode.MESSAGE, MESSAGE_FIELDS + size
        messages['channel'] = channel_id
        messages['sequence'] = np.arange(sequence, sequence + count)
        messages['log_time'] = messages['publish_time'] = times_ns
        messages['data'] = rows
        entries = np.empty((count, 2), np.uint64)
        entries[:, 0] = times_ns
        entries[:, 1] = np.arange(offset, end, record_size)
        self.entries[channel_id].frombytes(entries.data.cast('B'))
        self.size = end

    def _compressed(self) -> bytes:
        if self._compression == 'zstd':
            return self._zstd.compress(self.data)
        return lz4.frame.compress(self.data) if self._compression == 'lz4' else bytes(self.data)

    def _enlarge(self, size: int) -> None:
        larger = memoryview(bytearray(size))
        larger[:self.size] = self.data
        self._memory = larger


def record_bytes(record: McapRecord) -> bytes:
    """Return a record as it stands in a file."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def message_indexes(entries: IndexEntries) -> dict[int, bytes]:
    """Return the message index records behind a chunk by channel id, in ascending order."""
    return {
        channel_id: INDEX_HEAD.pack(
            Opcode.MESSAGE_INDEX, 2 + 4 + 8 * len(numbers), channel_id, 8 * len(numbers))
        + numbers.tobytes()
        for channel_id, numbers in sorted(entries.items())}


def time_span(entries: IndexEntries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    times = [np.frombuffer(numbers, np.uint64)[::2] for numbers in entries.values()]
    return (min((int(column.min()) for column in times), default=0),
            max((int(column.max()) for column in times), default=0))
