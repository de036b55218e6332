# SPDX-License-Identifier: Apache-2.0
"""The simulated world: any number of seeds; one that fails is told with as little as suffices."""

from helpers.world_findings import examine, failure_of, told
from helpers.world_plan import plan_of

PATIENCE_S = 300.0          # with shrinking
MEMORY_MB = 1000


def check(seed, folder):
    try:
        outcome, _ = examine(plan_of(seed))
    except Exception as error:
        raise AssertionError(told(seed)) from error
    return outcome


def repeat(seed, numbers):
    """Run a seed with some of its actions again; return the exit code."""
    plan = plan_of(seed).only([int(one) for one in numbers.split(',') if one != '-'])
    failure = failure_of(plan)
    print(failure or f'world: seed {seed}: nothing is wrong')
    return 1 if failure else 0
