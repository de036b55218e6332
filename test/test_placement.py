# SPDX-License-Identifier: Apache-2.0
"""States of a top from pose and twist."""

import math

import numpy as np
import pytest

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.placement import POLE, state_of
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.propagator import propagate

TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)


def pose_and_twist(state):
    """Return quaternion and angular velocity in the world of a state, by the exact solver."""
    states = propagate(TOP, state, method='exact').states(range(1))
    q = states.rows_quaternion
    return np.concatenate(q), np.concatenate(attitude.rotated(q, states.rows_angular_velocity))


@pytest.mark.parametrize('seed', range(6))
def test_a_state_comes_back_from_its_pose_and_twist(seed):
    rng = np.random.default_rng(seed)
    state = State(theta=rng.uniform(0.02, 3.12), theta_dot=rng.normal(), phi=rng.uniform(-3, 3),
                  psi=rng.uniform(-3, 3), l3=rng.normal(), lz=rng.normal())
    q, rates = pose_and_twist(state)
    found = state_of(TOP, q * rng.choice([0.5, 1.0, 2.0]), rates)
    for name, value in vars(state).items():
        # The length of a quaternion does not matter; angles come back up to turns.
        difference = getattr(found, name) - value
        if name in ('phi', 'psi'):
            difference = math.remainder(difference, math.tau)
        assert abs(difference) < 1e-12, name
    again, rates_again = pose_and_twist(found)
    assert np.allclose(again, q, rtol=0.0, atol=1e-14), 'the sign of the quaternion stays'
    assert np.allclose(rates_again, rates, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize('tilt', [0.0, 0.4 * POLE])
@pytest.mark.parametrize('inverted', [False, True])
@pytest.mark.parametrize('rates', [(0.0, 0.0, 3.0), (0.3, -0.4, 2.0), (0.0, -0.5, 0.0)])
def test_at_a_pole_what_is_not_spin_is_nutation(tilt, inverted, rates):
    theta = math.pi - tilt if inverted else tilt
    columns = [np.array([value]) for value in (0.7, theta, -1.9)]
    q = np.concatenate(attitude.quaternion_of_angles(*columns))
    state = state_of(TOP, q, np.array(rates))
    assert state.theta == (math.pi if inverted else 0.0)
    assert state.lz == (-state.l3 if inverted else state.l3) == TOP.lambda3 * rates[2]
    assert state.theta_dot == math.hypot(*rates[:2])
    again, rates_again = pose_and_twist(state)
    assert np.allclose(np.abs(again @ q), 1.0, rtol=0.0, atol=1e-15)
    assert np.allclose(again, q, rtol=0.0, atol=POLE)
    assert np.allclose(rates_again, rates, rtol=0.0, atol=1e-14)
