# SPDX-License-Identifier: Apache-2.0
"""The reference filter where readings have what no data sheet says: motion, disturbance, bias."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import diagnosis, scenarios
from spinning_top_sim.exam.measures import rms
from spinning_top_sim.exam.reference import ReferenceFilter
from spinning_top_sim.exam.trial import follow
from spinning_top_sim.tools.scene_file import read_scene

SLOW = replace(scenarios.SLOW, duration=20.0)


def test_motion_is_not_taken_for_gravity():
    """For 12 s the device is shaken along the east with 1 m/s^2, at 0.5 Hz."""
    run = scenarios.record(SLOW, scenarios.CALIBRATED, 1)
    motion = np.zeros((len(run.t), 3))
    motion[800:, 0] = np.sin(np.pi * (run.t[800:] - run.t[800]))
    accelerometer = run.accelerometer + Rotation.from_quat(run.truth).inv().apply(motion)
    errors = follow(ReferenceFilter, replace(run, accelerometer=accelerometer)).errors
    assert np.degrees(rms(errors.tilt[800:])) < 0.25


def test_a_disturbed_field_changes_neither_tilt_nor_heading():
    """For 8 s the field is turned by 56 degrees."""
    run = scenarios.record(SLOW, scenarios.CALIBRATED, 1)
    disturbed = np.zeros((len(run.t), 3))
    disturbed[800:1600, 0] = 30e-6
    magnetometer = run.magnetometer + Rotation.from_quat(run.truth).inv().apply(disturbed)
    errors = follow(ReferenceFilter, replace(run, magnetometer=magnetometer)).errors
    assert np.degrees(np.max(errors.tilt[800:])) < 0.1
    assert np.degrees(np.max(np.abs(errors.heading[800:]))) < 2.0


@pytest.mark.parametrize('name', ['bmi088', 'icm_42688_p'])
def test_an_uncalibrated_device_is_calibrated_and_the_covariance_says_how_well(name):
    """The accelerometer alone would be 1 degree off, and the covariance knows no data sheet."""
    imu = read_scene(ROOT / f'config/imu/{name}.yaml')
    outcomes = [follow(ReferenceFilter, scenarios.record(SLOW, imu, seed)) for seed in range(4)]
    tilts = [np.degrees(rms(outcome.last().errors.tilt)) for outcome in outcomes]
    assert max(tilts) < 0.05
    nees = diagnosis.consistency(outcomes, absolute=True)
    for what in ('tilt', 'attitude'):
        low, high = nees[what].band
        assert low < nees[what].ratio < high, what
    assert 0.7 < nees['tilt'].ratio < 1.4


def test_the_covariance_of_the_tilt_is_not_below_the_bound_of_white_noise():
    """At 50 Hz, where low passes of the residual are far from continuous ones."""
    imu = scenarios.CALIBRATED
    bound = 2.0 * (imu['imu.gyroscope_noise_density'] * imu['imu.accelerometer_noise_density']
                   / scenarios.GRAVITY)
    ratios = []
    for seed in range(2):
        outcome = follow(ReferenceFilter, scenarios.record(replace(SLOW, rate=50.0), imu, seed))
        turn = Rotation.from_quat(outcome.estimates[-1]).as_matrix()
        ratios.append(np.trace((turn @ outcome.covariances[-1] @ turn.T)[:2, :2]) / bound)
    assert 1.0 < np.mean(ratios) < 1.3


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_at_rest_the_gyroscope_shows_its_bias_without_a_field(sign):
    filter_, bias, noise = ReferenceFilter(), sign * np.array((0.01, -0.02, 0.03)), (
        np.random.default_rng(1).normal(size=(1000, 2, 3)))
    for rates, force in noise:
        filter_.update(bias + 2e-3 * rates, (0.0, 0.0, 9.80665) + 0.02 * force, None, 0.01)
    assert filter_.bias == pytest.approx(bias, abs=1e-3)
