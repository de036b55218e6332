# SPDX-License-Identifier: Apache-2.0
"""Constants and states of the top, attitude mathematics, regimes: no ROS."""

import math

import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top, solve
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.shape import LARGEST, SMALLEST, THINNEST, Shape
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters

TOP = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': 9.80665}
STATE = {'theta': 0.7, 'theta_dot': 0.4, 'phi': 0.3, 'psi': -1.2, 'l3': 1.6, 'lz': 1.1}


@pytest.mark.parametrize(('make', 'given', 'field', 'value'), [
    *((Top, TOP, field, value) for field, value in (
        ('lambda1', 0.0), ('lambda3', math.inf), ('mass', -2.0), ('gravity', math.nan),
        ('lambda3', 9e-51), ('com_distance', -2e50), ('mass', None), ('gravity', True),
        ('mass', 10 ** 400))),
    *((State, STATE, field, value) for field, value in (
        ('theta', -1e-300), ('theta', math.nextafter(math.pi, 4.0)), ('phi', math.nan),
        ('lz', '1.0 kg'))),
    *((State.from_rates, {'theta': 0.5, 'top': Top(**TOP), 'precession': 1.0, 'spin': 2.0},
       field, value) for field, value in (
           ('theta', -0.1), ('theta', math.nan), ('precession', math.nan), ('spin', '3 rad/s')))])
def test_a_bad_constant_state_or_rate_is_refused_by_name_and_value(make, given, field, value):
    with pytest.raises(ValueError, match=rf'{field} = .*must ') as error:
        make(**{**given, field: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize(('theta', 'lz', 'pole'), [
    (0.0, -1.6, 'l3 = 1.6'), (math.pi, 1.6, '-l3 = -1.6')])
def test_at_a_pole_only_one_momentum_is_possible(theta, lz, pole):
    with pytest.raises(ValueError, match=rf'^lz = {lz} kg .* {theta} rad\) it must equal {pole}$'):
        State(**{**STATE, 'theta': theta, 'lz': lz})


@pytest.mark.parametrize('theta', [0.0, 1e-9, 0.7, 3.0, math.pi])
def test_a_state_from_rates_turns_at_them(theta):
    top, turning = Top(**TOP), State.from_rates
    assert turning(theta, 3.0, top=top) == turning(theta, 3.0, 0.0, 0.0, top=top, phi=0, psi=0)
    assert turning(math.pi, 3.0, spin=3.0, top=top).lz == 0.0       # sin(pi) is not 0 in doubles
    state = turning(theta, 3.0, -0.4, 12.0, top=top, phi=0.2, psi=-1.0)
    motion = solve(top, state, [0.0])
    assert (state.theta, state.phi, state.psi) == (theta, 0.2, -1.0)
    assert motion.theta_dot[0] == pytest.approx(-0.4, rel=1e-14)
    # At a pole only the sum or the difference of the two has a meaning.
    turned = motion.psi_dot[0] + motion.phi_dot[0] * math.cos(theta)
    assert turned == pytest.approx(12.0 + 3.0 * math.cos(theta), rel=1e-14)
    if 1e-3 < theta < math.pi - 1e-3:
        assert motion.phi_dot[0] == pytest.approx(3.0, rel=1e-13)


@pytest.mark.parametrize(('start', 'expected'), [
    (-2.0, (0.5, 0.0, 2.5)), (0.0, (-1.0, -2.0, 3.0)),
    (5e-324, (-1.7976931348623157e308, -1.7976931348623157e308, 1.7976931348623157e308))])
def test_a_drift_is_relative_absolute_where_the_constant_is_0_and_finite(start, expected):
    assert tuple(relative_drift(np.array([-1.0, -2.0, 3.0]), start)) == expected


@pytest.mark.parametrize('seed', range(20))
def test_attitude_rates_and_energy_are_those_of_the_euler_angles(seed):
    """Of random states, by an independent library; the rates are those of the Lagrangian."""
    rng = np.random.default_rng(seed)
    start = State(theta=rng.uniform(0.01, math.pi - 0.01), **dict(zip(
        ('l3', 'lz', 'theta_dot', 'phi', 'psi'), rng.normal(size=5), strict=True)))
    state = solve(Top(**TOP), start, [0.0], method='rk45', equations='euler')
    rotation, phi_dot, psi_dot = (
        Rotation.from_quat(state.quaternion[0]), state.phi_dot[0], state.psi_dot[0])
    expected = Rotation.from_euler('ZYZ', (start.phi, start.theta, start.psi))
    assert (rotation * expected.inv()).magnitude() < 1e-14
    # Eq. (1): phi' z + theta' e2' + psi' e3.
    e2 = Rotation.from_euler('Z', start.phi).apply((0.0, 1.0, 0.0))
    world = (phi_dot * np.array((0.0, 0.0, 1.0)) + start.theta_dot * e2
             + psi_dot * rotation.apply((0.0, 0.0, 1.0)))
    assert rotation.inv().apply(world) == pytest.approx(
        state.angular_velocity[0], abs=1e-14 * (1.0 + abs(phi_dot) + abs(psi_dot)))
    # Eqs. (13), (14).
    top, c, s = state.top, math.cos(start.theta), math.sin(start.theta)
    kinetic = (0.5 * top.lambda1 * (phi_dot ** 2 * s * s + start.theta_dot ** 2)
               + start.l3 ** 2 / (2.0 * top.lambda3))
    assert state.energy[0] == pytest.approx(kinetic + top.gravity_torque * c)


SCENE_NAMES = {
    'cusp': 'cusps', 'looping': 'loops', 'wavy': 'waves', 'steady_slow': 'steady precession',
    'steady_fast': 'steady precession', 'sleeping': 'sleeping', 'free_top': 'free top',
    'spherical_pendulum': 'spherical pendulum', 'fast_gyroscope': 'cusps',
    'planar_pendulum': 'planar pendulum, rotating', 'waking_sleeper': 'cusps',
    'near_separatrix': 'waves', 'heavy_top': 'loops'}


@pytest.mark.parametrize('scene', SCENES)
def test_every_scene_is_valid_the_motion_it_says_and_drawn_with_its_mass_and_moments(scene):
    values = parameters.checked(scene_parameters(scene))
    top = parameters.top_of(values)
    assert top.is_realizable
    solution = ExactSolution(top, parameters.start_state(values))
    assert solution.describe().name == SCENE_NAMES[scene]
    shape = Shape(top)
    assert 0.5 * top.mass * shape.radius ** 2 == pytest.approx(top.lambda3, rel=1e-12)
    if shape.height > THINNEST * shape.radius:
        across = top.mass * (3.0 * shape.radius ** 2 + shape.height ** 2) / 12.0
        assert across + top.mass * shape.centre ** 2 == pytest.approx(top.lambda1, rel=1e-12)
    assert shape.centre == top.com_distance
    assert abs(shape.tip) > abs(shape.centre) + 0.5 * shape.height


@pytest.mark.parametrize('changed', [
    {'mass': 0.0}, {'com_distance': -0.15}, {'com_distance': 0.0}, {'lambda3': 1.0},
    {'mass': 5e-324}, {'lambda1': 1e50, 'lambda3': 1e50}, {'lambda1': 1e-50, 'lambda3': 1e-50}])
def test_every_top_can_be_drawn(changed):
    shape = Shape(Top(**{**TOP, **changed}))
    assert (shape.tip < 0.0) == (changed.get('com_distance', 0.0) < 0.0)
    assert SMALLEST <= shape.radius <= LARGEST and SMALLEST <= shape.height <= LARGEST
    assert math.isfinite(shape.tip)


AT_A_POLE = [
    (0.0, 0.0, math.nextafter(2.0, 3.0), 1.0, 'sleeping'),
    (0.0, 0.0, 2.0, 1.0, 'sleeping, unstable'), (0.0, 0.0, -2.0, 1.0, 'sleeping, unstable'),
    (math.pi, 0.0, 2.0, -1.0, 'hanging'), (0.8, -3.5, 0.5, 1.0, 'through the top'),
    (2.0, 3.5, 0.5, -1.0, 'through the bottom'), (0.0, 0.0, 0.0, 0.0, 'at rest')]


@pytest.mark.parametrize(('theta', 'theta_dot', 'l3', 'lz', 'name'), AT_A_POLE)
def test_a_motion_at_or_through_a_pole_has_its_name(theta, theta_dot, l3, lz, name):
    """It sleeps where L3^2 > 4 lambda1 |P|; with these constants both sides are exact."""
    top = Top(lambda1=0.5, lambda3=0.5, mass=1.0, com_distance=1.0, gravity=2.0)
    described = ExactSolution(
        top, State(theta=theta, theta_dot=theta_dot, l3=l3, lz=lz * l3)).describe()
    assert described.name == name and described.gyroscopic_ratio == 0.25 * l3 * l3
    assert (described.nutation_period is None) == (theta_dot == 0.0)


NOT_ABOVE = [
    (-0.15, 0.0, 3.0, 3.0, 'hanging'), (-0.15, math.pi, 3.0, -3.0, 'sleeping'),
    (-0.15, 1.0, 0.0, 0.0, 'planar pendulum, swinging'), (-0.15, 2.2, 0.6, -0.6, 'waves'),
    (0.0, 0.7, 0.0, 0.0, 'at rest')]


@pytest.mark.parametrize(('distance', 'theta', 'l3', 'lz', 'name'), NOT_ABOVE)
def test_a_centre_of_mass_that_is_not_above_the_pivot(distance, theta, l3, lz, name):
    top, state = Top(**{**TOP, 'com_distance': distance}), State(theta=theta, l3=l3, lz=lz)
    described = ExactSolution(top, state).describe()
    assert described.name == name
    assert described.theta_min - 1e-15 <= theta <= described.theta_max + 1e-15


@pytest.mark.parametrize(('theta', 'theta_dot', 'l3', 'lz', 'name'), [
    (0.6, 0.0, 1.6, 1.0, 'loops'), (2.0, 0.0, 1.0, -math.cos(2.0), 'loops'),
    (1.2, 0.5, 0.3, 0.5, 'waves'), (1.2, 0.5, -0.3, 0.5, 'waves'),
    (1.0, 2.0, -0.3, -0.6, 'waves'), (2.0, 1.0, 0.3, -0.5, 'waves'),
    (0.9, 0.0, 1.6, 1.6, 'through the top'), (1.0, 0.0, 0.0, 0.0, 'planar pendulum, swinging')])
def test_the_extremes_are_those_of_the_motion(theta, theta_dot, l3, lz, name):
    """Of phi' and theta, sampled over a nutation: inside the swing, at its ends, at a pole."""
    top, start = Top(**TOP), State(theta=theta, theta_dot=theta_dot, l3=l3, lz=lz)
    description = ExactSolution(top, start).describe()
    motion = solve(top, start, np.linspace(0.0, description.nutation_period, 20_001))
    assert description.name == name
    for low, high, column in (
            (description.precession_min, description.precession_max, motion.phi_dot),
            (description.theta_min, description.theta_max, motion.theta_folded)):
        width = column.max() - column.min()
        assert low - 1e-12 * width <= column.min() <= low + 1e-5 * width
        assert high - 1e-5 * width <= column.max() <= high + 1e-12 * width
    for mean, angle in ((description.mean_precession_rate, motion.phi),
                        (description.mean_spin_rate, motion.psi)):
        assert mean * description.nutation_period == pytest.approx(
            angle[-1] - angle[0], rel=1e-12, abs=1e-12)
