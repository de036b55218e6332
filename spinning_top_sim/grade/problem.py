# SPDX-License-Identifier: Apache-2.0
"""
The least-squares problem of the fit: readings against the exact motion of a top.

Attitudes do not depend on the scale of the inertia: the unknowns are those of a top with
lambda1 = 1.  They are regular at the poles: attitude and angular velocity of the body at t = 0,
L3/lambda1 and P/lambda1; and of an IMU its mounting, its place and how late its stamps are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.placement import state_of
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution

# The unknowns: rotation of the reference attitude [rad], angular velocity [rad/s], L3/lambda1
# [rad/s], P/lambda1 [1/s^2], rotation of the reference mounting [rad], place in the body [m],
# lateness [s].
TURN, RATES, SPIN, L3, P = slice(0, 3), slice(3, 6), 5, 6, 7
MOUNTING, PLACE, LATE = slice(8, 11), slice(11, 14), 14
MOTION, SENSOR = range(8), range(8, 15)
UNKNOWNS = 15
ROUNDING = 1e-14            # of rates
CHANGE = 1e-6               # of the readings by a step of finite differences [rad], [rad/s], ..


@dataclass
class Readings:
    """
    Readings at times.

    kind : 'attitude', q(world <- body) as x, y, z, w; 'rates' or 'force' of an IMU
    times : (n,), ascending [s]
    values : (4, n) or (3, n), [rad/s] or [m/s^2]
    sigma : standard deviation of a component
    """

    kind: str
    times: Reals
    values: Reals
    sigma: float = 1.0


class Problem:
    """
    Residuals and Jacobian of readings.

    reference, mounting : q(world <- body) at t = 0 and q(body <- IMU), from which the unknown
        rotations count, as x, y, z, w
    """

    def __init__(self, readings: Sequence[Readings], reference: Reals, gravity: float,
                 mounting: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> None:
        self.readings, self.reference, self.gravity = readings, reference, gravity
        self.mounting = mounting
        self._steps = np.full(UNKNOWNS, 1e-6)
        self._seen: dict[
            tuple[object, ...], tuple[tuple[States, Reals, Reals], Reals]] = {}

    def start(self, x: Reals) -> tuple[Top, State]:
        """Return top and state with lambda1 = lambda3 = 1: its spin is L3, not omega_3."""
        q = turned(self.reference, x[TURN])
        rates = np.ravel(attitude.in_world(q, (x[3], x[4], x[L3])))
        rates[np.abs(rates) < ROUNDING * np.max(np.abs(rates))] = 0.0   # an upright top may rest
        top = Top(lambda1=1.0, lambda3=1.0, mass=1.0, com_distance=float(x[P]), gravity=1.0)
        return top, state_of(top, np.ravel(q), rates)

    def residuals(self, x: Reals) -> Reals:
        """Return (readings - model)/sigma (m,).  Raises ValueError where there is no motion."""
        return np.concatenate([self.residual(x, one).ravel() / one.sigma
                               for one in self.readings])

    def jacobian(self, x: Reals, free: Sequence[int], central: bool = False) -> Reals:
        """Return the derivatives of the residuals (m, len(free)), by finite differences."""
        base = None if central else self.residuals(x)
        columns, sigma = [], min(one.sigma for one in self.readings)
        for k in free:
            step = np.zeros(UNKNOWNS)
            step[k] = self._steps[k]
            ahead = self.residuals(x + step)
            behind = self.residuals(x - step) if base is None else base
            columns.append((ahead - behind) / ((1.0 if central is False else 2.0) * step[k]))
            largest = float(np.max(np.abs(columns[-1]))) * sigma
            self._steps[k] = min(max(CHANGE / max(largest, 1e-300), 1e-12), 1e-4)
        return np.stack(columns, axis=1)

    def rates(self, x: Reals, times: Reals) -> Reals:
        """Return the angular velocity in the body (3, n) at the times of readings of an IMU."""
        return self._motion(x, times, float(x[LATE]))[2]

    def residual(self, x: Reals, one: Readings) -> Reals:
        """Return readings - model (3, n)."""
        late = 0.0 if one.kind == 'attitude' else float(x[LATE])
        states, q, w = self._motion(x, one.times, late)
        if one.kind == 'attitude':
            a, b, c, d = q
            x1, y1, z1, w1 = attitude.product((-a, -b, -c, d), tuple(one.values))
            sign = np.where(w1 < 0.0, -1.0, 1.0)
            return np.stack(attitude.rotation_vector((sign * x1, sign * y1, sign * z1, sign * w1)))
        model = w if one.kind == 'rates' else self._force(x, q, w)
        return one.values - np.stack(attitude.in_body(
            turned(self.mounting, x[MOUNTING]), tuple(model)))

    def _motion(self, x: Reals, times: Reals, late: float) -> tuple[States, Reals, Reals]:
        """Return states, and attitudes (4, n) and angular velocities (3, n) of the true spin."""
        key = (x[:8].tobytes(), late, id(times))
        if key not in self._seen:
            if len(self._seen) > 2:
                self._seen.pop(next(iter(self._seen)))      # the oldest
            t = times - late
            states = ExactSolution(*self.start(x)).states_at_seconds(t)
            angle = (x[SPIN] - x[L3]) * t
            sine, cosine = np.sin(0.5 * angle), np.cos(0.5 * angle)
            qx, qy, qz, qw = states.rows_quaternion
            q = np.stack((qx * cosine + qy * sine, qy * cosine - qx * sine,
                          qz * cosine + qw * sine, qw * cosine - qz * sine))
            w = np.empty((3, 0))
            if any(one.kind != 'attitude' and one.times is times for one in self.readings):
                (w1, w2), sine, cosine = states.transverse_velocity, np.sin(angle), np.cos(angle)
                w = np.stack((cosine * w1 + sine * w2, cosine * w2 - sine * w1,
                              np.full(len(t), x[SPIN])))
            # With the times, whose identity nothing else has as long as they are kept.
            self._seen[key] = (states, q, w), times
        return self._seen[key][0]

    def _force(self, x: Reals, q: Reals, w: Reals) -> Reals:
        """Return the specific force at the IMU, as `States.specific_force` for its own spin."""
        z1, z2, _ = z = np.stack(attitude.vertical_in_body(tuple(q)))
        gyroscopic, place = x[SPIN] - x[L3], x[PLACE]
        change = np.stack((gyroscopic * w[1] + x[P] * z2, -gyroscopic * w[0] - x[P] * z1,
                           np.zeros(len(z1))))
        turning = np.cross(w, place, axis=0)
        force: Reals = np.cross(change, place, axis=0) + np.cross(w, turning, axis=0)
        return force + self.gravity * z


def turned(reference: Sequence[float] | Reals, vector: Reals) -> attitude.Quaternion:
    """Return the attitude after a rotation vector in the body, components (1,)."""
    a, b, c, d = (np.array([part]) for part in reference)
    x, y, z = (np.array([part]) for part in vector)
    return attitude.product((a, b, c, d), attitude.quaternion_of_vector((x, y, z)))
