# SPDX-License-Identifier: Apache-2.0
"""
The exact solution: against 30-digit references, against an integrator, and against itself.

data/reference_cases.json holds 32 motions at four times each, computed with 70 digits; its own
`conventions` say what the numbers mean.  The bound for everything is the one that `ExactSolution`
promises: 5e-15, relative for what is larger than 1.
"""

import doctest
import json
import math
import os
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from helpers.random_tops import random_case
from helpers.reference import CASES, ROOT, start_of, top_of
from helpers.tops import EXACT, check_motion, time_limit

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers import solve as solve_module
from spinning_top_sim.solvers.exact import TIMES_TOGETHER, ExactSolution, exact_about
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.solvers.vertical import Posture


def error(value, digits, start=0.0):
    """Return the error of a double over max(1, |value|, |value at the start|)."""
    true = Decimal(digits)
    return float(abs(Decimal(float(value)) - true) / max(1, abs(true), abs(Decimal(start))))


HARD_CASES = json.loads((ROOT / 'test/data/hard_cases.json').read_text())['cases']


@pytest.mark.parametrize('case', [*CASES.values(), *HARD_CASES], ids=lambda case: case['name'])
def test_states_agree_with_reference(case):
    """
    At seconds, and at those that are whole nanoseconds.

    The hard cases have 28 digits (data/make_references.py): starts within 1e-26 to 1e-99 rad of a
    pole that is passed, or 1e-19 to 1e-91 rad/s from a turning point, passages of a pole at
    1e-11 rad, angles of many turns, and random tops.
    """
    solution = ExactSolution(top_of(case), start_of(case))
    scale = solution.start if case in HARD_CASES else State(theta=0.0, l3=0.0, lz=0.0)
    whole = [(ns.numerator, state) for state in case['states']
             if (ns := Fraction(state['t']) * 10 ** 9).denominator == 1]
    for states, references in (
            (solution.states(np.array(case['times'])), case['states']),
            (solution.states(np.array([ns for ns, _ in whole]), 10 ** 9),
             [state for _, state in whole])):
        for i, reference in enumerate(references):
            assert max(map(error, np.roll(states.quaternion[i], 1), reference['q'])) <= EXACT
            for name in ('theta', 'theta_dot', 'phi', 'psi'):
                assert error(getattr(states, name)[i], reference[name.replace('_', '')],
                             getattr(scale, name)) <= EXACT, name


@pytest.mark.parametrize('seed', range(int(os.environ.get('TOPS', '40'))))
def test_random_tops(seed):
    """TOPS=20000 in the environment takes as many; 40 by default."""
    with time_limit(20.0):
        check_motion(*random_case(seed))


UNIT = Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8)


def start(theta, theta_dot=0.0, *, l3, lz):
    return State(theta=theta, theta_dot=theta_dot, phi=0.3, psi=-0.7, l3=l3, lz=lz)


LOOPING = UNIT, start(0.6, l3=6.0, lz=4.5)
NOTHING_MOVES = replace(UNIT, gravity=0.0), start(0.5, l3=0.0, lz=0.0)


def test_a_tiny_oscillation_has_its_rate_and_is_refused_below_what_doubles_hold():
    top = replace(UNIT, com_distance=-0.5)          # it hangs at theta = 0
    rate = math.sqrt(4.9)
    t = np.array([0.3, 0.9])
    motion = solve(top, start(1e-140, l3=0.0, lz=0.0), t)
    assert motion.theta == pytest.approx(1e-140 * np.cos(rate * t), rel=1e-14, abs=0.0)
    assert np.abs(motion.theta_dot) == pytest.approx(
        1e-140 * rate * np.abs(np.sin(rate * t)), rel=1e-14, abs=0.0)
    with pytest.raises(ValueError, match=r'the amplitude of .* at least 1e-145'):
        solve(top, start(1e-150, l3=0.0, lz=0.0), [0.0])


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize(('top', 'state', 'turns'), [
    (replace(UNIT, lambda3=0.001), start(0.0, l3=3.0, lz=3.0), 1500.0 / math.tau),
    (replace(UNIT, gravity=0.0), start(0.4, 250.0, l3=0.0, lz=0.0), 250.0 / math.pi)])
def test_times_end_where_the_fastest_phase_has_made_2_to_the_52_turns(top, state, turns, sign):
    limit = sign * 2.0 ** 52 / turns
    assert np.isfinite(solve(top, state, [limit * (1.0 - 1e-9)]).phi).all()
    with pytest.raises(ValueError, match='must be finite and within'):
        solve(top, state, [0.0, limit * (1.0 + 1e-9)])


@pytest.mark.parametrize('motion', [LOOPING, NOTHING_MOVES])
def test_a_range_has_the_bits_of_its_times_in_any_pieces(motion):
    """Of nanoseconds and of years, backwards, where the integers end, and beyond one block."""
    solution = Piece(*motion, 0, method='exact')
    end = 2 ** 63 - 1
    for times in (range(-3, 700), range(50_000 * 10 ** 9, 0, -10 ** 9), range(end - 2000, end, 3),
                  range(0, 2 * TIMES_TOGETHER * 10 ** 6 + 1, 10 ** 6), range(-end, end, end // 7)):
        of_range, of_array = solution.states(times), solution.states(np.array(times))
        for column in ('quaternion', 'theta', 'phi', 'angular_velocity'):
            expected = getattr(of_array, column)
            assert getattr(of_range, column).tobytes() == expected.tobytes()
            part = slice(len(times) // 3, len(times) // 3 + 40)
            assert getattr(solution.states(times[part]), column).tobytes() == (
                expected[part].tobytes())


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_a_motion_too_fast_for_doubles_is_refused(method):
    with pytest.raises(ValueError, match=r'rate of the axis must be at most 1e\+100 rad/s'):
        solve(UNIT, start(3e-133, l3=1.6, lz=1.1), [0.0], method=method)


def test_the_example_of_solve_is_right_and_swapped_arguments_are_told():
    assert doctest.testmod(solve_module) == (0, 4)
    with pytest.raises(TypeError, match=r'^solve\(State, Top, ...\): must be solve\(top'):
        solve(*LOOPING[::-1], [0.0])


@pytest.mark.parametrize('alpha', [0.0, 1.0])
@pytest.mark.parametrize('transverse', [4.0, -4.0 + 1.0j])
def test_a_motion_that_is_handed_over_at_a_pole_leaves_it_as_steps_do(alpha, transverse):
    top = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.8)
    posture, t = Posture(alpha + 0j, 1.0 - alpha + 0j, transverse + 0j, 0.8), np.arange(21) * 0.1
    found, stepped = (motion.states(t).quaternion for motion in (
        exact_about(top, posture, (0, 0, 0))[0], motion_of(top, posture, method='rk45')))
    assert np.abs(found * np.sign(found[0] @ stepped[0]) - stepped).max() < 1e-9
