# SPDX-License-Identifier: Apache-2.0
"""The robot description: its forward kinematics, by a library of other people, are the pose."""

import runpy

import numpy as np
import pytest
from helpers.reference import ROOT, scene_parameters
from helpers.simulations import SECOND, run
from scipy.spatial.transform import Rotation

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Mounting
from spinning_top_sim.streams.topics import JOINTS
from spinning_top_sim.tools import export
from spinning_top_sim.tools.export import model

pytest.importorskip('xacro')
MOUNTED = {'imu.lever_arm': (0.1, -0.05, 0.3), 'imu.rpy': (0.3, -0.2, 1.1)}


def described(values):
    return export.robot_description(parameters.checked(values), ROOT / 'urdf')


def matrix(q):
    return Rotation.from_quat(q).as_matrix()


def test_the_joint_states_put_base_link_where_the_pose_is(tmp_path):
    yourdfpy = pytest.importorskip('yourdfpy')
    values, path = {**scene_parameters('fast_gyroscope'), **MOUNTED}, tmp_path / 'top.urdf'
    path.write_text(described(values), encoding='utf-8')
    model = yourdfpy.URDF.load(str(path), build_scene_graph=True, load_meshes=False)
    simulation, found = run(values, SECOND, 'pose', 'joint_states')
    poses, positions = found['pose'][3], found['joint_states'][2]
    assert len(poses) == len(positions) == 101
    assert model.actuated_joint_names == list(JOINTS)
    arm = np.array(MOUNTED['imu.lever_arm'])
    mounting = Mounting(simulation.values_at_start)
    imu = matrix(np.concatenate(mounting.orientation(simulation.state())))
    # Unwrapped angles of thousands of radians cannot be told to 1e-12.
    limit = max(1e-12, 2.0 * np.spacing(np.abs(positions).max()))
    worst = 0.0
    for q, angles in zip(poses, positions, strict=True):
        model.update_cfg(dict(zip(JOINTS, angles, strict=True)))
        found = model.get_transform('base_link', 'world')
        worst = max(worst, np.abs(found[:3, :3] - matrix(q)).max(), np.abs(found[:3, 3]).max())
        place = model.get_transform('imu_link', 'world')[:3, 3]
        worst = max(worst, np.abs(place - matrix(q) @ arm).max())
    assert worst < limit
    assert np.abs(model.get_transform('imu_link', 'world')[:3, :3] - imu).max() < limit


@pytest.mark.parametrize(('name', 'value'), [
    ('top.mass', 0.0), ('top.com_distance', 1.0), ('top.lambda3', 0.1561)])
def test_an_inertia_that_no_body_has_is_left_out_and_makes_no_model_of_an_engine(name, value):
    assert '<inertial' not in described({name: value})
    said = f'{name.removeprefix("top.")}={value!r}.* no rigid body .* lambda3 <= 2'
    with pytest.raises(ValueError, match=said):
        model(parameters.checked({name: value}), 'mjcf')


def test_the_plain_file_is_written_from_the_xacro_file():
    text = runpy.run_path(str(ROOT / 'docs/urdf.py'))['description']()
    assert (ROOT / 'urdf/spinning_top.urdf').read_text(encoding='utf-8') == text
