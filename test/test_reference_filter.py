# SPDX-License-Identifier: Apache-2.0
"""The filter of the examples where readings have what no data sheet says."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.reference import ROOT
from helpers.wrong_filters import ReferenceFilter
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import motions
from spinning_top_sim.exam.feeding import feed
from spinning_top_sim.exam.measures import nees_of
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.identify import rms
from spinning_top_sim.tools.scene_file import read_scene


def errors(run):
    (outcome,) = feed(ReferenceFilter, [run])
    return errors_of(outcome.estimates, run.truth)


@pytest.fixture
def run():
    return motions.noisy('', motions.CALIBRATED, 1, 0.02, 20.0)


def test_motion_is_not_taken_for_gravity(run):
    """The device is shaken along the east with 1 m/s^2, 10 s: a tenth of the tilt is left."""
    motion = np.zeros((len(run.t), 3))
    motion[1000:, 0] = np.sin(np.pi * (run.t[1000:] - run.t[1000]))
    force = run.accelerometer + Rotation.from_quat(run.truth).inv().apply(motion)
    assert np.degrees(rms(errors(replace(run, accelerometer=force)).tilt[1000:])) < (
        0.1 * np.degrees(math.sqrt(0.5) / motions.GRAVITY))


def test_a_disturbed_field_changes_neither_tilt_nor_heading(run):
    """For 6 s the field is turned by 56 degrees."""
    disturbed = np.zeros((len(run.t), 3))
    disturbed[1000:1600, 0] = 30e-6
    field = run.magnetometer + Rotation.from_quat(run.truth).inv().apply(disturbed)
    found, before = errors(replace(run, magnetometer=field)), errors(run)
    assert np.degrees(np.max(np.abs(found.tilt - before.tilt)[1000:])) < 0.01
    assert np.degrees(np.max(np.abs(found.heading[1000:]))) < 2.0


@pytest.mark.parametrize('name', ['bmi088', 'icm_42688_p'])
def test_an_uncalibrated_device_is_calibrated_and_the_covariance_says_how_well(name):
    """Of the tilt by the turn-on bias a tenth is left, and the covariance knows no data sheet."""
    imu = {key: value for key, value in read_scene(ROOT / f'config/imu/{name}.yaml').items()
           if key.startswith(motions.TAKEN)}
    outcomes = feed(ReferenceFilter, [motions.noisy('', imu, seed, 0.02, 20.0) for seed in (0, 1)])
    for one in outcomes:
        last = one.part(slice(len(one.run.dt) // 2, None))
        assert np.degrees(rms(errors_of(last.estimates, last.run.truth).tilt)) < 0.1 * np.degrees(
            imu['imu.accelerometer_turn_on_bias'] / motions.GRAVITY)
    nees = nees_of(outcomes)
    assert nees.low < nees.ratio < nees.high


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_at_rest_the_gyroscope_shows_its_bias_without_a_field(sign):
    filter_, bias, noise = ReferenceFilter(), sign * np.array((0.01, -0.02, 0.03)), (
        np.random.default_rng(1).normal(size=(1000, 2, 3)))
    for rates, force in noise:
        filter_.update(bias + 2e-3 * rates, (0.0, 0.0, 9.80665) + 0.02 * force, None, 0.01)
    assert filter_.bias == pytest.approx(bias, abs=1e-3)
