# SPDX-License-Identifier: Apache-2.0
"""
What the running node publishes: over real DDS, seen from another process.

Truths come from outside the code under test: differences of what was published, the field's
formulas, readers of other people; or from the pipeline run in this process without ROS.
"""

import math
import signal
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    KINDS,
    PERIODS_NS,
    SECOND,
    assert_clean_end,
    assert_received_from,
    log_of,
    settled,
    stamp_of,
    stamps_of,
    the_log,
    verified,
)
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import MarkerArray

WATCHED_S = 1

RUNS = {
    'plain': {},
    'mounted': {'imu.lever_arm': [0.1, -0.05, 0.3], 'imu.rpy': [0.3, -0.2, 1.1],
               'initial.theta': 0.8, 'initial.theta_dot': 0.4, 'spin.l3': 1.2, 'spin.lz': 0.5,
               'imu.frame_id': 'sensor', 'world_frame': 'map', 'body_frame': 'wheel',
               'markers.enabled': True},
}


@pytest.fixture(scope='module')
def both_runs(peer, diagnostics, tmp_path_factory):
    """Two nodes side by side on either executor, recorded, watched, told, and ended."""
    folder = tmp_path_factory.mktemp('runs')
    runs = {}
    # With the default depth of 10, a subscriber that stands still for 50 ms misses samples.
    one, two = ({**values, 'record.enabled': True, **{
        f'qos_overrides./{name}/{topic}.publisher.depth': 1000 for topic in (*KINDS, 'markers')}}
        for name, values in RUNS.items())
    with (SimNode(folder, one, namespace='/plain') as one,
          SimNode(folder, two, namespace='/mounted', executor='single') as two):
        for node in (one, two):
            topics = {name: peer.listen(node.topic(name), kind) for name, kind in KINDS.items()}
            runs[node.namespace[1:]] = SimpleNamespace(node=node, topics=topics)
        runs['mounted'].topics['markers'] = peer.listen(two.topic('markers'), MarkerArray)
        for run in runs.values():
            for name, topic in run.topics.items():
                topic.wait(WATCHED_S * SECOND // PERIODS_NS.get(name, 50_000_000))
            for topic in run.topics.values():
                topic.muted = True
            run.said = diagnostics.next(run.node)
        # What is said to one, after what is watched, and does not reach the other.
        commands = peer.node.create_publisher(Float64MultiArray, one.topic('~/commands'), 10)
        wait_for('the command', lambda: commands.publish(Float64MultiArray(
            data=[2.0, 1.5])) or peer.get(one, 'spin.l3', 'spin.lz') == [2.0, 1.5])
        assert peer.set_together(one, seed=99, pose__rate=50.0).successful
        assert peer.switch(one, 'set_pause', True).success
        for run in runs.values():       # its answer waits for the file, on either executor
            assert f'{run.node.folder}/' in peer.switch(run.node, 'record', False).message
            assert peer.switch(run.node, 'record', False).message == 'not recording'
        said = diagnostics.next(two)
        assert [said[key] for key in ('state', 'commands', 'rejected commands')] == [
            'running', '0', '0']
        assert peer.get(two, 'spin.l3', 'spin.lz', 'seed', 'pose.rate') == [1.2, 0.5, 0, 100.0]
        runs['plain'].code = one.end(signal.SIGINT)
        runs['mounted'].code = two.end(signal.SIGTERM)
    for run in runs.values():
        run.log, run.metadata = log_of(the_log(run.node.folder))
    return runs


@pytest.fixture(params=RUNS)
def run(request, both_runs):
    return both_runs[request.param]


def test_the_log_is_what_the_subscribers_got(run):
    """The same bytes, in order, with nothing missing between the first and the last."""
    for name, topic in run.topics.items():
        logged = [data for _, data in run.log[run.node.topic(name)]]
        if name in KINDS:
            assert [stamp for stamp, _ in run.log[run.node.topic(name)]] == [
                stamp_of(data) for data in logged]
        first = logged.index(topic.raw[0])
        if int(run.said['skipped samples']) == 0:
            assert logged[first:first + len(topic.raw)] == topic.raw, name
        else:
            assert_received_from(topic.raw, logged)


def test_the_log_is_the_run_computed_offline(run):
    verdict = verified(the_log(run.node.folder))
    assert verdict['identical']
    assert {topic.split('/', 2)[2] for topic in verdict['compared']} >= {*run.topics}


def test_two_nodes_in_two_namespaces_do_not_disturb_each_other(both_runs):
    for name, other in (('plain', 'mounted'), ('mounted', 'plain')):
        topics = both_runs[name].log
        assert all(topic.startswith(f'/{name}/') for topic in topics), topics
        got = {bytes(data) for topic in both_runs[name].topics.values() for data in topic.raw}
        assert not got & {data for rows in both_runs[other].log.values() for _, data in rows}


def test_sigint_and_sigterm_end_a_node_properly(run):
    assert_clean_end(run.node, run.code)


def test_services_answer_and_act(peer, tmp_path):
    with SimNode(tmp_path) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(3)
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
        pose.muted = True
