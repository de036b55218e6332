#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure what an ensemble costs, and write that section of docs/ensembles.md.

    python benchmark/ensemble.py                    # 4000 runs, by one worker and by two
    python benchmark/ensemble.py --runs 500 --no-report

A run takes 10 s at 200 Hz, with the exact solution and a BMI088 beside its truth and bias: 26
columns.  Each ensemble is a process of its own, measured from start to exit.  Its peak memory is
the sum over its processes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from cases import ROOT
from processes import Process, load
from report import preamble, table, write

from spinning_top_sim.tools import ensemble_cluster, ensemble_part, ensemble_spec

DURATION, RATE = 10.0, 200.0
ROWS = round(DURATION * RATE) + 1
FEW = 100
BEGIN, END = '<!-- cost -->\n', '<!-- end -->\n'        # of the section
ROUNDS = 3                  # one worker and two take turns
EMPTY_TASKS = 2000
ALONE = 100                 # runs in this process, without Dask
MACHINES, CORES = (10, 1000), 2
MANY = (10 ** 6, 10 ** 9)


def specification(runs: int) -> dict[str, object]:
    return {'runs': runs, 'seed': 1, 'duration': DURATION,
            'params': [str(ROOT / 'config/wavy.yaml'), str(ROOT / 'config/imu/bmi088.yaml'),
                       {'solver.method': 'exact', 'imu.rate': RATE,
                        'ground_truth_imu.rate': RATE}],
            'sample': {'initial.theta': {'uniform': [0.2, 1.2]},
                       'spin.l3': {'normal': [1.6, 0.1]}},
            'streams': ['imu', 'ground_truth_imu']}


def peak_memory(pid: int, peaks: dict[int, int]) -> None:
    """Note the largest resident set of a process and of its children so far [bytes]."""
    for one in (pid, *children(pid)):
        try:
            status = Path(f'/proc/{one}/status').read_text()
        except OSError:
            continue
        lines = dict(line.split(':', 1) for line in status.splitlines())
        if 'VmHWM' in lines:
            peaks[one] = 1024 * int(lines['VmHWM'].split()[0])


def children(pid: int) -> list[int]:
    found: list[int] = []
    for path in Path(f'/proc/{pid}/task').glob('*/children'):
        try:
            found += map(int, path.read_text().split())
        except OSError:
            continue
    return found


def run(folder: Path, runs: int, workers: int) -> tuple[float, int, int]:
    """Return the time [s], the peak memory [bytes] and the size [bytes] of an ensemble."""
    from pyarrow import parquet

    spec, output = folder / 'spec.yaml', folder / 'out'
    spec.write_text(json.dumps(specification(runs)))
    peaks: dict[int, int] = {}
    begin = time.monotonic()
    with Process(('-P', str(ROOT / 'scripts/ensemble')),
                 (str(spec), '-o', str(output), '--workers', str(workers), '--quiet')) as process:
        while True:
            try:
                code = process.wait(0.1)
                break
            except subprocess.TimeoutExpired:
                peak_memory(process.pid, peaks)
    taken = time.monotonic() - begin
    files = list((output / 'data').iterdir())
    if code or sum(parquet.read_metadata(file).num_rows for file in files) != runs * ROWS:
        raise SystemExit(f'the ensemble ended with exit code {code}, or lacks rows')
    size = sum(file.stat().st_size for file in files)
    shutil.rmtree(output)
    return taken, sum(peaks.values()), size


def alone(folder: Path) -> float:
    """Return the time of a run without Dask [s]."""
    spec = ensemble_spec.parse({**specification(ALONE), 'runs_per_part': ALONE}, 'benchmark')
    for name in (ensemble_part.DATA, ensemble_part.UNFINISHED):
        (folder / 'alone' / name).mkdir(parents=True)
    begin = time.monotonic()
    ensemble_part.compute_part(spec, 0, str(folder / 'alone'), ensemble_part.versions())
    return (time.monotonic() - begin) / ALONE


def empty_task() -> float:
    """Return the time of a task that does nothing [s]."""
    with ensemble_cluster.connect(1, None) as client:
        list(ensemble_cluster.compute(client, abs, range(100)))
        begin = time.monotonic()
        list(ensemble_cluster.compute(client, abs, range(EMPTY_TASKS)))
        return (time.monotonic() - begin) / EMPTY_TASKS


def costs(a_run: float, a_task: float, a_size: float, per_part: int) -> Sequence[Sequence[str]]:
    """Return the rows of the table of large ensembles."""
    rows = []
    for runs in MANY:
        for machines in MACHINES:
            for together in (per_part, 10 * per_part):
                computing = runs * a_run / (machines * CORES)
                scheduling = runs / together * a_task
                rows.append((f'{runs:.0e}'.replace('e+0', 'e'), str(machines), str(together),
                             hours(computing), hours(scheduling),
                             hours(max(computing, scheduling)), f'{runs * a_size / 1e12:.3g}',
                             f'{runs // together:,}'))
    return rows


def hours(seconds: float) -> str:
    return f'{seconds / 3600.0:.2g}'


def page(folder: Path, runs: int) -> str:
    """Measure; return the text of the page."""
    single = alone(folder)
    task = empty_task()
    start, _, _ = run(folder, 1, 1)
    few = run(folder, FEW, 2)[1]
    taken: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(ROUNDS):
        for workers, times in taken.items():
            seconds, peak, size = run(folder, runs, workers)    # the last one has two workers
            times.append(seconds)
    ratio = statistics.median(one / two for one, two in zip(*taken.values(), strict=True))
    one, two = map(statistics.median, taken.values())
    per_part = ensemble_spec.parse(specification(10 ** 6), 'benchmark').runs_per_part
    a_run = (two - start) * CORES / runs
    return '\n'.join((
        f'Load average at the end {load():.1f}.\n',
        table(('what', 'figure'), (
            (f'{runs} runs, one worker [s]', f'{one:.1f}'),
            (f'{runs} runs, two workers [s]', f'{two:.1f}'),
            ('ratio', f'{ratio:.2f}'),
            ('a run and core, two workers, without the start [ms]', f'{1e3 * a_run:.2f}'),
            ('a run, one process without Dask [ms]', f'{1e3 * single:.2f}'),
            ('from start to exit with one run [s]', f'{start:.1f}'),
            ('overhead a task [ms]', f'{1e3 * task:.2f}'),
            (f'the same of the time of {per_part} runs', f'{task / per_part / a_run:.2%}'),
            (f'peak memory, two workers, {FEW} runs [MB]', f'{few / 1e6:.0f}'),
            (f'peak memory, two workers, {runs} runs [MB]', f'{peak / 1e6:.0f}'),
            ('a run on the disk [kB]', f'{size / runs / 1e3:.0f}'))),
        'One worker and two take turns; the times are medians, and the ratio is that of a turn.\n',
        '### Large ensembles\n',
        f'Computed from the table above, for machines of {CORES} cores. The cores share the runs, '
        'and one\nscheduler handles all tasks, one after the other: the larger time of both '
        'decides. Where it is the\nscheduler, set `runs_per_part` in the specification. The disks '
        'of a cluster are not measured here.\n',
        table(('runs', 'machines', 'runs_per_part', 'computing [h]', 'scheduling [h]',
               'in all [h]', 'size [TB]', 'files'), costs(a_run, task, size / runs, per_part))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=4000)
    parser.add_argument('--no-report', action='store_true', help='print only')
    arguments = parser.parse_args()
    head = '#' + preamble('Cost', ('numpy', 'distributed', 'pyarrow'))
    with tempfile.TemporaryDirectory() as name:
        text = page(Path(name), arguments.runs)
    print(text)
    if not arguments.no_report:
        section = '\n'.join((head, __doc__.strip().split('\n\n')[-1] + '\n', text))
        before, rest = (ROOT / 'docs/ensembles.md').read_text().split(BEGIN)
        write('ensembles.md', before + BEGIN + section + END + rest.split(END)[1])


if __name__ == '__main__':
    sys.exit(main())
