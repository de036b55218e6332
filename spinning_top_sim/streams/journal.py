# SPDX-License-Identifier: Apache-2.0
"""
What a log holds besides the streams: the commands and events that shaped the run.

With the parameters in the log's metadata they are enough to compute every message again.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.stream import Stream

COMMANDS, EVENTS = '~/commands', '~/events'
# Topics and types, recorded behind the streams, in this order.
TOPICS = {COMMANDS: 'std_msgs/msg/Float64MultiArray', EVENTS: 'std_msgs/msg/String'}


def recorded_streams(streams: Sequence[Stream], values: Mapping[str, Any]) -> list[Stream]:
    """Return the streams that `record.streams` chooses among those there are."""
    return [stream for stream in streams if is_recorded(stream.parameter, values)]


def is_recorded(parameter: str, values: Mapping[str, Any]) -> bool:
    """Return whether a stream is switched on and `record.streams` chooses it."""
    chosen = values['record.streams']
    return parameters.is_enabled(parameter, values) and ('all' in chosen or parameter in chosen)


def command(l3: float, lz: float) -> bytes:
    """Return an applied command as it is logged: std_msgs/Float64MultiArray [L3, Lz]."""
    return messages.float64_multi_array(('l3', 'lz')).encode_one(0, (l3, lz))


def command_entries(t_ns: int, l3: float, lz: float) -> list[tuple[str, bytes]]:
    """Return what is logged of a command at the simulated time `t_ns`, by topic."""
    return [(EVENTS, event('command', t_ns, t_ns, l3=l3, lz=lz)), (COMMANDS, command(l3, lz))]


def event(name: str, t_ns: int, sent_ns: int, **details: object) -> bytes:
    """
    Return an event at the simulated time `t_ns` as it is logged: std_msgs/String of JSON.

    sent_ns : simulated time up to which samples had been sent before the event [ns], -1 for
        none.  A reset puts t back to 0: there it is a time of the motion that ended.
    """
    return messages.string(json.dumps(
        {'event': name, 't_ns': t_ns, 'sent_ns': sent_ns, **details}, default=list))
