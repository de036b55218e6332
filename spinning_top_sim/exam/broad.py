# SPDX-License-Identifier: Apache-2.0
"""
Examines filters with trials of BROAD: readings of a real IMU beside an optical truth.

(D. Laidig, M. Caruso, A. Cereatti, T. Seel, "BROAD: A Benchmark for Robust Inertial Orientation
Estimation", Data 2021, 6, 72)
"""

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.exam import measures
from spinning_top_sim.exam.isolation import feed_apart
from spinning_top_sim.exam.report import Report
from spinning_top_sim.exam.scenarios import Run
from spinning_top_sim.exam.trial import (
    NORM_TOLERANCE,
    Feed,
    InvalidOutputError,
    MakeFilter,
    Outcome,
    follow,
    one_line,
)
from spinning_top_sim.installation import needed
from spinning_top_sim.tools.verdict import Fault

SUFFIXES = '.mat', '.hdf5', '.h5'
# Arrays of a trial with their columns; the field is in microtesla, quaternions are w, x, y, z.
COLUMNS = {'imu_gyr': 3, 'imu_acc': 3, 'imu_mag': 3, 'opt_quat': 4, 'movement': 1}


class Trial(NamedTuple):
    """A trial as a run, and the samples whose errors count: of a known truth in motion (n,)."""

    run: Run
    counts: NDArray[np.intp]

    def follow(self, make_filter: MakeFilter, feed: Feed = feed_apart) -> Outcome:
        """Return the outcome of a new filter, the samples that count.  Raises as `follow`."""
        return follow(make_filter, self.run, (), feed).part(self.counts)


def examine_data(make_filter: MakeFilter, folder: str | Path, *, subject: str | None = None,
                 show: Callable[[float], object] = lambda done: None) -> Report:
    """
    Examine a filter with the trials in a folder.

    The filter gets each trial from its first sample on.  The measures are the root mean squares
    of the errors in motion, of each trial and their means.  `invalid_output` is the only fault
    that can be found.

    Parameters
    ----------
    make_filter, subject : as for `examine`
    folder : path
        With files of BROAD: .mat, or .hdf5, which need h5py.
    show : callable, optional
        Is called with the number of trials that are done.

    Raises
    ------
    ValueError
        If there is no folder, no trial in it, or a file is none.
    """
    return judge(make_filter, map(read_trial, trials_in(folder)), 'data', one_line(
        subject or getattr(make_filter, '__name__', 'filter')), show=show)


def judge(make_filter: MakeFilter, trials: Iterable[Trial], kind: str, subject: str,
          feed: Feed = feed_apart, show: Callable[[float], object] = lambda done: None) -> Report:
    """Return the report on a filter in trials; the names of its measures begin with `kind`."""
    found: dict[str, list[tuple[float, ...]]] = {}
    outcomes, failed, means = [], [], {}
    for number, trial in enumerate(trials, start=1):
        try:
            outcomes.append(outcome := trial.follow(make_filter, feed))
        except InvalidOutputError as error:
            failed.append(str(error))
        else:
            one = measures.rmse(outcome.estimates, outcome.run.truth)
            # The truth of real data has gaps.
            alone = (measures.unaided(trial.run, trial.counts).total if kind == 'field'
                     else math.nan)
            found.setdefault(trial.run.name, []).append((*one, one.total / alone))
        show(number)
    if found:
        names = f'{kind}_rms_deg', f'{kind}_heading_rms_deg', f'{kind}_tilt_rms_deg'
        means = dict(zip(names, np.mean([one for same in found.values() for one in same],
                                        axis=0).tolist(), strict=False))
    for name, same in found.items():
        total, ratio = np.array(same)[:, [0, 3]].T
        means |= {f'{kind}_rms_{name}_deg': float(np.mean(total)),
                  f'{kind}_rms_{name}_spread_deg': float(np.std(total, ddof=1))
                  if len(same) > 1 else math.nan,
                  f'{kind}_{name}_to_gyroscope': float(np.mean(ratio))}
    means = {name: value for name, value in means.items() if not math.isnan(value)}
    faults = [Fault('invalid_output', '; '.join(failed))] if failed else []
    return Report(subject, faults, means, outcomes)


def trials_in(folder: str | Path) -> list[Path]:
    """Return the files of trials in a folder, by name.  Raises ValueError if there is none."""
    if not Path(folder).is_dir():
        raise ValueError(f'{folder}: must be a folder with trials of BROAD')
    paths = sorted(path for path in Path(folder).iterdir() if path.suffix in SUFFIXES)
    if not paths:
        raise ValueError(f'{folder} has no trial: must have files {", ".join(SUFFIXES)}')
    return paths


def read_trial(path: Path) -> Trial:
    """Return the trial of a file.  Raises ValueError if it is none."""
    from scipy.io import loadmat  # noqa: PLC0415 - slow

    try:
        data = loadmat(path) if path.suffix == '.mat' else _hdf5(path)
        rate = float(np.squeeze(data['sampling_rate']))
        readings = [np.reshape(data[name], (len(data['imu_gyr']), count)).astype(float)
                    for name, count in COLUMNS.items()]
    except ImportError:
        raise
    except Exception as error:      # whatever a reader says of a damaged file
        what = f'it has no {error}' if isinstance(error, KeyError) else one_line(error)
        raise ValueError(f'{path} is no trial of BROAD: {what}') from error
    gyroscope, accelerometer, magnetometer, truth, movement = readings
    # The truth is NaN where the cameras do not see the sensor.
    counts = np.flatnonzero((movement[:, 0] != 0.0)
                            & (np.abs(np.linalg.norm(truth, axis=1) - 1.0) < NORM_TOLERANCE))
    if not (0.0 < rate < np.inf and len(counts) and np.all(np.isfinite(readings[:3]))):
        raise ValueError(f'{path}: must have a sampling_rate > 0, finite readings, and movement '
                         'with opt_quat')
    step = np.full(len(truth), 1.0 / rate)
    # Nothing asks for the true rates here.
    return Trial(Run(one_line(path.stem), np.cumsum(step), step, truth[:, [1, 2, 3, 0]],
                     gyroscope, gyroscope, accelerometer, 1e-6 * magnetometer), counts)


def _hdf5(path: Path) -> Mapping[str, Any]:
    with needed('an HDF5 file'):
        import h5py  # noqa: PLC0415
    with h5py.File(path) as file:
        return {**file.attrs, **{name: file[name][()] for name in COLUMNS}}
