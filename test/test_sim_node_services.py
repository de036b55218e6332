# SPDX-License-Identifier: Apache-2.0
"""The services and topics of running nodes, seen from another process; and /clock."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers import node_logs
from helpers.node_harness import DrivenClock, SimNode, wait_for
from helpers.node_logs import PERIODS_NS, SECOND, assert_clean_end, settled, stamp_of, stamps_of
from rosgraph_msgs.msg import Clock


@pytest.fixture(scope='module')
def served(peer, tmp_path_factory):
    """A node that publishes /clock and is told to follow it: it does not wait for itself."""
    folder = tmp_path_factory.mktemp('served')
    values = {'status_period': 0.2, 'clock.enabled': True, 'use_sim_time': True}
    with SimNode(folder, values, namespace='/served') as node:
        clock = peer.listen('/clock', Clock).wait(3)
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(3)
        assert clock.last().clock.sec > 1_000_000_000
        clock.muted = True
        yield SimpleNamespace(node=node, pose=pose)
        assert_clean_end(node, node.end())


def test_services_answer_and_act(peer, served):
    node, pose = served.node, served.pose
    assert 'paused' in peer.trigger(node, 'step').message
    paused_at = peer.switch(node, 'set_pause', True).message
    assert peer.switch(node, 'set_pause', True).message == paused_at        # idempotent
    count = settled(pose)
    assert peer.set_together(node, step__count=7, step__dt=0.03).successful
    assert peer.trigger(node, 'step').success
    pose.wait(count + 21)
    assert settled(pose) == count + 21
    assert peer.switch(node, 'set_pause', False).success
    pose.wait(count + 50)
    assert (np.diff(stamps_of(pose)) % PERIODS_NS['pose'] == 0).all(), 'one grid'
    assert peer.set_together(node, spin__l3=0.9, spin__lz=0.2).successful
    answer = peer.trigger(node, 'reset')
    epoch = int(answer.message.split()[-2])
    wait_for('samples after it', lambda: stamp_of(pose.raw[-1]) > epoch)
    stamps = stamps_of(pose)
    assert epoch in stamps and (np.diff(stamps) > 0).all()
    assert peer.get(node, 'spin.l3', 'spin.lz') == [1.6, 1.6 * math.cos(math.radians(30.0))]


def test_a_node_follows_the_clock_of_another_and_waits_for_it_aloud(peer, diagnostics, tmp_path):
    """Before the clock, with it, and when it stops."""
    clock = DrivenClock(peer, '/driven', 1_000_000_000_000)     # /clock is that of `served`

    def waits():
        status = diagnostics.wait_for(node, 'a warning', lambda s: 'waiting' in s.message)
        assert (status.level, status.message) == (b'\x01', 'waiting for /clock')
        wait_for('the status line', lambda: ' s waiting for /clock | ' in
                 node.out.splitlines()[-1])

    def is_ahead():
        assert all(stamp_of(data) <= clock.now_ns for data in pose.raw[-1:])
        return len(pose.raw) > 50

    with SimNode(tmp_path, {'use_sim_time': True, 'status_period': 0.2, 'time_scale': 2.0},
                 namespace='/follower', arguments=('-r', '/clock:=/driven')) as node:
        waits()
        refused = peer.set_together(node, spin__l3=2.0)     # it would send t = 0 to nobody
        assert not refused.successful and 'waiting for /clock' in refused.reason
        assert 'follows another /clock' in peer.set_together(node, clock__enabled=True).reason
        answer = peer.trigger(node, 'reset')
        assert not answer.success and 'clock' in answer.message
        assert 'waiting for the start at t = 0' in peer.switch(node, 'set_pause', False).message
        pose = peer.listen(node.topic('pose'), PoseStamped)
        assert peer.set_together(node, time_scale=1.0).successful
        clock.now_ns += 3_000_000           # not on the grid of the stamps
        clock.drive('the motion', is_ahead)
        # It has gone as far as the clock has, to the last point of its grid.
        settled(pose)
        assert clock.now_ns - SECOND // 2 < stamp_of(pose.raw[-1]) <= clock.now_ns
        assert set(stamps_of(pose) % PERIODS_NS['pose']) == {0}
        waits()                             # it has stopped
        assert_clean_end(node, node.end())
    assert node_logs.TRACEBACK not in node.err
    pose.muted = True
    clock.stop()
