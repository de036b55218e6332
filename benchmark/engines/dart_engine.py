# SPDX-License-Identifier: Apache-2.0
"""DART through dartpy, the engine that Gazebo uses by default: a ball joint in a `World`."""

from __future__ import annotations

import dartpy as dart
import numpy as np
from scipy.spatial.transform import Rotation

from engines import mounting, recorded


def run(top, start, times, dt):
    skeleton = dart.dynamics.Skeleton('top')
    joint, body = skeleton.createBallJointAndBodyNodePair()
    body.setInertia(dart.dynamics.Inertia(top.mass, np.array(top.com),
                                          np.diag(top.inertia_at_com)))
    world = dart.simulation.World()
    world.setGravity([0.0, 0.0, -top.gravity])
    world.setTimeStep(dt)
    world.addSkeleton(skeleton)
    attitude = Rotation.from_quat(start.attitude)
    joint.setPositions(dart.dynamics.BallJoint.convertToPositions(attitude.as_matrix()))
    joint.setVelocities(start.rates)
    imu = mounting(top).inv()
    skeleton.computeForwardDynamics()

    def advance(n):
        for _ in range(n):
            world.step()

    def read():
        turned = Rotation.from_matrix(body.getWorldTransform().rotation())
        rates = body.getAngularVelocity(dart.dynamics.Frame.World(), body)
        force = body.getLinearAcceleration(
            np.array(top.lever_arm), dart.dynamics.Frame.World(), body) \
            + turned.inv().apply([0.0, 0.0, top.gravity])
        return {'attitudes': turned.as_quat(), 'rates': rates,
                'gyroscope': imu.apply(rates), 'accelerations': imu.apply(force)}

    return recorded(times, dt, advance, read)
