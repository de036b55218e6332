# SPDX-License-Identifier: Apache-2.0
"""Constants and states of the top, attitude mathematics, regimes: no ROS, no solver."""

import math

import numpy as np
import pytest
from helpers.reference import CASES, SCENES, scene_parameters, start_of, top_of
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.kinematics import AxisState
from spinning_top_sim.physics.regimes import regime, swing
from spinning_top_sim.streams import parameters

TOP = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': 9.80665}
STATE = {'theta': 0.7, 'theta_dot': 0.4, 'phi': 0.3, 'psi': -1.2, 'l3': 1.6, 'lz': 1.1}


@pytest.mark.parametrize(('field', 'value'), [
    ('lambda1', 0.0), ('lambda1', -1.0), ('lambda1', math.nan), ('lambda3', 0.0),
    ('lambda3', math.inf), ('mass', -2.0), ('gravity', math.nan), ('com_distance', -math.inf),
    ('mass', 'heavy'), ('mass', None), ('gravity', True), ('mass', 10 ** 400)])
def test_a_bad_constant_is_refused_by_name_and_value(field, value):
    with pytest.raises(ValueError, match=rf'{field} = .*must be') as error:
        Top(**{**TOP, field: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize(('field', 'value'), [
    ('theta', -1e-300), ('theta', math.nextafter(math.pi, 4.0)), ('theta', math.nan),
    ('theta_dot', math.inf), ('phi', math.nan), ('psi', -math.inf), ('l3', math.nan),
    ('lz', '1.0 kg')])
def test_a_bad_state_is_refused_by_name_and_value(field, value):
    with pytest.raises(ValueError, match=rf'{field} = .*must be') as error:
        State(**{**STATE, field: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize(('theta', 'lz', 'allowed'), [(0.0, 1.5, 1.6), (math.pi, 1.6, -1.6)])
def test_at_a_pole_only_one_lz_is_possible(theta, lz, allowed):
    with pytest.raises(ValueError, match=rf'lz = {lz} .*{allowed}'):
        State(**{**STATE, 'theta': theta, 'lz': lz})
    assert State(**{**STATE, 'theta': theta, 'lz': allowed}).lz == allowed


def test_negative_distances_and_gravity_are_legal():
    assert Top(**{**TOP, 'com_distance': -0.1}).gravity_torque < 0.0
    assert Top(**{**TOP, 'gravity': -9.8}).gravity_torque < 0.0


def test_realizable_is_the_triangle_inequality_about_the_centre_of_mass():
    across = 2.0 * 0.15 ** 2
    assert Top(**{**TOP, 'lambda1': 0.075 + across}).is_realizable
    assert not Top(**{**TOP, 'lambda1': 0.0749 + across}).is_realizable


def random_states(count=50):
    rng = np.random.default_rng(3)
    for _ in range(count):
        theta = rng.uniform(0.01, math.pi - 0.01)
        yield AxisState(Top(**TOP), rng.normal(), rng.normal(), theta, *rng.normal(size=3))


def test_quaternion_is_rz_ry_rz():
    for state in random_states():
        expected = Rotation.from_euler('ZYZ', (state.phi, state.theta, state.psi))
        ours = Rotation.from_quat(state.quaternion)
        assert (ours * expected.inv()).magnitude() < 1e-14


def test_angular_velocity_is_that_of_the_euler_angles():
    """Eq. (1): phi' z + theta' e2' + psi' e3, turned into the body by an independent library."""
    for state in random_states():
        rz = Rotation.from_euler('Z', state.phi)
        e2 = rz.apply((0.0, 1.0, 0.0))
        rotation = Rotation.from_quat(state.quaternion)
        world = (state.phi_dot * np.array((0.0, 0.0, 1.0)) + state.theta_dot * e2
                 + state.psi_dot * rotation.apply((0.0, 0.0, 1.0)))
        rounding = 1e-14 * (1.0 + abs(state.phi_dot) + abs(state.psi_dot))
        assert rotation.inv().apply(world) == pytest.approx(state.angular_velocity, abs=rounding)


def test_energy_and_momenta_are_those_of_the_lagrangian():
    """Eqs. (7), (11), (13), (14)."""
    for state in random_states():
        top, c, s = state.top, math.cos(state.theta), math.sin(state.theta)
        assert top.lambda3 * (state.psi_dot + state.phi_dot * c) == pytest.approx(state.l3)
        assert top.lambda1 * state.phi_dot * s * s + state.l3 * c == pytest.approx(state.lz)
        kinetic = (0.5 * top.lambda1 * (state.phi_dot ** 2 * s * s + state.theta_dot ** 2)
                   + state.l3 ** 2 / (2.0 * top.lambda3))
        assert state.energy == pytest.approx(kinetic + top.gravity_torque * c)


def test_vectors_turn_into_the_body():
    for state in random_states(10):
        rotation = Rotation.from_quat(state.quaternion)
        v = np.array((0.3, -1.1, 0.7))
        in_body = rotation.inv().apply(v)
        transverse = attitude.transverse_in_body(state.alpha, state.beta, v[0] + 1j * v[1], v[2])
        assert (transverse.real, transverse.imag) == pytest.approx(tuple(in_body[:2]), abs=1e-14)
        up, along = state.vertical
        assert (up.real, up.imag, along) == pytest.approx(
            tuple(rotation.inv().apply((0.0, 0.0, 1.0))), abs=1e-14)


def test_hanging_at_rest_an_accelerometer_reads_g_upwards():
    top = Top(**TOP)
    hanging = AxisState(top, 0.0, 0.0, math.pi, 0.0, 0.0, 0.0)
    assert hanging.specific_force((0.1, 0.0, 0.2)) == pytest.approx((0.0, 0.0, -top.gravity))
    upright = AxisState(top, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert upright.specific_force((0.0, 0.0, 0.0)) == (0.0, 0.0, top.gravity)


def test_the_centre_of_percussion_of_a_horizontal_pendulum_feels_no_force_along_its_swing():
    """At lambda1/(M R) from the pivot a released horizontal pendulum falls with g."""
    top = Top(**TOP)
    level = AxisState(top, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0)
    arm = top.lambda1 / (top.mass * top.com_distance)
    assert level.specific_force((0.0, 0.0, arm)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-14)


NAMES = {
    'loop-a': 'loops', 'loop-c-thd+': 'loops', 'wavy-a': 'waves', 'cusp-headline-a': 'cusps',
    'cusp-e-low': 'cusps', 'fast-1e+08-cusp': 'cusps', 'cross-top-a': 'through the top',
    'cross-bottom-a': 'through the bottom', 'sleep-exact-stable': 'sleeping',
    'hang-pi-double': 'hanging', 'spherical-a': 'spherical pendulum',
    'planar-osc-thd': 'planar pendulum, swinging', 'planar-rot-': 'planar pendulum, rotating',
    'free-R0-fixedaxis': 'free top', 'steady-fast': 'steady precession', 'negP-a': 'loops'}


@pytest.mark.parametrize(('case', 'name'), NAMES.items())
def test_regimes_have_their_classical_names(case, name):
    assert regime(top_of(CASES[case]), start_of(CASES[case])) == name


SCENE_NAMES = {
    'cusp': 'cusps', 'looping': 'loops', 'wavy': 'waves', 'steady_slow': 'steady precession',
    'steady_fast': 'steady precession', 'sleeping': 'sleeping', 'free_top': 'free top',
    'spherical_pendulum': 'spherical pendulum', 'fast_gyroscope': 'cusps',
    'planar_pendulum': 'planar pendulum, rotating', 'waking_sleeper': 'cusps',
    'near_separatrix': 'waves', 'heavy_top': 'loops'}


def test_every_scene_is_valid_and_is_the_motion_it_says():
    assert set(SCENE_NAMES) == set(SCENES)
    for scene, name in SCENE_NAMES.items():
        values = parameters.checked(scene_parameters(scene))
        top = parameters.top_of(values)
        assert top.is_realizable, scene
        assert regime(top, parameters.start_state(values)) == name


def test_the_default_parameters_are_the_cusp_scene():
    assert parameters.checked(scene_parameters('cusp')) == parameters.checked({})


def test_swing_contains_every_reference_tilt():
    """Two roots that nearly meet are known to the square root of a rounding only."""
    for case in CASES.values():
        if case['regime'] in ('planar', 'pole-crossing') or case['name'] == 'hang-pi-double':
            continue
        at = swing(top_of(case), start_of(case))
        for state in case['states']:
            u = math.cos(float(state['theta_folded']))
            slack = 2e-8 if case['regime'] == 'separatrix' else 1e-12
            assert at.low - slack <= u <= at.high + slack, case['name']


@pytest.mark.parametrize(('name', 'value'), [
    ('top.lambda1', 0.0), ('top.lambda1', 'big'), ('pose.rate', -5.0), ('pose.rate', 1e5),
    ('solver.method', 'rk4'), ('pacing', 'often'), ('imu.lever_arm', (1.0, 2.0)),
    ('seed', 1.5), ('pose.enabled', 1), ('record.streams', ('pose', 'poses')), ('spin.l3', None),
    ('step.count', 0), ('initial.theta', 3.2), ('tick_rate', math.nan), ('no.such', 1.0)])
def test_a_bad_parameter_is_refused_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=name.replace('.', r'\.')) as error:
        parameters.checked({name: value})
    shown = list(value) if name == 'record.streams' else value
    assert repr(shown) in str(error.value)


def test_an_integer_is_taken_for_a_double():
    value = parameters.checked({'spin.l3': 2})['spin.l3']
    assert value == 2.0 and isinstance(value, float)
