# SPDX-License-Identifier: Apache-2.0
"""
Random tops, symmetries, edge inputs and continued branches: what must hold for every motion.

STRESS_TOPS=100000 in the environment takes as many random tops; `python test/stress.py` does the
same on all processors and tells the worst cases.
"""

import os

import pytest
from stress import blocks, check_block, report

TOPS = int(os.environ.get('STRESS_TOPS', '1000'))


@pytest.mark.parametrize('seeds', blocks(0, TOPS), ids=lambda seeds: f'{seeds[0]}-{seeds[-1]}')
def test_random_tops(seeds):
    found = check_block(seeds)
    assert not found.failures, '\n'.join([*found.failures, report(found)])
    # The judges must have judged: most tops all the way.
    assert found.counts['integrated'] > 0.85 * len(seeds)
    assert found.counts['rk45: q'] > 0.8 * len(seeds)
