# SPDX-License-Identifier: Apache-2.0
"""The exam of filters with one fault each: none passes, none is blamed for another cause."""

from helpers.wrong_filters import TABLE

from spinning_top_sim.exam import examine

PATIENCE_S = 1800.0
MEMORY_MB = 4000


def check(seed, folder):
    del folder
    name = list(TABLE)[seed % len(TABLE)]
    make, causes = TABLE[name]
    report = examine(make, seeds=[seed // len(TABLE)], isolated=False, subject=name)
    assert bool(report.faults) == bool(causes), str(report)
    assert causes.issuperset(report.faults), str(report)
    return 'named' if causes else 'right'
