# SPDX-License-Identifier: Apache-2.0
"""What the sensors of a run read, in numbers."""

import numpy as np

from helpers.simulations import play, simulate, stream
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.inertial_sensor import Sensor

STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def run(values, until_ns, *topics, events=()):
    """
    Simulate; return the simulation and {topic: (times (n,) [ns], stamps (n,) [ns], *fields)}.

    events : time [ns] and what is done with the simulation then
    """
    simulation, taken = simulate(values), []
    for t_ns, act in (*events, (until_ns, lambda simulation: None)):
        taken += play(simulation, t_ns, *topics)
        act(simulation)
    return simulation, {topic: fields(simulation, taken, topic) for topic in topics}


def fields(simulation, taken, topic):
    times_ns, messages = zip(*((t_ns, data) for name, t_ns, data in taken if name == topic),
                             strict=True)
    data, template = b''.join(messages), stream(simulation, topic).template
    has_stamp = stream(simulation, topic).type_name != 'std_msgs/msg/Float64MultiArray'
    return (np.array(times_ns), template.stamps_ns(data) if has_stamp else None,
            *map(np.array, template.decode(data)))


def command(l3, lz):
    """Return an event: L3 and Lz jump by these factors."""
    return lambda simulation: simulation.command(l3 * simulation.l3, lz * simulation.lz)


def rate(hertz):
    """Return an event: `imu.rate` changes."""
    return lambda simulation: simulation.apply({'imu.rate': hertz})


def read(sensor, times, exact=STILL):
    """
    Return what an IMU reads at these times [ns], and its bias, (n, 6) each.

    sensor : or the parameters of one that takes its samples at these times
    """
    if not isinstance(sensor, Sensor):
        sensor = Sensor(parameters.checked(sensor), times.step)
    return tuple(np.column_stack([np.broadcast_to(axis, len(times)) for kind in found
                                  for axis in kind])
                 for found in (sensor.read(exact, times), sensor.bias(times)))
