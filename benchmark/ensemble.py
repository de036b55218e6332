#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure what an ensemble costs.

    python benchmark/ensemble.py                    # 4000 runs, by one worker and by two
    python benchmark/ensemble.py --runs 500 --no-report

A run takes 10 s at 200 Hz, with the exact solution and a BMI088 beside its truth and bias: 26
columns.  Each ensemble is a process of its own, measured from start to exit.  Its peak memory is
the sum over its processes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

import psutil
from cases import ROOT
from processes import Process, load
from report import preamble, table, write

DURATION, RATE = 10.0, 200.0
ROWS = round(DURATION * RATE) + 1
FEW = 100
ROUNDS = 3                  # one worker and two take turns
CORES = 2


def specification(runs: int) -> dict[str, object]:
    return {'runs': runs, 'seed': 1, 'duration': DURATION,
            'params': [str(ROOT / 'config/wavy.yaml'), str(ROOT / 'config/imu/bmi088.yaml'),
                       {'solver.method': 'exact', 'imu.rate': RATE,
                        'ground_truth_imu.rate': RATE}],
            'sample': {'initial.theta': {'uniform': [0.2, 1.2]},
                       'spin.l3': {'normal': [1.6, 0.1]}},
            'streams': ['imu', 'ground_truth_imu']}


def run(folder: Path, runs: int, workers: int) -> tuple[float, int, int]:
    """Return the time [s], the peak memory [bytes] and the size [bytes] of an ensemble."""
    from pyarrow import parquet

    spec, output = folder / 'spec.yaml', folder / 'out'
    spec.write_text(json.dumps(specification(runs)))
    begin = time.monotonic()
    with Process(('-P', str(ROOT / 'scripts/ensemble')),
                 (str(spec), '-o', str(output), '--workers', str(workers), '--quiet')) as process:
        peak = 0
        while process.alive:
            with contextlib.suppress(psutil.NoSuchProcess):     # a worker has just ended
                own = psutil.Process(process.pid)
                peak = max(peak, sum(one.memory_info().rss
                                     for one in (own, *own.children(recursive=True))))
            time.sleep(0.1)
        code = process.wait(0.0)
    taken = time.monotonic() - begin
    files = list((output / 'data').iterdir())
    if code or sum(parquet.read_metadata(file).num_rows for file in files) != runs * ROWS:
        raise SystemExit(f'the ensemble ended with exit code {code}, or lacks rows')
    size = sum(file.stat().st_size for file in files)
    shutil.rmtree(output)
    return taken, peak, size


def page(folder: Path, runs: int) -> str:
    """Measure; return the text of the page."""
    start, _, _ = run(folder, 1, 1)
    few = run(folder, FEW, 2)[1]
    taken: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(ROUNDS):
        for workers, times in taken.items():
            seconds, peak, size = run(folder, runs, workers)    # the last one has two workers
            times.append(seconds)
    ratio = statistics.median(one / two for one, two in zip(*taken.values(), strict=True))
    one, two = map(statistics.median, taken.values())
    a_run = (two - start) * CORES / runs
    return '\n'.join((
        f'Load average at the end {load():.1f}.\n',
        table(('what', 'figure'), (
            (f'{runs} runs, one worker [s]', f'{one:.1f}'),
            (f'{runs} runs, two workers [s]', f'{two:.1f}'),
            ('ratio', f'{ratio:.2f}'),
            ('a run and core, two workers, without the start [ms]', f'{1e3 * a_run:.2f}'),
            ('from start to exit with one run [s]', f'{start:.1f}'),
            (f'peak memory, two workers, {FEW} runs [MB]', f'{few / 1e6:.0f}'),
            (f'peak memory, two workers, {runs} runs [MB]', f'{peak / 1e6:.0f}'),
            ('a run on the disk [kB]', f'{size / runs / 1e3:.0f}'))),
        'One worker and two take turns; times are medians, the ratio is that of a turn.\n'))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=4000)
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = preamble('What an ensemble costs', ('numpy', 'distributed', 'pyarrow'))
    with tempfile.TemporaryDirectory() as name:
        text = page(Path(name), arguments.runs)
    print(text)
    if not arguments.no_report:
        write('ensemble.md', '\n'.join((head, __doc__.strip().split('\n\n')[-1] + '\n', text)))


if __name__ == '__main__':
    sys.exit(main())
