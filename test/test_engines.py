# SPDX-License-Identifier: Apache-2.0
"""The adapters of benchmark/engines: where an engine is installed, `grade` sees what it does."""

import importlib
import runpy
from dataclasses import replace

from helpers.reference import ROOT

from spinning_top_sim.grade import grade
from spinning_top_sim.grade.scenes import SCENES


def test_rows_of_the_page_differ_and_a_fine_tolerance_passes(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'benchmark'))
    entries = runpy.run_path(str(ROOT / 'benchmark/engines.py'))['ENTRIES']
    assert len({entry.key for entry in entries}) == len(entries) > 20
    scipy = importlib.import_module('engines.integrators').scipy
    for tolerances, passes in (({'rtol': 1e-10, 'atol': 1e-12}, True), ({}, False)):
        assert grade(lambda *given, **_: scipy(*given, 'DOP853', **tolerances),  # noqa: B023
                     scenes=[replace(SCENES[0], duration=3.0)]).passed == passes
