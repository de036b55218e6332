# SPDX-License-Identifier: Apache-2.0
"""The adapters of benchmark/engines: where an engine is installed, `grade` sees what it does."""

import importlib
import runpy
from dataclasses import replace

import pytest
from helpers.reference import ROOT

from spinning_top_sim.grade import grade
from spinning_top_sim.grade.scenes import SCENES

BENCHMARK = ROOT / 'benchmark'
SHORT = [replace(SCENES[0], duration=3.0, divided=(1, 2))]


@pytest.fixture
def adapter(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARK))
    return lambda name: importlib.import_module(f'engines.{name}')


def test_every_row_of_the_page_is_named_once_and_has_its_adapter(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARK))
    entries = runpy.run_path(str(BENCHMARK / 'engines.py'))['ENTRIES']
    assert len({entry.key for entry in entries}) == len(entries) > 20
    for entry in entries:
        module, name = entry.place.split(':')
        text = (BENCHMARK / f'engines/{module}.py').read_text(encoding='utf-8')
        assert f'def {name}(' in text or f'class {name}:' in text


def test_an_integrator_with_a_fine_tolerance_passes_and_with_its_default_does_not(adapter):
    scipy = adapter('integrators').scipy

    def run(top, start, times, dt, **tolerances):
        return scipy(top, start, times, dt, 'DOP853', **tolerances)

    assert grade(lambda *given: run(*given, rtol=1e-10, atol=1e-12), scenes=SHORT).passed
    assert not grade(run, scenes=SHORT).passed
