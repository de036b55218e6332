# SPDX-License-Identifier: Apache-2.0
"""
What the running node publishes: over real DDS, seen from another process.

Truths come from outside the code under test: differences of what was published, the field's
formulas, readers of other people; or from the pipeline run in this process without ROS.
"""

import math
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import LIFETIME_S, SimNode, wait_for
from helpers.node_logs import (
    GRAVITY,
    KINDS,
    PERIODS_NS,
    SECOND,
    about_x,
    about_y,
    about_z,
    assert_clean_end,
    assert_received_from,
    assert_steps,
    commands_in,
    conjugate,
    difference,
    in_common,
    log_of,
    product,
    simulated,
    stamp_of,
    stamps_of,
    the_log,
    turned,
    xyz,
    xyzw,
)
from visualization_msgs.msg import MarkerArray

WATCHED_S = 3

RUNS = {
    'plain': {},
    'mounted': {'imu.lever_arm': [0.1, -0.05, 0.3], 'imu.rpy': [0.3, -0.2, 1.1],
               'initial.theta': 0.8, 'initial.theta_dot': 0.4, 'spin.l3': 1.2, 'spin.lz': 0.5,
               'imu.frame_id': 'sensor', 'world_frame': 'map', 'body_frame': 'wheel',
               'markers.enabled': True},
}


@pytest.fixture(scope='module')
def both_runs(peer, diagnostics, tmp_path_factory):
    """Two nodes side by side in namespaces of their own, recorded, watched, told, and ended."""
    folder = tmp_path_factory.mktemp('runs')
    runs = {}
    with (SimNode(folder, {**RUNS['plain'], 'record.enabled': True}, namespace='/plain') as one,
          SimNode(folder, {**RUNS['mounted'], 'record.enabled': True},
                  namespace='/mounted') as two):
        for node in (one, two):
            topics = {name: peer.listen(node.topic(name), kind) for name, kind in KINDS.items()}
            runs[node.namespace[1:]] = SimpleNamespace(node=node, topics=topics)
        runs['mounted'].topics['markers'] = peer.listen(two.topic('markers'), MarkerArray)
        for run in runs.values():
            for name, topic in run.topics.items():
                topic.wait(WATCHED_S * SECOND // PERIODS_NS.get(name, 50_000_000))
            for topic in run.topics.values():
                peer.stop_listening(topic)
            run.said = diagnostics.next(run.node)
        # What is said to one, after what is watched, and does not reach the other.
        peer.introduce(one, diagnostics)
        peer.send_command(one, 2.0, 1.5)
        wait_for('the command', lambda: peer.get(one, 'spin.l3', 'spin.lz') == [2.0, 1.5])
        assert peer.set_together(one, seed=99, pose__rate=50.0).successful
        assert peer.switch(one, 'set_pause', True).success
        said = diagnostics.next(two)
        assert [said[key] for key in ('state', 'commands', 'rejected commands')] == [
            'running', '0', '0']
        assert peer.get(two, 'spin.l3', 'spin.lz', 'seed', 'pose.rate') == [1.2, 0.5, 0, 100.0]
        runs['plain'].code = one.end(signal.SIGINT)
        runs['mounted'].code = two.end(signal.SIGTERM)
    for run in runs.values():
        run.log, run.metadata = log_of(the_log(run.node.folder))
    return runs


@pytest.fixture(params=RUNS)
def run(request, both_runs):
    return both_runs[request.param]


def test_consecutive_stamps_differ_by_exactly_the_period(run):
    for name in KINDS:
        stamps = stamps_of(run.topics[name])
        assert set(stamps % PERIODS_NS[name]) == {0}
        assert_steps(stamps, PERIODS_NS[name], run.said['skipped samples'])


def test_pose_is_the_zyz_quaternion_of_the_joints(run):
    """Q = Rz(precession) Ry(nutation) Rz(spin), the sign included."""
    common, (poses, joints) = in_common(run.topics['pose'], run.topics['joint_states'])
    assert len(common) > 0.9 * WATCHED_S * 100
    assert list(joints[0].name) == ['precession_joint', 'nutation_joint', 'spin_joint']
    phi, theta, psi = np.array([joint.position for joint in joints]).T
    expected = product(product(about_z(phi), about_y(theta)), about_z(psi))
    found = np.array([xyzw(pose.pose.orientation) for pose in poses])
    sign = np.sign(np.sum(expected * found, axis=1))
    assert np.abs(found - sign[:, None] * expected).max() < 1e-12
    assert abs(sign.sum()) == len(sign), 'unwrapped angles and a continuous sign go together'


@pytest.mark.parametrize(('name', 'of'), [
    ('pose', lambda m: m.pose.orientation), ('ground_truth/imu', lambda m: m.orientation),
    ('ground_truth/odom', lambda m: m.pose.pose.orientation)])
def test_quaternions_are_of_norm_one_and_continuous(run, name, of):
    found = np.array([xyzw(of(message)) for message in run.topics[name].messages()])
    assert max(abs(math.hypot(*q) - 1.0) for q in found) <= 8e-16
    found = np.array([xyzw(of(message)) for message in gapless(run, name)])
    assert (np.sum(found[1:] * found[:-1], axis=1) > 0.9).all()


def rates_by_differences(q, step):
    """Return body rates from attitudes alone: 2 conj(q) q'."""
    return 2.0 * product(conjugate(q[5:-5]), difference(q, step))[:, :3]


def gapless(run, name):
    """Return the messages of the longest run without a gap (all, unless the node skipped)."""
    breaks = np.flatnonzero(np.diff(stamps_of(run.topics[name])) != PERIODS_NS[name]) + 1
    parts = np.split(np.arange(len(run.topics[name].raw)), breaks)
    part = max(parts, key=len)
    assert len(part) > 100
    return run.topics[name].messages()[part[0]:part[-1] + 1]


def test_odometry_rates_are_the_derivative_of_its_attitude(run):
    """Tenth order: at 100 Hz and 13 rad/s it is off by some 1e-11 rad/s."""
    messages = gapless(run, 'ground_truth/odom')
    q = np.array([xyzw(m.pose.pose.orientation) for m in messages])
    rates = np.array([xyz(m.twist.twist.angular) for m in messages])
    assert np.abs(rates_by_differences(q, 0.01) - rates[5:-5]).max() < 1e-6
    assert np.ptp(rates, axis=0).max() > 0.1
    resting = {xyz(m.twist.twist.linear) + xyz(m.pose.pose.position) for m in messages}
    assert resting == {6 * (0.0,)}


def test_imu_rates_are_the_derivative_of_its_attitude(run):
    messages = gapless(run, 'ground_truth/imu')
    q = np.array([xyzw(m.orientation) for m in messages])
    rates = np.array([xyz(m.angular_velocity) for m in messages])
    assert np.abs(rates_by_differences(q, 0.005) - rates[5:-5]).max() < 1e-6


def test_joint_velocities_are_the_derivatives_of_the_positions(run):
    messages = gapless(run, 'joint_states')
    positions = np.array([m.position for m in messages])
    velocities = np.array([m.velocity for m in messages])
    assert np.abs(difference(positions, 0.01) - velocities[5:-5]).max() < 1e-6
    assert np.abs(np.diff(positions, axis=0)).max() < 1.0, 'unwrapped'


def test_the_accelerometer_at_the_pivot_reads_gravity(both_runs):
    """REP-145: +g along the vertical, whatever the motion, for nothing accelerates there."""
    messages = both_runs['plain'].topics['ground_truth/imu'].messages()
    q = np.array([xyzw(m.orientation) for m in messages])
    vertical = turned(conjugate(q), np.tile([0.0, 0.0, 1.0], (len(q), 1)))
    found = np.array([xyz(m.linear_acceleration) for m in messages])
    assert np.abs(found - GRAVITY * vertical).max() < 1e-13


def test_the_accelerometer_on_the_body_reads_the_acceleration_of_its_place(both_runs):
    """Second differences of where the sensor is, plus gravity, in the sensor's frame."""
    run = both_runs['mounted']
    messages = gapless(run, 'ground_truth/imu')
    q_sensor = np.array([xyzw(m.orientation) for m in messages])
    roll, pitch, yaw = (np.array(angle) for angle in RUNS['mounted']['imu.rpy'])
    mounting = product(product(about_z(yaw), about_y(pitch)), about_x(roll))
    q_body = product(q_sensor, conjugate(np.tile(mounting, (len(q_sensor), 1))))
    arm = np.tile(RUNS['mounted']['imu.lever_arm'], (len(q_body), 1))
    force = difference(turned(q_body, arm), 0.005, order=2) + np.array([0.0, 0.0, GRAVITY])
    expected = turned(conjugate(q_sensor[5:-5]), force)
    found = np.array([xyz(m.linear_acceleration) for m in messages])[5:-5]
    assert np.abs(found - expected).max() < 1e-6
    assert np.abs(np.linalg.norm(found, axis=1) - GRAVITY).max() > 1.0


def test_the_attitude_of_the_mounted_sensor_is_that_of_the_body_and_the_mounting(both_runs):
    run = both_runs['mounted']
    common, (imus, poses) = in_common(run.topics['ground_truth/imu'], run.topics['pose'])
    roll, pitch, yaw = (np.array(angle) for angle in RUNS['mounted']['imu.rpy'])
    mounting = product(product(about_z(yaw), about_y(pitch)), about_x(roll))
    expected = product(np.array([xyzw(p.pose.orientation) for p in poses]),
                       np.tile(mounting, (len(common), 1)))
    assert np.abs(np.array([xyzw(m.orientation) for m in imus]) - expected).max() < 1e-15


def test_a_perfect_sensor_reads_the_truth(run):
    common, (raw, truth) = in_common(run.topics['imu/data_raw'], run.topics['ground_truth/imu'])
    assert len(common) > 0.9 * WATCHED_S * 200
    for mine, other in zip(raw, truth, strict=True):
        assert xyz(mine.angular_velocity) == xyz(other.angular_velocity)
        assert xyz(mine.linear_acceleration) == xyz(other.linear_acceleration)
        assert mine.orientation_covariance[0] == -1.0
    bias = run.topics['ground_truth/imu_bias'].last()
    assert xyz(bias.angular_velocity) + xyz(bias.linear_acceleration) == 6 * (0.0,)


def test_frames_are_those_of_the_parameters(both_runs):
    for name, sensor, world, body in (('plain', 'imu_link', 'world', 'base_link'),
                                      ('mounted', 'sensor', 'map', 'wheel')):
        topics = both_runs[name].topics
        assert {m.header.frame_id for m in topics['pose'].messages()} == {world}
        assert {m.header.frame_id for m in topics['imu/data_raw'].messages()} == {sensor}
        odometry = topics['ground_truth/odom'].last()
        assert (odometry.header.frame_id, odometry.child_frame_id) == (world, body)


def test_the_log_is_what_the_subscribers_got(run):
    """The same bytes, in order, with nothing missing between the first and the last."""
    for name, topic in run.topics.items():
        logged = [data for _, data in run.log[run.node.topic(name)]]
        if name in KINDS:
            assert [stamp for stamp, _ in run.log[run.node.topic(name)]] == [
                stamp_of(data) for data in logged]
        first = logged.index(topic.raw[0])
        if int(run.said['skipped samples']) == 0:
            assert logged[first:first + len(topic.raw)] == topic.raw, name
        else:
            assert_received_from(topic.raw, logged)


def test_the_log_is_the_run_computed_offline(run):
    """Bit for bit, stamps included: from the metadata in the log alone."""
    until = max(time for rows in run.log.values() for time, _ in rows)
    epoch = int(run.metadata['spinning_top_sim']['epoch_ns'])
    expected = simulated(run.log, run.metadata, until - epoch)
    for stream in (*KINDS, '~/invariants', *(['markers'] if 'markers' in run.topics else [])):
        rows = run.log[run.node.topic(stream)]
        assert len(rows) > 0
        assert rows == expected[stream][:len(rows)], stream
        assert len(rows) >= len(expected[stream]) - 1, stream
    assert len(commands_in(run.log)) == (run.node.namespace == '/plain')


def test_the_log_begins_at_the_first_sample_and_is_on_the_grid(run):
    epoch = int(run.metadata['spinning_top_sim']['epoch_ns'])
    for name, period in PERIODS_NS.items():
        times = np.array([time for time, _ in run.log[run.node.topic(name)]])
        assert times[0] == epoch
        watched = times[times < epoch + WATCHED_S * SECOND]
        assert set(np.diff(watched)) == {period}


def test_every_message_of_a_log_is_near_the_date(run):
    """A log that begins in 1970 is 56 years long to whoever plays it."""
    begin = min(time for rows in run.log.values() for time, _ in rows)
    end = max(time for rows in run.log.values() for time, _ in rows)
    assert 0 <= end - begin < LIFETIME_S * SECOND
    assert abs(begin - time.time_ns()) < 3600 * SECOND


def test_two_nodes_in_two_namespaces_do_not_disturb_each_other(both_runs):
    for name, other in (('plain', 'mounted'), ('mounted', 'plain')):
        topics = both_runs[name].log
        assert all(topic.startswith(f'/{name}/') for topic in topics), topics
        got = {bytes(data) for topic in both_runs[name].topics.values() for data in topic.raw}
        assert not got & {data for rows in both_runs[other].log.values() for _, data in rows}


def test_markers_are_in_the_world_frame_with_the_whole_trace(both_runs):
    for message in both_runs['mounted'].topics['markers'].messages():
        assert [marker.header.frame_id for marker in message.markers] == 3 * ['map']
        assert len(message.markers[2].points) == 201


def test_sigint_and_sigterm_end_a_node_properly(run):
    assert_clean_end(run.node, run.code)
