# SPDX-License-Identifier: Apache-2.0
"""Computes a log's run again and compares every message, byte for byte."""

from __future__ import annotations

import json
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from spinning_top_sim.recording.provenance import surroundings
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.topics import Stream
from spinning_top_sim.tools.rerun import Account, DepartureError, Rerun

# What the runs of a template are called in the message definition, in their order.
FIELDS = {
    'geometry_msgs/msg/PoseStamped': ('pose.orientation',),
    'sensor_msgs/msg/JointState': ('position', 'velocity'),
    'sensor_msgs/msg/Imu': ('orientation', 'angular_velocity', 'linear_acceleration'),
    'nav_msgs/msg/Odometry': ('pose.pose.orientation', 'twist.twist.angular'),
    'std_msgs/msg/Float64MultiArray': ('data',),
    'visualization_msgs/msg/MarkerArray': (
        'markers[0].pose.position', 'markers[0].pose.orientation',
        'markers[1].pose.orientation', 'markers[2].points'),
}


@dataclass(frozen=True)
class Difference:
    """
    Where a log and the computation part.

    byte: the first that differs in the message, None where one of them has no such message
    field: what stands there;  logged, computed: its value in either, or what else is the matter
    """

    topic: str
    stamp_ns: int
    byte: int | None
    field: str
    logged: str
    computed: str


@dataclass
class Verdict:
    """
    What the comparison found.

    compared: messages that both have, by topic;  different: of these;  missing: computed, but not
    in the log;  unexpected: in the log, but not computed;  first: the first of all these
    stopped: why the run could not be computed any further, '' if it was
    warnings: what else makes bits differ;  whole: whether the log was whole
    """

    whole: bool
    compared: dict[str, int]
    different: int = 0
    missing: int = 0
    unexpected: int = 0
    first: Difference | None = None
    stopped: str = ''
    warnings: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether each message is as computed; of a torn log, each that is left."""
        return not (self.different or self.unexpected or self.stopped
                    or (self.missing and self.whole))


def verify(reader: LogReader, account: Account, end_ns: int,
           show: Callable[[int], None] = lambda stamp_ns: None) -> Verdict:
    """
    Compare a log of ours with its run computed again, side by side.

    end_ns: log time of the last message;  show: takes the log time reached, now and then
    """
    return _Comparison(reader, account, end_ns, show).run()


class _Comparison:
    def __init__(self, reader: LogReader, account: Account, end_ns: int,
                 show: Callable[[int], None]) -> None:
        self._reader, self._account, self._end_ns, self._show = reader, account, end_ns, show
        self._names = {name: topic for topic, name in account.topics.items()}
        topics = list(account.topics)
        if account.commands_topic is not None:
            topics.append(account.commands_topic)
            self._names[journal.COMMANDS] = account.commands_topic
        self._waiting: dict[str, deque[tuple[int, bytes]]] = {name: deque() for name in topics}
        self._verdict = Verdict(not reader.damage.truncated and reader.damage.lossless,
                                dict.fromkeys(topics, 0), warnings=_warnings(account))

    def run(self) -> Verdict:
        verdict = self._verdict
        for stamp_ns, reason in self._account.broken:
            verdict.different += 1
            self._note(Difference(self._account.events_topic or '', stamp_ns, None, 'entry',
                                  reason, 'an entry of the journal'))
        try:
            self._rerun = Rerun(self._account, self._take)
        except (DepartureError, ValueError, IntegrationError) as error:
            verdict.stopped = str(error)
            return verdict
        self._legs = self._rerun.legs(self._end_ns)
        for message in self._reader.messages(topics=list(self._waiting)):
            self._compare(message.topic, message.log_time, message.data)
        while self._go_on():
            self._drop_all()
        self._drop_all()
        return verdict

    def _take(self, name: str, stamp_ns: int, data: bytes) -> None:
        if stamp_ns <= self._end_ns:
            self._waiting[self._names[name]].append((stamp_ns, data))

    def _go_on(self) -> bool:
        """Compute one leg more; return whether there was one."""
        try:
            event = next(self._legs)
        except StopIteration:
            return False
        except (DepartureError, ValueError) as error:
            self._verdict.stopped = self._verdict.stopped or str(error)
            return False
        self._show(self._rerun.stamp_ns)
        if event is not None and event.name == 'command' and journal.COMMANDS in self._names:
            self._take(journal.COMMANDS, event.stamp_ns,
                       journal.command(event.details['l3'], event.details['lz']))
        return True

    def _compare(self, topic: str, stamp_ns: int, data: bytes) -> None:
        waiting, verdict = self._waiting[topic], self._verdict
        while True:
            while not waiting and self._go_on():
                pass
            if not waiting or waiting[0][0] > stamp_ns:
                verdict.unexpected += 1
                self._note(Difference(topic, stamp_ns, None, 'message', 'there',
                                      'no such message'))
                return
            computed_ns, computed = waiting.popleft()
            if computed_ns == stamp_ns:
                break
            self._miss(topic, computed_ns)
        verdict.compared[topic] += 1
        if data != computed:
            verdict.different += 1
            if verdict.first is None:
                self._note(self._difference(topic, stamp_ns, data, computed))

    def _drop_all(self) -> None:
        """Count what has been computed and is not in the log."""
        for topic, waiting in self._waiting.items():
            while waiting:
                self._miss(topic, waiting.popleft()[0])

    def _miss(self, topic: str, stamp_ns: int) -> None:
        self._verdict.missing += 1
        if self._verdict.whole:
            self._note(Difference(topic, stamp_ns, None, 'message', 'no such message', 'there'))

    def _note(self, difference: Difference) -> None:
        if self._verdict.first is None:
            self._verdict.first = difference

    def _difference(self, topic: str, stamp_ns: int, data: bytes,
                    computed: bytes) -> Difference:
        if len(data) != len(computed):
            return Difference(topic, stamp_ns, min(len(data), len(computed)), 'size',
                              f'{len(data)} bytes', f'{len(computed)} bytes')
        at = next(i for i, pair in enumerate(zip(data, computed, strict=True))
                  if pair[0] != pair[1])
        name = self._account.topics.get(topic)
        stream = next((stream for stream in self._rerun.simulation.streams
                       if stream.topic == name), None)
        what, read = _field_at(stream, at)
        return Difference(topic, stamp_ns, at, what, read(data), read(computed))


def _field_at(stream: Stream | None, at: int) -> tuple[str, Any]:
    """Return the name of what stands at a byte of a message, and a function that shows it."""
    place = None if stream is None else stream.template.field_at(at)
    if stream is None or place is None:
        return f'byte {at}', lambda data: f'0x{data[at]:02x}'
    run, element, offset = place
    if run < 0:
        return 'header.stamp', lambda data: '{}.{:09d}'.format(
            *struct.unpack_from('<iI', data, offset))
    return (f'{FIELDS[stream.type_name][run]}[{element}]',
            lambda data: repr(struct.unpack_from('<d', data, offset)[0]))


def _warnings(account: Account) -> list[str]:
    """Return in what this machine differs from that of the recording."""
    here = surroundings()
    return [f'{what} was {then}, is {now}'
            for what, then, now in (*_parts(account.surroundings, here),) if then != now]


def _parts(then: Any, now: Any) -> Iterator[tuple[str, str, str]]:
    yield 'the version of spinning_top_sim', then['version'], now['version']
    yield 'the platform', then['platform'], now['platform']
    try:
        libraries = json.loads(then['libraries'])
    except ValueError:
        libraries = {}
    # Other libraries compute nothing.
    yield 'numpy', str(libraries.get('numpy')), json.loads(now['libraries'])['numpy']
