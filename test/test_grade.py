# SPDX-License-Identifier: Apache-2.0
"""The grade of simulators: measures, faults by name, right simulators, bad answers."""

import math
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.bodies import NAMES
from helpers.faulty_simulators import DEFECTS, MOVED, NOISY, RIGHT, Imu, exact
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, solve
from spinning_top_sim.grade import grade
from spinning_top_sim.grade.scenes import SCENES, WHEEL, Scene

SENSOR = replace(WHEEL, gyroscope_noise_density=1.7e-4, accelerometer_noise_density=1.2e-3,
                 lever_arm=(-0.14, -0.2, -0.11))    # where noise of a wrong dt looks like a lag
# Parts of the scenes, to be fast; steps of 4 ms make the error of a method as large.
SHORT = tuple(replace(scene, duration=0.2 * scene.duration)
              for scene in SCENES if scene.name in ('cusps', 'waves', 'pole', 'fast spin'))


def short(simulator, body=WHEEL):
    return grade(simulator, body=body, scenes=SHORT, dt=0.004)


@pytest.mark.parametrize(('told', 'faults', 'says'), [
    (lambda q: q, [], 'not judged: gyroscope: there is none'),
    (lambda q: q[:, [3, 0, 1, 2]], ['convention'], 'w, x, y, z'),
    (lambda q: np.concatenate((q[1:], 2.0 * q[-1:] - q[-2:-1])), ['early'], 'steps after')])
def test_the_solution_of_this_package_passes_and_conventions_are_found_at_the_start(
        told, faults, says):
    report = grade(lambda top, start, times, dt: told(solve(top, start, times).quaternion),
                   dt=0.01, scenes=SHORT[:2])
    assert report.faults == faults and says in str(report), report


@pytest.mark.parametrize('name', RIGHT)
def test_a_right_simulator_passes_with_noise_as_declared(name):
    report = short(Imu(RIGHT[name], parts=('accelerations', 'gyroscope')), SENSOR)
    assert report.passed, report
    marks = report.measures
    assert marks['gyroscope_noise'] == pytest.approx(1.7e-4 / math.sqrt(0.004), rel=0.05)
    assert marks['total_error_deg: cusps'] < 1e-6


# By the defect: the number that is told of it.
NUMBERS = {'late': 1.0, 'wrong dt': 4.0, 'density as deviation': math.sqrt(0.004),
           'gyroscope twice': 2.0, 'offset': math.sqrt(29e-6), 'damped': 0.05}


@pytest.mark.parametrize('name', DEFECTS)
def test_a_defect_of_the_readings_is_named(name):
    report = short(Imu(defect=name, seed=1), SENSOR if name in (*NOISY, 'wrong dt') else WHEEL)
    assert {*report.faults} == {DEFECTS[name][0]}, report
    if name in NUMBERS:
        assert report.found[0].number == pytest.approx(NUMBERS[name], rel=0.05)


@pytest.mark.parametrize(('name', 'body'), [('wrong dt', WHEEL), ('residuals', SENSOR)])
def test_a_defect_is_no_other_place_and_no_chance(name, body):
    scenes = [replace(scene, duration=0.4 * scene.duration) for scene in SCENES[1:3]]
    report = grade(Imu(defect=name, seed=1), body=body, dt=0.001, scenes=scenes)
    assert report.faults == [DEFECTS[name][0]], report


@pytest.mark.parametrize('name', MOVED)
def test_a_defect_of_the_motion_is_named(name):
    simulator, faults = MOVED[name]
    report = short(Imu(simulator))
    assert report.faults == list(faults), report
    if name in NUMBERS:
        assert report.found[0].number == pytest.approx(NUMBERS[name], rel=1e-3)
    # Without rates, those of the attitudes serve.
    assert short(Imu(simulator, parts=())).faults == (
        ['inaccurate'] if name in ('midpoint', 'turns twice') else list(faults))


def test_rates_of_another_size_are_named_and_the_gyroscope_is_right():
    report = short(Imu(defect=lambda b: {'rates': 1.005 * b.w}))
    assert report.faults == ['rates_scale'], report
    assert report.found[0].number == pytest.approx(1.005)


def test_what_is_wrong_with_rates_may_have_all_causes():
    def run(top, start, times, dt):
        rates = 1.002 * solve(top, start, times + 0.4 * dt).angular_velocity
        return {'attitudes': solve(top, start, times).quaternion,
                'rates': rates + 0.02 * np.sin(20.0 * times)[:, np.newaxis] * (1.0, 0.3, -0.5)}

    report = grade(run, scenes=SCENES[1:2], dt=0.004)
    assert report.passed and 'rates' not in str(report.unjudged), report


def test_what_is_held_is_named_and_not_graded():
    def run(*given):
        said = Imu(defect='late')(*given)
        return {**said, 'gyroscope': said['gyroscope'][::2].repeat(2, axis=0)[:len(given[2])]}

    assert short(run).faults == ['held']


def test_what_is_too_fast_is_left_out_and_what_cannot_be_seen_is_no_fault():
    report = grade(Imu(), scenes=SCENES[-2:], dt=1.0 / 60.0)
    assert report.passed and 'not judged: fast spin' in str(report), report
    assert not grade(Imu(), scenes=SCENES[-1:], dt=1.0 / 60.0).passed     # nothing is judged
    for theta, gravity in ((0.0, 9.8), (math.pi, -9.8), (0.0, 0.0)):
        spin = Scene('spin', State(theta=theta, l3=2.0, lz=2.0 * math.cos(theta)), 0.5)
        assert grade(Imu(), body=replace(WHEEL, gravity=gravity), scenes=[spin], dt=0.01).passed


def test_what_has_no_cause_is_inaccurate_and_another_motion_in_the_same_run_is_told():
    def drifting(top, start, times, dt):
        q, w, a = exact(top, start, times, dt)
        turn = Rotation.from_rotvec(0.01 * times[:, np.newaxis] ** 2 * (0.0, 0.0, 1.0))
        return (Rotation.from_quat(q) * turn).as_quat(), w, a

    def slow(top, start, times, dt):
        return exact(top, start, 0.999 * times, dt)

    def odd(b):
        return {'accelerations': b.force() + np.sin(np.arange(len(b.w)) / 3.0)[:, np.newaxis]}

    for simulator in (Imu(drifting, parts=()), Imu(slow, parts=()), Imu(slow, parts=('rates',)),
                      Imu(defect=odd)):
        assert short(simulator).faults == ['inaccurate']


def test_all_faults_are_in_the_page_and_no_other():
    page = (ROOT / 'docs/grade.md').read_text(encoding='utf-8')
    _, table = page.split('| fault | signature |')
    names = [name for line in table.splitlines() if line.startswith('| `')
             for name in re.findall(r'`(\w+)`', line.split('|')[1])]
    named = {*NAMES.values(), *(fault for fault, _ in DEFECTS.values()), *(
        fault for _, faults in MOVED.values() for fault in faults)}
    assert len(names) == len({*names}) and named < {*names}
    # Those without a simulator or a body there have a test of their own, or are causes of causes.
    assert {*names} - named == {
        'invalid_output', 'inaccurate', 'early', 'gravity', 'no_linear_acceleration'}


def at_rest(t):
    return np.tile(np.eye(4)[3], (len(t), 1))


@pytest.mark.parametrize(('said', 'says'), [
    (lambda t: 1 / 0, 'cusps: run raises ZeroDivisionError'),
    (lambda t: sys.exit(3), 'cusps: run raises SystemExit'),
    (lambda t: None, 'attitudes of type NoneType: must have shape (1001, 4)'),
    (lambda t: np.ones((len(t), 4)), 'attitudes[0]: |q| = 2: must be 1'),
    (lambda t: np.eye(4)[:1], 'attitudes of shape (1, 4): must have shape (1001, 4)'),
    (lambda t: {'attitudes': at_rest(t), 'accelerometer': t}, 'did you mean accelerations?'),
    (lambda t: {'attitudes': at_rest(t), 'rates': 0.0 * at_rest(t)[:, :3] + np.nan},
     'rates[0, 0] = nan: must be finite')])
def test_what_is_no_motion_is_told(said, says):
    report = grade(lambda top, start, times, dt: said(times), scenes=SHORT[:1])
    assert report.faults == ['invalid_output'] and not report.marks
    assert says in str(report)


@pytest.mark.parametrize(('call', 'says'), [
    (lambda: grade(Imu(), dt=0.0), 'dt = 0.0 s, tolerance = 0.001745'),
    (lambda: grade(Imu(), dt='0.1'), "dt = '0.1' s, tolerance"),
    (lambda: grade(Imu(), tolerance=-1.0), 'tolerance = -1.0 rad: must be positive'),
    (lambda: replace(WHEEL, mounting=(1.0, 1.0, 0.0, 0.0)), 'norm must be 1'),
    (lambda: replace(WHEEL, lever_arm=(1.0, 2.0)), 'of shape (2,): must have shape (3,)'),
    (lambda: replace(WHEEL, mass=-1.0), 'mass = -1.0 kg')])
def test_wrong_arguments_are_refused(call, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        call()
