# SPDX-License-Identifier: Apache-2.0
"""
Random tops, symmetries, edge inputs and continued branches: what must hold for every motion.

STRESS_TOPS=100000 in the environment takes as many random tops; `python test/stress tops` does the
same on all processors and tells the worst cases.
"""

import math
import os

import numpy as np
import pytest
import test_extremes as extremes
from helpers.reference import scene_parameters
from stress.tops import EXACT, blocks, check_block, natural_rate, report
from test_extremes import METHODS, START, TOP

from spinning_top_sim import Top
from spinning_top_sim.physics.attitude import quaternion_of_angles
from spinning_top_sim.physics.top import ContinuedState
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.propagator import propagate
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.live import LiveSimulation

TOPS = int(os.environ.get('STRESS_TOPS', '44'))


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
@pytest.mark.parametrize('power', [-500, 100, 480])
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


@pytest.mark.parametrize('theta', [0.0, 1e-160, 1e-20, math.pi, math.nextafter(math.pi, 0)])
@pytest.mark.parametrize('theta_dot', [0.0, 1e-160, 0.3])
@pytest.mark.parametrize('l3', [0.0, 5.0])
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
        assert math.dist(states.quaternion[0], quaternion_of_angles(
            start.phi, start.theta, start.psi)) < 1e-13
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


@pytest.mark.parametrize('method', ['rk45', 'exact'])
@pytest.mark.parametrize('scene', ['planar_pendulum', 'waking_sleeper', 'cusp'])
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
