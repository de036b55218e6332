# SPDX-License-Identifier: Apache-2.0
"""The presets of config/imu: what they set, the data sheets' figures in SI units, their use."""

import math

import pytest
from helpers.reference import ROOT, scene_parameters

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import read_scene

FOLDER = ROOT / 'config/imu'
ERRORS = {name for name in parameters.BY_NAME if name.endswith((
    '_noise_density', '_random_walk', '_turn_on_bias', '_bias_instability', '_range',
    '_resolution'))}
MAG = {f'mag.{name}' for name in ('noise_density', 'random_walk', 'range', 'resolution', 'enabled',
                                  'rate')}
# What else is an error; the others of `imu` and `mag` say where it sits, how often it is read, and
# what the flat of a bias instability of 0 would be.
ALL_ERRORS = {name for name in parameters.BY_NAME if name.startswith(('imu.', 'mag.')) and not (
    name.endswith(('.enabled', 'imu.rate', 'mag.rate', '_correlation_time')))} - {
        'imu.frame_id', 'imu.lever_arm', 'imu.rpy', 'imu.sampling', 'imu.bias_instability_band',
        'mag.field'}
DEG, G = math.radians(1.0), 9.80665


def one_sided(density):
    """Return the two-sided density of a one-sided one: half the power on either side."""
    return density / math.sqrt(2.0)


# Of gyroscope and accelerometer: noise density, instability, turn-on bias, range, resolution.
# A range ends at the last code of 16 bits, 32767.
GYRO, ACCEL = DEG / 16.4, G / 2048.0
DATA_SHEETS = {
    'perfect': (5 * (0.0,), 5 * (0.0,)),
    'bmi088': ((one_sided(0.014 * DEG), 0.0, 1.0 * DEG, 32767 * DEG / 16.384, DEG / 16.384),
               (one_sided(190e-6 * G), 0.0, 0.020 * G, 6.0 * G, G / 5460.0)),
    'icm_42688_p': ((one_sided(0.0028 * DEG), 0.0, 0.5 * DEG, 32767 * GYRO, GYRO),
                    (one_sided(70e-6 * G), 0.0, 0.020 * G, 32767 * ACCEL, ACCEL)),
    'icm_20948': ((one_sided(0.015 * DEG), 0.0, 5.0 * DEG, 32767 * GYRO, GYRO),
                  (one_sided(230e-6 * G), 0.0, 0.025 * G, 32767 * ACCEL, ACCEL)),
    'adis16470': ((0.34 * DEG / 60.0, 8.0 * DEG / 3600.0, 0.2 * DEG, 2000.0 * DEG, 0.1 * DEG),
                  (0.037 / 60.0, 13e-6 * G, 0.004 * G, 40.0 * G, 1.25e-3 * G))}
FIGURES = ('noise_density', 'bias_instability', 'turn_on_bias', 'range', 'resolution')


@pytest.mark.parametrize('name', sorted(path.stem for path in FOLDER.glob('*.yaml')))
def test_a_preset_sets_all_errors_of_the_imu_and_nothing_else(name):
    """So any preset replaces any other, and a scene keeps its motion and its mounting."""
    given = read_scene(FOLDER / f'{name}.yaml')
    assert set(given) == {'perfect': ALL_ERRORS, 'icm_20948': ERRORS | MAG}.get(
        name, ERRORS | {'mag.enabled'})
    assert given.get('mag.enabled', False) is (name == 'icm_20948')
    defaults = parameters.checked({})
    assert name != 'perfect' or all(defaults[key] == value or [*defaults[key]] == value
                                    for key, value in given.items())
    assert given.get('mag.range', 0.0) == (name == 'icm_20948') * 4912e-6
    values = parameters.checked({**scene_parameters('wavy'), **given})
    for kind, figures in zip(('gyroscope', 'accelerometer'), DATA_SHEETS[name], strict=True):
        found = [values[f'imu.{kind}_{one}'] for one in FIGURES]
        assert found == pytest.approx(figures, rel=2e-5), kind
        assert found[3] <= 32767.5 * found[4], 'what 16 bits hold'
