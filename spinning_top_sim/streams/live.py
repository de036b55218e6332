# SPDX-License-Identifier: Apache-2.0
"""
A simulation that sends its samples in time.

Samples up to `now_ns` are sent, those up to `computed_ns` are sent or in the queue.  `advance`
moves the one to the time that is due, `prepare` the other ahead of it.  All that changes samples
after `now_ns` empties the queue.
"""

import contextlib
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spinning_top_sim.physics.pivot import NEVER_NS
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.blocks import Block, blocks, span_of
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.streams.stream import Stream

# Samples of the fastest stream in a block.  A command makes what is computed useless, and the next
# one may come soon: after it, blocks begin small and double.
LARGEST_BLOCK, SMALLEST_BLOCK = 256, 16
MOST_BYTES, MOST_STEPS = 4 << 20, 256           # of a block
LONGEST_AHEAD_NS = 300_000_000                  # from the last sample that is sent

# A message for a log: number of the stream in the log, stamp [ns], CDR.
Entry = tuple[int, int, bytes]
# Takes messages of one stamp for a log.
Write = Callable[[Sequence[Entry]], object]


@dataclass(eq=False)
class Output:
    """
    Where the samples of a stream go.

    publish : takes each message in time; None while there are no subscribers
    log_index : number of the stream in the log, None if it is not recorded
    sent, skipped : samples that were published, and those that were too late for that
    """

    stream: Stream
    publish: Callable[[bytes], object] | None = None
    log_index: int | None = None
    sent: int = 0
    skipped: int = 0

    @property
    def is_used(self) -> bool:
        """Whether anybody takes the samples: else they are not computed."""
        return self.publish is not None or self.log_index is not None


# The messages of one time: for the log, and of outputs with subscribers.
Instant = tuple[list[Entry], list[tuple[Output, bytes]]]


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
        self._write: Write = lambda entries: None
        self._queue: deque[tuple[int, Instant]] = deque()       # by time [ns]
        self._used: list[Output] = []               # those whose samples are in the queue
        # The queue is right as long as these are as they were when it was computed: `version`,
        # `epoch_ns`, and which outputs had no subscribers.
        self._holds_for: tuple[int, int, list[bool]] = -1, 0, []
        self._work: Iterator[Block | None] | None = None
        self._block_size = SMALLEST_BLOCK

    def restart(self, values: Mapping[str, Any]) -> None:
        super().restart(values)
        for output, stream in zip(self.outputs, self.streams, strict=True):
            output.stream = stream

    def log_to(self, write: Write | None, streams: Sequence[Stream] = ()) -> None:
        """
        Record these streams after `now_ns`, and no others.

        write : takes their messages, in the order of time
        streams : the position of a stream is its number in the log
        """
        if write is not None:
            self._write = write
        for output in self.outputs:
            output.log_index = streams.index(output.stream) if output.stream in streams else None
        self.version += 1

    @property
    def lowest_imu_rate(self) -> float:
        """The lowest `imu.rate` [Hz] with which means and increments in use can go on."""
        uses = self.imu.takes_means or any(
            output.stream.parameter == 'increments' and output.is_used for output in self.outputs)
        return parameters.LOWEST_RATE_OF_INTERVALS if uses else 0.0

    def advance(self, target_ns: int, publish_from_ns: int = 0,
                give_way: Callable[[], bool] = lambda: False) -> bool:
        """
        Send every sample due up to `target_ns`; return whether that was reached.

        publish_from_ns : earlier samples are too late to be published; they are recorded
        give_way : asked between blocks of samples; True ends the call early.
            Nothing is lost: the next call goes on there.

        Raises IntegrationError if the motion does not go on.
        """
        begin_ns = self.now_ns
        self._refresh()
        queue = self._queue
        try:
            while True:
                while queue and queue[0][0] <= target_ns:
                    self._send(*queue.popleft(), publish_from_ns)
                if self.computed_ns >= target_ns:
                    self.now_ns = max(self.now_ns, target_ns)
                    return True
                self.now_ns = max(self.now_ns, self.computed_ns)
                if self.now_ns > begin_ns and give_way():
                    return False
                self._compute(target_ns, publish_from_ns)
        finally:        # also what was sent before an error
            if publish_from_ns > begin_ns + 1:
                until_ns = min(self.now_ns, publish_from_ns - 1)
                for output in self.outputs:
                    if output.publish is not None:
                        output.skipped += len(output.stream.times(begin_ns, until_ns))

    def prepare(self, until_ns: int, budget_ns: int | None = None) -> bool:
        """
        Compute a block ahead, if samples up to `until_ns` are not computed.

        Return False only if the block takes longer than `budget_ns`: the next call goes on there.
        """
        self._refresh()
        if self._work is None and self.computed_ns < until_ns:
            ahead_ns = min(self._span_ns(self._used, self._block_size), LONGEST_AHEAD_NS)
            self._block_size = min(2 * self._block_size, LARGEST_BLOCK)
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
        """Empty the queue if the motion or the outputs have changed."""
        holds_for = (self.version, self.epoch_ns,
                     [output.publish is None for output in self.outputs])
        if holds_for != self._holds_for:
            self._holds_for = holds_for
            self._used = [output for output in self.outputs if output.is_used]
            self._queue.clear()
            self._work, self.computed_ns, self._block_size = None, self.now_ns, SMALLEST_BLOCK

    def _send(self, t_ns: int, instant: Instant, publish_from_ns: int) -> None:
        """Send the messages of one time, to the log before others."""
        entries, publications = instant
        if entries:
            self._write(entries)
        self.now_ns = t_ns
        if t_ns >= publish_from_ns:
            for output, message in publications:
                assert output.publish is not None       # `_refresh` sees when it is not
                output.publish(message)
                output.sent += 1

    def _compute(self, target_ns: int, publish_from_ns: int) -> None:
        """Finish the block under way, or compute one up to `target_ns` at most."""
        if self._work is None:
            used = self._used
            if self.computed_ns < publish_from_ns - 1:      # nobody takes the others
                used = [output for output in used if output.log_index is not None]
                target_ns = min(target_ns, publish_from_ns - 1)
            self._begin_block(used, target_ns)
        self._go_on(None)

    @staticmethod
    def _span_ns(used: Sequence[Output], count: int) -> int:
        """Return the time of a block with so many samples of the fastest stream [ns]."""
        streams = [output.stream for output in used]
        shortest_ns = min((stream.period_ns for stream in streams), default=NEVER_NS)
        return min((count - 1) * shortest_ns, span_of(streams, MOST_BYTES, NEVER_NS))

    def _begin_block(self, used: Sequence[Output], until_ns: int) -> None:
        until_ns = min(until_ns, self.computed_ns + self._span_ns(used, LARGEST_BLOCK))
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
        """Put the messages of a block into the queue; what is done here is not done by a tick."""
        instants: defaultdict[int, Instant] = defaultdict(lambda: ([], []))
        for stream, times_ns, rows in block.messages:
            output = next(one for one in self.outputs if one.stream is stream)
            data, size = rows.tobytes(), stream.size
            for t_ns, begin in zip(times_ns.tolist(), range(0, len(data), size), strict=True):
                (entries, publications), message = instants[t_ns], data[begin:begin + size]
                if output.log_index is not None:
                    entries.append((output.log_index, self.epoch_ns + t_ns, message))
                if output.publish is not None:
                    publications.append((output, message))
        self._queue.extend(sorted(instants.items()))
        self.computed_ns = block.until_ns
