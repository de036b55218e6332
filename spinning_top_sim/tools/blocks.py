# SPDX-License-Identifier: Apache-2.0
"""Offline samples in blocks: how long a block is, and where blocks end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.topics import Stream

Item = TypeVar('Item')

# Bytes of messages in a block, which becomes a chunk: twice as many take no less time, and are
# compressed worse (28 MB of 546 000 messages become 36 MB).
BLOCK_BYTES = 1 << 20
# A longer block would show no progress, and an interrupted run would lose it.
LONGEST_BLOCK_NS = 100 * NANOSECONDS


def block_length(streams: Sequence[Stream]) -> int:
    """Return the simulated time in which these streams fill a block [ns]."""
    bytes_per_ns = sum(len(stream.template) / stream.period_ns for stream in streams)
    return max(int(BLOCK_BYTES / max(bytes_per_ns, BLOCK_BYTES / LONGEST_BLOCK_NS)), 1)


def targets(now_ns: int, stops: Iterable[tuple[int, Item]], block_ns: int,
            ) -> Iterator[tuple[int, Item | None]]:
    """
    Yield the times up to which to advance, one after the other.

    Parameters
    ----------
    now_ns : int
        Simulated time at the beginning [ns].
    stops : iterable of (int, item)
        Times in ascending order [ns], and what happens there.
    block_ns : int
        Longest time between two targets [ns].

    Yields
    ------
    (int, item or None)
        A target [ns], and the item of the stop if it is one.
    """
    for stop_ns, item in stops:
        while stop_ns - now_ns > block_ns:
            now_ns += block_ns
            yield now_ns, None
        now_ns = stop_ns
        yield stop_ns, item
