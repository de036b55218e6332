# SPDX-License-Identifier: Apache-2.0
"""Drake: the exported SDF in a `MultibodyPlant`, with its gyroscope and accelerometer."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.all import (
    Accelerometer,
    DiagramBuilder,
    Gyroscope,
    MultibodyPlant,
    Parser,
    RigidTransform,
    RotationMatrix,
    Simulator,
)

from engines import model, mounting, recorded

logging.getLogger('drake').setLevel(logging.ERROR)      # it reads no gravity and sensors from SDF


def run(top, start, times, dt, accuracy=None):
    """accuracy: of error-controlled steps, which end at each sample; None: steps of dt."""
    builder, down = DiagramBuilder(), np.array([0.0, 0.0, -top.gravity])
    plant = builder.AddSystem(MultibodyPlant(0.0 if accuracy else dt))
    Parser(plant).AddModelsFromString(model(top, start, 'sdf'), 'sdf')
    plant.mutable_gravity_field().set_gravity_vector(down)
    plant.Finalize()
    body, joint = plant.GetBodyByName('base_link'), plant.GetJointByName('pivot')
    place = RigidTransform(RotationMatrix(mounting(top).as_matrix()), top.lever_arm)
    sensors = [builder.AddSystem(sensor) for sensor in (
        Gyroscope(body, place), Accelerometer(body, place, down))]
    for sensor in sensors:
        for name in ('body_poses', 'body_spatial_velocities', 'body_spatial_accelerations'):
            if sensor.HasInputPort(name):
                builder.Connect(plant.GetOutputPort(name), sensor.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    inside = plant.GetMyMutableContextFromRoot(context)
    # The zero angles of the joint are the attitude at the start.
    joint.set_angular_velocity(inside, start.rates)
    if accuracy:
        simulator.get_mutable_integrator().set_target_accuracy(accuracy)
    simulator.Initialize()

    def read():
        turned = plant.EvalBodyPoseInWorld(inside, body).rotation()
        rates = plant.EvalBodySpatialVelocityInWorld(inside, body).rotational()
        return {'attitudes': np.roll(turned.ToQuaternion().wxyz(), -1),
                'rates': turned.inverse() @ rates,
                **{name: sensor.get_output_port().Eval(sensor.GetMyContextFromRoot(context))
                   for name, sensor in zip(('gyroscope', 'accelerations'), sensors, strict=True)}}

    return recorded(times, dt, lambda n: simulator.AdvanceTo(context.get_time() + n * dt), read)
