# SPDX-License-Identifier: Apache-2.0
"""The services and topics of running nodes, seen from another process; and /clock."""

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
    SECOND,
    TRACEBACK,
    assert_clean_end,
    assert_received_from,
    assert_steps,
    by_parameters,
    decoded,
    log_of,
    settled,
    stamp_of,
    stamps_of,
)
from helpers.simulations import record
from rosgraph_msgs.msg import Clock

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation


@pytest.fixture(scope='module')
def served(peer, tmp_path_factory):
    """A node that publishes /clock and is told to follow it: it does not wait for itself."""
    folder = tmp_path_factory.mktemp('served')
    values = {'status_period': 0.2, 'publish_clock': True, 'use_sim_time': True}
    with SimNode(folder, values, namespace='/served') as node:
        clock = peer.listen('/clock', Clock).wait(3)
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(3)
        assert clock.last().clock.sec > 1_000_000_000
        peer.stop_listening(clock)
        yield SimpleNamespace(node=node, pose=pose)
        assert_clean_end(node, node.end())


def time_in(answer):
    """Return the simulated time that a service has answered [ns]."""
    seconds, nanoseconds = re.search(r'at t = (\d+)\.(\d{9}) s', answer.message).groups()
    return int(seconds) * SECOND + int(nanoseconds)


def test_a_pause_is_a_pause_and_a_resume_catches_nothing_up(peer, diagnostics, served):
    node, pose = served.node, served.pose
    paused_at = peer.switch(node, 'set_pause', True).message
    assert 'paused at t = ' in paused_at
    count = settled(pose)
    assert peer.switch(node, 'set_pause', True).message == paused_at        # idempotent
    assert len(pose.raw) == count
    begun = time.monotonic_ns()
    assert peer.switch(node, 'set_pause', False).success
    pose.wait(count + 30)
    passed = time.monotonic_ns() - begun
    stamps = stamps_of(pose)[count - 1:]
    assert stamps[30] - stamps[0] <= passed + SECOND // 2, 'no burst'
    # The grid goes on where it stopped.
    assert_steps(stamps, PERIODS_NS['pose'], diagnostics.next(node)['skipped samples'])


def test_a_step_is_a_step(peer, served):
    node, pose = served.node, served.pose
    answer = peer.trigger(node, 'step')
    assert not answer.success
    assert 'paused' in answer.message
    paused_at = time_in(peer.switch(node, 'set_pause', True))
    assert peer.set_together(node, step__count=7, step__dt=0.03).successful
    count = settled(pose)
    for turn in range(1, 3):
        answer = peer.trigger(node, 'step')
        assert answer.success
        assert time_in(answer) == paused_at + turn * 210_000_000
        pose.wait(count + 21 * turn)
    assert settled(pose) == count + 42
    assert set(np.diff(stamps_of(pose)[count - 1:])) == {PERIODS_NS['pose']}
    assert peer.switch(node, 'set_pause', False).success
    pose.wait(count + 50)


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
    offline = LiveSimulation(parameters.checked({}), epoch)
    taken = record(offline, 'pose')
    offline.advance(int(stamps[-1]) - epoch)
    expected = {epoch + t_ns: data for _, t_ns, data in taken}
    assert all(expected[stamp] == data
               for stamp, data in zip(stamps[first:], pose.raw[first:len(stamps)], strict=True))
    assert peer.get(node, 'spin.l3', 'spin.lz') == [1.6, 1.6 * math.cos(math.radians(30.0))]


def test_recordings_start_and_stop(peer, diagnostics, served):
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
    log, _ = log_of(uri)
    logged = [data for _, data in log[node.topic('pose')]]
    wait_for('the last that was recorded', lambda: logged[-1] in pose.raw)
    assert_received_from([data for data in pose.raw
                          if stamp_of(logged[0]) <= stamp_of(data) <= stamp_of(logged[-1])],
                         logged)


def test_a_recording_overwrites_nothing_and_is_made_where_the_node_runs(peer, served):
    node = served.node
    uri = node.folder / 'there.mcap'
    uri.write_bytes(b'precious')
    assert peer.set_together(node, record__uri=str(uri)).successful
    answer = peer.switch(node, 'record', True)
    assert not answer.success
    assert 'exists' in answer.message
    assert uri.read_bytes() == b'precious'
    assert peer.switch(node, 'record', False).message == 'not recording'
    # Who asks need not know where the node runs.
    assert peer.set_together(node, record__uri='here.mcap').successful
    assert str(node.folder / 'here.mcap') in peer.switch(node, 'record', True).message
    assert peer.switch(node, 'record', False).success


# ------------------------------------------------------------------------------------- /clock

def test_a_node_follows_the_clock_of_another_and_waits_for_it_aloud(peer, diagnostics, tmp_path):
    """Before the clock, with it, when it stops, and steps back."""
    clock = DrivenClock(peer, '/driven', 1_000_000_000_000)     # /clock is that of `served`

    def waits():
        status = diagnostics.wait_for(node, 'a warning', lambda s: 'waiting' in s.message)
        assert (status.level, status.message) == (b'\x01', 'waiting for /clock')
        wait_for('the status line', lambda: ' s waiting for /clock | ' in
                 node.out.splitlines()[-1])

    def is_ahead():
        assert all(stamp_of(data) <= clock.now_ns for data in pose.raw[-1:])
        return len(pose.raw) > count + 50

    with SimNode(tmp_path, {'use_sim_time': True, 'status_period': 0.2, 'time_scale': 2.0},
                 namespace='/follower', arguments=('-r', '/clock:=/driven')) as node:
        waits()
        refused = peer.set_together(node, spin__l3=2.0)     # it would send t = 0 to nobody
        assert not refused.successful and 'waiting for /clock' in refused.reason
        assert 'follows another /clock' in peer.set_together(node, clock__enabled=True).reason
        answer = peer.trigger(node, 'reset')
        assert not answer.success and 'clock' in answer.message
        pose = peer.listen(node.topic('pose'), PoseStamped)
        assert peer.set_together(node, time_scale=1.0).successful
        clock.now_ns += 3_000_000           # not on the grid of the stamps
        count = 0
        clock.drive('the motion', is_ahead)
        # It has gone as far as the clock has, to the last point of its grid.
        settled(pose)
        assert clock.now_ns - SECOND // 2 < stamp_of(pose.raw[-1]) <= clock.now_ns
        assert set(stamps_of(pose) % PERIODS_NS['pose']) == {0}
        clock.drive('no warning', lambda: 'waiting' not in diagnostics.statuses(node)[-1].message)
        waits()                             # it has stopped
        count = len(pose.raw)
        clock.drive('the motion', is_ahead)
        count = len(pose.raw)
        clock.now_ns -= 400 * SECOND        # as where a log is played in a loop
        clock.drive('samples', lambda: len(pose.raw) > count + 50)
        wait_for('a warning', lambda: re.search(r'/clock stepped back by (399|40)', node.err))
        assert (np.diff(stamps_of(pose)) > 0).all()
        assert_clean_end(node, node.end())
    assert TRACEBACK not in node.err
    peer.stop_listening(pose)
    clock.stop()
