# SPDX-License-Identifier: Apache-2.0
"""Computes a log's run again and compares every message, byte for byte."""

from __future__ import annotations

import json
import struct
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.provenance import surroundings
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.topics import Stream
from spinning_top_sim.tools.rerun import DepartureError, Rerun
from spinning_top_sim.tools.run_description import RunDescription

# Names in the message definition of the arrays of numbers in a template, in their order.
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
    """The first place where a log and the computation differ."""

    topic: str
    stamp_ns: int                         # log time of the message [ns]
    byte: int | None                      # None where one of them has no such message
    field: str                            # name of the field there
    logged: str                           # its two values, or what is different instead
    computed: str


@dataclass
class Verdict:
    """The result of a comparison."""

    whole: bool                           # the log is whole
    compared: dict[str, int]              # messages that both have, by topic
    different: int = 0                    # how many of these differ
    missing: int = 0                      # messages that were computed and are not in the log
    unexpected: int = 0                   # messages that are in the log and were not computed
    first: Difference | None = None       # the first of all these
    stopped: str = ''                     # why the run could not be computed to its end
    # Differences of version and machine, which may change the last bits
    warnings: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether every message is as computed; of a torn log, every message that is left."""
        return not (self.different or self.unexpected or self.stopped
                    or (self.missing and self.whole))


def verify(reader: LogReader, run: RunDescription, end_ns: int,
           show: Callable[[int], None] = lambda stamp_ns: None) -> Verdict:
    """
    Compute the run of a log again and compare all messages, side by side.

    Parameters
    ----------
    reader : LogReader
        The log.
    run : RunDescription
        Its run.
    end_ns : int
        Log time of the last message [ns].
    show : callable
        Takes the log time reached [ns].
    """
    return _Comparison(reader, run, end_ns, show).run()


class _Comparison:
    """The messages of a log, and those computed that still wait for their counterparts."""

    def __init__(self, reader: LogReader, run: RunDescription, end_ns: int,
                 show: Callable[[int], None]) -> None:
        self._reader, self._run, self._end_ns, self._show = reader, run, end_ns, show
        self._topics = {name: topic for topic, name in run.topics.items()}
        if run.commands_topic is not None:
            self._topics[journal.COMMANDS] = run.commands_topic
        self._waiting: dict[str, deque[tuple[int, bytes]]] = {
            topic: deque() for topic in self._topics.values()}
        self._verdict = Verdict(not reader.damage.truncated and reader.damage.lossless,
                                dict.fromkeys(self._waiting, 0), warnings=_warnings(run))

    def run(self) -> Verdict:
        verdict = self._verdict
        for stamp_ns, reason in self._run.broken:
            verdict.different += 1
            self._note(Difference(self._run.events_topic or '', stamp_ns, None, 'entry',
                                  reason, 'an entry of the journal'))
        try:
            self._rerun = Rerun(self._run, self._take)
        except (DepartureError, ValueError, IntegrationError) as error:
            verdict.stopped = str(error)
            return verdict
        self._progress = self._rerun.advance(self._end_ns)
        for message in self._reader.messages(topics=list(self._waiting)):
            self._compare(message.topic, message.log_time, message.data)
        while self._compute_more():
            self._miss_all()
        self._miss_all()
        return verdict

    def _take(self, stream: Stream, stamps_ns: NDArray[np.int64],
              rows: NDArray[np.uint8]) -> None:
        """Let a block of computed messages wait for those of the log."""
        rows = rows[stamps_ns <= self._end_ns]
        size, data = rows.shape[1], rows.tobytes()
        self._waiting[self._topics[stream.topic]].extend(
            (stamp_ns, data[i * size:(i + 1) * size])
            for i, stamp_ns in enumerate(stamps_ns[:len(rows)].tolist()))

    def _compute_more(self) -> bool:
        """Compute one more block; return whether there was one."""
        try:
            event = next(self._progress)
        except StopIteration:
            return False
        except (DepartureError, ValueError) as error:
            self._verdict.stopped = self._verdict.stopped or str(error)
            return False
        self._show(self._rerun.stamp_ns)
        if event is not None and event.name == 'command' and self._run.commands_topic and (
                event.stamp_ns <= self._end_ns):
            self._waiting[self._run.commands_topic].append(
                (event.stamp_ns, journal.command(event.details['l3'], event.details['lz'])))
        return True

    def _compare(self, topic: str, stamp_ns: int, data: bytes) -> None:
        waiting, verdict = self._waiting[topic], self._verdict
        while True:
            while not waiting and self._compute_more():
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

    def _miss_all(self) -> None:
        """Count the messages that were computed and are not in the log."""
        for topic, waiting in self._waiting.items():
            while waiting:
                self._miss(topic, waiting.popleft()[0])

    def _miss(self, topic: str, stamp_ns: int) -> None:
        self._verdict.missing += 1
        if self._verdict.whole:
            self._note(Difference(topic, stamp_ns, None, 'message', 'no such message', 'there'))

    def _note(self, difference: Difference) -> None:
        self._verdict.first = self._verdict.first or difference

    def _difference(self, topic: str, stamp_ns: int, data: bytes,
                    computed: bytes) -> Difference:
        if len(data) != len(computed):
            return Difference(topic, stamp_ns, min(len(data), len(computed)), 'size',
                              f'{len(data)} bytes', f'{len(computed)} bytes')
        at = next(i for i, pair in enumerate(zip(data, computed, strict=True))
                  if pair[0] != pair[1])
        name = self._run.topics.get(topic)
        stream = next((stream for stream in self._rerun.simulation.streams
                       if stream.topic == name), None)
        what, read = _field_at(stream, at)
        return Difference(topic, stamp_ns, at, what, read(data), read(computed))


def _field_at(stream: Stream | None, at: int) -> tuple[str, Callable[[bytes], str]]:
    """Return the name of the field at a byte of a message, and what formats its value."""
    place = None if stream is None else stream.template.field_at(at)
    if stream is None or place is None:
        return f'byte {at}', lambda data: f'0x{data[at]:02x}'
    number, element, offset = place
    if number < 0:
        return 'header.stamp', lambda data: '{}.{:09d}'.format(
            *struct.unpack_from('<iI', data, offset))
    return (f'{FIELDS[stream.type_name][number]}[{element}]',
            lambda data: repr(struct.unpack_from('<d', data, offset)[0]))


def _warnings(run: RunDescription) -> list[str]:
    """Return the differences of this machine from that of the recording."""
    then, now = _versions(run.surroundings), _versions(surroundings())
    return [f'{what} was {then[what]}, is {now[what]}' for what in now
            if then[what] != now[what]]


def _versions(recorded: Mapping[str, str]) -> dict[str, str]:
    try:
        numpy_version = str(json.loads(recorded['libraries']).get('numpy'))
    except ValueError:
        numpy_version = 'unknown'
    # Of the libraries only numpy computes.
    return {'the version of spinning_top_sim': recorded['version'],
            'the platform': recorded['platform'], 'numpy': numpy_version}
