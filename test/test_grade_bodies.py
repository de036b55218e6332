# SPDX-License-Identifier: Apache-2.0
"""The IMU of any rigid body against its poses: right ones pass, each fault is named, no other."""

import re

import numpy as np
import pytest
from helpers.bodies import FAULTS, GRAVITY, NAMES, SWAPPED, body, rolled, told
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import Imu, grade_readings
from spinning_top_sim.grade.bodies import held


@pytest.mark.parametrize('noisy', [False, True])
@pytest.mark.parametrize('kind', ['free', 'forced'])
def test_a_right_body_passes_and_its_lever_arm_is_found(kind, noisy):
    for seed in range(2):
        moving = body(seed, noisy=noisy, seconds=5.0, kind=kind)
        report = grade_readings(told(moving))
        assert report.passed, (seed, report)
        for axis, right in zip('xyz', moving.arm, strict=True):
            mark = report.marks[f'lever_arm_{axis}']
            doubt = float(mark.meaning.split()[1])
            assert abs(mark.value - right) <= max(3.0 * doubt, 1e-6), (seed, mark, right)
        assert grade_readings(told(moving), Imu(lever_arm=tuple(moving.arm))).passed, seed


@pytest.mark.parametrize('fault', FAULTS)
def test_a_fault_is_named_and_no_other(fault):
    for noisy in (False, True):
        moving = body(noisy, noisy=noisy, seconds=4.0, kind='forced', rate=100.0)
        known = Imu(lever_arm=tuple(moving.arm) if noisy or fault == 'no lever arm' else None)
        report = grade_readings(told(moving, fault), known)
        assert report.faults == [NAMES[fault]], report


def test_two_faults_are_told_as_both():
    """Mounting ignored, or axes exchanged in degrees, and readings a step late, at any rate."""
    turn = Rotation.from_rotvec((0.3, -0.2, 1.1))
    for rate, seconds in ((50.0, 5.0), (500.0, 6.0), (1000.0, 3.0)):
        parts = told(body(3, noisy=rate == 500.0, seconds=seconds, kind='forced', rate=rate))
        (t, w), (_, f) = parts['gyroscope'], parts['accelerations']
        mounted = {**parts, 'gyroscope': (t, rolled(turn.inv().apply(w))),
                   'accelerations': (t, rolled(turn.inv().apply(f)))}
        assert set(grade_readings(mounted).faults) == {'late', 'mounting'}, rate
        assert set(grade_readings(mounted, Imu(mounting=tuple(turn.as_quat()))).faults) == {'late'}
        report = grade_readings({**parts, 'gyroscope': (t, np.degrees(rolled(w, 2)) @ SWAPPED)})
        assert report.faults == ['late', 'axes'] and 'in deg/s' in str(report), report


def test_numbers_have_intervals_that_hold():
    matrix = np.array([[1.02, 0.01, 0.0], [-0.01, 0.99, 0.005], [0.0, 0.01, 1.01]])
    within = []
    for seed in range(5):
        moving = body(seed, noisy=True, seconds=10.0, kind='forced', rate=200.0)
        parts = told(moving)
        t, w = parts['gyroscope']
        marks = grade_readings({**parts, 'gyroscope': (t, w @ matrix.T + 0.01)}).marks
        for name, right in [(f'matrix_{"xyz"[i]}{"xyz"[j]}', matrix[i, j])
                            for i in range(3) for j in range(3)] + [
                                ('bias_x', 0.01), ('lag_steps', 0.0)]:
            mark = marks[f'gyroscope_{name}']
            within.append(abs(mark.value - right) <= float(mark.meaning.split()[1]))
    assert np.mean(within) >= 0.95


def test_a_lag_that_the_motion_does_not_tell_is_not_told():
    t, random = np.arange(0.0, 6.0, 0.01), np.random.default_rng(0)
    turn = Rotation.from_euler('ZYX', 0.3 * np.sin(np.outer(t, random.uniform(0.3, 2.0, 3))))
    f = turn.inv().apply((0.0, 0.0, 9.80665)) + 0.02 * random.standard_normal((len(t), 3))
    mark = grade_readings({
        'attitudes': (t, turn.as_quat()), 'positions': (t, np.zeros((len(t), 3))),
        'accelerations': (t, f)}).marks['accelerations_lag_steps']
    assert np.isnan(mark.value) or abs(mark.value) <= float(mark.meaning.split()[1])
    # The rates of a free symmetric body turn about its axis, as axes of a mounting may.
    parts = told(body(8, noisy=False, seconds=6.0, kind='free'), 'late')
    report = grade_readings({name: parts[name] for name in ('attitudes', 'gyroscope')})
    assert report.passed and 'or the readings are 1 +- ' in str(report.unjudged), report
    assert 'this motion does not tell' in str(report.unjudged), report


def test_another_axis_of_the_sensor_is_no_convention_and_rounded_stamps_are_no_fault():
    parts = told(body(0, noisy=False, seconds=5.0, kind='forced', rate=100.0))
    t, turn = parts['attitudes'][0], Rotation.from_euler('z', -90.0, degrees=True)
    turned = {name: (t, turn.apply(parts[name][1])) for name in ('gyroscope', 'accelerations')}
    assert grade_readings({**parts, **turned}).faults == ['axes']
    stamps = t + 1e-6 * np.random.default_rng(0).standard_normal(len(t))
    assert grade_readings({**parts, **{name: (stamps, parts[name][1]) for name in (
        'attitudes', 'positions')}}).passed


def test_what_poses_are_too_coarse_to_tell_is_told_with_the_noise_that_would_do():
    moving = body(4, noisy=False, seconds=20.0, kind='forced', rate=30.0)
    moving.noise = {'attitudes': 0.05, 'positions': 1e-3}
    report = grade_readings(told(moving, 'no centripetal'))
    assert report.passed, report
    assert any('centripetal' in one and 'would tell' in one for one in report.unjudged), report


def test_readings_beside_too_few_poses_are_not_judged():
    t = np.arange(0.0, 5.0, 1.0 / 30.0)
    w = np.tile((0.0, 0.0, 80.0), (len(t), 1))
    turn = Rotation.from_rotvec(w * t[:, np.newaxis]) * Rotation.from_euler('x', 0.3)
    report = grade_readings({'attitudes': (t, turn.as_quat()),
                             'gyroscope': (t, 2.0 * turn.inv().apply(w))})
    assert not report.passed and str(report).startswith(
        'readings: nothing was judged\n  not judged: readings: the body turns by more than 0.7')


def test_gravity_elsewhere_and_gaps_and_rates_of_each_sensor_are_no_faults():
    parts = told(moving := body(1, noisy=False, seconds=8.0, kind='forced', rate=400.0))
    t, f = parts['accelerations']
    up = moving.rotation.inv().apply((0.0, 0.0, 1.0))
    assert grade_readings({**parts, 'accelerations': (t, f + 0.2 * up)}).faults == ['gravity']
    # In free flight it is told from no acceleration of the origin; the lever arm is.
    flying = body(3, noisy=False, seconds=4.0, kind='free', rate=200.0)
    flying.noise, flying.a[:, 2] = {}, -9.81
    flying.p[:, 2] += 0.5 * (GRAVITY - 9.81) * flying.t ** 2
    report = grade_readings({**told(flying), 'accelerations': (
        flying.t, flying.force(9.81 / GRAVITY))})
    assert report.passed and 'accelerations_matrix_xx' not in report.marks, report
    assert 'the size of the reading does not show here' in str(report.unjudged)
    assert report.measures['lever_arm_x'] == pytest.approx(flying.arm[0], abs=1e-6)
    parts['accelerations'] = t, f + 0.05 * up
    parts['positions'][1][t > 6.0] += 1.0       # and a jump
    lost = (t > 3.0) & (t < 3.5) | (np.random.default_rng(0).random(len(t)) < 0.03)
    for name, every in (('attitudes', 4), ('positions', 4), ('gyroscope', 2)):
        parts[name] = tuple(one[::every][~lost[::every]] for one in parts[name])
    report = grade_readings(parts)
    assert report.passed and 's in gaps, at jumps of poses' in report.unjudged[0], report
    assert abs(report.marks['lever_arm_x'].value - moving.arm[0]) < 1e-3, report


PARTS = told(body(0, noisy=False, seconds=2.0, kind='forced', rate=100.0))
T, W = PARTS['gyroscope']


@pytest.mark.parametrize(('changed', 'says'), [
    (None, 'parts of type NoneType: must be a mapping'),
    ({'gyro': (T, W)}, 'accelerations, magnetometer; did you mean gyroscope?'),
    ({'attitudes': None}, 'attitudes: must be times (n,) and values (n, 4)'),
    ({'gyroscope': (W, T)}, 'gyroscope of shape (200,): must have shape (n, 3)'),
    ({'gyroscope': (T[1:], W)}, 'times of gyroscope of shape (199,): must have shape (200,)'),
    ({'gyroscope': (T, 0.0 * W + np.nan)}, 'gyroscope[0, 0] = nan: must be finite'),
    ({'gyroscope': (T, np.ma.array(W, mask=True))}, 'gyroscope[0, 0] = nan: must be finite'),
    ({'gyroscope': (1e9 * T, W)}, '200 rows of gyroscope, 1e+07 s apart: must be 20 at least'),
    ({'gyroscope': (100.0 + T, W)}, 'must be of one clock'),
    ({'attitudes': (T, np.ones((200, 4)))}, 'attitudes[0]: |q| = 2: must be 1')])
def test_what_is_no_motion_is_refused_in_a_line(changed, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        grade_readings(changed and {**PARTS, **changed})


def test_lists_are_arrays_positions_in_mm_are_told_and_attitudes_are_asked_for():
    lists = {name: [one.tolist() for one in pair] for name, pair in PARTS.items()}
    assert str(grade_readings(lists)) == str(grade_readings(PARTS))
    mm = grade_readings({**PARTS, 'positions': (T, 1e3 * PARTS['positions'][1])})
    assert mm.faults == ['no_linear_acceleration'] and 'positions in mm' in str(mm), mm
    with pytest.raises(ValueError, match='no attitudes; the first time is 0 s; gyroscope of'):
        grade_readings({'gyroscope': (T, W)})


def test_without_positions_the_acceleration_of_the_origin_is_no_fault():
    parts = told(body(4, noisy=False, seconds=4.0, kind='forced', rate=200.0))
    assert parts.pop('positions')[1].any()
    report = grade_readings(parts)
    assert report.passed and report.unjudged == ['accelerations: without positions'], report


def test_a_magnetometer_needs_no_field_and_its_faults_are_told():
    moving = body(2, noisy=False, seconds=3.0, kind='forced', rate=100.0)
    field = moving.rotation.inv().apply((0.0, 20e-6, -43e-6))
    parts = {**told(moving), 'magnetometer': (moving.t, field)}
    report = grade_readings(parts)
    assert report.passed and abs(report.marks['field_y'].value - 20e-6) < 1e-9, report
    for one, fault in ((1e6 * field, 'units'), (field @ SWAPPED, 'axes'),
                       (2e4 * field, 'reading_scale'), (0.0 * field + field[0], 'inaccurate'),
                       (0.0 * field, 'reading_scale'), (np.add(field, (1e-5, 0.0, 2e-5)), 'bias')):
        assert grade_readings({**parts, 'magnetometer': (moving.t, one)}).faults == [fault]


def test_a_wrong_sign_of_gravity_and_accelerations_in_the_world_are_no_conventions():
    moving = body(5, noisy=False, seconds=4.0, kind='forced', rate=200.0)
    parts = told(moving)
    world = moving.rotation.apply(moving.force())
    for force, fault in (moving.force(gravity=-1.0), 'gravity_sign'), (world, 'reading_in_world'):
        assert grade_readings({**parts, 'accelerations': (moving.t, force)}).faults == [fault]


def test_held_poses_are_told_and_a_body_that_rests_is_not_held():
    parts = told(body(1, noisy=False, seconds=4.0, kind='forced', rate=200.0))
    t, q = parts['attitudes']
    repeated = q[np.floor(np.arange(len(q)) / 6.667).astype(int) * 20 // 3]
    assert grade_readings({**parts, 'attitudes': (t, repeated)}).faults == ['held']
    moving = np.cumsum(np.full((600, 3), 0.01), axis=0)
    resting = np.concatenate((moving, np.repeat(moving[-1:], 400, axis=0), moving + 9.0))
    assert not held('gyroscope', resting)[1]
    assert held('gyroscope', np.repeat(moving, 2, axis=0))[1][0].number == 2.0


def test_short_parts_and_coarse_places_change_nothing_and_zeros_are_no_units():
    parts = told(body(4, noisy=False, seconds=5.0, kind='forced', rate=100.0))
    (t, w), (_, places) = parts['gyroscope'], parts['positions']
    cut = {name: tuple(np.delete(one, np.s_[65:75], axis=0) for one in pair)
           for name, pair in {**parts, 'gyroscope': (t, rolled(w, 20))}.items()}
    assert grade_readings(cut).faults == ['late']
    coarse = np.round(5e-3 * places, 3)
    assert grade_readings({**parts, 'positions': (t, coarse)}).marks
    known = Imu(lever_arm=(0.1, 0.2, 0.3), field=(0.0, 2e-5, -4e-5))
    for name in ('gyroscope', 'accelerations', 'magnetometer'):
        faults = grade_readings({**parts, name: (t, 0.0 * w)}, known).faults
        assert 'units' not in faults and faults, (name, faults)
    with pytest.raises(ValueError, match='must be 0 or positive'):
        Imu(gyroscope_noise_density=-1.0)
