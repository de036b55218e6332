#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Measure how well the exam names faults, and examine published filters.

Every exam has its own seeds, so its own noise and starts.  `named` is the share of the exams of
a filter with one fault that name this fault; `alone` the share that name it and no other.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import timeit
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import report
from cases import ROOT

sys.path.insert(0, str(ROOT / 'test'))

from helpers.faulty_filters import FAULTY
from spinning_top_sim.exam.reference import ReferenceFilter

from spinning_top_sim.exam import examine
from spinning_top_sim.exam.adapters import FILTERS, Vqf

PACKAGES = ('numpy', 'scipy', 'vqf', 'ahrs', 'imufusion')
SEEDS = 3                       # of an exam
UNHARMED = {'reference': ReferenceFilter, 'vqf': Vqf}
COLUMNS = (('tilt [deg]', 'tilt_rms_deg'), ('heading [deg]', 'heading_rms_deg'),
           ('lever arm [deg]', 'lever_arm_deg'), ('steps [deg]', 'integration_error_deg'),
           ('bias left [s]', 'bias_error_s'))
HEADS = ('filter', *(head for head, _ in COLUMNS), 'faults')


def faults_of(name: str, number: int) -> list[str]:
    make = UNHARMED.get(name) or FAULTY[name]
    return examine(make, seeds=range(SEEDS * number, SEEDS * (number + 1))).faults


def marks_of(name: str) -> tuple[str, ...] | None:
    try:
        found = examine(FILTERS[name], 'full', subject=name)
    except ImportError as error:
        print(f'{name} is left out: {error}', file=sys.stderr)
        return None
    values = (report.number(found.measures.get(key, math.nan), 3) for _, key in COLUMNS)
    return (f'`{name}`', *values, ', '.join(found.faults) or 'none')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--exams', type=int, default=100, help='of each fault')
    parser.add_argument('--unharmed', type=int, default=200, help='of each filter without fault')
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    examine(Vqf, seeds=1)           # imports
    quick_s = statistics.median(timeit.repeat(lambda: examine(Vqf), number=1, repeat=7))
    with ProcessPoolExecutor(arguments.workers) as pool:
        marks = [row for row in pool.map(marks_of, FILTERS) if row is not None]
        unharmed = {name: list(pool.map(partial(faults_of, name), range(arguments.unharmed)))
                    for name in UNHARMED}
        harmed = {name: list(pool.map(partial(faults_of, name), range(arguments.exams)))
                  for name in FAULTY}
    table = report.table(HEADS, marks)
    report.write('exam_marks.md', '\n'.join((
        report.preamble('Results of published filters', PACKAGES),
        'With the settings of their packages, on a calibrated IMU, at level `full`. '
        '[The exam](../exam.md) defines the columns: '
        '`tilt_rms_deg`, `heading_rms_deg`, `lever_arm_deg`, `integration_error_deg`, '
        '`bias_error_s`.\n', table,
        f'A quick exam of VQF takes {quick_s:.2g} s.\n',
        '## Faults that are named\n', 'Each exam has seeds of its own.\n',
        report.table(('fault', 'exams', 'named', 'alone'), [
            (f'`{name}`', str(len(found)), str(sum(name in one for one in found)),
             str(sum(one == [name] for one in found))) for name, found in harmed.items()]),
        '## False alarms\n', report.table(('filter', 'exams', 'with a fault', 'which'), [
            (name, str(len(found)), str(sum(map(bool, found))), ', '.join(
                f'{fault} {count}' for fault, count in Counter(
                    fault for one in found for fault in one).items()) or '–')
            for name, found in unharmed.items()]))))


if __name__ == '__main__':
    main()
