# SPDX-License-Identifier: Apache-2.0
"""
Every CDR template against the serializer of ROS itself (rclpy, Fast DDS).

That serializer leaves padding as it finds it in memory, so bytes may differ exactly there: where
the template has a zero and a change of that byte changes no field.
"""

import random

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import (  # noqa: E402
    PoseStamped,
    Quaternion,
    QuaternionStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
)
from helpers.simulations import EPOCH_NS, SECOND, play, simulate  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.serialization import deserialize_message, serialize_message  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu, JointState, MagneticField, NavSatFix  # noqa: E402
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String  # noqa: E402

from spinning_top_sim.nodes.endpoints import message_class  # noqa: E402
from spinning_top_sim.streams import messages  # noqa: E402

STAMPS = (0, 1, SECOND - 1, SECOND, 1_700_000_000 * SECOND + 123_456_789, -1, -SECOND,
          -2 ** 31 * SECOND, (2 ** 31 - 1) * SECOND + SECOND - 1)
# What follows a string is aligned by its length: all remainders of 8.
FRAMES = (*('abcdefghi'[:length] for length in range(10)), 'θ/world', 'x' * 300)
DIAGONAL = messages.diagonal(2.5e-5, 1e-4, 0.25)


def numbers(count):
    """Return numbers that differ from slot to slot, so that no two can be mixed up."""
    dice = random.Random(count)
    return [dice.uniform(-10.0, 10.0) for _ in range(count)]


def set_stamp(stamp, stamp_ns):
    stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND)


def set_axes(part, values):
    """Set x, y, z and, of a quaternion, w."""
    for axis, value in zip('xyzw', values, strict=False):
        setattr(part, axis, value)


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


def with_header(frame, stamp_ns):
    """Yield template, its fields, and the message that it must give."""
    message, (a, b, c) = PoseStamped(), (numbers(4), numbers(3), numbers(5)[2:])
    set_axes(message.pose.position, b)
    set_axes(message.pose.orientation, a)
    yield messages.pose(frame), (b, a), message
    for orientation in (messages.UNKNOWN_ORIENTATION, messages.EXACT, DIAGONAL):
        message = Imu(orientation_covariance=orientation, angular_velocity_covariance=DIAGONAL,
                      linear_acceleration_covariance=messages.EXACT)
        set_axes(message.orientation, a)
        set_axes(message.angular_velocity, b)
        set_axes(message.linear_acceleration, c)
        has_none = orientation == messages.UNKNOWN_ORIENTATION
        message.orientation = Quaternion() if has_none else message.orientation
        yield (messages.imu(frame, orientation, DIAGONAL, messages.EXACT),
               (b, c) if has_none else (a, b, c), message)
    message = MagneticField(magnetic_field_covariance=DIAGONAL)
    set_axes(message.magnetic_field, b)
    yield messages.magnetic_field(frame), (b, DIAGONAL), message
    for child in ('', 'frame', 'a'):
        message = Odometry(child_frame_id=child)
        message.pose.covariance = message.twist.covariance = messages.diagonal(*6 * (0.0,))
        set_axes(message.pose.pose.orientation, a)
        set_axes(message.twist.twist.angular, b)
        set_axes(message.pose.pose.position, c)
        set_axes(message.twist.twist.linear, b[::-1])
        yield messages.odometry(frame, child), (c, a, b[::-1], b), message
    message = NavSatFix(latitude=b[0], longitude=b[1], altitude=b[2],
                        position_covariance=DIAGONAL, position_covariance_type=2)
    message.status.status, message.status.service = 0, 1
    yield messages.nav_sat_fix(frame), ([0], b, DIAGONAL, [2]), message
    message = TwistWithCovarianceStamped()
    message.twist.covariance = messages.diagonal(0.25, 0.25, 4.0, -1.0, -1.0, -1.0)
    set_axes(message.twist.twist.linear, b)
    yield messages.twist_with_covariance(frame, (0.25, 0.25, 4.0)), (b,), message
    message = QuaternionStamped()
    set_axes(message.quaternion, a)
    yield messages.quaternion(frame), (a,), message
    message = Vector3Stamped()
    set_axes(message.vector, b)
    yield messages.vector(frame), (b,), message


@pytest.mark.parametrize('number', range(len(FRAMES)), ids=FRAMES)
def test_a_template_is_what_ros_serializes(number):
    frame, stamp_ns = FRAMES[number], STAMPS[number % len(STAMPS)]
    for template, fields, message in with_header(frame, stamp_ns):
        message.header.frame_id = frame
        set_stamp(message.header.stamp, stamp_ns)
        assert_same(template.encode_one(stamp_ns, *fields), message)
    for count in (0, 1, 2, 3, 5):
        names, values = [f'{frame}{index}' for index in range(count)], numbers(2 * count)
        joints = JointState(name=names, position=values[:count], velocity=values[count:])
        set_stamp(joints.header.stamp, stamp_ns)
        assert_same(messages.joint_state(tuple(names)).encode_one(
            stamp_ns, values[:count], values[count:]), joints)
    labels = ('a' + frame, 'b')
    array = Float64MultiArray(data=numbers(2))
    array.layout.dim = [MultiArrayDimension(label=','.join(labels), size=2, stride=2)]
    assert_same(messages.float64_multi_array(tuple(labels)).encode_one(0, numbers(2)), array)
    clock = Clock()
    set_stamp(clock.clock, stamp_ns)
    assert_same(messages.clock().encode_one(stamp_ns), clock)
    assert_same(messages.string(frame), String(data=frame))


def test_every_stream_sends_a_message_of_its_type_with_the_frames_of_the_parameters():
    world, body, imu = 'map', 'top', 'a/much/longer/frame'
    simulation = simulate(world_frame=world, body_frame=body, imu__frame_id=imu)
    expected = {'pose': world, 'joint_states': '', 'ground_truth/odom': world,
                'ground_truth/imu_odom': world, 'gnss/fix': body, 'ground_truth/gnss/fix': body,
                'gnss/velocity': world, 'ground_truth/gnss/velocity': world, **dict.fromkeys((
                    'imu/data_raw', 'imu/data', 'ground_truth/imu', 'ground_truth/imu_bias',
                    'imu/mag', 'ground_truth/mag', 'imu/dq', 'imu/dv'), imu)}
    children, types = ({'ground_truth/odom': body, 'ground_truth/imu_odom': imu},
                       {one.topic: one.type_name for one in simulation.channels})
    types.pop('/tf')                # its package is no part of the wheels of ROS
    for topic, _, data in play(simulation, 0):
        if topic == '/tf':
            continue
        message = deserialize_message(data, message_class(types.pop(topic)))
        assert_same(data, message)
        if topic in expected:
            assert message.header.frame_id == expected.pop(topic), topic
            assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(
                EPOCH_NS, SECOND)
        if topic in children:
            assert message.child_frame_id == children[topic]
    assert not expected and not types


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
    for topic, _, data in play(simulation, 0, *expected):
        message = deserialize_message(data, Imu)
        for covariance, numbers in zip((
                message.orientation_covariance, message.angular_velocity_covariance,
                message.linear_acceleration_covariance), expected.pop(topic), strict=True):
            assert covariance == pytest.approx(numbers, rel=1e-12, abs=0.0), topic
    assert not expected
