# SPDX-License-Identifier: Apache-2.0
"""Bullet through PyBullet: a multibody with a spherical joint, without its default damping."""

from __future__ import annotations

import pybullet as p
from scipy.spatial.transform import Rotation

from engines import recorded


def run(top, start, times, dt):
    client = p.connect(p.DIRECT)
    try:
        p.setGravity(0.0, 0.0, -top.gravity)
        p.setTimeStep(dt)
        body = p.createMultiBody(
            baseMass=0.0, linkMasses=[top.mass], linkCollisionShapeIndices=[-1],
            linkVisualShapeIndices=[-1], linkPositions=[[0.0, 0.0, 0.0]],
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]], linkInertialFramePositions=[top.com],
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]], linkParentIndices=[0],
            linkJointTypes=[p.JOINT_SPHERICAL], linkJointAxis=[[0.0, 0.0, 1.0]])
        p.changeDynamics(body, 0, localInertiaDiagonal=top.inertia_at_com, linearDamping=0.0,
                         angularDamping=0.0, jointDamping=0.0)
        p.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        p.setJointMotorControlMultiDof(body, 0, p.POSITION_CONTROL, [0.0, 0.0, 0.0, 1.0],
                                       force=[0.0, 0.0, 0.0])
        p.resetJointStateMultiDof(body, 0, start.attitude, start.rates)

        def advance(n):
            for _ in range(n):
                p.stepSimulation()

        def read():
            state = p.getLinkState(body, 0, computeLinkVelocity=1, computeForwardKinematics=1)
            turned = Rotation.from_quat(state[5])
            return {'attitudes': state[5], 'rates': turned.inv().apply(state[7])}

        return recorded(times, dt, advance, read)
    finally:
        p.disconnect(client)
