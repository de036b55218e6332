# SPDX-License-Identifier: Apache-2.0
"""
Random tops, symmetries, edge inputs and continued branches: what must hold for every motion.

STRESS_TOPS=100000 in the environment takes as many random tops; `python test/stress tops` does the
same on all processors and tells the worst cases.
"""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
import test_extremes as extremes
from helpers.random_tops import random_case
from helpers.reference import scene_parameters
from stress.tops import EXACT, blocks, check_block, natural_rate, report, state_of, time_limit
from test_extremes import METHODS, START, TOP

from spinning_top_sim import State, Top, solve
from spinning_top_sim.physics.top import ContinuedState
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.propagator import propagate
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation

TOPS = int(os.environ.get('STRESS_TOPS', '145'))


@pytest.mark.parametrize('seeds', blocks(0, TOPS), ids=lambda seeds: f'{seeds[0]}-{seeds[-1]}')
def test_random_tops(seeds):
    found = check_block(seeds)
    assert not found.failures, '\n'.join([*found.failures, report(found)])
    # The judges must have judged: most tops all the way.
    assert found.counts['integrated'] > 0.85 * len(seeds)
    assert found.counts['rk45: q'] > 0.8 * len(seeds)


# ------------------------------------------------------------------------------ edge inputs

def answer(top, start, t, **method):
    return extremes.answer({**top, **start}, {'method': 'exact', **method}, t)


def assert_same_attitude(one, other, bound):
    assert np.abs(one.quaternion - other.quaternion).max() <= bound


@pytest.mark.parametrize('method', METHODS[:2], ids=('exact', 'transport'))
@pytest.mark.parametrize('power', [-500, -100, 100, 480])
def test_the_motion_is_the_same_at_every_scale_of_mass_and_of_time(power, method):
    base = answer(TOP, START, [0.5, 1.0], **method)
    by = 2.0 ** power
    heavier = {**TOP, 'lambda1': by * 0.123, 'lambda3': by * 0.15, 'mass': by * 2.0}
    motion = answer(heavier, {**START, 'l3': by * 1.6, 'lz': by * 1.1}, [0.5, 1.0], **method)
    if motion is not None:
        assert_same_attitude(motion, base, 2.0 * EXACT)
    assert motion is not None or abs(power) > 400
    by = 2.0 ** (power // 4)
    quick = {**START, 'theta_dot': by * 0.4, 'l3': by * 1.6, 'lz': by * 1.1}
    motion = answer({**TOP, 'gravity': by * by * 9.8}, quick, np.array([0.5, 1.0]) / by, **method)
    assert motion is not None
    assert_same_attitude(motion, base, 2.0 * EXACT)


NEXT_TO_PI = math.nextafter(math.pi, 0.0)


@pytest.mark.parametrize('theta', [0.0, 1e-300, 1e-160, 1e-20, 1e-12, math.pi, NEXT_TO_PI])
@pytest.mark.parametrize('theta_dot', [0.0, 1e-160, 1e-20, 0.3])
@pytest.mark.parametrize('l3', [0.0, 0.3, 5.0])
def test_starts_at_the_poles_and_next_to_them_are_right_or_refused(theta, theta_dot, l3):
    """
    With Lz = L3 (-L3 below) the start is regular however near the pole is.

    An exponent k = sqrt(P/lambda1) = 4.9/s carries a start of 1e-16 to 1e-11 within 2 s, and
    what is beneath it may as well be 0.
    """
    start = {'theta': theta, 'theta_dot': theta_dot, 'phi': 0.3, 'psi': -1.2, 'l3': l3,
             'lz': l3 if theta < 1.0 else -l3}
    t = np.array([0.0, 0.7, 2.0])
    exact = answer(TOP, start, t)
    stepped = answer(TOP, start, t, method='rk45', rtol=1e-9)
    assert stepped is not None
    if theta < 1e-19 and theta_dot < 1e-19:
        rest = answer(TOP, {**start, 'theta': 0.0, 'theta_dot': 0.0}, t)
        assert_same_attitude(stepped, rest, 1e-7)       # some 100 steps of 1e-9
        if exact is not None:
            assert_same_attitude(exact, rest, 1e-14)    # 1e-20 exp(2 k), and rounding
    elif exact is not None:
        assert_same_attitude(stepped, exact, 1e-6)
        for name in ('theta', 'phi', 'psi'):
            if theta_dot > 1e-3 or theta >= 1e-12:
                sine = np.sin(exact.theta_folded)
                told = sine > 1e-4
                assert getattr(stepped, name)[told] == pytest.approx(
                    getattr(exact, name)[told], abs=1e-2)
    # m1, the distance to the separatrix, goes with the squares: refused below 1e-290.
    assert exact is not None or 0.0 < theta < 1e-145 or 0.0 < theta_dot < 1e-144


@pytest.mark.parametrize('t', [[1e9, -1e9, 0.0], [0, 1, 10 ** 9], (0.5, 1), range(3), [],
                               np.array([1], dtype=np.int8), [5e-324, -5e-324]])
def test_times_of_any_kind(t):
    motion = answer(TOP, START, t)
    assert motion.quaternion.shape == (len(t), 4) and motion.phi_dot.shape == (len(t),)
    ns = np.array([round(float(instant) * 1e9) for instant in t], np.int64)
    by_ns = ExactSolution(Top(**TOP), State(**START)).states(ns)
    assert np.abs(motion.quaternion - by_ns.quaternion).max(initial=0.0) <= 2.0 * EXACT


def test_a_time_beyond_patience_is_refused_at_once():
    with time_limit(5.0), pytest.raises(IntegrationError, match=r"steps of .* 'exact'"):
        solve(Top(**TOP), State(**START), [1e12], method='rk45')


# ------------------------------------------------------------- what random tops have broken

def test_planar_rates_are_columns():
    motion = answer(TOP, {**START, 'l3': 0.0, 'lz': 0.0}, [0.0, 1.0])
    assert motion.phi_dot.tolist() == motion.psi_dot.tolist() == [0.0, 0.0]


def test_next_to_a_pole_an_axis_that_swings_does_not_rest():
    start = {**START, 'theta': 1e-15, 'theta_dot': 0.0}
    start['lz'] = math.nextafter(start['l3'], 0.0)
    exact = answer(TOP, start, [0.3])
    assert exact.theta[0] > 0.05
    assert_same_attitude(answer(TOP, start, [0.3], method='rk45', rtol=1e-9), exact, 1e-6)


def test_states_keep_their_angles_when_the_steps_go_on():
    """And are forgotten: the columns are computed when they are first asked for."""
    stepped = propagate(Top(**TOP), State(**START), method='rk45')
    t = np.linspace(0.0, 20.0, 11)
    states = [stepped.states_at_seconds(t[i:i + 1]) for i in range(11)]
    stepped.release(20 * 10 ** 9)
    exact = answer(TOP, START, t)
    for name in ('theta', 'phi', 'psi'):
        assert [getattr(s, name)[0] for s in states] == pytest.approx(getattr(exact, name),
                                                                      abs=1e-7)


def test_omega_3_has_no_rounding_of_the_whole_momentum():
    top = {**TOP, 'lambda1': 1e9}
    motion = answer(top, START, [0.5], method='rk45', rtol=1e-6)
    assert motion.angular_velocity[0, 2] == START['l3'] / TOP['lambda3']


# ------------------------------------------------------------------------ continued branches

CONTINUED = [-0.3, -1.5, math.pi + 0.4, 2.0 * math.pi - 0.1, 2.0 * math.pi + 0.2, -7.0, 9.5,
             -math.pi - 0.1, 100.3, -40.0]


MOMENTA = (0.0, 0.0), (1.6, 1.6), (1.6, -1.6), (0.0, 0.9), (1.6, 1.1)
# Every pair of gravity and momenta, with branches in turn.
BRANCHES = [(CONTINUED[(3 * i + k) % 10], momenta, gravity)
            for i, momenta in enumerate(MOMENTA) for k, gravity in enumerate((9.8, -9.8, 0.0))]


@pytest.mark.parametrize(('theta', 'momenta', 'gravity'), BRANCHES)
def test_both_methods_go_on_from_any_branch(theta, momenta, gravity):
    """A motion that was commanded after its axis went over the top, any number of times."""
    l3, lz = momenta
    top = Top(**{**TOP, 'gravity': gravity})
    start = ContinuedState(theta=theta, theta_dot=5.5, phi=3.3, psi=-11.2, l3=l3, lz=lz)
    step = min(0.02, 0.3 / natural_rate(top, start))
    t = np.arange(0.0, 2.0, step)
    exact, stepped = (propagate(top, start, method=method, rtol=1e-11).states_at_seconds(t)
                      for method in ('exact', 'rk45'))
    for states in (exact, stepped):
        assert math.dist(states.quaternion[0], attitude_of(start)) < 1e-13
        assert states.theta_dot[0] == pytest.approx(start.theta_dot,
                                                    abs=1e-13 * natural_rate(top, start))
        for name in ('theta', 'phi', 'psi'):
            assert getattr(states, name)[0] == pytest.approx(getattr(start, name), abs=1e-12)
    # A turn of 0.3 and what the body adds, far from the 2 of a change of sign.
    assert np.linalg.norm(np.diff(exact.quaternion, axis=0), axis=1).max() < 0.5
    assert np.linalg.norm(exact.quaternion - stepped.quaternion, axis=1).max() < 1e-7
    away = np.abs(np.sin(exact.theta)) > 1e-3
    for name in ('theta', 'phi', 'psi'):
        assert getattr(exact, name)[away] == pytest.approx(getattr(stepped, name)[away], abs=1e-4)


def attitude_of(start):
    """Return x, y, z, w from Euler angles, of any branch."""
    c, s = math.cos(0.5 * start.theta), math.sin(0.5 * start.theta)
    half_sum, half_difference = 0.5 * (start.phi + start.psi), 0.5 * (start.phi - start.psi)
    return (-s * math.sin(half_difference), s * math.cos(half_difference),
            c * math.sin(half_sum), c * math.cos(half_sum))


@pytest.mark.parametrize('method', ['rk45', 'exact'])
@pytest.mark.parametrize('scene', ['planar_pendulum', 'near_separatrix', 'waking_sleeper',
                                   'spherical_pendulum', 'cusp', 'free_top'])
def test_commands_at_random_times_leave_the_attitude_as_it_is(scene, method):
    """And what follows is the exact motion from there, on the same branch."""
    random = np.random.default_rng(len(scene))
    values = parameters.checked({**scene_parameters(scene), 'solver.method': method})
    simulation = LiveSimulation(values)
    scale = abs(values['spin.l3']) or 1.0
    now = 0
    for _ in range(12):
        now += int(random.integers(1, 700_000_000))
        assert simulation.advance(now)
        before = simulation.state()
        l3, lz = (float(x) for x in scale * random.uniform(-2.0, 2.0, 2))
        lz = {0: lz, 1: l3, 2: -l3}[int(random.integers(0, 3))]
        if abs(math.sin(before.theta[0])) < 0.1:    # else by 1/sin(theta) too fast for a test
            lz = l3 if math.cos(before.theta[0]) > 0.0 else -l3
        if random.integers(0, 4) == 0:
            l3 = lz = 0.0
        simulation.command(l3, lz)
        after = simulation.state()
        assert (simulation.l3, simulation.lz) == (l3, lz)
        assert after.lz[0] == lz
        omega1, omega2, omega3 = after.angular_velocity[0]
        assert omega3 == l3 / simulation.top.lambda3
        total = math.hypot(simulation.top.lambda1 * math.hypot(omega1, omega2), l3)
        assert after.l3[0] == pytest.approx(l3, rel=0.0, abs=1e-14 * total)
        # Where a pole is crossed the angles are of the ideal line, and steps of 1e-11 beside it.
        assert math.dist(after.quaternion[0], before.quaternion[0]) < 1e-9
        for name in ('theta', 'theta_dot', 'phi', 'psi'):
            assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-9)
        truth = ExactSolution(simulation.top, simulation.segment.start)
        for later in (1_000_000, 50_000_000, 200_000_000):
            simulation.advance(now + later)
            exact = truth.states(range(later, later + 1))
            assert math.dist(simulation.state().quaternion[0], exact.quaternion[0]) < 1e-7
        now += 200_000_000


def test_a_command_and_the_command_back_are_as_if_nothing_had_been():
    for method in ('rk45', 'exact'):
        values = parameters.checked({**scene_parameters('spherical_pendulum'),
                                     'solver.method': method})
        commanded, left_alone = LiveSimulation(values), LiveSimulation(values)
        for simulation in (commanded, left_alone):
            simulation.advance(1_234_567_891)
        l3, lz = commanded.l3, commanded.lz
        commanded.command(l3 + 1.0, lz - 0.5)
        commanded.command(l3, lz)
        for simulation in (commanded, left_alone):
            simulation.advance(6_000_000_000)
        one, other = commanded.state(), left_alone.state()
        assert math.dist(one.quaternion[0], other.quaternion[0]) < 1e-8
        assert one.phi[0] == pytest.approx(other.phi[0], abs=1e-8)


def test_a_sleeping_top_takes_commands_of_its_pole_only():
    for method in ('rk45', 'exact'):
        values = parameters.checked({**scene_parameters('sleeping'), 'solver.method': method})
        simulation = LiveSimulation(values)
        simulation.advance(777_000_000)
        before = simulation.state()
        with pytest.raises(ValueError, match=r'lz = .*pole'):
            simulation.command(2.0, 1.9)
        assert (simulation.state().quaternion == before.quaternion).all()
        simulation.command(2.0, 2.0)
        assert math.dist(simulation.state().quaternion[0], before.quaternion[0]) < 1e-14


# ------------------------------------------------------------------- symmetries of the steps

def stepped_and_changed(seed, change):
    """Return states of 2 nutations by rk45 and of the changed top, with their evaluations."""
    case = random_case(seed)
    period = ExactSolution(case.top, case.start).nutation_period
    if period is None or case.start.theta in (0.0, math.pi):
        return None
    t = np.array([0.3, 1.1, 2.0]) * period
    result = []
    for top, start, times in ((case.top, case.start, t), change(case.top, case.start, t)):
        motion = propagate(top, start, method='rk45', rtol=1e-9, atol=1e-10)
        result += [motion.states_at_seconds(times), motion]
    return result


def heavier(top, start, t):
    return (replace(top, lambda1=8.0 * top.lambda1, lambda3=8.0 * top.lambda3,
                    mass=8.0 * top.mass),
            replace(start, l3=8.0 * start.l3, lz=8.0 * start.lz), t)


def faster(top, start, t):
    return (replace(top, gravity=16.0 * top.gravity),
            replace(start, theta_dot=4.0 * start.theta_dot, l3=4.0 * start.l3,
                    lz=4.0 * start.lz), 0.25 * t)


def mirrored(top, start, t):
    return top, replace(start, phi=-start.phi, psi=-start.psi, l3=-start.l3, lz=-start.lz), t


@pytest.mark.parametrize(('change', 'signs'), [
    (heavier, (1.0, 1.0, 1.0, 1.0)), (faster, (1.0, 1.0, 1.0, 1.0)),
    (mirrored, (-1.0, 1.0, -1.0, 1.0))])
def test_steps_of_a_scaled_or_mirrored_top_are_the_same_to_the_last_bit(change, signs):
    """Powers of 2 and signs do not round: so no absolute tolerance and no handedness hides."""
    compared = 0
    for seed in range(60):
        pair = stepped_and_changed(seed, change)
        if pair is None:
            continue
        one, motion, other, changed = pair
        assert np.array_equal(one.quaternion, other.quaternion * signs), random_case(seed)
        assert motion.evaluations == changed.evaluations
        compared += 1
    assert compared > 40


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_a_motion_turned_upside_down_or_restarted_is_the_same(method):
    """
    With theta -> pi - theta, psi -> -psi, L3 -> -L3, P -> -P; and from any state on.

    Both round the start, which grows as neighbours do: by a thousand at most where this is
    tried, away from the separatrix (m1 > 1e-2).
    """
    bound, compared = {'exact': 1e-11, 'rk45': 1e-5}[method], 0
    for seed in range(100):
        case = random_case(seed)
        top, start = case.top, case.start
        solution = ExactSolution(top, start)
        tilted = 1e-3 < start.theta < math.pi - 1e-3
        if not solution.nutation_period or solution.m1 < 1e-2 or not tilted:
            continue
        t = np.array([0.3, 1.1, 2.0]) * solution.nutation_period
        motion = solve(top, start, t, method=method, rtol=1e-9)
        turned = replace(start, theta=math.pi - start.theta, theta_dot=-start.theta_dot,
                         psi=-start.psi, l3=-start.l3)
        other = solve(replace(top, com_distance=-top.com_distance), turned, t, method=method,
                      rtol=1e-9)
        x, y, z, w = other.quaternion.T         # theta and psi as above: alpha and beta change
        assert np.abs(np.stack((-z, w, -x, y), -1) - motion.quaternion).max() <= bound, case
        middle = state_of(case, motion, 1)
        if middle is not None:
            again = solve(top, middle, t[1:] - t[1], method=method, rtol=1e-9)
            apart = [min(np.abs(p - q).max(), np.abs(p + q).max()) for p, q in zip(
                again.quaternion, motion.quaternion[1:], strict=True)]
            # The angles of the start are large numbers in some tops, and rounded.
            rounded = math.ulp(abs(middle.phi) + abs(middle.psi))
            assert max(apart) <= bound + rounded, case
        compared += 1
    assert compared > 25
