# SPDX-License-Identifier: Apache-2.0
"""
What a node does for simulation_interfaces: states, steps, resets, features.

The handlers are called as the executor calls them, with stand-ins for the messages, and with the
installed ones where there are some.
"""

import json
import re

import pytest

pytest.importorskip('rclpy')

from helpers.node_logs import xyz, xyzw
from helpers.standard_node import standard_node  # noqa: F401, a fixture

from spinning_top_sim.nodes.simulation_handlers import FEATURES
from spinning_top_sim.tools import inspect

UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
STOPPED, PLAYING, PAUSED, QUITTING, NO_WORLD = range(5)
ALREADY, TRANSITION_ERROR, INCORRECT_TRANSITION = 101, 102, 103


@pytest.fixture
def top(stopped):
    return stopped


def test_features_are_those_of_the_services(top):
    known = top.messages.SimulatorFeatures
    features = top.call('GetSimulatorFeatures').features
    names = {name for name in dir(known) if name.isupper()
             and getattr(known, name) in list(features.features)}
    assert names == {name for row in FEATURES.values() for name in row}
    assert not {'ENTITY_TAGS', 'ENTITY_CATEGORIES', 'ENTITY_BOUNDS', 'SPAWNING', 'DELETING',
                'SIMULATION_RESET_TIME', 'WORLD_TAGS', 'ENTITY_INFO_SETTING'} & names
    assert not features.spawn_formats


def test_a_node_that_starts_paused_is_stopped_until_something_moves(top):
    assert top.state == STOPPED
    assert top.set_state('STOPPED') == ALREADY
    assert top.set_state('PAUSED') == OK
    assert top.state == PAUSED
    assert top.simulation.now_ns == -1, 'no sample of the motion is sent'
    assert top.set_state('PAUSED') == ALREADY
    assert top.set_state('STOPPED') == OK
    assert top.state == STOPPED


def test_play_pause_stop(top):
    assert top.set_state('PLAYING') == OK
    assert top.state == PLAYING
    assert top.set_state('PLAYING') == ALREADY
    top.wait_until(50_000_000)
    assert top.set_state('PAUSED') == OK
    paused_ns = top.simulation.now_ns
    assert top.state == PAUSED
    assert top.set_state('PLAYING') == OK
    top.wait_until(paused_ns + 50_000_000)
    epoch_ns, now_ns = top.simulation.epoch_ns, top.simulation.now_ns
    assert top.set_state('STOPPED') == OK
    assert top.state == STOPPED
    assert top.simulation.now_ns == -1
    assert top.simulation.epoch_ns > epoch_ns + now_ns, 'stamps do not go back'
    assert top.set_state('PLAYING') == OK


def test_other_states_are_refused_by_name(top):
    code, text = top.refused('SetSimulationState',
                             state=top.messages.SimulationState(state=NO_WORLD))
    assert code == INCORRECT_TRANSITION
    assert text == 'state = 4: must be 0 (STOPPED), 1 (PLAYING), 2 (PAUSED), 3 (QUITTING)'


def test_quitting_ends_the_node(top):
    assert top.set_state('QUITTING') == OK
    assert top.state == QUITTING
    assert top.set_state('QUITTING') == ALREADY
    for name in ('STOPPED', 'PLAYING', 'PAUSED'):
        assert top.set_state(name) == INCORRECT_TRANSITION
    assert top.refused('ResetSimulation', scope=0) == (
        INCORRECT_STATE, 'the simulator is quitting')
    assert not top.node.finished.done(), 'the response goes out first'
    top.spin_until('the end', top.node.finished.done)
    assert top.node.finished.result() is None       # exit code 0


def test_a_failed_motion_is_paused_until_it_is_stopped(top):
    top.pause()
    top.loop.fail('the equations end')
    response = top.done('GetSimulationState')
    assert (response.state.state, response.result.error_message) == (PAUSED, 'the equations end')
    number = top.messages.SimulationState(state=PLAYING)
    code, text = top.refused('SetSimulationState', state=number)
    assert code == TRANSITION_ERROR
    assert 'the equations end' in text
    assert top.refused('StepSimulation', steps=1) == (
        FAILED, 'the motion stands still: the equations end')
    assert top.set_state('STOPPED') == OK
    assert (top.state, top.loop.failure) == (STOPPED, None)


def test_steps_only_while_paused(top):
    code, text = top.refused('StepSimulation', steps=1)
    assert code == FAILED
    assert 'STATE_PAUSED first' in text
    top.set_state('PLAYING')
    assert top.refused('StepSimulation', steps=1)[0] == FAILED
    top.pause()
    assert top.refused('StepSimulation', steps=0) == (FAILED, 'steps = 0: must be >= 1')


def test_steps_are_whole_nanoseconds_however_they_are_divided(top):
    assert top.set(step__dt=1.0 / 3.0).successful
    top.pause().done('StepSimulation', steps=6)
    assert top.simulation.now_ns == 6 * 333_333_333
    for _ in range(3):
        top.done('StepSimulation', steps=1)
    assert top.simulation.now_ns == 9 * 333_333_333
    assert top.state == PAUSED


def motion(top):
    """Return attitude and angular velocity."""
    state = top.done('GetEntityState', entity='spinning_top').state
    return xyzw(state.pose.orientation), xyz(state.twist.angular)


@pytest.mark.parametrize('scope', [0, 3])
def test_a_reset_of_time_and_state_is_that_of_the_node(top, scope):
    start = motion(top)
    top.pause().done('StepSimulation', steps=5)
    assert top.set(spin__l3=2.5).successful
    assert top.get('spin.l3') == [2.5]
    top.done('ResetSimulation', scope=scope)
    assert top.simulation.now_ns == -1
    assert motion(top) == start
    assert top.get('spin.l3') == [1.6]
    assert top.state == STOPPED, 'a pause stays'


def test_a_reset_of_the_state_lets_time_go_on(top):
    start = motion(top)
    top.pause().done('StepSimulation', steps=5)
    top.done('ResetSimulation', scope=2)
    assert top.simulation.now_ns == 50_000_000
    assert motion(top) == start
    assert top.state == PAUSED
    top.done('StepSimulation', steps=1)


def test_other_scopes_are_not_supported(top):
    top.pause().done('StepSimulation', steps=2)
    code, text = top.refused('ResetSimulation', scope=1)
    assert code == UNSUPPORTED
    assert text.startswith('scope = 1: must be 0 or 255 (all), 2 (state) or 3')
    assert top.simulation.now_ns == 20_000_000


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_a_log_of_all_this_verifies(top, tmp_path, capsys, method):
    """States and resets are in the journal: the run can be computed again."""
    path = str(tmp_path / 'run.mcap')
    assert top.set(
        solver__method=method, increments__enabled=True, markers__enabled=True, mag__enabled=True,
        imu__lever_arm=[0.1, 0.0, 0.02], imu__gyroscope_noise_density=1e-3,
        imu__gyroscope_bias_stddev=0.1, record__uri=path).successful
    top.done('ResetSimulation', scope=0)
    state = top.messages.EntityState()
    state.twist.angular.x, state.pose.orientation.w = 0.5, 1.0
    state.twist.angular.z = 11.0
    top.pause().done('StepSimulation', steps=3)
    top.done('SetEntityState', entity='spinning_top', state=state, set_twist=True)
    top.done('StepSimulation', steps=3)
    assert top.switch('record', True).success
    top.done('StepSimulation', steps=7)
    top.done('SetEntityState', entity='spinning_top', state=state, set_pose=True, set_twist=True)
    top.done('StepSimulation', steps=11)
    top.done('ResetSimulation', scope=2)
    top.done('StepSimulation', steps=5)
    top.done('StepSimulation', steps=20)
    top.done('SetEntityState', entity='spinning_top', state=state, set_pose=True)
    top.done('StepSimulation', steps=13)
    assert top.switch('record', False).success
    code = inspect.main([path, '--verify', '--json'])
    content = json.loads(capsys.readouterr().out)
    assert (code, content['verify']['identical']) == (0, True), content['verify']
    assert [motion['cause'] for motion in content['motions']] == [
        'start', 'state', 'state', 'state']
    assert inspect.main([path]) == 0
    assert re.search('.*, 3 states set', capsys.readouterr().out)
