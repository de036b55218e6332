# SPDX-License-Identifier: Apache-2.0
"""MuJoCo as a simulator of the top: a body on a ball joint, with sensors at a site."""

import mujoco
import numpy as np

MODEL = """
<mujoco>
  <option timestep="{dt!r}" integrator="{integrator}" gravity="0 0 -{gravity!r}"
          magnetic="{field}">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body>
      <joint type="ball"/>
      <inertial pos="0 0 {com!r}" mass="{mass!r}" diaginertia="{inertia}"/>
      <site name="imu" pos="{arm}" quat="{mounting}"/>
    </body>
  </worldbody>
  <sensor>
    <gyro site="imu"/>
    <accelerometer site="imu"/>
    <magnetometer site="imu"/>
  </sensor>
</mujoco>"""


def _listed(values):
    return ' '.join(map(repr, values))


class MujocoTop:
    """
    MuJoCo with one of its integrators.

    forward : evaluates the sensors after each step, for the state it has reached
    """

    def __init__(self, integrator='Euler', forward=False):
        self._integrator, self._forward = integrator, forward
        self.__name__ = f'MuJoCo {mujoco.__version__}, {integrator}'

    def __call__(self, top, start, times, dt):
        model = mujoco.MjModel.from_xml_string(MODEL.format(
            dt=dt, integrator=self._integrator, gravity=top.gravity, mass=top.mass,
            com=top.com_distance, field=_listed(top.field), arm=_listed(top.lever_arm),
            mounting=_listed(top.mounting), inertia=_listed(top.inertia_at_com)))
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start.attitude, start.rates
        stride = round((times[1] - times[0]) / dt)
        mujoco.mj_forward(model, data)
        rows = []
        for number in range((len(times) - 1) * stride + 1):
            if number % stride == 0:
                rows.append(np.concatenate((data.qpos, data.qvel, data.sensordata)))
            mujoco.mj_step(model, data)
            if self._forward:
                mujoco.mj_forward(model, data)
        states = np.array(rows)
        return {'attitudes': states[:, :4], 'rates': states[:, 4:7],
                'gyroscope': states[:, 7:10], 'accelerations': states[:, 10:13],
                'magnetometer': states[:, 13:]}
