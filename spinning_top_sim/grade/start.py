# SPDX-License-Identifier: Apache-2.0
"""The start of a known top, from the first attitudes."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from spinning_top_sim.grade import guess
from spinning_top_sim.grade.fit import Fit, attitudes_of, descend, first_values
from spinning_top_sim.grade.problem import L3, MOTION, SPIN, P, Problem
from spinning_top_sim.grade.scenes import Reals, Start
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution

BEGIN = 64      # attitudes that tell a start, whatever follows
OFF = 0.1       # rad, or share of the rates: another start


def start_of(found: Fit, parts: Mapping[str, tuple[Reals, Reals]], top: Top) -> State:
    """Return the start of a known top: the fitted one, or if none was found that of the begin."""
    if found.reached:
        start = Start.of(found.top, found.start)
        return Start(start.attitude, start.rates).state_of(top)
    one, _ = attitudes_of(parts)
    first = replace(one, times=one.times[:BEGIN], values=one.values[:, :BEGIN])
    problem, (x, _) = Problem([first], one.values[:, 0], top.gravity), first_values(one, parts)
    x[P] = top.gravity_torque / top.lambda1
    for _ in range(3):
        x[L3] = top.lambda3 / top.lambda1 * x[SPIN]
        x, _ = descend(problem, x, MOTION[:6])
    _, state = problem.start(x)
    return replace(state, l3=state.l3 * top.lambda1, lz=state.lz * top.lambda1)


def near_start(parts: Mapping[str, tuple[Reals, Reals]], top: Top, start: State) -> str:
    """Return how far the attitudes are from a start at t = 0, '' if they are near it."""
    one, begin = attitudes_of(parts)
    q = one.values
    first = ExactSolution(top, start).states_at_seconds(np.array([begin]))
    apart = float(attitude.angle_between(first.rows_quaternion, tuple(q[:, :1]))[0])
    axis = np.stack(attitude.axis_in_world(tuple(q)))
    w1, w2, error = guess.transverse_rates(one.times, q, axis)
    right = first.angular_velocity[0]
    spin, _ = guess.spin_rate(one.times, q, float(right[2]))
    off = math.dist((w1, w2, spin), right)
    noise = 6.0 * error
    if apart <= OFF + noise * float(one.times[1]) and off <= OFF * np.linalg.norm(right) + noise:
        return ''
    return (f'at its begin the attitude is {math.degrees(apart):.3g} deg off, the rates '
            f'{off:.3g} rad/s')
