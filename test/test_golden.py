# SPDX-License-Identifier: Apache-2.0
"""The same bits on every machine, Python and NumPy, or nearly so on another processor."""

import json

import numpy as np
import pytest
from helpers.golden import CASES, KEPT, computed, golden

# What differs in NumPy 1.26, whatever the processor.
OF_ITS_NUMPY = ('imu, low pass, vibration',) if np.__version__ < '2' else ()
LARGEST = 1e-9      # difference over the magnitude of a column, on another processor


@pytest.fixture(scope='module')
def kept():
    return json.loads(KEPT.read_text())


@pytest.fixture(scope='module')
def plain():
    return computed()


@pytest.mark.parametrize('case', CASES)
def test_a_run_has_the_bits_that_it_has_everywhere(case, kept, plain):
    if case not in OF_ITS_NUMPY:
        assert plain[case] == kept[case]
    found = golden(case)            # as this processor computes it
    assert found.keys() == kept[case].keys()
    for name, (_, *numbers) in found.items():
        value, expected = (np.array([float.fromhex(x) for x in row]) for row in (
            numbers, kept[case][name][1:]))
        # Drifts and errors are nothing but last bits.
        assert abs(value - expected).max() <= LARGEST * abs(expected).max() or (
            '~/invariants' in name), name
