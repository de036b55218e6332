# SPDX-License-Identifier: Apache-2.0
"""
Running nodes: over real DDS, seen from another process, until a signal ends them.

What a node sends is compared with its log, and that with the run computed in this process.
"""

import signal
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import TRACEBACK, events_in, log_of, stamp_of, the_log, verified
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import MarkerArray

KINDS = {'pose': PoseStamped, 'joint_states': JointState, 'imu/data_raw': Imu,
         'ground_truth/imu': Imu, 'ground_truth/odom': Odometry, 'ground_truth/imu_bias': Imu}
INT, TERM = signal.SIGINT, signal.SIGTERM
MOUNTED = {'imu.lever_arm': [0.1, -0.05, 0.3], 'imu.rpy': [0.3, -0.2, 1.1],
           'initial.theta': 0.8, 'initial.theta_dot': 0.4, 'spin.l3': 1.2, 'spin.lz': 0.5,
           'imu.frame_id': 'sensor', 'world_frame': 'map', 'body_frame': 'wheel',
           'markers.enabled': True}


@pytest.fixture(scope='module')
def both_runs(peer, tmp_path_factory):
    """Two nodes side by side on either executor, recorded, watched, told, and ended."""
    folder = tmp_path_factory.mktemp('runs')
    # With the default depth of 10, a subscriber that stands still for 50 ms misses samples.
    one, two = ({**values, 'record.enabled': True, **{
        f'qos_overrides./{name}/{topic}.publisher.depth': 1000 for topic in (*KINDS, 'markers')}}
        for name, values in (('plain', {}), ('mounted', MOUNTED)))
    with (SimNode(folder, one, namespace='/plain') as one,
          SimNode(folder, two, namespace='/mounted', executor='single') as two):
        runs = [SimpleNamespace(node=node, topics={
            name: peer.listen(node.topic(name), kind) for name, kind in kinds.items()})
            for node, kinds in ((one, KINDS), (two, {**KINDS, 'markers': MarkerArray}))]
        for run in runs:
            for name, topic in run.topics.items():
                count = 10 if name == 'markers' else 100
                wait_for(name, lambda topic=topic, count=count: len(topic) > count)
                run.topics[name] = [*topic]
        # What is said to one, after what is watched, and does not reach the other.
        commands = peer.node.create_publisher(Float64MultiArray, one.topic('~/commands'), 10)
        wait_for('a command', lambda: commands.publish(Float64MultiArray(
            data=[2.0])) or 'data has 1 values' in one.err)
        assert peer.set_together(one, spin__l3=2.0, pose__rate=50.0).successful
        assert peer.switch(one, 'set_pause', True).success
        for node in (one, two):         # its answer waits for the file, on either executor
            assert f'{node.folder}/' in peer.switch(node, 'record', False).message
        runs[0].code, runs[1].code = one.end(INT, INT), two.end(TERM, INT)
    return runs


@pytest.mark.parametrize('number', [0, 1])
def test_a_node_sends_records_and_ends_as_it_is_computed_offline(both_runs, number):
    """The same bytes, in order, with nothing missing between the first and the last."""
    run = both_runs[number]
    assert run.code == 0 and TRACEBACK not in run.node.err + run.node.out, run.node.err
    path = the_log(run.node.folder)
    log, verdict = log_of(path)[0], verified(path)
    assert verdict['identical'] and {run.node.topic(topic) for topic in run.topics} <= {
        *verdict['compared']}
    assert all(topic.startswith(f'{run.node.namespace}/') for topic in log)
    assert len(events_in(log)) == (3, 1)[number], 'what is told to one reaches no other'
    for topic, heard in run.topics.items():
        times, logged = zip(*log[run.node.topic(topic)], strict=True)
        if topic in KINDS:
            assert [*times] == [stamp_of(data) for data in logged]
        places = [*map({data: place for place, data in enumerate(logged)}.get, heard)]
        assert places == sorted({*places}), topic
        if 'live topics skip samples' not in run.node.err:
            assert places[-1] - places[0] == len(places) - 1


# A node with an error in its 50th tick
BROKEN = """
import sys
from spinning_top_sim.nodes.loop import Loop
from spinning_top_sim.__main__ import main
ordinary, ticks = Loop.tick, iter(range(50))
Loop.tick = lambda self: (ordinary(self), 1 // (49 - next(ticks)))[0]
sys.exit(main())
"""


def test_an_error_that_nobody_expects_ends_the_node_loudly_and_the_log_is_whole(tmp_path):
    with SimNode(tmp_path, {'record.enabled': True}, program=('-c', BROKEN, 'node')) as node:
        assert node.process.wait(60.0) == 1
    assert TRACEBACK in node.err and 'ZeroDivisionError' in node.err
    assert verified(the_log(node.folder))['identical']
