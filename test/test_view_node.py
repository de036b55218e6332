# SPDX-License-Identifier: Apache-2.0
"""What the page of a node takes from it."""

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from helpers.simulations import play
from rclpy.qos import ReliabilityPolicy

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.view.samples import SampledTrack


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
        # So a page that hangs never makes the node wait.
        assert live._listener.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
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
