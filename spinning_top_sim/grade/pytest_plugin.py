# SPDX-License-Identifier: Apache-2.0
"""A fixture for pytest: `pytest_plugins = ['spinning_top_sim.grade.pytest_plugin']`."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from spinning_top_sim.grade.grader import grade
from spinning_top_sim.grade.report import Report


@pytest.fixture
def pass_grade() -> Callable[..., Report]:
    """
    Return a function that grades a simulator and fails the test if it has faults.

    The function takes the arguments of `grade`, and `known`, names of faults that are allowed.
    It returns the report.
    """
    def pass_grade(*arguments: Any, known: Iterable[str] = (), **options: Any) -> Report:
        __tracebackhide__ = True
        report = grade(*arguments, **options)
        if not set(report.names) <= set(known):
            pytest.fail(str(report), pytrace=False)
        return report
    return pass_grade
