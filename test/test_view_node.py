# SPDX-License-Identifier: Apache-2.0
"""What the page does to the node: few messages, and nothing when it dies, hangs or is slow."""

import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import stamp_of
from helpers.simulations import record
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter

from spinning_top_sim.nodes import throttle
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.view.track import Track

VIEW = ('-m', 'spinning_top_sim.view.command', '--no-browser', '--port', '0')
PERIODS = {'/pose': 5_000_000, '/ground_truth/odom': 10_000_000}


@pytest.mark.parametrize(('period', 'count'), [(0.001, 300), (0.01, 300), (0.1, 101)])
def test_a_throttle_lets_few_messages_through_and_the_last_one(monkeypatch, period, count):
    now, sent = 0.0, []
    monkeypatch.setattr(throttle.time, 'monotonic', lambda: now)
    publisher = SimpleNamespace(publish=sent.append, get_subscription_count=lambda: 1)
    one = throttle.Throttle(publisher)
    number = 0
    while now < 10.0:
        number += 1
        one.sink(None)(number)
        now = number * period
    assert len(sent) == pytest.approx(count, abs=1)
    one.flush(at_once=True)
    one.flush(at_once=True)
    assert sent[-1] == number
    assert len(set(sent)) == len(sent)


def test_steps_while_paused_keep_to_the_rate_of_a_throttle(monkeypatch):
    now, sent = 0.0, []
    monkeypatch.setattr(throttle.time, 'monotonic', lambda: now)
    one = throttle.Throttle(SimpleNamespace(
        publish=sent.append, get_subscription_count=lambda: 1))
    step = one.sink(None)
    for tick in range(1000):                # 200 a second, with a step before each
        step(tick)
        one.flush()
        now += 0.005
    assert len(sent) == pytest.approx(5 * throttle.RATE, abs=1)
    now += 1.0 / throttle.RATE
    one.flush()
    assert sent[-1] == 999


def test_a_throttle_is_not_in_the_way_of_others():
    sent, every = [], []
    publisher = SimpleNamespace(publish=sent.append, get_subscription_count=lambda: watchers)
    one, watchers = throttle.Throttle(publisher), 0
    assert one.sink(None) is None
    assert one.sink(every.append) == every.append
    watchers = 1
    for number in range(100):
        one.sink(every.append)(number)
    assert every == list(range(100))
    assert set(sent) < set(every)
    watchers = 0
    one.sink(every.append)
    sent.clear()
    one.flush(at_once=True)
    assert sent == []                       # nobody waits for it


def test_the_throttled_topic_has_messages_of_its_stream(peer, tmp_path):
    with SimNode(tmp_path) as node:
        few = peer.listen(node.topic('ground_truth/odom_throttle'), Odometry)
        few.wait(20)
        every = peer.listen(node.topic('ground_truth/odom'), Odometry)
        every.wait(1)
        few.wait_more(20)
        assert peer.switch(node, 'set_pause', True).success
        wait_for('the last message on both topics', lambda: few.raw[-1] == every.raw[-1])
        known = {stamp_of(data): data for data in every.raw}
        shared = [data for data in few.raw if stamp_of(data) in known]
        assert len(shared) >= 20
        assert all(data == known[stamp_of(data)] for data in shared)
        # A step, too, is shown, whatever came shortly before.
        assert peer.trigger(node, 'step').success
        wait_for('the step', lambda: few.raw[-1] == every.raw[-1]
                 and stamp_of(few.raw[-1]) > max(known))


@pytest.fixture
def live():
    """A page whose node, in this process, hears nobody."""
    pytest.importorskip('viser')
    from spinning_top_sim.view.live import LiveView
    from spinning_top_sim.view.page import Page
    rclpy.init()
    view = LiveView(Page('one', '127.0.0.1', None))
    yield view
    view._page.close()
    view.destroy_node()
    rclpy.try_shutdown()


def test_the_page_goes_on_where_the_clock_of_a_new_run_is_earlier(live):
    values = parameters.checked({'spin.lz': 1.4})
    live._stale, live._track = False, Track('', values)
    live._page.set_tracks([live._track])
    live._listen_as_needed()
    for epoch_ns in (100 * NANOSECONDS, 5 * NANOSECONDS):
        run = LiveSimulation(values, epoch_ns)
        taken = record(run, 'ground_truth/odom')
        run.advance(NANOSECONDS // 2)
        live._inbox.extend((topic, data) for topic, _, data in taken)
        live._draw_once()
        assert live._track.span == (epoch_ns, epoch_ns + NANOSECONDS // 2)
        assert live._page._tops[0].drawn[0] == epoch_ns + NANOSECONDS // 2
        assert live._track.values is values
    # A message that comes late begins nothing.
    live._inbox.append(('ground_truth/odom', taken[-2][2]))
    live._draw_once()
    assert live._track.span == (epoch_ns, epoch_ns + NANOSECONDS // 2)


def answers_with(live, monkeypatch, given):
    """Let a sim_node answer with these parameters instead of the defaults; it is started."""
    def ask(_, request):
        values = parameters.checked(given)
        spin = {'spin.l3': 1.6, 'spin.lz': 1.4}
        return SimpleNamespace(values=[
            Parameter(name, value=list(value) if isinstance(value, tuple) else value
                      ).get_parameter_value()
            for name in request.names for value in [spin.get(name, values[name])]])

    monkeypatch.setattr(live, '_ask', ask)


def diagnostics_at(live, epoch_ns):
    live._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(
        name='spinning_top', values=[KeyValue(key=key, value=value) for key, value in {
            'state': 'running', 'recorder': 'off', 'simulated time [s]': '1', 'energy drift': '0',
            'real-time factor': '1', 'orientation error [rad]': '0',
            'stamp of t = 0 [ns]': str(epoch_ns)}.items()])]))


def test_the_page_shows_another_top_when_its_motion_begins(live, monkeypatch):
    given = {}
    answers_with(live, monkeypatch, given)
    live._read_parameters()
    diagnostics_at(live, NANOSECONDS)
    assert live._track.top.mass == parameters.checked({})['top.mass']
    given |= {'top.mass': 4.0, 'pose.rate': 50.0}       # the mass waits for a reset
    live._read_parameters()
    diagnostics_at(live, NANOSECONDS)
    assert live._track.top.mass == parameters.checked({})['top.mass']
    assert live._track.values['pose.rate'] == 50.0
    assert not live._stale
    diagnostics_at(live, 2 * NANOSECONDS)
    assert live._stale
    live._read_parameters()
    assert live._track.top.mass == 4.0


def test_the_page_goes_on_with_the_topics_that_come(live):
    values = parameters.checked({'spin.lz': 1.4})
    live._stale, live._track = False, Track('', values)
    live._page.set_tracks([live._track])
    run = LiveSimulation(values, NANOSECONDS)
    taken = record(run, 'ground_truth/odom', 'pose', 'joint_states')
    for number, enabled in enumerate((True, False, True)):
        live._track.values = {**values, 'ground_truth_odom.enabled': enabled}
        live._listen_as_needed()
        run.advance((number + 1) * NANOSECONDS)
        live._inbox.extend((topic, data) for topic, _, data in taken if topic in live._listeners)
        taken.clear()
        live._draw_once()
        assert live._track.span[1] == (number + 2) * NANOSECONDS
        assert live._page._tops[0].drawn[0] == (number + 2) * NANOSECONDS


def test_a_scene_brings_its_start_and_leaves_the_sensor_alone(live, monkeypatch):
    said = []
    monkeypatch.setattr(live, 'set_parameters_together', said.append)
    monkeypatch.setattr(live, 'call', said.append)
    assert live.load_scene('wavy') == 'scene wavy'
    values, then = said
    assert then == 'reset'
    assert (values['spin.l3'], values['spin.lz']) == (1.6, 1.42)
    assert values['initial.phi'] == 0.0                 # the default
    assert not any(name.startswith('imu.') for name in values)


def test_a_page_in_trouble_does_not_slow_the_node(peer, diagnostics, tmp_path):
    pytest.importorskip('viser')
    path = tmp_path / 'run.mcap'
    with SimNode(tmp_path, {'record.enabled': True, 'record.uri': str(path),
                            'pose.rate': 200.0}) as node:
        poses = peer.listen(node.topic('pose'), PoseStamped)
        with SimNode(tmp_path / 'view', namespace=node.namespace, program=VIEW) as view:
            wait_for('the page to listen', lambda: peer.node.count_subscribers(
                node.topic('ground_truth/odom_throttle')))
            before = diagnostics.next(node)
            for _ in range(10):         # it has a tenth of its time
                os.killpg(view.process.pid, signal.SIGSTOP)
                poses.wait_more(36)
                os.killpg(view.process.pid, signal.SIGCONT)
                poses.wait_more(4)
            assert view.alive
            # It hangs for two seconds of simulated time, which is the real time.
            os.killpg(view.process.pid, signal.SIGSTOP)
            poses.wait_more(400)
            os.killpg(view.process.pid, signal.SIGCONT)
            # Killed while it makes a port of shared memory, as it may when it goes on, it would
            # block all who open that port (Fast DDS).
            poses.wait_more(200)
            assert view.alive
            view.kill()
            poses.wait_more(100)
        after = diagnostics.next(node)
        assert after['clock slip [s]'] == before['clock slip [s]'] == '0.000'
        assert after['recorder'] == 'recording'
        assert node.end() == 0
    with LogReader(path) as reader:
        stamps = {topic: np.array([message.log_time for message in reader.messages(
            topics=[f'{node.namespace}{topic}'])]) for topic in PERIODS}
    for topic, period in PERIODS.items():
        assert len(stamps[topic]) > 4.0e9 / period
        assert (np.diff(stamps[topic]) == period).all(), topic
