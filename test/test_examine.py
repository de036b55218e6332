# SPDX-License-Identifier: Apache-2.0
"""The exam of filters: faults by name, right filters, bad output, programs, the command."""

import contextlib
import ctypes
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from functools import cache, partial

import numpy as np
import pytest
from helpers.reference import ROOT
from helpers.wrong_filters import RIGHT, WRONG, Mahony, Part, ReferenceFilter
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import checks, examine, feeding, measures, motions, runs
from spinning_top_sim.exam.adapters import FILTERS, Vqf
from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.page import draw_page

pytest.importorskip('vqf')

NAMES = {'convention', 'gyroscope', 'accelerometer', 'magnetometer', 'timing', 'integration',
         'lever_arm', 'bias', 'covariance', 'accuracy', 'nondeterministic', 'invalid_output'}
# The others take minutes: STRESS=2 pytest test/test_stress.py -k filters
FAST = [name for name, (make, _) in WRONG.items() if make.func is Part and make.args == ()]


@pytest.fixture(scope='module')
def report():
    """Return a function that returns the report on a filter of the tables, computed once."""
    @cache
    def report(name):
        make = {**RIGHT, **{wrong: make for wrong, (make, _) in WRONG.items()}}[name]
        return examine(make, seeds=1, feed=feeding.feed, subject=name)
    return report


@pytest.fixture(scope='module')
def short():
    return motions.noisy('short', motions.CALIBRATED, 1, 0.5, 0.5)


def test_the_names_of_faults_are_twelve_and_the_tables_have_them():
    assert {check.fault for check in checks.CHECKS} | {'invalid_output'} == NAMES
    assert {area for _, areas in WRONG.values() for area in areas.split(', ')} == (
        NAMES - {'nondeterministic'})


@pytest.mark.parametrize('name', [*FAST, 'first order', 'force late', 'no bias', 'no field'])
def test_a_wrong_filter_is_named_by_its_area_and_nothing_else(report, name):
    found = report(name)
    assert ', '.join(found.faults) == WRONG[name][1], found
    assert found.found[0].evidence in str(found)


@pytest.mark.parametrize('name', ['vqf', 'vqf, six axes', 'mahony, corrects first'])
def test_a_right_filter_passes(report, name):
    found = report(name)
    assert found.passed, found


def test_a_filter_without_an_estimate_of_a_bias_is_right_unless_it_reports_one(report):
    class NoEstimate(Part):
        bias = None

    found = examine(partial(NoEstimate, partial(Mahony, 0.5, 0.5, 0.0)), seeds=1)
    assert found.passed and report('no bias').faults == ['bias']
    assert found.measures['bias_tilt_s'] == pytest.approx(2.0, rel=0.1)


def test_what_a_fault_hides_and_the_shift_of_the_force_are_said(report):
    found = report('rates negated')
    assert found.notes[0].startswith('not judged because of this: rest_deg, delay')
    assert 'clean_deg' not in found.marks
    assert 'with force and field of 1 and ' in str(report('force late'))


def test_a_filter_that_is_random_or_shares_state_is_nondeterministic_and_nothing_else():
    class Random(Vqf):
        def update(self, *readings):
            return super().update(*readings) + 1e-5 * np.random.default_rng().normal(size=4)

    assert examine(Random, seeds=1, feed=feeding.feed).faults == ['nondeterministic']
    shared = examine(cache(Vqf), seeds=1)
    assert shared.faults == ['nondeterministic'] and 'share state' in str(shared)


def test_no_motion_is_degenerate_to_better_than_a_degree():
    motion = motions.excitation(1.0)
    truth = motion.run('').truth[np.array(motion.kinds) == 'rests']
    assert np.min(Rotation.from_quat(truth).magnitude()) > math.radians(1.0)
    up = measures.up(truth)
    assert np.max(np.abs(up)) < math.cos(math.radians(1.0))
    # But near them, and with each axis level, for the matrix of a sensor.
    assert min(*np.max(up, axis=0), *-np.min(up, axis=0)) > 0.88
    assert np.max(np.min(np.abs(up), axis=0)) < 0.1


def test_north_is_magnetic_north():
    field = {'mag.field': (10e-6, 20e-6, -40e-6), 'mag.noise_density': 0.0}
    noisy = motions.noisy('', field, 1, 0.1, 1.0)
    east, north, _ = Rotation.from_quat(noisy.truth).apply(noisy.magnetometer).T
    assert east == pytest.approx(0.0, abs=1e-18)
    assert north == pytest.approx(math.hypot(10e-6, 20e-6))


def test_off_the_axis_the_acceleration_is_that_of_the_point():
    exam = runs.Exam(lambda fed: [feeding.Outcome(run, run.truth, None, None) for run in fed],
                     {}, [0])
    exam.lead = 200
    assert checks.lever_arm(exam).value < 1e-12
    assert checks.tilt_answer(exam).value < 1e-12       # no kick is felt
    run, arm = exam.run, exam.told['lever arm'][0].run
    rows, rates = np.flatnonzero(np.array(exam.motion.kinds) == 'top')[450:-50], run.gyroscope
    expected = np.cross(np.gradient(rates, 0.01, axis=0), checks.ARM) + np.cross(
        rates, np.cross(rates, checks.ARM))
    # The rates are those of the middle of a step.
    middle = 0.5 * (expected[1:] + expected[:-1])
    assert np.max(np.abs((arm.accelerometer - run.accelerometer)[rows] - middle[rows])) < 0.02


@pytest.mark.parametrize('factor', [1.0, 50.0])
def test_covariances_may_be_about_the_axes_of_sensor_or_world(factor):
    noisy = [motions.noisy('', motions.CALIBRATED, seed, 3.0, 12.0) for seed in range(2)]
    found = []
    for in_world in (False, True):
        said = []
        for one in feeding.feed(ReferenceFilter, noisy):
            turn = Rotation.from_quat(one.estimates).as_matrix()
            p = turn @ one.covariances @ turn.transpose(0, 2, 1) if in_world else one.covariances
            said.append(feeding.Outcome(one.run, one.estimates, p / factor, one.biases))
        found.append(measures.nees_of(said))
    assert found[0] == pytest.approx(found[1], rel=0.1)
    assert 0.2 < found[0] / factor < 2.0


class Bad:
    def __init__(self, said):
        self._said = said

    def update(self, *readings):
        return self._said()


@pytest.mark.parametrize(('said', 'says'), [
    (partial(int, 'north'), ': raises ValueError: invalid literal'),
    (lambda: 'north', ': update returns north: must be 4 finite numbers'),
    (lambda: np.full(4, math.inf), 'must be 4 finite numbers'),
    (lambda: np.ones(4), 'its norm must be 1'),
    (partial(time.sleep, 60.0), 'updates take more than 1 s'),
    (lambda: ctypes.string_at(0), 'the filter ends the process, exit code -11'),
    (partial(os._exit, 3), 'the filter ends the process, exit code 3'),
    (partial(sys.exit, 3), 'raises SystemExit: 3')])
def test_a_filter_that_returns_no_attitude_or_crashes_is_told(monkeypatch, said, says):
    if says.endswith(' s'):
        monkeypatch.setattr(feeding, 'ANSWER_S', 1.0)
        monkeypatch.setattr(feeding, 'UPDATE_S', 0.0)
    report = examine(partial(Bad, said), seeds=1)
    assert report.faults == ['invalid_output']
    assert says in str(report) and not report.measures


def test_a_covariance_may_be_unknown_but_not_impossible(short):
    class Known(Vqf):
        covariance = np.zeros((3, 3))

    assert np.isnan(feeding.feed(Known, [short])[0].covariances).all()
    asymmetric = np.eye(3) + 0.1 * np.eye(3, k=1)
    for Known.covariance in (-np.eye(3), 0.5, np.full((3, 3), math.nan), asymmetric):
        with pytest.raises(feeding.InvalidOutputError, match=r'covariance is .*: must '):
            feeding.feed(Known, [short])


def test_whatever_a_filter_says_can_be_written(tmp_path):
    def fail():
        raise ValueError('red\x1b[31m\nand $a^$ \ud800')

    report = examine(partial(Bad, fail), seeds=1, feed=feeding.feed, subject='a\x1b $a^$ \ud800')
    assert 'raises ValueError: red\\x1b[31m and $a^$ \\ud800' in report.found[0].evidence
    assert report.subject == 'a\\x1b $a^$ \\ud800'
    draw_page(report, tmp_path / 'page.svg')
    page = (tmp_path / 'page.svg').read_text()
    assert all(text in page for text in ('$a^$', 'tilt error [deg]', 'heading error [deg]'))


@pytest.mark.parametrize(('options', 'says'), [
    ({'level': 'slow'}, "level = 'slow': must be one of quick, field"),
    ({'imu': {'imu.colour': 1.0}}, 'imu.colour = 1.0: there is no such parameter'),
    ({'imu': ROOT / 'config/cusp.yaml'}, 'cusp.yaml has '),
    ({'imu': {'imu.bandwidth': 9.0}}, '= 9.0, which nothing in level quick has: must be imu.gyro'),
    ({'imu': {'imu.lever_arm': [1.0, 0.0, 0.0]}, 'level': 'field'}, 'imu has imu.lever_arm'),
    ({'seeds': 0}, 'seeds = 0: must be'), ({'seeds': [-1]}, 'must be')])
def test_wrong_arguments_are_refused(options, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        examine(Vqf, **options)


def test_parameters_that_are_given_replace_those_of_the_same_name_only():
    loud = examine(Vqf, seeds=1, feed=feeding.feed, imu={'imu.gyroscope_noise_density': 2e-3})
    assert loud.passed and 0.1 < loud.measures['tilt_rms_deg'] < 1.0


PROGRAMS = {
    'kill -9 $$': 'the program has ended, signal 9',
    'sleep 60': 'no answer within 1 s',
    'read a; echo north': "answers 'north': must be x y z w",
    'read a; echo 0 0 0 1 bias 1 2; cat': "answers '0 0 0 1 bias 1 2': must be x y z w",
    'read a; head -c 10000000 /dev/zero; cat': 'answers more than 4096 bytes',
    'while read a; do echo 0 0 0 1; echo 0 0 0 1; done': 'answers more than a line',
    'read a; echo 0 0 0 1; cat > /dev/null': 'update 2 of'}


@pytest.mark.parametrize('script', PROGRAMS)
def test_a_program_that_does_not_answer_as_it_should_is_told_in_a_line(
        tmp_path, monkeypatch, capsys, script):
    monkeypatch.setattr('spinning_top_sim.exam.programs.ANSWER_S', 1.0)
    (tmp_path / 'filter.sh').write_text(script)
    assert main(['--command', f'sh {tmp_path}/filter.sh', '--seeds', '1', '--json']) == 1
    found = json.loads(capsys.readouterr().out)
    assert found['faults'] == ['invalid_output'] and PROGRAMS[script] in (
        found['found'][0]['evidence'])


def test_the_program_in_c_of_the_page_is_examined(tmp_path, capsys):
    compiler = shutil.which('cc')
    if compiler is None:
        pytest.skip('there is no C compiler')
    text = (ROOT / 'docs/exam.md').read_text()
    (tmp_path / 'filter.c').write_text(re.search('```c\n(.*?)```', text, re.DOTALL)[1])
    subprocess.run([compiler, '-O2', '-o', 'filter', 'filter.c', '-lm'], cwd=tmp_path, check=True)
    assert main(['--command', str(tmp_path / 'filter'), '--seeds', '1', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['faults'] == [] and found['marks']['clean_deg']['value'] < 0.1
    assert found['marks']['bias_tilt_s']['value'] == pytest.approx(2.0, rel=0.1)


def test_the_command_examines_a_class_in_a_file(tmp_path, capsys):
    (tmp_path / 'neighbour.py').write_text('UP = [0.0, 0.0, 0.0, 1.0]\n')
    (tmp_path / 'mine.py').write_text('from neighbour import UP\n\n\nclass Still:\n'
                                      '    def update(self, *readings):\n        return UP[:3]\n')
    assert main(['--filter', f'{tmp_path}/mine.py:Still', '--seeds', '1']) == 1
    assert capsys.readouterr().out.startswith('Still: invalid_output')
    (tmp_path / 'bad.py').write_text('Still = \n')
    for given, code, says in (('mine.py:Other', 2, 'there is no Other in'),
                              ('mine.py:UP', 2, 'that can be called'),
                              ('bad.py:Still', 2, 'raises SyntaxError: invalid syntax'),
                              ('none.py:Still', 1, 'No such file'), ('x', 2, 'FILE.py:CLASS')):
        assert main(['--filter', f'{tmp_path}/{given}']) == code
        assert says in capsys.readouterr().err


@pytest.mark.parametrize(('arguments', 'says'), [
    ([], 'log --filter --command --node is required'),
    (['x', '--topic', '/pose', '--filter', 'vqf'], 'not allowed with argument'),
    (['--filter', 'vqf', '--seeds', '0'], 'seeds = 0'), (['--command', ' '], 'must be a program'),
    (['--node', 'x'], '--node needs --topic'),
    (['--filter', 'vqf', '--data', '.', '--level', 'field'], 'data cannot be given with level'),
    (['x', '--topic', '/pose', '--level', 'quick'],
     '--level cannot be given with log: must be --topic, --truth')])
def test_wrong_arguments_of_the_command(capsys, arguments, says):
    with contextlib.suppress(SystemExit):       # by argparse
        assert main(arguments) == 2
    said = capsys.readouterr().err
    assert says in said and said.count('\n') == 1


def test_what_will_be_written_is_checked_before_the_exam(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr('spinning_top_sim.exam.command.examine', None)      # is not called
    (tmp_path / 'there.png').write_text('x')
    for page in ('there.png', 'no/folder.png'):
        assert main(['--filter', 'vqf', '--page', str(tmp_path / page)]) == 1
        assert 'cannot write' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'spinning_top_sim.exam.page', None)
    assert main(['--filter', 'vqf', '--page', str(tmp_path / 'new.png')]) == 1
    assert 'a page needs' in capsys.readouterr().err


def test_published_filters_have_the_faults_that_they_are_known_for():
    pytest.importorskip('imufusion')
    assert examine(FILTERS['imufusion'], seeds=1, feed=feeding.feed).faults == ['integration']
