# SPDX-License-Identifier: Apache-2.0
"""
Attitude mathematics of the top in Cayley-Klein parameters, valid at every attitude.

The attitude q(world <- body) = Rz(phi) Ry(theta) Rz(psi) is held as two complex numbers (Klein &
Sommerfeld, *Theorie des Kreisels*, ch. I),

    alpha = w + i z = cos(theta/2) exp(i (phi + psi)/2),
    beta  = y - i x = sin(theta/2) exp(i (phi - psi)/2),

and a vector as v_x + i v_y with v_z apart.  Only + - * / and `conjugate` are used, so every
function takes one state (floats, complex) or many (numpy arrays) alike.
"""

from __future__ import annotations

import math
from typing import Any

from spinning_top_sim.physics.top import Top

# One number or an array of them; complex where the text says so.
Scalar = Any


def quaternion(alpha: Scalar, beta: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return (x, y, z, w), the order of ROS and SciPy, of q(world <- body)."""
    return -beta.imag, beta.real, alpha.imag, alpha.real


def axis_in_world(alpha: Scalar, beta: Scalar) -> tuple[Scalar, Scalar]:
    """Return the symmetry axis e3 in the world: (e3_x + i e3_y, e3_z)."""
    return 2.0 * alpha * beta, squared_modulus(alpha) - squared_modulus(beta)


def vertical_in_body(alpha: Scalar, beta: Scalar) -> tuple[Scalar, Scalar]:
    """Return the upward vertical in the body frame: (z_1 + i z_2, z_3)."""
    return -2.0 * alpha.conjugate() * beta, squared_modulus(alpha) - squared_modulus(beta)


def transverse_in_body(alpha: Scalar, beta: Scalar, v_xy: Scalar, v_z: Scalar) -> Scalar:
    """Return v_1 + i v_2 in the body frame of a vector given in the world."""
    conjugate = alpha.conjugate()
    return (conjugate * conjugate * v_xy - beta * beta * v_xy.conjugate()
            - 2.0 * conjugate * beta * v_z)


def squared_modulus(z: Scalar) -> Scalar:
    """Return |z|^2 without a square root."""
    return z.real * z.real + z.imag * z.imag


def momentum_in_world(top: Top, theta_dot: Scalar, phi_dot: Scalar, sin_theta: Scalar,
                      cos_theta: Scalar, l3: float, cis_phi: Scalar) -> Scalar:
    """
    Return L_x + i L_y [kg m^2/s].

    Eq. (6) of "Analysis of Symmetric Spinning Top" turned into the world by exp(i phi).
    """
    return cis_phi * (sin_theta * (l3 - top.lambda1 * phi_dot * cos_theta)
                      + 1j * (top.lambda1 * theta_dot))


def precession_rate(top: Top, l3: float, lz: float, cos2_half: Scalar,
                    sin2_half: Scalar) -> Scalar:
    """
    Return phi' [rad/s] from cos^2 and sin^2 of theta/2.

    Eq. (31), (Lz - L3 cos theta)/(lambda1 sin^2 theta), split so that each part has one pole and
    nothing cancels; a part whose momentum vanishes is 0 at its pole too.
    """
    return 0.25 / top.lambda1 * (_over(lz + l3, cos2_half) + _over(lz - l3, sin2_half))


def angular_acceleration(top: Top, omega: tuple[Scalar, Scalar, Scalar],
                         vertical: Scalar) -> tuple[Scalar, Scalar]:
    """
    Return omega_1' and omega_2' [rad/s^2] in the body frame (omega_3' = 0): Euler's equations.

    omega: body rates [rad/s]; vertical: z_1 + i z_2 of `vertical_in_body`.
    """
    gyroscopic = (top.lambda1 - top.lambda3) * omega[2]
    torque = top.gravity_torque
    return ((gyroscopic * omega[1] + torque * vertical.imag) / top.lambda1,
            -(gyroscopic * omega[0] + torque * vertical.real) / top.lambda1)


def specific_force(gravity: float, point: tuple[float, float, float],
                   omega: tuple[Scalar, Scalar, Scalar],
                   alpha: tuple[Scalar, Scalar, Scalar],
                   vertical: tuple[Scalar, Scalar, Scalar],
                   ) -> tuple[Scalar, Scalar, Scalar]:
    """
    Return what an ideal accelerometer at a body point measures [m/s^2], in the body frame.

    f = alpha x r + omega x (omega x r) + g z: +g upwards at rest (REP-145).
    point: r [m];  omega, alpha: angular velocity and acceleration;  vertical: upward unit vector.
    """
    r1, r2, r3 = point
    w1, w2, w3 = omega
    a1, a2, a3 = alpha
    along = w1 * r1 + w2 * r2 + w3 * r3
    square = w1 * w1 + w2 * w2 + w3 * w3
    return (a2 * r3 - a3 * r2 + w1 * along - r1 * square + gravity * vertical[0],
            a3 * r1 - a1 * r3 + w2 * along - r2 * square + gravity * vertical[1],
            a1 * r2 - a2 * r1 + w3 * along - r3 * square + gravity * vertical[2])


def angle_between(p: tuple[float, float, float, float],
                  q: tuple[float, float, float, float]) -> float:
    """Return the angle [rad] of the rotation from one attitude to another, accurate near 0."""
    apart = math.dist(p, q)
    opposite = math.hypot(*[a + b for a, b in zip(p, q, strict=True)])
    return 4.0 * math.atan2(min(apart, opposite), max(apart, opposite))


def _over(momentum: float, square: Scalar) -> Scalar:
    return momentum / square if momentum != 0.0 else 0.0 * square
