# SPDX-License-Identifier: Apache-2.0
"""Two tops in two namespaces: what is said to one does not reach the other; and what both tell."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    QUIET,
    SECOND,
    assert_clean_end,
    assert_received_from,
    assert_steps,
    by_topic_command,
    commands_in,
    log_of,
    settled,
    simulated,
    the_log,
)
from rcl_interfaces.srv import DescribeParameters
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import inspect


@pytest.fixture(scope='module')
def pair(peer, diagnostics, tmp_path_factory):
    """Two nodes, recorded, with the markers on."""
    folder = tmp_path_factory.mktemp('pair')
    values = {**QUIET, 'record.enabled': True, 'markers.enabled': True,
              'markers.trace_length': 0.5, 'markers.trace_points': 10}
    with (SimNode(folder, values, namespace='/pair/left') as left,
          SimNode(folder, {**values, 'body_frame': 'r/base_link'},
                  namespace='/pair/right') as right):
        found = SimpleNamespace(left=left, right=right, joints={}, markers={})
        for node in (left, right):
            found.joints[node] = peer.listen(node.topic('joint_states'), JointState).wait(5)
            peer.introduce(node, diagnostics)
        yield found
        for node in (left, right):
            assert_clean_end(node, node.end())


def spin(peer, node):
    return tuple(peer.get(node, 'spin.l3', 'spin.lz'))


@pytest.mark.parametrize('told', ['left', 'right'])
def test_what_is_said_to_one_does_not_reach_the_other(peer, diagnostics, pair, told):
    node = getattr(pair, told)
    other = pair.right if told == 'left' else pair.left
    l3, lz = {'left': (2.0, 1.5), 'right': (1.2, 0.7)}[told]
    before = spin(peer, other)
    begun = diagnostics.next(other)
    by_topic_command(peer, node, l3, lz)
    wait_for('the command to arrive', lambda: spin(peer, node) == (l3, lz))
    assert peer.set_together(node, seed=99, pose__rate=50.0).successful
    assert peer.switch(node, 'set_pause', True).success
    still = settled(pair.joints[node])
    pair.joints[other].wait_more(100)
    assert len(pair.joints[node].raw) == still, 'paused'
    assert peer.trigger(node, 'step').success
    assert not peer.trigger(other, 'step').success, 'it is not paused'
    assert peer.trigger(node, 'reset').success
    assert peer.switch(node, 'set_pause', False).success
    pair.joints[node].wait_more(10)

    assert spin(peer, other) == before
    assert peer.get(other, 'pose.rate') == ([100.0] if told == 'left' else [50.0])
    said = diagnostics.next(other)
    for key in ('commands', 'rejected commands'):
        assert said[key] == begun[key], key
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec
              for m in pair.joints[other].messages()]
    if told == 'left':
        assert_steps(stamps, 10_000_000, said['skipped samples'])


def test_a_recording_stops_for_one_alone(peer, pair):
    assert peer.switch(pair.left, 'record', False).success
    pair.joints[pair.right].wait_more(50)
    assert peer.switch(pair.right, 'record', True).message != 'not recording'
    assert peer.switch(pair.right, 'record', False).success
    log, _ = log_of(the_log(pair.left.folder))
    assert all(topic.startswith('/pair/left/') for topic in log)
    assert [momenta for _, *momenta in commands_in(log)] == [[2.0, 1.5]]
    log, _ = log_of(the_log(pair.right.folder))
    assert all(topic.startswith('/pair/right/') for topic in log)
    assert [momenta for _, *momenta in commands_in(log)] == [[1.2, 0.7]]


# ------------------------------------------------------------------------------------ markers


def test_markers_are_published_as_recorded_and_as_computed(peer, tmp_path):
    """Heard late, with a command before: the bytes of the log, and of the run done offline."""
    values = {**QUIET, 'record.enabled': True, 'markers.enabled': True, 'world_frame': 'map',
              'markers.rate': 50.0}
    with SimNode(tmp_path, values) as node:
        joints = peer.listen(node.topic('joint_states'), JointState).wait(20)
        assert peer.set_together(node, spin__l3=2.0, spin__lz=1.5).successful
        joints.wait_more(50)
        markers = peer.listen(node.topic('markers'), MarkerArray).wait(30)
        assert_clean_end(node, node.end())
    peer.stop_listening(markers)
    peer.stop_listening(joints)
    path = the_log(node.folder)
    log, metadata = log_of(path)
    rows = log[node.topic('markers')]
    logged = [data for _, data in rows]
    assert_received_from(markers.raw, logged)
    assert markers.raw[0] != logged[0], 'heard late'
    computed = simulated(log, metadata, rows[-1][0] - int(
        metadata['spinning_top_sim']['epoch_ns']))['markers']
    differ = [i for i, pair in enumerate(zip(rows, computed, strict=False)) if pair[0] != pair[1]]
    assert (differ, len(rows) <= len(computed)) == ([], True)
    for message in markers.messages():
        assert [marker.header.frame_id for marker in message.markers] == 3 * ['map']
        assert len(message.markers[2].points) == 201
    assert inspect.main([str(path), '--verify']) == 0
    with LogReader(path) as reader:
        assert node.topic('markers') in {topic.name for topic in reader.topics}


# -------------------------------------------------------------------------------- descriptions


def test_parameters_are_described(peer, pair):
    """What `ros2 param describe` shows: text with unit, range and effect, and what is allowed."""
    names = list(parameters.BY_NAME)
    found = peer.call(DescribeParameters, pair.left.topic('~/describe_parameters'),
                      DescribeParameters.Request(names=names)).descriptors
    assert [descriptor.name for descriptor in found] == names
    for descriptor, parameter in zip(found, parameters.TABLE, strict=True):
        assert parameter.text in descriptor.description
        assert f'[{parameter.unit}]' in descriptor.description or not parameter.unit
        assert parameter.effect.value in descriptor.description
        assert 'must' not in descriptor.description, 'what is allowed is a constraint'
        assert descriptor.read_only == (parameter.effect is parameters.Effect.START)
        bounded = [bound for bound in (parameter.minimum, parameter.above, parameter.maximum)
                   if bound is not None]
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert len(ranges) == (len(bounded) == 2), parameter.name
        for limits in ranges:
            assert [limits.from_value, limits.to_value] == bounded, parameter.name
        said = descriptor.additional_constraints
        assert said == (parameter.allowed if not ranges else f'must be > {parameter.above:g}'
                        if parameter.above is not None else
                        f'must be 0 or >= {parameter.smallest:g}' if parameter.smallest else '')
    described = {d.name: d for d in found}
    assert described['solver.method'].additional_constraints == 'must be one of rk45, exact'
    assert 'cusp' in described['spin.lz'].description
    assert not described['pacing'].description.count('change takes effect')
