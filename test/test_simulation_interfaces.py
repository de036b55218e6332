# SPDX-License-Identifier: Apache-2.0
"""
What a node does for simulation_interfaces: states, steps, resets, features, and its entity.

The handlers are called as the executor calls them, with the installed messages or stand-ins.
"""

import functools
import importlib
import importlib.util
import math

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import Pose, Quaternion, Twist, Vector3
from helpers import standard_types
from helpers.node_logs import events_in, log_of, verified, xyz, xyzw
from helpers.own_node import OwnNode
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from spinning_top_sim.nodes.simulation_handlers import FEATURES, SimulationHandlers

UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
ALREADY = INVALID_POSE = 101
TRANSITION_ERROR, INCORRECT_TRANSITION = 102, 103
NAME = 'spinning_top'


class StandardNode(OwnNode):
    """The node, which starts paused; `call` calls a handler as the executor calls it."""

    def __init__(self, folder, **values):
        super().__init__(folder, start_paused=True, **values)
        self.messages, self.services = [
            importlib.import_module(f'simulation_interfaces.{part}') for part in ('msg', 'srv')
        ] if importlib.util.find_spec('simulation_interfaces') else standard_types.modules()
        self.handlers = SimulationHandlers(self.node, self.messages)

    def call(self, name, **request):
        """Return the response to a request with these fields."""
        service = getattr(self.services, name)
        return self.handlers.serve(name, service.Request(**request), service.Response())

    def done(self, name, **request):
        """Return the response to a request that succeeds."""
        response = self.call(name, **request)
        assert response.result.result == OK, response.result.error_message
        return response

    def refused(self, name, **request):
        """Return the code of a refusal, and its text."""
        result = self.call(name, **request).result
        assert result.error_message
        return result.result, result.error_message

    def put(self, numbers=None, *, state=None, **flags):
        """Return a request to set a state, by default upright but for numbers by their paths."""
        state = state or self.messages.EntityState(pose=Pose(orientation=Quaternion(w=1.0)))
        for path, value in (numbers or {}).items():
            *way, name = path.split('.')
            setattr(functools.reduce(getattr, way, state), name, value)
        return {'entity': NAME, 'state': state, 'set_pose': True, 'set_twist': True, **flags}

    @property
    def entity(self):
        return self.done('GetEntityState', entity=NAME).state

    @property
    def state(self):
        return self.done('GetSimulationState').state.state

    def set_state(self, name):
        """Ask for a state; return the code of the result."""
        number = getattr(self.messages.SimulationState, f'STATE_{name}')
        return self.call('SetSimulationState', state=self.messages.SimulationState(
            state=number)).result.result

    def pause(self, steps=0):
        """Leave the stopped state, and make some steps."""
        assert self.set_state('PAUSED') == OK
        if steps:
            self.done('StepSimulation', steps=steps)


@pytest.fixture
def top(tmp_path):
    with StandardNode(tmp_path) as top:
        yield top


def numbers(state):
    """Return attitude, angular velocity and acceleration of an EntityState, as one array."""
    return np.array([*xyzw(state.pose.orientation), *xyz(state.twist.angular),
                     *xyz(state.acceleration.angular)])


def test_states_change_as_the_standard_says(top):
    for name, code, state in (('STOPPED', ALREADY, STOPPED), ('PAUSED', OK, PAUSED),
                              ('PAUSED', ALREADY, PAUSED), ('STOPPED', OK, STOPPED),
                              ('PLAYING', OK, PLAYING), ('PLAYING', ALREADY, PLAYING)):
        assert (top.set_state(name), top.state) == (code, state)
        sent_ns = top.simulation.sent_ns
        assert sent_ns == {STOPPED: -1, PAUSED: 0, PLAYING: max(sent_ns, 0)}[state]
    top.wait_until(50_000_000)
    assert (top.set_state('PAUSED'), top.state) == (OK, PAUSED)
    assert (top.set_state('STOPPED'), top.state, top.simulation.sent_ns) == (OK, STOPPED, -1)


def test_what_is_offered_is_told_and_the_rest_refused_with_its_values(top):
    known, messages = top.messages.SimulatorFeatures, top.messages
    found = {*top.call('GetSimulatorFeatures').features.features}
    assert found == {getattr(known, name) for row in FEATURES.values() for name in row}
    info = top.done('GetEntityInfo', entity=NAME).info
    assert info.category.category == messages.EntityCategory.CATEGORY_ROBOT
    assert 'mass=2.0' in info.description and 'imu' in info.tags
    assert top.refused('StepSimulation', steps=1) == (
        FAILED, 'the simulation is STOPPED: must be PAUSED')
    top.pause()
    for service, request, code, text in (
            ('SetSimulationState', {'state': messages.SimulationState(state=4)},
             INCORRECT_TRANSITION, 'state = 4 from PAUSED: must be one of'),
            ('StepSimulation', {'steps': 0}, FAILED, 'steps = 0: must be >= 1'),
            ('ResetSimulation', {'scope': 1}, UNSUPPORTED, 'scope = 1: must be 0, 255 or 3'),
            ('GetEntityState', {'entity': 'Top'}, NOT_FOUND,
             "entity = 'Top': must be 'spinning_top'"),
            *((service, {'filters': messages.EntityFilters(**filters)}, UNSUPPORTED,
               'filters must be empty') for service in ('GetEntities', 'GetEntitiesStates')
              for filters in ({'filter': 'top'}, {'categories': [messages.EntityCategory()]},
                              {'tags': messages.TagsFilter(tags=['imu'])},
                              {'bounds': messages.Bounds(type=1)}))):
        found, said = top.refused(service, **request)
        assert (found, said[:len(text)]) == (code, text)
    assert top.done('GetEntities').entities == [NAME]


def test_a_failed_motion_is_paused_until_it_is_stopped_and_quitting_ends_the_node(top):
    top.pause()
    top.loop.fail('the equations end')
    response = top.done('GetSimulationState')
    assert (response.state.state, response.result.error_message) == (PAUSED, 'the equations end')
    code, text = top.refused('SetSimulationState', state=top.messages.SimulationState(
        state=PLAYING))
    assert code == TRANSITION_ERROR and 'the equations end' in text
    assert (top.set_state('STOPPED'), top.state, top.loop.failure) == (OK, STOPPED, None)
    assert (top.set_state('QUITTING'), top.state, top.set_state('QUITTING')) == (
        OK, QUITTING, ALREADY)
    assert top.set_state('PLAYING') == INCORRECT_TRANSITION
    assert top.refused('ResetSimulation', scope=0)[0] == INCORRECT_STATE
    for refused in (top.trigger('reset').message, top.switch('set_pause', False).message,
                    top.set(step__dt=0.02, pose__enabled=False).reason,
                    top.set(spin__l3=2.0).reason):
        assert (refused, top.state) == ('at the end: nothing follows', QUITTING)
    assert [one for one in top.node.publishers if one.topic_name == '/pose']
    top.spin_until('the end', top.node.finished.done)
    assert top.node.finished.result() is None       # exit code 0


def test_a_reset_begins_the_motion_again_or_lets_time_go_on(top):
    start = numbers(top.entity)
    assert top.set(step__dt=1.0 / 3.0).successful
    for scope, now_ns, state in ((0, -1, STOPPED), (3, -1, STOPPED), (2, 999_999_999, PAUSED)):
        top.pause(steps=3)
        assert top.set(spin__l3=2.5).successful
        top.done('ResetSimulation', scope=scope)
        assert (top.simulation.sent_ns, top.state, top.get('spin.l3')) == (now_ns, state, [1.6])
        assert (numbers(top.entity) == start).all()


def test_a_log_of_all_this_verifies_and_has_the_states(top, tmp_path):
    """States and resets are events; a state is bit by bit what is published at its stamp."""
    path = tmp_path / 'run.mcap'
    top.pause(steps=3)
    assert top.switch('record', True).success
    top.done('SetEntityState', **top.put({'twist.angular.x': 0.5, 'twist.angular.z': 11.0}))
    top.done('ResetSimulation', scope=2)
    top.done('StepSimulation', steps=25)
    state, (other,) = top.entity, top.done('GetEntitiesStates').states
    assert (numbers(other) == numbers(state)).all() and state.header.frame_id == 'world'
    assert top.switch('record', False).success
    assert verified(path)['identical']
    log = log_of(path)[0]
    assert [event['event'] for event in events_in(log)] == ['start', 'state', 'state']
    odom = deserialize_message(log['/ground_truth/odom'][-1][1], Odometry)
    assert state.header.stamp == odom.header.stamp
    assert xyzw(state.pose.orientation) == xyzw(odom.pose.pose.orientation)
    # The twist of an odometry is in the frame of the body.
    turned = Rotation.from_quat(xyzw(odom.pose.pose.orientation)).apply(
        xyz(odom.twist.twist.angular))
    assert np.allclose(numbers(state)[4:7], turned, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize('which', ['pose', 'twist'])
def test_a_state_that_is_set_is_the_state(top, which):
    top.pause(steps=20)
    before, q, rates = numbers(top.entity), (0.2, -0.4, 0.4, 0.8), (1.0, -2.0, 9.0)
    wanted = {f'pose.orientation.{axis}': value for axis, value in zip('xyzw', q, strict=True)} | {
        f'twist.angular.{axis}': value for axis, value in zip('xyz', rates, strict=True)}
    top.done('SetEntityState', **top.put(wanted, set_pose=which == 'pose',
                                         set_twist=which == 'twist'))
    expected = ([*q, *before[4:7]] if which == 'pose' else [*before[:4], *rates])
    assert np.allclose(numbers(top.entity)[:7], expected, rtol=0.0, atol=1e-12)
    now = top.simulation.state()
    assert top.get('spin.l3', 'spin.lz') == pytest.approx(
        [float(now.l3[0]), float(now.lz[0])], rel=1e-12), 'the parameters show the spin'


BAD_STATES = [
    ({'pose.position.x': 0.1}, INVALID_POSE, 'pose.position [m] = [0.1, 0.0, 0.0]: must be'),
    ({'pose.orientation.w': 0.9}, INVALID_POSE, '[0.0, 0.0, 0.0, 0.9]: must have the length 1'),
    ({'pose.orientation.x': math.nan}, INVALID_POSE, 'must have the length 1'),
    ({'twist.linear.y': 0.5}, FAILED, 'twist.linear [m/s] = [0.0, 0.5, 0.0]: must be that of'),
    ({'twist.angular.z': math.inf}, FAILED, 'twist.angular = [0.0, 0.0, inf] rad/s: must be'),
    ({'twist.angular.z': 1e200}, FAILED, 'must be a number of at most 1e+50'),
    ({'header.frame_id': 'map'}, UNSUPPORTED, "header.frame_id = 'map': must be 'world'"),
]


def test_a_bad_state_changes_nothing(top):
    top.pause(steps=5)
    before = top.entity
    for changes, code, text in BAD_STATES:
        found, reason = top.refused('SetEntityState', **top.put(changes))
        assert (found, text in reason) == (code, True), (found, reason)
        assert (numbers(top.entity) == numbers(before)).all()


def test_a_state_can_be_set_where_the_pivot_is(top):
    top.pause()
    top.receive('cmd_vel', Twist(linear=Vector3(x=0.5)))
    top.done('StepSimulation', steps=30)
    state = top.entity
    assert state.pose.position.x > 0.01 and state.twist.linear.x > 0.1
    assert top.refused('SetEntityState', **top.put(set_twist=False))[0] == INVALID_POSE
    top.done('SetEntityState', **top.put(state=state))
    after = top.entity
    assert xyz(after.pose.position) == xyz(state.pose.position)
    assert xyz(after.twist.linear) == xyz(state.twist.linear)
    assert numbers(after)[:7] == pytest.approx(numbers(state)[:7], abs=1e-12)


def test_before_the_clock_and_after_the_end_nothing_can_be_set(tmp_path):
    with StandardNode(tmp_path, use_sim_time=True) as top:
        top.loop.paused = False
        for state in ('PLAYING', 'PAUSED'):
            assert (top.set_state(state), top.state) == (TRANSITION_ERROR, STOPPED)
        assert not top.loop.paused
        assert top.refused('StepSimulation', steps=1) == (
            INCORRECT_STATE, 'waiting for /clock (use_sim_time is set)')
    with StandardNode(tmp_path, duration=0.05) as top:
        top.pause()
        assert top.refused('StepSimulation', steps=6) == (
            FAILED, 'at t = 0.050000000 s: `duration` ends before the steps do')
        assert top.state == QUITTING
