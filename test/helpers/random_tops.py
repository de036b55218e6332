# SPDX-License-Identifier: Apache-2.0
"""
Random tops, seeded: log-uniform over decades, and dense on every special case of the theory.

`random_case(seed)` is the same case for ever, so a failure is named by its seed alone.
"""

import math
import random

from spinning_top_sim import State, Top


def random_case(seed):
    """Return a top and its start."""
    draw = random.Random(seed)

    def log(low, high):
        return 10.0 ** draw.uniform(low, high)

    def signed(x):
        return draw.choice((x, -x))

    def close_to(x):
        return x * draw.choice((1.0, 1.0 + signed(log(-16, -2))))

    lambda1 = log(-6, 3)
    top = Top(lambda1=lambda1, lambda3=lambda1 * log(-2, 0.7), mass=log(-3, 3),
              com_distance=signed(log(-3, 1)), gravity=draw.choice((*9 * (log(-1, 2),), 0.0)))
    # In its natural units: w0 of rates and l0 of momenta.
    torque = top.gravity_torque or lambda1
    w0, l0 = math.sqrt(abs(torque) / lambda1), math.sqrt(lambda1 * abs(torque))
    theta = draw.choice((*3 * (draw.uniform(1e-3, math.pi - 1e-3),), 0.0, math.pi, log(-16, -1),
                         math.pi - log(-15.5, -1)))
    cosine, sine, half = math.cos(theta), math.sin(theta), 0.5 * theta
    # None; about that of an upright top that sleeps; any; fast.
    l3 = signed(l0 * draw.choice((0.0, draw.uniform(0.0, 4.0), log(-2, 2), log(0.8, 4.3))))
    # In slow steady precession, or what takes its place where there is none.
    square = l3 * l3 - 4.0 * lambda1 * torque * cosine
    steady = l3 * cosine + 2.0 * lambda1 * torque * sine * sine / (
        l3 + math.copysign(math.sqrt(abs(square)), l3) or l0)
    # To a pole or close by, with a cusp, in steady precession, or any.
    lz = draw.choice((close_to(l3), close_to(-l3), close_to(l3 * cosine), close_to(steady),
                      l3 * cosine + signed(l0 * log(-3, 1)) * sine))
    lz = {0.0: l3, math.pi: -l3}.get(theta, lz)
    # At rest, on the way to the upright position, or any.
    square = abs(4.0 * torque / lambda1 * math.sin(half) ** 2 - (l3 / lambda1) ** 2 * (
        math.tan(half) ** 2 if theta < 3.0 else 0.0))
    theta_dot = draw.choice((0.0, close_to(math.sqrt(square)), w0 * log(-12, -1), w0 * log(-1, 1)))
    return top, State(theta=theta, theta_dot=signed(theta_dot), phi=draw.uniform(-10.0, 10.0),
                      psi=draw.uniform(-10.0, 10.0), l3=l3, lz=lz)
