# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit: where it sits on the body, and what it adds to the truth.

The errors follow kalibr's model, with its names and units.  Conventions: REP-145 (at rest an
accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
"""

import itertools
import math
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion, Vector
from spinning_top_sim.physics.states import States

# Six columns or rows: three axes of the gyroscope, three of the accelerometer.
Rows = NDArray[np.float64]
NO_ERRORS = np.zeros((6, 1))
# The bias changes this often, whatever the rate of the IMU.
WALK_STEP_NS = 1_000_000
# Random numbers are drawn for so many samples, or steps of the walk, together.
DRAWN_TOGETHER = 512
# What a draw is for.
WHITE, TURN_ON, WALK_STEPS, WALK_ENDS = range(4)


class Imu:
    """One IMU, at `imu.lever_arm` [m] and `imu.rpy` [rad]; what it adds is of its `sensor`."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: tuple[float, float, float] = values['imu.lever_arm']
        self._is_rotated = any(values['imu.rpy'])
        self._mounting = _quaternion(*values['imu.rpy'])
        self.sensor: Callable[[int], Sensor] = lru_cache(4)(partial(Sensor, values))

    def orientation(self, states: States) -> Quaternion:
        """Return q(world <- IMU): columns x, y, z, w."""
        if not self._is_rotated:
            return states.rows_quaternion
        return attitude.product(states.rows_quaternion, self._mounting)

    def in_body(self, orientation: Quaternion, rates: Vector) -> tuple[Quaternion, Vector]:
        """Return attitude and rates of the body from those of the IMU."""
        x, y, z, w = self._mounting
        inverse = -x, -y, -z, w
        return attitude.product(orientation, inverse), attitude.in_body(inverse, rates)

    def true(self, states: States) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the IMU's frame."""
        rates = states.rows_angular_velocity
        force = states.specific_force(self._lever_arm)
        if not self._is_rotated:
            return rates, force
        # What the world is to the body, the body is to the IMU.
        return attitude.in_body(self._mounting, rates), attitude.in_body(self._mounting, force)


class Sensor:
    """
    The readings of an IMU that takes a sample every `period_ns`.

    White noise is numbered by sample: that of sample k depends on the seed and on k alone.  The
    bias is a path in time, which depends on the seed alone: a change of the rate does not move it.
    A reading between two samples has the noise of the one before, as of a driver that sends the
    newest sample, so that all streams agree where they have a time in common.

    rate_variance, force_variance : of white noise and rounding together

    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140)
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        def six(name: str) -> Rows:
            rate, force = values[f'imu.gyroscope_{name}'], values[f'imu.accelerometer_{name}']
            return np.repeat((rate, force), 3)[:, np.newaxis]

        self._seed, self._period_ns = values['seed'], period_ns
        # Deviations of a sample's noise, and of the change of the bias in a step of its walk.
        self._white = six('noise_density') / math.sqrt(period_ns * 1e-9)
        self._walk = six('random_walk') * math.sqrt(WALK_STEP_NS * 1e-9)
        # + 0.0: no bias is -0, and below no reading.
        self._turn_on = six('turn_on_bias') * _normal(self._seed, TURN_ON, 0, 1).T + 0.0
        self._resolution = six('resolution')
        self._limit = [_largest_reading(*pair) for pair in zip(
            six('range')[:, 0].tolist(), self._resolution[:, 0].tolist(), strict=True)]
        self._is_perfect = not any(map(np.any, (
            self._white, self._walk, self._turn_on, six('range'), self._resolution)))
        variances = self._white ** 2 + self._resolution ** 2 / 12.0
        self.rate_variance, self.force_variance = variances[[0, 3], 0].tolist()
        self._newest: tuple[range, Rows, Rows] = range(0), NO_ERRORS, NO_ERRORS

    def read(self, exact: tuple[Vector, Vector], times: range) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] at these times [ns] of what is exact there."""
        if self._is_perfect:
            return exact
        rows = []
        for value, white, bias, limit, (step,) in zip(
                itertools.chain(*exact), *self._errors(times), self._limit, self._resolution,
                strict=True):
            reading = value + white + bias
            if step:
                reading = (np.rint(reading / step) + 0.0) * step
            rows.append(np.clip(reading, -limit, limit))
        return tuple(rows[:3]), tuple(rows[3:])

    def bias(self, times: range) -> tuple[Vector, Vector]:
        """Return the bias at these times [ns]: [rad/s], [m/s^2]."""
        _, bias = self._errors(times)
        return tuple(bias[:3]), tuple(bias[3:])

    def _errors(self, times: range) -> tuple[Rows, Rows]:
        """Return white noise and bias at these times, (6, n) or (6, 1) each."""
        if self._newest[0] != times:      # streams of one rate ask for the same ones
            t_ns = np.arange(times.start, times.stop, times.step)
            white, bias = NO_ERRORS, self._turn_on
            if self._white.any():
                white = self._white * _rows(
                    partial(_normal, self._seed, WHITE), t_ns // self._period_ns)
            if self._walk.any():
                bias = bias + self._walk * _rows(
                    partial(_walk, self._seed), t_ns // WALK_STEP_NS)
            self._newest = times, white, bias
        return self._newest[1:]


def _largest_reading(limit: float, step: float) -> float:
    """Return the largest multiple of the resolution within the range; 0 is no limit."""
    if not limit:
        return math.inf
    if not step:
        return limit
    count = math.floor(limit / step)
    return (count if count * step <= limit else count - 1) * step


def _rows(block: Callable[[int], Rows], numbers: NDArray[np.int64]) -> Rows:
    """Return the samples of these ascending numbers, (6, n), from blocks of them."""
    edges = np.flatnonzero(np.diff(numbers // DRAWN_TOGETHER)) + 1
    return np.concatenate([block(int(part[0]) // DRAWN_TOGETHER)[part % DRAWN_TOGETHER]
                           for part in np.split(numbers, edges)]).T


@lru_cache(8)
def _normal(seed: int, purpose: int, number: int, count: int = DRAWN_TOGETHER) -> Rows:
    """
    Draw normal numbers (count, 6) that depend on nothing else that is drawn.

    Philox is counter-based (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11).
    """
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, purpose, number])
                               ).standard_normal((count, 6))


@lru_cache(4)
def _walk(seed: int, block: int) -> Rows:
    """Return a random walk in a block of steps, (512, 6): a Brownian bridge between its ends."""
    begin, end = _walk_end(seed, block), _walk_end(seed, block + 1)
    steps: Rows = _normal(seed, WALK_STEPS, block)
    missing: Rows = end - begin - steps.sum(axis=0)
    steps = steps + missing / DRAWN_TOGETHER
    return begin + (np.cumsum(steps, axis=0) - steps)


@lru_cache(256)
def _walk_end(seed: int, block: int) -> Rows:
    """
    Return the random walk where a block begins, (6,), by way of some log2(block) others.

    Its ends at powers of two follow from one another, and half-way between two that are known
    lies their mean and a normal number (P. Levy's construction of Brownian motion).
    """
    if block == 0:
        return np.zeros(6)
    normal: Rows = _normal(seed, WALK_ENDS, block, 1)[0]
    apart = block & -block          # the largest power of two that divides it
    if block == apart:
        before = block // 2
        return _walk_end(seed, before) + math.sqrt((block - before) * DRAWN_TOGETHER) * normal
    middle = 0.5 * (_walk_end(seed, block - apart) + _walk_end(seed, block + apart))
    return middle + math.sqrt(0.5 * apart * DRAWN_TOGETHER) * normal


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll) as columns x, y, z, w of one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
