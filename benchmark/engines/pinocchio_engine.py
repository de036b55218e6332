# SPDX-License-Identifier: Apache-2.0
"""Pinocchio: `aba`, then velocity and `integrate`, as in its examples of a simulation."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from engines import mounting, recorded


def run(top, start, times, dt):
    model = pin.Model()
    model.gravity.linear[:] = 0.0, 0.0, -top.gravity
    joint = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), 'pivot')
    model.appendBodyToJoint(joint, pin.Inertia(
        top.mass, np.array(top.com), np.diag(top.inertia_at_com)), pin.SE3.Identity())
    imu = model.addFrame(pin.Frame('imu', joint, 0, pin.SE3(
        mounting(top).as_matrix(), np.array(top.lever_arm)), pin.FrameType.SENSOR))
    data, torque = model.createData(), np.zeros(3)
    q, v = np.array(start.attitude), np.array(start.rates)

    def advance(n):
        nonlocal q, v
        for _ in range(n):
            v = v + dt * pin.aba(model, data, q, v, torque)
            q = pin.integrate(model, q, dt * v)

    def read():
        pin.forwardKinematics(model, data, q, v, pin.aba(model, data, q, v, torque))
        down = pin.updateFramePlacement(model, data, imu).rotation.T @ model.gravity.linear
        force = pin.getFrameClassicalAcceleration(model, data, imu, pin.LOCAL).linear - down
        return {'attitudes': q.copy(), 'rates': v, 'accelerations': force,
                'gyroscope': pin.getFrameVelocity(model, data, imu, pin.LOCAL).angular}

    return recorded(times, dt, advance, read)
