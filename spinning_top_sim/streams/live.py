# SPDX-License-Identifier: Apache-2.0
"""
A simulation that sends its samples in time.

Of the times, two move on; both count from the start [ns]:

    0 -------- now_ns -------------- computed_ns -----> t
       sent             in the queue

    now_ns       samples up to here are sent
    computed_ns  samples up to here are sent, or computed ahead and in the queue

`advance` moves `now_ns` to the time that is due, `prepare` moves `computed_ns` ahead of it.  All
that changes samples after `now_ns` empties the queue.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, repeat
from operator import itemgetter
from typing import Any

from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.blocks import NEVER_NS, Block, blocks
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.streams.topics import ImuIncrements

# Samples of the fastest stream in a block.  A command makes what is computed useless, and the next
# one may come soon: after it, blocks begin small and double.
LARGEST_BLOCK, SMALLEST_BLOCK = 256, 16
# Nor does a block reach further ahead than this, or take more integration steps.
LONGEST_BLOCK_NS, MOST_STEPS = 300_000_000, 256

# A message for a log: number of the stream in the log, stamp [ns], CDR.
Entry = tuple[int, int, bytes]


class Output:
    """
    Where the samples of a stream go.

    publish : takes each message in time; None while there are no subscribers
    log_index : number of the stream in the log, None if it is not recorded
    sent, skipped : samples that were published, and those that were too late for that
    """

    def __init__(self, stream: Stream) -> None:
        self.stream = stream
        self.publish: Callable[[bytes], object] | None = None
        self.log_index: int | None = None
        self.sent = self.skipped = 0

    @property
    def is_used(self) -> bool:
        """Whether anybody takes the samples: else they are not computed."""
        return self.publish is not None or self.log_index is not None


class LiveSimulation(Simulation):
    """
    A simulation with an output for each stream.

    What is sent does not depend on when it is computed, or on how often `advance` is called.

    outputs : of each stream, in the order in which the samples of one time are sent
    computed_ns : see the head of this module
    """

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        super().__init__(values, epoch_ns)
        self.outputs = [Output(stream) for stream in self.streams]
        self.computed_ns = -1
        self._write: Callable[[Sequence[Entry]], object] | None = None
        self._queue: deque[tuple[int, Output, bytes]] = deque()     # time [ns], message
        self._used: list[Output] = []               # those whose samples are computed
        self._version = -1                          # that of the samples in the queue
        self._work: Iterator[Block | None] | None = None
        self._block = SMALLEST_BLOCK

    def output(self, stream: Stream) -> Output:
        """Return the output of a stream."""
        return next(output for output in self.outputs if output.stream is stream)

    def log_to(self, write: Callable[[Sequence[Entry]], object] | None,
               streams: Sequence[Stream] = ()) -> None:
        """
        Record these streams after `now_ns`, and no others.

        write : takes their messages, some at a time
        streams : the position of a stream is its number in the log
        """
        self._write = write
        for output in self.outputs:
            output.log_index = streams.index(output.stream) if output.stream in streams else None

    def lowest_imu_rate(self, *, restarted: bool) -> float:
        """
        Return the lowest `imu.rate` [Hz] with which means and increments in use can go on.

        restarted : after `restart`, which may end the means
        """
        uses = (self.imu.takes_means and not restarted) or any(
            isinstance(output.stream, ImuIncrements) and output.is_used for output in self.outputs)
        return parameters.LOWEST_RATE_OF_INTERVALS if uses else 0.0

    def advance(self, target_ns: int, publish_from_ns: int = 0,
                give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every sample due up to `target_ns`; return whether that was reached.

        publish_from_ns : earlier samples are too late to be published; they are recorded
        give_way : asked between batches of samples and between blocks; True ends the call early.
            Nothing is lost: the next call goes on there.

        Raises IntegrationError if the motion does not go on.
        """
        begin_ns = self.now_ns
        self._refresh()
        try:
            while True:
                self._send(target_ns, publish_from_ns)
                self.now_ns = max(self.now_ns, min(target_ns, self.computed_ns))
                if self.computed_ns >= target_ns:
                    return True
                if self.now_ns > begin_ns and give_way():
                    return False
                self._compute(target_ns, publish_from_ns)
        finally:
            if publish_from_ns > begin_ns + 1:
                self._count_skipped(begin_ns, min(self.now_ns, publish_from_ns - 1))

    def prepare(self, until_ns: int, budget_ns: int | None = None) -> bool:
        """
        Compute a block ahead, if samples up to `until_ns` are not computed.

        Return False only if the block takes longer than `budget_ns`: the next call goes on there.
        """
        self._refresh()
        if self._work is None and self.computed_ns < until_ns:
            ahead_ns = min((self._block - 1) * self._shortest_ns(self._used), LONGEST_BLOCK_NS)
            self._block = min(2 * self._block, LARGEST_BLOCK)
            self._begin_block(self._used, max(until_ns, self.computed_ns + ahead_ns))
        if self._work is None:
            return True
        # An error is met again by `advance`, when the time has come.
        with contextlib.suppress(IntegrationError):
            return self._go_on(None if budget_ns is None else time.monotonic_ns() + budget_ns)
        return True

    def _settle(self) -> None:
        """Send the samples up to now, at least that of t = 0, before the motion changes."""
        self.advance(max(self.now_ns, 0))

    def _refresh(self) -> None:
        """Empty the queue if its samples do not hold any more, or lack those of an output."""
        used = [output for output in self.outputs if output.is_used]
        if self._version != self.version or not set(used) <= set(self._used):
            for output, stream in zip(self.outputs, self.streams, strict=True):
                output.stream = stream
            self._version, self._block = self.version, SMALLEST_BLOCK
            self._drop()
        self._used = used

    def _drop(self) -> None:
        self._queue.clear()
        self._work, self.computed_ns = None, self.now_ns

    def _send(self, target_ns: int, publish_from_ns: int) -> None:
        """Record what is computed up to `target_ns`, then publish it."""
        queue, due = self._queue, []
        while queue and queue[0][0] <= target_ns:
            due.append(queue.popleft())
        if not due:
            return
        if self._write is not None:
            entries = [(output.log_index, self.epoch_ns + t_ns, message)
                       for t_ns, output, message in due if output.log_index is not None]
            if entries:
                self._write(entries)
        self.now_ns = due[-1][0]
        for t_ns, output, message in due:
            if output.publish is not None and t_ns >= publish_from_ns:
                output.publish(message)
                output.sent += 1

    def _count_skipped(self, after_ns: int, until_ns: int) -> None:
        for output in self.outputs:
            if output.publish is not None:
                output.skipped += len(output.stream.times(after_ns, until_ns))

    def _compute(self, target_ns: int, publish_from_ns: int) -> None:
        """Finish the block under way, or compute one up to `target_ns` at most."""
        if self._work is None:
            used = self._used
            if self.computed_ns < publish_from_ns - 1:      # nobody takes the others
                used = [output for output in used if output.log_index is not None]
                target_ns = min(target_ns, publish_from_ns - 1)
            self._begin_block(used, min(target_ns, self.computed_ns + (
                LARGEST_BLOCK - 1) * self._shortest_ns(used)))
        self._go_on(None)

    def _shortest_ns(self, used: Sequence[Output]) -> int:
        return min((output.stream.period_ns for output in used), default=NEVER_NS)

    def _begin_block(self, used: Sequence[Output], until_ns: int) -> None:
        self.path.release(self.now_ns)
        self._work = blocks(self.path, [output.stream for output in used], self.epoch_ns,
                            self.computed_ns, until_ns, span_ns=NEVER_NS, most_steps=MOST_STEPS)

    def _go_on(self, end_ns: int | None) -> bool:
        """Compute pieces of the block under way until a time; return whether it is complete."""
        assert self._work is not None
        try:
            for block in self._work:
                if block is not None:
                    self._append(block)
                    break
                if end_ns is not None and time.monotonic_ns() >= end_ns:
                    return False
        except BaseException:
            self._work = None
            raise
        self._work = None
        return True

    def _append(self, block: Block) -> None:
        """Put a block into the queue, in the order of time."""
        parts: list[Iterator[tuple[int, Output, bytes]]] = []
        for stream, t_ns, rows in block.parts:
            data, size = rows.tobytes(), stream.size
            messages = [data[at:at + size] for at in range(0, len(data), size)]
            parts.append(zip(t_ns.tolist(), repeat(self.output(stream)), messages))
        self._queue.extend(sorted(chain(*parts), key=itemgetter(0)))
        self.computed_ns = block.until_ns
