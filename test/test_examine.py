# SPDX-License-Identifier: Apache-2.0
"""The exam of attitude filters: measures, faults by name, bad filters, logs, the command."""

import ctypes
import json
import math
import os
import re
import struct
import sys
import time
from dataclasses import replace
from functools import cache, partial
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.faulty_filters import FAULTY, MISREADINGS
from helpers.reference import ROOT
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import examine, examiner, isolation, measures, scenarios, trial
from spinning_top_sim.exam.adapters import FILTERS, Vqf
from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.diagnosis import FAULTS
from spinning_top_sim.exam.log import examine_log
from spinning_top_sim.exam.page import draw_page
from spinning_top_sim.exam.pytest_plugin import pass_exam  # noqa: F401, a fixture
from spinning_top_sim.exam.reference import ReferenceFilter
from spinning_top_sim.exam.trial import InvalidOutputError, follow
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import create_file
from spinning_top_sim.streams import messages
from spinning_top_sim.tools.simulate import main as simulate

pytest.importorskip('vqf')

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


def linear_filter(seed, factor=1.0):
    """
    Return attitudes, truth and covariances of a Kalman filter of small tilts: it is consistent.

    Each tilt is a random walk of 0.002 rad a step, of which readings have an error of 0.01 rad.
    """
    random = np.random.default_rng(seed)
    walk, noise, n = 0.002, 0.01, 4000
    true = np.cumsum(walk * random.standard_normal((n, 2)), axis=0)
    readings = true + noise * random.standard_normal((n, 2))
    variance, tilt = 1.0, np.zeros(2)
    said, variances = [], []
    for reading in readings:
        variance += walk ** 2
        gain = variance / (variance + noise ** 2)
        tilt = tilt + gain * (reading - tilt)
        variance *= 1.0 - gain
        said.append(tilt)
        variances.append(variance)

    def attitudes(tilts):
        return Rotation.from_rotvec(np.column_stack((tilts, np.zeros(n)))).as_quat()[200:]
    covariances = factor * np.array(variances)[200:, None, None] * np.eye(3)
    return attitudes(np.array(said)), attitudes(true), covariances


@pytest.mark.parametrize(('factor', 'expected'), [(1.0, None), (0.5, 'above'), (2.0, 'below')])
def test_the_nees_of_a_linear_filter_is_in_its_band(factor, expected):
    runs = [linear_filter(seed, factor) for seed in range(3)]
    nees = measures.nees_of(runs, False)
    low, high = nees.band()
    assert nees.degrees > 300
    assert expected == ('below' if nees.ratio < low else 'above' if nees.ratio > high else None)
    assert nees.ratio == pytest.approx(1.0 / factor, rel=0.2)
    for _, _, covariances in runs:
        covariances[:, 2, 2] = 0.0          # of the heading, of which the filter knows nothing
    assert measures.nees_of(runs, False).ratio == pytest.approx(nees.ratio, rel=0.02)
    assert measures.nees_of(runs, True) is None


def summed_autocorrelation_time(values):
    centred = values - np.mean(values)
    time = 1.0
    for lag in range(1, values.shape[1]):
        time += 2.0 * np.mean(centred[:, lag:] * centred[:, :-lag]) / np.mean(centred ** 2)
        if lag >= 5.0 * time:
            break
    return max(time, 1.0)


@pytest.mark.parametrize('scale', [1.0, 2.0 ** 1000])
@pytest.mark.parametrize('shape', [(1, 1), (1, 2), (3, 7), (3, 1000)])
def test_the_autocorrelation_time_is_the_direct_sum(shape, scale):
    noise = np.random.default_rng(1).standard_normal(shape)
    for values in (noise, np.cumsum(noise, axis=1), np.ones(shape)):
        assert measures.autocorrelation_time(scale * values) == pytest.approx(
            summed_autocorrelation_time(values) if np.ptp(values) else 1.0, rel=1e-9)


def test_covariances_may_be_about_the_axes_of_the_world():
    said = follow(ReferenceFilter, scenarios.record(scenarios.SLOW, scenarios.CALIBRATED, 1))
    said = said.last(0.75)
    samples, of_filter = said.covariances
    estimates, truth = said.estimates[samples], said.run.truth[samples]
    turn = Rotation.from_quat(estimates).as_matrix()
    for factor in (0.5, 1.0, 2.0):
        of_sensor = factor * of_filter
        of_world = turn @ of_sensor @ turn.transpose(0, 2, 1)
        for absolute in (False, True):
            nees = [measures.nees_of([(estimates, truth, covariances)], absolute)
                    for covariances in (of_sensor, of_world)]
            assert nees[0].ratio == pytest.approx(nees[1].ratio, rel=1e-6)


# ------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize('name', MISREADINGS)
def test_a_misreading_is_named_with_its_evidence(name):
    report = examine(partial(MISREADINGS[name], Vqf), seeds=1)
    assert report.faults == [name], report
    assert not report.passed
    assert name in str(report) and report.found[0].evidence in str(report)


@pytest.mark.parametrize('name', sorted(set(FAULTY) - set(MISREADINGS)))
def test_a_fault_of_the_method_is_named(name):
    assert examine(FAULTY[name], seeds=3 if 'covariance' in name else 1).faults == [name]


def test_every_fault_is_tried():
    assert set(FAULTY) == set(FAULTS)


def test_a_filter_without_faults_passes():
    report = examine(ReferenceFilter)
    assert report.passed and not report.faults, report
    found = report.measures
    assert found['tilt_rms_deg'] < 0.03 and found['convergence_s'] < 1.0
    assert found['bias_found'] == pytest.approx(1.0, abs=0.01)
    assert found['nees_low'] < found['nees'] < found['nees_high']


def test_vqf_passes_with_and_without_magnetometer(pass_exam):   # noqa: F811
    report = pass_exam(Vqf)
    assert all(type(value) is float for value in report.measures.values())
    assert pass_exam(partial(Vqf, magnetic=False), seeds=1).measures['heading_rms_deg'] < 0.1
    assert report.measures['tilt_rms_deg'] < 0.05
    assert 'nees' not in report.measures
    with pytest.raises(pytest.fail.Exception, match='conjugated, the error falls'):
        pass_exam(partial(MISREADINGS['conjugated'], Vqf), seeds=1)
    pass_exam(partial(MISREADINGS['conjugated'], Vqf), seeds=1, known=['conjugated'])


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


def test_without_heading_a_world_north_east_down_and_the_sign_of_gravity_are_the_same():
    without = partial(Vqf, magnetic=False)
    for name in ('frame_ned', 'gravity_sign'):
        report = examine(partial(MISREADINGS[name], without), seeds=1)
        assert report.faults == ['frame_ned', 'gravity_sign']
        assert 'cannot be told apart' in report.found[0].evidence


@pytest.mark.parametrize('name', ['', 'gyroscope_units', 'frame_ned', 'stamp_offset'])
def test_a_filter_that_goes_on_from_run_to_run_gets_the_same_verdict(name):
    make = partial(Vqf, magnetic=False) if name else Vqf
    make = partial(MISREADINGS[name], make) if name else make
    report = examine(make, seeds=1, restart=False)
    assert report.faults == examine(make, seeds=1).faults, report
    if not name:
        assert report.measures['heading_rms_deg'] < 1.0
        assert 1.0 < report.measures['convergence_s'] < 30.0


def test_a_covariance_is_measured_but_not_judged_from_run_to_run():
    class WithCovariance(Vqf):
        covariance = 1e-12 * np.eye(3)

    assert examine(WithCovariance, seeds=1).faults == ['covariance_small']
    report = examine(WithCovariance, seeds=1, restart=False)
    assert report.passed and report.measures['nees'] > 0.0


def test_any_number_of_workers_gives_the_same_report():
    pytest.importorskip('distributed')
    make = partial(MISREADINGS['gyroscope_units'], Vqf)     # its runs are repeated
    one, two = (examine(make, 'full', seeds=2, workers=workers) for workers in (1, 2))
    assert one.as_json() == two.as_json() and one.faults == ['gyroscope_units']
    assert [outcome.run.name for outcome in one.outcomes] == [
        outcome.run.name for outcome in two.outcomes]
    assert all(np.array_equal(a.estimates, b.estimates)
               for a, b in zip(one.outcomes, two.outcomes, strict=True))


def test_a_full_exam_has_more_motions():
    report = examine(Vqf, 'full', seeds=2)
    assert report.passed
    assert report.measures['tilt_rms_pole_deg'] < 0.1
    assert report.measures['tilt_rms_command_deg'] < 0.1
    assert report.measures['tilt_rms_saturation_deg'] > 5.0 * report.measures['tilt_rms_deg']
    assert report.measures['tilt_rms_drops_deg'] > 5.0 * report.measures['tilt_rms_deg']


def test_imufusion_takes_first_order_steps_and_does_not_estimate_a_bias():
    pytest.importorskip('imufusion')
    report = examine(FILTERS['imufusion'], seeds=1)
    assert {'first_order_integration', 'no_bias_estimate'} <= set(report.faults)
    assert report.measures['integration_error_deg'] > 0.5


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
    report = examine(partial(Bad, said), seeds=1)
    assert report.faults == ['invalid_output']
    assert says in str(report)
    assert not report.measures


@pytest.mark.parametrize(('first', 'others', 'says'), [
    (4.9, 0.01, None),              # it compiles itself
    (0.2, 0.2, 'update 30 of 100 ends after 6 s, and must within 5.6 s'),
    (5.5, 0.0, 'too slow: update 10 of 100 ends after 5.5 s')])
def test_a_filter_may_take_some_seconds_and_twice_the_time_of_the_run(
        monkeypatch, first, others, says):
    now = 0.0

    def work():
        nonlocal now
        now += others if now else first
        return 0.0, 0.0, 0.0, 1.0

    monkeypatch.setattr(trial, '_working_time', lambda: now)
    run = scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))
    if says is None:
        assert len(follow(partial(Bad, work), run).estimates) == 100
        return
    with pytest.raises(InvalidOutputError, match=says):
        follow(partial(Bad, work), run)


def test_whatever_a_filter_says_can_be_written(tmp_path):
    class Rude(Vqf):
        def update(self, *readings):
            raise ValueError('red\x1b[31m\nand $a^$ \ud800')

    report = examine(Rude, seeds=1, subject='a\x1b $a^$ \ud800')
    assert 'raises ValueError: red\\x1b[31m and $a^$ \\ud800' in report.found[0].evidence
    assert report.subject == 'a\\x1b $a^$ \\ud800'
    ElementTree.fromstring(report.as_junit().encode())
    draw_page(report, tmp_path / 'page.svg')
    assert '$a^$' in (tmp_path / 'page.svg').read_text()


def test_waiting_for_a_processor_is_not_slowness(monkeypatch, tmp_path):
    waiting = tmp_path / 'schedstat'
    monkeypatch.setattr(trial, 'WAITING', waiting)
    waited_ns = 0

    def wait():
        nonlocal waited_ns
        time.sleep(0.05)
        waited_ns += 50_000_000
        waiting.write_text(f'0 {waited_ns} 0')
        return 0.0, 0.0, 0.0, 1.0

    waiting.write_text('0 0 0')
    run = scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))
    assert len(follow(partial(Bad, wait), run).estimates) == 100


class OnDevice:
    """Numbers that cannot be converted, as a torch tensor with requires_grad."""

    def __array__(self, *arguments, **options):
        raise RuntimeError('call detach() first')


@pytest.mark.parametrize('name', ['said', 'covariance', 'bias'])
def test_what_cannot_be_converted_is_told(name):
    class Strange(Vqf):
        def update(self, *readings):
            attitude = super().update(*readings)
            return OnDevice() if name == 'said' else attitude

    if name != 'said':
        setattr(Strange, name, OnDevice())
    run = scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))
    with pytest.raises(InvalidOutputError, match='of 100 raises RuntimeError: call detach'):
        follow(Strange, run)


def test_what_is_not_known_is_left_out():
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

    said = follow(Forgetful, scenarios.record(scenarios.SLOW, {}, 1).part(slice(100)))
    assert said.covariances.samples.tolist() == [9, 19, 39, 59, 69, 79, 89, 99]
    assert said.biases.samples.tolist() == [9, *range(29, 100, 10)]
    later = said.since(50)
    assert later.covariances.samples.tolist() == [9, 19, 29, 39, 49]
    assert np.all(later.covariances.values[0] == 1e308)
    assert later.biases.values.shape == (5, 3)


def test_a_covariance_of_zeros_is_unknown():
    class Unknowing(Vqf):
        covariance = np.zeros((3, 3))

    report = examine(Unknowing, seeds=1)
    assert report.passed and 'nees' not in report.measures


def test_a_filter_may_return_the_array_that_its_next_update_changes():
    class InPlace(Vqf):
        def __init__(self):
            super().__init__()
            self._said = np.empty(4)

        def update(self, *readings):
            self._said[:] = super().update(*readings)
            return self._said

    run = scenarios.record(scenarios.SLOW, {}, 1).part(slice(100))
    assert np.array_equal(follow(InPlace, run).estimates, follow(Vqf, run).estimates)


def test_a_run_that_fails_leaves_the_others():
    class Fragile(Vqf):
        def update(self, gyroscope, accelerometer, magnetometer, dt):
            if dt < 0.009:
                raise ValueError('too fast for me')
            return super().update(gyroscope, accelerometer, magnetometer, dt)

    report = examine(Fragile, seeds=1)
    assert report.faults == ['invalid_output']
    assert 'fast at 200 Hz, seed 0: update 1 of' in str(report)
    assert report.measures['tilt_rms_deg'] < 0.05 and 'bias_error_s' in report.measures


def update_for_ever():
    while True:
        pass


@pytest.mark.parametrize(('said', 'says'), [
    (update_for_ever, 'update 1 of 200 takes more than 2 s: killed'),
    (partial(time.sleep, 1e6), 'update 1 of 200 takes more than 2 s: killed'),
    (lambda: ctypes.string_at(0), 'update 1 of 200 ends the process: Segmentation fault'),
    (partial(os._exit, 3), 'update 1 of 200 ends the process: exit code 3'),
    (partial(sys.exit, 3), 'update 1 of 200 raises SystemExit: 3')])
def test_a_filter_that_never_returns_or_crashes_is_told(monkeypatch, said, says):
    monkeypatch.setattr(isolation, 'LONGEST_S', 2.0)
    report = examine(partial(Bad, said), seeds=1)
    assert report.faults == ['invalid_output']
    assert says in str(report)


def test_a_run_that_hangs_leaves_the_others(monkeypatch):
    class Fragile(Vqf):
        def update(self, gyroscope, accelerometer, magnetometer, dt):
            if dt < 0.009:
                update_for_ever()
            return super().update(gyroscope, accelerometer, magnetometer, dt)

    monkeypatch.setattr(isolation, 'LONGEST_S', 2.0)
    report = examine(Fragile, seeds=1)
    assert report.faults == ['invalid_output']
    assert 'fast at 200 Hz, seed 0: update 1 of 1600 takes more than 2 s' in str(report)
    assert report.measures['tilt_rms_deg'] < 0.05 and 'bias_error_s' in report.measures


def test_a_filter_may_be_fed_in_this_process():
    made = []

    def make():
        made.append(Vqf())
        return made[-1]

    report = examine(make, seeds=1, isolated=False)
    assert len(made) > 10
    assert report.as_json() == examine(make, seeds=1).as_json()


@pytest.mark.parametrize(('covariance', 'says'), [
    (-np.eye(3), 'must have no negative eigenvalue'),
    (np.eye(2), 'of shape (2, 2): must be 3 x 3 finite numbers'),
    (0.5, 'covariance is 0.5: must be 3 x 3 finite numbers'),
    ('large', 'covariance is large: must be 3 x 3 finite numbers'),
    (np.full((3, 3), math.nan), 'must be 3 x 3 finite numbers')])
def test_a_wrong_covariance_is_told(covariance, says):
    class Wrong(Vqf):
        pass

    Wrong.covariance = covariance
    report = examine(Wrong, seeds=1)
    assert report.faults == ['invalid_output'] and says in str(report)


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
        monkeypatch):
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
    report = examine(Failing, seeds=[0, 1], isolated=False)
    assert report.faults == ['invalid_output']
    assert report.measures['noise_gain'] == pytest.approx(
        examine(Vqf, seeds=[1], isolated=False).measures['noise_gain'], rel=1e-12)


def test_the_gain_of_the_noise_is_without_the_lever_arm_that_the_imu_has():
    gains = [examine(FAULTY['lever_arm'], seeds=1, isolated=False, imu={
        **scenarios.CALIBRATED, 'imu.lever_arm': arm}).measures['noise_gain']
        for arm in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))]
    assert gains[1] == pytest.approx(gains[0], rel=0.5)


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


# --------------------------------------------------------------------------------------- logs


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp('log') / 'run.mcap'
    assert simulate(['--quiet', '-o', str(path), '--duration', '20', '-p',
                     'imu_data.enabled:=true', '-p', 'imu.rpy:=[0.3, -0.2, 1.0]',
                     '--params', str(ROOT / 'config/wavy.yaml')]) == 0
    return path


TYPES = ('sensor_msgs/msg/Imu', 'geometry_msgs/msg/QuaternionStamped',
         'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/PoseWithCovarianceStamped',
         'nav_msgs/msg/Odometry')


@pytest.fixture(scope='module')
def beside(log, tmp_path_factory):
    """Return what writes attitudes of a sensor beside its truth, as messages of another writer."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with LogReader(log) as reader:
        truth = [(message.log_time, message.data)
                 for message in reader.messages(['/ground_truth/imu'])]

    def filled(type_name, header, quaternion, variance):
        q = store.types['geometry_msgs/msg/Quaternion'](*quaternion)
        if type_name == 'geometry_msgs/msg/QuaternionStamped':
            return store.types[type_name](header, q)
        zero = store.types['geometry_msgs/msg/Vector3'](1.0, 2.0, 3.0)
        if type_name == 'sensor_msgs/msg/Imu':
            blank = np.zeros(9)
            return store.types[type_name](header, q, (variance * np.eye(3)).ravel(), zero, blank,
                                          zero, blank)
        pose = store.types['geometry_msgs/msg/Pose'](
            store.types['geometry_msgs/msg/Point'](1.0, 2.0, 3.0), q)
        if type_name == 'geometry_msgs/msg/PoseStamped':
            return store.types[type_name](header, pose)
        matrix = np.diag([-1.0, 9.0, 9.0] + [variance] * 3).ravel()     # position unknown
        pose = store.types['geometry_msgs/msg/PoseWithCovariance'](pose, matrix)
        if type_name.endswith('PoseWithCovarianceStamped'):
            return store.types[type_name](header, pose)
        twist = store.types['geometry_msgs/msg/TwistWithCovariance'](
            store.types['geometry_msgs/msg/Twist'](zero, zero), np.zeros(36))
        return store.types[type_name](header, 'sensor', pose, twist)

    def write(said, type_name=TYPES[0], variance=0.0, delay_ns=0):
        path = tmp_path_factory.mktemp('beside') / 'run.mcap'
        file = create_file(path, [RecordedTopic('/ground_truth/imu', 'sensor_msgs/msg/Imu'),
                                  RecordedTopic('/estimate', type_name)], {}, compression='zstd')
        quaternions = []
        for stamp_ns, data in truth:
            file.append(0, stamp_ns, data)
            q = store.deserialize_cdr(data, 'sensor_msgs/msg/Imu').orientation
            quaternions.append((q.x, q.y, q.z, q.w))
        for (stamp_ns, _), one in zip(truth, said(np.array(quaternions)), strict=True):
            stamp = store.types['builtin_interfaces/msg/Time'](
                *divmod(stamp_ns + delay_ns, 10 ** 9))
            header = store.types['std_msgs/msg/Header'](stamp, 'a frame')
            file.append(1, stamp_ns, bytes(store.serialize_cdr(
                filled(type_name, header, one, variance), type_name)))
        file.write_chunk()
        file.finish()
        return path
    return write


def disturbed(quaternions, deviation=0.01):
    noise = deviation * np.random.default_rng(5).standard_normal((len(quaternions), 3))
    return (Rotation.from_quat(quaternions) * Rotation.from_rotvec(noise)).as_quat()


@pytest.mark.parametrize('type_name', TYPES)
def test_attitudes_of_every_type_are_read(beside, type_name):
    report = examine_log(beside(disturbed, type_name, variance=1e-4), 'estimate', north='true')
    assert report.passed, report
    assert report.measures['tilt_rms_deg'] == pytest.approx(math.degrees(0.01 * 2 ** 0.5),
                                                            rel=0.05)
    assert ('nees' in report.measures) == ('Covariance' in type_name or type_name in (
        'sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry'))


@pytest.mark.parametrize(('name', 'said', 'options'), [
    ('conjugated', lambda q: q * (-1.0, -1.0, -1.0, 1.0), {}),
    ('component_order', lambda q: np.roll(q, 1, axis=1), {}),
    ('frame_ned', lambda q: (Rotation.from_quat((0.5 ** 0.5, 0.5 ** 0.5, 0.0, 0.0))
                             * Rotation.from_quat(q)).as_quat(), {}),
    ('stamp_offset', disturbed, {'delay_ns': 20_000_000}),
    ('covariance_small', disturbed, {'variance': 0.5e-4}),
    ('covariance_large', disturbed, {'variance': 2e-4}),
    ('diverges', lambda q: np.roll(q, 100, axis=0), {}),
    ('invalid_output', lambda q: q * np.where(np.arange(len(q)) == 777, np.nan, 1.0)[:, None],
     {}),
    ('invalid_output', disturbed, {'variance': -1e-4})])
def test_faults_of_attitudes_in_a_log_are_named(beside, name, said, options):
    report = examine_log(beside(said, **options), '/estimate', north='true')
    assert report.faults == [name], report


@pytest.mark.parametrize('truth', [None, '/imu/data', 'ground_truth/odom'])
def test_the_truth_may_be_of_the_sensor_or_of_the_body(log, truth):
    """The IMU is turned on the body."""
    report = examine_log(log, '/ground_truth/imu', truth or '/imu/data', north='true')
    assert report.passed and report.measures['tilt_rms_deg'] < 1e-6


def test_a_delay_in_a_log_is_in_steps_of_the_filter(tmp_path):
    """Attitudes at 1 kHz, 3 ms late, beside a truth of 200 Hz."""
    path = tmp_path / 'run.mcap'
    assert simulate(['--quiet', '-o', str(path), '--duration', '20',
                     '-p', 'imu_data.enabled:=true', '-p', 'imu_data.rate:=1000.0',
                     '-p', 'ground_truth_imu.rate:=200.0',
                     '--params', str(ROOT / 'config/wavy.yaml')]) == 0
    late = tmp_path / 'late.mcap'
    file = create_file(late, [RecordedTopic(name, 'sensor_msgs/msg/Imu') for name in (
        '/ground_truth/imu', '/late')], {}, compression='none')
    with LogReader(path) as reader:
        for message in reader.messages(['/ground_truth/imu']):
            file.append(0, message.log_time, message.data)
        for message in reader.messages(['/imu/data']):
            stamp_ns = message.log_time + 3_000_000
            stamp = struct.pack('<iI', *divmod(stamp_ns, 10 ** 9))
            file.append(1, stamp_ns, message.data[:4] + stamp + message.data[12:])
    file.write_chunk()
    file.finish()
    report = examine_log(late, '/late', north='true')
    assert report.faults == ['stamp_offset']
    assert report.measures['stamp_offset_s'] == pytest.approx(0.003, rel=0.02)


@pytest.mark.parametrize(('odd', 'says'), [
    ({'parameters': '[]'}, r'the parameters in the metadata of .*run\.mcap cannot be used: Attr'),
    ({'parameters': 'rpy'}, r'the parameters in the metadata of .*run\.mcap cannot be used: JSON'),
    ({'parameters': '{"imu.rpy": "level"}'}, "cannot be used: ValueError: imu.rpy = 'level'"),
    ((0.0, 0.0, 0.0, 0.0), r'/ground_truth/imu has the quaternion \[0\.0, 0\.0, 0\.0, 0\.0\] at '
     r'1\.070000000 s: its norm must be 1')])
def test_an_odd_log_is_refused_by_what_is_odd_in_it(tmp_path, odd, says):
    path = tmp_path / 'run.mcap'
    names = '/ground_truth/imu', '/estimate'
    file = create_file(path, [RecordedTopic(name, TYPES[0]) for name in names],
                       odd if isinstance(odd, dict) else {}, compression='none')
    template = messages.imu('imu', *3 * (messages.EXACT,))
    for number in range(100):
        stamp_ns = 10 ** 9 + number * 10 ** 7
        for index in range(2):
            quaternion = odd if (number, index) == (7, 0) and isinstance(odd, tuple) else (
                0.0, 0.0, 0.0, 1.0)
            file.append(index, stamp_ns, template.encode_one(
                stamp_ns, quaternion, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))
    file.write_chunk()
    file.finish()
    with pytest.raises(ValueError, match=says):
        examine_log(path, '/estimate')


@pytest.mark.parametrize(('others', 'truth', 'says'), [
    ({}, None, 'has no other topic ground_truth/imu, ground_truth/odom, pose with attitudes'),
    ({'/turtle1/pose': 'turtlesim/msg/Pose'}, None, 'has no other topic ground_truth/imu'),
    ({'/pose': 'geometry_msgs/msg/PoseStamped'}, None, '/pose has 0 messages: must have 100'),
    ({}, 'ekf/pose', 'the truth of /ekf/pose cannot be ekf/pose: must be another topic')])
def test_a_topic_is_not_its_own_truth(tmp_path, others, truth, says):
    path, template = tmp_path / 'run.mcap', messages.pose_stamped('world')
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start('ros2', 'another program')
        for name, kind in {**others, '/ekf/pose': 'geometry_msgs/msg/PoseStamped'}.items():
            channel = writer.register_channel(
                name, 'cdr', writer.register_schema(kind, 'ros2msg', b''))
        for stamp_ns in range(10 ** 9, 2 * 10 ** 9, 10 ** 7):
            writer.add_message(
                channel, stamp_ns, template.encode_one(stamp_ns, (0.0, 0.0, 0.0, 1.0)), stamp_ns)
        writer.finish()
    with pytest.raises(ValueError, match=says):
        examine_log(path, '/ekf/pose', truth)


def test_the_command_judges_a_log(beside, log, tmp_path, capsys):
    junit, page = tmp_path / 'junit.xml', tmp_path / 'page.png'
    bad = beside(lambda q: q * (-1.0, -1.0, -1.0, 1.0))
    assert main([str(bad), '--topic', '/estimate', '--heading', 'true', '--json', '--junit',
                 str(junit), '--page', str(page)]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found['faults'] == ['conjugated'] and not found['passed']
    assert found['measures']['convergence_s'] is None
    suite = ElementTree.parse(junit).getroot()
    assert suite.get('tests') == str(len(FAULTS)) and suite.get('failures') == '1'
    assert [case.get('name') for case in suite if case.find('failure') is not None] == [
        'conjugated']
    assert page.read_bytes().startswith(b'\x89PNG')
    # By the pose of the body and the mounting that the log has.
    assert main([str(log), '--topic', '/imu/data', '--truth', '/pose', '--heading', 'true']) == 0
    assert 'passed' in capsys.readouterr().out


def test_the_heading_in_a_log_counts_from_the_north_that_is_asked_for(log, beside):
    assert examine_log(log, '/imu/data', north='true').measures['heading_rms_deg'] < 1e-9
    declination = math.degrees(math.atan2(1.57, 21.02))
    assert examine_log(log, '/imu/data', north='magnetic').measures[
        'heading_rms_deg'] == pytest.approx(declination, rel=1e-6)
    with pytest.raises(ValueError, match='does not say where magnetic north is'):
        examine_log(beside(disturbed), '/estimate', north='magnetic')


def test_the_command_examines_a_published_filter(capsys):
    assert main(['--filter', 'vqf', '--seeds', '1', '--imu',
                 str(ROOT / 'config/imu/adis16470.yaml')]) == 0
    assert 'vqf: passed' in capsys.readouterr().out


@pytest.mark.parametrize(('arguments', 'code', 'says'), [
    (['{log}', '--topic', '/nix'], 2, 'has no topic /nix; it has /pose'),
    (['{log}', '--topic', '/joint_states'], 2, 'has the type sensor_msgs/msg/JointState'),
    (['{log}', '--topic', '/imu/data_raw'], 2, 'it has no orientation'),
    (['{log}'], 2, '--topic'), ([], 2, '--topic: which topic'),
    (['{log}', '--topic', '/pose', '--filter', 'vqf'], 2, 'give either a log'),
    (['--filter', 'vqf', '--workers', '0'], 2, 'workers = 0: must be from 1'),
    (['nix.mcap', '--topic', '/a'], 1, 'nix.mcap'),
    (['{log}', '--topic', '/pose', '--page', 'a.gif'], 2, 'must end in .png'),
    (['--filter', 'vqf', '--seeds', '0'], 2, 'seeds = 0'),
    (['{log}', '--topic', '/pose', '--level', 'quick'], 2,
     '--level quick: a log takes --topic, --truth, --heading only'),
    (['{log}', '--topic', '/pose', '--seeds', '3'], 2, '--seeds 3: a log takes'),
    (['{log}', '--topic', '/pose', '--imu', 'a'], 2, '--imu a: a log takes'),
    (['{log}', '--topic', '/pose', '--workers', '1'], 2, '--workers 1: a log takes'),
    (['--filter', 'vqf', '--truth', 'a'], 2, '--truth a: --filter takes --level, --imu, '),
    (['--filter', 'vqf', '--topic', 'a'], 2, '--topic a: --filter takes'),
    (['--topic', 'a', '--heading', 'true'], 2, '--heading true: a node takes --topic, --level, '),
    (['--node', 'a', '--topic', 'b', '--workers', '2'], 2, '--workers 2: a node takes')])
def test_wrong_arguments_of_the_command(log, capsys, arguments, code, says):
    arguments = [argument.format(log=log) for argument in arguments]
    try:
        assert main(arguments) == code
    except SystemExit as end:
        assert end.code == code
    assert says in capsys.readouterr().err


def test_its_help_fits_into_80_columns(capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    with pytest.raises(SystemExit, match='0'):
        main(['--help'])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
