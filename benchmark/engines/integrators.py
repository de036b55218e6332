# SPDX-License-Identifier: Apache-2.0
"""SciPy, heyoka and diffrax on Euler's equations with a quaternion, by their dense output."""

from __future__ import annotations

import numpy as np


def _rates(top, y, stack):
    """Return the derivative of w, x, y, z and the body rates, from `y` of the same seven."""
    w, x, yy, z, w1, w2, w3 = y
    pull = top.gravity_torque / top.lambda1
    turn = (top.lambda1 - top.lambda3) / top.lambda1 * w3
    return stack([0.5 * (-x * w1 - yy * w2 - z * w3), 0.5 * (w * w1 + yy * w3 - z * w2),
                  0.5 * (w * w2 + z * w1 - x * w3), 0.5 * (w * w3 + x * w2 - yy * w1),
                  turn * w2 + pull * (2.0 * (yy * z + w * x)),
                  -turn * w1 - pull * (2.0 * (x * z - w * yy)), 0.0 * w3])


def _first(start):
    x, y, z, w = start.attitude
    return [w, x, y, z, *start.rates]


def _told(states):
    return {'attitudes': states[:, [1, 2, 3, 0]], 'rates': states[:, 4:]}


def scipy(top, start, times, dt, method, **tolerances):
    from scipy.integrate import solve_ivp
    result = solve_ivp(lambda t, y: _rates(top, y.tolist(), list), (0.0, times[-1]),
                       _first(start), method, times, **tolerances)
    return _told(result.y.T)


def heyoka(top, start, times, dt, **tolerances):
    import heyoka as hy
    y = hy.make_vars('w', 'x', 'y', 'z', 'w1', 'w2', 'w3')
    taylor = hy.taylor_adaptive(list(zip(y, _rates(top, y, list), strict=True)),
                                _first(start), **tolerances)
    return _told(taylor.propagate_grid(times)[-1])


class Diffrax:
    """
    Steps of dt, or with tolerances those that they need.

    double : whether JAX computes in double precision; its default is single
    """

    def __init__(self, method: str, double: bool = True, **tolerances: float) -> None:
        import diffrax
        import jax
        jax.config.update('jax_enable_x64', double)
        import jax.numpy as jnp
        control = (diffrax.PIDController(**tolerances) if tolerances else
                   diffrax.ConstantStepSize())
        term = diffrax.ODETerm(lambda t, y, top: _rates(top, y, jnp.stack))
        self._solve = jax.jit(lambda top, y, times, dt: diffrax.diffeqsolve(
            term, getattr(diffrax, method)(), 0.0, times[-1], dt, y, top,
            saveat=diffrax.SaveAt(ts=times), stepsize_controller=control,
            max_steps=10_000_000).ys, static_argnums=0)

    def __call__(self, top, start, times, dt):
        return _told(np.asarray(self._solve(
            top, np.array(_first(start)), times, dt)))
