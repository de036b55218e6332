# SPDX-License-Identifier: Apache-2.0
"""The grade of simulators: measures, faults by name, right simulators, bad answers."""

import json
import math
import re
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.bodies import NAMES
from helpers.faulty_simulators import NOISY, OTHER, PUBLISHED, RIGHT, STEPPED, Imu, Stepped, exact
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim import solve
from spinning_top_sim.grade import Start, grade
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Scene

SENSOR = replace(WHEEL, gyroscope_noise_density=1.7e-4, accelerometer_noise_density=1.2e-3)
# Parts of the scenes, to be fast; steps of 4 ms make the error of a method as large.
SHORT = tuple(replace(scene, duration=0.2 * scene.duration, divided=scene.divided[:2])
              for scene in SCENES if scene.name in ('cusps', 'waves', 'pole', 'fast spin'))


@cache
def short(simulator, body=WHEEL, dt=0.004):
    return grade(simulator, body=body, scenes=SHORT, dt=dt)


@pytest.mark.parametrize('scene', SCENES, ids=lambda scene: scene.name)
def test_a_start_is_the_same_in_attitude_and_rates_as_in_angles_and_momenta(scene):
    start = scene.start_of(WHEEL, 3)
    again = Start.at(WHEEL, start.attitude, start.rates)
    for name in ('theta', 'theta_dot', 'phi', 'psi', 'l3', 'lz'):
        assert getattr(again, name) == pytest.approx(getattr(start, name), abs=1e-12)
    q, w, _ = exact(WHEEL, start, [0.0], 0.0)
    assert q[0] == pytest.approx(start.attitude, abs=1e-14)
    assert w[0] == pytest.approx(start.rates, abs=1e-12)


def test_the_solution_of_this_package_passes_as_anybody_would_try_it():
    report = grade(lambda top, start, times, dt: solve(top, start, times).quaternion, dt=0.01,
                   scenes=SCENES[:2])
    assert report.passed, report
    assert 'no readings: the IMU is not graded' in report.notes


@pytest.mark.parametrize(('told', 'fault', 'says'), [
    (lambda q: q[:, [3, 0, 1, 2]], 'convention', 'w, x, y, z'),
    (lambda q: q * (-1.0, -1.0, -1.0, 1.0), 'convention', 'conjugated'),
    (lambda q: (Rotation.from_euler('x', -90, degrees=True) * Rotation.from_quat(q)).as_quat(),
     'convention', 'world'),
    (lambda q: np.concatenate((q[1:], 2.0 * q[-1:] - q[-2:-1])), 'early', 'one step after')])
def test_a_convention_of_attitudes_is_found_at_the_start_and_undone(told, fault, says):
    report = grade(lambda top, start, times, dt: told(solve(top, start, times).quaternion),
                   dt=0.01, scenes=SHORT[:2])
    assert report.faults == [fault] and says in str(report), report


@pytest.mark.parametrize('name', RIGHT)
def test_a_right_simulator_passes_with_noise_as_declared(name):
    report = short(Imu(RIGHT[name], parts=('accelerations', 'gyroscope', 'covariance')), SENSOR)
    assert report.passed, report
    assert report.measures['total_error_deg: cusps'] < 1e-3
    assert report.measures['gyroscope_noise'] == pytest.approx(1.7e-4 / math.sqrt(0.004), rel=0.05)


def test_marks_of_the_exact_solution_are_those_of_the_motion():
    marks = grade(Imu()).measures
    assert marks['total_error_deg: cusps'] < 1e-12
    assert max(value for name, value in marks.items() if '_drift' in name) < 1e-9


@pytest.mark.parametrize('name', [*PUBLISHED, *OTHER])
def test_a_defect_of_the_readings_is_named(name):
    report = short(Imu(defect=name, seed=1), SENSOR if name in NOISY else WHEEL)
    assert report.faults == list({**PUBLISHED, **OTHER}[name]), report


@pytest.mark.parametrize('name', STEPPED)
def test_a_defect_of_the_motion_is_named(name):
    simulator, faults = STEPPED[name]
    report = short(Imu(simulator))
    assert report.faults == list(faults), report


def test_numbers_of_the_faults_are_those_of_the_defects():
    def number(defect, **options):
        return short(Imu(defect=defect), **options).found[0].number

    assert number('late') == pytest.approx(1.0, abs=0.02)
    assert number('late_by_seven') == pytest.approx(7.0, abs=0.02)
    assert number('wrong_dt') == pytest.approx(4.0, abs=0.1)
    assert number('times_root_two', body=SENSOR) == pytest.approx(math.sqrt(2.0), rel=0.05)
    offset = short(Imu(STEPPED['offset'][0])).found[0]
    assert offset.number == pytest.approx(math.sqrt(29e-6), rel=1e-3)
    assert '(0.003, -0.002, 0.154)' in offset.evidence


def test_with_the_step_of_a_game_the_fast_spin_is_left_out():
    report = grade(Imu(), scenes=SCENES[1:], dt=1.0 / 60.0)
    assert report.passed, report
    assert 'total_error_deg: waves' in report.marks
    assert 'total_error_deg: fast spin' not in report.marks
    semi = grade(Imu(Stepped(method='semi-implicit')), dt=1.0 / 60.0)
    assert semi.faults == ['first_order', 'explicit_gyroscopic_term'], semi


def test_without_rates_those_of_the_attitudes_serve():
    parts = ('accelerations', 'gyroscope')
    assert short(Imu(Stepped(method='implicit'), parts=parts)).faults == [
        'first_order', 'implicit_damping']
    assert short(Imu(defect='late', parts=parts)).faults == ['late']
    assert short(Imu(STEPPED['offset'][0], parts=())).faults == ['com_offset']


def test_an_error_without_a_cause_is_inaccurate():
    def drifting(top, start, times, dt):
        q, w, a = exact(top, start, times, dt)
        turn = Rotation.from_rotvec(0.01 * times[:, np.newaxis] ** 2 * (0.0, 0.0, 1.0))
        return (Rotation.from_quat(q) * turn).as_quat(), w, a

    report = short(Imu(drifting, parts=()))
    assert report.faults == ['inaccurate'], report


def test_readings_without_a_cause_are_inconsistent():
    class Odd(Imu):
        def none(self, said):
            said['accelerations'][:, 0] += np.sin(np.arange(len(self.w)) / 3.0)

    assert short(Odd()).faults == ['inaccurate']


@pytest.mark.parametrize('scene', [SCENES[1], SCENES[3]], ids=['waves', 'near the separatrix'])
def test_samples_that_are_fewer_than_the_steps_show_their_kind(scene):
    for method, fault in (('semi-implicit', 'explicit_gyroscopic_term'),
                          ('implicit', 'implicit_damping'), ('rk4', None)):
        def run(top, start, times, dt, method=method):
            attitudes, rates, _ = Stepped(method=method)(top, start, times, 0.2 * dt)
            return {'attitudes': attitudes, 'rates': rates}

        report = grade(run, dt=0.01, scenes=[replace(scene, divided=(1,))])
        assert report.faults == [fault] * bool(fault), report


def test_noise_that_is_not_declared_is_no_fault():
    def run(top, *given):
        return Imu(defect='residuals')(SENSOR, *given)

    unknown = {'gyroscope_noise_density': None, 'accelerometer_noise_density': None}
    assert short(run, replace(WHEEL, **unknown)).passed


@pytest.mark.parametrize('theta', [0.0, math.pi])
@pytest.mark.parametrize('gravity', [0.0, 9.8, -9.8])
def test_a_top_that_only_spins_shows_no_faults_that_cannot_be_seen(theta, gravity):
    spin = Scene('spin', {'theta': theta, 'l3': 2.0, 'lz': 2.0 * math.cos(theta)}, 0.5)
    assert grade(Imu(), body=replace(WHEEL, gravity=gravity), scenes=[spin], dt=0.01).passed


def test_all_faults_are_in_the_page_and_no_other():
    page = (ROOT / 'docs/grade.md').read_text(encoding='utf-8')
    _, table = page.split('| fault | signature |')
    names = [name for line in table.splitlines() if line.startswith('| `')
             for name in re.findall(r'`(\w+)`', line.split('|')[1])]
    named = {name for faults in (*PUBLISHED.values(), *OTHER.values(), NAMES.values(),
                                 *(faults for _, faults in STEPPED.values())) for name in faults}
    assert len(names) == len({*names}) and named < {*names}
    # Those without a simulator or a body there have a test of their own, or are causes of causes.
    assert {*names} - named == {
        'invalid_output', 'not_deterministic', 'inaccurate', 'early', 'gravity', 'matrix',
        'no_linear_acceleration', 'no_acceleration'}


def test_a_report_is_readable_and_json():
    report = short(Imu(defect='late'))
    assert 'late: late' in str(report) and report.found[0].evidence in str(report)
    said = json.loads(report.as_json())
    assert said['passed'] is False
    assert said['found'][0]['name'] == 'late'
    assert said['marks']['l3_drift: pole']['limit'] is None


def test_another_motion_in_the_same_run_is_told():
    class Random(Imu):
        def none(self, said):
            said['attitudes'][5:] = -said['attitudes'][5:]      # the same attitude
            said['attitudes'] += 1e-9 * self._random.standard_normal(said['attitudes'].shape)

    report = grade(Random(parts=()), scenes=SHORT[::-1], dt=1.0 / 60.0)
    assert report.faults == ['not_deterministic']
    assert 'total_error_deg: fast spin' not in report.marks


def at_rest(t):
    return np.tile(np.eye(4)[3], (len(t), 1))


@pytest.mark.parametrize(('said', 'says'), [
    (lambda t: 1 / 0, 'cusps: run raises ZeroDivisionError'),
    (lambda t: sys.exit(3), 'cusps: run raises SystemExit'),
    (lambda t: None, 'what is returned has nothing: must have attitudes'),
    (lambda t: {'attitudes': at_rest(t), 'covariance': {'gyro': np.eye(3)}},
     'covariance of gyro: must be of gyroscope or accelerations'),
    (lambda t: np.ones((len(t), 4)), 'the norm must be 1'),
    (lambda t: np.eye(4)[:1], 'attitudes has shape (1, 4): must be (1001, 4)'),
    (lambda t: {'poses': 1}, "has ['poses']: must have attitudes"),
    (lambda t: np.zeros((len(t), 3)), 'shape (1001, 3): must be (1001, 4)'),
    (lambda t: {'attitudes': at_rest(t), 'rates': 0.0 * at_rest(t)[:, :3] + np.nan},
     'rates[0, 0] = nan: must be finite'),
    (lambda t: {'attitudes': at_rest(t), 'gyroscope': 'no'}, 'gyroscope: ')])
def test_what_is_no_motion_is_told(said, says):
    report = grade(lambda top, start, times, dt: said(times), scenes=SHORT[:1])
    assert report.faults == ['invalid_output'] and not report.marks
    assert says in str(report)


@pytest.mark.parametrize(('options', 'says'), [
    ({'dt': 0.0}, 'dt = 0.0 s: must be in (0, 1]'), ({'dt': 1.0}, 'turns by more than 0.7 rad'),
    ({'scenes': []}, 'scenes = []: must have one at least')])
def test_wrong_arguments_are_refused(options, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        grade(Imu(), **options)
    with pytest.raises(TypeError, match=r'run = 3: must be run\(top, start, times, dt\)'):
        grade(3)


@pytest.mark.parametrize(('imu', 'says'), [
    ({'mounting': (1.0, 1.0, 0.0, 0.0)}, 'norm must be 1'),
    ({'lever_arm': (1.0, 2.0)}, 'must be 3 finite numbers')])
def test_wrong_parameters_are_refused(imu, says):
    with pytest.raises(ValueError, match=says):
        replace(WHEEL, **imu)


def test_a_body_is_a_top():
    assert WHEEL.com == (0.0, 0.0, 0.15) and replace(WHEEL, lambda1='0.123') == WHEEL
    assert WHEEL.inertia_at_com == pytest.approx((0.078, 0.078, 0.15))
