# SPDX-License-Identifier: Apache-2.0
"""Nodes that follow a /clock, whatever it does, or the date."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import DrivenClock, SimNode, wait_for
from helpers.node_logs import (
    SECOND,
    assert_clean_end,
    events_in,
    log_of,
    stamp_of,
    stamps_of,
    the_log,
    verified,
)
from helpers.own_node import OwnNode
from rosgraph_msgs.msg import Clock

from spinning_top_sim.nodes import executable

GRID_NS = 10_000_000        # of the stamps, and of pose


def follower(tmp_path, name, executor='events', **values):
    """Return a node that follows the topic of its name."""
    return SimNode(tmp_path, {
        'use_sim_time': True, 'status_period': 0.2, **values,
        # With the default depth of 10, what one message makes due would reach no slow reader.
        f'qos_overrides./{name}/pose.publisher.depth': 1000},
        namespace=f'/{name}', arguments=('-r', f'/clock:=/{name}_clock'), executor=executor)


@pytest.mark.parametrize('executor', ['events', 'single'])
def test_a_node_waits_for_a_clock_follows_its_steps_and_names_its_jumps(
        peer, diagnostics, tmp_path, executor):
    clock = DrivenClock(peer, f'/{executor}_clock', 1000 * SECOND + 3_000_000)

    def waits():
        wait_for('the status line', lambda: any(
            ' s waiting for /clock | ' in line for line in node.out.splitlines()[-1:]))

    def goes(step_ns):
        """Let the clock make a step, and wait until the stamps are there too."""
        clock.now_ns += step_ns
        clock.drive('the samples', step_ns=0, until=lambda: (
            0 <= clock.now_ns - stamp_of(pose.raw[-1]) < GRID_NS))

    def told(text, now_ns):
        clock.now_ns = now_ns
        clock.drive(text, lambda: text in node.err, step_ns=0)

    with follower(tmp_path, executor, executor, **{'record.enabled': True}) as node:
        waits()
        status = diagnostics.wait_for(node, 'a warning', lambda s: 'waiting' in s.message)
        assert (status.level, status.message) == (b'\x01', 'waiting for /clock')
        refused = peer.set_together(node, spin__l3=2.0)     # it would send t = 0 to nobody
        assert not refused.successful and 'waiting for /clock' in refused.reason
        assert 'follows another /clock' in peer.set_together(node, clock__enabled=True).reason
        for name in ('step', 'reset'):
            answer = peer.trigger(node, name)
            assert not answer.success and 'clock' in answer.message
        assert not peer.switch(node, 'record', True).success
        pose = peer.listen(node.topic('pose'), PoseStamped)
        clock.drive('the motion', lambda: len(pose.raw) > 20)
        for step_ns in (1, 1, 2, 2):
            goes(step_ns * SECOND)
        stamps = stamps_of(pose)
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
        waits()                             # the clock has stopped
        pose.muted = True
        assert_clean_end(node, node.end())
    clock.stop()
    assert node.err.count('/clock jumped') == 2 and node.err.count('stepped back') == 1
    assert 'cannot keep up' not in node.err
    path = the_log(node.folder)
    assert verified(path)['identical']
    assert [event['event'] for event in events_in(log_of(path)[0])] == ['start', 'epoch', 'epoch']


def test_a_node_that_publishes_the_clock_does_not_wait_for_itself(peer, tmp_path):
    with SimNode(tmp_path, {'clock.enabled': True, 'use_sim_time': True}) as node:
        clock = peer.listen('/clock', Clock).wait(3)
        assert clock.last().clock.sec > 1_000_000_000
        clock.muted = True
        assert_clean_end(node, node.end())


@pytest.mark.parametrize('publishes', [True, False])
def test_what_is_no_time_on_a_clock_is_left_out_with_one_line(tmp_path, capfd, publishes):
    with OwnNode(tmp_path, use_sim_time=True, clock__enabled=publishes) as node:
        executable.guard_clock(node.node)
        (clock,) = [one for one in node.node.subscriptions if one.msg_type is Clock]
        for sec, nanosec in ((7, 0), (-1, 0), (2 ** 31 - 1, 4_000_000_000)):
            clock.callback(Clock(clock=Time(sec=sec, nanosec=nanosec)))
        assert node.node.get_clock().now().nanoseconds == 7 * SECOND
    assert capfd.readouterr().err.count('/clock is left out: the stamp -1 s: must be >= 0') == 1


def test_a_stamp_is_a_date_that_has_come_at_the_start_and_after_resets(tmp_path):
    leads_ns = []
    with OwnNode(tmp_path).listen('pose') as node:
        node.heard['pose'] = SimpleNamespace(
            append=lambda data: leads_ns.append(stamp_of(data) - time.time_ns()))
        for _ in range(6):
            count = len(leads_ns)
            node.spin_until('samples', lambda count=count: len(leads_ns) > count + 5)
            assert node.trigger('reset').success
    assert max(leads_ns) <= 0
