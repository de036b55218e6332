# SPDX-License-Identifier: Apache-2.0
"""
Makes chunks in memory: runs of messages become rows of an array, in reused buffers.

Only the records that grow with every message are packed here, for speed (MCAP specification,
"Message" and "Message Index"); mcap's record classes do the rest.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import sys
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode

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
_INDEX = struct.Struct('<BQHI')     # opcode, length, channel, length of the entries


class PlainChunk(NamedTuple):
    """An uncompressed chunk."""

    data: bytes | memoryview    # message records; a memoryview is of a `BufferPool`
    entries: Entries
    span: tuple[int, int]       # the earliest and the latest log time [ns]


class Run(NamedTuple):
    """Consecutive messages of one channel and one length."""

    channel_id: int
    sequence: int                               # of the first message
    times: NDArray[np.integer]                  # log times (n,) [ns], n >= 1, in any order
    messages: NDArray[np.uint8] | list[bytes]   # (n, size), or n of one length


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


def split_by_topic(
    batch: Sequence[Messages],
) -> Iterator[tuple[int, NDArray[np.uint64], list[bytes]]]:
    """Yield the messages of each topic in runs of one length: topic index, log times, CDR."""
    import numpy as np  # noqa: PLC0415 - rclpy's messages have imported it

    times: dict[int, list[int]] = {}
    messages: dict[int, list[bytes]] = {}
    # Consecutive entries mostly have the same topics.
    for topic_indices, alike in groupby(batch, itemgetter(0)):
        _, alike_times, alike_messages, _ = zip(*alike, strict=True)
        for topic_index, data in zip(topic_indices, zip(*alike_messages, strict=True),
                                     strict=True):
            times.setdefault(topic_index, []).extend(alike_times)
            messages.setdefault(topic_index, []).extend(data)
    for topic_index, of_topic in messages.items():
        stamps = np.frombuffer(array('Q', times[topic_index]), np.uint64)
        start = 0
        for _, run in groupby(of_topic, len):
            rows = list(run)
            yield topic_index, stamps[start:start + len(rows)], rows
            start += len(rows)


def chunk_of_runs(runs: Sequence[Run], pool: BufferPool) -> PlainChunk:
    """Make a chunk; a run is copied in a tenth of the time that single messages take."""
    import numpy as np  # noqa: PLC0415 - recovery needs none

    lengths = [MESSAGE.size + len(run.messages[0]) for run in runs]
    buffer = pool.buffer(sum(
        len(run.times) * length for run, length in zip(runs, lengths, strict=True)))
    data = np.frombuffer(buffer, 'u1')
    head = np.dtype(_MESSAGE_DTYPE)
    entries: dict[int, array[int]] = {}
    offset = 0
    for (channel_id, sequence, times, messages), length in zip(runs, lengths, strict=True):
        count = len(times)
        numbers = np.arange(count)
        records = data[offset:offset + count * length].reshape(count, length)
        heads = records[:, :MESSAGE.size].view(head)[:, 0]
        heads['opcode'] = Opcode.MESSAGE
        heads['length'] = length - MESSAGE.size + MESSAGE_FIELDS
        heads['channel'] = channel_id
        heads['sequence'] = sequence + numbers & 0xFFFFFFFF
        heads['log_time'] = heads['publish_time'] = times
        _copy_rows(messages, records[:, MESSAGE.size:])
        index = np.empty((count, 2), 'u8')
        index[:, 0] = times
        index[:, 1] = offset + length * numbers
        entries.setdefault(channel_id, array('Q')).frombytes(index.tobytes())
        offset += count * length
    return PlainChunk(buffer, entries, (min(int(run.times.min()) for run in runs),
                                        max(int(run.times.max()) for run in runs)))


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
