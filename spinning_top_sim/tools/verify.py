# SPDX-License-Identifier: Apache-2.0
"""The comparison of a log with the computation of its run, byte by byte."""

import itertools
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.errors import MALFORMED, reason_of
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import events
from spinning_top_sim.streams.messages import Template
from spinning_top_sim.streams.play import Block
from spinning_top_sim.times import stamp_text
from spinning_top_sim.tools.recorded_run import RunDescription, rerun

# By stamp and topic, of which several commands may have the same: messages that are in the log,
# and those computed with their templates.
_Waiting = defaultdict[tuple[int, str], tuple[list[bytes], list[tuple[Template, bytes]]]]


@dataclass
class Comparison:
    """The result of a comparison."""

    compared: dict[str, int]              # messages that both have, by topic
    identical: bool = False               # whether all in the log are as computed
    different: int = 0                    # how many of `compared` differ
    missing: int = 0                      # messages that were computed and are not in the log
    unexpected: int = 0                   # messages that are in the log and were not computed
    first: str = ''                       # what is the earliest of all these
    stopped: str = ''                     # why the run could not be computed to its end
    warnings: list[str] = field(default_factory=list)       # of another version or machine

    def add(self, stamp_ns: int, topic: str, logged: bytes | None,
            computed: tuple[Template, bytes] | None) -> None:
        """Add a message, which may be in one of both only."""
        if logged is None:
            self.missing += 1
            found = 'not in the log'
        elif computed is None:
            self.unexpected += 1
            found = 'in the log, not computed'
        else:
            self.compared[topic] += 1
            template, expected = computed
            if logged == expected:
                return
            self.different += 1
            found = _difference(template, logged, expected)
        self.first = self.first or f'{topic} at {stamp_text(stamp_ns)} s: {found}'


def objection(run: RunDescription | None) -> str:
    """Return why the run of a log cannot be verified by this version, '' if it can."""
    return '' if run is None or run.format == provenance.FORMAT else (
        f'it was recorded by spinning_top_sim {run.environment["version"]}, which draws other '
        'noise and computes other last bits: verify it with that version')


def compare(run: RunDescription, reader: LogReader, end_ns: int) -> Comparison:
    """
    Compute the run of a log while the log is read in the order of time; return the result.

    end_ns : log time up to which they are compared [ns]
    """
    topics = [topic for name, topic in run.topics.items() if name != events.EVENTS]
    there, here = ({**json.loads(one['libraries']), **one, 'libraries': ''}
                   for one in (run.environment, provenance.environment()))
    # A library that only one of both has was not needed.
    result = Comparison(dict.fromkeys(topics, 0), warnings=[
        f'{what} was {there[what]}, is {here[what]}'
        for what in here if there.get(what, here[what]) != here[what]])
    waiting: _Waiting = defaultdict(lambda: ([], []))
    messages = reader.messages(topics)
    message = next(messages, None)
    for before_ns in _compute(run, end_ns, waiting, result):
        while message is not None and message.log_time < before_ns:
            waiting[message.log_time, message.topic][0].append(message.data)
            message = next(messages, None)
        for key in sorted(key for key in waiting if key[0] < before_ns):
            for logged, computed in itertools.zip_longest(*waiting.pop(key)):
                result.add(*key, logged, computed)
    result.identical = not (result.first or result.stopped)
    return result


def _compute(run: RunDescription, end_ns: int, waiting: _Waiting,
             result: Comparison) -> Iterator[int]:
    """Compute the messages of a run; yield the log times before which all is computed."""
    try:
        for simulation, done in rerun(run, end_ns, samples=True):
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


def _difference(template: Template, logged: bytes, computed: bytes) -> str:
    """Return what is the first that differs."""
    if len(logged) != len(computed):
        return f'{len(logged)} bytes in the log, {len(computed)} computed'
    at = next(at for at in range(len(logged)) if logged[at] != computed[at])
    name, (one, two) = template.shown_at(at, logged, computed)
    return f'byte {at}, {name}: in the log {one}, computed {two}'
