# SPDX-License-Identifier: Apache-2.0
"""The filter of the examples where readings have what no data sheet says."""

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


def test_a_disturbed_field_changes_neither_tilt_nor_heading(run):
    """For 6 s the field is turned by 56 degrees."""
    disturbed = np.zeros((len(run.t), 3))
    disturbed[1000:1600, 0] = 30e-6
    field = run.magnetometer + Rotation.from_quat(run.truth).inv().apply(disturbed)
    found, before = errors(replace(run, magnetometer=field)), errors(run)
    assert np.degrees(np.max(np.abs(found.tilt - before.tilt)[1000:])) < 0.01
    assert np.degrees(np.max(np.abs(found.heading[1000:]))) < 2.0


def test_an_uncalibrated_device_is_calibrated_and_the_covariance_says_how_well():
    """Of the tilt by the turn-on bias a tenth is left, and the covariance knows no data sheet."""
    imu = {key: value for key, value in read_scene(ROOT / 'config/imu/bmi088.yaml').items()
           if key.startswith(motions.TAKEN)}
    outcomes = feed(ReferenceFilter, [motions.noisy('', imu, seed, 0.02, 20.0) for seed in (0, 1)])
    for one in outcomes:
        last = one.part(slice(len(one.run.dt) // 2, None))
        assert np.degrees(rms(errors_of(last.estimates, last.run.truth).tilt)) < 0.1 * np.degrees(
            imu['imu.accelerometer_turn_on_bias'] / motions.GRAVITY)
    assert 0.05 < nees_of(outcomes) < 4.0
