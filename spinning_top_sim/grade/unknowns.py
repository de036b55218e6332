# SPDX-License-Identifier: Apache-2.0
"""
The least-squares problem of the fit: readings against the exact motion of a top; first values.

Attitudes do not depend on the scale of the inertia: the unknowns are those of a top with
lambda1 = 1.  They are regular at the poles: attitude and angular velocity of the body at t = 0,
L3/lambda1 and P/lambda1; and of an IMU its mounting, its place and how late its stamps are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade.scenes import Reals
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.solvers.vertical import state_of

# The unknowns: rotation of the reference attitude [rad], angular velocity [rad/s], L3/lambda1
# [rad/s], P/lambda1 [1/s^2], rotation of the reference mounting [rad], place in the body [m],
# lateness [s].
TURN, RATES, SPIN, L3, P = slice(0, 3), slice(3, 6), 5, 6, 7
MOUNTING, PLACE, LATE = slice(8, 11), slice(11, 14), 14
MOTION, SENSOR = range(8), range(8, 15)
UNKNOWNS = 15
# The natural size of each unknown is that of a rate to this power.
RATE_POWERS = np.array((0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, *np.zeros(6), -1.0))
ROUNDING = 1e-14            # of rates
FAR = 1e9
CHANGE = 1e-5               # of the readings by a step of finite differences [rad], [rad/s], ..


@dataclass(eq=False)        # hashed by identity
class Samples:
    """Samples at times."""

    # 'attitude', q(world <- body) as x, y, z, w; 'rates' or 'force' of an IMU.
    kind: str
    times: Reals            # (n,), ascending [s]
    values: Reals           # (4, n) or (3, n), [rad/s] or [m/s^2]
    sigma: float = 1.0      # standard deviation of a component


class Problem:
    """Residuals and Jacobian of readings."""

    def __init__(self, readings: Sequence[Samples], reference: Reals, gravity: float) -> None:
        self.readings, self.gravity = readings, gravity
        # q(world <- body) at t = 0 and q(body <- IMU), before the unknown turns.
        self.reference, self.mounting = reference, np.array((0.0, 0.0, 0.0, 1.0))
        self._steps = np.full(UNKNOWNS, 1e-6)
        self._motion = lru_cache(maxsize=4)(self._motion_of)

    def start(self, x: Reals) -> tuple[Top, State]:
        """Return top and state with lambda1 = lambda3 = 1: its spin is L3, not omega_3."""
        turn = turned(self.reference, x[TURN])
        rates = turn.apply((x[3], x[4], x[L3]))
        rates[np.abs(rates) < ROUNDING * np.max(np.abs(rates))] = 0.0   # an upright top may rest
        top = Top(lambda1=1.0, lambda3=1.0, mass=1.0, com_distance=float(x[P]), gravity=1.0)
        return top, state_of(top, turn.as_quat(), rates)

    def residuals(self, x: Reals) -> Reals:
        """Return (readings - model)/sigma (m,); they are FAR where no motion begins so."""
        try:
            return np.concatenate([self.residual(x, samples).ravel() / samples.sigma
                                   for samples in self.readings])
        except ValueError:
            return np.full(3 * sum(len(samples.times) for samples in self.readings), FAR)

    def jacobian(self, x: Reals, free: Sequence[int], central: bool = False) -> Reals:
        """Return the derivatives of the residuals (m, len(free)), by finite differences."""
        columns, sigma = [], min(samples.sigma for samples in self.readings)
        behind = self.residuals(x)
        for k in free:
            step = np.zeros(UNKNOWNS)
            step[k] = self._steps[k]
            behind = self.residuals(x - step) if central else behind
            change = self.residuals(x + step) - behind
            columns.append(change / ((1.0 + central) * step[k]))
            largest = float(np.max(np.abs(columns[-1]))) * sigma
            self._steps[k] = min(max(CHANGE / max(largest, 1e-300), 1e-12), 1e-4)
        return np.stack(columns, axis=1)

    def residual(self, x: Reals, samples: Samples) -> Reals:
        """Return readings - model (3, n)."""
        q, w = self.motion(x, samples)
        if samples.kind == 'attitude':
            a, b, c, d = q          # SciPy's rotations take ten times as long
            turn = np.stack(attitude.product((-a, -b, -c, d), tuple(samples.values)))
            return np.stack(attitude.rotation_vector(tuple(np.where(turn[3] < 0.0, -turn, turn))))
        model = w if samples.kind == 'rates' else self._force(x, q, w)
        return samples.values - turned(self.mounting, x[MOUNTING]).inv().apply(model.T).T

    def motion(self, x: Reals, samples: Samples) -> tuple[Reals, Reals]:
        """Return attitudes (4, n), and for an IMU rates in the body (3, n), at its times."""
        late = 0.0 if samples.kind == 'attitude' else float(x[LATE])
        return self._motion(samples, *x[:8].tolist(), late=late)

    def _motion_of(self, samples: Samples, *unknowns: float, late: float) -> tuple[Reals, Reals]:
        x, t = np.array(unknowns), samples.times - late
        states = ExactSolution(*self.start(x)).states_at_seconds(t)
        angle, zero = (x[SPIN] - x[L3]) * t, np.zeros(1)
        q = np.stack(attitude.product(states.rows_quaternion, (
            zero, zero, np.sin(0.5 * angle), np.cos(0.5 * angle))))
        w = np.full((3, len(t)), x[SPIN])
        if samples.kind != 'attitude':
            (w1, w2), sine, cosine = states.transverse_velocity, np.sin(angle), np.cos(angle)
            w[:2] = cosine * w1 + sine * w2, cosine * w2 - sine * w1
        return q, w

    def _force(self, x: Reals, q: Reals, w: Reals) -> Reals:
        """Return the specific force at the IMU, as `States.specific_force` for its own spin."""
        z1, z2, _ = z = np.stack(attitude.vertical_in_body(tuple(q)))
        gyroscopic, place = x[SPIN] - x[L3], x[PLACE]
        change = np.stack((gyroscopic * w[1] + x[P] * z2, -gyroscopic * w[0] - x[P] * z1,
                           np.zeros(len(z1))))
        turning = np.cross(w, place, axis=0)
        force: Reals = np.cross(change, place, axis=0) + np.cross(w, turning, axis=0)
        return force + self.gravity * z


def turned(reference: Sequence[float] | Reals, vector: Reals) -> Rotation:
    """Return the attitude after a rotation vector in the body."""
    return Rotation.from_quat(reference) * Rotation.from_rotvec(vector)


def spin_rate(times: Reals, q: Reals, hint: float | None) -> tuple[float, bool]:
    """
    Return omega_3 [rad/s] from attitudes (4, n), and whether the hint tells its whole turns.

    If not, it is the slowest of those that pass through evenly sampled attitudes.
    """
    x, y, z, w = q[:, :-1]
    _, _, dz, dw = attitude.product((-x, -y, -z, w), tuple(q[:, 1:]))
    turn, dt = 2.0 * np.arctan2(dz, dw), np.diff(times)
    step = float(np.median(dt))
    usual = np.abs(dt - step) < 0.1 * step
    rate = float(np.angle(np.mean(np.exp(1j * turn[usual])))) / step
    turns = 0.0 if hint is None else (hint - rate) * step / math.tau
    sure = hint is not None and abs(turns - round(turns)) < 0.1
    rate += math.tau / step * round(turns) if sure else 0.0
    rest = np.remainder(turn - rate * dt + math.pi, math.tau) - math.pi
    return rate + float(np.sum(rest) / np.sum(dt)), sure


def turns_added(x: Reals, times: Reals) -> float:
    """Return what makes the spin the slowest with 0 < lambda3 <= 2 lambda1, by whole turns."""
    step = float(times[-1]) / (len(times) - 1)
    sign, turn = math.copysign(1.0, x[L3]), math.tau / step
    less = 0.5 * abs(x[L3]) - sign * x[SPIN]
    even = np.max(np.abs(np.diff(times) - step)) < 1e-5 * step
    return sign * turn * math.ceil(less / turn) if even and less > 0.01 * sign * x[SPIN] else 0.0


def small_nutation(times: Reals, q: Reals) -> Iterator[tuple[float, float]]:
    """
    Yield (L3/lambda1, P/lambda1) of a small nutation, from its strongest frequency.

    About a steady precession W at the tilt theta, W^2 sin^2 theta + (L3 - 2 W cos theta)^2 is the
    square of the frequency, and P = L3 W - W^2 cos theta.
    """
    axis = attitude.axis_in_world(tuple(q))
    phi = np.unwrap(np.arctan2(axis[1], axis[0]))
    rate, first = np.polyfit(times, phi, 1)
    height, dt = float(np.mean(axis[2])), float(np.median(np.diff(times)))
    sine = math.sqrt(max(1.0 - height * height, 0.0))
    even = np.arange(times[0], times[-1], dt)
    rest = (np.interp(even, times, height - axis[2]) / max(sine, 1e-3)
            + 1j * sine * np.interp(even, times, phi - first - rate * times))
    power = np.abs(np.fft.fft((rest - np.mean(rest)) * np.hanning(len(even)), 4 * len(even)))
    frequency = math.tau * np.fft.fftfreq(len(power), dt)
    best = abs(float(frequency[np.argmax(power)]))
    for alias in (best, math.tau / dt - best, math.tau / dt + best):
        within = alias * alias - (rate * sine) ** 2
        for sign in (1.0, -1.0) if within > 0.0 else ():
            l3 = 2.0 * rate * height + sign * math.sqrt(within)
            yield l3, l3 * rate - rate * rate * height
