# SPDX-License-Identifier: Apache-2.0
"""The run of a log: how the log describes it, and its computation again."""

import contextlib
import json
import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from spinning_top_sim.physics.top import State
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.provenance import METADATA_NAME
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.blocks import Block
from spinning_top_sim.streams.cdr import ENCAPSULATION
from spinning_top_sim.streams.parameter import Effect
from spinning_top_sim.streams.simulation import Drive, Simulation
from spinning_top_sim.streams.stream import Stream
from spinning_top_sim.streams.topics import all_streams

LAST_LOG_TIME_NS = 1 << 62  # the difference of any two log times fits into int64
# What is computed for a log at most: for a small one, and more for each of its bytes.
LEAST_STEPS, STEPS_A_BYTE = 200_000, 20
LEAST_SAMPLES, SAMPLES_A_BYTE = 100_000, 1
# What entries of `Simulation.history` have after their time, by the events that record them; they
# differ in the count of numbers.
APPLIED = {'command': ('l3', 'lz'), 'state': tuple(field.name for field in fields(State)),
           'parameters': ('rate',), 'drive': Drive._fields[1:]}
NEW_MOTIONS = ('command', 'state', 'drive')     # events that begin another motion at once


class ForeignLogError(Exception):
    """A log lacks what is needed to compute its run again; the text says what."""


@dataclass(frozen=True)
class Event:
    """An entry of the journal."""

    name: str                             # start, command, state, drive, parameters or reset
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
    environment: Mapping[str, str]       # version, platform and libraries
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
            self.values_at_start if parameter.effect is Effect.RESET
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
        if times_ns != sorted(times_ns) or not 0 <= epoch_ns <= epoch_ns + times_ns[-1] <= min(
                LAST_LOG_TIME_NS, reader.span[1] or LAST_LOG_TIME_NS):
            raise ValueError('times are out of order or too late')
        environment = {key: metadata[key] for key in ('version', 'platform', 'libraries')}
        topics = _topics(reader.topics, at_recording)
    except MALFORMED as error:
        raise ForeignLogError(
            f'its metadata {METADATA_NAME!r} cannot be used: {reason_of(error)}') from error
    commands_topic = topics.pop(journal.COMMANDS, None)
    events_topic = topics.pop(journal.EVENTS, None)
    events, broken = _journal(reader, events_topic, epoch_ns)
    return RunDescription(at_start, at_recording, epoch_ns, begun_ns, history, environment,
                          topics, commands_topic, events_topic, events, broken, reader.size)


def _journal(reader: LogReader, topic: str | None, epoch_ns: int,
             ) -> tuple[list[Event], list[tuple[int, str]]]:
    """Return the events in a topic, and stamp [ns] and reason of each that cannot be one."""
    events, broken, reached_ns = [], [], epoch_ns - 1
    for message in reader.messages(topics=[] if topic is None else [topic]):
        try:
            event = _event(message.log_time, message.data)
            sent_ns = epoch_ns + event.sent_ns
            new_epoch_ns = event.details.get('epoch_ns', epoch_ns)
            if not reached_ns <= sent_ns <= event.stamp_ns <= LAST_LOG_TIME_NS or not (
                    epoch_ns <= new_epoch_ns <= event.stamp_ns):
                raise ValueError(f'sent_ns = {event.sent_ns} is out of order or too late')
            epoch_ns, reached_ns = new_epoch_ns, max(sent_ns, new_epoch_ns - 1)
            events.append(event)
        except MALFORMED as error:
            broken.append((message.log_time, reason_of(error)))
    return events, broken


def _applied_before(epoch_ns: int, t_ns: int, *numbers: float) -> Event:
    """Return an entry of `Simulation.history` as an event.  Raises ValueError for other counts."""
    name = next(name for name, keys in APPLIED.items() if len(numbers) == len(keys))
    details = dict(zip(APPLIED[name], numbers, strict=True))
    if name == 'parameters':
        details = {'imu.rate': parameters.BY_NAME['imu.rate'].check(details['rate'])}
    return Event(name, epoch_ns + t_ns, t_ns, t_ns, details)


def _topics(topics: Sequence[LogTopic], values: Mapping[str, Any]) -> dict[str, str]:
    every = all_streams(values)
    recorded = [*((stream.topic, stream.type_name)
                  for stream in journal.recorded_streams(every, values)), *journal.TOPICS.items()]
    # As the log was written they have this order, whatever they were remapped to.  In a log that
    # was put together anew they are known by the ends of their names.
    if [topic.type_name for topic in topics] == [type_name for _, type_name in recorded]:
        return {name: topic.name for topic, (name, _) in zip(topics, recorded, strict=True)}
    known = [*((stream.topic, stream.type_name) for stream in every), *journal.TOPICS.items()]
    return {name: topic.name for topic in reversed(topics) for name, type_name in known
            if type_name == topic.type_name and topic.name.endswith('/' + name.lstrip('~/'))}


def _event(stamp_ns: int, data: bytes) -> Event:
    details = json.loads(data[len(ENCAPSULATION) + 4:-1])      # 4 for the length of the text
    name, t_ns, sent_ns = (details.pop(key) for key in ('event', 't_ns', 'sent_ns'))
    if journal.event(name, t_ns, sent_ns, **details) != data:
        raise ValueError('the bytes of the entry are not as it was written')
    operator.index(t_ns), operator.index(sent_ns)
    if name in NEW_MOTIONS:
        details = {key: (operator.index if key == 'stop_ns' else float)(details[key])
                   for key in APPLIED[name]}
    elif name == 'parameters':
        details = {key: parameters.BY_NAME[key].check(value) for key, value in details.items()}
    elif name == 'reset':
        details = {'epoch_ns': operator.index(details['epoch_ns']),
                   'parameters': parameters.checked(details['parameters'])}
    elif name == 'start':
        details = {}
    else:
        raise ValueError(f'event {name!r} is unknown')
    return Event(name, stamp_ns, t_ns, sent_ns, details)


def rerun(run: RunDescription, end_ns: int, *, samples: bool = False,
          ) -> Iterator[tuple[Simulation, Event | Block]]:
    """
    Compute the run of a log up to a log time, within limits that the size of the log sets.

    samples : yield the messages of the log's streams in blocks; else only motions are computed

    Yields the simulation at the start, after each event and after each block.
    Raises one of MALFORMED where there is no motion with these parameters and commands, or where
    it takes far more work than a run that fits into the log.
    """
    simulation = Simulation(run.values_at_start, run.epoch_ns)
    most_steps = LEAST_STEPS + STEPS_A_BYTE * run.log_bytes
    samples_left = LEAST_SAMPLES + SAMPLES_A_BYTE * run.log_bytes

    def play(t_ns: int, streams: Sequence[Stream]) -> Iterator[tuple[Simulation, Block]]:
        """Yield the blocks up to a time, as far as the equations and the limits go."""
        nonlocal samples_left
        samples_left -= sum(len(one.times(simulation.now_ns, t_ns)) for one in streams)
        if samples_left < 0:
            raise ValueError(f'a log of {run.log_bytes} bytes lacks most samples of this run')
        with contextlib.suppress(IntegrationError):
            for block in simulation.play(streams, t_ns):
                yield simulation, block
                if simulation.steps > most_steps:
                    raise ValueError(f'over {most_steps} integration steps are too many for a log '
                                     f'of {run.log_bytes} bytes')

    def up_to(t_ns: int, *, moves: bool = False) -> Iterator[tuple[Simulation, Block]]:
        """Yield the samples up to a time; `moves`: let the motion reach it in any case."""
        streams = [stream for stream in simulation.streams
                   if samples and stream.topic in run.topics]
        if streams or moves:
            yield from play(t_ns, streams)
        simulation.now_ns = t_ns

    # Before the recording: the motion and its commands, no samples.
    for event in run.history:
        yield from play(event.t_ns, ())
        _apply(simulation, event)
    if samples:
        yield from play(run.begun_ns, ())
    simulation.now_ns = run.begun_ns
    at_once = {one.name for one in parameters.TABLE if one.effect is Effect.NOW}
    simulation.apply({name: run.values_at_recording[name] for name in at_once})
    yield simulation, Event('start', run.epoch_ns, 0, simulation.now_ns, {})

    # The journal: samples up to each event that acts on them, and up to the end.
    for event in run.events:
        if event.name in ('reset', *NEW_MOTIONS) or not at_once.isdisjoint(event.details):
            yield from up_to(event.sent_ns, moves=event.name in NEW_MOTIONS)
            _apply(simulation, event)
            yield simulation, event
    yield from up_to(end_ns - simulation.epoch_ns)


def _apply(simulation: Simulation, event: Event) -> None:
    details = event.details
    if event.name in NEW_MOTIONS:
        if event.name == 'command':
            simulation.command(**details)
        elif event.name == 'drive':
            *velocity, stop_ns = (details[key] for key in APPLIED['drive'])
            simulation.drive(velocity, stop_ns)
        else:
            simulation.set_state(State(**details))
        applied_ns = simulation.now_ns
        if applied_ns != event.t_ns:
            raise ValueError(f'{event.name} at t = {event.t_ns} ns: applied at {applied_ns} ns')
    elif event.name == 'parameters':
        simulation.apply(details)
    else:
        simulation.restart(details['parameters'])
        simulation.epoch_ns = details['epoch_ns']
