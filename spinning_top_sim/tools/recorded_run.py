# SPDX-License-Identifier: Apache-2.0
"""The run of a log: how the log describes it, and its computation again."""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from spinning_top_sim.physics.top import State
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.provenance import METADATA_NAME
from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import events, parameters
from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.events import Event
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.play import Block, Simulation
from spinning_top_sim.streams.topics import all_channels, recorded
from spinning_top_sim.times import check_stamp, period_ns

LAST_LOG_TIME_NS = 1 << 62  # the difference of any two log times fits into int64
# Samples and integration steps of a log at most: of a small one, and more for each of its bytes.
LEAST_WORK, WORK_A_BYTE = 200_000, 20
# In logs of 1.x events before the recording are lists of numbers: the time, and these.
LISTS_OF_1 = {'command': ('l3', 'lz'), 'state': tuple(field.name for field in fields(State)),
              'parameters': ('imu.rate',), 'drive': ('x', 'y', 'z', 'stop_ns')}


class ForeignLogError(Exception):
    """A log lacks what is needed to compute its run again; the text says what."""


class Logged(NamedTuple):
    """An event of a log, and its log time [ns]."""

    stamp_ns: int
    event: Event


@dataclass(frozen=True)
class RunDescription:
    """The run of a log, by its metadata and journal."""

    # Checked parameters at the start of the motion, and at the begin of the recording
    values_at_start: Mapping[str, Any]
    values_at_recording: Mapping[str, Any]
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

    @property
    def values_in_effect(self) -> dict[str, Any]:
        """The parameters of the first sample: a change that waits for a reset is not in it."""
        return {**self.values_at_start, **self.changes_at_once}

    @property
    def changes_at_once(self) -> dict[str, Any]:
        """The parameters whose changes take effect at once, at the begin of the recording."""
        return {name: self.values_at_recording[name] for name in parameters.AT_ONCE}


def read_run_description(reader: LogReader) -> RunDescription:
    """Return the run of a log.  Raises ForeignLogError where the metadata do not have it."""
    metadata = reader.metadata.get(METADATA_NAME)
    if metadata is None:
        raise ForeignLogError('it was not recorded by spinning_top_sim: it has no metadata '
                              f'{METADATA_NAME!r}')
    try:
        at_start, at_recording = (parameters.valid(json.loads(metadata[key]))
                                  for key in ('parameters', 'parameters_now'))
        epoch_ns, begun_ns = int(metadata['epoch_ns']), int(metadata['begun_ns'])
        history = [_event_before(entry) for entry in json.loads(metadata['history'])]
        check_stamp(epoch_ns)
        environment = {key: metadata[key] for key in ('version', 'platform', 'libraries')}
        dict(json.loads(environment['libraries']))      # raises if it cannot be one
        topics = _topics(reader.topics, at_recording)
        journal = [topics[name] for name in topics if name == events.EVENTS]
        return RunDescription(
            at_start, at_recording, epoch_ns, begun_ns, history, metadata['format'], environment,
            topics, [Logged(message.log_time, Event.decoded(message.data))
                     for message in reader.messages(journal)],
            reader.size, reader.span[1] or LAST_LOG_TIME_NS)
    except MALFORMED as error:
        raise ForeignLogError(
            f'its metadata {METADATA_NAME!r} or journal cannot be used: {reason_of(error)}',
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
    logged = [*((channel.topic, channel.type_name) for channel in recorded(every, values)),
              *events.TOPICS.items()]
    # As the log was written they have this order, whatever they were remapped to.  In a log that
    # was put together anew they are known by the ends of their names.
    if [topic.type_name for topic in topics] == [type_name for _, type_name in logged]:
        return {name: topic.name for topic, (name, _) in zip(topics, logged, strict=True)}
    known = [*((channel.topic, channel.type_name) for channel in every), *events.TOPICS.items()]
    return {name: topic.name for topic in reversed(topics) for name, type_name in known
            if type_name == topic.type_name and topic.name.endswith('/' + name.lstrip('~/'))}


def rerun(run: RunDescription, end_ns: int, *, samples: bool = False,
          ) -> Iterator[tuple[Simulation, Logged | Block]]:
    """
    Compute the run of a log up to a log time, within limits that the size of the log sets.

    samples : yield the messages of the log's channels in blocks; else only motions are computed

    Yields the simulation at the start, after each event and after each block.
    Raises one of MALFORMED where there is no motion with these parameters and commands, or where
    it takes far more work than a run that fits into the log.
    """
    simulation = Simulation(parameters.checked(run.values_at_start), run.epoch_ns)
    limit, count = LEAST_WORK + WORK_A_BYTE * run.log_bytes, 0
    too_much = ValueError(f'over {limit} samples or integration steps are too many for a log of '
                          f'{run.log_bytes} bytes')

    def play(t_ns: int, *, recorded: bool) -> Iterator[tuple[Simulation, Block]]:
        """Yield the blocks up to a time, as far as the equations and the limit go."""
        nonlocal count
        # An event before the first sample has the time 0, and what is sent then the time -1.
        if not simulation.now_ns <= max(t_ns, 0) <= run.log_end_ns - simulation.epoch_ns:
            raise ValueError(f't = {t_ns} ns: out of order, or behind the end of the log')
        channels = [channel for channel in simulation.channels
                    if recorded and samples and channel.topic in run.topics]
        count += sum(len(one.times(simulation.sent_ns, t_ns)) for one in channels)
        if count > limit:
            raise too_much
        with contextlib.suppress(IntegrationError):
            for block in simulation.play(channels, t_ns):
                yield simulation, block
                if simulation.trajectory.steps > limit:
                    raise too_much
        simulation.sent_ns = t_ns

    for event in run.history:               # before the recording
        yield from play(event.t_ns, recorded=False)
        simulation.apply(event.kind, **event.details)
    yield from play(run.begun_ns, recorded=False)
    simulation.apply('parameters', **run.changes_at_once)
    yield simulation, Logged(run.epoch_ns, Event('start', 0, simulation.sent_ns))
    for logged in run.events:
        event = logged.event
        if event.kind != 'start' and (event.kind != 'parameters'
                                      or not parameters.AT_ONCE.isdisjoint(event.details)):
            yield from play(event.sent_ns, recorded=True)
            simulation.apply(event.kind, **event.details)
            yield simulation, logged
    yield from play(max(end_ns - simulation.epoch_ns, simulation.sent_ns), recorded=True)
