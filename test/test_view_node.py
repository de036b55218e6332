# SPDX-License-Identifier: Apache-2.0
"""The page of a running sim_node, without a browser: what it shows, and what its buttons do."""

import contextlib
import signal
import threading

import pytest
import rclpy
from helpers.desk import Desk
from helpers.node_harness import SimNode, wait_for
from helpers.simulations import play
from rclpy.executors import ExternalShutdownException
from rclpy.qos import ReliabilityPolicy

from spinning_top_sim import solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.samples import SampledTrack

pytest.importorskip('viser')
from spinning_top_sim.view.node import NodeView


@pytest.fixture
def desk():
    rclpy.init(args=['--ros-args', '-r', '__ns:=/seen'])
    yield Desk()
    rclpy.try_shutdown()


def test_a_running_node(desk, peer, tmp_path):
    def spin():
        with contextlib.suppress(ExternalShutdownException):
            rclpy.spin(view)

    def motion():
        t_ns = view.update(0.0)
        found = view.track and view.track.motion_at(t_ns)
        return found and found.description.name

    view, spinning = NodeView(desk), threading.Thread(target=spin)
    spinning.start()
    with SimNode(tmp_path, namespace='/seen') as node:
        status = desk.inputs['*waiting for sim_node*']
        wait_for('/diagnostics, with the stamp of t = 0', lambda: 't = ' in status.content)
        assert wait_for('a motion', motion) == 'cusps'
        desk.press('time', 'Step')
        assert desk.message.content.startswith('**refused:** step: ')
        desk.press('Pause')
        assert desk.message.content.startswith('pause: paused at t = ')
        t_ns = view.update(0.0)
        exact = solve(view.track.top, parameters.start_state(view.track.values), [t_ns * 1e-9])
        assert view.track.state(t_ns).quaternion == pytest.approx(exact.quaternion, abs=1e-8)
        desk.press('time', 'Step')
        wait_for('a step', lambda: view.update(0.0) > t_ns)
        # Another motion, whoever commands it.
        assert peer.set_together(node, spin__l3=2.0, spin__lz=1.5).successful
        # /diagnostics of before the pause may have come after its answer.
        wait_for('the button', lambda: desk.inputs['Pause'].label == 'Resume')
        desk.press('Pause')
        wait_for('loops', lambda: motion() == 'loops')
        desk.press('time', 'Reset')
        assert desk.message.content.startswith('reset: at t = 0')
        assert node.end() == 0
        wait_for('the end', lambda: view.update(0.0) and 'has ended' in status.content)
    view.stop()
    rclpy.try_shutdown()
    spinning.join()


def test_the_page_goes_on_with_the_topics_and_the_clock_that_come(desk, monkeypatch):
    """Without ground_truth/odom, and where a new run has an earlier clock."""
    values, view = parameters.checked({'spin.lz': 1.4}), NodeView(desk)
    view._is_stale, view._track = False, SampledTrack(values)
    for seconds, topic in ((100, 'ground_truth/odom'), (200, 'joint_states'), (300, 'pose'),
                           (5, 'ground_truth/odom')):
        epoch_ns = seconds * NANOSECONDS
        monkeypatch.setattr(view, 'count_publishers', lambda name, only=topic: name == only)
        view._listen()
        assert view._listener.topic_name == f'/seen/{topic}'
        # So a page that hangs never makes the node wait.
        assert view._listener.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        taken = play(Simulation(values, epoch_ns), NANOSECONDS // 2, topic)
        view._inbox.extend((topic, data) for topic, _, data in (*taken, (topic, 0, bytes(99))))
        t_ns = view.update(0.0)
        assert t_ns + view.track.epoch_ns == epoch_ns + NANOSECONDS // 2
        assert (view.track.motion_at(t_ns) is None) is (topic == 'pose')    # which has no rates
    # The trace begins with the last reset.
    view._epoch_ns = epoch_ns + NANOSECONDS // 4
    view.update(0.0)
    assert view.track.span == (0, NANOSECONDS // 4)
    view.stop()             # as where the start has failed


def test_the_command_serves_a_page_until_a_signal(tmp_path):
    with SimNode(tmp_path, program=(
            '-m', 'spinning_top_sim', 'view', '--node', '--no-browser', '--port', '0')) as view:
        wait_for('the address', lambda: 'http://127.0.0.1:' in view.out)
        assert view.end(signal.SIGINT) == 0, view.err
