# SPDX-License-Identifier: Apache-2.0
"""Every template of a message: the bytes and the fields of rosbags, which is not written here."""

import random
import re
from functools import reduce

import numpy as np
import pytest
from helpers.recordings import ARRAY, JAZZY
from helpers.simulations import EPOCH_NS, SECOND, play, simulate

from spinning_top_sim.streams import events, messages

STAMPS = (0, 1, SECOND - 1, 1_700_000_000 * SECOND + 123_456_789, -1, -2 ** 31 * SECOND,
          (2 ** 31 - 1) * SECOND + SECOND - 1)
# What follows a string is aligned by its length: all remainders of 8.
FRAMES = (*('abcdefghi'[:length] for length in range(1, 10)), 'θ/world', 'x' * 300)
GEODETIC = ('latitude', 'longitude', 'altitude')


def read(data, type_name):
    """Return a message that rosbags, which sets padding to zero, serializes to these bytes."""
    message = JAZZY.deserialize_cdr(data, type_name)
    theirs = bytes(JAZZY.serialize_cdr(message, type_name))
    # Ours are whole fours, as everything that has gone through RTPS is.
    assert theirs == data[:len(theirs)] and not any(data[len(theirs):]), type_name
    assert len(data) % 4 == 0
    return message


def axes_of(part):
    """Return x, y, z and, of a quaternion, w."""
    return [getattr(part, axis) for axis in 'xyzw' if hasattr(part, axis)]


def numbers_at(message, name):
    """Return the numbers of a field by its name in the definition."""
    if name == 'position' and hasattr(message, 'latitude'):
        return [getattr(message, one) for one in GEODETIC]
    parts = re.findall(r'\w+', name)
    found = reduce(lambda part, key: part[int(key)] if key.isdigit() else getattr(part, key),
                   parts, message)
    if hasattr(found, 'x'):
        return axes_of(found)
    if parts[-1] == 'points':
        return [number for point in found for number in axes_of(point)]
    return list(found) if hasattr(found, '__len__') else [found]


@pytest.mark.parametrize('number', range(len(FRAMES)), ids=FRAMES)
def test_every_channel_sends_its_fields_and_frames(number):
    frame, stamp_ns = FRAMES[number], STAMPS[number % len(STAMPS)]
    body, imu = f'{frame}_body', f'{frame}_imu'
    children = {'ground_truth/odom': body, 'ground_truth/imu_odom': imu}
    dice = random.Random(number)
    for one in simulate(world_frame=frame, body_frame=body, imu__frame_id=imu,
                        markers__trace_points=number + 1).channels:
        # Numbers that differ from slot to slot, so that no two can be mixed up.
        fields = [[dice.uniform(-10.0, 10.0) if field.code == 'd' else dice.randrange(100)
                   for _ in range(field.size)] for field in one.template.fields]
        message = read(one.template.encode_one(stamp_ns, *fields), one.type_name)
        for field, given in zip(one.template.fields, fields, strict=True):
            assert numbers_at(message, field.name) == given, (one.topic, field.name)
        header = getattr((message.transforms if one.topic == '/tf' else [message])[0], 'header',
                         None)
        if header is not None:
            assert (header.stamp.sec, header.stamp.nanosec) == divmod(stamp_ns, SECOND)
            expected = (imu if 'imu/' in one.topic or '/mag' in one.topic or one.topic.endswith(
                ('imu', 'imu_bias')) else body if one.topic.endswith('fix')
                else '' if one.topic == 'joint_states' else frame)
            assert header.frame_id == expected, one.topic
        if one.topic in children:
            assert message.child_frame_id == children[one.topic]
    assert read(messages.string(frame), 'std_msgs/msg/String').data == frame
    message = read(events.COMMAND.encode_one(0, (1.5, -0.25)), ARRAY)
    (dimension,) = message.layout.dim
    assert (list(message.data), dimension.label, dimension.size) == ([1.5, -0.25], 'l3,lz', 2)


NOISE = {'imu.gyroscope_noise_density': 1e-3, 'imu.accelerometer_noise_density': 0.02,
         'imu.gyroscope_resolution': 0.01, 'imu.accelerometer_resolution': 0.3,
         'imu.orientation_stddev': (0.1, 0.2, 0.0)}


@pytest.mark.parametrize(('values', 'orientation', 'rates', 'force'), [
    ({}, 3 * (1e-18,), 1e-18, 1e-18),
    # density^2 x rate of the IMU + resolution^2/12, of angular velocity and linear acceleration
    (NOISE, (0.01, 0.04, 1e-18), 1e-6 * 50.0 + 1e-4 / 12.0, 4e-4 * 50.0 + 0.09 / 12.0)])
def test_imu_covariances_follow_rep_145(values, orientation, rates, force):
    """No orientation estimate: first element -1; 0 means unknown, so that exact is 1e-18."""
    unknown, known = [-1.0, *8 * [0.0]], np.diag(3 * [1e-18]).ravel()
    noisy = (np.diag(3 * [rates]).ravel(), np.diag(3 * [force]).ravel())
    expected = {'imu/data_raw': (unknown, *noisy),
                'imu/data': (np.diag(orientation).ravel(), *noisy),
                'ground_truth/imu': 3 * (known,), 'ground_truth/imu_bias': (unknown, known, known)}
    simulation = simulate(values)
    simulation.apply('parameters', **{'imu.rate': 50.0})
    for topic, stamp_ns, data in play(simulation, 0, *expected):
        message = read(data, 'sensor_msgs/msg/Imu')
        assert stamp_ns == EPOCH_NS
        for covariance, numbers in zip((
                message.orientation_covariance, message.angular_velocity_covariance,
                message.linear_acceleration_covariance), expected.pop(topic), strict=True):
            assert covariance == pytest.approx(numbers, rel=1e-12, abs=0.0), topic
    assert not expected
