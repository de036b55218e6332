# SPDX-License-Identifier: Apache-2.0
"""What exam and grade share: conventions of attitudes, the fit of a sensor, the report."""

import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools import conventions
from spinning_top_sim.tools.report import Finding, Mark, Report

TRUTH = Rotation.random(12, random_state=3)


@pytest.mark.parametrize('one', conventions.group()[::7], ids=lambda one: one.name)
def test_a_convention_is_found_and_undone(one):
    told = one.tell(TRUTH.as_quat())
    found = conventions.best(told, TRUTH.as_quat())
    assert len(found.convention.parts) <= len(one.parts)
    assert np.allclose((Rotation.from_quat(found.convention.undo(told))
                        * TRUTH.inv()).magnitude(), 0.0, atol=1e-6)
    assert found.after < 1e-6 and (found.before > 0.1) == bool(one.parts)


def test_a_constant_heading_is_no_error_where_it_need_only_be_steady():
    turned = (Rotation.from_euler('z', 0.7) * TRUTH).as_quat()
    for heading, error in (('absolute', 0.7), ('steady', 0.0), ('any', 0.0)):
        assert conventions.error_of(turned, TRUTH.as_quat(), heading) == pytest.approx(
            error, abs=1e-9)


def test_a_report_is_a_table_and_json():
    report = Report('it', [Finding('timing', '3 samples late', 3.0)], {
        'lag': Mark(3.0, 1.0, 'samples'), 'unknown': Mark(math.nan), 'far': Mark(math.inf)},
        ['bias: not judged'])
    assert not report.passed and report.faults == ['timing'] and report.measures['lag'] == 3.0
    assert 'it: timing\n  timing: 3 samples late\n  bias: not judged\n' in str(report)
    assert any(line.split() == ['lag', '3', '1', 'samples'] for line in str(report).splitlines())
    assert 'unknown' not in str(report)
    said = json.loads(report.as_json())
    assert said['found'] == [{'name': 'timing', 'evidence': '3 samples late', 'number': 3.0}]
    assert said['marks']['far'] == {'value': None, 'limit': None}
