# SPDX-License-Identifier: Apache-2.0
"""
Reads trials of BROAD: readings of a real IMU beside an optical truth.

(D. Laidig, M. Caruso, A. Cereatti, T. Seel, "BROAD: A Benchmark for Robust Inertial Orientation
Estimation", Data 2021, 6, 72)
"""

from pathlib import Path

import numpy as np

from spinning_top_sim.exam.feeding import TOLERANCE
from spinning_top_sim.exam.motions import Run, Scored
from spinning_top_sim.tools.cli import one_line

# Arrays of a trial with their columns; the field is in microtesla, quaternions are w, x, y, z.
COLUMNS = {'imu_gyr': 3, 'imu_acc': 3, 'imu_mag': 3, 'opt_quat': 4, 'movement': 1}


def trials_in(folder: str | Path) -> list[Path]:
    """Return the files of trials in a folder, by name.  Raises ValueError if there is none."""
    paths = sorted(Path(folder).glob('*.mat'))
    if not paths:
        raise ValueError(f'{folder}: must be a folder with trials of BROAD (.mat)')
    return paths


def read_trial(path: Path) -> Scored:
    """Return the trial of a file.  Raises ValueError if it is none."""
    from scipy.io import loadmat  # noqa: PLC0415 - slow

    try:
        data = loadmat(path)
        rate = float(np.squeeze(data['sampling_rate']))
        readings = [np.reshape(data[name], (len(data['imu_gyr']), count)).astype(float)
                    for name, count in COLUMNS.items()]
    except Exception as error:      # whatever a reader says of a damaged file
        what = f'it has no {error}' if isinstance(error, KeyError) else one_line(error)
        raise ValueError(f'{path} is no trial of BROAD: {what}') from error
    gyroscope, accelerometer, magnetometer, truth, movement = readings
    # The truth is NaN where the cameras do not see the sensor.
    counts = np.flatnonzero((movement[:, 0] != 0.0)
                            & (np.abs(np.linalg.norm(truth, axis=1) - 1.0) < TOLERANCE))
    if not (0.0 < rate < np.inf and len(counts) and np.all(np.isfinite(readings[:3]))):
        raise ValueError(f'{path}: must have a sampling_rate > 0, finite readings, and movement '
                         'with opt_quat')
    step = np.full(len(truth), 1.0 / rate)
    return Run(one_line(path.stem), step, truth[:, [1, 2, 3, 0]], gyroscope, accelerometer,
               1e-6 * magnetometer), counts
