# SPDX-License-Identifier: Apache-2.0
"""Simulations for tests, what they send, and what that costs."""

import struct

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.pipeline import Simulation

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
EPOCH_NS = 1_700_000_000 * SECOND


def simulate(values=None, **more):
    """Return a simulation of these parameters; in keywords `__` stands for a dot."""
    dotted = {name.replace('__', '.'): value for name, value in more.items()}
    return Simulation(parameters.checked({**(values or {}), **dotted}), EPOCH_NS)


def stream(simulation, topic):
    return next(stream for stream in simulation.streams if stream.topic == topic)


def record(simulation, *topics):
    """Record these streams, all where none is named, from now on: [(topic, t_ns, bytes)]."""
    taken, epoch_ns = [], simulation.epoch_ns
    recorded = [one.topic for one in simulation.streams if not topics or one.topic in topics]

    def write(numbers, stamp_ns, messages, size):
        assert size == sum(map(len, messages))
        taken.extend((recorded[number], stamp_ns - epoch_ns, bytes(message))
                     for number, message in zip(numbers, messages, strict=True))

    simulation.log_to(write, [stream(simulation, topic) for topic in recorded])
    return taken


def publish(simulation, *topics):
    """Subscribe to these streams: [(topic, bytes)]."""
    taken = []
    for topic in topics:
        stream(simulation, topic).publish = (
            lambda message, topic=topic: taken.append((topic, bytes(message))))
    return taken


def times(taken, topic):
    """Return the times of the recorded samples of a stream [ns]."""
    return [t_ns for name, t_ns, _ in taken if name == topic]


def doubles(data, count):
    """Return the last doubles of a message."""
    return struct.unpack(f'<{count}d', data[-8 * count:])


class Counting:
    """Counts the items that a method of one object is asked for, and its calls."""

    def __init__(self, owner, name, number=lambda *args: 1):
        original = getattr(owner, name)
        self.count = self.calls = 0

        def counted(*args):
            self.calls += 1
            self.count += number(*args)
            return original(*args)
        setattr(owner, name, counted)


def states_of(simulation):
    """Count the states that the present motion is asked for."""
    return Counting(simulation.segment.solver, 'states', len)


def messages_of(simulation):
    """Count the messages that are encoded of each topic."""
    return {one.topic: Counting(one, 'encode', lambda states, epoch_ns, times: len(times))
            for one in simulation.streams}
