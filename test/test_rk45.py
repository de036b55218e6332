# SPDX-License-Identifier: Apache-2.0
"""
Dormand-Prince steps: accuracy and cost, poles, refusals.

The judge is the reference data (30 digits), and where that has no time the exact solution.
"""

import math
import sys

import numpy as np
import pytest
from helpers.reference import CASES, angle, quaternion_of, scene_parameters, start_of, top_of

from spinning_top_sim import State, Top, solve
from spinning_top_sim.physics.pivot import PivotPath
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.equations import TransportMotion
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.motion import Motion
from spinning_top_sim.solvers.solve import METHODS, motion_of
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.trajectory import Trajectory

SECOND = 1_000_000_000
TOP = Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8)
LOOPING = top_of(CASES['loop-a']), start_of(CASES['loop-a'])
# A gyroscope of 1e8 takes 640 000 steps a second; and near a separatrix neighbouring motions part
# like exp(k t): within 30 s 1e-13 grows beyond 1e-6.
LATEST = {'fast-1e+08-cusp': 1e-5, 'fast-10000-cusp': 1.0, 'loop-a': 124.0, 'cross-top-a': 124.0,
          'negP-a': 124.0}


@pytest.mark.parametrize(('name', 'equations'), [
    *((name, 'transport') for name in CASES),       # and away from the poles
    *((name, 'euler') for name in ('loop-c-thd+', 'oblate-neg-spin', 'negP-a'))])
def test_reference_cases(name, equations):
    case = CASES[name]
    states = [s for s in case['states'] if s['t'] <= (
        LATEST.get(name, 20.0) if equations == 'transport' else case['states'][1]['t'])]
    motion = solve(top_of(case), start_of(case), [s['t'] for s in states], method='rk45',
                   rtol=1e-12, equations=equations)
    for i, state in enumerate(states):
        assert angle(motion.quaternion[i], quaternion_of(state)) <= 1e-6
        for ours, theirs in (('theta', 'theta'), ('phi', 'phi'), ('psi', 'psi'),
                             ('theta_folded', 'theta_folded'), ('theta_dot', 'thetadot')):
            true = float(state[theirs])
            assert abs(getattr(motion, ours)[i] - true) <= 1e-6 * (
                max(1.0, abs(true)) if ours == 'theta_dot' else 1.0), (ours, state['t'])


def test_a_minute_of_the_cusp_scene():
    """Orientation, invariants, cost and cusps of the default solver at its default tolerance."""
    values, seconds = parameters.checked(scene_parameters('cusp')), 60.0
    top, start = parameters.top_of(values), parameters.start_state(values)
    stepped = motion_of(top, start, method='rk45', rtol=values['solver.rtol'],
                        atol=values['solver.atol'])
    period = ExactSolution(top, start).nutation_period
    states = stepped.states(period * np.arange(int(seconds / period) + 1))
    assert np.abs(states.phi_dot).max() <= 1e-6
    for column in (states.energy / states.energy[0], states.l3 / start.l3, states.lz / start.lz):
        assert np.abs(column - 1.0).max() <= 1e-12
    last, truth = stepped.states(np.array([seconds])), solve(top, start, [seconds])
    assert angle(last.quaternion[0], truth.quaternion[0]) < 3e-9
    assert abs(last.phi[0] - truth.phi[0]) < 3e-9
    assert stepped.evaluations <= seconds * 1500


@pytest.mark.parametrize('name', ['free-R0-fixedaxis', 'sleep-exact-stable', 'steady-fast'])
def test_free_motion_and_equilibria_take_no_steps(name):
    motion = motion_of(top_of(CASES[name]), start_of(CASES[name]), method='rk45')
    state = next(s for s in CASES[name]['states'] if s['t'] == 123.4)
    found = motion.states(np.array([123.4])).quaternion[0]
    assert motion.steps == motion.evaluations == 0
    assert angle(found, quaternion_of(state)) < 1e-12


@pytest.mark.parametrize(('lambda3', 'state', 'says'), [
    (0.5, State(theta=0.0, theta_dot=2.0, l3=1.5, lz=1.5), 'pole.*transport'),
    (0.5, State(theta=0.8, theta_dot=-3.5, l3=2.0, lz=2.000000001), 'pole.*transport'),
    (0.5, State(theta=0.8, theta_dot=-3.5, l3=2.0, lz=2.0), 'pole.*transport'),
    (1e15, State(theta=0.6, l3=1.6, lz=1.1), r'lambda3 = 1.*lambda1 for the euler equations')])
def test_the_literal_equations_stop_with_advice_where_they_fail(lambda3, state, says):
    top = Top(lambda1=1.0, lambda3=lambda3, mass=1.0, com_distance=0.5, gravity=9.8)
    with pytest.raises((IntegrationError, ValueError), match=says):
        solve(top, state, [5.0], method='rk45', equations='euler', rtol=1e-9)


@pytest.mark.parametrize(('arguments', 'message'), [
    ({'method': 'rk4'}, "method = 'rk4'"), ({'equations': 'newton'}, "equations = 'newton'"),
    ({'rtol': 'a'}, "rtol = 'a': must be in"), ({'rtol': math.nan}, 'rtol = nan'),
    ({'rtol': 1.0}, r'rtol = 1\.0'), ({'atol': -1.0}, r'atol = -1\.0'),
    ({'t': np.ma.array([1.0, 2.0], mask=[0, 1])}, r't\[1\] = nan s: must be finite'),
    ({'t': [1.0, 0.5]}, r't\[1\] = 0\.5 s after 1\.0'), ({'t': [-1.0]}, r't\[0\] = -1\.0'),
    ({'t': [[1.0]]}, 'shape'), ({'t': ['soon']}, 'soon'), ({'t': [10 ** 5000]}, 'numbers, in s'),
    ({'t': np.array(['2026-01-01'], 'M8[ns]')}, 'datetime64.*numbers, in s')])
def test_bad_settings_and_times_are_refused_by_name_and_value(arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(*LOOPING, **{'t': [1.0], 'method': 'rk45', **arguments})


def test_steps_need_no_multiprecision_and_the_exact_solution_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, 'gmpy2', None)
    monkeypatch.delitem(sys.modules, 'spinning_top_sim.solvers.exact')
    sleeping = State(theta=0.0, l3=1.6, lz=1.6)
    assert solve(TOP, sleeping, [1.0], method='rk45').phi_dot[0] == pytest.approx(0.8, rel=1e-12)
    with pytest.raises(ImportError, match=r"method = 'exact' needs gmpy2, .*not installed"):
        solve(TOP, sleeping, [1.0])


def test_steps_are_read_until_they_are_forgotten():
    motion, seconds = motion_of(*LOOPING, method='rk45'), np.arange(90.0)
    before = motion.states(seconds[:60])
    steps = motion.steps
    motion.forget(30 * SECOND)
    after = motion.states(seconds[30:60])
    assert after.phi.tobytes() == before.phi[30:].tobytes()
    assert motion.steps == steps and motion.reached_ns >= 59 * SECOND
    with pytest.raises(IntegrationError, match='oldest'):
        motion.states(seconds[1:2])
    motion.forget(100 * SECOND)                 # the newest step stays: the next begins there
    assert len(motion.states(seconds[59:])) == 31


def test_a_solver_is_a_name_in_a_table(monkeypatch):
    """Here one that has nothing but states, and no digits beyond doubles."""
    class Another(Motion):
        def states(self, t, per_second=1):
            return ExactSolution(self.top, self.start).states(t, per_second)

    monkeypatch.setitem(METHODS, 'another', lambda top, start, *_: Another(top, start))
    found, expected = (Trajectory(
        *LOOPING, PivotPath([(SECOND, (1.0, 0.0, 0.0))]), {'method': method},
        most_acceleration=2.0).evaluate(SECOND * np.arange(4)).theta
        for method in ('another', 'exact'))
    assert found == pytest.approx(expected, abs=1e-12)


def test_an_error_that_is_no_number_is_no_small_error(monkeypatch):
    monkeypatch.setattr(TransportMotion, 'errors', lambda *unknowns: (0.5, math.nan, 0.25))
    with pytest.raises(IntegrationError, match='collapsed'):
        solve(*LOOPING, [1.0], method='rk45')


@pytest.mark.parametrize('equations', ['transport', 'euler'])
def test_a_time_that_takes_too_many_steps_is_refused_at_once(equations):
    top = Top(lambda1=1e-8, lambda3=1e-8, mass=1.0, com_distance=0.1, gravity=9.81)
    with pytest.raises(IntegrationError, match=r'steps of .* s away: use|leapt over a pole'):
        solve(top, State(theta=0.7, l3=40.0, lz=-11.0), [1.0], method='rk45', equations=equations,
              rtol=1e-6)
