# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit: where it sits on the body, and what it adds to the truth.

Rates and specific force come from the state itself, never from differences; the errors follow
kalibr's model, with its names and units.  Conventions: REP-145
(at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
"""

from __future__ import annotations

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
GYROSCOPE, ACCELEROMETER = slice(0, 3), slice(3, 6)
NO_ERRORS = np.zeros((6, 1))
# At rates that are changed often, old ones are forgotten.
SENSORS_KEPT = 4
# The bias changes this often, whatever the rate of the IMU.
WALK_STEP_NS = 1_000_000
# Random numbers are drawn for so many samples, or steps of the walk, together.
DRAWN_TOGETHER = 512
# What a draw is for.
WHITE, TURN_ON, WALK_STEPS, WALK_ENDS = range(4)


class Imu:
    """
    One IMU: at `imu.lever_arm` [m] and `imu.rpy` [rad] of the body frame.

    What it measures there is `true`; what it reads there, `sensor(period_ns).read`.  `sensor`
    takes the period of its samples [ns].
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: tuple[float, float, float] = values['imu.lever_arm']
        self._is_rotated = any(values['imu.rpy'])
        self._mounting = _quaternion(*values['imu.rpy'])
        self.sensor: Callable[[int], Sensor] = lru_cache(SENSORS_KEPT)(partial(Sensor, values))

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


class Axes:
    """
    The errors of three axes of one kind, `imu.<kind>_...`, in samples `period` [s] apart.

    white : standard deviation of one sample's noise, density/sqrt(period)
    walk : of the bias' change in a step of the walk, random walk x sqrt(WALK_STEP_NS)
    turn_on : of the bias at the start
    variance : of what is added to a sample besides the bias: white noise and rounding

    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140)
    """

    def __init__(self, values: Mapping[str, Any], kind: str, period: float) -> None:
        self.white: float = values[f'imu.{kind}_noise_density'] / math.sqrt(period)
        self.walk: float = values[f'imu.{kind}_random_walk'] * math.sqrt(WALK_STEP_NS * 1e-9)
        self.turn_on: float = values[f'imu.{kind}_turn_on_bias']
        self._limit: float = values[f'imu.{kind}_range'] or math.inf
        self._resolution: float = values[f'imu.{kind}_resolution']
        self.is_perfect = not (self.white or self.walk or self.turn_on or self._resolution
                               or self._limit < math.inf)
        self.variance = self.white ** 2 + self._resolution ** 2 / 12.0

    def read(self, exact: Vector, white: Rows, bias: Rows) -> Vector:
        """Return the readings: noise and bias added, cut at the range, rounded."""
        x, y, z = (np.clip(value + noise + offset, -self._limit, self._limit)
                   for value, noise, offset in zip(exact, white, bias, strict=True))
        step = self._resolution
        if step:        # + 0.0: no reading is -0
            return tuple((np.rint(one / step) + 0.0) * step for one in (x, y, z))
        return x, y, z


class Sensor:
    """
    The readings of an IMU that takes a sample every `period_ns`.

    White noise is numbered by sample: that of sample k depends on the seed and on k alone.  The
    bias is a path in time, which depends on the seed alone: a change of the rate does not move it.
    A reading between two samples has the noise of the one before, as of a driver that sends the
    newest sample, so that all streams agree where they have a time in common.
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        self.gyroscope, self.accelerometer = kinds = [
            Axes(values, kind, period_ns * 1e-9) for kind in ('gyroscope', 'accelerometer')]
        self._is_perfect = all(kind.is_perfect for kind in kinds)
        self._seed: int = values['seed']
        self._period_ns = period_ns
        self._white, self._walk, turn_on = (
            np.repeat([getattr(kind, name) for kind in kinds], 3)[:, np.newaxis]
            for name in ('white', 'walk', 'turn_on'))
        self._turn_on = turn_on * _normal(self._seed, TURN_ON, 0, 1).T + 0.0    # no bias is -0
        self._newest: tuple[range, Rows, Rows] = range(0), NO_ERRORS, NO_ERRORS

    def read(self, exact: tuple[Vector, Vector], times: range) -> tuple[Vector, Vector]:
        """
        Return the readings of rates [rad/s] and force [m/s^2] at these times [ns].

        exact : what an ideal sensor reads there
        """
        if self._is_perfect:
            return exact
        white, bias = self._errors(times)
        return (self.gyroscope.read(exact[0], white[GYROSCOPE], bias[GYROSCOPE]),
                self.accelerometer.read(exact[1], white[ACCELEROMETER], bias[ACCELEROMETER]))

    def bias(self, times: range) -> tuple[Vector, Vector]:
        """Return the bias at these times [ns]: [rad/s], [m/s^2]."""
        _, bias = self._errors(times)
        return tuple(bias[GYROSCOPE]), tuple(bias[ACCELEROMETER])

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


def _rows(block: Callable[[int], Rows], numbers: NDArray[np.int64]) -> Rows:
    """Return the samples of these ascending numbers, (6, n), from blocks of them."""
    edges = np.flatnonzero(np.diff(numbers // DRAWN_TOGETHER)) + 1
    return np.concatenate([block(int(part[0]) // DRAWN_TOGETHER)[part % DRAWN_TOGETHER]
                           for part in np.split(numbers, edges)]).T


@lru_cache(8)
def _normal(seed: int, purpose: int, number: int, count: int = DRAWN_TOGETHER) -> Rows:
    """
    Draw normal numbers (count, 6), the same ones for the same arguments.

    Philox is counter-based (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11):
    what is drawn for one block does not depend on what else is drawn.
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
