# SPDX-License-Identifier: Apache-2.0
"""The run of a log: how the log describes it, its computation again, the comparison of both."""

import contextlib
import json
import math
import operator
import re
import struct
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.top import State
from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.writer import METADATA_NAME
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.cdr import ENCAPSULATION
from spinning_top_sim.streams.intervals import LONGEST_NS
from spinning_top_sim.streams.pipeline import Simulation, TakeRows
from spinning_top_sim.streams.schedule import offline_block_ns, offline_targets
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.streams.topics import all_streams

# What values raise that are not as this package writes them.
ODD = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
LATEST_NS = 1 << 62         # of log times: the difference of any two of them fits into int64
MOST_TEXT = 300             # of a reason
# What is computed for a log at most: for a small one, and more for each of its bytes.
LEAST_STEPS, STEPS_A_BYTE = 200_000, 20
LEAST_SAMPLES, SAMPLES_A_BYTE = 100_000, 1
MOST_BLOCKS = 20_000        # of samples between two events
# Numbers of the events that begin another motion at the present time, in the order of
# `Simulation.history`.
FIELDS_OF = {'command': ('l3', 'lz'), 'state': tuple(field.name for field in fields(State))}
# Names in the message definition of the arrays of numbers in a template, in their order, by topic
# or by type.
FIELDS = {
    'geometry_msgs/msg/PoseStamped': ('pose.orientation',),
    'sensor_msgs/msg/JointState': ('position', 'velocity'),
    'sensor_msgs/msg/Imu': ('orientation', 'angular_velocity', 'linear_acceleration'),
    'sensor_msgs/msg/MagneticField': ('magnetic_field', 'magnetic_field_covariance'),
    'nav_msgs/msg/Odometry': ('pose.pose.orientation', 'twist.twist.angular'),
    'ground_truth/imu_odom': ('pose.pose.position', 'pose.pose.orientation',
                              'twist.twist.linear', 'twist.twist.angular'),
    'geometry_msgs/msg/QuaternionStamped': ('quaternion',),
    'geometry_msgs/msg/Vector3Stamped': ('vector',),
    'std_msgs/msg/Float64MultiArray': ('data',),
    'visualization_msgs/msg/MarkerArray': (
        'markers[0].pose.position', 'markers[0].pose.orientation',
        'markers[1].pose.orientation', 'markers[2].points'),
}


def field_names(stream: Stream) -> Sequence[str] | None:
    """Return the names of the fields of a stream's template, None if they are not in FIELDS."""
    return FIELDS.get(stream.topic) or FIELDS.get(stream.type_name)


class ForeignLogError(Exception):
    """A log lacks what is needed to compute its run again; the text says what."""


class DepartureError(Exception):
    """The computation cannot follow the journal; the text says where."""


@dataclass(frozen=True)
class Event:
    """An entry of the journal."""

    name: str                             # start, command, state, parameters or reset
    stamp_ns: int                         # log time [ns]
    t_ns: int                             # simulated time [ns]
    sent_ns: int                          # time up to which all samples had been sent [ns]
    details: Mapping[str, Any]            # the rest of the entry


@dataclass(frozen=True)
class RunDescription:
    """The run of a log, by its metadata and journal."""

    # Checked parameters at the start of the motion, and at the begin of the recording
    values_at_start: Mapping[str, Any]
    values_at_recording: Mapping[str, Any]
    epoch_ns: int                         # stamp of t = 0 [ns]
    begun_ns: int                         # simulated time at which the recording began [ns]
    history: Sequence[Event]              # commands and states before that
    surroundings: Mapping[str, str]       # version, platform and libraries
    topics: Mapping[str, str]             # topic in the log by that of the stream, imu/data_raw
    commands_topic: str | None            # None where the log has none
    events_topic: str | None
    events: Sequence[Event]               # the journal
    broken: Sequence[tuple[int, str]]     # stamp [ns] of each damaged entry, and the reason
    log_bytes: int                        # size of the log

    @property
    def values_in_effect(self) -> dict[str, Any]:
        """The parameters of the first sample: a change that waits for a reset is not in it."""
        return {parameter.name: (
            self.values_at_start if parameter.effect is parameters.Effect.RESET
            else self.values_at_recording)[parameter.name] for parameter in parameters.TABLE}


def read_run_description(reader: LogReader) -> RunDescription:
    """Return the run of a log.  Raises ForeignLogError where the metadata do not have it."""
    metadata = reader.metadata.get(METADATA_NAME)
    if metadata is None:
        raise ForeignLogError('it was not recorded by spinning_top_sim: it has no metadata '
                              f'{METADATA_NAME!r}')
    try:
        at_start, at_recording = (parameters.checked(json.loads(metadata[key]))
                                  for key in ('parameters', 'parameters_now'))
        epoch_ns, begun_ns = int(metadata['epoch_ns']), int(metadata['begun_ns'])
        history = [_applied_before(epoch_ns, *entry) for entry in json.loads(metadata['history'])]
        times_ns = [0, *(operator.index(event.t_ns) for event in history), max(begun_ns, 0)]
        if times_ns != sorted(times_ns) or epoch_ns < 0 or (
                epoch_ns + times_ns[-1] > min(LATEST_NS, reader.span[1] or LATEST_NS)):
            raise ValueError('times are out of order or too late')
        surroundings = {key: metadata[key] for key in ('version', 'platform', 'libraries')}
        topics = _topics(reader.topics, at_recording)
    except ODD as error:
        raise ForeignLogError(
            f'its metadata {METADATA_NAME!r} cannot be used: {reason_of(error)}') from error
    commands_topic = topics.pop(journal.COMMANDS, None)
    events_topic = topics.pop(journal.EVENTS, None)
    events: list[Event] = []
    broken: list[tuple[int, str]] = []
    epoch, reached_ns = epoch_ns, epoch_ns - 1
    for message in () if events_topic is None else reader.messages(topics=[events_topic]):
        try:
            event = _event(message.log_time, message.data)
            new_epoch = event.details['epoch_ns'] if event.name == 'reset' else epoch
            if not reached_ns <= epoch + event.sent_ns <= event.stamp_ns <= LATEST_NS or not (
                    epoch <= new_epoch <= event.stamp_ns):
                raise ValueError(f'sent_ns = {event.sent_ns} is out of order or too late')
            epoch, reached_ns = new_epoch, max(epoch + event.sent_ns, new_epoch - 1)
            events.append(event)
        except ODD as error:
            broken.append((message.log_time, reason_of(error)))
    return RunDescription(at_start, at_recording, epoch_ns, begun_ns, history, surroundings,
                          topics, commands_topic, events_topic, events, broken, reader.size)


def _applied_before(epoch_ns: int, t_ns: int, *numbers: float) -> Event:
    """Return an entry of `Simulation.history` as an event.  Raises ValueError for other counts."""
    name = 'command' if len(numbers) == len(FIELDS_OF['command']) else 'state'
    return Event(name, epoch_ns + t_ns, t_ns, t_ns,
                 dict(zip(FIELDS_OF[name], numbers, strict=True)))


def reason_of(error: Exception) -> str:
    """Return a line about an error."""
    text = f'{type(error).__name__}: {error}'
    return text if len(text) <= MOST_TEXT else f'{text[:MOST_TEXT]}...'


def _topics(topics: Sequence[LogTopic], values: Mapping[str, Any]) -> dict[str, str]:
    """Return the topic in the log of each stream and of the parts of the journal."""
    every = all_streams(values)
    recorded = [*((stream.topic, stream.type_name)
                  for stream in journal.recorded_streams(every, values)), *journal.TOPICS]
    # As the log was written they have this order, whatever they were remapped to.  In a log that
    # was put together anew they are known by the ends of their names.
    if [topic.type_name for topic in topics] == [type_name for _, type_name in recorded]:
        return {name: topic.name for topic, (name, _) in zip(topics, recorded, strict=True)}
    known = [*((stream.topic, stream.type_name) for stream in every), *journal.TOPICS]
    found: dict[str, str] = {}
    for topic in topics:
        names = [name for name, type_name in known
                 if type_name == topic.type_name and name not in found
                 and topic.name.endswith('/' + name.lstrip('~/'))]
        if names:
            found[max(names, key=len)] = topic.name
    return found


def _event(stamp_ns: int, data: bytes) -> Event:
    """Return an event from its bytes.  Raises one of ODD where they are not as written."""
    details = json.loads(data[len(ENCAPSULATION) + 4:-1])      # 4 for the length of the text
    name, t_ns, sent_ns = (details.pop(key) for key in ('event', 't_ns', 'sent_ns'))
    if journal.event(name, t_ns, sent_ns, **details) != data:
        raise ValueError('the bytes of the entry are not as it was written')
    operator.index(t_ns), operator.index(sent_ns)
    if name in FIELDS_OF:
        details = {key: float(details[key]) for key in FIELDS_OF[name]}
    elif name == 'parameters':
        details = {key: parameters.BY_NAME[key].check(value) for key, value in details.items()}
    elif name == 'reset':
        details = {'epoch_ns': operator.index(details['epoch_ns']),
                   'parameters': parameters.checked(details['parameters'])}
    elif name == 'start':
        since_ns, begin_ns = map(operator.index, details.get('interval_ns', (0, 0)))
        if not 0 <= begin_ns <= since_ns <= max(sent_ns, 0) or (
                since_ns - begin_ns > LONGEST_NS):
            raise ValueError(f'interval_ns = {[since_ns, begin_ns]}')
        details = {'interval_ns': (since_ns, begin_ns)} if since_ns else {}
    else:
        raise ValueError(f'event {name!r} is unknown')
    return Event(name, stamp_ns, t_ns, sent_ns, details)


def rerun(run: RunDescription, end_ns: int,
          send: TakeRows | None = None) -> Iterator[tuple[Simulation, Event | None]]:
    """
    Compute the run of a log again; yield it after the start, each event, and each block (None).

    end_ns : log time of the end [ns]
    send : takes the samples of the log's streams in blocks; without it only motions are computed

    Raises DepartureError where there is no motion with these parameters and commands, or where it
    takes far more work than a run that fits into the log.
    """
    try:
        yield from _rerun(run, end_ns, send)
    except ODD as error:
        raise DepartureError(reason_of(error)) from error


def _rerun(run: RunDescription, end_ns: int,
           send: TakeRows | None) -> Iterator[tuple[Simulation, Event | None]]:
    simulation = Simulation(run.values_at_start, run.epoch_ns)
    most_steps = LEAST_STEPS + STEPS_A_BYTE * run.log_bytes
    samples_left = LEAST_SAMPLES + SAMPLES_A_BYTE * run.log_bytes

    def reach(target_ns: int) -> None:
        with contextlib.suppress(IntegrationError):     # as far as the equations go
            simulation.advance_in_blocks(target_ns, send or (lambda *_: None),
                                         lambda: simulation.steps > most_steps)
        if simulation.steps > most_steps:
            raise DepartureError(f'over {most_steps} integration steps are too many for a log of '
                                 f'{run.log_bytes} bytes')

    # 1. Before the recording: the motion and its commands, no samples.  The rates are already
    # those of the recording: the first of its samples may be a mean over a time before it.
    simulation.apply(run.values_at_recording)
    for event in run.events:
        if 'interval_ns' in event.details:
            simulation.open_interval = event.details['interval_ns']
    for event in run.history:
        reach(event.t_ns)
        _apply(simulation, event)
    if send is not None:
        reach(run.begun_ns)

    # 2. The recording begins, with the streams of this moment.
    simulation.skip_to(max(run.begun_ns, -1))
    if send is not None:
        simulation.log_to(None, [stream for stream in simulation.streams
                                 if stream.topic in run.topics])
    yield simulation, Event('start', run.epoch_ns, 0, simulation.now_ns, {})

    # 3. The journal: samples up to each event that acts on them, and up to the end.
    at_once = {name for stream in simulation.streams for name in stream.at_once}
    acting = [event for event in run.events if event.name in ('reset', *FIELDS_OF)
              or not at_once.isdisjoint(event.details)]
    for item in (*acting, None):
        now_ns = max(simulation.now_ns, 0)
        stop_ns = end_ns - simulation.epoch_ns if item is None else item.sent_ns
        recorded = [stream for stream in simulation.streams if stream.has_sinks]
        samples_left -= sum(max(stop_ns - now_ns, 0) // stream.period_ns for stream in recorded)
        if samples_left < 0:
            raise DepartureError(f'a log of {run.log_bytes} bytes lacks most samples of this run')
        block_ns = max(offline_block_ns(recorded), (stop_ns - now_ns) // MOST_BLOCKS)
        for target_ns, arrived in offline_targets(now_ns, [(stop_ns, item)], block_ns):
            # Without samples states are only needed where a command finds them.
            if send is not None or (arrived is not None and arrived.name in FIELDS_OF):
                reach(target_ns)
            simulation.skip_to(target_ns)
            if arrived is not None:
                _apply(simulation, arrived)
            yield simulation, arrived


def _apply(simulation: Simulation, event: Event) -> None:
    """Apply an event.  Raises DepartureError where that cannot be."""
    details = event.details
    try:
        if event.name in FIELDS_OF:
            if event.name == 'command':
                simulation.command(**details)
            else:
                simulation.set_state(State(**details))
            applied_ns = simulation.history[-1][0]
            if applied_ns != event.t_ns:
                raise ValueError(f'applied at {applied_ns} ns')
        elif event.name == 'parameters':
            simulation.apply(details)
        else:
            simulation.restart(details['parameters'])
            simulation.epoch_ns = details['epoch_ns']
    except ODD as error:
        raise DepartureError(f'{event.name} at t = {event.t_ns} ns: {reason_of(error)}') from error


class Difference(NamedTuple):
    """A place where a log and the computation differ."""

    stamp_ns: int                         # log time of the message [ns]
    topic: str
    field: str                            # name of the field, or what else is different
    logged: str                           # its two values
    computed: str
    byte: int | None = None               # None where one of them has no such message


@dataclass
class Verdict:
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

    def note(self, this: Difference) -> None:
        """Keep a difference if it is the earliest so far."""
        self.first = min(self.first or this, this, key=operator.attrgetter('stamp_ns'))


def verify(reader: LogReader, run: RunDescription, end_ns: int,
           show: Callable[[int], None]) -> Verdict:
    """Compute a run again up to a log time, and compare; `show` takes the one reached [ns]."""
    commands = run.commands_topic
    verdict = Verdict({topic: 0 for topic in (*run.topics.values(), commands)
                       if topic is not None}, warnings=_warnings(run))
    for stamp_ns, reason in run.broken:
        verdict.different += 1
        verdict.note(Difference(stamp_ns, run.events_topic or '', 'entry', reason, 'an entry'))
    # What has not been met in the log, by stamp and topic: several commands may have the same.
    computed: defaultdict[tuple[int, str], deque[tuple[Stream | None, bytes]]] = defaultdict(deque)

    def take(stream: Stream, stamps_ns: NDArray[np.int64], rows: NDArray[np.uint8]) -> None:
        for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True):
            computed[stamp_ns, run.topics[stream.topic]].append((stream, row.tobytes()))

    def computing() -> Iterator[float]:
        """Compute the run; yield the log times before which all is computed, at last infinity."""
        try:
            for simulation, event in rerun(run, end_ns, take):
                if commands is not None and event is not None and event.name == 'command':
                    computed[event.stamp_ns, commands].append(
                        (None, journal.command(event.details['l3'], event.details['lz'])))
                reached_ns = simulation.epoch_ns + simulation.now_ns
                show(reached_ns)
                # Not up to it: another command at this very time may follow.
                yield reached_ns
        except DepartureError as error:
            verdict.stopped = str(error)
        yield math.inf

    def miss(before_ns: float) -> None:
        """Count what the log, which is read in the order of time, does not have before a time."""
        for key in [key for key in computed if key[0] < before_ns]:
            verdict.missing += len(computed.pop(key))
            verdict.note(Difference(*key, 'message', 'no such message', 'there'))

    progress, before_ns = computing(), -math.inf
    for message in reader.messages(topics=verdict.compared):
        while message.log_time >= before_ns:
            before_ns = next(progress)
            miss(message.log_time)
        key = message.log_time, message.topic
        if key in computed:
            stream, expected = computed[key].popleft()
            if not computed[key]:
                del computed[key]
            verdict.compared[message.topic] += 1
            if message.data != expected:
                verdict.different += 1
                verdict.note(_difference(key, stream, message.data, expected))
        else:
            verdict.unexpected += 1
            verdict.note(Difference(*key, 'message', 'there', 'no such message'))
    for _ in progress:
        miss(math.inf)
    miss(math.inf)
    return verdict


def _difference(key: tuple[int, str], stream: Stream | None, logged: bytes,
                computed: bytes) -> Difference:
    """Return the first difference of two messages."""
    sizes = len(logged), len(computed)
    if sizes[0] != sizes[1]:
        return Difference(*key, 'size', f'{sizes[0]} bytes', f'{sizes[1]} bytes', min(sizes))
    at = next(at for at in range(sizes[0]) if logged[at] != computed[at])
    place = None if stream is None else stream.template.field_at(at)
    if stream is None or place is None:
        return Difference(*key, f'byte {at}', f'0x{logged[at]:02x}', f'0x{computed[at]:02x}', at)
    number, element, start = place
    if number < 0:
        what, code, text = 'header.stamp', '<iI', '{}.{:09d}'
    else:
        names = field_names(stream)
        what = f'{names[number] if names else f"array {number}"}[{element}]'
        code, text = '<d', '{!r}'
    one, two = (text.format(*struct.unpack_from(code, data, start)) for data in (logged, computed))
    return Difference(*key, what, one, two, at)


def _warnings(run: RunDescription) -> list[str]:
    """Return the differences of this machine from that of the recording."""
    now, found = provenance.surroundings(), []
    for what, key, pattern in (('the version of spinning_top_sim', 'version', '.*'),
                               ('the platform', 'platform', '.*'),
                               ('numpy', 'libraries', '"numpy": "[^"]*"')):     # only it computes
        then, here = (''.join(re.findall(pattern, one[key])) for one in (run.surroundings, now))
        if then != here:
            found.append(f'{what} was {then}, is {here}')
    return found
