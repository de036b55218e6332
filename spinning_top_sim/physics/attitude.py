# SPDX-License-Identifier: Apache-2.0
"""
Attitude mathematics of the top in unit quaternions, regular at every attitude.

The unit quaternion (x, y, z, w) of the body in the world holds the Cayley-Klein parameters of
Klein & Sommerfeld, *Theorie des Kreisels*, ch. I:

    alpha = w + i z = cos(theta/2) exp(i (phi + psi)/2),
    beta  = y - i x = sin(theta/2) exp(i (phi - psi)/2).

Functions take and return columns (n,), and tuples of such for vectors and quaternions.  They use
elementwise real arithmetic only: a value does not depend on the other values in its column.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.top import Top

Column = NDArray[np.float64]
# Components x, y, z of a vector; an entry that is the same for all samples may be a float.
Vector = tuple[Column | float, Column | float, Column | float]
# Components x, y, z, w, the order of ROS and SciPy.
Quaternion = tuple[Column, Column, Column, Column]
Number = TypeVar('Number', float, Column)


def quaternion_of_angles(phi: Column, theta: Column, psi: Column) -> Quaternion:
    """Return q(world <- body) of ZYZ Euler angles [rad]."""
    half_sum, half_difference = 0.5 * (phi + psi), 0.5 * (phi - psi)
    cosine, sine = np.cos(0.5 * theta), np.sin(0.5 * theta)
    return (-sine * np.sin(half_difference), sine * np.cos(half_difference),
            cosine * np.sin(half_sum), cosine * np.cos(half_sum))


def quaternion_of_vector(v: Vector) -> Quaternion:
    """Return the rotation by |v| [rad] about v."""
    x, y, z = v
    half = 0.5 * np.sqrt(x * x + y * y + z * z)
    scale = 0.5 * np.sinc(half / np.pi)
    return scale * x, scale * y, scale * z, np.cos(half)


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the quaternion product p q: first the rotation q, then p."""
    (a, b, c, d), (x, y, z, w) = p, q
    return (d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z)


def axis_in_world(q: Quaternion) -> tuple[Column, Column, Column]:
    """Return the symmetry axis e3 in the world frame."""
    x, y, z, w = q
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), (w * w + z * z) - (x * x + y * y))


def vertical_in_body(q: Quaternion) -> tuple[Column, Column, Column]:
    """Return the upward vertical in the body frame."""
    x, y, z, w = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), (w * w + z * z) - (x * x + y * y))


def rotated_back(q: Quaternion, v: Vector) -> tuple[Column, Column, Column]:
    """Return a vector given in frame a in the components of frame b, with q(a <- b)."""
    x, y, z, w = q
    vx, vy, vz = v
    return ((w * w + x * x - y * y - z * z) * vx + 2.0 * (x * y + w * z) * vy
            + 2.0 * (x * z - w * y) * vz,
            2.0 * (x * y - w * z) * vx + (w * w - x * x + y * y - z * z) * vy
            + 2.0 * (y * z + w * x) * vz,
            2.0 * (x * z + w * y) * vx + 2.0 * (y * z - w * x) * vy
            + (w * w - x * x - y * y + z * z) * vz)


def rotated(q: Quaternion, v: Vector) -> tuple[Column, Column, Column]:
    """Return a vector given in frame b in the components of frame a, with q(a <- b)."""
    x, y, z, w = q
    return rotated_back((-x, -y, -z, w), v)


def rotation_vector(q: Quaternion) -> tuple[Column, Column, Column]:
    """Return axis times angle [rad] of a unit quaternion; the angle is in [0, 2 pi]."""
    x, y, z, w = q
    sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 * np.arctan2(sine, w) / np.where(sine > 0.0, sine, 1.0)
    return scale * x, scale * y, scale * z


def precession_rate(top: Top, l3: float, lz: float, cos2_half: Number,
                    sin2_half: Number) -> Number:
    """
    Return phi' [rad/s] from cos^2 and sin^2 of theta/2.

    (Lz - L3 cos theta)/(lambda1 sin^2 theta), eq. (31) of "Analysis of Symmetric Spinning Top",
    is split into two terms with one pole each: nothing cancels.  A term without momentum is 0.
    """
    bottom = (lz + l3) / cos2_half if lz + l3 else 0.0 * cos2_half
    upright = (lz - l3) / sin2_half if lz - l3 else 0.0 * sin2_half
    return (bottom + upright) / (4.0 * top.lambda1)


def transverse(theta_dot: Column, across: Column, cos_psi: Column, sin_psi: Column,
               ) -> tuple[Column, Column]:
    """
    Return omega_1 and omega_2 [rad/s], eq. (4) of "Analysis of Symmetric Spinning Top".

    omega_1 + i omega_2 = (-phi' sin(theta) + i theta') exp(-i psi); across: phi' sin(theta).
    """
    return theta_dot * sin_psi - across * cos_psi, theta_dot * cos_psi + across * sin_psi


def angle_between(p: Quaternion, q: Quaternion) -> Column:
    """Return the angle [rad] of the rotation from one attitude to another, accurate near 0."""
    apart = sum((a - b) * (a - b) for a, b in zip(p, q, strict=True))
    opposite = sum((a + b) * (a + b) for a, b in zip(p, q, strict=True))
    return 4.0 * np.arctan2(np.sqrt(np.minimum(apart, opposite)),
                            np.sqrt(np.maximum(apart, opposite)))
