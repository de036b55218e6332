# SPDX-License-Identifier: Apache-2.0
"""
The one place where samples are computed: the solver steps, states are evaluated and encoded.

A message depends on the parameters, the commands and its own time alone, never on the block that
it is computed in.
"""

from collections.abc import Generator, Iterator, Sequence
from functools import cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import TIMES_TOGETHER
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.streams.path import Path, Segment
from spinning_top_sim.streams.stream import Rows, Samples, Stream

STEPS_IN_A_PIECE = 4
MOST_SEGMENTS = 64      # of a block


class Block(NamedTuple):
    """
    The messages of some streams after the block before and up to `until_ns`.

    messages : of each stream that has any: the stream, the times (n,) [ns] of its messages, and
        these as rows (n, size), valid until the next block
    """

    until_ns: int
    messages: Sequence[tuple[Stream, NDArray[np.int64], Rows]]


def blocks(path: Path, streams: Sequence[Stream], epoch_ns: int, after_ns: int, until_ns: int, *,
           span_ns: int, most_steps: int) -> Iterator[Block | None]:
    """
    Yield the messages of these streams after `after_ns` and up to `until_ns`, block by block.

    Yields None between pieces of work of some 0.1 to 0.3 ms, so that the caller can interrupt it.

    span_ns : longest time that a block covers [ns]
    most_steps : most integration steps of a block; the block ends where they end

    Raises IntegrationError behind the last block that can be computed.
    """
    end_ns = min(until_ns, LAST_STAMP_NS - epoch_ns)
    while after_ns < end_ns:
        # Times where segments meet, with begin and end of the block.
        edges, failure = yield from _reach(
            path, after_ns, min(end_ns, after_ns + span_ns), most_steps)
        if edges[-1] > after_ns:
            # Once for all streams of one rate: the ranges of their times are the key.
            samples = cache(partial(_samples, path, epoch_ns))
            messages = []
            for stream in streams:
                found = samples(*(stream.times(*ends) for ends in pairwise(edges)))
                if found:
                    times_ns, rows = stream.encode(*found)
                    if len(times_ns):       # a sensor may lose all samples of a block
                        messages.append((stream, times_ns, rows))
                    yield None
            yield Block(edges[-1], messages)
            after_ns = edges[-1]
        if failure is not None:
            raise failure
    if end_ns < until_ns:
        raise IntegrationError(f'the stamp {(epoch_ns + until_ns) / NANOSECONDS:.12g} s: must be '
                               f'< {2 ** 31} s, in January 2038')


def _samples(path: Path, epoch_ns: int, *ranges: range) -> list[Samples]:
    """Return the samples at times [ns] in consecutive segments, short ones that chain together."""
    groups: list[list[tuple[Segment, range]]] = []
    chains, count = False, 0
    for times in filter(len, ranges):
        segment = path.after(times.start - 1)
        count += len(times)
        if chains and segment.chains and count <= TIMES_TOGETHER:
            groups[-1].append((segment, times))
        else:
            groups.append([(segment, times)])
            chains, count = segment.chains, len(times)
    return [Samples(path, group, epoch_ns) for group in groups]


def _reach(path: Path, after_ns: int, until_ns: int, most_steps: int,
           ) -> Generator[None, None, tuple[list[int], IntegrationError | None]]:
    """
    Let the motion reach a time [ns], or take the most steps; yield between pieces of work.

    Returns the first time, where segments meet, and the time that is reached [ns]; and why the
    motion does not go on from there, if it does not.
    """
    edges, budget = [after_ns], -(-most_steps // STEPS_IN_A_PIECE)
    try:
        while edges[-1] < until_ns and budget and len(edges) <= MOST_SEGMENTS:
            segment = path.after(edges[-1])
            goal_ns = min(until_ns, segment.end_ns)
            try:
                while budget and not segment.reach(goal_ns, STEPS_IN_A_PIECE):
                    budget -= 1
                    yield None
            finally:
                edges.append(max(edges[-1], min(goal_ns, segment.reached_ns)))
    except IntegrationError as error:
        return edges, error
    return edges, None


def span_of(streams: Sequence[Stream], most_bytes: int, longest_ns: int) -> int:
    """Return the time [ns] in which the messages of streams have so many bytes, or the longest."""
    bytes_per_ns = sum(stream.size / stream.period_ns for stream in streams)
    return max(1, int(most_bytes / max(bytes_per_ns, most_bytes / longest_ns)))
