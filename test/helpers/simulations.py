# SPDX-License-Identifier: Apache-2.0
"""Simulations for tests, what they send, and what that costs."""

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
EPOCH_NS = 1_700_000_000 * SECOND


def simulate(values=None, **more):
    """Return a simulation of these parameters; in keywords `__` stands for a dot."""
    dotted = {name.replace('__', '.'): value for name, value in more.items()}
    return LiveSimulation(parameters.checked({**(values or {}), **dotted}), EPOCH_NS)


def stream(simulation, topic):
    return next(stream for stream in simulation.streams if stream.topic == topic)


def output(simulation, topic):
    return next(one for one in simulation.outputs if one.stream.topic == topic)


def record(simulation, *topics):
    """Record these streams, all where none is named, from now on: [(topic, t_ns, bytes)]."""
    taken, epoch_ns = [], simulation.epoch_ns
    recorded = [one for one in simulation.streams if not topics or one.topic in topics]

    def write(entries):
        taken.extend((recorded[number].topic, stamp_ns - epoch_ns, message)
                     for number, stamp_ns, message in entries)

    simulation.log_to(write, recorded)
    return taken


def play(simulation, until_ns, *topics):
    """Return what the same run sends offline, in the order of blocks: [(topic, t_ns, bytes)]."""
    streams = [one for one in simulation.streams if not topics or one.topic in topics]
    return [(one.topic, t_ns, row.tobytes()) for block in simulation.play(streams, until_ns)
            for one, times_ns, rows in block.messages
            for t_ns, row in zip(times_ns.tolist(), rows, strict=True)]


def publish(simulation, *topics):
    """Subscribe to these streams: [(topic, bytes)]."""
    taken = []
    for topic in topics:
        output(simulation, topic).publish = (
            lambda message, topic=topic: taken.append((topic, message)))
    return taken


def times(taken, topic):
    """Return the times of the recorded samples of a stream [ns]."""
    return [t_ns for name, t_ns, _ in taken if name == topic]


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
    return Counting(simulation.segment.motion, 'states', len)


def messages_of(simulation):
    """Count the samples that are encoded of each topic."""
    return {one.topic: Counting(one, 'encode', lambda samples: len(samples.times))
            for one in simulation.streams}
