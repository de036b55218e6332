# SPDX-License-Identifier: Apache-2.0
"""
What changes a run: one type, logged as JSON in ~/events and in the metadata.

With the parameters in a log's metadata, its events are enough to compute every message again.
"""

import json
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

from spinning_top_sim.physics.top import State
from spinning_top_sim.streams import messages, parameters

COMMANDS, EVENTS = '~/commands', '~/events'
# Topics and types, recorded behind the channels, in this order.
TOPICS = {COMMANDS: 'std_msgs/msg/Float64MultiArray', EVENTS: 'std_msgs/msg/String'}
COMMAND = messages.float64_multi_array(('l3', 'lz'))        # an applied one, as it is logged
MOTIONS = ('command', 'state', 'drive')     # events that begin another motion, on the same clock
RESTARTS = (*MOTIONS, 'reset')              # after which another motion goes on
CHANGES = (*MOTIONS, 'parameters', 'epoch', 'reset')        # all but the start of a recording
# The details of each event and what reads them; 'parameters' has those that change.
_DETAILS: Mapping[str, Mapping[str, Callable[[Any], Any]]] = {
    'start': {},
    'command': {'l3': float, 'lz': float},
    'state': {one.name: float for one in fields(State)},
    'drive': {'x': float, 'y': float, 'z': float, 'stop_ns': operator.index},
    'epoch': {'epoch_ns': operator.index},
    'reset': {'epoch_ns': operator.index, 'parameters': parameters.valid}}


@dataclass(frozen=True)
class Event:
    """
    Something that changes a run.

    kind, details : as docs/logs.md says
    t_ns : simulated time at which it acts [ns]
    sent_ns : time up to which samples had been sent before, -1 for none [ns]; a reset puts t back
        to 0, and this is a time of the motion that ended
    """

    kind: str
    t_ns: int
    sent_ns: int
    details: Mapping[str, Any] = field(default_factory=dict)

    def repeats(self, last: 'Event') -> bool:
        """Return whether this is a drive that puts off the end of another, and does no more."""
        return (self.kind == last.kind == 'drive' and self.t_ns < last.details['stop_ns']
                and all(self.details[axis] == last.details[axis] for axis in 'xyz'))

    @property
    def text(self) -> str:
        """The event in JSON, as it is logged."""
        return json.dumps({'event': self.kind, 't_ns': self.t_ns, 'sent_ns': self.sent_ns,
                           **self.details}, default=list)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Self:
        """Return the event that its decoded `text` describes.  Raises one of MALFORMED."""
        given = dict(mapping)
        kind, t_ns, sent_ns = given.pop('event'), given.pop('t_ns'), given.pop('sent_ns')
        if kind == 'parameters':
            details = parameters.checked_changes(given)
        elif kind in _DETAILS:
            details = {name: read(given[name]) for name, read in _DETAILS[kind].items()}
        else:
            raise ValueError(f'event {kind!r} is unknown')
        return cls(kind, operator.index(t_ns), operator.index(sent_ns), details)

    @classmethod
    def decoded(cls, data: bytes) -> Self:
        """Return a logged event.  Raises one of MALFORMED for any other message."""
        begin = len(messages.ENCAPSULATION) + 4
        end = begin + int.from_bytes(data[begin - 4:begin], 'little')       # of the text
        mapping = json.loads(data[begin:end - 1])
        if messages.string(json.dumps(mapping))[:end] != data[:end]:
            raise ValueError('the bytes of the entry are not as it was written')
        return cls.from_mapping(mapping)

    def entries(self) -> list[tuple[str, bytes]]:
        """Return what is logged of the event: topics and messages; std_msgs/String of JSON."""
        logged = [(EVENTS, messages.string(self.text))]
        if self.kind == 'command':
            logged.append((COMMANDS, COMMAND.encode_one(
                0, (self.details['l3'], self.details['lz']))))
        return logged
