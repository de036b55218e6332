# SPDX-License-Identifier: Apache-2.0
"""The exam of attitude filters: measures, faults by name, bad filters, the command."""

import contextlib
import ctypes
import math
import os
import re
import sys
import time
from dataclasses import replace
from functools import cache, partial
from unittest.mock import create_autospec
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.faulty_filters import FAULTY, MISREADINGS
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import (
    diagnosis,
    examine,
    examiner,
    isolation,
    measures,
    pytest_plugin,
    scenarios,
    trial,
)
from spinning_top_sim.exam.adapters import FILTERS, Vqf
from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.diagnosis import FAULTS
from spinning_top_sim.exam.page import draw_page
from spinning_top_sim.exam.pytest_plugin import pass_exam  # noqa: F401, a fixture
from spinning_top_sim.exam.reference import ReferenceFilter
from spinning_top_sim.exam.trial import InvalidOutputError, follow

pytest.importorskip('vqf')


class SureVqf(Vqf):
    covariance = 1e-12 * np.eye(3)


class UnsureVqf(Vqf):
    covariance = np.eye(3)


SUBJECTS = {'reference': ReferenceFilter, 'covariance_small': SureVqf,
            'covariance_large': UnsureVqf}


@pytest.fixture(scope='module')
def report():
    """
    Return a function that returns the report on a filter; it computes each report once.

    It takes the name of a filter of SUBJECTS, FILTERS or FAULTY, a misreading, and options of
    `examine`.  By default there is one seed, and the filter runs in this process.
    """
    @cache
    def report(name, fault='', **options):
        make = {**FAULTY, **FILTERS, **SUBJECTS}[name]
        if fault:
            make = partial(MISREADINGS[fault], make)
        return examine(make, **{'seeds': 1, 'isolated': False, 'subject': name, **options})
    return report


@pytest.fixture(scope='module')
def slow():
    """A second of the slow motion."""
    return scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))


# ----------------------------------------------------------------------------------- measures


def test_tilt_and_heading_are_those_of_the_world():
    truth = Rotation.from_euler('xyz', (0.4, 0.5, 0.6))
    for axis, tilt, heading in (('x', 0.2, 0.0), ('y', 0.2, 0.0), ('z', 0.0, 0.2)):
        estimate = Rotation.from_euler(axis, 0.2) * truth
        errors = measures.errors_of(estimate.as_quat()[None], truth.as_quat()[None])
        assert errors.tilt == pytest.approx(tilt, abs=1e-7)
        assert errors.heading == pytest.approx(heading, abs=1e-7)


def runs_at(factors, scenario):
    scenario = replace(scenario, duration=4.0, reversals=(), noisy=False)
    return [scenarios.record(replace(scenario, rate=100.0 * factor), {}, 1) for factor in factors]


def moved(run, turns):
    """Return the error at the end of turns (n, 3) [rad] from the true start."""
    attitude = Rotation.from_quat(run.truth[0])
    estimates = [attitude.as_quat()]
    for turn in turns:
        attitude = attitude * turn
        estimates.append(attitude.as_quat())
    return measures.moved(np.array(estimates), run.truth)[-1]


def test_the_order_of_eulers_steps_is_1_and_that_of_mean_rates_in_closed_form_2():
    factors = (1.0, 2.0, 4.0)
    runs = runs_at(factors, scenarios.SLOW)
    euler = [moved(run, [Rotation.from_quat((*(0.5 * dt * rate), 1.0))
                         for rate, dt in zip(run.rates[:-1], run.dt[1:], strict=True)])
             for run in runs]
    closed = [moved(run, Rotation.from_rotvec(run.gyroscope[1:] * run.dt[1:, None]))
              for run in runs]
    assert measures.convergence_order(factors, euler) == pytest.approx(1.0, abs=0.1)
    assert measures.convergence_order(factors, closed) == pytest.approx(2.0, abs=0.1)


def test_the_gyroscope_reads_the_mean_over_its_step():
    coarse, fine = runs_at((1.0, 16.0), scenarios.WAVES)
    mean = fine.gyroscope.reshape(-1, 16, 3).mean(axis=1)
    assert np.max(np.abs(coarse.gyroscope - mean)) < 1e-6
    assert coarse.truth[-1] == pytest.approx(fine.truth[-1], abs=1e-12)
    assert np.max(np.abs(coarse.rates - coarse.gyroscope)) > 0.01


def test_a_delay_is_measured():
    run, = runs_at((4.0,), scenarios.FAST)
    offset = measures.time_offset(run.truth[:-4], run.truth[4:], run.rates[4:], True)
    assert offset.seconds == pytest.approx(0.01, rel=0.01)
    assert offset.after < 0.1 * offset.before


def linear_filter(seed):
    """
    Return attitudes, truth and covariances of a Kalman filter of small tilts: it is consistent.

    Each tilt is a random walk of 0.002 rad a step, of which readings have an error of 0.01 rad.
    """
    random = np.random.default_rng(seed)
    walk, noise, n = 0.002, 0.01, 4000
    true = np.cumsum(walk * random.standard_normal((n, 2)), axis=0)
    variance, tilt = 1.0, np.zeros(2)
    said, variances = [], []
    for reading in true + noise * random.standard_normal((n, 2)):
        variance += walk ** 2
        gain = variance / (variance + noise ** 2)
        tilt = tilt + gain * (reading - tilt)
        variance *= 1.0 - gain
        said.append(tilt)
        variances.append(variance)
    estimates, truth = (Rotation.from_rotvec(np.column_stack((tilts, np.zeros(n)))).as_quat()[200:]
                        for tilts in (np.array(said), true))
    return estimates, truth, np.array(variances)[200:, None, None] * np.eye(3)


def test_the_nees_of_a_linear_filter_is_in_its_band():
    runs = [linear_filter(seed) for seed in range(3)]
    for factor, expected in ((1.0, None), (0.5, 'above'), (2.0, 'below')):
        nees = measures.nees_of([(*both, factor * p) for *both, p in runs], False)
        low, high = nees.band()
        assert nees.degrees > 300
        assert expected == ('below' if nees.ratio < low else
                            'above' if nees.ratio > high else None)
        assert nees.ratio == pytest.approx(1.0 / factor, rel=0.2)
    for _, _, covariances in runs:
        covariances[:, 2, 2] = 0.0          # of the heading, of which the filter knows nothing
    assert measures.nees_of(runs, False).ratio == pytest.approx(2.0 * nees.ratio, rel=0.02)
    assert measures.nees_of(runs, True) is None


def summed_autocorrelation_time(values):
    centred = values - np.mean(values)
    time = 1.0
    for lag in range(1, values.shape[1]):
        time += 2.0 * np.mean(centred[:, lag:] * centred[:, :-lag]) / np.mean(centred ** 2)
        if lag >= 5.0 * time:
            break
    return max(time, 1.0)


@pytest.mark.parametrize('shape', [(1, 1), (1, 2), (3, 7), (3, 1000)])
def test_the_autocorrelation_time_is_the_direct_sum(shape):
    noise = np.random.default_rng(1).standard_normal(shape)
    for values in (noise, np.cumsum(noise, axis=1), np.ones(shape)):
        expected = summed_autocorrelation_time(values) if np.ptp(values) else 1.0
        for scale in (1.0, 2.0 ** 1000):
            assert measures.autocorrelation_time(scale * values) == pytest.approx(expected,
                                                                                  rel=1e-9)


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


# ------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize('name', MISREADINGS)
def test_a_misreading_is_named_with_its_evidence(report, name):
    found = report('vqf', name)
    assert found.faults == [name], found
    assert not found.passed
    assert name in str(found) and found.found[0].evidence in str(found)


@pytest.mark.parametrize('name', sorted(set(FAULTY) - set(MISREADINGS)))
def test_a_fault_of_the_method_is_named(report, name):
    assert report(name).faults == [name]


def test_every_fault_is_tried():
    assert set(FAULTY) == set(FAULTS)


def test_a_filter_without_faults_passes(report):
    found = report('reference', seeds=2)
    assert found.passed and not found.faults, found
    marks = found.measures
    assert marks['tilt_rms_deg'] < 0.03 and marks['convergence_s'] < 1.0
    assert marks['bias_found'] == pytest.approx(1.0, abs=0.01)
    assert marks['nees_low'] < marks['nees'] < marks['nees_high']


def test_vqf_passes_with_and_without_magnetometer(report):
    found = report('vqf', seeds=None)
    assert found.passed and len(found.outcomes) == 3, found
    assert all(type(value) is float for value in found.measures.values())
    assert found.measures['tilt_rms_deg'] < 0.05 and 'nees' not in found.measures
    without = report('vqf-6d')
    assert without.passed and without.measures['heading_rms_deg'] < 0.1, without


def test_the_fixture_for_pytest_fails_a_test_of_a_filter_with_faults(
        pass_exam, report, monkeypatch):        # noqa: F811
    monkeypatch.setattr(pytest_plugin, 'examine', report)
    assert pass_exam('vqf') is report('vqf')
    with pytest.raises(pytest.fail.Exception, match='conjugated, the error falls'):
        pass_exam('vqf', 'conjugated')
    pass_exam('vqf', 'conjugated', known=['conjugated'])


def test_north_is_magnetic_north_in_every_field():
    """The declination of this field is 27 degrees."""
    field = {'mag.field': (10e-6, 20e-6, -40e-6)}
    level = np.array((0.0, 0.0, 0.0, 1.0))
    for run in (scenarios.record(scenarios.SLOW, field, 1),
                scenarios.record(scenarios.PIVOT, field, 1),
                scenarios.turning(field, level, level, 1.0)):
        east, north, up = Rotation.from_quat(run.truth).apply(run.magnetometer).T
        assert east == pytest.approx(0.0, abs=1e-18)
        assert north == pytest.approx(math.hypot(10e-6, 20e-6))
        assert up == pytest.approx(-40e-6)


def test_without_heading_a_world_north_east_down_and_the_sign_of_gravity_are_the_same(report):
    for name in ('frame_ned', 'gravity_sign'):
        found = report('vqf-6d', name)
        assert found.faults == ['frame_ned', 'gravity_sign']
        assert 'cannot be told apart' in found.found[0].evidence


def test_a_filter_that_goes_on_from_run_to_run_gets_the_same_verdict(report):
    found = report('vqf', 'frame_ned', restart=False)       # without a heading it is another
    assert found.faults == report('vqf', 'frame_ned').faults, found


def test_a_covariance_is_measured_but_not_judged_from_run_to_run(report):
    found = report('covariance_small', restart=False)
    assert found.passed and found.measures['nees'] > 0.0, found
    assert found.measures['heading_rms_deg'] < 1.0
    assert 1.0 < found.measures['convergence_s'] < 30.0


def test_the_report_is_the_same_if_workers_share_the_runs(report, monkeypatch):
    """Tasks go to the workers pickled, and their results come in any order."""
    cloudpickle = pytest.importorskip('cloudpickle')
    pytest.importorskip('distributed')
    from spinning_top_sim.tools import ensemble_cluster as cluster

    computed = []

    def compute(client, task, numbers):
        computed.append(numbers := list(numbers))
        return map(cloudpickle.loads(cloudpickle.dumps(task)), reversed(numbers))

    for name, instead in (('connect', lambda *_: contextlib.nullcontext()), ('compute', compute)):
        monkeypatch.setattr(cluster, name, create_autospec(
            getattr(cluster, name), side_effect=instead))
    one, two = (report('vqf', 'gyroscope_units', level='full', seeds=2, **options)
                for options in ({}, {'workers': 2, 'isolated': True}))
    assert computed == [[0, 1], [0, 1], [0, 1, 2, 3]]       # the seeds are repeated
    assert one.as_json() == two.as_json() and one.faults == ['gyroscope_units']
    assert [outcome.run.name for outcome in one.outcomes] == [
        outcome.run.name for outcome in two.outcomes]
    assert all(np.array_equal(a.estimates, b.estimates)
               for a, b in zip(one.outcomes, two.outcomes, strict=True))


def test_a_full_exam_has_more_motions(report):
    marks = report('vqf', 'gyroscope_units', level='full', seeds=2).measures    # it is undone
    assert marks['tilt_rms_pole_deg'] < 0.1 and marks['tilt_rms_command_deg'] < 0.1
    assert marks['tilt_rms_saturation_deg'] > 0.1 and marks['tilt_rms_drops_deg'] > 0.1


def test_imufusion_takes_first_order_steps_and_does_not_estimate_a_bias(report):
    pytest.importorskip('imufusion')
    found = report('imufusion')
    assert {'first_order_integration', 'no_bias_estimate'} <= set(found.faults)
    assert found.measures['integration_error_deg'] > 0.5


# -------------------------------------------------------------------------------- bad filters


class Bad:
    def __init__(self, said):
        self._said = said

    def update(self, *readings):
        return self._said()


def fail():
    raise RuntimeError('no calibration')


@pytest.mark.parametrize(('said', 'says'), [
    (fail, 'update 1 of 200 raises RuntimeError: no calibration'),
    (lambda: None, 'update 1 returns None: must be 4 numbers x, y, z, w'),
    (lambda: (0.0, 0.0, 1.0), 'of shape (3,): must be 4 numbers'),
    (lambda: 'north', 'update 1 returns north'),
    (lambda: np.full(4, math.inf), 'it is not finite'),
    (lambda: np.ones(4), 'its norm is 2, and must be 1'),
    (lambda: np.eye(4), 'of shape (4, 4)')])
def test_a_filter_that_returns_no_attitude_is_told(said, says):
    report = examine(partial(Bad, said), seeds=1, isolated=False)
    assert report.faults == ['invalid_output']
    assert says in str(report)
    assert not report.measures


@pytest.mark.parametrize(('first', 'others', 'says'), [
    (4.9, 0.01, None),              # it compiles itself
    (0.2, 0.2, 'update 30 of 100 ends after 6 s, and must within 5.6 s'),
    (5.5, 0.0, 'too slow: update 10 of 100 ends after 5.5 s')])
def test_a_filter_may_take_some_seconds_and_twice_the_time_of_the_run(
        monkeypatch, slow, first, others, says):
    now = 0.0

    def work():
        nonlocal now
        now += others if now else first
        return 0.0, 0.0, 0.0, 1.0

    monkeypatch.setattr(trial, '_working_time', lambda: now)
    if says is None:
        assert len(follow(partial(Bad, work), slow).estimates) == 100
        return
    with pytest.raises(InvalidOutputError, match=says):
        follow(partial(Bad, work), slow)


def test_whatever_a_filter_says_can_be_written(tmp_path):
    class Rude(Vqf):
        def update(self, *readings):
            raise ValueError('red\x1b[31m\nand $a^$ \ud800')

    report = examine(Rude, seeds=1, isolated=False, subject='a\x1b $a^$ \ud800')
    assert 'raises ValueError: red\\x1b[31m and $a^$ \\ud800' in report.found[0].evidence
    assert report.subject == 'a\\x1b $a^$ \\ud800'
    ElementTree.fromstring(report.as_junit().encode())
    draw_page(report, tmp_path / 'page.svg')
    assert '$a^$' in (tmp_path / 'page.svg').read_text()


def test_waiting_for_a_processor_is_not_slowness(monkeypatch, tmp_path):
    waiting, now = tmp_path / 'schedstat', [0.0]
    monkeypatch.setattr(trial, 'WAITING', waiting)
    monkeypatch.setattr(trial.time, 'perf_counter', lambda: now[0])
    began = trial._working_time()
    now[0] = 7.0
    waiting.write_text('0 6500000000 0')
    assert trial._working_time() - began == pytest.approx(0.5)


def test_what_is_not_known_is_nan(slow):
    class Forgetful(Vqf):
        number = 0
        bias = property(lambda self: None if self.number == 20 else np.zeros(3))

        def update(self, *readings):
            self.number += 1
            return super().update(*readings)

        @property
        def covariance(self):
            return {30: None, 50: np.zeros((3, 3)), 60: 1e308 * np.ones((3, 3))}.get(
                self.number, np.eye(3))

    def known(values):
        return np.flatnonzero(np.isfinite(values).reshape(len(values), -1).all(axis=1)).tolist()

    said = follow(Forgetful, slow)
    assert known(said.covariances) == [9, 19, 39, 59, 69, 79, 89, 99]
    assert known(said.biases) == [9, *range(29, 100, 10)]
    assert known(said.since(50).covariances) == [9, 19, 29, 39, 49]
    assert np.all(said.covariances[59] == 1e308)


def test_a_filter_may_return_the_array_that_its_next_update_changes(slow):
    class InPlace(Vqf):
        def __init__(self):
            super().__init__()
            self._said = np.empty(4)

        def update(self, *readings):
            self._said[:] = super().update(*readings)
            return self._said

    assert np.array_equal(follow(InPlace, slow).estimates, follow(Vqf, slow).estimates)


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


def update_for_ever():
    while True:
        pass


@pytest.mark.parametrize(('said', 'says'), [
    (update_for_ever, 'update 1 of 100 takes more than 2 s: killed'),
    (lambda: ctypes.string_at(0), 'update 1 of 100 ends the process: Segmentation fault'),
    (partial(os._exit, 3), 'update 1 of 100 ends the process: exit code 3'),
    (partial(sys.exit, 3), 'update 1 of 100 raises SystemExit: 3')])
def test_a_filter_that_never_returns_or_crashes_is_told(monkeypatch, slow, said, says):
    if says.endswith('killed'):
        monkeypatch.setattr(isolation, 'LONGEST_S', 2.0)
    with pytest.raises(InvalidOutputError, match=says):
        follow(partial(Bad, said), slow, feed=isolation.feed_apart)


def test_a_filter_that_takes_long_but_goes_on_is_not_killed(monkeypatch, slow):
    monkeypatch.setattr(isolation, 'LONGEST_S', 2.0)

    def work():
        time.sleep(0.5)
        return 0.0, 0.0, 0.0, 1.0

    short = slow.part(slice(5))
    assert len(follow(partial(Bad, work), short, feed=isolation.feed_apart).estimates) == 5


def test_a_process_of_its_own_changes_nothing(report):
    assert report('vqf', isolated=True).as_json() == report('vqf').as_json()


@pytest.mark.parametrize(('covariance', 'says'), [
    (-np.eye(3), 'must have no negative eigenvalue'),
    (np.eye(2), 'of shape (2, 2): must be 3 x 3 finite numbers'),
    (0.5, 'covariance is 0.5: must be 3 x 3 finite numbers'),
    ('large', 'covariance is large: must be 3 x 3 finite numbers'),
    (np.full((3, 3), math.nan), 'must be 3 x 3 finite numbers')])
def test_a_wrong_covariance_is_told(slow, covariance, says):
    class Wrong(Vqf):
        pass

    Wrong.covariance = covariance
    with pytest.raises(InvalidOutputError, match=re.escape(says)):
        follow(Wrong, slow)


@pytest.mark.parametrize(('options', 'says'), [
    ({'level': 'slow'}, "level = 'slow': must be one of quick, full"),
    ({'imu': {'imu.colour': 1.0}}, 'imu.colour = 1.0: there is no such parameter'),
    ({'imu': {'seed': 3, 'top.mass': 1.0}}, 'imu has seed, top.mass: must have parameters imu.* '),
    ({'imu': ROOT / 'config/cusp.yaml'}, 'cusp.yaml has top.'),
    ({'seeds': 0}, 'seeds = 0: must be'), ({'seeds': [-1]}, 'must be'),
    ({'seeds': [0.5]}, 'must be'), ({'seeds': 2.5}, 'seeds = 2.5: must be'),
    ({'seeds': np.int64(-3)}, 'must be'), ({'workers': 0}, 'workers = 0: must be from 1'),
    ({'workers': 2, 'restart': False}, 'workers = 2: must be from 1')])
def test_wrong_arguments_are_refused(options, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        examine(Vqf, **options)


def test_the_noise_is_compared_with_the_same_motion_though_the_filter_fails_with_a_seed(
        monkeypatch, report):
    record, failing = scenarios.record, []

    class Failing(Vqf):
        def update(self, gyroscope, *readings):
            if failing and np.array_equal(gyroscope, failing[0]):
                raise ValueError('these readings')
            return super().update(gyroscope, *readings)

    def recorded(scenario, imu, seed):
        run = record(scenario, imu, seed)
        if scenario is scenarios.SLOW and seed == 0 and not failing:
            failing.append(run.gyroscope[2000])
        return run

    monkeypatch.setattr(scenarios, 'record', recorded)
    found = examine(Failing, seeds=[0, 1], isolated=False)
    assert found.faults == ['invalid_output']
    assert found.measures['noise_gain'] == pytest.approx(
        report('vqf', seeds=(1,)).measures['noise_gain'], rel=1e-12)


def test_the_gain_of_the_noise_is_without_the_lever_arm_that_the_imu_has(report):
    arm = {**scenarios.CALIBRATED, 'imu.lever_arm': (0.1, 0.0, 0.0)}
    assert examine(Vqf, seeds=1, imu=arm, isolated=False).measures['noise_gain'] == pytest.approx(
        report('vqf').measures['noise_gain'], rel=0.1)


def test_a_run_that_fails_at_once_does_not_move_a_filter_that_goes_on(monkeypatch):
    class NeedsField(Vqf):
        def update(self, gyroscope, accelerometer, magnetometer, dt):
            if magnetometer is None:
                raise ValueError('no field')
            return super().update(gyroscope, accelerometer, magnetometer, dt)

    turning, begins = scenarios.turning, []
    monkeypatch.setattr(scenarios, 'turning', lambda imu, first, *rest: (
        begins.append(first), turning(imu, first, *rest))[1])
    conditions = examiner._OneFilter(cache(NeedsField), trial.feed, scenarios.CALIBRATED)
    pivot, fast = (scenarios.record(replace(scenario, duration=2.0, reversals=()),
                                    scenarios.CALIBRATED, 0)
                   for scenario in (scenarios.PIVOT, scenarios.FAST))
    conditions.follow(pivot)
    with pytest.raises(InvalidOutputError):
        conditions.follow(fast, magnetometer=False)
    conditions.follow(fast)
    assert (begins[-1] == pivot.truth[-1]).all()


def test_a_filter_that_fails_with_every_seed_once_a_misreading_is_undone_is_reported():
    class Ends(MISREADINGS['gyroscope_units'].func):
        count = 0

        def update(self, *readings):
            type(self).count += 1
            if self.count > 34_000:
                raise RuntimeError('it has ended')
            return super().update(*readings)

    report = examine(lambda: Ends(partial(Vqf, magnetic=False), rates=math.pi / 180.0), seeds=1,
                     restart=False)
    assert report.faults == ['gyroscope_units', 'invalid_output']


def test_only_level_imu_and_seeds_may_be_given_without_their_names():
    with pytest.raises(TypeError, match='takes from 1 to 4 positional arguments but 5 were given'):
        examine(Vqf, 'quick', None, 1, 2)       # workers?


def test_the_command_examines_a_published_filter(capsys):
    assert main(['--filter', 'vqf', '--seeds', '1', '--imu',
                 str(ROOT / 'config/imu/adis16470.yaml')]) == 0
    assert 'vqf: passed' in capsys.readouterr().out


@pytest.mark.parametrize(('arguments', 'says'), [
    ([], '--topic: which topic'), (['x', '--topic', '/pose', '--filter', 'vqf'], 'give either a'),
    (['--filter', 'vqf', '--workers', '0'], 'workers = 0: must be from 1'),
    (['--filter', 'vqf', '--seeds', '0'], 'seeds = 0'),
    (['--filter', 'vqf', '--truth', 'a'], '--truth a: --filter takes --level, --imu, '),
    (['--topic', 'a', '--heading', 'true'], '--heading true: a node takes --topic, --level, '),
    (['--node', 'a', '--topic', 'b', '--workers', '2'], '--workers 2: a node takes'),
    (['x', '--topic', '/pose', '--level', 'quick'],
     '--level quick: a log takes --topic, --truth, --heading only')])
def test_wrong_arguments_of_the_command(capsys, arguments, says):
    assert main(arguments) == 2
    assert says in capsys.readouterr().err


def test_its_help_fits_into_80_columns(capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit, match='0'):
        main(['--help'])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
