# SPDX-License-Identifier: Apache-2.0
"""The exam of right filters, and of filters with one fault each: each is named by it alone."""

from helpers.wrong_filters import TABLE

from spinning_top_sim.exam import examine
from spinning_top_sim.exam.feeding import feed

PATIENCE_S = 1800.0
MEMORY_MB = 4000


def check(seed, folder):
    del folder
    name = list(TABLE)[seed % len(TABLE)]
    make, fault = TABLE[name]
    report = examine(make, seeds=[seed // len(TABLE)], feed=feed, subject=name)
    assert ', '.join(report.faults) == fault, str(report)
    return 'named' if fault else 'right'
