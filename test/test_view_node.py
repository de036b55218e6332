# SPDX-License-Identifier: Apache-2.0
"""The page of a running sim_node, without a browser: what it shows, and what its buttons do."""

import contextlib
import signal
import threading

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from helpers.desk import Desk
from helpers.node_harness import SimNode, wait_for
from helpers.simulations import SECOND
from rclpy.executors import ExternalShutdownException
from rclpy.qos import ReliabilityPolicy

from spinning_top_sim import solve
from spinning_top_sim.streams import parameters

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
        wait_for('/diagnostics, with the stamp of t = 0', lambda: 'factor' in status.content)
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
        # Another motion, whoever commands it: loops, wherever in the nutation that happens.
        assert peer.set_together(node, spin__l3=2.0, spin__lz=1.2).successful
        wait_for('the button', lambda: desk.inputs['Pause'].label == 'Resume')
        desk.press('Pause')
        wait_for('loops', lambda: motion() == 'loops')
        # The trace begins with a reset, and then the top may be another one.
        assert peer.set_together(node, top__mass=3.0).successful
        epoch_ns = view.track.epoch_ns
        desk.press('time', 'Reset')
        assert desk.message.content.startswith('reset: at t = 0')
        wait_for('the stamp of t = 0', lambda: (
            view.update(0.0) and view.track.epoch_ns != epoch_ns and view.track.top.mass == 3.0))
        assert view.track.span[0] >= 0
        # Another topic, where the one that tells most has gone; a pose has no rates.
        for stream, topic in (('ground_truth_odom', 'joint_states'), ('joint_states', 'pose')):
            assert view.track.motion_at(view.update(0.0)) is not None
            assert peer.set_together(node, **{f'{stream}__enabled': False}).successful
            wait_for(topic, lambda topic=topic: f'/seen/{topic}' in dict(
                view.get_subscriber_names_and_types_by_node('view', '/seen')))
        wait_for('samples of poses', lambda: view.track.motion_at(view.update(0.0)) is None)
        # A page that hangs never makes the node wait.
        listening, = view.get_subscriptions_info_by_topic('/seen/pose')
        assert listening.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert node.end() == 0
        wait_for('the end', lambda: view.update(0.0) and 'has ended' in status.content)
    # Another run, with an earlier clock.
    again, pose = peer.node.create_publisher(PoseStamped, '/seen/pose', 10), PoseStamped()
    pose.header.stamp.sec, pose.header.frame_id = 5, view.track.values['world_frame']

    def began_again():
        again.publish(pose)
        return view.update(0.0) is not None and view.track.stamps_ns.tolist() == [5 * SECOND]

    wait_for('the new run', began_again)
    view.stop()
    rclpy.try_shutdown()
    spinning.join()


def test_the_command_serves_a_page_until_a_signal(tmp_path):
    with SimNode(tmp_path, program=(
            '-m', 'spinning_top_sim', 'view', '--node', '--no-browser', '--port', '0')) as view:
        wait_for('the address', lambda: 'http://127.0.0.1:' in view.out)
        assert view.end(signal.SIGINT) == 0, view.err
