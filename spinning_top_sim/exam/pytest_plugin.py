# SPDX-License-Identifier: Apache-2.0
"""A fixture for pytest: `pytest_plugins = ['spinning_top_sim.exam.pytest_plugin']`."""

from collections.abc import Callable

import pytest

from spinning_top_sim.exam.examiner import examine
from spinning_top_sim.tools.report import Report, passing


@pytest.fixture
def pass_exam() -> Callable[..., Report]:
    """
    Return a function that examines a filter and fails the test if it has faults.

    The function takes the arguments of `examine`, and `known`, names of faults that are allowed.
    It returns the report.
    """
    return passing(examine)
