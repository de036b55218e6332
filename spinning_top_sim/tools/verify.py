# SPDX-License-Identifier: Apache-2.0
"""The comparison of a log with the computation of its run, byte by byte."""

import math
import operator
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import events
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.play import Block
from spinning_top_sim.tools.recorded_run import RunDescription, rerun

# Channels and messages by stamp and topic: several commands may have the same.
_Computed = defaultdict[tuple[int, str], deque[tuple[Channel | None, bytes]]]


class Difference(NamedTuple):
    """A place where a log and the computation differ."""

    stamp_ns: int                         # log time of the message [ns]
    topic: str
    field: str                            # name of the field, or what else is different
    logged: str                           # its two values
    computed: str
    byte: int | None = None               # None where one of them has no such message


@dataclass
class Comparison:
    """The result of a comparison."""

    compared: dict[str, int]              # messages that both have, by topic
    different: int = 0                    # how many of these differ
    missing: int = 0                      # messages that were computed and are not in the log
    unexpected: int = 0                   # messages that are in the log and were not computed
    first: Difference | None = None       # the earliest of all these
    stopped: str = ''                     # why the run could not be computed to its end
    warnings: list[str] = field(default_factory=list)       # of another version or machine

    @property
    def identical(self) -> bool:
        """Whether the messages in the log are those computed."""
        return not (self.different or self.missing or self.unexpected or self.stopped)

    def as_json(self) -> dict[str, Any]:
        return {'identical': self.identical, **asdict(self),
                'first': self.first and self.first._asdict()}

    def note(self, this: Difference) -> None:
        self.first = min(self.first or this, this, key=operator.attrgetter('stamp_ns'))


def objection(run: RunDescription) -> str:
    """Return why the run of a log cannot be verified by this version, '' if it can."""
    return '' if run.format == provenance.FORMAT else (
        f'it was recorded by spinning_top_sim {run.environment["version"]}, which draws other '
        'noise and computes other last bits: verify it with that version')


def compare(run: RunDescription, reader: LogReader, end_ns: int,
            show: Callable[[int], None]) -> Comparison:
    """
    Compute the run of a log while the log is read in the order of time; return the result.

    end_ns : log time up to which they are compared [ns]
    show : takes the log time that is reached [ns]
    """
    topics = (*run.topics.values(), run.commands_topic)
    comparison = Comparison(dict.fromkeys(filter(None, topics), 0), warnings=[
        f'{what} was {run.environment[what]}, is {here}'
        for what, here in provenance.environment().items() if run.environment[what] != here])
    # What has not been met in the log.
    computed: _Computed = defaultdict(deque)
    progress, before_ns = _compute(run, end_ns, computed, comparison, show), -math.inf
    for message in reader.messages(topics=comparison.compared):
        while message.log_time >= before_ns:
            before_ns = next(progress)
            _miss(computed, comparison, message.log_time)
        key = message.log_time, message.topic
        if key not in computed:
            comparison.unexpected += 1
            comparison.note(Difference(*key, 'message', 'there', 'no such message'))
            continue
        channel, expected = computed[key].popleft()
        if not computed[key]:
            del computed[key]
        comparison.compared[message.topic] += 1
        if message.data != expected:
            comparison.different += 1
            comparison.note(_difference(key, channel, message.data, expected))
    for _ in progress:
        _miss(computed, comparison, math.inf)
    _miss(computed, comparison, math.inf)
    return comparison


def _compute(run: RunDescription, end_ns: int, computed: _Computed, comparison: Comparison,
             show: Callable[[int], None]) -> Iterator[float]:
    """Compute the run; yield the log times before which all is computed, at last infinity."""
    try:
        for simulation, done in rerun(run, end_ns, samples=True):
            if isinstance(done, Block):
                for channel, times_ns, rows in done.messages:
                    topic = run.topics[channel.topic]
                    for t_ns, row in zip(times_ns.tolist(), rows, strict=True):
                        computed[simulation.epoch_ns + t_ns, topic].append(
                            (channel, row.tobytes()))
            elif run.commands_topic is not None and done.event.kind == 'command':
                computed[done.stamp_ns, run.commands_topic].append(
                    (None, events.command(**done.event.details)))
            reached_ns = simulation.epoch_ns + simulation.now_ns
            show(reached_ns)
            # Not up to it: another command at this very time may follow.
            yield reached_ns
    except MALFORMED as error:
        comparison.stopped = reason_of(error)
    yield math.inf


def _miss(computed: _Computed, comparison: Comparison, before_ns: float) -> None:
    """Count the computed messages before a time that the log does not have."""
    for key in [key for key in computed if key[0] < before_ns]:
        comparison.missing += len(computed.pop(key))
        comparison.note(Difference(*key, 'message', 'no such message', 'there'))


def _difference(key: tuple[int, str], channel: Channel | None, logged: bytes,
                computed: bytes) -> Difference:
    sizes = len(logged), len(computed)
    if sizes[0] != sizes[1]:
        return Difference(*key, 'size', f'{sizes[0]} bytes', f'{sizes[1]} bytes', min(sizes))
    at = next(at for at in range(sizes[0]) if logged[at] != computed[at])
    what, (one, two) = channel.template.shown_at(at, logged, computed) if channel else (
        f'byte {at}', (f'0x{logged[at]:02x}', f'0x{computed[at]:02x}'))
    return Difference(*key, what, one, two, at)
