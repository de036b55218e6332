# SPDX-License-Identifier: Apache-2.0
"""
Dormand-Prince steps: the tableau, the order, accuracy and cost, poles, refusals.

The judge is the reference data (30 digits), and where that has no time the exact solution, which
test_exact.py holds against the same data.
"""

import gc
import math
import re
import subprocess
import sys
import weakref

import numpy as np
import pytest
from helpers.reference import CASES, angle, quaternion_of, scene_parameters, start_of, top_of

from spinning_top_sim import State, Top, solve
from spinning_top_sim.solvers import dormand_prince
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.solve import motion_of
from spinning_top_sim.solvers.transport import TransportMotion
from spinning_top_sim.streams import parameters

SECOND = 1_000_000_000
LOOPING = CASES['loop-a']


# Near a separatrix neighbouring motions part like exp(k t): 1e-13 grows beyond 1e-6.
ILL_CONDITIONED = {('sleep-unstable-1e-8', 100.0), ('sep-rounded-a', 30.0),
                   ('planar-sep-rounded', 30.0)}


# One of each regime goes on to 100 s.
LONG = {'loop-a', 'cusp-headline-a', 'cross-top-a', 'cross-bottom-a', 'sleep-unstable-1e-8',
        'spherical-a', 'planar-rot-', 'negP-a', 'nearpole-thmin~1e-6'}


@pytest.mark.parametrize('name', CASES)
def test_reference_cases_up_to_100_s(name):
    case = CASES[name]
    top, start = top_of(case), start_of(case)
    # A gyroscope of 1e8 takes 640 000 steps a second; and a minute and a half takes 10 s in all.
    latest = {'fast-1e+08-cusp': 1e-5, 'fast-10000-cusp': 1.0}.get(
        name, 124.0 if name in LONG else 31.0)
    states = [s for s in case['states'] if s['t'] <= latest]
    motion = solve(top, start, [s['t'] for s in states], method='rk45', rtol=1e-12)
    for i, state in enumerate(states):
        error = max(
            angle(motion.quaternion[i], quaternion_of(state)),
            *(abs(getattr(motion, ours)[i] - float(state[theirs])) for ours, theirs in (
                ('theta', 'theta'), ('phi', 'phi'), ('psi', 'psi'),
                ('theta_folded', 'theta_folded'))))
        if (name, state['t']) in ILL_CONDITIONED:
            assert error > 1e-6, 'not an exception any more'
        else:
            assert error <= 1e-6, (name, state['t'])
            assert motion.theta_dot[i] == pytest.approx(float(state['thetadot']), rel=1e-6,
                                                        abs=1e-6)


def cusp_scene():
    values = parameters.checked(scene_parameters('cusp'))
    return parameters.top_of(values), parameters.start_state(values), values


def test_a_minute_of_the_cusp_scene():
    """Orientation, invariants, cost and cusps of the default solver at its default tolerance."""
    seconds = 60.0
    top, start, values = cusp_scene()
    exact = ExactSolution(top, start)
    stepped = motion_of(top, start, method='rk45', rtol=values['solver.rtol'],
                        atol=values['solver.atol'])
    period = exact.nutation_period
    states = stepped.states_at_seconds(period * np.arange(int(seconds / period) + 1))
    assert np.abs(states.phi_dot).max() <= 1e-6
    assert np.abs(states.energy / states.energy[0] - 1.0).max() <= 1e-12
    assert np.abs(states.l3 / start.l3 - 1.0).max() <= 1e-12
    assert np.abs(states.lz / start.lz - 1.0).max() <= 1e-12
    last, truth = stepped.states_at_seconds(np.array([seconds])), solve(top, start, [seconds])
    assert angle(last.quaternion[0], truth.quaternion[0]) < 3e-9
    assert abs(last.phi[0] - truth.phi[0]) < 3e-9
    assert stepped.evaluations <= seconds * 1500


@pytest.mark.parametrize('name', ['free-R0-fixedaxis', 'sleep-exact-stable', 'steady-fast'])
def test_free_motion_and_equilibria_take_no_steps(name):
    case = CASES[name]
    motion = motion_of(top_of(case), start_of(case), method='rk45')
    states = motion.states_at_seconds(np.array([123.4]))
    assert motion.steps == motion.evaluations == 0
    state = next(s for s in case['states'] if s['t'] == 123.4)
    assert angle(states.quaternion[0], quaternion_of(state)) < 1e-12


ONE_TOP = Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8)


LITERAL_FAILURES = {
    'start at the pole, moving': ({'theta': 0.0, 'theta_dot': 2.0, 'l3': 1.5, 'lz': 1.5}, 5.0),
    'passes the pole at 1e-9': (
        {'theta': 0.8, 'theta_dot': -3.5, 'l3': 2.0, 'lz': 2.000000001}, 5.0),
    'crosses the pole': ({'theta': 0.8, 'theta_dot': -3.5, 'l3': 2.0, 'lz': 2.0}, 5.0),
    'hanging': ({'theta': math.pi, 'l3': 3.0, 'lz': -3.0}, 7.3),
}


@pytest.mark.parametrize('name', LITERAL_FAILURES)
def test_the_literal_equations_stop_with_advice_where_they_fail(name):
    fields, t = LITERAL_FAILURES[name]
    with pytest.raises(IntegrationError, match=r'euler equations.*pole.*transport'):
        solve(ONE_TOP, State(**fields), [t], method='rk45', equations='euler', rtol=1e-9)


def test_the_literal_equations_refuse_a_disc_that_loses_their_digits():
    top = Top(lambda1=0.123, lambda3=0.123e15, mass=2.0, com_distance=0.15, gravity=9.8)
    with pytest.raises(ValueError, match=r'lambda3 = 1.*lambda1 for the euler equations'):
        solve(top, State(theta=0.6, l3=1.6, lz=1.1), [1.0], method='rk45', equations='euler')


@pytest.mark.parametrize('name', ['loop-c-thd+', 'oblate-neg-spin', 'negP-a'])
def test_away_from_the_poles_the_literal_equations_are_right(name):
    case = CASES[name]
    states = case['states'][:2]
    motion = solve(top_of(case), start_of(case), [s['t'] for s in states], method='rk45',
                   equations='euler', rtol=1e-11)
    for i, state in enumerate(states):
        assert angle(motion.quaternion[i], quaternion_of(state)) < 1e-7
        assert motion.phi[i] == pytest.approx(float(state['phi']), abs=1e-8)
        assert motion.psi[i] == pytest.approx(float(state['psi']), abs=1e-8)


@pytest.mark.parametrize(('arguments', 'message'), [
    ({'method': 'rk4'}, "method = 'rk4'"), ({'equations': 'newton'}, "equations = 'newton'"),
    ({'rtol': 'a'}, "rtol = 'a': must be in"), ({'atol': '1'}, "atol = '1'"),
    ({'t': np.ma.array([1.0, 2.0], mask=[0, 1])}, r't\[1\] = nan s: must be finite'),
    ({'rtol': math.nan}, 'rtol = nan'), ({'rtol': 1.0}, r'rtol = 1\.0'),
    ({'atol': -1.0}, r'atol = -1\.0'), ({'t': [1.0, 0.5]}, r't\[1\] = 0\.5 s after 1\.0'),
    ({'t': [-1.0]}, r't\[0\] = -1\.0'), ({'t': [0.0, math.nan]}, r't\[1\] = nan'),
    ({'t': [[1.0]]}, 'shape'), ({'t': ['soon']}, 'soon'), ({'t': [10 ** 5000]}, 'numbers, in s'),
    ({'t': np.array(['2026-01-01'], 'M8[ns]')}, 'datetime64.*numbers, in s')])
def test_bad_settings_and_times_are_refused_by_name_and_value(arguments, message):
    top, start, _ = cusp_scene()
    with pytest.raises(ValueError, match=message):
        solve(top, start, **{'t': [1.0], 'method': 'rk45', **arguments})


WITHOUT_GMPY2 = """
import sys
sys.modules['gmpy2'] = None
from spinning_top_sim import State, Top, solve
from spinning_top_sim.physics.pivot import PivotPath
from spinning_top_sim.solvers.handover import Piece
top = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
print(solve(top, State(theta=0.0, l3=1.6, lz=1.6), [1.0], method='rk45').phi_dot[0])
path = PivotPath([(10 ** 9, (1.0, 0.0, 0.0))])
first = Piece(top, State(theta=0.5, l3=1.6, lz=1.3), 0, path.lasting(0))
second = Piece(top, first.posture(10 ** 9), 10 ** 9, path.lasting(10 ** 9))
print(len(second.states(range(10 ** 9, 2 * 10 ** 9, 10 ** 8))), second.exact)
try:
    solve(top, State(theta=0.5, l3=1.6, lz=1.3), [1.0])
except ImportError as error:
    print(error)
"""


def test_steps_need_no_multiprecision_and_the_exact_solution_says_what_it_needs():
    run = subprocess.run([sys.executable, '-c', WITHOUT_GMPY2], capture_output=True, text=True,
                         timeout=60, check=True)
    rate, piece, said = run.stdout.splitlines()
    assert float(rate) == pytest.approx(0.5 * 1.6 / 0.123, rel=1e-12)
    assert piece == '10 None'
    assert re.match(r"method = 'exact' needs gmpy2, which is not installed: .*pip install", said)


def looping_motion():
    return motion_of(top_of(LOOPING), start_of(LOOPING), method='rk45')


def test_steps_are_read_until_they_are_forgotten():
    motion = looping_motion()
    before = motion.states(range(0, 60 * SECOND, SECOND))
    assert motion.reached_ns >= 59 * SECOND
    steps = motion.steps
    motion.forget(30 * SECOND)
    after = motion.states(range(30 * SECOND, 60 * SECOND, SECOND))
    assert after.quaternion.tobytes() == before.quaternion[30:].tobytes()
    assert after.phi.tobytes() == before.phi[30:].tobytes()
    assert motion.steps == steps
    with pytest.raises(IntegrationError, match='oldest'):
        motion.states(range(SECOND, 2 * SECOND, SECOND))
    motion.forget(100 * SECOND)                 # the newest step stays: the next begins there
    assert len(motion.states(range(59 * SECOND, 90 * SECOND, SECOND))) == 31


def test_so_many_steps_are_kept_at_most(monkeypatch):
    """Whatever is asked: a fast top between two samples of a slow IMU must not fill the memory."""
    monkeypatch.setattr(dormand_prince, 'MOST_KEPT', 50)
    motion = looping_motion()
    found = motion.states(range(60 * SECOND, 60 * SECOND + 1)).phi
    with pytest.raises(IntegrationError, match='oldest'):
        motion.states(range(1))
    monkeypatch.undo()
    assert found == looping_motion().states(range(60 * SECOND, 60 * SECOND + 1)).phi


def test_an_error_that_is_no_number_is_no_small_error():
    class Blind(TransportMotion):
        def errors(self, y, y_new, difference):
            return 0.5, math.nan, 0.25

    with pytest.raises(IntegrationError, match='collapsed'):
        Blind(top_of(LOOPING), start_of(LOOPING), 1e-9, 1e-10).states(range(SECOND, SECOND + 1))


@pytest.mark.parametrize('equations', ['transport', 'euler'])
def test_a_time_that_takes_too_many_steps_is_refused_at_once(equations):
    top = Top(lambda1=1e-8, lambda3=1e-8, mass=1.0, com_distance=0.1, gravity=9.81)
    with pytest.raises(IntegrationError, match=r'steps of .* s away: use|leapt over a pole'):
        solve(top, State(theta=0.7, l3=40.0, lz=-11.0), [1.0], method='rk45', equations=equations,
              rtol=1e-6)


@pytest.mark.parametrize('settings', [
    {'method': 'exact'}, {'method': 'rk45'}, {'method': 'rk45', 'equations': 'euler'}])
def test_a_motion_leaves_nothing_for_the_garbage_collector(settings):
    """A node makes one at each command; its states go too."""
    motion = motion_of(top_of(LOOPING), start_of(LOOPING), **settings)
    states = motion.states(range(0, SECOND, SECOND // 10))
    assert states.phi.shape == states.rows_quaternion[0].shape == (10,)
    there = [weakref.ref(thing) for thing in (motion, states)]
    gc.disable()
    try:
        del motion, states
        assert [reference() for reference in there] == [None, None]
    finally:
        gc.enable()
