# SPDX-License-Identifier: Apache-2.0
"""Runs of a sensor as a user has them: recorded by `simulate`, read by mcap and rosbags."""

from collections import defaultdict

import numpy as np
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from spinning_top_sim.tools.simulate import main as simulate

VECTORS = {'sensor_msgs/msg/Imu': ('orientation', 'angular_velocity', 'linear_acceleration'),
           'sensor_msgs/msg/MagneticField': ('magnetic_field',)}


def recorded(folder, values, duration, *more):
    """
    Return what `simulate` records: {topic: (header stamps [ns], log times [ns], rows)}.

    A row has all vectors of the message, or its array of numbers.  Stamps are None without header.
    """
    path = folder / f'run{len(list(folder.iterdir()))}.mcap'
    given = [part for name, value in values.items() for part in ('-p', f'{name}:={text(value)}')]
    assert simulate(['--quiet', '-o', str(path), '--duration', str(duration), *given, *more]) == 0
    store, found = get_typestore(Stores.ROS2_JAZZY), defaultdict(list)
    with path.open('rb') as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema.name in VECTORS or channel.topic == '/ground_truth/imu_timing':
                decoded = store.deserialize_cdr(message.data, schema.name)
                found[channel.topic.lstrip('/')].append((
                    stamp_of(decoded), message.log_time, row_of(schema.name, decoded)))
    return path, {topic: tuple(map(np.array, zip(*rows, strict=True)))
                  for topic, rows in found.items()}


def text(value):
    """Return a value of a parameter as YAML."""
    if isinstance(value, tuple | list):
        return '[' + ', '.join(map(text, value)) + ']'
    return str(value).lower() if isinstance(value, bool) else repr(value)


def stamp_of(message):
    header = getattr(message, 'header', None)
    return header and header.stamp.sec * 10 ** 9 + header.stamp.nanosec


def row_of(name, message):
    if name not in VECTORS:
        return np.array(message.data)
    return np.concatenate([[getattr(getattr(message, field), axis) for axis in (
        'xyzw' if field == 'orientation' else 'xyz')] for field in VECTORS[name]])
