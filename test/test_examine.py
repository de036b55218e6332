# SPDX-License-Identifier: Apache-2.0
"""The exam of attitude filters: measures, faults by name, bad filters, the command."""

import ctypes
import math
import os
import re
import sys
import time
from dataclasses import replace
from functools import cache, partial
from unittest.mock import Mock
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.faulty_filters import FAULTY, MISREADINGS
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, examine, isolation, measures, pytest_plugin, scenarios
from spinning_top_sim.exam.adapters import FILTERS, Vqf
from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.diagnosis import FAULTS
from spinning_top_sim.exam.kicks import not_corrected
from spinning_top_sim.exam.page import draw_page
from spinning_top_sim.exam.pytest_plugin import pass_exam  # noqa: F401, a fixture
from spinning_top_sim.exam.report import MEANINGS, Report
from spinning_top_sim.exam.trial import InvalidOutputError, follow

pytest.importorskip('vqf')


class TooSure(Vqf):
    covariance = 1e-9 * np.eye(3)


@pytest.fixture(scope='module')
def report():
    """
    Return a function that returns the report on a filter; it computes each report once.

    It takes the name of a filter, a misreading, and options of `examine`.
    """
    @cache
    def report(name, fault='', **options):
        make = {**FAULTY, **FILTERS, 'too sure': TooSure}[name]
        if fault:
            make = partial(MISREADINGS[fault], make)
        return examine(make, **{'seeds': 1, 'isolated': False, 'subject': name, **options})
    return report


@pytest.fixture(scope='module')
def slow():
    return scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))     # a second


def test_the_gyroscope_reads_the_mean_over_its_step_and_a_delay_is_measured():
    scenario = replace(scenarios.FAST, duration=4.0, reversals=())
    coarse, fine = (scenarios.record(replace(scenario, rate=rate), {}, 1)
                    for rate in (100.0, 1600.0))
    mean = fine.gyroscope.reshape(-1, 16, 3).mean(axis=1)
    assert np.max(np.abs(coarse.gyroscope - mean)) < 1e-6
    offset = measures.time_offset(fine.truth[:-16], fine.truth[16:], fine.rates[16:], True)
    assert offset.seconds == pytest.approx(0.01, rel=0.01)
    assert offset.after < 0.1 * offset.before


@pytest.mark.parametrize(('sensor', 'answer'), [
    ('magnetometer', ((0.06, 0.0, 0.0), (0.0, 0.05, -0.22), (-0.08, 0.0, 0.997))),
    ('accelerometer', ((0.06, 0.0, 0.0), (0.0, 1.0, 0.0), (-0.08, 2.15, 0.05)))])
def test_a_kick_that_stays_blames_the_sensor_that_should_correct_it(sensor, answer):
    found = not_corrected(np.array(answer), 4.0, 0.995)
    assert [fault.name for fault in found] == [f'{sensor}_wiring']


def test_an_error_that_is_off_changes_no_limit(slow):
    off = {**scenarios.CALIBRATED, 'imu.gyroscope_turn_on_bias': 0.0}
    for imu, is_same in ((off, True), ({**off, 'imu.gyroscope_turn_on_bias': 0.1}, False)):
        assert (diagnosis.noisy_limit(slow, True, imu) < diagnosis.DIVERGED) == is_same


def test_the_autocorrelation_time_is_the_direct_sum():
    values = np.cumsum(np.random.default_rng(1).standard_normal((3, 1000)), axis=1)
    centred, expected = values - np.mean(values), 1.0
    for lag in range(1, 1000):
        expected += 2.0 * np.mean(centred[:, lag:] * centred[:, :-lag]) / np.mean(centred ** 2)
        if lag >= 3.0 * expected:
            break
    assert measures.autocorrelation_time(values) == pytest.approx(expected, rel=1e-9)
    assert measures.autocorrelation_time(np.ones((3, 7))) == 1.0


@pytest.mark.parametrize(('factor', 'fault'), [
    (0.5, 'covariance_small'), (1.0, None), (2.0, 'covariance_large')])
def test_covariances_may_be_about_the_axes_of_sensor_or_world(report, factor, fault):
    """The covariances of the reference filter are consistent; others are a factor off."""
    outcomes = report('reference', seeds=2).outcomes
    of_sensor, of_world = [], []
    for outcome in outcomes:
        turn = Rotation.from_quat(outcome.estimates).as_matrix()
        of_sensor.append(replace(outcome, covariances=factor * outcome.covariances))
        of_world.append(replace(outcome, covariances=factor * (
            turn @ outcome.covariances @ turn.transpose(0, 2, 1))))
    for absolute in (False, True):
        one, other = (diagnosis.consistency(said, absolute) for said in (of_sensor, of_world))
        assert one['tilt'].ratio == pytest.approx(other['tilt'].ratio, rel=1e-6)
        for found in (one, other):
            named = diagnosis.covariance_fault(found)
            assert (named and named.name) == fault
    assert one['attitude'].ratio == pytest.approx(other['attitude'].ratio, rel=1e-6)


@pytest.mark.parametrize('name', MISREADINGS)
def test_a_misreading_is_named_with_its_evidence(report, name):
    found = report('vqf', name)
    assert found.faults == [name] and not found.passed, found
    if name not in ('stamp_offset', 'time_step', 'diverges', 'invalid_output'):   # it is undone
        assert found.measures['tilt_rms_deg'] < 0.1 and found.measures['convergence_s'] < 1.0
        assert found.outcomes[0].errors.tilt[-1] < 0.01
    assert name in str(found) and found.found[0].evidence in str(found)


@pytest.mark.parametrize('name', ['first_order_integration', 'lever_arm', 'no_bias_estimate'])
def test_a_fault_of_the_method_is_named(report, name):
    assert report(name).faults == [name]
    assert set(FAULTY) == set(FAULTS)
    if name == 'lever_arm':             # which hides the other comes first
        assert report(name, 'component_order').faults == ['component_order', name]


@pytest.mark.parametrize('name', ['gyroscope_wiring', 'conjugated'])
def test_another_filter_has_its_own_faults_and_this_one(report, name):
    pytest.importorskip('imufusion')
    own = report('imufusion').faults
    assert own and report('imufusion', name).faults == [name, *own]


def test_a_filter_that_corrects_in_a_quarter_of_a_second_corrects(report):
    """And then goes to and fro about the truth."""
    pytest.importorskip('ahrs')
    assert report('madgwick-6d').faults == ['first_order_integration']


def test_a_filter_without_faults_passes(report):
    found = report('reference', seeds=2)
    assert found.passed, found
    marks = found.measures
    assert marks['tilt_rms_deg'] < 0.03 and marks['convergence_s'] < 1.0
    assert marks['bias_found'] == pytest.approx(1.0, abs=0.01)
    # The bound is that of white noise alone, in the settled half.
    assert 0.7 < marks['tilt_to_bound'] < 1.3 and 0.7 < marks['heading_to_bound'] < 2.0
    assert marks['tilt_to_gyroscope'] < 0.6
    assert marks['nees_low'] < marks['nees'] < marks['nees_high']
    explained = {name for name in MEANINGS if not name.startswith(('data_', 'field_'))}
    assert {*explained, 'nees_low', 'nees_high', 'nees_attitude_low', 'nees_attitude_high'} == {
        *marks}, 'each measure is explained'
    assert 'fault from 1.5\n' in str(found)


def test_vqf_passes_with_and_without_magnetometer(report):
    found = report('vqf')
    assert found.passed, found
    assert found.measures['tilt_rms_deg'] < 0.05 and 'nees' not in found.measures
    without = report('vqf-6d')
    assert without.passed and without.measures['heading_rms_deg'] < 0.1, without
    assert examine(partial(Vqf, tauAcc=30.0), seeds=1, isolated=False).passed


@pytest.fixture
def short_exam(report, monkeypatch):
    monkeypatch.setattr(pytest_plugin, 'examine', report)


def test_the_fixture_for_pytest_fails_a_test_of_a_filter_with_faults(
        short_exam, pass_exam, report):         # noqa: F811
    assert pass_exam('vqf') is report('vqf')
    with pytest.raises(pytest.fail.Exception, match='conjugated, the error falls'):
        pass_exam('vqf', 'conjugated')
    pass_exam('vqf', 'conjugated', known=['conjugated'])


def test_north_is_magnetic_north():
    """The declination of this field is 27 degrees."""
    run = scenarios.record(scenarios.PIVOT, {'mag.field': (10e-6, 20e-6, -40e-6)}, 1)
    east, north, _ = Rotation.from_quat(run.truth).apply(run.magnetometer).T
    assert east == pytest.approx(0.0, abs=1e-18)
    assert north == pytest.approx(math.hypot(10e-6, 20e-6))


def test_without_heading_a_world_north_east_down_and_the_sign_of_gravity_are_the_same(report):
    for name in ('frame_ned', 'gravity_sign'):
        found = report('vqf-6d', name)
        assert found.faults == ['frame_ned', 'gravity_sign']
        assert 'cannot be told apart' in found.found[0].evidence


def test_a_filter_that_goes_on_from_run_to_run_gets_the_same_verdict_but_for_its_covariance(
        report):
    assert report('vqf', 'frame_ned', restart=False).faults == ['frame_ned']
    assert report('too sure').faults == ['covariance_small']
    found = report('too sure', restart=False)
    assert found.passed and found.measures['nees'] > 1.5, found
    assert found.measures['heading_rms_deg'] < 1.0
    assert report('reference', restart=False).passed


def test_an_error_that_only_noise_shows_is_inaccurate():
    class Nervous(Vqf):
        def update(self, gyroscope, accelerometer, *others):
            noisy = abs(np.linalg.norm(accelerometer) - scenarios.GRAVITY) > 1e-6
            return (Rotation.from_rotvec((0.0, 0.0, 0.035 * noisy)) * Rotation.from_quat(
                super().update(gyroscope, accelerometer, *others))).as_quat()

    assert examine(Nervous, seeds=1, isolated=False).faults == ['inaccurate']


class Bad:
    def __init__(self, said):
        self._said = said

    def update(self, *readings):
        return self._said()


@pytest.mark.parametrize(('said', 'says'), [
    (partial(int, 'north'), 'update 1 of 200 raises ValueError: invalid literal'),
    (lambda: 'north', 'update 1 returns north: must be 4 finite numbers'),
    (lambda: np.full(4, math.inf), 'must be 4 finite numbers'),
    (lambda: np.ones(4), 'its norm must be 1')])
def test_a_filter_that_returns_no_attitude_is_told(said, says):
    report = examine(partial(Bad, said), seeds=1, isolated=False)
    assert report.faults == ['invalid_output']
    assert says in str(report) and not report.measures


def test_a_covariance_may_be_unknown_but_not_impossible(slow):
    class Known(Vqf):
        covariance = np.zeros((3, 3))

    assert np.isnan(follow(Known, slow).covariances).all()
    asymmetric = np.eye(3) + 0.1 * np.eye(3, k=1)
    for Known.covariance in (-np.eye(3), 0.5, np.full((3, 3), math.nan), asymmetric):
        with pytest.raises(InvalidOutputError, match=r'covariance is .*: must '):
            follow(Known, slow)


def test_filters_must_share_no_state():
    assert 'share no state' in str(examine(cache(Vqf), seeds=1))


def test_whatever_a_filter_says_can_be_written(tmp_path):
    def fail():
        raise ValueError('red\x1b[31m\nand $a^$ \ud800')

    report = examine(partial(Bad, fail), seeds=1, isolated=False, subject='a\x1b $a^$ \ud800')
    assert 'raises ValueError: red\\x1b[31m and $a^$ \\ud800' in report.found[0].evidence
    assert report.subject == 'a\\x1b $a^$ \\ud800'
    ElementTree.fromstring(report.as_junit().encode())
    assert '"x": null' in Report('', (), {'x': math.inf}).as_json()
    draw_page(report, tmp_path / 'page.svg')
    assert '$a^$' in (tmp_path / 'page.svg').read_text()


def test_the_page_has_two_panels_with_plain_numbers(report, tmp_path):
    draw_page(report('vqf'), tmp_path / 'page.svg')
    page = (tmp_path / 'page.svg').read_text()
    assert '<!-- 0.01 -->' in page and 'mathdefault' not in page
    assert page.count('<!-- t [s] -->') == 2 and '<!-- tilt error [deg] -->' in page


def test_an_excitation_that_fails_leaves_the_noisy_runs():
    report = examine(lambda: Mock(spec=['update'], update=Mock(
        side_effect=4000 * [(0.0, 0.0, 0.0, 1.0)])), seeds=1)
    assert report.faults == ['invalid_output', 'inaccurate']


def test_a_run_that_fails_leaves_the_others():
    class Fragile(Vqf):
        def update(self, gyroscope, accelerometer, magnetometer, dt):
            if dt < 0.009:
                raise ValueError('too fast for me')
            return super().update(gyroscope, accelerometer, magnetometer, dt)

    report = examine(Fragile, seeds=1, isolated=False)
    assert report.faults == ['invalid_output']
    assert 'fast at 200 Hz, seed 0: update 1 of' in str(report)
    assert report.measures['tilt_rms_deg'] < 0.05 and 'bias_error_s' in report.measures


@pytest.mark.parametrize(('said', 'says'), [
    (partial(time.sleep, 60.0), '100 updates take more than 1 s'),
    (lambda: ctypes.string_at(0), 'the filter ends the process: Segmentation fault'),
    (partial(os._exit, 3), 'the filter ends the process: exit code 3'),
    (partial(sys.exit, 3), 'update 1 of 100 raises SystemExit: 3')])
def test_a_filter_that_never_returns_or_crashes_is_told(monkeypatch, slow, said, says):
    if says.endswith(' s'):
        monkeypatch.setattr(isolation, 'LONGEST_S', 1.0)
        monkeypatch.setattr(isolation, 'UPDATE_S', 0.0)
    with pytest.raises(InvalidOutputError, match=says):
        follow(partial(Bad, said), slow, feed=isolation.feed_apart)


def test_a_process_of_its_own_changes_nothing(report):
    assert report('vqf', isolated=True).as_json() == report('vqf').as_json()


@pytest.mark.parametrize(('options', 'says'), [
    ({'level': 'slow'}, "level = 'slow': must be one of quick, full"),
    ({'imu': {'imu.colour': 1.0}}, 'imu.colour = 1.0: there is no such parameter'),
    ({'imu': ROOT / 'config/cusp.yaml'}, 'cusp.yaml has top.'),
    ({'imu': {'imu.bandwidth': 9.0}}, 'imu has imu.bandwidth = 9.0: must be 0.0, because'),
    ({'imu': {'imu.rate': 9.0}, 'level': 'full'}, 'imu.rate = 9.0: must be 200.0, because'),
    ({'imu': {'mag.field': [0.0, 0.0, 1.0]}}, 'mag.field = [0.0, 0.0, 1.0]: must have a horiz'),
    ({'seeds': 0}, 'seeds = 0: must be'), ({'seeds': [-1]}, 'must be'),
    ({'seeds': 2.5}, 'seeds = 2.5: must be')])
def test_wrong_arguments_are_refused(options, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        examine(Vqf, **options)


@pytest.mark.parametrize('filter_', ['vqf', Vqf()])
def test_what_makes_no_filter_is_refused(filter_):
    with pytest.raises(TypeError, match=r"make_filter = .*: pass the class .*FILTERS\['vqf'\]"):
        examine(filter_)


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
                              ('mine:Still', 2, 'must be'), ('none.py:Still', 1, 'No such file')):
        assert main(['--filter', f'{tmp_path}/{given}']) == code
        assert says in capsys.readouterr().err


@pytest.mark.parametrize(('arguments', 'says'), [
    ([], 'give either a'), (['x', '--topic', '/pose', '--filter', 'vqf'], 'give either a'),
    (['--filter', 'vqf', '--seeds', '0'], 'seeds = 0'), (['--data', '.'], 'give either a'),
    (['x', '--data', '.'], 'give either a'),
    (['--filter', 'vqf', '--data', '.', '--level', 'full'],
     '--level cannot be given with --data\n'),
    (['x', '--topic', '/pose', '--level', 'quick'],
     '--level cannot be given with a log: must be --topic, --truth, --heading')])
def test_wrong_arguments_of_the_command(capsys, arguments, says):
    assert main(arguments) == 2
    assert says in capsys.readouterr().err
