# SPDX-License-Identifier: Apache-2.0
"""Computes a log's run again and compares every message, byte for byte."""

from __future__ import annotations

import math
import re
import struct
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.recording.provenance import surroundings
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import journal
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.tools.recorded_run import DepartureError, Rerun, RunDescription

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
    """A place where a log and the computation differ."""

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
    first: Difference | None = None       # the earliest of all these
    stopped: str = ''                     # why the run could not be computed to its end
    # Differences of version and machine, which may change the last bits
    warnings: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        """Whether every message is as computed; of a torn log, every message that is left."""
        return not (self.different or self.unexpected or self.stopped
                    or (self.missing and self.whole))

    def note(self, topic: str, stamp_ns: int, what: str, logged: str, computed: str,
             byte: int | None = None) -> None:
        """Keep a difference if it is the earliest so far."""
        if self.first is None or stamp_ns < self.first.stamp_ns:
            self.first = Difference(topic, stamp_ns, byte, what, logged, computed)


def verify(reader: LogReader, run: RunDescription, show: Callable[[int], None]) -> Verdict:
    """
    Compute the run of a log again and compare all messages.

    show : takes the log time reached [ns]
    """
    damage = reader.damage
    topics = [*run.topics.values(), run.commands_topic]
    verdict = Verdict(not damage.truncated and damage.lossless,
                      {topic: 0 for topic in topics if topic is not None}, warnings=_warnings(run))
    for stamp_ns, reason in run.broken:
        verdict.different += 1
        verdict.note(run.events_topic or '', stamp_ns, 'entry', reason, 'an entry of the journal')
    # What has not been met in the log, by topic and stamp: several commands may have the same.
    computed: defaultdict[tuple[str, int], list[tuple[Stream | None, bytes]]] = defaultdict(list)

    def take(stream: Stream, stamps_ns: NDArray[np.int64], rows: NDArray[np.uint8]) -> None:
        topic, size, data = run.topics[stream.topic], rows.shape[1], rows.tobytes()
        for number, stamp_ns in enumerate(stamps_ns[stamps_ns <= damage.end_ns].tolist()):
            computed[topic, stamp_ns].append((stream, data[number * size:(number + 1) * size]))

    messages = reader.messages(topics=verdict.compared)
    message = next(messages, None)

    def compare(before_ns: float) -> None:
        nonlocal message
        while message is not None and message.log_time < before_ns:
            key = message.topic, message.log_time
            if key in computed:
                stream, expected = computed[key].pop(0)
                if not computed[key]:
                    del computed[key]
                verdict.compared[message.topic] += 1
                if message.data != expected:
                    verdict.different += 1
                    what, logged, value, byte = _difference(stream, message.data, expected)
                    verdict.note(*key, what, logged, value, byte)
            else:
                verdict.unexpected += 1
                verdict.note(*key, 'message', 'there', 'no such message')
            message = next(messages, None)

    try:
        rerun = Rerun(run, take)
        for event in rerun.advance(damage.end_ns):
            show(rerun.stamp_ns)
            if event is not None and event.name == 'command' and run.commands_topic is not None:
                computed[run.commands_topic, event.stamp_ns].append(
                    (None, journal.command(event.details['l3'], event.details['lz'])))
            # Another command at this very time may follow.
            compare(rerun.stamp_ns)
    except DepartureError as error:
        verdict.stopped = str(error)
    compare(math.inf)
    for (topic, stamp_ns), left in computed.items():
        verdict.missing += len(left)
        if verdict.whole:
            verdict.note(topic, stamp_ns, 'message', 'no such message', 'there')
    return verdict


def _difference(stream: Stream | None, logged: bytes,
                computed: bytes) -> tuple[str, str, str, int]:
    """Return the name of the first field that differs, its values, and the byte."""
    if len(logged) != len(computed):
        return ('size', f'{len(logged)} bytes', f'{len(computed)} bytes',
                min(len(logged), len(computed)))
    at = next(at for at, pair in enumerate(zip(logged, computed, strict=True))
              if pair[0] != pair[1])
    place = None if stream is None else stream.template.field_at(at)
    if stream is None or place is None:
        return f'byte {at}', f'0x{logged[at]:02x}', f'0x{computed[at]:02x}', at
    number, element, offset = place
    if number < 0:
        what, code, text = 'header.stamp', '<iI', '{}.{:09d}'
    else:
        what, code, text = f'{FIELDS[stream.type_name][number]}[{element}]', '<d', '{!r}'
    one, two = (text.format(*struct.unpack_from(code, data, offset))
                for data in (logged, computed))
    return what, one, two, at


def _warnings(run: RunDescription) -> list[str]:
    """Return the differences of this machine from that of the recording."""
    then, now = (
        {'the version of spinning_top_sim': recorded['version'],
         'the platform': recorded['platform'],
         # Of the libraries only numpy computes.
         'numpy': ''.join(re.findall('"numpy": "([^"]*)"', recorded['libraries'])) or 'unknown'}
        for recorded in (run.surroundings, surroundings()))
    return [f'{what} was {then[what]}, is {now[what]}' for what in now if then[what] != now[what]]
