# SPDX-License-Identifier: Apache-2.0
"""The run behind a log: its own account of it (metadata, journal), and how to compute it again."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.writer import METADATA_NAME
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.cdr import ENCAPSULATION
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.streams.topics import Stream, all_streams
from spinning_top_sim.tools.simulate import stretches, stride

# Simulated time between two looks at what has been computed, when states go one by one.
STRIDE_NS = 100_000_000
COLUMNS = 'columns'


class NotOursError(Exception):
    """A log does not tell what is needed to compute it again; the text says what is missing."""


class DepartureError(Exception):
    """The computation cannot follow the journal; the text says where."""


@dataclass(frozen=True)
class Event:
    """
    An entry of the journal.

    name: start, command, parameters or reset;  stamp_ns: its log time;  t_ns: simulated time;
    sent_ns: up to there samples had been sent;  details: the rest
    """

    name: str
    stamp_ns: int
    t_ns: int
    sent_ns: int
    details: Mapping[str, Any]


@dataclass(frozen=True)
class Account:
    """
    What a log tells of its run.

    values, now: checked parameters, when the motion began and when the recording did
    epoch_ns: stamp of t = 0;  begun_ns: simulated time up to which samples went unrecorded
    history: commands before that;  evaluation: how states were computed
    surroundings: version, platform, libraries
    topics: name of a stream, such as 'imu/data_raw', by its topic in the log
    commands_topic, events_topic: None where the log has none
    events: in order;  broken: (stamp, reason) of those that are not as they were written
    """

    values: Mapping[str, Any]
    now: Mapping[str, Any]
    epoch_ns: int
    begun_ns: int
    history: tuple[tuple[int, float, float], ...]
    evaluation: str
    surroundings: Mapping[str, str]
    topics: Mapping[str, str]
    commands_topic: str | None
    events_topic: str | None
    events: tuple[Event, ...]
    broken: tuple[tuple[int, str], ...]


def read_account(reader: LogReader) -> Account:
    """Return what a log of ours tells of its run.  Raises NotOursError."""
    told = reader.metadata.get(METADATA_NAME)
    if told is None:
        raise NotOursError('it was not recorded by spinning_top_sim: it has no metadata '
                           f'{METADATA_NAME!r}')
    try:
        values = parameters.checked(json.loads(told['parameters']))
        now = parameters.checked(json.loads(told['parameters_now']))
        numbers = int(told['epoch_ns']), int(told['begun_ns'])
        history = tuple((int(t_ns), float(l3), float(lz))
                        for t_ns, l3, lz in json.loads(told['history']))
        evaluation = told['evaluation']
        surroundings = {key: told[key] for key in ('version', 'platform', 'libraries')}
    except (KeyError, TypeError, ValueError) as error:
        raise NotOursError(f'its metadata {METADATA_NAME!r} cannot be used: '
                           f'{type(error).__name__}: {error}') from error
    topics = _named(reader.topics, now)
    names = {name: topic for topic, name in topics.items()}
    events_topic = names.get(journal.EVENTS)
    events, broken = _read_events(reader, events_topic)
    return Account(
        values=values, now=now, epoch_ns=numbers[0], begun_ns=numbers[1], history=history,
        evaluation=evaluation, surroundings=surroundings,
        topics={topic: name for topic, name in topics.items()
                if name not in (journal.COMMANDS, journal.EVENTS)},
        commands_topic=names.get(journal.COMMANDS), events_topic=events_topic,
        events=events, broken=broken)


def _named(topics: tuple[LogTopic, ...], now: Mapping[str, Any]) -> dict[str, str]:
    """
    Return which stream, or which part of the journal, each topic is.

    A log as it was written has them in a known order, whatever they were remapped to; one that
    something was taken from, or that was put together anew, by the ends of their names.
    """
    every = all_streams(now, Imu(now))
    recorded = [(stream.topic, stream.type_name) for stream in
                journal.recorded_streams(every, now)] + list(journal.TOPICS)
    if [topic.type_name for topic in topics] == [type_name for _, type_name in recorded]:
        return {topic.name: name
                for topic, (name, _) in zip(topics, recorded, strict=True)}
    known = [(stream.topic, stream.type_name) for stream in every] + list(journal.TOPICS)
    found: dict[str, str] = {}
    for topic in topics:
        fitting = [name for name, type_name in known if type_name == topic.type_name
                   and topic.name.endswith('/' + name.removeprefix('~/').removeprefix('/'))
                   and name not in found.values()]
        if fitting:
            found[topic.name] = max(fitting, key=len)
    return found


def _read_events(reader: LogReader, topic: str | None,
                 ) -> tuple[tuple[Event, ...], tuple[tuple[int, str], ...]]:
    events, broken = [], []
    for message in () if topic is None else reader.messages(topics=[topic]):
        try:
            events.append(_event(message.log_time, message.data))
        except (ValueError, KeyError, TypeError, struct.error) as error:
            broken.append((message.log_time, f'{type(error).__name__}: {error}'))
    return tuple(events), tuple(broken)


def _event(stamp_ns: int, data: bytes) -> Event:
    """Return an event from its bytes.  Raises ValueError where they are not as written."""
    head = len(ENCAPSULATION) + 4
    content = json.loads(data[head:-1])
    details = {key: value for key, value in content.items()
               if key not in ('event', 't_ns', 'sent_ns')}
    event = Event(content['event'], stamp_ns, content['t_ns'], content['sent_ns'], details)
    if journal.event(event.name, event.t_ns, event.sent_ns, **details) != data:
        raise ValueError('the bytes of the entry are not as it was written')
    if event.name not in ('start', 'command', 'parameters', 'reset'):
        raise ValueError(f'event {event.name!r} is unknown')
    return event


# Takes the stream's topic, stamp [ns] and bytes of a sample.
Take = Callable[[str, int, bytes], None]


class Rerun:
    """
    Computes the run of a log again, with the evaluation that the log names.

    simulation: at its beginning, then as far as `legs` has come
    stamp_ns: up to there (log time) all samples have been taken
    stopped: why the equations could not go on; then no samples come until a reset
    """

    def __init__(self, account: Account, take: Take | None = None) -> None:
        """
        Begin where the recording does.  Without `take` nothing is computed but the motions.

        Raises DepartureError.
        """
        self._account, self._take = account, take
        self._columns = account.evaluation == COLUMNS
        self.stopped = ''
        self.simulation = simulation = Simulation(account.values, account.epoch_ns)
        for at_ns, l3, lz in account.history:
            self._reach(at_ns)
            self._command(at_ns, l3, lz)
        if take is not None:
            self._reach(account.begun_ns)
        simulation.now_ns = max(account.begun_ns, simulation.now_ns)
        if account.begun_ns < 0:
            simulation.now_ns = -1      # commands before the first sample
        self._set_rates({name: value for name, value in account.now.items()
                         if value != account.values[name]})
        wanted = set(account.topics.values())
        for stream in simulation.streams:
            if take is not None and stream.topic in wanted:
                stream.record = self._sink(stream.topic, take)
        self.stamp_ns = account.epoch_ns + simulation.now_ns

    @staticmethod
    def _sink(topic: str, take: Take) -> Callable[[int, bytes], None]:
        return lambda stamp_ns, data: take(topic, stamp_ns, data)

    def legs(self, end_ns: int) -> Iterator[Event | None]:
        """
        Go on from event to event, and in strides between; yield the event just applied, or None.

        end_ns: log time up to which samples are wanted.  Raises DepartureError.
        """
        simulation = self.simulation
        for target_ns, event in self._targets(end_ns):
            if self._take is not None or (event is not None and event.name == 'command'):
                self._reach(target_ns)
            self.stamp_ns = simulation.epoch_ns + target_ns
            if event is not None:
                simulation.now_ns = target_ns
                self._apply(event)
            yield event

    def _targets(self, end_ns: int) -> Iterator[tuple[int, Event | None]]:
        """Yield how far to go in simulated time, and what happens there."""
        simulation = self.simulation
        events = [event for event in self._account.events if event.name != 'start']
        if self._columns and self._take is not None:
            waiting = iter(events)
            commands = [(event.t_ns, event.details['l3'], event.details['lz'])
                        for event in events]
            duration_ns = round(simulation.values['duration'] * 1e9)
            streams = [stream for stream in simulation.streams if stream.wanted]
            for target_ns, command in stretches(duration_ns, commands, stride(streams)):
                yield target_ns, None if command is None else next(waiting)
                if self.stamp_ns >= end_ns:
                    return
            return
        for event in events:
            yield from self._strides(event.sent_ns)
            yield event.sent_ns, event
        last_ns = end_ns - simulation.epoch_ns
        yield from self._strides(last_ns)
        yield last_ns, None

    def _strides(self, until_ns: int) -> Iterator[tuple[int, None]]:
        while self._take is not None and until_ns - self.simulation.now_ns > STRIDE_NS:
            before = self.simulation.now_ns
            yield before + STRIDE_NS, None
            if self.stopped:
                return

    def _reach(self, target_ns: int) -> None:
        """Send the samples up to a time."""
        simulation = self.simulation
        if target_ns <= simulation.now_ns or self.stopped:
            return
        try:
            if self._columns and self._take is not None:
                simulation.advance_in_columns(target_ns, self._take_rows)
            else:
                simulation.advance(target_ns)
        except IntegrationError as error:
            self.stopped = str(error)

    def _take_rows(self, stream: Stream, stamps: Any, rows: Any) -> None:
        assert stream.record is not None
        size, data = rows.shape[1], rows.tobytes()
        for i, stamp_ns in enumerate(stamps.tolist()):
            stream.record(stamp_ns, data[i * size:(i + 1) * size])

    def _apply(self, event: Event) -> None:
        details = event.details
        try:
            if event.name == 'command':
                self._command(event.t_ns, details['l3'], details['lz'])
            elif event.name == 'parameters':
                self._set_rates(details)
            elif event.name == 'reset':
                self.simulation.restart(parameters.checked(details['parameters']))
                self.simulation.epoch_ns = int(details['epoch_ns'])
                self.stopped = ''
        except (KeyError, TypeError, ValueError, IntegrationError) as error:
            raise DepartureError(f'{event.name} at t = {event.t_ns} ns: '
                                 f'{type(error).__name__}: {error}') from error

    def _command(self, at_ns: int, l3: float, lz: float) -> None:
        try:
            self.simulation.command(l3, lz)
        except ValueError as error:
            raise DepartureError(f'command at t = {at_ns} ns: {error}') from error
        applied_ns = self.simulation.history[-1][0]
        if applied_ns != at_ns:
            raise DepartureError(f'command at t = {at_ns} ns: applied at {applied_ns} ns')

    def _set_rates(self, changed: Mapping[str, Any]) -> None:
        for stream in self.simulation.streams:
            name = f'{stream.parameter}.rate'
            if name in changed:
                stream.set_rate(parameters.BY_NAME[name].check(changed[name]))
                stream.resume(self.simulation.now_ns)
