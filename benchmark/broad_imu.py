#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Grade the IMU of BROAD against its poses by cameras.

FOLDER has trials of BROAD (https://doi.org/10.3390/data6070072).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import report
from scipy.io import loadmat

from spinning_top_sim.grade import Report, grade_readings

PACKAGES = ('numpy', 'scipy')
UT = 1e-6               # [T]


def graded(path: Path) -> Report:
    """Return the report on a trial."""
    trial = loadmat(path)
    t = np.arange(len(trial['imu_gyr'])) / float(trial['sampling_rate'].item())
    seen = np.all(np.isfinite(np.hstack((trial['opt_quat'], trial['opt_pos']))), axis=1)
    return Report(path.stem).plus(grade_readings({
        'attitudes': (t[seen], trial['opt_quat'][seen][:, [1, 2, 3, 0]]),
        'positions': (t[seen], trial['opt_pos'][seen]), 'gyroscope': (t, trial['imu_gyr']),
        'accelerations': (t, trial['imu_acc']), 'magnetometer': (t, UT * trial['imu_mag'])}))


def told(found: Report, *names: str) -> str:
    """Return marks with their intervals; a dash where one cannot be told."""
    marks = [found.marks[name] for name in names]
    return ', '.join('–' if not np.isfinite(mark.value) or 'inf' in mark.meaning else
                     f'{mark.value:.4g} ± {mark.meaning.split()[1]}' for mark in marks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path)
    rows = []
    for path in sorted(parser.parse_args().folder.glob('*.mat')):
        found = graded(path)
        print(found, flush=True)
        rows.append((path.stem, *(told(found, f'gyroscope_matrix_{a}{a}') for a in 'xyz'),
                     *(told(found, f'gyroscope_bias_{a}') for a in 'xyz'),
                     told(found, 'gyroscope_lag_steps'), told(found, 'accelerations_lag_steps'),
                     ', '.join(f'`{fault.name}` ({fault.evidence.partition(":")[0]})'
                               for fault in found.found) or 'none'))
    report.write('broad_imu.md', '\n'.join((
        report.preamble('The IMU of BROAD beside its poses', PACKAGES), TEXT,
        report.table(('trial', 'matrix xx', 'yy', 'zz', 'bias x [rad/s]', 'y', 'z',
                      'lag of the gyroscope [samples]', 'of the accelerometer', 'faults'), rows))))


TEXT = """\
[The grade](../grade.md) of trials of [BROAD](https://doi.org/10.3390/data6070072): poses by
cameras, a real IMU at 286 Hz. `matrix` is what the gyroscope reads of the rates of the poses,
along each axis; intervals are those of 95 %, a dash is what the motion cannot tell. The gyroscope
lags behind the poses by the same time, 4 ms, in every trial: it is a property of the recording,
and told as `late`, for it is more than a sample.
"""


if __name__ == '__main__':
    main()
