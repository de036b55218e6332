# SPDX-License-Identifier: Apache-2.0
"""The run of a log: how the log describes it, its computation again, and their comparison."""

import contextlib
import itertools
import json
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from spinning_top_sim.physics.top import State
from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.errors import MALFORMED, LogError, reason_of
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.events import Event
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.messages import Template
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.streams.topics import all_channels, recorded
from spinning_top_sim.times import check_stamp, period_ns, stamp_text

# Samples and integration steps of a log at most: of a small one, and more for each of its bytes.
LEAST_WORK, WORK_A_BYTE = 200_000, 20
# In logs of 1.x events before the recording are lists of numbers: the time, and these.
LISTS_OF_1 = {'command': ('l3', 'lz'), 'state': tuple(field.name for field in fields(State)),
              'parameters': ('imu.rate',), 'drive': ('x', 'y', 'z', 'stop_ns')}


class ForeignLogError(LogError):
    """A log lacks what is needed to compute its run again; the text says what."""


class Logged(NamedTuple):
    """An event of a log, and its log time [ns]."""

    stamp_ns: int
    event: Event


@dataclass(frozen=True)
class RunDescription:
    """The run of a log, by its metadata and journal."""

    values_at_start: Mapping[str, Any]    # checked parameters at the start of the motion
    values_in_effect: Mapping[str, Any]   # of the first sample in the log
    epoch_ns: int                         # stamp of t = 0 [ns]
    begun_ns: int                         # simulated time at which the recording began [ns]
    history: Sequence[Event]              # what was applied before that
    format: str                           # of the metadata, 1 in logs of 1.x
    environment: Mapping[str, str]        # version, platform and libraries
    # Topic in the log by that of the stream, such as imu/data_raw, and of events.TOPICS
    topics: Mapping[str, str]
    events: Sequence[Logged]              # what was applied later
    log_bytes: int                        # size of the log
    log_end_ns: int                       # latest log time [ns]


def read_run_description(reader: LogReader) -> RunDescription:
    """Return the run of a log.  Raises ForeignLogError where the metadata do not have it."""
    metadata = reader.metadata.get(provenance.METADATA_NAME)
    if metadata is None:
        raise ForeignLogError('it was not recorded by spinning_top_sim: it has no metadata of it')
    try:
        at_start, at_recording = (parameters.valid(json.loads(metadata[key]))
                                  for key in ('parameters', 'parameters_now'))
        epoch_ns, begun_ns = int(metadata['epoch_ns']), int(metadata['begun_ns'])
        history = [_event_before(entry) for entry in json.loads(metadata['history'])]
        begin_ns = epoch_ns + max(begun_ns, 0)          # without messages it ends there
        check_stamp(epoch_ns)
        check_stamp(begin_ns)
        environment = {key: metadata[key] for key in ('version', 'platform', 'libraries')}
        topics = _topics(reader.topics, at_recording)
        journal = [topics[name] for name in topics if name == events.EVENTS]
        # A change that waits for a reset is not in effect.
        changes = {name: at_recording[name] for name in parameters.AT_ONCE}
        return RunDescription(
            at_start, {**at_start, **changes}, epoch_ns, begun_ns, history, metadata['format'],
            environment, topics, [Logged(message.log_time, Event.decoded(message.data))
                                  for message in reader.messages(journal)],
            reader.size, max(reader.span[1], begin_ns))
    except MALFORMED as error:
        raise ForeignLogError(f'its metadata or journal cannot be used: {reason_of(error)}'
                              ) from error


def channels_of(values: Mapping[str, Any]) -> list[Channel]:
    """Return every channel of a run that begins with these parameters."""
    return all_channels(values, Imu(values, period_ns(values['imu.rate'])))


def _event_before(entry: Mapping[str, Any] | Sequence[Any]) -> Event:
    """Return an entry of the history.  Raises one of MALFORMED for what is none."""
    if not isinstance(entry, Mapping):
        t_ns, *numbers = entry
        kind = next(kind for kind, keys in LISTS_OF_1.items() if len(numbers) == len(keys))
        entry = {'event': kind, 't_ns': t_ns, 'sent_ns': t_ns,
                 **dict(zip(LISTS_OF_1[kind], numbers, strict=True))}
    return Event.from_mapping(entry)


def _topics(topics: Sequence[LogTopic], values: Mapping[str, Any]) -> dict[str, str]:
    every = channels_of(values)
    logged = {channel.topic: channel.type_name
              for channel in recorded(every, values)} | events.TOPICS
    # As the log was written they have this order, whatever they were remapped to.  In a log that
    # was put together anew they are known by the ends of their names.
    if [topic.type_name for topic in topics] == [*logged.values()]:
        return {name: topic.name for topic, name in zip(topics, logged, strict=True)}
    known = {channel.topic: channel.type_name for channel in every} | events.TOPICS
    return {name: topic.name for topic in reversed(topics) for name, type_name in known.items()
            if type_name == topic.type_name and topic.name.endswith('/' + name.lstrip('~/'))}


def rerun(run: RunDescription,
          topics: Container[str] = ()) -> Iterator[tuple[Simulation, Logged | Block]]:
    """
    Compute the run of a log up to its end, within limits that the size of the log sets.

    topics : of the channels whose messages are computed

    Yields the simulation at the start, after each event and after each block.
    Raises one of MALFORMED where there is no motion with these parameters and commands, or where
    it takes far more work than a run that fits into the log.
    """
    simulation = Simulation(parameters.checked(run.values_at_start), run.epoch_ns)
    limit, samples = LEAST_WORK + WORK_A_BYTE * run.log_bytes, 0

    def play(t_ns: int, topics: Container[str] = ()) -> Iterator[tuple[Simulation, Block]]:
        """Yield the blocks up to a time, as far as the equations and the limit go."""
        nonlocal samples
        # An event before the first sample has the time 0, and what is sent then the time -1.
        if not simulation.now_ns <= max(t_ns, 0) <= run.log_end_ns - simulation.epoch_ns:
            raise ValueError(f't = {t_ns} ns: out of order, or behind the end of the log')
        channels = [channel for channel in simulation.channels if channel.topic in topics]
        samples += sum(len(one.times(simulation.sent_ns, t_ns)) for one in channels)
        with contextlib.suppress(IntegrationError):
            for block in itertools.chain([None], simulation.play(channels, t_ns)):
                if max(samples, simulation.trajectory.steps) > limit:
                    raise ValueError(f'over {limit} samples or integration steps are too many for '
                                     f'a log of {run.log_bytes} bytes')
                if block:
                    yield simulation, block
        simulation.sent_ns = t_ns

    for event in run.history:               # before the recording
        yield from play(event.t_ns)
        simulation.apply(event.kind, **event.details)
    yield from play(run.begun_ns)
    simulation.apply('parameters', **{
        name: run.values_in_effect[name] for name in parameters.AT_ONCE})
    yield simulation, Logged(run.epoch_ns, Event('start', 0, simulation.sent_ns))
    for logged in run.events:
        event = logged.event
        if event.kind != 'start' and (event.kind != 'parameters'
                                      or not parameters.AT_ONCE.isdisjoint(event.details)):
            yield from play(event.sent_ns, topics)
            simulation.apply(event.kind, **event.details)
            yield simulation, logged
    yield from play(max(run.log_end_ns - simulation.epoch_ns, simulation.sent_ns), topics)


@dataclass
class Comparison:
    """The result of `compare`."""

    compared: dict[str, int]              # messages that both have, by topic
    different: int = 0                    # how many of `compared` differ
    missing: int = 0                      # messages that were computed and are not in the log
    unexpected: int = 0                   # messages that are in the log and were not computed
    first: str = ''                       # what is the earliest of all these
    stopped: str = ''                     # why the run could not be computed to its end
    warnings: list[str] = field(default_factory=list)       # of another version or machine
    identical: bool = False               # whether all in the log are as computed

    def add(self, stamp_ns: int, topic: str, logged: bytes | None,
            computed: tuple[Template, bytes] | None) -> None:
        """Count a message of the log, of the run, or of both."""
        found = ''
        if logged is None:
            self.missing += 1
            found = 'not in the log'
        elif computed is None:
            self.unexpected += 1
            found = 'in the log, not computed'
        else:
            self.compared[topic] += 1
            if logged != computed[1]:
                self.different += 1
                found = _difference(logged, *computed)
        if found and not self.first:
            self.first = f'{topic} at {stamp_text(stamp_ns)} s: {found}'


def compare(run: RunDescription, reader: LogReader) -> Comparison:
    """
    Compute the run up to the last message of a log; compare the messages byte for byte.

    Raises LogError for logs of 1.x.
    """
    if run.format != provenance.FORMAT:
        raise LogError(
            f'--verify: it was recorded by spinning_top_sim {run.environment["version"]}, which '
            'draws other noise and computes other last bits: verify it with that version')
    topics = [topic for name, topic in run.topics.items() if name != events.EVENTS]
    result = Comparison(dict.fromkeys(topics, 0), warnings=[
        f'{what} was {run.environment[what]}, is {here}' for what, here in
        provenance.environment().items() if run.environment[what] != here])
    # By stamp and topic, of which several commands may have the same: what is in the log, and
    # what was computed, with its template.
    waiting = defaultdict[tuple[int, str], tuple[list[bytes], list[tuple[Template, bytes]]]](
        lambda: ([], []))
    messages, last_ns = reader.messages(topics), 0
    message = next(messages, None)
    for before_ns in _compute(run, waiting, result):
        while message is not None and message.log_time < before_ns:
            last_ns = message.log_time
            waiting[last_ns, message.topic][0].append(message.data)
            message = next(messages, None)
        for key in sorted(key for key in waiting if key[0] < before_ns):
            pairs = itertools.zip_longest(*waiting.pop(key))
            if message is not None or key[0] <= last_ns:        # else it is behind the end
                for logged, computed in pairs:
                    result.add(*key, logged, computed)
    result.identical = not (result.first or result.stopped)
    return result


def _compute(run: RunDescription, waiting: Mapping[tuple[int, str], Any],
             result: Comparison) -> Iterator[int]:
    """Compute the messages of a run; yield the log times before which all is computed."""
    try:
        for simulation, done in rerun(run, run.topics):
            if isinstance(done, Block):
                for channel, times_ns, rows in done.messages:
                    topic = run.topics[channel.topic]
                    for t_ns, row in zip(times_ns.tolist(), rows, strict=True):
                        waiting[simulation.epoch_ns + t_ns, topic][1].append(
                            (channel.template, row.tobytes()))
            elif done.event.kind == 'command' and events.COMMANDS in run.topics:
                waiting[done.stamp_ns, run.topics[events.COMMANDS]][1].append(
                    (events.COMMAND, dict(done.event.entries())[events.COMMANDS]))
            # Not up to it: another command at this very time may follow.
            yield simulation.epoch_ns + simulation.sent_ns
    except MALFORMED as error:
        result.stopped = reason_of(error)
    else:
        yield 1 << 64


def _difference(logged: bytes, template: Template, computed: bytes) -> str:
    """Return the first difference."""
    if len(logged) != len(computed):
        return f'{len(logged)} bytes in the log, {len(computed)} computed'
    at = next(at for at in range(len(logged)) if logged[at] != computed[at])
    name, (one, two) = template.shown_at(at, logged, computed)
    return f'byte {at}, {name}: in the log {one}, computed {two}'
