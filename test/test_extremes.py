# SPDX-License-Identifier: Apache-2.0
"""Extreme tops, parameters and commands: they run, or are refused in one clear line."""

import math
import re
import sys
import warnings

import numpy as np
import pytest
from helpers.examples import examples
from helpers.tops import COLUMNS, UNIT, time_limit
from hypothesis import example, given
from hypothesis import strategies as st

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters

DOUBLES = (0.0, -0.0, 5e-324, 1e-310, 1e-300, 1e-170, 1e-100, 1e-46, 1e-20, 1e-9, 1e-3, 0.5, 1.0,
           math.pi, 2.0, 14.0, 1e3, 1e5, 1e9, 1e10, 1e16, 1e17, 1e20, 1e30, 1e100, 1e154, 1e200,
           1e300, sys.float_info.max)
START = {'theta': 0.6, 'theta_dot': 0.4, 'phi': 0.3, 'psi': -1.2, 'l3': 1.6, 'lz': 1.1}
TOP = {'lambda1': 0.123, 'lambda3': 0.15, 'mass': 2.0, 'com_distance': 0.15, 'gravity': 9.8}
METHODS = ({'method': 'exact'}, {'method': 'rk45', 'rtol': 1e-6},
           {'method': 'rk45', 'rtol': 1e-6, 'equations': 'euler'})
# What may be said instead of an answer; a ValueError names the field, or tops and starts.
REASONS = (r'(theta|theta_dot|l3|lz|lambda1|lambda3|mass|com_distance|gravity|phi|psi|t) = '
           r'|closer to the separatrix|at most|at least')
SIZES = st.sampled_from((*DOUBLES, 1e-150, 1e-30, 1e150)) | st.floats(0.0, 1e60)
CHANGES = st.dictionaries(st.sampled_from([*TOP, *START]),
                          st.tuples(SIZES, st.sampled_from((1.0, -1.0))), min_size=1)


@pytest.mark.parametrize('method', METHODS, ids=('exact', 'transport', 'euler'))
@examples(40)
@given(CHANGES, st.sampled_from((None, 1.0, -1.0)))
@example({'lambda3': (5e-324, 1.0)}, None)
@example({'lambda1': (1e-48, 1.0)}, None)
@example({'mass': (0.0, 1.0), 'lambda3': (1e-9, 1.0), 'theta_dot': (0.0, 1.0), 'l3': (8e41, 1.0)},
         None)
def test_any_sizes_of_numbers_give_the_start_or_a_reason(method, changed, lz_of_l3):
    """And, by the closed form, what follows."""
    values = {**TOP, **START, **{
        name: size * (side if name not in ('theta', 'lambda1', 'lambda3', 'mass') else 1.0)
        for name, (size, side) in changed.items()}}
    if lz_of_l3 is not None:
        values['lz'] = lz_of_l3 * values['l3']
    exact = method == METHODS[0]
    try:
        with time_limit(5.0), warnings.catch_warnings():
            warnings.simplefilter('error')
            motion = solve(Top(**{name: values[name] for name in TOP}),
                           State(**{name: values[name] for name in START}),
                           [0.0, 1e-6, 0.5] if exact else [0.0], **method)
            for name in COLUMNS:
                assert np.all(np.isfinite(getattr(motion, name))), name
    except (ValueError, IntegrationError) as error:
        assert '\n' not in str(error)
        assert isinstance(error, IntegrationError) or re.search(REASONS, str(error)), error
        return
    assert np.abs(np.linalg.norm(motion.quaternion, axis=1) - 1.0).max() <= UNIT
    for name in ('theta', 'theta_dot', 'phi', 'psi') if exact else ():
        assert abs(getattr(motion, name)[0] - values[name]) <= 1e-14 * max(
            1.0, abs(values[name])), name


HUGE, TINY = 1e300, 1e-300
SHUTTLE = {'pivot.waypoints': (0.0, 0.0, 0.0, 2.0, 1.0, 0.5), 'pivot.repeat': True}


@pytest.mark.parametrize(('values', 'words'), [
    *(({name: value}, rf'^{re.escape(name)} = .*: must be ') for name, value in (
        ('status_period', TINY), ('pose.rate', 1e5), ('imu.gyroscope_M', (*8 * (0.0,), HUGE)),
        ('imu.bias_instability_band', (0.0, 1.0)), ('step.count', 0), ('seed', 10 ** 400),
        ('record.min_free_bytes', 2 ** 63), ('pivot.waypoints', (1.0, math.nan, 0.0)),
        ('pivot.waypoints', (0.0, 0.0, 0.0, 1.0)))),
    ({'imu.bandwidth': 0.5}, 'imu.bandwidth.*must be a number 0 or >= 1 and <= 100000'),
    ({'imu.vibration.rate_psd': (20.0, 0.1, 20.0, 0.1)}, 'rate_psd.*two or more ascending'),
    ({'imu.vibration.rate_psd': (1e-300, 1e-300, 1e6, 1e6)}, 'rate_psd.*0 or >= 1e-100'),
    ({'mag.disturbance.body': (2.0, 1.0, 0.0, 0.0, 0.0)}, 'must not end before'),
    ({'imu.bandwidth': 9.0, 'imu.sampling': 'mean'}, 'imu.bandwidth = 9.0: must be 0 with'),
    ({'mag.disturbance.world': ()}, 'world.*a list of 5 numbers, or a multiple'),
    ({'gnss.origin': (90.5, 0.0, 0.0)}, 'gnss.origin'),
    ({'gnss.outages': (1.0, 3.0, 2.0, 4.0)}, 'gnss.outages'),
    ({'pivot.path': (1.0, 2.0, 3.0)}, 'pivot.path = .*4 numbers, or a multiple'),
    ({'pivot.path': (1e-6, 0.0, 0.0, 0.0)}, 'duration 1e-06 s: must be >= 0.001'),
    ({'pivot.path': (1.0, 1.0, 0.0, 0.0), 'pivot.repeat': True}, 'changes the velocity'),
    ({'pivot.speed': 1e-300, **SHUTTLE}, 'pivot.waypoints: a piece .* must be less than 9e9 s'),
    ({'pivot.waypoints': (0.0, 0.0, 0.0, 1e-9, 0.0, 0.0), 'pivot.repeat': True}, 'for each'),
    ({'pivot.waypoints': (1.0, 1.0, 0.0)}, 'two different points'),
    ({'pivot.path': (1.0, 0.0, 0.0, 1.0), **SHUTTLE}, 'must be zeros with pivot.path')])
def test_what_makes_no_sense_is_refused_in_words(values, words):
    with pytest.raises(ValueError, match=words):
        parameters.checked(values)
