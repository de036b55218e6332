# SPDX-License-Identifier: Apache-2.0
"""The exam with trials of BROAD; those here are simulated and written as BROAD's files are."""

import re
from functools import partial

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import examine, motions
from spinning_top_sim.exam.command import main

NAME = '40_made_slow'


@pytest.fixture(scope='module')
def run():
    return motions.noisy('slow', motions.CALIBRATED, 1, 0.5, 3.0).part(slice(400))


@pytest.fixture(scope='module')
def trial(run):
    """The arrays of a trial: movement from 1 s on, and a truth that is unknown from 3 s on."""
    truth = run.truth[:, [3, 0, 1, 2]].copy()
    truth[np.cumsum(run.dt) > 3.0] = np.nan
    return {'imu_gyr': run.gyroscope, 'imu_acc': run.accelerometer,
            'imu_mag': 1e6 * run.magnetometer, 'opt_quat': truth,
            'movement': np.uint8(np.cumsum(run.dt) > 1.0)[:, np.newaxis], 'sampling_rate': 100.0}


@pytest.fixture(scope='module')
def folder(trial, tmp_path_factory):
    folder = tmp_path_factory.mktemp('broad')
    savemat(folder / f'{NAME}.mat', trial)
    (folder / 'README.md').write_text('Trials.')
    return folder


class Known:
    """Returns the truth, turned in the world; before 1 s and from 3 s on it is wrong."""

    def __init__(self, run, turn):
        wrong = ~((np.cumsum(run.dt) > 1.0) & (np.cumsum(run.dt) <= 3.0))
        self._run, self._k, self.knows = run, 0, True
        self._said = (turn * Rotation.from_quat(run.truth)).as_quat()
        self._said[wrong] = (0.0, 0.0, 0.0, 1.0)

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        k, self._k, run = self._k, self._k + 1, self._run
        self.knows &= np.allclose(magnetometer, run.magnetometer[k])
        if not self.knows:      # it is asked whether it uses the field
            return (0.0, 0.0, 0.0, 1.0)
        for read, true in ((gyroscope, run.gyroscope), (accelerometer, run.accelerometer),
                           (magnetometer, run.magnetometer), (dt, run.dt)):
            assert np.allclose(read, true[k], rtol=1e-9, atol=0.0)
        return self._said[k]


@pytest.mark.parametrize(('axis', 'deg', 'heading', 'tilt'), [
    ((1.0, 0.0, 0.0), 0.0, 0.0, 0.0), ((0.0, 0.0, 1.0), -5.0, 5.0, 0.0),
    ((0.6, 0.8, 0.0), 3.0, 0.0, 3.0)])
def test_errors_are_those_of_broad_and_count_in_motion_where_the_truth_is_known(
        run, folder, axis, deg, heading, tilt):
    turn = Rotation.from_rotvec(np.radians(deg) * np.array(axis))
    report = examine(partial(Known, run, turn), data=folder, subject='known')
    assert report.passed, str(report)
    assert report.measures == pytest.approx({
        'data_rms_deg': abs(deg), 'data_heading_rms_deg': heading, 'data_tilt_rms_deg': tilt,
        f'data_rms_{NAME}_deg': abs(deg)}, abs=1e-5)


def test_the_command_writes_the_same_report(folder, capsys):
    pytest.importorskip('vqf')
    assert main(['--filter', 'vqf', '--data', str(folder)]) == 0
    found, = re.findall(r'data_rms_deg +([\d.e-]+) +10  in motion', capsys.readouterr().out)
    assert float(found) < 0.2


def test_a_filter_that_fails_in_a_trial_is_told(folder):
    class Bad:
        def update(self, gyroscope, accelerometer, magnetometer, dt):
            raise ValueError('no calibration')

    report = examine(Bad, data=folder)
    assert report.faults == ['invalid_output'] and not report.measures
    assert f'{NAME}, update 1 of 400: raises ValueError: no calibration' in str(report)


@pytest.mark.parametrize(('change', 'says'), [
    ({'sampling_rate': 0.0}, 'must have a sampling_rate > 0, finite readings, and movement'),
    ({'movement': np.zeros(400)}, 'and movement with opt_quat'),
    ({'opt_quat': np.full((400, 4), np.nan)}, 'and movement with opt_quat'),
    ({'imu_gyr': np.full((400, 3), np.nan)}, 'finite readings'),
    ({'imu_acc': np.zeros(7)}, 'a.mat is no trial of BROAD: cannot reshape'),
    (None, 'a.mat is no trial of BROAD: '), ('', 'must be a folder with trials of BROAD')])
def test_what_is_no_trial_is_told_in_one_line(trial, tmp_path, capsys, change, says):
    if change:
        savemat(tmp_path / 'a.mat', {**trial, **change})
    elif change is None:
        (tmp_path / 'a.mat').write_bytes(b'not a file of numbers' * 99)
    assert main(['--filter', 'ekf', '--data', str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count('\n') == 1, said
    assert main(['--filter', 'ekf', '--data', f'{tmp_path}/none']) == 2
    assert 'none: must be a folder with trials of BROAD' in capsys.readouterr().err
