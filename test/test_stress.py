# SPDX-License-Identifier: Apache-2.0
"""Continued branches after commands, and seeds of the parts of `make stress`."""

import importlib
import math

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, simulate
from helpers.wrong_filters import TABLE

from spinning_top_sim.physics.top import ContinuedState
from spinning_top_sim.solvers.exact import ExactSolution


def momenta(random, scale, theta):
    l3, lz = (float(x) for x in scale * random.uniform(-2.0, 2.0, 2))
    lz = {0: lz, 1: l3, 2: -l3}[int(random.integers(0, 3))]
    if abs(math.sin(theta)) < 0.1:      # else by 1/sin(theta) too fast for a test
        lz = l3 if math.cos(theta) > 0.0 else -l3
    return (0.0, 0.0) if random.integers(0, 4) == 0 else (l3, lz)


@pytest.mark.parametrize('method', ['rk45', 'exact'])
@pytest.mark.parametrize('scene', ['planar_pendulum', 'waking_sleeper', 'cusp'])
def test_commands_at_random_times_leave_the_attitude_as_it_is(scene, method):
    """And what follows is the exact motion from there, on the same branch."""
    random = np.random.default_rng(len(scene))
    simulation = simulate({**scene_parameters(scene), 'solver.method': method})
    top, scale = simulation.trajectory.top, abs(simulation.values['spin.l3']) or 1.0
    now = 0
    for _ in range(12):
        now += int(random.integers(1, 700 * MILLISECOND))
        assert simulation.send(now)
        before = simulation.state()
        l3, lz = momenta(random, scale, before.theta[0])
        simulation.apply('command', l3=l3, lz=lz)
        after = simulation.state()
        assert (*simulation.trajectory.momenta(now), after.lz[0]) == (l3, lz, lz)
        omega1, omega2, omega3 = after.angular_velocity[0]
        assert omega3 == l3 / top.lambda3
        total = math.hypot(top.lambda1 * math.hypot(omega1, omega2), l3)
        assert after.l3[0] == pytest.approx(l3, rel=0.0, abs=1e-14 * total)
        # Where a pole is crossed the angles are of the ideal line, and steps of 1e-11 beside it.
        assert math.dist(after.quaternion[0], before.quaternion[0]) < 1e-9
        for name in ('theta', 'theta_dot', 'phi', 'psi'):
            assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-9)
        truth = ExactSolution(top, ContinuedState(l3=l3, lz=lz, **{
            name: float(getattr(after, name)[0])
            for name in ('theta', 'theta_dot', 'phi', 'psi')}))
        later = np.array([1, 50, 200]) * MILLISECOND
        assert np.abs(simulation.trajectory.evaluate(now + later).quaternion
                      - truth.states(later).quaternion).max() < 1e-7
        now += int(later[-1])
        assert simulation.send(now)


@pytest.mark.parametrize(('part', 'seed'), [
    *(('logs', seed) for seed in range(6)), *(
    ('wrong', [*TABLE].index(one)) for one in (
        'mahony, slow from the identity', 'field of a level sensor', 'no tilt about y',
        'bias clamped', 'covariance x 50'))])
def test_a_seed_of_a_part_of_make_stress(tmp_path, part, seed):
    if part == 'logs':
        pytest.importorskip('rclpy')
    assert importlib.import_module(f'stress.{part}').check(seed, tmp_path)
