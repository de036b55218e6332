# SPDX-License-Identifier: Apache-2.0
"""
The exact solution where its own arithmetic is at its limits.

Starts within 1e-26 to 1e-99 rad of a pole that is passed, or 1e-19 to 1e-91 rad/s from a turning
point, passages of a pole at 1e-11 rad, and angles of many turns.  data/hard_cases.json holds their
states to 28 digits, from Taylor series of Newton's and Euler's equations at two precisions
(data/make_references.py): nothing of a closed form is in them.
"""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from helpers.reference import start_of, top_of

from spinning_top_sim import solve

BOUND = 5e-15
CASES = json.loads((Path(__file__).parent / 'data' / 'hard_cases.json').read_text())['cases']
cases = pytest.mark.parametrize('case', CASES, ids=lambda case: case['name'])


def error(value, digits, start=0.0):
    """Return the error of a double over max(1, |value|, |value at the start|)."""
    true = Decimal(digits)
    return float(abs(Decimal(float(value)) - true) / max(1, abs(true), abs(Decimal(start))))


@cases
def test_states_are_right_to_the_last_digits(case):
    top, start = top_of(case), start_of(case)
    motion = solve(top, start, np.array(case['times']))
    errors = {}
    for k, state in enumerate(case['states']):
        x, y, z, w = motion.quaternion[k]
        errors[state['t']] = (
            error(motion.theta[k], state['theta'], start.theta),
            error(motion.theta_dot[k], state['thetadot'], start.theta_dot),
            error(motion.phi[k], state['phi'], start.phi),
            error(motion.psi[k], state['psi'], start.psi),
            max(map(error, (w, x, y, z), state['q'])))
    assert max(map(max, errors.values())) <= BOUND, errors
