# SPDX-License-Identifier: Apache-2.0
"""
The least-squares problem of the fit: readings against the exact motion of a top.

Poses do not depend on the scale of the inertia: the unknowns are those of a top with lambda1 = 1.
They are regular at the poles: attitude and angular velocity of the body at t = 0, L3/lambda1 and
P/lambda1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution

Reals = NDArray[np.float64]
# The unknowns: small rotation of the reference attitude [rad], angular velocity [rad/s], L3/lambda1
# [rad/s], P/lambda1 [1/s^2]; then of the sensor: small rotation of its mounting [rad], place in the
# body [m], and how late its stamps are [s].
MOTION, SENSOR = slice(0, 8), slice(8, 15)
TURN, RATES, L3, P = slice(0, 3), slice(3, 6), 6, 7
MOUNTING, PLACE, LATE = slice(8, 11), slice(11, 14), 14
UNKNOWNS = 15
# A step of finite differences changes the readings by this [rad], [rad/s], [m/s^2].
CHANGE = 1e-6
AT_POLE = 1e-9              # sin(theta) of an axis that is vertical


@dataclass
class Readings:
    """
    Readings at times.

    Parameters
    ----------
    kind : {'attitude', 'rates', 'force'}
        Quaternions q(world <- body) as x, y, z, w, angular velocities [rad/s] or specific forces
        [m/s^2] of the sensor.
    times : (n,) array
        Ascending [s].
    values : (4, n) or (3, n) array
    sigma : float
        Standard deviation of a component.
    """

    kind: str
    times: Reals
    values: Reals
    sigma: float = 1.0


class Start(NamedTuple):
    """A top with lambda1 = 1, its state at t = 0, and how much faster than L3 it spins [rad/s]."""

    top: Top
    state: State
    extra_spin: float


class Problem:
    """
    Residuals and Jacobian of readings.

    reference : attitude at t = 0, about which the unknown rotation is small (4,)
    mounting : q(body <- sensor), likewise (4,)
    """

    def __init__(self, readings: Sequence[Readings], reference: Reals, gravity: float,
                 mounting: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> None:
        self.readings, self._reference, self._gravity = readings, reference, gravity
        self._mounting = mounting
        self._steps = np.full(UNKNOWNS, 1e-6)
        self._seen: dict[tuple[object, ...], tuple[States, Reals]] = {}

    def start(self, x: Reals) -> Start:
        """Return the motion of the unknowns.  Raises ValueError where there is none."""
        q = attitude.product(_quaternion(self._reference), _small(x[TURN]))
        state = state_of([float(part[0]) for part in q], x[RATES], float(x[L3]))
        top = Top(lambda1=1.0, lambda3=1.0, mass=1.0, com_distance=float(x[P]), gravity=1.0)
        return Start(top, state, float(x[5] - x[L3]))

    def turn_to(self, q: attitude.Quaternion) -> list[float]:
        """Return the unknown rotation of an attitude at t = 0."""
        x, y, z, w = _quaternion(self._reference)
        turn = attitude.product((-x, -y, -z, w), q)
        sign = 1.0 if float(turn[3][0]) >= 0.0 else -1.0
        x, y, z, w = (sign * part for part in turn)
        return [float(part[0]) for part in attitude.rotation_vector((x, y, z, w))]

    def residuals(self, x: Reals) -> Reals:
        """Return (readings - model)/sigma, (m,).  Raises ValueError."""
        return np.concatenate([self._residual(x, one).ravel() / one.sigma
                               for one in self.readings])

    def jacobian(self, x: Reals, free: Sequence[int], central: bool = False) -> Reals:
        """Return the derivatives of the residuals (m, len(free)), by finite differences."""
        base = None if central else self.residuals(x)
        columns = []
        for k in free:
            step = np.zeros(UNKNOWNS)
            step[k] = self._steps[k]
            ahead = self.residuals(x + step)
            behind = self.residuals(x - step) if base is None else base
            column = (ahead - behind) / (step[k] if base is not None else 2.0 * step[k])
            columns.append(column)
            largest = float(np.max(np.abs(column))) * min(one.sigma for one in self.readings)
            self._steps[k] = min(max(CHANGE / max(largest, 1e-300), 1e-12), 1e-4)
        return np.stack(columns, axis=1)

    def _residual(self, x: Reals, one: Readings) -> Reals:
        if one.kind == 'attitude':
            states, q = self._states(x[MOTION], one, 0.0)
            a, b, c, d = q
            x1, y1, z1, w1 = attitude.product((-a, -b, -c, d), tuple(one.values))
            sign = np.where(w1 < 0.0, -1.0, 1.0)
            return np.stack(attitude.rotation_vector((sign * x1, sign * y1, sign * z1, sign * w1)))
        states, q = self._states(x[MOTION], one, float(x[LATE]))
        mount = attitude.product(_quaternion(self._mounting), _small(x[MOUNTING]))
        model = self._rates(x, states) if one.kind == 'rates' else self._force(x, states, q)
        return one.values - np.stack(np.broadcast_arrays(
            *attitude.in_body(mount, model)))

    def _states(self, motion: Reals, one: Readings, late: float,
                ) -> tuple[States, Reals]:
        """Return the states at the times of readings, and attitudes with the true spin (4, n)."""
        key = (motion.tobytes(), late, id(one.times))
        if key not in self._seen:
            if len(self._seen) > 3:
                self._seen.pop(next(iter(self._seen)))      # the oldest
            top, state, extra = self.start(motion)
            times = one.times - late
            states = ExactSolution(top, state).states_at_seconds(times)
            x, y, z, w = states.rows_quaternion
            sine, cosine = np.sin(0.5 * extra * times), np.cos(0.5 * extra * times)
            self._seen[key] = states, np.stack((
                x * cosine + y * sine, y * cosine - x * sine, z * cosine + w * sine,
                w * cosine - z * sine))
        return self._seen[key]

    def _rates(self, x: Reals, states: States) -> attitude.Vector:
        """Return the angular velocity in the body that spins truly [rad/s]."""
        w1, w2 = states.transverse_velocity
        angle = (x[5] - x[L3]) * states.t
        cosine, sine = np.cos(angle), np.sin(angle)
        return cosine * w1 + sine * w2, cosine * w2 - sine * w1, np.full(len(states), x[5])

    def _force(self, x: Reals, states: States, q: Reals) -> attitude.Vector:
        """Return the specific force, as `States.specific_force` does for its own spin."""
        w1, w2, w3 = w = np.stack(self._rates(x, states))
        z = z1, z2, _ = attitude.vertical_in_body(tuple(q))
        slower, r = x[L3] - x[5], x[PLACE]
        turning = np.stack((x[P] * z2 - slower * w2, slower * w1 - x[P] * z1, 0.0 * w3))
        # The other term of lambda1 - lambda3 over lambda1 times w3 is w3 itself.
        force = np.cross(turning, r, axis=0) + np.cross(w, np.cross(w, r, axis=0), axis=0)
        return tuple(force + self._gravity * np.stack(z))


def state_of(q: Sequence[float], rates: Sequence[float], l3: float) -> State:
    """Return the state of a top with lambda1 = 1 from attitude and angular velocity."""
    x, y, z, w = q
    w1, w2, _ = rates
    theta = 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w))
    half_sum, half_difference = math.atan2(z, w), math.atan2(-x, y)
    phi, psi = half_sum + half_difference, half_sum - half_difference
    if math.sin(theta) < AT_POLE:       # all the motion of the axis is nutation
        psi = math.atan2(w1, w2)
        up = theta < 1.0
        return State(theta=0.0 if up else math.pi, theta_dot=math.hypot(w1, w2), psi=psi,
                     phi=2.0 * half_sum - psi if up else 2.0 * half_difference + psi,
                     l3=l3, lz=l3 if up else -l3)
    theta_dot = w1 * math.sin(psi) + w2 * math.cos(psi)
    across = w2 * math.sin(psi) - w1 * math.cos(psi)        # phi' sin(theta)
    return State(theta=theta, theta_dot=theta_dot, phi=phi, psi=psi, l3=l3,
                 lz=l3 * math.cos(theta) + across * math.sin(theta))


def _quaternion(q: Sequence[float]) -> attitude.Quaternion:
    x, y, z, w = (np.array([part]) for part in q)
    return x, y, z, w


def _small(vector: Reals) -> attitude.Quaternion:
    x, y, z = (np.array([part]) for part in vector)
    return attitude.quaternion_of_vector((x, y, z))
