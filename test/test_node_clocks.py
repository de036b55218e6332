# SPDX-License-Identifier: Apache-2.0
"""A node that follows a /clock, whatever it does, or the date."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from builtin_interfaces.msg import Time as Stamp
from helpers.node_logs import SECOND, events_in, log_of, stamp_of, verified
from helpers.own_node import OwnNode
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from spinning_top_sim.nodes import executable

GRID_NS = 10_000_000        # of the stamps, and of pose


def test_a_node_waits_for_a_clock_follows_its_steps_and_names_its_jumps(tmp_path, capfd):
    with OwnNode(tmp_path, '-r', '/clock:=/other_clock', use_sim_time=True,
                 record__enabled=True).listen('pose') as node:
        clock = node.node.create_publisher(Clock, '/other_clock', 10)
        heard, said = node.heard['pose'], []

        def show(now_ns):
            """Let the clock show a time, and wait until the stamps are there."""
            clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
            node.spin_until('the samples', lambda: (
                heard and 0 <= now_ns - stamp_of(heard[-1]) < GRID_NS))

        def told(text, now_ns):
            clock.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))
            node.spin_until(text, lambda: (
                said.append(capfd.readouterr().err) or text in ''.join(said)))

        assert node.diagnostics()[:2] == (1, 'waiting for /clock (use_sim_time is set)')
        for answer in (node.trigger('step'), node.trigger('reset'), node.switch('record', True)):
            assert not answer.success and 'waiting for /clock' in answer.message
        assert 'waiting for /clock' in node.set(spin__l3=2.0).reason    # it would send t = 0
        assert 'follows another /clock' in node.set(clock__enabled=True).reason
        now_ns = 1000 * SECOND + 3_000_000
        for step in (0, 1, 1, 2, 2):
            now_ns += step * SECOND
            show(now_ns)
        assert set(np.diff([*map(stamp_of, heard)])) == {GRID_NS}, 'every sample is published'
        for jump in (10, 985.004):
            now_ns += round(jump * SECOND)
            told(f'/clock jumped forward by {jump} s: so do the stamps', now_ns)
            now_ns += SECOND
            show(now_ns)
        told('/clock stepped back by ', 7 * SECOND)
        count = len(heard)
        clock.publish(Clock(clock=Time(nanoseconds=8 * SECOND).to_msg()))
        node.spin_until('samples', lambda: len(heard) >= count + 100)
        assert stamp_of(heard[-1]) > now_ns
        answer = node.trigger('reset')
        assert int(answer.message.split()[-2]) == 8 * SECOND
        told('recording stopped: stamps have gone back', 9 * SECOND)
        show(9 * SECOND)
    assert {stamp_of(data) % GRID_NS for data in heard} == {0}
    assert ''.join(said).count('/clock jumped') == 2 and 'keep up' not in ''.join(said)
    path = tmp_path / 'run.mcap'
    assert verified(path)['identical']
    assert [event['event'] for event in events_in(log_of(path)[0])] == ['start', 'epoch', 'epoch']


def test_stamps_are_dates_that_have_come_after_resets_too_beside_a_clock_of_its_own(tmp_path):
    leads_ns = []
    with OwnNode(tmp_path, use_sim_time=True, clock__enabled=True).listen('pose') as node:
        node.heard['pose'] = SimpleNamespace(
            append=lambda data: leads_ns.append(stamp_of(data) - time.time_ns()))
        for _ in range(4):
            count = len(leads_ns)
            node.spin_until('samples', lambda count=count: len(leads_ns) > count + 5)
            assert node.trigger('reset').success
    assert max(leads_ns) <= 0


def test_what_is_no_time_on_a_clock_is_left_out_with_one_line(tmp_path, capfd):
    with OwnNode(tmp_path, use_sim_time=True) as node:
        executable.guard_clock(node.node)
        (clock,) = [one for one in node.node.subscriptions if one.msg_type is Clock]
        for sec, nanosec in ((7, 0), (-1, 0), (2 ** 31 - 1, 4_000_000_000)):
            clock.callback(Clock(clock=Stamp(sec=sec, nanosec=nanosec)))
        assert node.node.get_clock().now().nanoseconds == 7 * SECOND
    assert capfd.readouterr().err.count('/clock is left out: the stamp -1 s: must be >= 0') == 1
