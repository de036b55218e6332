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
NED, NWU = (Rotation.from_matrix(rows) for rows in (
    [(0, 1, 0), (1, 0, 0), (0, 0, -1)], [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]))
FLIPPED = Rotation.from_euler('x', 180.0, degrees=True)


@pytest.mark.parametrize(('name', 'told'), [
    ('', TRUTH.as_quat()), ('conjugated', TRUTH.inv().as_quat()),
    ('w, x, y, z', TRUTH.as_quat()[:, [3, 0, 1, 2]]),
    ('world north-east-down', (NED * TRUTH).as_quat()),
    ('world north-west-up', (NWU * TRUTH).as_quat()),
    ('sensor axes z, x, y', -(TRUTH * Rotation.from_quat([0.5] * 4)).as_quat()),
    ('w, x, y, z, world north-east-down, sensor axes x, -y, -z',
     (NED * TRUTH * FLIPPED).as_quat()[:, [3, 0, 1, 2]]),
    ('vector part x, -y, z', TRUTH.as_quat() * (1.0, -1.0, 1.0, 1.0))])
def test_a_convention_is_found_and_undone(name, told):
    found = conventions.best(told, TRUTH.as_quat())
    assert found.convention.name == name
    assert np.allclose((Rotation.from_quat(found.convention.undo(told))
                        * TRUTH.inv()).magnitude(), 0.0, atol=1e-6)
    assert found.after < 1e-6 and (found.before > 0.1) == bool(name)


def test_a_constant_heading_is_no_error_where_it_need_only_be_steady():
    turned = (Rotation.from_euler('z', 0.7) * TRUTH).as_quat()
    for steady, error in ((False, 0.7), (True, 0.0)):
        found = conventions.best(turned, TRUTH.as_quat(), steady=steady)
        assert found.before == pytest.approx(error, abs=1e-9) and not found.convention.parts


def test_a_report_is_a_table_and_json():
    report = Report('it', [Finding('timing', '3 samples late', 3.0)], {
        'lag': Mark(3.0, 1.0, 'samples'), 'unknown': Mark(math.nan), 'far': Mark(math.inf),
        'error: spin: fast': Mark(2.0)}, ['bias: not judged'])
    assert not report.passed and report.faults == ['timing'] and report.measures['lag'] == 3.0
    assert 'it: timing\n  timing: 3 samples late\n  bias: not judged\n' in str(report)
    assert any(line.split() == ['lag', '3', '1', 'samples'] for line in str(report).splitlines())
    assert 'unknown' not in str(report) and '  spin: fast      2' in str(report)
    said = json.loads(report.as_json())
    assert said['found'] == [{'name': 'timing', 'evidence': '3 samples late', 'number': 3.0}]
    assert said['marks']['far'] == {'value': None, 'limit': None, 'meaning': ''}
