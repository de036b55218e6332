# SPDX-License-Identifier: Apache-2.0
"""Commands and parameters of the running node: what they do."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    GRAVITY,
    QUIET,
    SECOND,
    assert_clean_end,
    by_parameters,
    by_topic_command,
    commands_in,
    log_of,
    simulated,
    stamps_of,
    the_log,
    xyzw,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from spinning_top_sim.streams import parameters

PERIOD_NS = 2_000_000
LAMBDA1 = 0.123
TORQUE = 2.0 * 0.15 * GRAVITY
LAMBDA3 = parameters.checked({})['top.lambda3']


def listen_to_motion(peer, node):
    kinds = {'joint_states': JointState, 'ground_truth/odom': Odometry, 'pose': PoseStamped,
             '~/invariants': Float64MultiArray}
    topics = {name: peer.listen(node.topic(name), kind) for name, kind in kinds.items()}
    for topic in topics.values():
        topic.wait(3)
    return topics


def euler(start, l3, lz, span):
    """Follow (phi, theta, psi, theta') by eqs. (29)-(32) with classical Runge-Kutta."""
    def rates(y):
        _, theta, _, theta_dot = y
        sine, cosine = math.sin(theta), math.cos(theta)
        phi_dot = (lz - l3 * cosine) / (LAMBDA1 * sine * sine)
        bend = sine / LAMBDA1 * (LAMBDA1 * phi_dot * phi_dot * cosine - l3 * phi_dot + TORQUE)
        return np.array([phi_dot, theta_dot, l3 / LAMBDA3 - phi_dot * cosine, bend])

    fastest = max(abs(rates(start)[0]), 100.0)
    steps = min(1000, max(1, math.ceil(span * fastest / 0.01)))
    h, y = span / steps, start
    for _ in range(steps):
        k1 = rates(y)
        k2 = rates(y + 0.5 * h * k1)
        k3 = rates(y + 0.5 * h * k2)
        k4 = rates(y + h * k3)
        y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return y


@pytest.fixture(scope='module')
def commanded(peer, diagnostics, tmp_path_factory):
    """A node that takes commands; sampled at 500 Hz, so that a jump would show."""
    folder = tmp_path_factory.mktemp('commanded')
    rates = {f'{name}.rate': 500.0 for name in ('joint_states', 'ground_truth_odom', 'pose',
                                                'invariants')}
    with SimNode(folder, {**QUIET, **rates, 'tick_rate': 100.0, 'record.enabled': True}) as node:
        topics = listen_to_motion(peer, node)
        peer.introduce(node, diagnostics)
        yield SimpleNamespace(node=node, topics=topics)
        assert_clean_end(node, node.end())
        # All that was commanded, computed again in this process, is what was recorded.
        log, metadata = log_of(the_log(node.folder))
        until = max(time for rows in log.values() for time, _ in rows)
        expected = simulated(log, metadata, until - int(metadata['spinning_top_sim']['epoch_ns']))
        for stream in ('pose', 'joint_states', 'ground_truth/odom', '~/invariants'):
            rows = log[node.topic(stream)]
            assert rows == expected[stream][:len(rows)]
        assert len(commands_in(log)) > 3


@pytest.fixture
def motion(commanded):
    """The listened-to node, with only what comes from now on."""
    for topic in commanded.topics.values():
        del topic.raw[:]
        topic.muted = False
        topic.wait(50)
    return commanded


def l3_of(messages):
    return np.array([m.twist.twist.angular.z * LAMBDA3 for m in messages])


@pytest.mark.parametrize(('command', 'l3', 'lz'), [
    (by_topic_command, 1.25, 0.75), (by_parameters, 2.0, -0.5), (by_parameters, 1, 0),
    (by_topic_command, 1.6, 1.3856)])
def test_a_command_sets_the_momenta_and_nothing_jumps(peer, motion, command, l3, lz):
    """
    An impulsive torque: attitude and nutation rate go on, L3 and Lz are the commanded ones.

    No motion here has L3 = +-Lz, which leads over a pole: next to it, the angles of the one that
    follows turn too fast to be told from two samples.
    """
    topics = motion.topics
    command(peer, motion.node, l3, lz)
    odometry = topics['ground_truth/odom']
    wait_for('the new momentum', lambda: abs(l3_of([odometry.last()])[0] - l3) < 1e-9)
    for topic in topics.values():
        topic.wait_more(50)
    # Omega3 = L3/lambda3 has one jump, from the one exactly to the other.
    momentum = l3_of(odometry.messages())
    jump = int(np.argmax(np.abs(momentum - momentum[0]) > 1e-9))
    assert jump >= 40
    assert np.abs(momentum[:jump] - momentum[0]).max() < 1e-12
    assert np.abs(momentum[jump:] - l3).max() < 1e-12
    at = stamps_of(odometry)[jump]
    # L3 and Lz as the node itself reports them.
    invariants = np.array([m.data for m in topics['~/invariants'].messages()])
    assert np.abs(invariants[-1, 1:3] - (l3, lz)).max() < 1e-11
    # Between the samples around it there is an instant at which momenta jumped, and nothing else.
    for topic in topics.values():
        peer.stop_listening(topic)
    joints = topics['joint_states'].messages()
    position = np.array([m.position for m in joints])
    velocity = np.array([m.velocity for m in joints])
    stamps = np.array([SECOND * m.header.stamp.sec + m.header.stamp.nanosec for m in joints])
    omega3 = velocity[:, 2] + velocity[:, 0] * np.cos(position[:, 1])
    first = int(np.argmax(np.abs(LAMBDA3 * omega3 - l3) < 1e-9))
    assert first >= 40
    phi, theta, psi = position[first - 1]
    lz_before = (LAMBDA1 * velocity[first - 1, 0] * math.sin(theta) ** 2
                 + momentum[0] * math.cos(theta))
    before = np.array([phi, theta, psi, velocity[first - 1, 1]])
    after = np.array([*position[first], velocity[first, 1]])
    span = (stamps[first] - stamps[first - 1]) / SECOND

    def off(share):
        there = euler(before, momentum[0], lz_before, share * span)
        return np.abs(euler(there, l3, lz, (1.0 - share) * span) - after).max()

    low, high = 0.0, 1.0
    for _ in range(9):
        shares = np.linspace(low, high, 21)
        best = int(np.argmin([off(share) for share in shares]))
        low, high = shares[max(best - 1, 0)], shares[min(best + 1, 20)]
    assert off(0.5 * (low + high)) < 1e-7
    # phi' right after follows eq. (31) with the commanded momenta.
    after = int(np.argmax(stamps_of(topics['joint_states']) >= at))
    theta = position[after:, 1]
    expected = (lz - l3 * np.cos(theta)) / (LAMBDA1 * np.sin(theta) ** 2)
    assert np.abs(velocity[after:, 0] - expected).max() < 1e-8
    assert np.abs(velocity[after:, 2] - (l3 / LAMBDA3 - expected * np.cos(theta))).max() < 1e-8
    q = np.array([xyzw(m.pose.orientation) for m in topics['pose'].messages()])
    near = np.diff(stamps_of(topics['pose'])) == PERIOD_NS
    assert (np.sum(q[1:] * q[:-1], axis=1) > 0.99)[near].all()
    assert peer.get(motion.node, 'spin.l3', 'spin.lz') == [l3, lz]


def test_an_integer_is_taken_for_a_double(peer, motion):
    assert all(result.successful for result in
               peer.set_each(motion.node, spin__l3=2, pose__rate=250))
    assert peer.get(motion.node, 'spin.l3', 'pose.rate') == [2.0, 250.0]
    pose = motion.topics['pose']
    # On the grid of the new rate from its first point on: after 2 ms or, on the old one's, 4 ms.
    # Multiples of it where the machine has held the node up.
    pose.wait_more(100)
    wait_for('fifty at the new rate', lambda: not (
        np.diff(stamps_of(pose)[-51:]) % (2 * PERIOD_NS)).any())
    steps = np.diff(stamps_of(pose))
    assert (steps % PERIOD_NS == 0).all()
    assert steps[-50:].min() == 2 * PERIOD_NS
    assert peer.set_each(motion.node, pose__rate=500.0)[0].successful
