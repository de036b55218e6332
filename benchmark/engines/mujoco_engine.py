# SPDX-License-Identifier: Apache-2.0
"""MuJoCo and MJX: the exported MJCF, `mj_step`, and `sensordata` after it."""

from __future__ import annotations

import mujoco
import numpy as np

from engines import model, recorded


def _loaded(top, start, dt, integrator):
    loaded = mujoco.MjModel.from_xml_string(model(top, start, 'mjcf'))
    loaded.opt.timestep = dt
    loaded.opt.integrator = getattr(mujoco.mjtIntegrator, f'mjINT_{integrator.upper()}')
    data = mujoco.MjData(loaded)
    mujoco.mj_resetDataKeyframe(loaded, data, 0)
    mujoco.mj_forward(loaded, data)
    return loaded, data


def _read(data):
    return {'attitudes': data.qpos[[1, 2, 3, 0]], 'rates': data.qvel,
            'gyroscope': data.sensordata[:3], 'accelerations': data.sensordata[3:]}


def run(top, start, times, dt, integrator):
    loaded, data = _loaded(top, start, dt, integrator)
    return recorded(times, dt, lambda n: mujoco.mj_step(loaded, data, n), lambda: _read(data))


class Mjx:
    """MJX on the CPU, in single precision as JAX has it by default; one program for all runs."""

    MOST = 50_000       # samples of a run

    def __init__(self) -> None:
        import jax
        from jax import numpy as jnp
        from mujoco import mjx
        self._mjx = mjx

        def sample(k, loaded, every, now, rows):
            now = jax.lax.fori_loop(0, every, lambda _, one: mjx.step(loaded, one), now)
            return now, rows.at[k].set(jnp.concatenate((now.qpos, now.qvel, now.sensordata)))

        self._play = jax.jit(lambda loaded, now, every, n: jax.lax.fori_loop(
            1, n, lambda k, one: sample(k, loaded, every, *one),
            (now, jnp.zeros((self.MOST, 13))))[1])

    def __call__(self, top, start, times, dt, integrator):
        loaded, data = _loaded(top, start, dt, integrator)
        rows = self._play(self._mjx.put_model(loaded), self._mjx.put_data(loaded, data),
                          round((times[1] - times[0]) / dt), len(times))
        rows = np.array(rows, float)[:len(times)]
        rows[0] = np.concatenate((data.qpos, data.qvel, data.sensordata))
        return {'attitudes': rows[:, [1, 2, 3, 0]], 'rates': rows[:, 4:7],
                'gyroscope': rows[:, 7:10], 'accelerations': rows[:, 10:]}
