#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Compare the mark of filters in scenes of the field with their errors on real data.

FOLDER has trials of BROAD (https://doi.org/10.3390/data6070072).  `field_rms_deg` is the mean of
the root mean squares of the whole error over the scenes, that of real data over the trials.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path

import numpy as np
import report
from cases import ROOT
from scipy.stats import spearmanr

from spinning_top_sim.exam import broad
from spinning_top_sim.exam import scenes as field
from spinning_top_sim.exam.adapters import Ahrs, Imufusion, Vqf
from spinning_top_sim.exam.feeding import InvalidOutputError, feed
from spinning_top_sim.exam.measures import rmse
from spinning_top_sim.exam.motions import Scored
from spinning_top_sim.tools.cli import progress

sys.path.insert(0, str(ROOT / 'examples'))

from reference_filter import ReferenceFilter

PACKAGES = ('numpy', 'scipy', 'vqf', 'ahrs', 'imufusion')
FILTERS = {
    'vqf': Vqf, 'vqf tauAcc=6 tauMag=20': partial(Vqf, tauAcc=6.0, tauMag=20.0),
    'reference': ReferenceFilter,
    'madgwick': partial(Ahrs, 'Madgwick'),
    'madgwick gain=0.12': partial(Ahrs, 'Madgwick', gain_marg=0.12),
    'ekf': partial(Ahrs, 'EKF'),
    'ekf noises=0.01,2.25,2.25': partial(Ahrs, 'EKF', noises=[0.01, 2.25, 2.25]),
    'mahony': partial(Ahrs, 'Mahony'),
    'mahony k_P=0.74 k_I=0.0012': partial(Ahrs, 'Mahony', k_P=0.74, k_I=0.0012),
    'imufusion': Imufusion,
    'imufusion rejection=10': partial(Imufusion, acceleration_rejection=10.0,
                                      magnetic_rejection=10.0, rejection_timeout=5.0)}
WORST = np.full(3, 180.0)       # of a filter that fails
DRAWS = 2000


@cache
def trial_of(what: Path | tuple[int, int]) -> Scored:
    """Return a trial of a file, or of a scene and a seed."""
    if isinstance(what, Path):
        return broad.read_trial(what)
    return field.record(field.SCENES[what[0]], what[1], {})


def error_of(job: tuple[str, Path | tuple[int, int]]) -> np.ndarray:
    name, what = job
    try:
        run, counts = trial_of(what)
        outcome = feed(FILTERS[name], [run])[0].part(counts)
    except InvalidOutputError as error:
        print(f'{name}: {error}')
        return WORST
    return rmse(outcome.estimates, outcome.run.truth)


def rank_correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(spearmanr(one, other)[0])


def spread(draw) -> str:
    """Return median, 5th and 95th percentile of a random number."""
    low, middle, high = np.percentile([draw() for _ in range(DRAWS)], (5, 50, 95))
    return f'{middle:.2f} ({low:.2f} to {high:.2f})'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--seeds', type=int, default=1, help='of each scene')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    paths = broad.trials_in(arguments.folder)
    runs = [*paths, *((scene, seed) for seed in range(arguments.seeds)
                      for scene in range(len(field.SCENES)))]
    jobs = [(name, what) for what in runs for name in FILTERS]
    found = []
    with (ProcessPoolExecutor(arguments.workers) as pool,
          progress('examined', len(jobs), 'runs') as show):
        for one in pool.map(error_of, jobs):
            found.append(one)
            show(len(found))
    # Axes: run, filter, and total, heading and tilt.
    errors = np.array(found).reshape(len(runs), len(FILTERS), 3)
    real, scenes = np.split(errors, [len(paths)])
    mark, total = scenes[..., 0].mean(axis=0), real[..., 0]
    random = np.random.default_rng(0)

    def of_bootstrap() -> float:
        drawn = random.integers(len(paths), size=len(paths))
        return rank_correlation(mark, total[drawn].mean(axis=0))

    def of_halves(mark: np.ndarray | None) -> float:
        one, other = np.array_split(random.permutation(len(paths)), 2)
        return rank_correlation(total[one].mean(axis=0), total[other].mean(axis=0)
                                if mark is None else mark)

    order = np.argsort(mark)
    rows = [(f'`{list(FILTERS)[k]}`', *(report.number(x, 3) for x in (
        *scenes[:, k].mean(axis=0), *real[:, k].mean(axis=0)))) for k in order]
    report.write('broad.md', '\n'.join((
        report.preamble('Scenes of the field beside real data', PACKAGES),
        'Root mean squares of errors in motion [deg], means over the scenes of '
        f'[the exam](../exam.md#scenes-of-the-field) with {arguments.seeds} seed(s), and over '
        f'{len(paths)} trials of [BROAD](https://doi.org/10.3390/data6070072). The filters have '
        'the default settings of their packages but for those that are named.\n',
        report.table(('filter', 'field: whole', 'heading', 'tilt', 'real: whole', 'heading',
                      'tilt'), rows),
        f'## Rank correlation\n\nSpearman’s ρ of the whole error, over {len(FILTERS)} filters. '
        'The spread is over trials: median, 5 % and 95 %.\n',
        report.table(('between', 'ρ'), (
            ('scenes and all trials', f'{rank_correlation(mark, total.mean(axis=0)):.2f}'),
            ('scenes and trials drawn with replacement', spread(of_bootstrap)),
            ('scenes and half of the trials', spread(partial(of_halves, mark))),
            ('half of the trials and the other half', spread(partial(of_halves, None))))),
        'The last line is what real data say of other real data.\n',
        '## Each trial\n', report.table(
            ('trial', *(f'`{name}`' for name in FILTERS)),
            [(path.stem, *(report.number(x, 2) for x in row))
             for path, row in zip(paths, total, strict=True)]),
        '## Each scene\n', report.table(
            ('scene', *(f'`{name}`' for name in FILTERS)),
            [(scene.name, *(report.number(x, 2) for x in row)) for scene, row in zip(
                field.SCENES, scenes[..., 0].reshape(
                    arguments.seeds, len(field.SCENES), -1).mean(axis=0), strict=True)]))))


if __name__ == '__main__':
    main()
