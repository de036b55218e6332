# SPDX-License-Identifier: Apache-2.0
"""Commands and parameters of a node: what they do, what is refused, and what the user is told."""

import inspect
import math

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import Twist, Vector3
from helpers.node_logs import events_in, log_of, verified
from helpers.own_node import OwnNode

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.parameter import Effect
from spinning_top_sim.streams.topics import INVARIANTS


@pytest.fixture
def node(tmp_path):
    with OwnNode(tmp_path, start_paused=True) as node:
        yield node


def recorded(node):
    """Stop the recording; return the log, which is the run computed from its metadata."""
    assert node.switch('record', False).success
    path = node.get('record.uri')[0]
    assert verified(path)['identical']
    log, metadata = log_of(path)
    assert '"pose.rate": 100.0' in metadata['spinning_top_sim']['parameters'], 'at the start'
    return log


def as_parameters(node, l3, lz):
    assert node.set(spin__l3=l3, spin__lz=lz).successful


@pytest.mark.parametrize(('command', 'l3', 'lz'), [
    (OwnNode.command, 1.25, 0.75), (as_parameters, 2, 0)])
def test_a_command_sets_the_momenta(node, command, l3, lz):
    assert node.set(pose__rate=50.0).successful and node.switch('record', True).success
    node.step(50)
    assert node.set(pose__rate=25.0, seed=7).successful, 'the one now, the other later'
    command(node, l3, lz)
    assert node.get('spin.l3', 'spin.lz') == [l3, lz]
    node.step(50)
    log = recorded(node)
    assert [(event['l3'], event['lz']) for event in events_in(log)
            if event['event'] == 'command'] == [(l3, lz)]
    invariants = np.frombuffer(log['/spinning_top/invariants'][-1][1][-8 * len(INVARIANTS):])
    assert np.abs(invariants[1:3] - (l3, lz)).max() < 1e-11


def test_a_spin_that_is_set_beside_the_start_is_that_of_the_next_start(node, capfd):
    assert node.set(initial__theta=0.5, spin__l3=2.0).successful
    assert 'initial.theta: a change takes effect at the next ~/reset' in capfd.readouterr().err
    assert node.loop.commands == 0 and node.trigger('reset').success
    assert node.get('spin.l3') == [2.0] and node.simulation.state().theta == 0.5
    assert node.set(initial__phi=0.25, spin__l3=2.5).successful and node.loop.commands == 0


REFUSED_COMMANDS = {
    (): '0 values', (1.0, 1.0, 1.0): '3 values', (math.nan, 1.0): 'nan', (1.0, -math.inf): 'inf',
    (1e300, 1e300): '1e+300', (1e20, 1.0): '1e+20', (-1e150, 1e15): '1e+150'}
REFUSED_PARAMETERS = [
    ({'spin__l3': math.nan}, 'nan'), ({'spin__l3': 1e20, 'spin__lz': 1.0}, '1e+20'),
    ({'spin__lz': None}, 'cannot be unset'), ({'spin__l3': 'fast'}, 'fast'),
    ({'pose__enabled': 1}, '1'), ({'top__lambda3': -2}, '-2'),
    ({'top__mass': 1e300, 'top__gravity': 1e300}, '1e+300'), ({'imu__rate': 1e5}, '1000'),
    ({'imu__lever_arm': [0.0, 1.5]}, 'imu.lever_arm = [0.0, 1.5]: must be'),
    ({'record__streams': ['pose', 'poise']}, 'poise'), ({'solver__rtol': '3.5'}, '3.5'),
    ({'imu__lever_arm': ['1e-2', 'x', '2e0']}, 'must be a list of 3 numbers'),
    ({'initial__theta': 4.0, 'pose__rate': 50.0}, '4.0'), ({'use_sim_time': True}, 'read-only')]


def test_refused_commands_and_parameters_change_nothing(node, capfd):
    """Each is refused with the value named; the motion is to the bit the undisturbed one."""
    assert node.switch('record', True).success
    node.step(10)
    before, rejected = (node.node.values_next, node.loop.commands), node.loop.rejected_commands
    for data, named in REFUSED_COMMANDS.items():
        node.command(*data)
        assert named in capfd.readouterr().err, data
    for twist, named in (
            (Twist(angular=Vector3(z=0.5)), 'angular = [0.0, 0.0, 0.5] rad/s: must be 0'),
            (Twist(linear=Vector3(x=math.nan)), 'linear = [nan, 0.0, 0.0] m/s: each must be'),
            (Twist(linear=Vector3(z=1e5)), '100000.0] m/s: each must be finite and within 10000')):
        node.receive('cmd_vel', twist)
        assert named in capfd.readouterr().err
    node.receive('cmd_vel', Twist())        # of a pivot that rests: no event
    rejected += 3 + len(REFUSED_COMMANDS)
    assert node.loop.rejected_commands == rejected
    for given, named in REFUSED_PARAMETERS:
        result = node.set(**given)
        name = next(iter(given)).split('__')[-1]
        assert (result.successful, named in result.reason, name in result.reason) == (
            False, True, True), (given, result.reason)
    assert not node.set(world_frame='map').successful, 'read-only'
    spins = sum(any('spin__' in key for key in given) for given, _ in REFUSED_PARAMETERS)
    assert node.loop.rejected_commands == rejected + spins
    assert (node.node.values_next, node.loop.commands) == before
    node.step(10)
    assert {event['event'] for event in events_in(recorded(node))} == {'start', 'parameters'}


def test_a_stream_that_cannot_be_published_is_refused_before_anything_changes(tmp_path):
    with OwnNode(tmp_path, '-p', 'qos_overrides./imu/mag.publisher.reliability:=foo',
                 start_paused=True) as node:
        before, rates = node.node.values_next, [one.period_ns for one in node.simulation.channels]
        topics = {one.topic_name for one in node.node.publishers}
        result = node.set(imu_data__enabled=True, mag__enabled=True, pose__rate=20.0)
        assert not result.successful and 'foo' in result.reason
        assert node.node.values_next == before and not node.get('mag.enabled')[0]
        assert [one.period_ns for one in node.simulation.channels] == rates
        assert {one.topic_name for one in node.node.publishers} == topics
        assert not node.simulation.history
        node.step(3)


def test_texts_that_are_numbers_are_taken_as_ros2_param_sends_them(node):
    """YAML 1.1 takes 1e-9 for a text, and so do `ros2 param set` and `ros2 param load`."""
    timers = {*node.node.timers}
    assert not any(inspect.signature(one.callback).parameters for one in timers)    # TimerInfo
    assert node.set(solver__rtol='1e-9', imu__gyroscope_noise_density='5e-5', duration=0,
                    imu__lever_arm=['1e-2', '0e0', '2e0']).successful
    assert node.get('solver.rtol', 'imu.gyroscope_noise_density', 'duration') == [1e-9, 5e-5, 0.0]
    assert list(node.get('imu.lever_arm')[0]) == [0.01, 0.0, 2.0]
    assert {*node.node.timers} == timers, 'ticks go on as before'
    assert node.set(tick_rate=250.0).successful and len({*node.node.timers}) == len(timers)


def test_streams_can_be_switched_off_and_on_and_only_subscribers_make_work(node):
    output = next(one for one in node.simulation.outputs if one.channel.topic == 'pose')
    node.listen('pose').step(5)
    assert output.is_used and output.sent == 6, 'with that of t = 0'
    assert node.set(pose__enabled=False).successful and output.publish is None
    assert not [one for one in node.node.publishers if one.topic_name == '/pose']
    assert node.set(pose__enabled=True).successful
    node.step(5)
    assert not output.is_used and output.sent == 6
    node.listen('pose').step(5)
    assert output.is_used and output.sent == 11


def test_parameters_are_described(node):
    """What `ros2 param describe` shows: text with unit and effect, range, and what is allowed."""
    found = node.node.describe_parameters(list(parameters.BY_NAME))
    for descriptor, parameter in zip(found, parameters.TABLE, strict=True):
        assert descriptor.name == parameter.name
        assert descriptor.description == parameter.describe(range_too=False)
        assert descriptor.read_only == (parameter.effect is Effect.START)
        for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
            assert limits.from_value in parameter.range or parameter.range.is_open, parameter.name
            assert limits.to_value == parameter.range.highest, parameter.name
        assert descriptor.additional_constraints == parameter.allowed
