# SPDX-License-Identifier: Apache-2.0
"""The same bits on every machine, Python and NumPy, or a line that says where they differ."""

import json
import warnings

import numpy as np
import pytest
from helpers.golden import CASES, KEPT, computed, differences, golden

# What differs in NumPy 1.26, whatever the processor.
OF_ITS_NUMPY = ('imu, low pass, vibration',) if np.__version__ < '2' else ()
LARGEST = 1e-9      # difference over the magnitude of a column, on another processor


@pytest.fixture(scope='module')
def kept():
    return json.loads(KEPT.read_text())


@pytest.fixture(scope='module', params=[True, False], ids=['plain', 'as it is'])
def found(request):
    return request.param, computed() if request.param else {
        case: golden(case) for case in CASES}


@pytest.mark.parametrize('case', CASES)
def test_a_run_has_the_bits_that_it_has_everywhere(case, kept, found):
    plain, cases = found
    lines = differences(cases[case], kept[case])
    if plain and case not in OF_ITS_NUMPY:
        assert not lines, '\n'.join(line for line, _ in lines.values())
    for name, (line, size) in lines.items():
        warnings.warn(f'{case}: {line}', stacklevel=1)
        # Drifts and errors are nothing but last bits.
        assert size <= LARGEST or '~/invariants' in name, line


def test_where_runs_differ_the_column_and_the_units_are_told():
    x, y = 1.0, 1.0 + 3 * 2.0 ** -52
    kept = {'a': ['1', x.hex(), x.hex()], 'b': ['2', x.hex(), x.hex()], 'c': ['3']}
    found = {'a': ['1', x.hex(), x.hex()], 'b': ['4', x.hex(), y.hex()], 'd': ['3']}
    assert {name: line for name, (line, _) in differences(found, kept).items()} == {
        'b': 'b: up to 3 units in the last place in 1 of 2 samples',
        'c': 'c: not in both', 'd': 'd: not in both'}
