# SPDX-License-Identifier: Apache-2.0
"""The adapters of benchmark/engines: where an engine is installed, `grade` sees what it does."""

import runpy
from dataclasses import replace

from helpers.reference import ROOT

from spinning_top_sim.grade import grade
from spinning_top_sim.grade.scenes import SCENES


def test_every_row_of_the_page_has_its_adapter_and_a_fine_tolerance_passes(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'benchmark'))
    entries = runpy.run_path(str(ROOT / 'benchmark/engines.py'))['ENTRIES']
    assert len({entry.key for entry in entries}) == len(entries) > 20
    for module, name in (entry.place.split(':') for entry in entries):
        text = (ROOT / f'benchmark/engines/{module}.py').read_text(encoding='utf-8')
        assert f'def {name}(' in text or f'class {name}:' in text
    scipy = runpy.run_path(str(ROOT / 'benchmark/engines/integrators.py'))['scipy']
    for tolerances, passes in (({'rtol': 1e-10, 'atol': 1e-12}, True), ({}, False)):
        assert grade(lambda *given, **_: scipy(*given, 'DOP853', **tolerances),  # noqa: B023
                     scenes=[replace(SCENES[0], duration=3.0)]).passed == passes
