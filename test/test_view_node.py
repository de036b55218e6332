# SPDX-License-Identifier: Apache-2.0
"""What the page does to the node: few messages, and nothing when it dies, hangs or is slow."""

import os
import signal

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.simulations import play

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.samples import SampledTrack

VIEW = ('-m', 'spinning_top_sim', 'view', '--node', '--no-browser', '--port', '0')
PERIODS = {'/pose': 5_000_000, '/ground_truth/odom': 10_000_000}


@pytest.fixture
def live():
    """A page whose node, in this process, hears nobody."""
    pytest.importorskip('viser')
    from spinning_top_sim.view.node import NodeView
    from spinning_top_sim.view.page import Page
    rclpy.init()
    view = NodeView(Page('one', '127.0.0.1', None))
    yield view
    view.stop()             # as where the start has failed
    view.destroy_node()
    rclpy.try_shutdown()


def test_the_page_goes_on_with_the_topics_and_the_clock_that_come(live, monkeypatch):
    """Without ground_truth/odom, and where a new run has an earlier clock."""
    values = parameters.checked({'spin.lz': 1.4})
    live._is_stale, live._track = False, SampledTrack(values)
    for seconds, topic in ((100, 'ground_truth/odom'), (200, 'joint_states'), (300, 'pose'),
                           (5, 'ground_truth/odom')):
        epoch_ns = seconds * NANOSECONDS
        monkeypatch.setattr(live, 'count_publishers', lambda name, only=topic: name == only)
        live._listen()
        assert live._listener.topic_name == f'/{topic}'
        taken = play(Simulation(values, epoch_ns), NANOSECONDS // 2, topic)
        live._inbox.extend((topic, data) for topic, _, data in taken)
        t_ns = live.update(0.0)
        track = live.track
        assert t_ns + track.epoch_ns == epoch_ns + NANOSECONDS // 2
        motion = track.motion_at(t_ns)
        assert (motion is None) is (topic == 'pose')        # which has no rates
        live._page.draw(t_ns, track)
        assert live._page._top._picture[1] == t_ns
    # The trace begins with the last reset.
    live._epoch_ns = epoch_ns + NANOSECONDS // 4
    live.update(0.0)
    assert track.span == (0, NANOSECONDS // 4)


def test_what_others_send_under_our_names_changes_nothing(live):
    values = parameters.checked({})
    live._is_stale, live._track = False, SampledTrack(values)
    live._on_diagnostics(DiagnosticArray(status=[DiagnosticStatus(name='spinning_top')]))
    live._inbox.append(('pose', bytes(99)))
    assert live.update(0.0) == 0 and live.track is None


def test_a_page_in_trouble_does_not_slow_the_node(peer, diagnostics, tmp_path):
    pytest.importorskip('viser')
    path = tmp_path / 'run.mcap'
    with SimNode(tmp_path, {'record.enabled': True, 'record.uri': str(path),
                            'pose.rate': 200.0}) as node:
        poses = peer.listen(node.topic('pose'), PoseStamped)
        with SimNode(tmp_path / 'view', namespace=node.namespace, program=VIEW) as view:
            wait_for('the page to listen', lambda: peer.node.count_subscribers(
                node.topic('ground_truth/odom')))
            before = diagnostics.next(node)
            # It hangs for a second of simulated time, which is the real time.
            os.killpg(view.process.pid, signal.SIGSTOP)
            poses.wait_more(200)
            os.killpg(view.process.pid, signal.SIGCONT)
            # Killed while it makes a port of shared memory, as it may when it goes on, it would
            # block all who open that port (Fast DDS).
            poses.wait_more(100)
            assert view.alive
            view.kill()
            poses.wait_more(50)
        after = diagnostics.next(node)
        assert after['clock slip [s]'] == before['clock slip [s]'] == '0.000'
        assert after['recorder'] == 'recording'
        assert node.end() == 0
    with LogReader(path) as reader:
        stamps = {topic: np.array([message.log_time for message in reader.messages(
            topics=[f'{node.namespace}{topic}'])]) for topic in PERIODS}
    for topic, period in PERIODS.items():
        assert len(stamps[topic]) > 1.5e9 / period
        assert (np.diff(stamps[topic]) == period).all(), topic
