# SPDX-License-Identifier: Apache-2.0
"""The top as the entity of simulation_interfaces: what it says, and what can be set."""

import math

import numpy as np
import pytest

pytest.importorskip('rclpy')

from helpers.node_logs import log_of, xyz, xyzw
from helpers.standard_node import standard_node  # noqa: F401, a fixture
from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
PAUSED, INVALID_POSE = 2, 101
NAME = 'spinning_top'


@pytest.fixture
def top(stopped):
    return stopped.pause()


def numbers(state):
    """Return attitude, angular velocity and acceleration of an EntityState, as one array."""
    assert xyz(state.pose.position) == xyz(state.twist.linear) == (0.0, 0.0, 0.0)
    assert xyz(state.acceleration.linear) == (0.0, 0.0, 0.0)
    return np.array([*xyzw(state.pose.orientation), *xyz(state.twist.angular),
                     *xyz(state.acceleration.angular)])


def state_of(top):
    return top.done('GetEntityState', entity=NAME).state


def test_the_state_is_what_is_published_at_its_stamp(top, tmp_path):
    """Bit by bit against the log: attitude and rates of ground_truth/odom."""
    assert top.set(record__uri=str(tmp_path / 'run.mcap')).successful
    assert top.switch('record', True).success
    found = {}
    for _ in range(12):
        top.done('StepSimulation', steps=3)
        state = state_of(top)
        assert state.header.frame_id == 'world'
        found[state.header.stamp.sec, state.header.stamp.nanosec] = state
        (other,) = top.done('GetEntitiesStates').states
        assert (numbers(other) == numbers(state)).all()
    assert top.switch('record', False).success
    logged = [deserialize_message(data, Odometry)
              for _, data in log_of(tmp_path / 'run.mcap')[0]['/ground_truth/odom']]
    published = {(one.header.stamp.sec, one.header.stamp.nanosec): one for one in logged}
    assert len(found) == 12
    for stamp, state in found.items():
        odom = published[stamp]
        assert xyzw(state.pose.orientation) == xyzw(odom.pose.pose.orientation)
        # The twist of an odometry is in the frame of the body.
        turned = Rotation.from_quat(xyzw(odom.pose.pose.orientation)).apply(
            xyz(odom.twist.twist.angular))
        assert np.allclose(numbers(state)[4:7], turned, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize('which', ['pose', 'twist', 'both'])
def test_a_state_that_is_set_is_the_state(top, which):
    top.done('StepSimulation', steps=20)
    before = numbers(state_of(top))
    wanted = top.messages.EntityState()
    q = np.array([0.2, -0.5, 0.4, 0.7])
    q /= np.linalg.norm(q)
    for name, value in zip('xyzw', q.tolist(), strict=True):
        setattr(wanted.pose.orientation, name, value)
    for name, value in zip('xyz', (1.0, -2.0, 9.0), strict=True):
        setattr(wanted.twist.angular, name, value)
    response = top.done('SetEntityState', entity=NAME, state=wanted,
                        set_pose=which != 'twist', set_twist=which != 'pose')
    assert not response.result.error_message
    after = numbers(state_of(top))
    expected = np.concatenate([before[:4] if which == 'twist' else q,
                               before[4:7] if which == 'pose' else (1.0, -2.0, 9.0)])
    assert np.allclose(after[:7], expected, rtol=0.0, atol=1e-12)
    assert top.state == PAUSED
    assert top.simulation.now_ns == 200_000_000
    # The parameters show the spin, and the motion goes on from there.
    assert top.get('spin.l3', 'spin.lz') == pytest.approx(
        [float(top.simulation.state().l3[0]), float(top.simulation.state().lz[0])], rel=1e-12)
    top.done('StepSimulation', steps=1)
    moved = numbers(state_of(top))
    assert np.allclose(moved[4:7], after[4:7] + 0.01 * after[7:], rtol=0.0, atol=0.05)
    # A reset is back at the start.
    top.done('ResetSimulation', scope=0)
    assert top.get('spin.l3') == [1.6]


def upright(top, **changes):
    """Return a state with these numbers, by paths such as twist__linear__x."""
    state = top.messages.EntityState()
    state.pose.orientation.w = 1.0
    for path, value in changes.items():
        *way, name = path.split('__')
        target = state
        for part in way:
            target = getattr(target, part)
        setattr(target, name, value)
    return state


BAD_STATES = [
    ({'pose__position__x': 0.1}, INVALID_POSE, 'pose.position = [0.1, 0.0, 0.0] m: must be'),
    ({'pose__position__z': math.nan}, INVALID_POSE, 'pose.position = [0.0, 0.0, nan] m: must be'),
    ({'pose__orientation__w': 0.9}, INVALID_POSE, 'has length 0.9: must be 1'),
    ({'pose__orientation__x': math.nan}, INVALID_POSE, 'has length nan: must be 1'),
    ({'twist__linear__y': 0.5}, FAILED, 'twist.linear = [0.0, 0.5, 0.0] m/s: must be that of'),
    ({'twist__angular__z': math.inf}, FAILED, 'twist.angular = [0.0, 0.0, inf] rad/s: must be'),
    ({'twist__angular__z': 1e200}, FAILED, 'no motion from'),
    ({'header__frame_id': 'map'}, UNSUPPORTED, "header.frame_id = 'map': must be 'world'"),
]


@pytest.mark.parametrize(('changes', 'code', 'text'), BAD_STATES)
def test_a_bad_state_changes_nothing(top, changes, code, text):
    top.done('StepSimulation', steps=5)
    before = state_of(top)
    found, reason = top.refused('SetEntityState', entity=NAME, state=upright(top, **changes),
                                set_pose=True, set_twist=True)
    assert (found, text in reason) == (code, True), (found, reason)
    assert (numbers(state_of(top)) == numbers(before)).all()


@pytest.mark.parametrize(('x', 'w', 'theta'), [(3e-9, 1.0, 0.0), (1.0, 3e-9, math.pi)])
def test_next_to_a_pole_what_is_not_spin_is_nutation(top, x, w, theta):
    state = upright(top, pose__orientation__x=x, pose__orientation__w=w, twist__angular__x=0.3,
                    twist__angular__z=2.0)
    top.done('SetEntityState', entity=NAME, state=state, set_pose=True, set_twist=True)
    start = top.simulation.state()
    assert start.theta == theta and abs(start.lz) == abs(start.l3)
    assert start.theta_dot == pytest.approx(0.3)


def test_a_state_can_be_set_where_the_pivot_is(top):
    """What the node says of a moving pivot can be sent back to it, and nothing else."""
    top.loop.drive((0.5, 0.0, 0.0))
    top.done('StepSimulation', steps=30)
    state = state_of(top)
    assert state.pose.position.x > 0.01 and state.twist.linear.x > 0.1
    assert top.refused('SetEntityState', entity=NAME, state=upright(top), set_pose=True,
                       set_twist=False)[0] == INVALID_POSE
    state.pose.orientation.x += 0.05        # and scaled to a unit quaternion
    size = math.hypot(*xyzw(state.pose.orientation))
    for name, value in zip('xyzw', xyzw(state.pose.orientation), strict=True):
        setattr(state.pose.orientation, name, value / size)
    top.done('SetEntityState', entity=NAME, state=state, set_pose=True, set_twist=True)
    after = state_of(top)
    for one, other in ((state.pose, after.pose), (state.twist, after.twist)):
        for part in type(one).get_fields_and_field_types():
            assert [getattr(getattr(one, part), axis) for axis in 'xyz'] == pytest.approx(
                [getattr(getattr(other, part), axis) for axis in 'xyz'], abs=1e-12)
    top.done('StepSimulation', steps=1)
    assert state_of(top).pose.position.x > after.pose.position.x


@pytest.mark.parametrize(('service', 'name'), [
    ('GetEntityState', ''), ('SetEntityState', 'Spinning_top'),
    ('GetEntityInfo', '/spinning_top')])
def test_there_is_one_entity(top, service, name):
    code, text = top.refused(service, entity=name)
    assert (code, text) == (NOT_FOUND, f"entity = {name!r}: there is 'spinning_top' only")


def test_what_the_entity_is(top):
    info = top.done('GetEntityInfo', entity=NAME).info
    assert info.category.category == top.messages.EntityCategory.CATEGORY_ROBOT
    assert 'mass 2 kg' in info.description
    assert list(info.tags) == ['spinning_top', 'heavy_symmetric_top', 'imu']


@pytest.mark.parametrize('service', ['GetEntities', 'GetEntitiesStates'])
def test_filters_are_refused_as_there_is_one_entity(top, service):
    assert top.done(service).entities == [NAME]
    category = top.messages.EntityCategory(category=1)
    for filters in ({'filter': 'top'}, {'categories': [category]},
                    {'tags': top.messages.TagsFilter(tags=['imu'])},
                    {'bounds': top.messages.Bounds(type=1)}):
        assert top.refused(service, filters=top.messages.EntityFilters(**filters)) == (
            UNSUPPORTED, 'filters must be empty: there is one entity')
