# SPDX-License-Identifier: Apache-2.0
"""
Continued branches after commands, and seeds of the parts of test/stress.

STRESS=100 pytest test/test_stress.py -k logs tries so many seeds of a part.
"""

import faulthandler
import importlib
import math
import os
import resource
from pathlib import Path

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, simulate

from spinning_top_sim.physics.top import ContinuedState
from spinning_top_sim.solvers.exact import ExactSolution

SEEDS = {'logs': range(6), 'grade': (), 'wrong': ()}      # the others take minutes
if count := int(os.environ.get('STRESS', '0')):
    SEEDS = dict.fromkeys(SEEDS, range(count))


@pytest.mark.parametrize('method', ['rk45', 'exact'])
@pytest.mark.parametrize('scene', ['planar_pendulum', 'waking_sleeper', 'cusp'])
def test_commands_at_random_times_leave_the_attitude_as_it_is(scene, method):
    """And what follows is the exact motion from there, on the same branch."""
    random = np.random.default_rng(len(scene))
    simulation = simulate({**scene_parameters(scene), 'solver.method': method})
    top, scale = simulation.trajectory.top, abs(simulation.values_at_start['spin.l3']) or 1.0
    later = np.array([1, 50, 200]) * MILLISECOND
    for _ in range(12):
        now = simulation.now_ns + int(random.integers(1, 700 * MILLISECOND))
        assert simulation.send(now)
        before = simulation.state()
        l3, lz = map(float, scale * random.uniform(-2.0, 2.0, 2))
        if abs(math.sin(before.theta[0])) < 0.1:    # else by 1/sin(theta) too fast for a test
            lz = math.copysign(l3, l3 * math.cos(before.theta[0]))
        simulation.apply('command', l3=l3, lz=lz)
        after = simulation.state()
        assert (*simulation.trajectory.momenta(now), after.lz[0]) == (l3, lz, lz)
        # Where a pole is crossed the angles are of the ideal line, and steps of 1e-11 beside it.
        assert math.dist(after.quaternion[0], before.quaternion[0]) < 1e-9
        angles = {name: float(getattr(after, name)[0])
                  for name in ('theta', 'theta_dot', 'phi', 'psi')}
        for name, angle in angles.items():
            assert angle == pytest.approx(float(getattr(before, name)[0]), abs=1e-9)
        truth = ExactSolution(top, ContinuedState(l3=l3, lz=lz, **angles))
        assert np.abs(simulation.trajectory.evaluate(now + later).quaternion
                      - truth.states(later).quaternion).max() < 1e-7
        assert simulation.send(now + int(later[-1]))


@pytest.fixture
def limited():
    """Return what bounds the memory of this process, and its time: then it dies."""
    before = resource.getrlimit(resource.RLIMIT_AS)

    def limit(part):
        mapped = resource.getpagesize() * int(Path('/proc/self/statm').read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (
            mapped + part.MEMORY_MB * 1_000_000, before[1]))
        faulthandler.dump_traceback_later(part.PATIENCE_S, exit=True)

    yield limit
    faulthandler.cancel_dump_traceback_later()
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize(('part', 'seed'), [
    (part, seed) for part, seeds in SEEDS.items() for seed in seeds])
def test_a_seed_of_a_part_of_make_stress(tmp_path, limited, part, seed):
    module = importlib.import_module(f'stress.{part}')
    limited(module)
    module.check(seed, tmp_path)
