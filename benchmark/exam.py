#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure how well the exam names faults, and examine published filters.

Every exam has its own seeds, so its own noise and starts.  `alone` is the number of exams of a
filter with one fault that name this fault and no other.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import timeit
from concurrent.futures import ProcessPoolExecutor

import report
from cases import ROOT

sys.path.insert(0, str(ROOT / 'test'))

from helpers.wrong_filters import TABLE

from spinning_top_sim.exam import examine
from spinning_top_sim.exam.adapters import FILTERS, Vqf
from spinning_top_sim.exam.feeding import feed

PACKAGES = ('numpy', 'scipy', 'vqf', 'ahrs', 'imufusion')
SEEDS = 3                       # of an exam
COLUMNS = (('tilt [deg]', 'tilt_rms_deg'), ('heading [deg]', 'heading_rms_deg'),
           ('lever arm [deg]', 'lever_arm_deg'), ('turns [1]', 'large_turn_off'),
           ('bias [s]', 'bias_tilt_s'))
HEADS = ('filter', *(head for head, _ in COLUMNS), 'faults')


def faults_of(job: tuple[str, int]) -> list[str]:
    name, number = job
    return examine(TABLE[name][0], seeds=range(SEEDS * number, SEEDS * (number + 1))).faults


def marks_of(name: str) -> tuple[str, ...] | None:
    try:
        found = examine(FILTERS[name], seeds=10, subject=name)
    except ImportError as error:
        print(f'{name} is left out: {error}', file=sys.stderr)
        return None
    values = (report.number(found.measures.get(key, math.nan), 3) for _, key in COLUMNS)
    return (f'`{name}`', *values, ', '.join(found.faults) or 'none')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--exams', type=int, default=3, help='of each filter of the table')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    examine(Vqf, seeds=1)           # imports
    quick_s = statistics.median(timeit.repeat(
        lambda: examine(Vqf, feed=feed), number=1, repeat=7))
    jobs = [(name, number) for name in TABLE for number in range(arguments.exams)]
    with ProcessPoolExecutor(arguments.workers) as pool:
        marks = [row for row in pool.map(marks_of, FILTERS) if row is not None]
        found: dict[str, list[list[str]]] = {}
        for (name, _), faults in zip(jobs, pool.map(faults_of, jobs), strict=True):
            found.setdefault(name, []).append(faults)
    rows = [(name, f'`{fault}`' if fault else 'none', str(len(said)), str(
        sum(', '.join(one) == fault for one in said)), ', '.join(sorted(
            {other for one in said for other in one} - {*fault.split(', ')})) or '–')
        for name, said in found.items() for fault in [TABLE[name][1]]]
    report.write('exam_marks.md', '\n'.join((
        report.preamble('Results of published filters', PACKAGES),
        'With the settings of their packages, on a calibrated IMU, with 10 seeds. '
        '[The exam](../exam.md) defines the columns: '
        f'{", ".join(f"`{key}`" for _, key in COLUMNS)}.\n', report.table(HEADS, marks),
        f'A quick exam of VQF takes {quick_s:.2g} s.\n',
        '## Right and wrong filters\n', 'Each exam has seeds of its own.\n',
        report.table(('filter', 'fault', 'exams', 'alone', 'others'), rows))))


if __name__ == '__main__':
    main()
