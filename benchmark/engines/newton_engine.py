# SPDX-License-Identifier: Apache-2.0
"""Newton on the CPU, with one of its solvers, in the single precision of Warp."""

from __future__ import annotations

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from engines import recorded

wp.config.quiet = True


def run(top, start, times, dt, solver):
    wp.set_device('cpu')
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -top.gravity))
    body = builder.add_link(mass=top.mass, com=wp.vec3(*top.com),
                            inertia=wp.mat33(np.diag(top.inertia_at_com)), lock_inertia=True)
    joint = builder.add_joint_ball(parent=-1, child=body)
    builder.add_articulation([joint])
    builder.joint_q[:4] = list(start.attitude)
    attitude = Rotation.from_quat(start.attitude)
    builder.joint_qd[:3] = attitude.apply(start.rates).tolist()
    model = builder.finalize()
    stepper = getattr(newton.solvers, f'Solver{solver}')(model)
    now, after = model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, now)
    control = model.control()

    def advance(n):
        nonlocal now, after
        for _ in range(n):
            now.clear_forces()
            stepper.step(now, after, control, None, dt)
            now, after = after, now

    def read():
        x, y, z, w = now.body_q.numpy()[0][3:].astype(float)
        rates = now.body_qd.numpy()[0][3:]
        return {'attitudes': (x, y, z, w),
                'rates': Rotation.from_quat((x, y, z, w)).inv().apply(rates)}

    return recorded(times, dt, advance, read)
