# SPDX-License-Identifier: Apache-2.0
"""
How many examples hypothesis tries of a property.

The suite tries the same ones every time.  EXAMPLES=100 in the environment asks for a hundred times
as many, at random; `make stress` does that, and a failure is told with what repeats it.
"""

import os

from hypothesis import HealthCheck, settings

TIMES = int(os.environ.get('EXAMPLES', '1'))


def examples(count):
    """Return the decorator of a test that tries so many in the suite."""
    return settings(
        max_examples=TIMES * count, derandomize=TIMES == 1, print_blob=True, database=None,
        deadline=None,              # time decides nothing
        suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large,
                               HealthCheck.filter_too_much, HealthCheck.large_base_example,
                               HealthCheck.function_scoped_fixture))
