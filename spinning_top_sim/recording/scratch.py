# SPDX-License-Identifier: Apache-2.0
"""
What the chunks of a log are made with: a compressor and room in memory, used again and again.

Each is some hundred kilobytes.  Taken anew for every chunk, memory comes back to the process page
by page, four times a second, and each recording's thread leaves a hole of that size in a heap of
its own.
"""

from __future__ import annotations

import contextlib
import mmap
from typing import TYPE_CHECKING

import lz4.frame  # type: ignore[import-untyped]
import zstandard

if TYPE_CHECKING:
    from collections.abc import Callable

# Of chunks larger than this, nothing is kept.  What is never written to takes no memory.
ROOM_BYTES = 2 << 20

# Half the time of zstd's own default, 3, and less memory, for files that are 1 to 6 % larger:
# `python benchmark/compression.py`.
ZSTD_LEVEL = 1


class Scratch:
    """
    For one file at a time; `scratch_for` has one, `keep` keeps it for the next file.

    compression: 'zstd', 'lz4' or 'none';  compress: takes the data of a chunk
    """

    def __init__(self, compression: str) -> None:
        self.compression = compression
        self._rooms: list[memoryview] = []
        methods: dict[str, Callable[[bytes | memoryview], bytes]] = {
            'zstd': self._zstd, 'lz4': _lz4, 'none': bytes}
        self.compress = methods[compression]
        if compression == 'zstd':
            self._zstd_compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
            self._compressed = _room()

    def room(self, size: int) -> memoryview:
        """Return `size` bytes of memory, with anything in it, for one chunk; see `give_back`."""
        if size > ROOM_BYTES:
            return memoryview(bytearray(size))
        with contextlib.suppress(IndexError):
            return self._rooms.pop()[:size]
        return _room()[:size]

    def give_back(self, room: memoryview) -> None:
        """Take back what `room` has returned, which nobody reads any more."""
        if isinstance(room.obj, mmap.mmap):
            self._rooms.append(memoryview(room.obj))

    def _zstd(self, plain: bytes | memoryview) -> bytes:
        # What cannot be compressed becomes longer by 0.4 % at most.
        if len(plain) > ROOM_BYTES // 2:
            compressed: bytes = self._zstd_compressor.compress(plain)
            return compressed
        with self._zstd_compressor.stream_reader(plain, size=len(plain)) as reader:
            return bytes(self._compressed[:reader.readinto(self._compressed)])


def _lz4(plain: bytes | memoryview) -> bytes:
    return bytes(lz4.frame.compress(plain))


def _room() -> memoryview:
    # Private: a process that forks would have it together with its children.
    private = ({'flags': mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS}
               if hasattr(mmap, 'MAP_PRIVATE') else {})
    return memoryview(mmap.mmap(-1, ROOM_BYTES, **private))


_kept: list[Scratch] = []


def scratch_for(compression: str) -> Scratch:
    """Return what was kept, or something new."""
    with contextlib.suppress(IndexError):
        scratch = _kept.pop()
        if scratch.compression == compression:
            return scratch
    return Scratch(compression)


def keep(scratch: Scratch) -> None:
    """Keep it for the next file, unless there is one already."""
    if not _kept:
        _kept.append(scratch)
