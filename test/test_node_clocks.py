# SPDX-License-Identifier: Apache-2.0
"""Nodes that follow a /clock, whatever it does, or the date."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import DrivenClock, SimNode, wait_for
from helpers.node_logs import (
    SECOND,
    assert_clean_end,
    events_in,
    log_of,
    stamp_of,
    the_log,
    verified,
)
from helpers.own_node import OwnNode
from rosgraph_msgs.msg import Clock

GRID_NS = 10_000_000        # of the stamps, and of pose


def test_a_node_waits_for_a_clock_follows_its_steps_and_names_its_jumps(peer, tmp_path):
    clock = DrivenClock(peer, '/other_clock', 1000 * SECOND + 3_000_000)

    def goes(step_ns):
        """Let the clock make a step, and wait until the stamps are there too."""
        clock.now_ns += step_ns
        clock.drive('the samples', step_ns=0, until=lambda: (
            0 <= clock.now_ns - stamp_of(pose.raw[-1]) < GRID_NS))

    def told(text, now_ns):
        clock.now_ns = now_ns
        clock.drive(text, lambda: text in node.err, step_ns=0)

    with SimNode(tmp_path, {
            'use_sim_time': True, 'status_period': 0.2, 'record.enabled': True,
            # With the default depth of 10, what one message makes due would reach no slow reader.
            'qos_overrides./clocked/pose.publisher.depth': 1000},
            namespace='/clocked', arguments=('-r', '/clock:=/other_clock')) as node:
        wait_for('the status line', lambda: ' s waiting | ' in node.out)
        refused = peer.set_together(node, spin__l3=2.0)     # it would send t = 0 to nobody
        assert not refused.successful and 'waiting for /clock' in refused.reason
        assert 'follows another /clock' in peer.set_together(node, clock__enabled=True).reason
        for answer in (peer.trigger(node, 'step'), peer.trigger(node, 'reset'),
                       peer.switch(node, 'record', True)):
            assert not answer.success and 'waiting for /clock' in answer.message
        pose = peer.listen(node.topic('pose'), PoseStamped)
        clock.drive('the motion', lambda: len(pose.raw) > 20)
        for step_ns in (1, 1, 2, 2):
            goes(step_ns * SECOND)
        stamps = [stamp_of(data) for data in pose.raw]
        assert set(np.diff(stamps)) == {GRID_NS}, 'every sample is published'
        for jump in (10, 985):
            told(f'/clock jumped forward by {jump} s: so do the stamps',
                 clock.now_ns + jump * SECOND)
            goes(SECOND)
        told('/clock stepped back by ', 7 * SECOND)
        goes_on_from = stamp_of(pose.raw[-1])
        clock.drive('samples', lambda: stamp_of(pose.raw[-1]) > goes_on_from)
        answer = peer.trigger(node, 'reset')
        assert int(answer.message.split()[-2]) == clock.now_ns // GRID_NS * GRID_NS
        goes(SECOND)
        wait_for('the end of the recording', lambda: 'recording stopped: stamps have' in node.err)
        pose.muted = True
        assert_clean_end(node, node.end())
    for text, count in (('/clock jumped', 2), ('stepped back', 1), ('cannot keep up', 0)):
        assert node.err.count(text) == count
    path = the_log(node.folder)
    assert verified(path)['identical']
    assert [event['event'] for event in events_in(log_of(path)[0])] == ['start', 'epoch', 'epoch']


def test_stamps_are_dates_that_have_come_after_resets_too_beside_a_clock_of_its_own(tmp_path):
    leads_ns = []
    with OwnNode(tmp_path, use_sim_time=True, clock__enabled=True).listen('pose') as node:
        heard = []
        listener = node.node.create_subscription(Clock, '/clock', heard.append, 10)
        node.heard['pose'] = SimpleNamespace(
            append=lambda data: leads_ns.append(stamp_of(data) - time.time_ns()))
        for _ in range(4):
            count = len(leads_ns)
            node.spin_until('samples', lambda count=count: len(leads_ns) > count + 5)
            assert node.trigger('reset').success
        node.spin_until('its clock', lambda: heard)
        node.node.destroy_subscription(listener)
    assert max(leads_ns) <= 0 and heard[0].clock.sec > 1_000_000_000
