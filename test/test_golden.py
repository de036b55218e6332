# SPDX-License-Identifier: Apache-2.0
"""The same bits on every machine, Python and NumPy."""

import json

import numpy as np
import pytest
from helpers.golden import CASES, KEPT, computed

# What differs in NumPy 1.26, whatever the processor.
OF_ITS_NUMPY = ('imu, low pass, vibration',) if np.__version__ < '2' else ()


@pytest.fixture(scope='module')
def plain():
    return computed()


@pytest.mark.parametrize('case', CASES)
def test_a_run_has_the_bits_that_it_has_everywhere(case, plain):
    if case not in OF_ITS_NUMPY:
        assert plain[case] == json.loads(KEPT.read_text())[case]
