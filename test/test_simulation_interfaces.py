# SPDX-License-Identifier: Apache-2.0
"""
What a node does for simulation_interfaces: states, steps, resets, features, worlds.

The handlers are called as the executor calls them, with stand-ins for the messages, and with the
installed ones where there are some.  test_simulation_interfaces_dds.py calls services.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from helpers import standard_types
from helpers.node_harness import wait_for
from helpers.standard_node import INSTALLED, KINDS, StandardNode, finished, types_of
from rclpy.parameter import Parameter

from spinning_top_sim.nodes import worlds
from spinning_top_sim.nodes.simulation_standard import FEATURES, SERVICES, service_name
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import inspect

ROOT = Path(__file__).parents[1]
UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
STOPPED, PLAYING, PAUSED, QUITTING, NO_WORLD = range(5)
ALREADY, TRANSITION_ERROR, INCORRECT_TRANSITION = 101, 102, 103
BAD_FORMAT, NO_RESOURCE, PARSE_ERROR, BAD_ELEMENTS = 101, 102, 103, 106


@pytest.fixture(params=KINDS)
def top(request, monkeypatch, tmp_path):
    with StandardNode(request.param, monkeypatch, tmp_path) as node:
        yield node


@pytest.mark.skipif(not INSTALLED, reason='simulation_interfaces is not installed')
def test_the_stand_ins_have_the_fields_and_constants_of_the_messages():
    for mine, theirs in zip(types_of('stand-in'), types_of('installed'), strict=True):
        for name, one in vars(mine).items():
            if isinstance(one, type):
                pairs = [(one, getattr(theirs, name))]
            elif hasattr(one, 'Feedback') or hasattr(one, 'Request'):
                pairs = [(kind, getattr(getattr(theirs, name), part))
                         for part, kind in vars(one).items()]
            else:
                continue
            for stand_in, real in pairs:
                assert stand_in.fields.keys() == real.get_fields_and_field_types().keys(), name
                constants = {key: value for key, value in vars(stand_in).items() if key.isupper()}
                assert constants == {key: getattr(real, key) for key in constants}, name
                assert constants.keys() == {key for key in dir(real) if key.isupper()
                                            and isinstance(getattr(real, key), int)
                                            and not key.endswith('__DEFAULT')}, name


def test_names_of_services_are_those_of_their_types():
    assert service_name('GetEntitiesStates') == 'get_entities_states'
    assert {service_name(name) for name in FEATURES} >= {
        'get_simulator_features', 'set_simulation_state', 'simulate_steps', 'load_world'}
    assert set(SERVICES) == set(standard_types.SERVICES)


def test_features_are_those_of_the_services(top):
    known = top.messages.SimulatorFeatures
    features = top.call('GetSimulatorFeatures').features
    names = {name for name in dir(known) if name.isupper()
             and getattr(known, name) in list(features.features)}
    assert names == {name for row in FEATURES.values() for name in row}
    assert not {'SPAWNING', 'SPAWNING_ENTITIES', 'DELETING', 'SIMULATION_RESET_TIME', 'WORLD_TAGS',
                'WORLD_UNLOADING', 'ENTITY_BOUNDS_CONVEX', 'ENTITY_INFO_SETTING'} & names
    assert not features.spawn_formats


# ------------------------------------------------------------------------------------ states

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


@pytest.mark.parametrize('state', [NO_WORLD, 5, 77])
def test_other_states_are_refused_by_name(top, state):
    code, text = top.refused('SetSimulationState',
                             state=top.messages.SimulationState(state=state))
    assert code == INCORRECT_TRANSITION
    assert f'state = {state}: must be 0 (STOPPED), 1 (PLAYING), 2 (PAUSED), 3 (QUITTING)' == text


def test_quitting_ends_the_node(top):
    assert top.set_state('QUITTING') == OK
    assert top.state == QUITTING
    assert top.set_state('QUITTING') == ALREADY
    for name in ('STOPPED', 'PLAYING', 'PAUSED'):
        assert top.set_state(name) == INCORRECT_TRANSITION
    assert top.refused('ResetSimulation', scope=0) == (
        INCORRECT_STATE, 'the simulator is quitting')
    assert not top.node.finished.done(), 'the response goes out first'
    import rclpy
    wait_for('the end', lambda: rclpy.spin_once(top.node, timeout_sec=0.1)
             or top.node.finished.done())
    assert top.node.finished.result() is None       # exit code 0


def test_a_failed_motion_is_paused_until_it_is_stopped(top, monkeypatch):
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


def test_a_start_that_has_no_motion_is_a_transition_error(top):
    top.pause().done('StepSimulation', steps=3)
    assert top.node.set_parameters([Parameter('top.lambda3', value=1e-25)])[0].successful
    code, text = top.refused('SetSimulationState',
                             state=top.messages.SimulationState(state=STOPPED))
    assert code == TRANSITION_ERROR
    assert 'it turns too fast' in text
    assert (top.state, top.simulation.now_ns) == (PAUSED, 30_000_000)


def test_before_the_clock_nothing_can_be_set(monkeypatch, tmp_path):
    with StandardNode('stand-in', monkeypatch, tmp_path, use_sim_time=True) as top:
        assert top.state == STOPPED
        for name in ('PLAYING', 'PAUSED'):
            assert top.set_state(name) == TRANSITION_ERROR
        for expected, name, request in (
                (FAILED, 'StepSimulation', {'steps': 1}),
                (INCORRECT_STATE, 'ResetSimulation', {'scope': 0}),
                (INCORRECT_STATE, 'LoadWorld', load(top, 'looping')),
                (INCORRECT_STATE, 'SetEntityState', {'entity': 'spinning_top'})):
            code, text = top.refused(name, **request)
            assert (code, text) == (expected, 'waiting for /clock (use_sim_time is set)')


# ------------------------------------------------------------------------------------- steps

def test_steps_only_while_paused(top):
    code, text = top.refused('StepSimulation', steps=1)
    assert code == FAILED
    assert 'STATE_PAUSED first' in text
    top.set_state('PLAYING')
    assert top.refused('StepSimulation', steps=1)[0] == FAILED
    top.pause()
    assert top.refused('StepSimulation', steps=0) == (FAILED, 'steps = 0: must be >= 1')


def test_steps_are_whole_nanoseconds_however_they_are_divided(monkeypatch, tmp_path):
    with StandardNode('stand-in', monkeypatch, tmp_path, step__dt=1.0 / 3.0) as top:
        top.pause().done('StepSimulation', steps=1)
        assert top.simulation.now_ns == 333_333_333
        top.done('StepSimulation', steps=5)
        assert top.simulation.now_ns == 6 * 333_333_333
        goal, coroutine = top.steps(3)
        assert finished(coroutine).result.result == OK
        assert top.simulation.now_ns == 9 * 333_333_333
        assert (goal.end, goal.feedback) == ('succeeded', [(1, 2), (2, 1), (3, 0)])
        assert top.state == PAUSED


def test_many_steps_are_exact_beyond_the_whole_numbers_of_doubles(monkeypatch, tmp_path):
    with StandardNode('stand-in', monkeypatch, tmp_path, step__dt=1.0 / 3.0,
                      solver__method='exact') as top:
        top.pause().done('StepSimulation', steps=30_000_001)
        assert top.simulation.now_ns == 30_000_001 * 333_333_333 > 2 ** 53


def test_steps_beyond_the_duration_say_so(monkeypatch, tmp_path):
    with StandardNode('stand-in', monkeypatch, tmp_path, duration=0.05) as top:
        code, text = top.pause().refused('StepSimulation', steps=6)
        assert code == FAILED
        assert text == 'at t = 0.050000000 s: `duration` ends before the steps do'
        assert top.state == QUITTING


def test_a_step_that_fails_says_why(top, monkeypatch):
    def advance(*_, **__):
        raise IntegrationError('the step is too small')
    top.pause()
    monkeypatch.setattr(top.simulation, 'advance', advance)
    assert top.refused('StepSimulation', steps=1) == (FAILED, 'the step is too small')


def test_simulate_steps_ends_as_it_is_told_to(top):
    goal, coroutine = top.steps(4)
    result = finished(coroutine).result
    assert (goal.end, result.result, goal.feedback) == ('aborted', FAILED, [])
    assert 'STATE_PAUSED first' in result.error_message
    top.pause()

    goal, coroutine = top.steps(4)
    coroutine.send(None)
    coroutine.send(None)
    other, second = top.steps(1)
    assert 'another' in finished(second).result.error_message
    assert other.end == 'aborted'
    assert 'SimulateSteps' in top.refused('StepSimulation', steps=1)[1]
    goal.is_cancel_requested = True
    result = finished(coroutine).result
    assert (goal.end, goal.feedback) == ('canceled', [(1, 3), (2, 2)])
    assert (result.result, result.error_message) == (FAILED, 'canceled after 2 of 4 steps')
    assert top.simulation.now_ns == 20_000_000
    top.done('StepSimulation', steps=1)         # the next ones may begin


def test_simulate_steps_says_that_the_duration_ends_or_the_motion_fails(monkeypatch, tmp_path):
    with StandardNode('stand-in', monkeypatch, tmp_path, duration=0.02) as top:
        goal, coroutine = top.pause().steps(3)
        assert finished(coroutine).result.error_message == (
            'interrupted after 2 of 3 steps: `duration` ends before the steps do')
        assert goal.end == 'aborted'
    with StandardNode('stand-in', monkeypatch, tmp_path) as top:
        _, coroutine = top.pause().steps(3)
        coroutine.send(None)
        top.loop.fail('the equations end')
        assert finished(coroutine).result.error_message == (
            'interrupted after 1 of 3 steps: the equations end')


@pytest.mark.parametrize('how', ['reset', 'play', 'stop', 'quit'])
def test_a_reset_or_another_state_ends_the_steps(top, how):
    top.pause()
    goal, coroutine = top.steps(10 ** 18)
    coroutine.send(None)
    if how == 'reset':
        top.done('ResetSimulation', scope=0)
    else:
        name = {'play': 'PLAYING', 'stop': 'STOPPED', 'quit': 'QUITTING'}[how]
        assert top.set_state(name) == OK
    result = finished(coroutine).result
    assert (goal.end, goal.feedback) == ('aborted', [(1, 10 ** 18 - 1)])
    assert 'interrupted after 1 of' in result.error_message


# ------------------------------------------------------------------------------------ resets

@pytest.mark.parametrize('scope', [0, 3, 255])
def test_a_reset_of_time_and_state_is_that_of_the_node(top, scope):
    start = top.simulation.segment.start
    top.pause().done('StepSimulation', steps=5)
    assert top.node.set_parameters([Parameter('spin.l3', value=2.5)])[0].successful
    assert top.parameter('spin.l3') == 2.5
    top.done('ResetSimulation', scope=scope)
    assert top.simulation.now_ns == -1
    assert top.simulation.segment.start == start
    assert top.parameter('spin.l3') == start.l3
    assert top.state == STOPPED, 'a pause stays'


def test_a_reset_of_the_state_lets_time_go_on(top):
    start = top.simulation.segment.start
    top.pause().done('StepSimulation', steps=5)
    top.done('ResetSimulation', scope=2)
    assert top.simulation.now_ns == 50_000_000
    assert top.simulation.segment.start == start
    assert top.state == PAUSED
    top.done('StepSimulation', steps=1)


@pytest.mark.parametrize('scope', [1, 4, 6, 8, 128])
def test_other_scopes_are_not_supported(top, scope):
    top.pause().done('StepSimulation', steps=2)
    code, text = top.refused('ResetSimulation', scope=scope)
    assert code == UNSUPPORTED
    assert text.startswith(f'scope = {scope}: must be 0 or 255 (all), 2 (state) or 3')
    assert top.simulation.now_ns == 20_000_000


# ------------------------------------------------------------------------------------ worlds

def test_scenes_are_worlds(top):
    found = top.done('GetAvailableWorlds').worlds
    scenes = sorted(ROOT.glob('config/*.yaml'))
    assert [world.name for world in found] == [scene.stem for scene in scenes]
    for world, scene in zip(found, scenes, strict=True):
        assert Path(world.world_resource.uri).read_bytes() == scene.read_bytes()
        assert not world.world_resource.resource_string
        assert len(world.description) > 50
        assert 'SPDX' not in world.description


def test_sources_of_worlds(top, tmp_path):
    folder = tmp_path / 'more worlds'
    folder.mkdir()
    (folder / 'mine.yaml').write_text('/**: {ros__parameters: {top.mass: 3.0}}')
    (folder / 'other.yaml').write_text('/**: {ros__parameters: {imu.rate: 3.0}}')
    (folder / 'broken.yaml').write_text('{')
    # No message can hold this name.
    (folder / os.fsdecode(b'\xff.yaml')).write_bytes((folder / 'mine.yaml').read_bytes())
    for source in (str(folder), folder.as_uri(), str(folder / 'mine.yaml')):
        found = top.done('GetAvailableWorlds', additional_sources=[source]).worlds
        assert found[-1].name == 'mine'
        assert len(found) == len(list(ROOT.glob('config/*.yaml'))) + 1
    for source in (str(tmp_path / 'none'), 'https://example.org/worlds', '~nosuchuser/x',
                   str(folder / 'broken.yaml')):
        code, text = top.refused('GetAvailableWorlds', additional_sources=[source])
        assert code == FAILED
        assert source in text
        response = top.done('GetAvailableWorlds', additional_sources=[source],
                            continue_on_error=True)
        assert source in response.result.error_message
        assert len(response.worlds) == len(list(ROOT.glob('config/*.yaml')))
    tags = top.messages.TagsFilter(tags=['indoor'])
    assert top.refused('GetAvailableWorlds', filter=tags)[0] == UNSUPPORTED


def test_without_scenes_the_default_sources_have_failed(top, monkeypatch):
    monkeypatch.setattr(worlds, 'scene_files', dict)
    code, text = top.refused('GetAvailableWorlds')
    assert (code, text) == (101, 'no scene is installed')
    assert top.done('GetCurrentWorld').world.world_resource.resource_string


def load(top, uri='', text='', **more):
    return {'world_resource': top.messages.Resource(uri=uri, resource_string=text), **more}


@pytest.mark.parametrize('paused', [True, False])
@pytest.mark.parametrize('as_what', ['name', 'path', 'uri', 'text'])
def test_a_world_is_loaded_with_all_of_its_parameters(top, as_what, paused):
    path = ROOT / 'config/looping.yaml'
    given = {'name': {'uri': 'looping'}, 'path': {'uri': str(path)}, 'uri': {'uri': path.as_uri()},
             'text': {'text': path.read_text()}}[as_what]
    # What the world does not set gets its default if it belongs to the top.
    results = top.node.set_parameters([
        Parameter('initial.phi', value=0.7), Parameter('solver.method', value='exact'),
        Parameter('imu.rate', value=320.0)])
    assert all(result.successful for result in results), results
    top.done('ResetSimulation', scope=0)
    if not paused:
        top.set_state('PLAYING')
        top.wait_until(20_000_000)
    response = top.done('LoadWorld', **load(top, **given))
    expected = parameters.checked({**top.node.values, **worlds.World.read(str(path)).given,
                                   'initial.phi': 0.0, 'solver.method': 'rk45'})
    assert top.simulation.values == expected
    assert top.simulation.segment.start == parameters.start_state(expected)
    assert (top.state, top.simulation.now_ns) == (STOPPED, -1)
    assert top.parameter('imu.rate') == 320.0
    for name in ('initial.phi', 'spin.l3', 'spin.lz', 'top.mass', 'solver.method'):
        assert top.parameter(name) == expected[name], name
    current = top.done('GetCurrentWorld').world
    for world in (response.world, current):
        resource = world.world_resource
        if as_what == 'text':
            assert (world.name, resource.uri, resource.resource_string) == ('', '', given['text'])
        else:
            assert (world.name, Path(resource.uri).name) == ('looping', 'looping.yaml')
    # A reset goes back to the world's start.
    top.pause().done('StepSimulation', steps=3)
    top.done('ResetSimulation', scope=0)
    assert top.simulation.segment.start == parameters.start_state(expected)


def test_a_world_that_does_not_go_with_the_present_parameters_is_not_the_current_one(top):
    text = '/**: {ros__parameters: {top.mass: 2.0, imu.rate: 0.5}}'
    top.done('LoadWorld', **load(top, text=text))
    assert top.done('GetCurrentWorld').world.world_resource.resource_string == text
    for name, value in (('imu.rate', 100.0), ('increments.enabled', True)):
        assert top.node.set_parameters([Parameter(name, value=value)])[0].successful
    top.done('ResetSimulation', scope=0)
    assert top.done('GetCurrentWorld').world.world_resource.resource_string != text


def refusal_of(top, name, value):
    (result,) = top.node.set_parameters([Parameter(name, value=value)])
    assert not result.successful
    return result.reason


def test_means_that_are_taken_keep_the_imu_at_a_hertz(top):
    assert all(result.successful for result in top.node.set_parameters([
        Parameter('imu.sampling', value='mean')]))
    top.done('ResetSimulation', scope=0)
    assert top.node.set_parameters([Parameter('imu.sampling', value='instant')])[0].successful
    assert 'imu.rate = 0.5: must be >= 1 while means' in refusal_of(top, 'imu.rate', 0.5)
    top.done('ResetSimulation', scope=0)
    assert top.node.set_parameters([Parameter('imu.rate', value=0.5)])[0].successful


def test_increments_that_are_recorded_keep_the_imu_at_a_hertz(top):
    assert top.node.set_parameters([Parameter('increments.enabled', value=True)])[0].successful
    top.node._session.start(top.node.values)()
    assert top.node.set_parameters([Parameter('increments.enabled', value=False)])[0].successful
    assert 'must be >= 1 while' in refusal_of(top, 'imu.rate', 0.5)
    text = '/**: {ros__parameters: {top.mass: 2.0, imu.rate: 0.5}}'
    assert 'imu.rate = 0.5: must be >= 1' in top.refused('LoadWorld', **load(top, text=text))[1]
    top.node._session.stop()
    assert top.node.set_parameters([Parameter('imu.rate', value=0.5)])[0].successful


def test_a_world_in_another_encoding_is_named(top, tmp_path):
    path = tmp_path / 'latin.yaml'
    path.write_bytes(b'# \xe9t\xe9\n')
    code, text = top.refused('LoadWorld', **load(top, str(path)))
    assert code == BAD_FORMAT and f'{path}: must be in UTF-8' in text


def test_the_current_world_is_known_by_its_start(top):
    assert top.done('GetCurrentWorld').world.name == 'cusp', 'the default'
    assert top.node.set_parameters([Parameter('top.mass', value=2.25)])[0].successful
    assert top.done('GetCurrentWorld').world.name == 'cusp', 'until the reset'
    top.done('ResetSimulation', scope=0)
    world = top.done('GetCurrentWorld').world
    assert (world.name, world.world_resource.uri) == ('', '')
    before = dict(top.simulation.values)
    top.done('LoadWorld', **load(top, 'looping'))
    top.done('LoadWorld', **load(top, text=world.world_resource.resource_string))
    assert top.simulation.values == before


BAD_WORLDS = [
    ({}, NO_RESOURCE, 'must be a world'),
    ({'uri': 'no_scene'}, NOT_FOUND, 'there are the scenes cusp, '),
    ({'uri': '/nowhere/x.yaml'}, NOT_FOUND, 'there is no such file'),
    ({'uri': 'https://example.org/x.yaml'}, BAD_FORMAT, 'file:// URI'),
    ({'uri': '~nosuchuser/x.yaml'}, BAD_FORMAT, 'there is no such user'),
    ({'uri': 'a\0b'}, BAD_FORMAT, 'file:// URI'),
    ({'uri': str(ROOT / 'README.md')}, BAD_FORMAT, '*.yaml'),
    ({'uri': str(ROOT / 'config/imu/bmi088.yaml')}, PARSE_ERROR, 'is no world'),
    ({'text': '{'}, PARSE_ERROR, 'is not YAML'),
    ({'text': '#' * 1_000_001}, BAD_FORMAT, '1000001 characters; must be at most 1000000'),
    ({'text': '/**: {ros__parameters: {top.mass: !!bool maybe}}'}, PARSE_ERROR, 'bool: must be'),
    ({'text': 'x: 1'}, PARSE_ERROR, 'ros__parameters'),
    ({'text': '/**: {ros__parameters: {top.mass: -1.0}}'}, PARSE_ERROR, 'top.mass = -1.0'),
    ({'text': '/**: {ros__parameters: {top.mass: }}'}, PARSE_ERROR, 'has no value'),
    ({'text': '/**: {ros__parameters: {top.mass: 3.0, imu.rate: x}}'}, PARSE_ERROR, 'imu.rate'),
    ({'text': '/**: {ros__parameters: {initial.theta: 0.0, spin.lz: 0.5}}'}, PARSE_ERROR, 'pole'),
    ({'text': '/**: {ros__parameters: {spin.l3: 1.0e+300}}'}, FAILED, 'no motion'),
    ({'text': '/**: {ros__parameters: {top.mass: 3.0, top.size: 1}}',
      'fail_on_unsupported_element': True}, BAD_ELEMENTS, 'top.size'),
    ({'text': '/**: {ros__parameters: {top.mass: 3.0, world_frame: map}}',
      'fail_on_unsupported_element': True}, BAD_ELEMENTS, 'world_frame'),
]


@pytest.mark.parametrize(('given', 'code', 'text'), BAD_WORLDS)
def test_a_bad_world_changes_nothing(top, given, code, text):
    top.set_state('PLAYING')
    top.wait_until(20_000_000)
    before = top.node.values, dict(top.simulation.values), top.simulation.epoch_ns
    found, reason = top.refused('LoadWorld', **load(top, **given))
    assert (found, text in reason) == (code, True), (found, reason)
    assert before == (top.node.values, top.simulation.values, top.simulation.epoch_ns)
    assert top.state == PLAYING
    assert top.done('GetCurrentWorld').world.name == 'cusp'
    top.wait_until(top.simulation.now_ns + 20_000_000)


def test_an_element_that_no_message_can_hold_is_named_too(top):
    text = '/**: {ros__parameters: {top.mass: 3.0, "top.\\ud800": 1}}'
    response = top.done('LoadWorld', **load(top, text=text))
    assert response.result.error_message.endswith(': top.\\ud800')
    assert response.result.error_message.isascii()


def test_unsupported_elements_are_named(top):
    text = ('/**: {ros__parameters: {top.mass: 3.0, top.size: 1, use_sim_time: true, '
            'pacing: timer}}')
    response = top.done('LoadWorld', **load(top, text=text))
    assert response.result.error_message.endswith(': top.size, pacing')
    assert top.simulation.top.mass == 3.0


# --------------------------------------------------------------------------------- recording

@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_a_log_of_all_this_verifies(monkeypatch, tmp_path, capsys, method):
    """States, resets and worlds are in the journal: the run can be computed again."""
    with StandardNode(
            'stand-in', monkeypatch, tmp_path, solver__method=method, increments__enabled=True,
            markers__enabled=True, mag__enabled=True, imu__lever_arm=[0.1, 0.0, 0.02],
            imu__gyroscope_noise_density=1e-3, imu__gyroscope_bias_stddev=0.1) as top:
        state = top.messages.EntityState()
        state.twist.angular.x, state.pose.orientation.w = 0.5, 1.0
        state.twist.angular.z = 11.0
        top.pause().done('StepSimulation', steps=3)
        top.done('SetEntityState', entity='spinning_top', state=state, set_twist=True)
        top.done('StepSimulation', steps=3)
        top.node._session.start(top.node.values)()
        top.done('StepSimulation', steps=7)
        top.done('SetEntityState', entity='spinning_top', state=state, set_pose=True,
                 set_twist=True)
        top.done('StepSimulation', steps=11)
        top.done('ResetSimulation', scope=2)
        top.done('StepSimulation', steps=5)
        top.done('LoadWorld', **load(top, 'waking_sleeper'))
        top.pause().done('StepSimulation', steps=20)
        top.done('SetEntityState', entity='spinning_top', state=state, set_pose=True)
        top.done('StepSimulation', steps=13)
        top.node._session.stop()
    code = inspect.main([f'{tmp_path}/run.mcap', '--verify', '--json'])
    content = json.loads(capsys.readouterr().out)
    assert (code, content['verify']['identical']) == (0, True), content['verify']
    assert [motion['cause'] for motion in content['motions']] == [
        'start', 'state', 'state', 'reset', 'state']
    assert inspect.main([f'{tmp_path}/run.mcap']) == 0
    assert re.search('1 resets, .*, 3 states set', capsys.readouterr().out)


# ------------------------------------------------------------------------- where it is absent

START = """
import importlib.util, sys, rclpy

def find_spec(name, found=importlib.util.find_spec):
    return {spec} if name == 'simulation_interfaces' else found(name)

importlib.util.find_spec = find_spec
from spinning_top_sim.nodes.simulator import Simulator
rclpy.init(args=['sim_node', '--ros-args', '-p', 'simulation_interfaces:={offered}'])
node = Simulator()
print(sorted(name for name in sys.modules if name in (
    'rclpy.action.server', 'simulation_interfaces') or name.startswith(
    ('spinning_top_sim.nodes.simulation_', 'spinning_top_sim.tools.'))))
node.stop()
node.destroy_node()
rclpy.try_shutdown()
"""


@pytest.mark.parametrize(('spec', 'offered'), [('None', 'true'), ('object()', 'false')])
def test_without_the_package_or_switched_off_nothing_is_imported(spec, offered):
    done = subprocess.run(
        [sys.executable, '-c', START.format(spec=spec, offered=offered)], capture_output=True,
        text=True, timeout=120, check=True)
    assert done.stdout == '[]\n', done.stderr
