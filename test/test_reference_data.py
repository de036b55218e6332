# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories: complete, described, and read back to the last bit."""

import csv
import json

import numpy as np
import pytest

from spinning_top_sim import State, Top, solve
from spinning_top_sim.__main__ import main
from spinning_top_sim.installation import parameter_files
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.parameters import checked

parquet = pytest.importorskip('pyarrow.parquet')
pytest.importorskip('xacro')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('reference') / 'new'
    assert main(f'export --reference {folder} --duration 1 --rate 50 --imu bmi088'.split()) == 0
    return folder


def read_csv(path):
    with path.open(encoding='utf-8') as file:
        head, *rows = csv.reader(file)
    return head, np.array(rows, np.float64)


def test_every_scene_has_its_trajectory_and_its_models(folder):
    suffixes = 'csv', 'parquet', 'mjcf.xml', 'urdf', 'sdf'
    expected = {f'{name}.{suffix}' for name in parameter_files('scene') for suffix in suffixes}
    assert {path.name for path in folder.iterdir()} == expected | {'README.md', 'scenes.json'}
    assert set(json.loads((folder / 'scenes.json').read_text())) == set(parameter_files('scene'))


@pytest.mark.parametrize('scene', ['cusp', 'heavy_top', 'free_fall'])
def test_both_files_have_the_same_doubles_and_units(folder, scene):
    head, rows = read_csv(folder / f'{scene}.csv')
    table = parquet.read_table(folder / f'{scene}.parquet')
    assert head == [f'{field.name} [{field.metadata[b"unit"].decode()}]' for field in table.schema]
    columns = np.stack([column.to_numpy() for column in table.columns], axis=1)
    assert rows.shape == (51, 26)
    assert rows.tobytes() == columns.tobytes()


@pytest.mark.parametrize('scene', ['cusp', 'heavy_top', 'sleeping'])
def test_the_trajectory_is_the_exact_solution_of_the_described_top(folder, scene):
    """Only from scenes.json and the head of the file, as a program in another language does."""
    facts = json.loads((folder / 'scenes.json').read_text())[scene]
    head, rows = read_csv(folder / f'{scene}.csv')
    column = {name.partition(' ')[0]: values for name, values in zip(head, rows.T, strict=True)}
    start = {name: facts['start'][name] for name in
             ('theta', 'theta_dot', 'phi', 'psi', 'l3', 'lz')}
    motion = solve(Top(**facts['top']), State(**start), column['t'])
    imu = Imu(checked({f'imu.{name}': tuple(value) for name, value in facts['imu'].items()}))
    assert any(facts['imu']['lever_arm'])
    for names, truth in (
            (('qx', 'qy', 'qz', 'qw'), motion.quaternion.T),
            (('omega_1', 'omega_2', 'omega_3'), motion.angular_velocity.T),
            (('energy', 'l3', 'lz'), (motion.energy, motion.l3, motion.lz)),
            ([f'{sensor}_{axis}' for sensor in ('gyroscope', 'accelerometer') for axis in 'xyz'],
             [part for reading in imu.true(motion) for part in reading])):
        for name, expected in zip(names, truth, strict=True):
            # Times are whole nanoseconds there, and doubles here.
            np.testing.assert_allclose(column[name], expected, rtol=1e-12, atol=1e-12,
                                       err_msg=name)
    np.testing.assert_allclose(facts['start']['quaternion_xyzw'], motion.quaternion[0], rtol=0.0,
                               atol=1e-15)


def test_the_schema_names_every_column_once(folder):
    text = (folder / 'README.md').read_text(encoding='utf-8')
    head, _ = read_csv(folder / 'cusp.csv')
    rows = [line.split(' | ') for line in text.splitlines() if line.startswith('| `')]
    named = [f'{name.strip("`| ")} [{unit}]' for names, unit, _ in rows
             for name in names.split(', ')]
    assert sorted(named) == sorted(head)
    assert 'CC0 1.0' in text


def test_an_existing_folder_is_left_alone(folder, capsys):
    before = sorted(folder.iterdir())
    assert main(['export', '--reference', str(folder), '--scene', 'cusp']) == 1
    assert 'exists' in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before
    assert main(['export', '--reference', str(folder.parent / 'b'), '-p', 'top.mass:=2.5']) == 2
    assert [*folder.parent.iterdir()] == [folder]
