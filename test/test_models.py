# SPDX-License-Identifier: Apache-2.0
"""Models for physics engines: one top in three formats."""

from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.reference import scene_parameters

from spinning_top_sim import solve
from spinning_top_sim.__main__ import main
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.export import FORMATS, model

IMU = {'imu.lever_arm': (0.1, -0.05, 0.3), 'imu.rpy': (0.3, -0.2, 1.1)}
HANGING = {'top.com_distance': -0.2, 'top.lambda1': 0.2}
SCENES = {'cusp': IMU, 'heavy_top': IMU, 'braking': {}, 'wavy': {**HANGING, **IMU}}


def numbers(text):
    return [float(word) for word in text.split()]


def read_mjcf(root):
    """Return mass, centre of mass, moments, gravity, attitude (x, y, z, w), place of the IMU."""
    assert root.find('compiler').attrib.items() >= {'angle': 'radian', 'eulerseq': 'XYZ'}.items()
    (body,) = root.iter('body')
    assert [joint.get('type') for joint in body.iter('joint')] == ['ball']
    inertial, site = body.find('inertial'), body.find('site')
    w, x, y, z = numbers(root.find('keyframe/key').get('qpos'))
    return (float(inertial.get('mass')), numbers(inertial.get('pos')),
            numbers(inertial.get('diaginertia')), numbers(root.find('option').get('gravity')),
            [x, y, z, w], numbers(site.get('pos')) + numbers(site.get('euler')))


def read_urdf(root):
    (inertial,) = root.iter('inertial')
    inertia = inertial.find('inertia').attrib
    place = root.find("joint[@name='imu_joint']/origin").attrib
    assert [joint.get('type') for joint in root.iter('joint')] == 3 * ['continuous'] + ['fixed']
    return (float(inertial.find('mass').get('value')),
            numbers(inertial.find('origin').get('xyz')),
            [float(inertia[entry]) for entry in ('ixx', 'iyy', 'izz')], None, None,
            numbers(place['xyz']) + numbers(place['rpy']))


def read_sdf(root):
    assert root.get('version') == '1.9'
    (inertial,), (joint,) = root.iter('inertial'), root.iter('joint')
    assert (joint.get('type'), joint.find('parent').text) == ('ball', 'world')
    pose = root.find('world/model/pose')
    assert pose.get('rotation_format') == 'quat_xyzw'
    assert {inertial.find(f'inertia/{entry}').text for entry in ('ixy', 'ixz', 'iyz')} == {'0.0'}
    return (float(inertial.find('mass').text), numbers(inertial.find('pose').text)[:3],
            [float(inertial.find(f'inertia/{entry}').text) for entry in ('ixx', 'iyy', 'izz')],
            numbers(root.find('world/gravity').text), numbers(pose.text)[3:],
            numbers(root.find('.//sensor/pose').text))


READ = {'mjcf': read_mjcf, 'urdf': read_urdf, 'sdf': read_sdf}


@pytest.mark.parametrize('scene', SCENES)
@pytest.mark.parametrize('file_format', FORMATS)
def test_every_format_has_the_top_its_start_and_its_imu(file_format, scene):
    if file_format == 'urdf':
        pytest.importorskip('xacro')
    values = parameters.checked({**scene_parameters(scene), **SCENES[scene]})
    top, text = parameters.top_of(values), model(values, file_format)
    start = solve(top, parameters.start_state(values), [0.0])
    mass, centre, moments, gravity, attitude, place = READ[file_format](
        ElementTree.fromstring(text))
    assert (mass, centre) == (top.mass, [0.0, 0.0, top.com_distance])
    assert moments == [top.lambda1_at_com, top.lambda1_at_com, top.lambda3]
    assert place == [*values['imu.lever_arm'], *values['imu.rpy']]
    assert gravity in (None, [0.0, 0.0, -top.gravity])
    if attitude is not None:
        np.testing.assert_allclose(attitude, start.quaternion[0], rtol=0.0, atol=1e-15)


def test_the_command_writes_a_scene_and_overwrites_nothing(tmp_path, capsys):
    path = tmp_path / 'top.sdf'
    words = ['export', '--model', 'sdf', '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]', '-o', str(path)]
    assert main(words) == 0 and main(words) == 1
    assert capsys.readouterr().err.endswith(
        'top.sdf: File exists, and nothing is overwritten: choose a new name\n')
    values = parameters.checked({'imu.lever_arm': (0.1, 0.0, 0.2)})
    assert path.read_text(encoding='utf-8') == model(values, 'sdf')
