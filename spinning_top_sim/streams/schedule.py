# SPDX-License-Identifier: Apache-2.0
"""Which samples are due when; their messages are computed in blocks, ahead of their time."""

import contextlib
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import TypeVar

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS
from spinning_top_sim.streams.segment import Segment
from spinning_top_sim.streams.stream import Stream

Item = TypeVar('Item')

# Samples of the fastest stream in a block.  A command makes what is computed useless, and the next
# one may come soon: after it, blocks begin small and double.
LARGEST_BLOCK, SMALLEST_BLOCK = 256, 16
# Nor does a block reach further ahead than this.
LONGEST_BLOCK_NS = 300_000_000
# Integration steps between two looks at the time, and how many such pieces make a block.
STEPS_IN_A_PIECE, MOST_PIECES = 4, 64
NEVER_NS = 2 ** 63 - 1
# Offline, a block becomes a chunk of a log.  With twice as many bytes, a log of 546 000 messages
# has 36 MB instead of 28 MB, in no less time.
OFFLINE_BYTES = 1 << 20
# A longer block would show no progress, and an interrupted run would lose it.
LONGEST_OFFLINE_NS = 100 * NANOSECONDS


def check_stamp(stamp_ns: int, error: type[Exception] = IntegrationError) -> None:
    """Raise an error for a stamp [ns] that no message can hold."""
    if not 0 <= stamp_ns <= LAST_STAMP_NS:
        raise error(f'the stamp {stamp_ns / NANOSECONDS:.12g} s: must be >= 0 and < {2 ** 31} s, '
                    'in January 2038')


def _weakly(method: Callable[[], None]) -> Callable[[], None]:
    """
    Return what calls a method while its object lives.

    A cycle of streams and schedule would keep the arrays of a run until Python looks for cycles.
    """
    reference = weakref.WeakMethod(method)

    def call() -> None:
        found = reference()
        if found is not None:
            found()

    return call


class Delivery:
    """
    The sinks for one set of streams that are due together.

    log_indices : numbers of the recorded streams in the log
    logged : places of their messages among all; None if all are recorded
    size : of the recorded messages together [bytes]
    published : (publish, place of the message, stream) of the streams with subscribers
    """

    def __init__(self, streams: Sequence[Stream]) -> None:
        logged = [k for k, stream in enumerate(streams) if stream.log_index is not None]
        self.log_indices = tuple(stream.log_index for stream in streams
                                 if stream.log_index is not None)
        self.logged = None if len(logged) == len(streams) else logged
        self.size = sum(len(streams[k].template) for k in logged)
        self.published = [(stream.publish, k, stream) for k, stream in enumerate(streams)
                          if stream.publish is not None]


# Simulated time [ns], sinks, and a message for each stream of the sinks.
Instant = tuple[int, Delivery, Sequence[bytes]]


class Schedule:
    """
    The messages of the streams of one run, in order of time.

    What is sent does not depend on when it is computed.  `follow` comes first.  The methods take
    `now_ns`, the simulated time up to which everything is sent.

    epoch_ns : stamp of t = 0 [ns]; after a change, call `invalidate`
    ready : instants that are computed and not yet sent
    ready_ns : every sample before this simulated time is sent or in `ready` [ns]; -1 when
        what is computed has been dropped
    """

    def __init__(self, streams: Sequence[Stream], epoch_ns: int) -> None:
        self._streams, self.epoch_ns = streams, epoch_ns
        self.ready: deque[Instant] = deque()
        for stream in streams:
            stream.on_change = _weakly(self.invalidate)

    def follow(self, segment: Segment) -> None:
        """Go on with another segment."""
        self._segment = segment
        self.invalidate()

    def invalidate(self) -> None:
        """Drop what is computed ahead: the motion, the sinks, the rates or the stamps changed."""
        self.ready.clear()
        self._work: Iterator[None] | None = None
        self.ready_ns = -1
        self._block = SMALLEST_BLOCK

    def next_due(self, now_ns: int) -> int:
        """
        Return the time of the first sample that is not sent [ns].

        After `invalidate` the schedule begins anew here, with the streams that now have sinks and
        their first samples after `now_ns`.
        """
        if self.ready_ns < 0:
            self._active = [stream for stream in self._streams if stream.has_sinks]
            # Of each active stream, the first sample that is not computed.
            self._next_ns = [stream.first_after(now_ns) for stream in self._active]
            self._shortest_ns = min((stream.period_ns for stream in self._active),
                                    default=NEVER_NS)
            self._deliveries: dict[tuple[int, ...], Delivery] = {}      # by places in `_active`
            self.ready_ns = min(self._next_ns, default=NEVER_NS)
        return self.ready[0][0] if self.ready else self.ready_ns

    def prepare(self, now_ns: int, until_ns: int, budget_ns: int | None = None) -> bool:
        """
        Compute a block if there are samples due up to `until_ns` that are not computed.

        Return False only if the block takes longer than `budget_ns`: the next call goes on there.
        """
        if self._work is None:
            self.next_due(now_ns)
            if self.ready_ns > until_ns:
                return True
            span_ns = min((self._block - 1) * self._shortest_ns, LONGEST_BLOCK_NS)
            self._block = min(2 * self._block, LARGEST_BLOCK)
            self._work = self._pieces(now_ns, max(until_ns, self.ready_ns + span_ns))
        # Deferred: `compute` raises the error when it is called for that time.
        with contextlib.suppress(IntegrationError):
            return self._go_on(None if budget_ns is None else time.monotonic_ns() + budget_ns)
        return True

    def compute(self, now_ns: int, until_ns: int) -> None:
        """
        Finish the block under way, or if there is none compute one up to `until_ns` at most.

        Raises IntegrationError if the equations, or stamps, do not go on from `now_ns`.
        """
        if self._work is None:
            self.next_due(now_ns)
            check_stamp(self.epoch_ns + min(self.ready_ns, until_ns))
            self._work = self._pieces(now_ns, until_ns)
        self._go_on(None)

    def _go_on(self, end_ns: int | None) -> bool:
        """Compute pieces of the block under way until a time; return whether it is complete."""
        assert self._work is not None
        try:
            for _ in self._work:
                if end_ns is not None and time.monotonic_ns() >= end_ns:
                    return False
        except BaseException:
            self.invalidate()
            raise
        self._work = None
        return True

    def _pieces(self, now_ns: int, until_ns: int) -> Iterator[None]:
        """Compute a block, as far as the steps allow, in pieces of some 0.1 to 0.3 ms."""
        segment = self._segment
        until_ns = min(until_ns, self.ready_ns + (LARGEST_BLOCK - 1) * self._shortest_ns,
                       LAST_STAMP_NS - self.epoch_ns)
        segment.release(now_ns)
        try:
            for _ in range(MOST_PIECES):
                if segment.reach(until_ns, STEPS_IN_A_PIECE):
                    break
                yield
        except IntegrationError:
            if segment.reached_ns <= now_ns:    # else what is due before that is sent first
                raise
        until_ns = min(until_ns, segment.reached_ns)
        blocks = [range(first_ns, until_ns + 1, stream.period_ns)
                  for stream, first_ns in zip(self._active, self._next_ns, strict=True)]
        instants: dict[int, tuple[list[int], list[bytes]]] = {}
        states = cache(segment.states)              # once for all streams of one rate
        for place, (stream, times) in enumerate(zip(self._active, blocks, strict=True)):
            if not times:
                continue
            states(times)
            yield
            data = stream.encode(states(times), self.epoch_ns, times).tobytes()
            size = len(stream.template)
            for number, t_ns in enumerate(stream.sent_ns(times).tolist()):
                places, messages = instants.setdefault(t_ns, ([], []))
                places.append(place)
                messages.append(data[number * size:(number + 1) * size])
            yield
        # All at once: a block that is dropped before this leaves nothing behind.
        for t_ns, (places, messages) in sorted(instants.items()):
            key = tuple(places)
            if key not in self._deliveries:
                self._deliveries[key] = Delivery([self._active[k] for k in places])
            self.ready.append((t_ns, self._deliveries[key], messages))
        self._next_ns = [first_ns + len(times) * times.step
                         for first_ns, times in zip(self._next_ns, blocks, strict=True)]
        self.ready_ns = min(self._next_ns, default=NEVER_NS)


def offline_block_ns(streams: Iterable[Stream]) -> int:
    """Return the simulated time in which the messages of these streams fill a block [ns]."""
    bytes_per_ns = sum(len(stream.template) / stream.period_ns for stream in streams)
    return max(int(OFFLINE_BYTES / max(bytes_per_ns, OFFLINE_BYTES / LONGEST_OFFLINE_NS)), 1)


def offline_targets(now_ns: int, stops: Iterable[tuple[int, Item]], block_ns: int,
                    ) -> Iterator[tuple[int, Item | None]]:
    """Yield times to advance to, at most `block_ns` apart; among them all stops, with items."""
    for stop_ns, item in stops:
        while stop_ns - now_ns > block_ns:
            now_ns += block_ns
            yield now_ns, None
        now_ns = stop_ns
        yield stop_ns, item
