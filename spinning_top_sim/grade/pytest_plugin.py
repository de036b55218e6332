# SPDX-License-Identifier: Apache-2.0
"""A fixture for pytest: `pytest_plugins = ['spinning_top_sim.grade.pytest_plugin']`."""

from collections.abc import Callable

import pytest

from spinning_top_sim.grade.simulators import grade
from spinning_top_sim.tools.report import Report, passing


@pytest.fixture
def pass_grade() -> Callable[..., Report]:
    """Return `grade` as a function that fails the test if there are faults, but for `known`."""
    return passing(grade)
