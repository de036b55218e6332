# SPDX-License-Identifier: Apache-2.0
"""
What the running node publishes: over real DDS, seen from another process.

What it sends is compared with its log, and that with the run computed in this process.
"""

import signal
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    KINDS,
    PERIODS_NS,
    SECOND,
    assert_clean_end,
    assert_received_from,
    log_of,
    stamp_of,
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
        assert peer.trigger(one, 'step').success and peer.trigger(one, 'reset').success
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


@pytest.mark.parametrize('name', RUNS)
def test_a_node_sends_records_and_ends_as_it_is_computed_offline(both_runs, name):
    """The same bytes, in order, with nothing missing between the first and the last."""
    run = both_runs[name]
    assert_clean_end(run.node, run.code)
    verdict = verified(the_log(run.node.folder))
    assert verdict['identical']
    assert {topic.split('/', 2)[2] for topic in verdict['compared']} >= {*run.topics}
    assert all(topic.startswith(f'/{name}/') for topic in run.log)
    for topic, heard in run.topics.items():
        logged = [data for _, data in run.log[run.node.topic(topic)]]
        if topic in KINDS:
            assert [stamp for stamp, _ in run.log[run.node.topic(topic)]] == [
                stamp_of(data) for data in logged]
        first = logged.index(heard.raw[0])
        if int(run.said['skipped samples']) == 0:
            assert logged[first:first + len(heard.raw)] == heard.raw, topic
        else:
            assert_received_from(heard.raw, logged)
