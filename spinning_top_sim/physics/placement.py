# SPDX-License-Identifier: Apache-2.0
"""A top that is put somewhere: its state from pose and twist."""

import math

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top

Reals = NDArray[np.float64]
# An axis nearer to a vertical than this [rad] counts as vertical.  The rounding of Lz changes the
# angular velocity of a tilted axis by some 1e-16 L3/(lambda1 theta), relative to L3/lambda1 here
# as much as the tilt that is left out.
POLE_IN_DOUBLES = 1.5e-8


def state_of(top: Top, quaternion: Reals, angular_velocity: Reals) -> State:
    """
    Return the state of a top with this attitude and angular velocity.

    A vertical axis has no precession angle of its own: there the angle is that of the line about
    which the axis turns, so that all of this motion is nutation.

    quaternion : (4,) q(world <- body) as x, y, z, w, of any length but 0; the sum and the
        difference of phi and psi belong to its sign
    angular_velocity : (3,) in the world frame [rad/s]
    """
    x, y, z, w = (quaternion / np.linalg.norm(quaternion)).tolist()
    wx, wy, wz = angular_velocity.tolist()
    theta = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    half_sum, half_difference = math.atan2(z, w), math.atan2(-x, y)
    if math.sin(theta) < POLE_IN_DOUBLES:
        phi = math.atan2(-wx, wy) if wx or wy else 0.0
        if theta < 1.0:
            theta, psi, sign = 0.0, 2.0 * half_sum - phi, 1.0
        else:
            theta, psi, sign = math.pi, phi - 2.0 * half_difference, -1.0
        lz = top.lambda3 * wz
        return State(theta=theta, theta_dot=math.hypot(wx, wy), phi=phi, psi=psi, l3=sign * lz,
                     lz=lz)
    columns = np.array([x]), np.array([y]), np.array([z]), np.array([w])
    w1, w2, w3 = (float(part[0]) for part in attitude.rotated_back(columns, (wx, wy, wz)))
    z1, z2, z3 = (float(part[0]) for part in attitude.vertical_in_body(columns))
    phi, l3 = half_sum + half_difference, top.lambda3 * w3
    return State(theta=theta, theta_dot=wy * math.cos(phi) - wx * math.sin(phi), phi=phi,
                 psi=half_sum - half_difference, l3=l3,
                 lz=top.lambda1 * (w1 * z1 + w2 * z2) + l3 * z3)
