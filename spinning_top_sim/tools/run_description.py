# SPDX-License-Identifier: Apache-2.0
"""The run of a log, from its metadata and journal: enough to compute it again."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from spinning_top_sim.recording.reader import LogReader, LogTopic
from spinning_top_sim.recording.writer import METADATA_NAME
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.all_streams import all_streams
from spinning_top_sim.streams.cdr import ENCAPSULATION

EVENT_NAMES = ('start', 'command', 'parameters', 'reset')


class ForeignLogError(Exception):
    """A log lacks what is needed to compute its run again; the text says what."""


@dataclass(frozen=True)
class Event:
    """An entry of the journal."""

    name: str                             # one of EVENT_NAMES
    stamp_ns: int                         # log time [ns]
    t_ns: int                             # simulated time [ns]
    sent_ns: int                          # time up to which all samples had been sent [ns]
    details: Mapping[str, Any]            # the rest of the entry


@dataclass(frozen=True)
class RunDescription:
    """The run of a log, by its metadata and journal."""

    values: Mapping[str, Any]             # checked parameters when the motion began
    now: Mapping[str, Any]                # and when the recording began
    epoch_ns: int                         # stamp of t = 0 [ns]
    begun_ns: int                         # simulated time at which the recording began [ns]
    # commands before that: time [ns], L3 and Lz [kg m^2/s]
    history: tuple[tuple[int, float, float], ...]
    surroundings: Mapping[str, str]       # version, platform and libraries
    topics: Mapping[str, str]             # stream, such as imu/data_raw, by topic of the log
    commands_topic: str | None            # None where the log has none
    events_topic: str | None
    events: tuple[Event, ...]             # the journal
    broken: tuple[tuple[int, str], ...]   # stamp [ns] of each damaged entry, and the reason


def read_run_description(reader: LogReader) -> RunDescription:
    """
    Return the run of a log that this package recorded.

    Raises
    ------
    ForeignLogError
        The log has no metadata of this package, or not all of them.
    """
    metadata = reader.metadata.get(METADATA_NAME)
    if metadata is None:
        raise ForeignLogError('it was not recorded by spinning_top_sim: it has no metadata '
                              f'{METADATA_NAME!r}')
    try:
        values = parameters.checked(json.loads(metadata['parameters']))
        now = parameters.checked(json.loads(metadata['parameters_now']))
        epoch_ns, begun_ns = int(metadata['epoch_ns']), int(metadata['begun_ns'])
        history = tuple((int(t_ns), float(l3), float(lz))
                        for t_ns, l3, lz in json.loads(metadata['history']))
        surroundings = {key: metadata[key] for key in ('version', 'platform', 'libraries')}
    except (KeyError, TypeError, ValueError) as error:
        raise ForeignLogError(f'its metadata {METADATA_NAME!r} cannot be used: '
                              f'{type(error).__name__}: {error}') from error
    names = _names(reader.topics, now)
    topics = {name: topic for topic, name in names.items()}
    commands_topic, events_topic = topics.get(journal.COMMANDS), topics.get(journal.EVENTS)
    events, broken = _read_events(reader, events_topic)
    return RunDescription(
        values=values, now=now, epoch_ns=epoch_ns, begun_ns=begun_ns, history=history,
        surroundings=surroundings,
        topics={topic: name for topic, name in names.items()
                if topic not in (commands_topic, events_topic)},
        commands_topic=commands_topic, events_topic=events_topic, events=events, broken=broken)


def _names(topics: Sequence[LogTopic], now: Mapping[str, Any]) -> dict[str, str]:
    """
    Return the stream, or the part of the journal, of each topic that is one.

    A log as it was written has them in a known order, whatever they were remapped to.  In a log
    that was put together anew they are known by the ends of their names.
    """
    every = all_streams(now)
    recorded = [(stream.topic, stream.type_name)
                for stream in journal.recorded_streams(every, now)] + list(journal.TOPICS)
    if [topic.type_name for topic in topics] == [type_name for _, type_name in recorded]:
        return {topic.name: name for topic, (name, _) in zip(topics, recorded, strict=True)}
    known = [(stream.topic, stream.type_name) for stream in every] + list(journal.TOPICS)
    found: dict[str, str] = {}
    for topic in topics:
        candidates = [name for name, type_name in known if type_name == topic.type_name
                      and topic.name.endswith('/' + name.removeprefix('~/').removeprefix('/'))
                      and name not in found.values()]
        if candidates:
            found[topic.name] = max(candidates, key=len)
    return found


def _read_events(reader: LogReader, topic: str | None,
                 ) -> tuple[tuple[Event, ...], tuple[tuple[int, str], ...]]:
    """Return the journal's events, and stamps and reasons of the entries that are damaged."""
    events, broken = [], []
    for message in () if topic is None else reader.messages(topics=[topic]):
        try:
            events.append(_event(message.log_time, message.data))
        except (ValueError, KeyError, TypeError, struct.error) as error:
            broken.append((message.log_time, f'{type(error).__name__}: {error}'))
    return tuple(events), tuple(broken)


def _event(stamp_ns: int, data: bytes) -> Event:
    """Return an event from its bytes.  Raises ValueError where they are not as written."""
    length_field = 4
    content = json.loads(data[len(ENCAPSULATION) + length_field:-1])
    details = {key: value for key, value in content.items()
               if key not in ('event', 't_ns', 'sent_ns')}
    event = Event(content['event'], stamp_ns, content['t_ns'], content['sent_ns'], details)
    if journal.event(event.name, event.t_ns, event.sent_ns, **details) != data:
        raise ValueError('the bytes of the entry are not as it was written')
    if event.name not in EVENT_NAMES:
        raise ValueError(f'event {event.name!r} is unknown')
    return event
