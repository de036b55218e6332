# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit: where it sits on the body, and what it adds to the truth.

Rates and specific force come from the state itself, never from differences.  Conventions: REP-145
(at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from spinning_top_sim.physics.kinematics import OneState

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Quaternion = tuple[float, float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


class Imu:
    """
    An IMU at `imu.lever_arm` [m] and `imu.rpy` [rad] of the body frame.

    gyroscope_variance, accelerometer_variance: of the white noise in one sample, per axis.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: Vector = values['imu.lever_arm']
        self._turned = values['imu.rpy'] != ZERO
        self._to_sensor = _transposed(_rotation(*values['imu.rpy']))
        self._mounting = _quaternion(*values['imu.rpy'])
        self.gyroscope_variance = self.accelerometer_variance = 0.0

    def orientation(self, state: OneState) -> Quaternion:
        """Return q(world <- IMU) as x, y, z, w."""
        return _product(state.quaternion, self._mounting) if self._turned else state.quaternion

    def true(self, state: OneState) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the IMU's frame."""
        rates = state.angular_velocity
        force = state.specific_force(self._lever_arm)
        if self._turned:
            return _apply(self._to_sensor, rates), _apply(self._to_sensor, force)
        return rates, force

    def measured(self, state: OneState, index: int) -> tuple[Vector, Vector]:
        """Return what the sensor reads at its sample number `index`."""
        return self.true(state)

    def bias(self, index: int) -> tuple[Vector, Vector]:
        """Return the bias in sample number `index`: [rad/s], [m/s^2]."""
        return ZERO, ZERO


def _rotation(roll: float, pitch: float, yaw: float) -> Matrix:
    """Return R(body <- IMU) = Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return ((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr))


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the same rotation as x, y, z, w."""
    turns = [(math.sin(0.5 * angle), math.cos(0.5 * angle)) for angle in (roll, pitch, yaw)]
    (xr, wr), (yp, wp), (zy, wy) = turns
    return _product(_product((0.0, 0.0, zy, wy), (0.0, yp, 0.0, wp)), (xr, 0.0, 0.0, wr))


def _product(p: Quaternion, q: Quaternion) -> Quaternion:
    (a, b, c, d), (x, y, z, w) = p, q
    return (d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z)


def _transposed(m: Matrix) -> Matrix:
    (a, b, c), (d, e, f), (g, h, i) = m
    return (a, d, g), (b, e, h), (c, f, i)


def _apply(m: Matrix, v: Vector) -> Vector:
    x, y, z = v
    (a, b, c), (d, e, f), (g, h, i) = m
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)
