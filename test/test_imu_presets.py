# SPDX-License-Identifier: Apache-2.0
"""The presets of config/imu: what they set."""

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


@pytest.mark.parametrize('name', sorted(path.stem for path in FOLDER.glob('*.yaml')))
def test_a_preset_sets_all_errors_of_the_imu_and_nothing_else(name):
    """So any preset replaces any other, and a scene keeps its motion and its mounting."""
    given = read_scene(FOLDER / f'{name}.yaml')
    assert set(given) == {'perfect': ALL_ERRORS, 'icm_20948': ERRORS | MAG}.get(
        name, ERRORS | {'mag.enabled'})
    values = parameters.checked({**scene_parameters('wavy'), **given})
    assert name != 'perfect' or values == parameters.checked(scene_parameters('wavy'))
    for kind in ('gyroscope', 'accelerometer'):
        largest, step = (values[f'imu.{kind}_{one}'] for one in ('range', 'resolution'))
        assert largest <= 32767.5 * step, 'what 16 bits hold'
