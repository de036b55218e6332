# SPDX-License-Identifier: Apache-2.0
"""The services of the running node, remapping, and clocks."""

import math
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import DrivenClock, SimNode, wait_for
from helpers.node_logs import (
    PERIODS_NS,
    QUIET,
    SECOND,
    assert_clean_end,
    assert_received_from,
    assert_steps,
    by_parameters,
    decoded,
    log_of,
    settled,
    stamp_of,
    stamps_of,
    the_log,
)
from helpers.simulations import record
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.simulation import Simulation


@pytest.fixture(scope='module')
def served(peer, tmp_path_factory):
    folder = tmp_path_factory.mktemp('served')
    with SimNode(folder, QUIET, namespace='/served') as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(3)
        yield SimpleNamespace(node=node, pose=pose)
        assert_clean_end(node, node.end())


def test_a_pause_is_a_pause_and_a_resume_catches_nothing_up(peer, diagnostics, served):
    node, pose = served.node, served.pose
    for _ in range(2):                                              # idempotent
        answer = peer.switch(node, 'set_pause', True)
        assert answer.success
        assert 'paused at t = ' in answer.message
    paused_at = answer.message
    count = settled(pose)
    last = stamp_of(pose.raw[-1])
    diagnostics.next(node)                                          # a second and more passes
    assert len(pose.raw) == count
    assert peer.switch(node, 'set_pause', True).message == paused_at
    for _ in range(2):
        begun = time.monotonic_ns()
        assert peer.switch(node, 'set_pause', False).success
    pose.wait(count + 30)
    passed = time.monotonic_ns() - begun
    stamps = stamps_of(pose)[count - 1:]
    assert stamps[30] - last <= passed + SECOND // 2, 'no burst'
    # The grid goes on where it stopped.
    assert stamps[0] == last
    assert_steps(stamps, PERIODS_NS['pose'], diagnostics.next(node)['skipped samples'])


def time_in(answer):
    """Return the simulated time that a service has answered [ns]."""
    seconds, nanoseconds = re.search(r'at t = (\d+)\.(\d{9}) s', answer.message).groups()
    return int(seconds) * SECOND + int(nanoseconds)


def test_a_step_is_a_step(peer, diagnostics, served):
    node, pose = served.node, served.pose
    answer = peer.trigger(node, 'step')
    assert not answer.success
    assert 'paused' in answer.message
    paused_at = time_in(peer.switch(node, 'set_pause', True))
    assert peer.set_together(node, step__count=7, step__dt=0.03).successful
    count = settled(pose)
    for turn in range(1, 4):
        answer = peer.trigger(node, 'step')
        assert answer.success
        assert time_in(answer) == paused_at + turn * 210_000_000
        pose.wait(count + 21 * turn)
    assert settled(pose) == count + 63
    assert set(np.diff(stamps_of(pose)[count - 1:])) == {PERIODS_NS['pose']}
    assert peer.switch(node, 'set_pause', False).success
    stamps = stamps_of(pose.wait(count + 70))[count - 1:]
    assert_steps(stamps, PERIODS_NS['pose'], diagnostics.next(node)['skipped samples'])


def test_an_endless_step_leaves_the_node_to_others(peer, served):
    """A million steps of 1000 s: the answer says how far it came, and services live."""
    node = served.node
    paused_at = time_in(peer.switch(node, 'set_pause', True)) / 1e9
    assert peer.set_together(node, step__count=1_000_000, step__dt=1000.0).successful
    answer = peer.trigger(node, 'step')
    assert not answer.success
    left = float(re.search(r'takes too long, (\S+) s are left', answer.message)[1])
    assert time_in(answer) / 1e9 + left == pytest.approx(paused_at + 1e9, abs=2.0)     # 9 digits
    assert peer.set_together(node, step__count=1, step__dt=0.01).successful
    assert peer.trigger(node, 'reset').success
    assert peer.switch(node, 'set_pause', False).success
    served.pose.wait_more(5)


def test_a_reset_begins_again_and_stamps_go_on(peer, served):
    node, pose = served.node, served.pose
    by_parameters(peer, node, 0.9, 0.2)
    pose.wait_more(10)
    count = len(pose.raw)
    answer = peer.trigger(node, 'reset')
    assert answer.success
    epoch = int(answer.message.split()[-2])
    wait_for('samples after it', lambda: stamp_of(pose.raw[-1]) > epoch + SECOND // 4)
    stamps = stamps_of(pose)
    assert (np.diff(stamps) > 0).all()
    (first,) = np.flatnonzero(stamps == epoch)
    assert first >= count
    offline = Simulation(parameters.checked({}), epoch)
    taken = record(offline, 'pose')
    offline.advance(int(stamps[-1]) - epoch)
    expected = {epoch + t_ns: data for _, t_ns, data in taken}
    assert all(expected[stamp] == data
               for stamp, data in zip(stamps[first:], pose.raw[first:len(stamps)], strict=True))
    assert peer.get(node, 'spin.l3', 'spin.lz') == [1.6, 1.6 * math.cos(math.radians(30.0))]


def test_recordings_start_and_stop_and_overwrite_nothing(peer, diagnostics, served):
    node, pose = served.node, served.pose
    uri = node.folder / 'take.mcap'
    assert peer.set_together(node, record__uri=str(uri)).successful
    answer = peer.switch(node, 'record', True)
    assert answer.success, answer.message
    assert str(uri) in answer.message
    assert 'already' in peer.switch(node, 'record', True).message
    pose.wait_more(50)
    assert diagnostics.next(node)['recorder'] == 'recording'
    answer = peer.switch(node, 'record', False)
    assert answer.success
    assert str(uri) in answer.message
    counts = decoded(uri)
    assert f'{sum(counts.values())} messages' in answer.message
    assert counts[node.topic('pose')] >= 50
    assert counts[node.topic('imu/data_raw')] >= 100
    before = uri.read_bytes()
    answer = peer.switch(node, 'record', True)
    assert not answer.success
    assert 'exists' in answer.message
    assert uri.read_bytes() == before
    assert peer.switch(node, 'record', False).message == 'not recording'
    log, _ = log_of(uri)
    logged = [data for _, data in log[node.topic('pose')]]
    wait_for('the last that was recorded', lambda: logged[-1] in pose.raw)
    assert_received_from([data for data in pose.raw
                          if stamp_of(logged[0]) <= stamp_of(data) <= stamp_of(logged[-1])],
                         logged)
    nowhere = node.folder / 'nowhere' / 'x.mcap'
    assert peer.set_together(node, record__uri=str(nowhere)).successful
    answer = peer.switch(node, 'record', True)
    assert not answer.success
    assert str(nowhere) in answer.message
    # Who asks need not know where the node runs.
    assert peer.set_together(node, record__uri='here.mcap').successful
    assert str(node.folder / 'here.mcap') in peer.switch(node, 'record', True).message
    assert peer.switch(node, 'record', False).success
    # A folder takes any number, each under a name of its own.
    assert peer.set_together(node, record__uri=str(node.folder)).successful
    paths = set()
    for _ in range(3):
        assert peer.switch(node, 'record', True).success
        pose.wait_more(2)
        paths.add(peer.switch(node, 'record', False).message.split(': ')[0])
    assert len(paths) == 3
    assert all(decoded(path) for path in paths)


# ------------------------------------------------------------------------------- remaps, clock

def test_remapping_and_qos_overrides_work(peer, tmp_path):
    arguments = ['-r', 'pose:=attitude', '-p',
                 'qos_overrides./ns/attitude.publisher.reliability:=best_effort', '-p',
                 'qos_overrides./ns/imu/data_raw.publisher.depth:=3']
    with SimNode(tmp_path, {**QUIET, 'record.enabled': True}, namespace='/ns',
                 arguments=arguments) as node:
        topic = peer.listen('/ns/attitude', PoseStamped, ReliabilityPolicy.BEST_EFFORT).wait(10)
        imu = peer.listen('/ns/imu/data_raw', Imu).wait(10)
        (found,) = peer.node.get_publishers_info_by_topic('/ns/attitude')
        assert found.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        (other,) = peer.node.get_publishers_info_by_topic('/ns/imu/data_raw')
        assert other.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert peer.node.get_publishers_info_by_topic('/ns/pose') == []
        assert_clean_end(node, node.end())
        for one in (topic, imu):
            peer.stop_listening(one)
    with AnyReader([the_log(node.folder)]) as reader:
        offered = {connection.topic: connection.ext.offered_qos_profiles[0]
                   for connection in reader.connections if '/ns/' in connection.topic
                   and connection.ext.offered_qos_profiles}
    assert offered['/ns/attitude'].reliability.value == 2
    assert offered['/ns/imu/data_raw'].depth == 3


def test_a_subscription_with_another_qos_is_warned_about(peer, tmp_path):
    with SimNode(tmp_path, QUIET) as node:
        topic = node.topic('pose')
        subscription = peer.node.create_subscription(
            PoseStamped, topic, lambda _: None, QoSProfile(
                depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        wait_for('a warning of the QoS', lambda: 'incompatible QoS' in node.err + node.out)
        assert "on topic 'pose'" in node.err + node.out
        assert_clean_end(node, node.end())
        assert subscription.topic_name == topic


def test_a_dump_of_the_parameters_makes_the_same_run(peer, tmp_path):
    """With lz unset, lists, integers, noise, and what was changed meanwhile."""
    given = {'duration': 2.0, 'record.enabled': True, 'seed': 7, 'pose.rate': 37.5,
             'imu.gyroscope_noise_density': 1e-3, 'imu.lever_arm': [0.1, 0.0, 0.02],
             'imu.frame_id': 'sensor', 'ground_truth_odom.enabled': False,
             'record.streams': ['pose', 'imu', 'joint_states'], 'solver.rtol': 1e-9,
             'initial.theta': 0.7, 'start_paused': True}
    with SimNode(tmp_path / 'first', given, namespace='/dumped') as first:
        assert peer.set_together(first, solver__rtol=1e-10, seed=8).successful
        assert peer.trigger(first, 'reset').success
        dumped = peer.dump(first)
        assert peer.switch(first, 'set_pause', False).success
        assert_clean_end(first, first.wait())
    file = tmp_path / 'dump.yaml'
    file.write_text(dumped)
    with SimNode(tmp_path / 'second', namespace='/dumped',
                 arguments=['--params-file', str(file)]) as second:
        assert peer.dump(second) == dumped
        assert peer.switch(second, 'set_pause', False).success
        assert_clean_end(second, second.wait())
    logs = []
    for node in (first, second):
        log, metadata = log_of(the_log(node.folder))
        epoch = int(metadata['spinning_top_sim']['epoch_ns'])
        logs.append({topic: [(time - epoch, data[:4] + data[12:]) for time, data in rows]
                     for topic, rows in log.items() if not topic.endswith(('events', 'commands'))})
    assert set(logs[0]) == {f'/dumped/{name}' for name in (
        'pose', 'imu/data_raw', 'ground_truth/imu_bias', 'joint_states')}
    for topic, rows in logs[0].items():
        times = [time - rows[0][0] for time, _ in rows]
        assert times == [time - logs[1][topic][0][0] for time, _ in logs[1][topic]]
        assert [data for _, data in rows] == [data for _, data in logs[1][topic]], topic
    assert len(logs[0]['/dumped/imu/data_raw']) == 401


def test_a_follower_moves_with_the_clock_of_another_node(peer, diagnostics, tmp_path):
    """One node drives /clock at twice real time; the other's stamps are of that clock."""
    with (SimNode(tmp_path, {**QUIET, 'use_sim_time': True, 'record.enabled': True},
                  namespace='/follower') as follower):
        pose = peer.listen(follower.topic('pose'), PoseStamped)
        answer = peer.trigger(follower, 'reset')
        assert not answer.success, 'there is no /clock yet'
        assert 'clock' in answer.message
        assert pose.raw == []
        with SimNode(tmp_path, {**QUIET, 'publish_clock': True, 'time_scale': 2.0},
                     namespace='/lead') as lead:
            clock = peer.listen('/clock', Clock)
            pose.wait(200)
            clock.wait(100)         # found later by this process, perhaps, than by the follower
            assert set(stamps_of(pose) % PERIODS_NS['pose']) == {0}
            assert peer.switch(lead, 'set_pause', True).success
            settled(clock)
            count = settled(pose)
            driven = [m.clock.sec * SECOND + m.clock.nanosec for m in clock.messages()]
            assert_steps(driven, 10_000_000, diagnostics.next(lead)['skipped samples'])
            # It has gone as far as the clock has, to the last point of its grid.
            assert stamp_of(pose.raw[-1]) <= driven[-1] < stamp_of(pose.raw[-1]) + SECOND // 2
            assert peer.switch(lead, 'set_pause', False).success
            stamps = stamps_of(pose.wait(count + 50))
            assert_steps(stamps, PERIODS_NS['pose'],
                         diagnostics.next(follower)['skipped samples'])
            assert_clean_end(lead, lead.end())
        assert_clean_end(follower, follower.end())
        for one in (pose, clock):
            peer.stop_listening(one)
    log, metadata = log_of(the_log(follower.folder))
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    times = [time for time, _ in log['/follower/pose']]
    assert times[0] == epoch > SECOND * 1_000_000_000
    assert set(np.diff(times)) == {PERIODS_NS['pose']}


def test_a_clock_that_steps_back_is_told_and_the_motion_goes_on(peer, tmp_path):
    """As when a log is played in a loop."""
    clock = DrivenClock(peer, 500 * SECOND)
    with SimNode(tmp_path, {**QUIET, 'use_sim_time': True}, namespace='/looped') as node:
        pose = peer.listen(node.topic('pose'), PoseStamped)
        clock.drive('samples', lambda: len(pose.raw) > 100)
        count = len(pose.raw)
        clock.now_ns = 100 * SECOND
        clock.drive('samples', lambda: len(pose.raw) > count + 100)
        stamps = stamps_of(pose)
        assert (np.diff(stamps) > 0).all()
        assert stamps[0] >= 500 * SECOND
        wait_for('a warning', lambda: '/clock stepped back by 40' in node.err)
        peer.stop_listening(pose)
        assert_clean_end(node, node.end())
    clock.stop()


def test_two_sources_of_time_do_not_lock_each_other(peer, tmp_path):
    """use_sim_time on the node that publishes /clock: it drives, it does not wait for itself."""
    with SimNode(tmp_path, {**QUIET, 'use_sim_time': True, 'publish_clock': True}) as node:
        clock = peer.listen('/clock', Clock).wait(30)
        assert clock.last().clock.sec > 1_000_000_000
        assert_clean_end(node, node.end())
        peer.stop_listening(clock)
