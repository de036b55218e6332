# SPDX-License-Identifier: Apache-2.0
"""
Every CDR template against the serializer of ROS itself (rclpy, Fast DDS).

That serializer leaves padding as it finds it in memory, so bytes may differ exactly there: where
the template has a zero and a change of that byte changes no field.
"""

import importlib
import itertools
import math
import random
from array import array

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu, JointState, MagneticField  # noqa: E402
from spinning_top_sim.streams.pipeline import Simulation  # noqa: E402
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String  # noqa: E402

from spinning_top_sim.streams import messages, parameters  # noqa: E402

SECOND = 1_000_000_000
STAMPS = (0, 1, SECOND - 1, SECOND, 1_700_000_000 * SECOND + 123_456_789, -1, -SECOND,
          -2 ** 31 * SECOND, (2 ** 31 - 1) * SECOND + SECOND - 1)
FRAMES = ('', *('abcdefghijklmnopq'[:length] for length in range(1, 17)), 'θ/world', 'x' * 300)
RATES, FORCE = messages.diagonal(*3 * (1e-6,)), messages.diagonal(*3 * (4e-4,))
NUMBERS = (0.0, -0.0, 1.5, -math.pi, 5e-324, 1.7976931348623157e308, math.inf, -1e-9)


def numbers(count):
    """Return numbers that differ from slot to slot, so that no two can be mixed up."""
    dice = random.Random(count)
    return [dice.uniform(-10.0, 10.0) for _ in range(count)]


def message_class(type_name):
    package, _, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def set_stamp(stamp, stamp_ns):
    stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND)


def set_xyzw(quaternion, values):
    quaternion.x, quaternion.y, quaternion.z, quaternion.w = values


def set_xyz(vector, values):
    vector.x, vector.y, vector.z = values


def assert_same(ours, message):
    """Whether `ours` is what ROS makes of `message`: field by field, and byte by byte."""
    kind = type(message)
    theirs = bytes(serialize_message(message))
    assert deserialize_message(ours, kind) == message
    assert ours[:4] == theirs[:4] == b'\x00\x01\x00\x00'
    # Behind the message ROS leaves bytes that say nothing: it reserves for the padding before the
    # elements of a sequence even where there are none, and rounds the whole up to four bytes.
    # Ours are whole fours, as everything that has gone through RTPS is.
    assert -4 < len(theirs) - len(ours) < 12
    assert len(ours) % 4 == 0 or kind is String
    assert not any(ours[len(theirs):])
    assert deserialize_message(theirs[:len(ours)], kind) == message
    if kind in (PoseStamped, Imu, Odometry, Clock):     # no sequences: to the byte, but for those
        assert len(theirs) - len(ours) < 4
    for at, (mine, other) in enumerate(zip(ours, theirs, strict=False)):
        if mine != other:
            assert mine == 0, f'byte {at} of {kind.__name__}: {mine} for {other}'
            flipped = bytearray(ours)
            flipped[at] = other
            assert deserialize_message(bytes(flipped), kind) == message, f'byte {at} is no padding'


@pytest.mark.parametrize('frame', FRAMES)
def test_pose_stamped_is_what_ros_serializes(frame):
    template = messages.pose_stamped(frame)
    for stamp_ns in STAMPS:
        message = PoseStamped()
        message.header.frame_id = frame
        set_stamp(message.header.stamp, stamp_ns)
        values = numbers(4)
        set_xyzw(message.pose.orientation, values)
        assert_same(template.encode_one(stamp_ns, values), message)


@pytest.mark.parametrize('frame', FRAMES)
@pytest.mark.parametrize('orientation', [messages.UNKNOWN_ORIENTATION, messages.EXACT,
                                         messages.diagonal(2.5e-5, 1e-4, 0.25)])
def test_imu_is_what_ros_serializes(frame, orientation):
    template = messages.imu(frame, orientation, RATES, FORCE)
    for stamp_ns in STAMPS:
        message = Imu()
        message.header.frame_id = frame
        set_stamp(message.header.stamp, stamp_ns)
        values = numbers(10)
        set_xyzw(message.orientation, values[:4])
        set_xyz(message.angular_velocity, values[4:7])
        set_xyz(message.linear_acceleration, values[7:])
        message.orientation_covariance = orientation
        message.angular_velocity_covariance = RATES
        message.linear_acceleration_covariance = FORCE
        assert_same(template.encode_one(stamp_ns, values[:4], values[4:7], values[7:]), message)


@pytest.mark.parametrize('frame', FRAMES)
def test_magnetic_field_is_what_ros_serializes(frame):
    for stamp_ns in STAMPS:
        message = MagneticField(magnetic_field_covariance=messages.diagonal(*numbers(3)))
        message.header.frame_id = frame
        set_stamp(message.header.stamp, stamp_ns)
        set_xyz(message.magnetic_field, numbers(5)[2:])
        assert_same(messages.magnetic_field(frame).encode_one(
            stamp_ns, numbers(5)[2:], messages.diagonal(*numbers(3))), message)


def test_no_covariance_is_zero_which_means_unknown():
    assert messages.EXACT == (1e-18, 0.0, 0.0, 0.0, 1e-18, 0.0, 0.0, 0.0, 1e-18)
    assert messages.diagonal(4.0, 0.0) == (4.0, 0.0, 0.0, 1e-18)


@pytest.mark.parametrize('frame', FRAMES[:9])
def test_odometry_is_what_ros_serializes(frame):
    for child, stamp_ns in itertools.product(FRAMES[:9], STAMPS):
        template = messages.odometry(frame, child)
        message = Odometry(child_frame_id=child)
        message.pose.covariance = message.twist.covariance = messages.diagonal(*6 * (0.0,))
        message.header.frame_id = frame
        set_stamp(message.header.stamp, stamp_ns)
        values = numbers(7)
        set_xyzw(message.pose.pose.orientation, values[:4])
        set_xyz(message.twist.twist.angular, values[4:])
        assert_same(template.encode_one(stamp_ns, values[:4], values[4:]), message)


@pytest.mark.parametrize('count', [0, 1, 2, 3, 5])
def test_joint_state_is_what_ros_serializes(count):
    for length, stamp_ns in itertools.product(range(17), STAMPS):
        names = [f'{"j" * length}{index}' for index in range(count)]
        template = messages.joint_state(names)
        values = numbers(2 * count)
        message = JointState(name=names, position=values[:count], velocity=values[count:])
        set_stamp(message.header.stamp, stamp_ns)
        assert_same(template.encode_one(stamp_ns, values[:count], values[count:]), message)


@pytest.mark.parametrize('length', range(1, 18))
def test_float64_multi_array_is_what_ros_serializes(length):
    labels = ('a' * length, 'b')
    message = Float64MultiArray(data=numbers(2))
    message.layout.dim = [MultiArrayDimension(label=','.join(labels), size=2, stride=2)]
    assert_same(messages.float64_multi_array(labels).encode_one(0, numbers(2)), message)


def test_clock_is_what_ros_serializes():
    for stamp_ns in STAMPS:
        message = Clock()
        set_stamp(message.clock, stamp_ns)
        assert_same(messages.clock().encode_one(stamp_ns), message)


@pytest.mark.parametrize('text', FRAMES)
def test_string_is_what_ros_serializes(text):
    assert_same(messages.string(text), String(data=text))


def test_extreme_doubles_survive():
    for value in NUMBERS:
        message = deserialize_message(
            messages.pose_stamped('w').encode_one(0, (value, 0.0, 0.0, 1.0)), PoseStamped)
        assert array('d', [message.pose.orientation.x]) == array('d', [value])
        assert math.copysign(1.0, message.pose.orientation.x) == math.copysign(1.0, value)
    assert math.isnan(deserialize_message(
        messages.pose_stamped('w').encode_one(0, (math.nan, 0.0, 0.0, 1.0)),
        PoseStamped).pose.orientation.x)


def test_a_template_remembers_nothing_of_the_last_messages():
    template = messages.imu('imu_link', messages.EXACT, messages.EXACT, messages.EXACT)
    first = template.encode_one(7, numbers(4), numbers(3), numbers(3))
    template.encode(np.full(20, SECOND * 99), (9.0,) * 4, (8.0,) * 3, (7.0,) * 3)
    assert template.encode_one(7, numbers(4), numbers(3), numbers(3)) == first


def test_many_messages_are_single_ones_one_after_the_other():
    """Fields as arrays, as columns and as numbers for all; growing and shrinking counts."""
    template = messages.imu('imu_link', messages.EXACT, messages.EXACT, messages.EXACT)
    rng = np.random.default_rng(1)
    for count in (1, 300, 7, 0, 1000):
        stamps_ns = rng.integers(-2 ** 60, 2 ** 60, count)
        orientation, rates = rng.normal(size=(count, 4)), rng.normal(size=(3, count))
        force = (0.5, -0.25, 0.0)
        rows = template.encode(stamps_ns, orientation, tuple(rates), force)
        assert rows.shape == (count, len(template))
        singles = [row.tobytes() for row in rows]
        assert singles == [template.encode_one(stamp_ns, q, w, force)
                           for stamp_ns, q, w in zip(stamps_ns, orientation, rates.T, strict=True)]
        data = b''.join(singles)
        for found, given in zip(template.decode(data), (orientation, rates.T, [force] * count),
                                strict=True):
            assert np.array_equal(found, np.reshape(given, found.shape))


@pytest.mark.parametrize('values', [
    {}, {'world_frame': 'map', 'body_frame': 'top', 'imu.frame_id': 'a/much/longer/frame'}])
def test_every_stream_sends_a_message_of_its_type_with_the_frames_of_the_parameters(values):
    simulation = Simulation(parameters.checked(values))
    states, start = simulation.state(), range(1)
    epoch_ns = 1_700_000_000 * SECOND + 5
    frames = parameters.checked(values)
    expected = {'pose': frames['world_frame'], 'joint_states': '',
                'ground_truth/odom': frames['world_frame'], 'imu/data_raw': frames['imu.frame_id'],
                'imu/data': frames['imu.frame_id'], 'ground_truth/imu': frames['imu.frame_id'],
                'ground_truth/imu_bias': frames['imu.frame_id']}
    seen = set()
    for stream in simulation.streams:
        data = stream.encode(states, epoch_ns, start).tobytes()
        message = deserialize_message(data, message_class(stream.type_name))
        assert_same(data, message)
        seen.add(stream.topic)
        if stream.topic in expected:
            assert message.header.frame_id == expected[stream.topic], stream.topic
            assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 5)
        if stream.topic == 'ground_truth/odom':
            assert message.child_frame_id == frames['body_frame']
    assert set(expected) <= seen


NOISE = {'imu.gyroscope_noise_density': 1e-3, 'imu.accelerometer_noise_density': 0.02,
         'imu.gyroscope_resolution': 0.01, 'imu.accelerometer_resolution': 0.3, 'imu.rate': 200.0,
         'imu_data.rate': 50.0}


@pytest.mark.parametrize(('values', 'reading'), [
    ({}, (1e-18, 1e-18)),
    # density^2 x rate of the IMU + resolution^2/12, of angular velocity and linear acceleration
    (NOISE, (1e-6 * 200.0 + 1e-4 / 12.0, 4e-4 * 200.0 + 0.09 / 12.0))])
def test_imu_covariances_follow_rep_145(values, reading):
    """No orientation estimate: first element -1; all others are what is known."""
    simulation = Simulation(parameters.checked(values))
    states = simulation.state()
    by_topic = {stream.topic: deserialize_message(
                    stream.encode(states, 0, range(1)).tobytes(), Imu)
                for stream in simulation.streams if stream.type_name == 'sensor_msgs/msg/Imu'}
    for topic in ('imu/data_raw', 'ground_truth/imu_bias'):
        assert by_topic[topic].orientation_covariance[0] == -1.0, topic
    for topic in ('imu/data', 'ground_truth/imu'):
        assert by_topic[topic].orientation_covariance[::4].tolist() == 3 * [1e-18], topic
        orientation = by_topic[topic].orientation
        assert math.hypot(orientation.x, orientation.y, orientation.z,
                          orientation.w) == pytest.approx(1.0, abs=1e-15)
    variances = {'imu/data_raw': reading, 'imu/data': reading, 'ground_truth/imu': (1e-18, 1e-18),
                 'ground_truth/imu_bias': (1e-18, 1e-18)}
    assert set(by_topic) == set(variances)
    for topic, message in by_topic.items():
        assert not any(message.orientation_covariance[k] for k in range(9) if k % 4), topic
        for covariance, variance in zip((message.angular_velocity_covariance,
                                         message.linear_acceleration_covariance),
                                        variances[topic], strict=True):
            assert covariance == pytest.approx(
                [variance if k % 4 == 0 else 0.0 for k in range(9)], rel=1e-12, abs=0.0), topic


@pytest.mark.parametrize('fields', [(), ((np.zeros(1),),), ((np.zeros(1),) * 3,)])
def test_a_field_that_lacks_a_column_or_has_one_too_many_is_refused(fields):
    with pytest.raises(ValueError, match='zip'):
        messages.float64_multi_array(('a', 'b')).encode(np.array([0]), *fields)
