# SPDX-License-Identifier: Apache-2.0
"""
Examines filters with trials of BROAD: readings of a real IMU beside an optical truth.

(D. Laidig, M. Caruso, A. Cereatti, T. Seel, "BROAD: A Benchmark for Robust Inertial Orientation
Estimation", Data 2021, 6, 72)
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from spinning_top_sim.exam.examiner import report_of
from spinning_top_sim.exam.feeding import TOLERANCE, Feed, MakeFilter, feed_apart
from spinning_top_sim.exam.motions import Run, Scored
from spinning_top_sim.tools.cli import one_line
from spinning_top_sim.tools.report import Report

# Arrays of a trial with their columns; the field is in microtesla, quaternions are w, x, y, z.
COLUMNS = {'imu_gyr': 3, 'imu_acc': 3, 'imu_mag': 3, 'opt_quat': 4, 'movement': 1}


def examine_data(make_filter: MakeFilter, folder: str | Path, *, subject: str | None = None,
                 feed: Feed = feed_apart,
                 show: Callable[[float, float], object] = lambda done, total: None) -> Report:
    """
    Examine a filter with the trials of BROAD in a folder: .mat, each from its first sample on.

    Parameters
    ----------
    make_filter : callable
        As for `examine`.
    folder : path
        With the trials.
    subject, feed, show : optional
        As for `examine`.

    Raises
    ------
    ValueError
        If there is no folder, no trial in it, or a file is none.
    """
    runs = [partial(read_trial, path) for path in trials_in(folder)]
    return report_of(make_filter, runs, 'data', one_line(
        subject or getattr(make_filter, '__name__', 'filter')), feed, show)


def trials_in(folder: str | Path) -> list[Path]:
    """Return the files of trials in a folder, by name.  Raises ValueError if there is none."""
    if not Path(folder).is_dir():
        raise ValueError(f'{folder}: must be a folder with trials of BROAD')
    paths = sorted(path for path in Path(folder).iterdir() if path.suffix == '.mat')
    if not paths:
        raise ValueError(f'{folder} has no trial: must have files .mat')
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
