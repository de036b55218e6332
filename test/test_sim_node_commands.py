# SPDX-License-Identifier: Apache-2.0
"""Commands and parameters of the running node: what they do."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from node_harness import SimNode, wait_for
from node_logs import (
    GRAVITY,
    QUIET,
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
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from spinning_top_sim.streams import parameters

PERIOD_NS = 2_000_000
LAMBDA3 = parameters.defaults()['top.lambda3']


def listen_to_motion(peer, node):
    kinds = {'joint_states': JointState, 'ground_truth/odom': Odometry, 'pose': PoseStamped,
             '~/invariants': Float64MultiArray}
    topics = {name: peer.listen(node.topic(name), kind) for name, kind in kinds.items()}
    for topic in topics.values():
        topic.wait(3)
    return topics


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


def l3_of(topic):
    return np.array([m.twist.twist.angular.z * LAMBDA3 for m in topic.messages()])


@pytest.mark.parametrize(('command', 'l3', 'lz'), [
    (by_topic_command, 1.25, 0.75), (by_parameters, 2.0, -0.5), (by_parameters, 1, 1),
    (by_topic_command, 1.6, 1.3856)])
def test_a_command_sets_the_momenta_and_nothing_jumps(peer, motion, command, l3, lz):
    """An impulsive torque: attitude and nutation rate go on, L3 and Lz are the commanded ones."""
    topics = motion.topics
    command(peer, motion.node, l3, lz)
    wait_for('the new momentum', lambda: abs(l3_of(topics['ground_truth/odom'])[-1] - l3) < 1e-9)
    for topic in topics.values():
        topic.wait_more(50)
    # Omega3 = L3/lambda3 has one jump, from the one exactly to the other.
    momentum = l3_of(topics['ground_truth/odom'])
    jump = int(np.argmax(np.abs(momentum - momentum[0]) > 1e-9))
    assert jump >= 40
    assert np.abs(momentum[:jump] - momentum[0]).max() < 1e-12
    assert np.abs(momentum[jump:] - l3).max() < 1e-12
    at = stamps_of(topics['ground_truth/odom'])[jump]
    # L3 and Lz as the node itself reports them.
    invariants = np.array([m.data for m in topics['~/invariants'].messages()])
    assert np.abs(invariants[-1, 1:3] - (l3, lz)).max() < 1e-11
    # Joints: no further in a period than what rates allow, with those between the samples.
    for topic in topics.values():
        peer.stop_listening(topic)
    joints = topics['joint_states'].messages()
    position = np.array([m.position for m in joints])
    velocity = np.array([m.velocity for m in joints])
    near = np.diff(stamps_of(topics['joint_states'])) == PERIOD_NS
    assert near.sum() > 50
    moved = np.abs(np.diff(position, axis=0))
    fastest = np.maximum(np.abs(velocity[1:]), np.abs(velocity[:-1]))
    bent = np.abs(np.diff(velocity, axis=0))
    assert (moved <= 0.002 * (2.0 * (fastest + bent) + 1.0))[near].all()
    # theta' goes on: between two samples it changes by what eq. (30) says at both, no more.
    phi_dot, theta = velocity[:, 0], position[:, 1]
    lambda1, torque = 0.123, 2.0 * 0.15 * GRAVITY
    omega3 = velocity[:, 2] + phi_dot * np.cos(theta)
    bend = np.sin(theta) * (phi_dot ** 2 * np.cos(theta) - LAMBDA3 / lambda1 * omega3 * phi_dot
                            + torque / lambda1)
    steepest = np.maximum(np.abs(bend[1:]), np.abs(bend[:-1]))
    assert (np.abs(np.diff(velocity[:, 1])) <= 0.002 * (1.1 * steepest + 1.0))[near].all()
    # phi' right after follows eq. (31) with the commanded momenta.
    after = int(np.argmax(stamps_of(topics['joint_states']) >= at))
    theta = position[after:, 1]
    expected = (lz - l3 * np.cos(theta)) / (lambda1 * np.sin(theta) ** 2)
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
    stamps = stamps_of(motion.topics['pose'].wait_more(100))
    changed = int(np.argmax(np.diff(stamps) == 4_000_000))
    wait_for('fifty at the new rate', lambda: len(motion.topics['pose'].raw) > changed + 50)
    steps = np.diff(stamps_of(motion.topics['pose']))
    # On the grid of the new rate from its first point on: after 2 ms or, on the old one's, 4 ms.
    # Multiples of it where the machine has held the node up.
    assert (steps[:changed] % PERIOD_NS == 0).all()
    assert (steps[changed:] % (2 * PERIOD_NS) == 0).all()
    assert peer.set_each(motion.node, pose__rate=500.0)[0].successful
