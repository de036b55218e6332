# SPDX-License-Identifier: Apache-2.0
"""
Fits of logs with noise: errors are as large as the Cramer-Rao bound and the intervals say.

The bound is computed here, from the derivatives of `solve` by the parameters of the top and its
start.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from spinning_top_sim import State, Top, solve
from spinning_top_sim.grade.fit import fit

PATIENCE_S = 300.0
MEMORY_MB = 1500
RATE_HZ = 100.0
DURATIONS_S = (6.0, 12.0)
NOISE = (1e-4, 1e-2)        # rad
ANGLES = [2, 3]
VAGUE = 0.05                # of the size of a parameter: the bound is one of linear theory


class Log(NamedTuple):
    """
    A synthetic log.

    true : theta, theta_dot, phi, psi, L3/lambda1, Lz/lambda1, lambda3/lambda1, P/lambda1
    t : (n,) [s]
    q : (n, 4), x, y, z, w, with noise
    sigma : of each component of the noise [rad]
    """

    true: np.ndarray
    t: np.ndarray
    q: np.ndarray
    sigma: float


def attitudes(true, t):
    theta, theta_dot, phi, psi, l3, lz, lambda3, p = true
    top = Top(lambda1=1.0, lambda3=lambda3, mass=1.0, com_distance=p, gravity=1.0)
    return Rotation.from_quat(solve(top, State(
        theta=theta, theta_dot=theta_dot, phi=phi, psi=psi, l3=l3, lz=lz), t).quaternion)


def make(seed):
    """Return a log of a random top."""
    random = np.random.default_rng(seed)
    t = np.arange(round(random.uniform(*DURATIONS_S) * RATE_HZ)) / RATE_HZ
    theta = random.uniform(0.3, 2.6)
    l3, lambda3 = random.uniform(2.0, 20.0) * random.choice((-1.0, 1.0)), random.uniform(0.3, 1.9)
    true = np.array([
        theta, random.uniform(-2.0, 2.0), *random.uniform(-3.0, 3.0, 2), l3,
        l3 * math.cos(theta) + random.uniform(-3.0, 3.0) * math.sin(theta) ** 2, lambda3,
        random.uniform(5.0, 40.0) * random.choice((-1.0, 1.0))])
    sigma = float(np.exp(random.uniform(*np.log(NOISE))))
    noise = Rotation.from_rotvec(sigma * random.standard_normal((len(t), 3)))
    return Log(true, t, (attitudes(true, t) * noise).as_quat(), sigma)


def information(log):
    """Return the Fisher information of the parameters (8, 8)."""
    columns = []
    for k, value in enumerate(log.true):
        step = np.zeros(8)
        step[k] = 1e-7 * max(abs(value), 1.0)
        behind, ahead = (attitudes(log.true + sign * step, log.t) for sign in (-1, 1))
        columns.append((behind.inv() * ahead).as_rotvec().ravel() / (2.0 * step[k]))
    jacobian = np.stack(columns, axis=1) / log.sigma
    return jacobian.T @ jacobian


def fitted(seed):
    """
    Fit a log; raise if the fit does not reach the noise.

    Return the errors over their estimated deviations (8,), NaN where the log hardly tells the
    parameter, and the error by the Fisher information: chi squared of 8 degrees of freedom.
    """
    log = make(seed)
    found = fit({'attitudes': (log.t, np.roll(log.q, 1, axis=1))})
    assert found.reached, f'residual {found.residual}, noise {log.sigma}'
    error = np.array(list(found.values.values())) - log.true
    error[ANGLES] = np.remainder(error[ANGLES] + math.pi, math.tau) - math.pi
    fisher = information(log)
    scale = 1.0 / np.sqrt(np.diag(fisher))
    least = scale * np.sqrt(np.diag(np.linalg.inv(fisher * np.outer(scale, scale))))
    vague = least > VAGUE * np.maximum(np.abs(log.true), 1.0)
    deviations = np.array(list(found.deviations.values()))
    return np.where(vague, np.nan, error / deviations), float(error @ fisher @ error)


def check(seed, folder):
    """Raise for an error of one in a million; return how many intervals hold the value."""
    over_deviation, squares = fitted(seed)
    low, high = chdtri(8, (1.0 - 1e-6, 1e-6))
    assert low < squares < high, squares
    assert np.nanmax(np.abs(over_deviation)) < 6.0, over_deviation
    known = over_deviation[np.isfinite(over_deviation)]
    return f'{np.count_nonzero(np.abs(known) < 1.96)} of {len(known)} in 95 % intervals'
