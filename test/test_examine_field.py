# SPDX-License-Identifier: Apache-2.0
"""The scenes of the field: their motion is consistent, their sensor errs as it is told to."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.wrong_filters import Vqf
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import examine
from spinning_top_sim.exam import scenes as field
from spinning_top_sim.exam.motions import GRAVITY
from spinning_top_sim.streams.parameters import IDENTITY

pytest.importorskip('vqf')

SHORT = ((1.0, 9.0),)
BY_NAME = {scene.name: replace(scene, motions=SHORT) for scene in field.SCENES}
# An IMU without errors, in a field without disturbance.
PERFECT = {name: IDENTITY if name.endswith(('_M', 'soft_iron')) else 3 * (0.0,)
           for name in field.LEFT} | {
    name: 0.0 for name in field.DEVICE if name != 'mag.field'} | {
    'mag.disturbance.world': 5 * (0.0,)}


@pytest.fixture
def perfect(monkeypatch):
    """Return what records a scene with a sensor without errors."""
    monkeypatch.setattr(field, 'BIAS', 0.0)
    monkeypatch.setattr(field, 'MAG_LATE', 0)
    return lambda name: field.record(replace(BY_NAME[name], values={}), 3, PERFECT)[0]


@pytest.mark.parametrize('name', BY_NAME)
def test_without_errors_the_readings_are_those_of_the_motion(perfect, name):
    run = perfect(name)
    turns = Rotation.from_quat(run.truth)
    # The rates are those of the attitudes; the middle of two steps is a step.
    step = (turns[:-2].inv() * turns[2:]).as_rotvec() / (2.0 * run.dt[0])
    assert np.max(np.abs(step - run.gyroscope[1:-1])) < 0.02 * np.max(np.abs(run.gyroscope))
    # The sensor rests before and after, so that the mean acceleration is zero; one of gravity
    # alone, or in the wrong frame, is not.
    acceleration = turns.apply(run.accelerometer) - (0.0, 0.0, GRAVITY)
    size = np.sqrt(np.mean(acceleration ** 2))
    assert np.max(np.abs(np.mean(acceleration, axis=0))) < 0.02 * size
    assert turns.apply(run.magnetometer) == pytest.approx(np.broadcast_to(
        field.DEVICE['mag.field'], (len(run.dt), 3)), abs=1e-12)


def test_a_scene_depends_on_its_seed_alone():
    one, same, other = (field.record(BY_NAME['combined'], seed, {})[0] for seed in (1, 1, 2))
    for name in ('truth', 'gyroscope', 'accelerometer', 'magnetometer'):
        assert np.array_equal(getattr(one, name), getattr(same, name))
        assert np.max(np.abs(getattr(one, name) - getattr(other, name))) > 1e-6


def test_the_device_errs_by_its_bias_its_bandwidth_and_the_magnet(perfect, monkeypatch):
    still = slice(100)
    exact = perfect('magnet_on_it')
    monkeypatch.setattr(field, 'BIAS', 0.01)
    scene = replace(BY_NAME['magnet_on_it'], values={
        'mag.disturbance.body': (0.0, 1e3, 1e-6, 2e-6, 3e-6)})
    run, _ = field.record(scene, 3, {**PERFECT, 'imu.bandwidth': 20.0})
    assert np.linalg.norm(run.gyroscope[still], axis=1) == pytest.approx(0.01)
    assert run.magnetometer[still] - exact.magnetometer[still] == pytest.approx(
        np.broadcast_to((1e-6, 2e-6, 3e-6), (100, 3)), abs=1e-12)
    # A low pass of first order is late by 1 / (2 pi f).
    late = exact.accelerometer[:-1] - run.accelerometer[:-1]
    slope = np.diff(exact.accelerometer, axis=0) / exact.dt[0]
    assert np.sum(late * slope) / np.sum(slope ** 2) == pytest.approx(
        1.0 / (40.0 * np.pi), rel=0.15)


def test_the_level_has_a_verdict(monkeypatch):
    monkeypatch.setattr(field, 'SCENES', [BY_NAME['slow_rotation']])
    asked = examine(Vqf, 'field', seeds=[7], imu={'mag.field': (0.0, 2e-5, 0.0)})
    assert asked.passed and 0.0 < asked.measures['field_rms_deg'] < 10.0
    still = examine(type('Still', (), {'update': lambda *_: (0.0, 0.0, 0.0, 1.0)}), 'field')
    assert still.faults == ['accuracy'] and 'the mean tilt error is' in str(still.found)
    # Without a field the heading is unknown.
    tilt = examine(partial(Vqf, magnetic=False), 'field')
    assert tilt.passed and tilt.measures['field_rms_deg'] > 10.0
    assert tilt.notes == ['the magnetometer changes nothing: the filter is judged by its tilt']
