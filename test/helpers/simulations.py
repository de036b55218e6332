# SPDX-License-Identifier: Apache-2.0
"""Simulations for tests, and what they send."""

import numpy as np

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
EPOCH_NS = 1_700_000_000 * SECOND


def simulate(values=None, **more):
    """Return a simulation of these parameters; in keywords `__` stands for a dot."""
    dotted = {name.replace('__', '.'): value for name, value in more.items()}
    return LiveSimulation(parameters.checked({**(values or {}), **dotted}), EPOCH_NS)


def channel(simulation, topic):
    return next(one for one in simulation.channels if one.topic == topic)


def output(simulation, topic):
    return next(one for one in simulation.outputs if one.channel.topic == topic)


def record(simulation, *topics):
    """Record these topics, all where none is named, from now on: [(topic, stamp_ns, bytes)]."""
    taken = []
    recorded = [one for one in simulation.channels if not topics or one.topic in topics]
    simulation.log_to(lambda entries: taken.extend(
        (recorded[number].topic, stamp_ns, row.tobytes()) for number, stamps_ns, rows in entries
        for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True)), recorded)
    return taken


def play(simulation, until_ns, *topics):
    """Return what is sent offline, in the order of blocks: [(topic, stamp_ns, bytes)]."""
    channels = [one for one in simulation.channels if not topics or one.topic in topics]
    return [entry for block in simulation.play(channels, until_ns)
            for entry in entries(simulation, block.messages)]


def entries(simulation, messages):
    return [(one.topic, simulation.epoch_ns + t_ns, row.tobytes())
            for one, times_ns, rows in messages
            for t_ns, row in zip(times_ns.tolist(), rows, strict=True)]


def times(taken, topic):
    """Return the times of the messages of a topic [ns]."""
    return [stamp_ns - EPOCH_NS for name, stamp_ns, _ in taken if name == topic]


def run(values, until_ns, *topics, events=()):
    """
    Simulate; return the simulation and {topic: (times (n,) [ns], stamps (n,) [ns], *fields)}.

    events : time [ns], kind and details
    """
    simulation, taken = simulate(values), []
    for t_ns, kind, details in events:
        taken += play(simulation, t_ns, *topics)
        simulation.apply(kind, **details)
    taken += play(simulation, until_ns, *topics)
    return simulation, {topic: fields(simulation, taken, topic) for topic in topics}


def fields(simulation, taken, topic):
    one = channel(simulation, topic)
    data = b''.join(data for name, _, data in taken if name == topic)
    has_stamp = one.type_name != 'std_msgs/msg/Float64MultiArray'
    return (np.array(times(taken, topic)), one.template.stamps_ns(data) if has_stamp else None,
            *map(np.array, one.template.decode(data)))


def drive(simulation, *velocity):
    """Let the pivot go to a velocity [m/s]; return the event."""
    return simulation.apply('drive', **simulation.drive_details(velocity))
