# SPDX-License-Identifier: Apache-2.0
"""Makes chunks in memory that is reused: of single messages, and of rows of an array for speed."""

from __future__ import annotations

import mmap
import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    # The next messages of a topic: its index, log times (n,) [ns], messages (n, size).
    Rows = tuple[int, NDArray[np.integer], NDArray[np.uint8]]

CHUNK_BYTES = 1 << 20   # uncompressed; a single larger message still makes a chunk of its own

# Half the time of zstd's own default, 3, and less memory, for files that are 1 to 6 % larger:
# `python benchmark/log_compression.py`.
ZSTD_LEVEL = 1

# Message index entries of a chunk by channel id: log time, offset in the uncompressed chunk, log
# time, offset, .. (uint64), as in the file: no platform of ROS 2 Jazzy is big-endian.
Entries = Mapping[int, 'array[int]']

# Only what grows with every message is packed here (MCAP specification, "Message" and "Message
# Index"); mcap's record classes do the rest.
MESSAGE = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log and publish time
MESSAGE_FIELDS = 2 + 4 + 8 + 8      # what `length` counts besides the data
_MESSAGE_DTYPE = [('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                  ('log_time', '<u8'), ('publish_time', '<u8')]     # and the data
_MESSAGE_OPCODE = int(Opcode.MESSAGE)   # is packed faster
INDEX_HEAD = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries
ENTRY_SIZE = 8 + 8                      # of a message index


class PlainChunk:
    """The messages of a chunk, uncompressed."""

    def __init__(self) -> None:
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

    def add(self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int,
            data: bytes | bytearray | memoryview) -> None:
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
        Add messages of one length, in a tenth of the time that they take one by one.

        sequence : sequence number of the first
        times_ns : log and publish times (n,), n >= 1, in any order
        rows : (n, size of a message)
        """
        import numpy as np  # noqa: PLC0415 - recovery needs none

        count, size = rows.shape
        dtype = np.dtype([*_MESSAGE_DTYPE, ('data', 'u1', (size,))])
        offset, end = self.size, self.size + count * dtype.itemsize
        if end > len(self._memory):
            self._enlarge(end)
        messages = np.frombuffer(self._memory[offset:end], dtype)
        messages['opcode'] = Opcode.MESSAGE
        messages['length'] = MESSAGE_FIELDS + size
        messages['channel'] = channel_id
        messages['sequence'] = sequence + np.arange(count) & 0xFFFFFFFF
        messages['log_time'] = messages['publish_time'] = times_ns
        messages['data'] = rows
        entries = np.column_stack((times_ns, np.arange(offset, end, dtype.itemsize))).astype('u8')
        self.entries[channel_id].frombytes(entries.tobytes())
        self.size = end

    def _enlarge(self, size: int) -> None:
        # Private: a process that forks would share it with its children.
        larger = memoryview(mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS))
        larger[:self.size] = self.data
        self._memory = larger


def compressor(compression: str) -> Callable[[memoryview], bytes]:
    """Return what compresses chunks: 'zstd', 'lz4' or 'none'."""
    if compression == 'zstd':
        # A window of a whole chunk, where the level has half of that: files are 20 % smaller.
        zstd = zstandard.ZstdCompressor(
            compression_params=zstandard.ZstdCompressionParameters.from_level(
                ZSTD_LEVEL, window_log=CHUNK_BYTES.bit_length() - 1))

        def compress(plain: memoryview) -> bytes:
            # As a stream, because at once it would take as much memory as the chunk has.
            stream = zstd.compressobj(size=len(plain))
            return stream.compress(plain) + stream.flush()

        return compress
    return lz4.frame.compress if compression == 'lz4' else bytes


def message_indexes(entries: Entries) -> dict[int, bytes]:
    """Return the message index records behind a chunk by channel id, in ascending order."""
    return {
        channel_id: INDEX_HEAD.pack(
            Opcode.MESSAGE_INDEX, 2 + 4 + 8 * len(numbers), channel_id, 8 * len(numbers))
        + numbers.tobytes()
        for channel_id, numbers in sorted(entries.items())}


def time_span(entries: Entries) -> tuple[int, int]:
    """Return the earliest and the latest stamp in the entries of a chunk; (0, 0) in none."""
    times = [numbers[::2] for numbers in entries.values()]
    return min(map(min, times), default=0), max(map(max, times), default=0)
