# SPDX-License-Identifier: Apache-2.0
"""
Measure the time of the exact solution, compared with integrators.

    python benchmark/exact_cost.py [--rounds 21]

Every figure is the median over interleaved rounds: each round runs everything once, so that a
busy machine slows all of them alike.  Ratios are relative to heyoka's Taylor integrator on the
same motion and the same 1 kHz grid, raw: its six unknowns, without the product that turns them
into the attitude of the body.  heyoka and scipy are optional; a missing one is reported.
"""

import argparse
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution

UNIT = Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=0.5, gravity=9.8)
SMALL = Top(lambda1=0.002, lambda3=0.001, mass=0.5, com_distance=0.05, gravity=9.81)
MOTIONS = {
    'cusp, 200 rad/s': (SMALL, State(theta=math.pi / 6, l3=0.2, lz=0.2 * math.cos(math.pi / 6))),
    'cusp, 60 rad/s': (SMALL, State(theta=math.pi / 6, l3=0.06, lz=0.06 * math.cos(math.pi / 6))),
    'looping': (UNIT, State(theta=0.6, l3=6.0, lz=4.47)),
    'slow spin': (UNIT, State(theta=0.6, l3=1.5, lz=1.5 * math.cos(0.6))),
    'slow spin, m1 = 0.03': (UNIT, State(theta=0.35, l3=0.3, lz=0.3 * math.cos(0.35))),
    'separatrix, m1 = 3e-17': (UNIT, State(theta=1e-8, l3=1.0, lz=1.0)),
    'pole crossing': (UNIT, State(theta=0.4, theta_dot=-6.0, l3=2.0, lz=2.0)),
    'planar rotation': (UNIT, State(theta=2.0, theta_dot=7.0, l3=0.0, lz=0.0)),
    'upside down': (Top(lambda1=1.0, lambda3=0.5, mass=1.0, com_distance=-0.5, gravity=9.8),
                    State(theta=0.6, l3=6.0, lz=4.47)),
}
ARRAY = 100_000
STEP_NS = 1_000_000
GRID = range(0, ARRAY * STEP_NS, STEP_NS)


def exact_jobs(top, state):
    """Yield the name of each job, the function to run, and the number of its states."""
    solution = ExactSolution(top, state)
    t = np.random.default_rng(1).uniform(0.0, 100.0, ARRAY)

    def all_columns():
        states = solution.states_at_seconds(t)
        return (states.rows_quaternion, states.theta, states.theta_dot, states.phi, states.psi,
                states.rows_angular_velocity)
    yield 'set-up', lambda: ExactSolution(top, state), 1
    yield ('quaternions, any times', lambda: solution.states_at_seconds(t).rows_quaternion,
           ARRAY)
    # What `simulate` does.
    yield 'quaternions, grid', lambda: solution.states(GRID).rows_quaternion, ARRAY
    yield 'full states, any times', all_columns, ARRAY


def quadratic_start(top, state):
    """Return w, x, y, z, Lx, Ly at the start: the unknowns of `derivative`."""
    s, c = math.sin(state.theta), math.cos(state.theta)
    across = (state.lz - state.l3 * c) / s
    p = [math.cos(state.theta / 2), 0.0, math.sin(state.theta / 2), 0.0]
    return [*p, state.l3 * s - across * c, top.lambda1 * state.theta_dot]


def derivative(top, state, v):
    """Right-hand side in w, x, y, z, Lx, Ly; of floats or of heyoka's expressions."""
    w, x, y, z, lx, ly = v
    n1, n2 = 2 * (x * z + w * y), 2 * (y * z - w * x)
    n3 = w * w - x * x - y * y + z * z
    o1, o2, o3 = ((momentum - state.l3 * n) / top.lambda1
                  for momentum, n in ((lx, n1), (ly, n2), (state.lz, n3)))
    return [0.5 * (-o1 * x - o2 * y - o3 * z), 0.5 * (o1 * w + o2 * z - o3 * y),
            0.5 * (o2 * w + o3 * x - o1 * z), 0.5 * (o3 * w + o1 * y - o2 * x),
            -top.gravity_torque * n2, top.gravity_torque * n1]


def heyoka_job(heyoka, top, state):
    variables = heyoka.make_vars('w', 'x', 'y', 'z', 'lx', 'ly')
    begin = quadratic_start(top, state)
    integrator = heyoka.taylor_adaptive(
        list(zip(variables, derivative(top, state, variables), strict=True)), begin)
    t = np.arange(ARRAY + 1) * (STEP_NS * 1e-9)

    def run():
        integrator.time = 0.0
        integrator.state[:] = begin
        integrator.propagate_grid(t)
    return 'heyoka, raw', run, ARRAY


def scipy_job(solve_ivp, top, state):
    begin, count = quadratic_start(top, state), 2000
    t = np.arange(count) * (STEP_NS * 1e-9)
    return 'scipy DOP853 1e-9', lambda: solve_ivp(
        lambda _, v: derivative(top, state, v), (0.0, t[-1]), begin, method='DOP853',
        rtol=1e-9, atol=1e-9, t_eval=t), count


def peers():
    """Import the optional packages; report a missing one."""
    try:
        import heyoka
    except ImportError:
        heyoka = None
        print('heyoka: missing (pip install heyoka)')
    try:
        from scipy.integrate import solve_ivp
    except ImportError:
        solve_ivp = None
        print('scipy: missing (pip install scipy)')
    return heyoka, solve_ivp


def seconds(run):
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def report(seconds_per_state):
    for unit, scale in (('s', 1.0), ('ms', 1e3), ('us', 1e6)):
        if seconds_per_state * scale >= 0.95:
            return f'{seconds_per_state * scale:9.2f} {unit}'
    return f'{seconds_per_state * 1e9:9.1f} ns'


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--rounds', type=int, default=21)
    rounds = parser.parse_args().rounds
    heyoka, solve_ivp = peers()
    print(f'Python {sys.version.split()[0]}, numpy {np.__version__}, '
          f'medians of {rounds} interleaved rounds, per state\n')
    for name, (top, state) in MOTIONS.items():
        jobs = list(exact_jobs(top, state))
        if heyoka:
            jobs.append(heyoka_job(heyoka, top, state))
        if solve_ivp:
            jobs.append(scipy_job(solve_ivp, top, state))
        runs = [[seconds(run) / count for _, run, count in jobs] for _ in range(rounds)]
        medians = {job[0]: statistics.median(column)
                   for job, column in zip(jobs, zip(*runs, strict=True), strict=True)}
        raw = medians.get('heyoka, raw')
        print(name)
        for job, median in medians.items():
            ratio = f'{median / raw:10.2f} x heyoka' if raw and job != 'set-up' else ''
            print(f'    {job:24s}{report(median)}{ratio}')


if __name__ == '__main__':
    main()
