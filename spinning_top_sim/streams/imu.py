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

Rows = NDArray[np.float64]
ZERO = (0.0, 0.0, 0.0)
NO_NOISE = np.zeros((12, 1))
# At rates that are changed often, old ones are forgotten.
SENSORS_KEPT = 4


class Imu:
    """
    One IMU: at `imu.lever_arm` [m] and `imu.rpy` [rad] of the body frame.

    What it measures there is `true`; what it reads, `sensor(period_ns).read`.

    Its `sensor` takes a sampling period [ns] and returns the `Sensor`, which all streams of that
    rate share.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: tuple[float, float, float] = values['imu.lever_arm']
        self._turned = values['imu.rpy'] != ZERO
        self._to_sensor = _rotation(*values['imu.rpy']).T
        self._mounting = _quaternion(*values['imu.rpy'])
        self.sensor: Callable[[int], Sensor] = lru_cache(SENSORS_KEPT)(partial(Sensor, values))

    def orientation(self, states: States) -> Quaternion:
        """Return q(world <- IMU): columns x, y, z, w."""
        if not self._turned:
            return states.rows_quaternion
        return attitude.product(states.rows_quaternion, self._mounting)

    def in_body(self, orientation: Quaternion, rates: Vector) -> tuple[Quaternion, Vector]:
        """Return attitude and rates of the body from those of the IMU."""
        if not self._turned:
            return orientation, rates
        x, y, z, w = self._mounting
        return (attitude.product(orientation, (-x, -y, -z, w)),
                _apply(self._to_sensor.T, rates))

    def true(self, states: States) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the IMU's frame."""
        rates = states.rows_angular_velocity
        force = states.specific_force(self._lever_arm)
        if self._turned:
            return _apply(self._to_sensor, rates), _apply(self._to_sensor, force)
        return rates, force


class Axes:
    """
    The errors of three axes of one kind, `imu.<kind>_...`, in samples `period` [s] apart.

    white : standard deviation of one sample's noise, density/sqrt(period)
    walk : of the bias' change from one sample to the next, random walk x sqrt(period)
    turn_on : of the bias at the start
    variance : of what is added to a sample besides the bias: white noise and rounding

    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140)
    """

    def __init__(self, values: Mapping[str, Any], kind: str, period: float) -> None:
        self.white: float = values[f'imu.{kind}_noise_density'] / math.sqrt(period)
        self.walk: float = values[f'imu.{kind}_random_walk'] * math.sqrt(period)
        self.turn_on: float = values[f'imu.{kind}_turn_on_bias']
        self._limit: float = values[f'imu.{kind}_range'] or math.inf
        self._resolution: float = values[f'imu.{kind}_resolution']
        self.is_random = bool(self.white or self.walk or self.turn_on)
        self.is_perfect = not (self.is_random or self._resolution) and self._limit == math.inf
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
    What the IMU reads at a rate: noise of sample k depends on the seed and on k alone.

    Block b of 512 samples is drawn from a generator keyed by seed and b (Philox, counter-based:
    Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11), so that samples can be
    read from anywhere.  The bias at the start of a block is the sum over the blocks before it.
    It is kept for the newest few blocks; older blocks are summed again from 0.
    """

    BLOCK = 512
    STARTS_KEPT = 4

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        period = period_ns * 1e-9
        self.gyroscope = Axes(values, 'gyroscope', period)
        self.accelerometer = Axes(values, 'accelerometer', period)
        kinds = (self.gyroscope, self.accelerometer)
        self._perfect = all(kind.is_perfect for kind in kinds)
        self._random = any(kind.is_random for kind in kinds)
        self._seed: int = values['seed']
        self._white = np.repeat([kind.white for kind in kinds], 3)
        self._walk = np.repeat([kind.walk for kind in kinds], 3)
        # Where the bias of block b begins; that of block 0 is the turn-on bias.
        self._bias_starts = {0: np.repeat([kind.turn_on for kind in kinds], 3)
                             * self._normal(0, 6, turn_on=True)[0]}
        self._block: tuple[int, Rows] = -1, np.empty((0, 12))
        self._newest: tuple[range, Rows] = range(0), np.empty((12, 0))

    def read(self, exact: tuple[Vector, Vector], indices: range) -> tuple[Vector, Vector]:
        """
        Return the readings of rates [rad/s] and force [m/s^2] in consecutive samples.

        exact : what an ideal sensor reads there
        indices : numbers k of the samples
        """
        if self._perfect:
            return exact
        drawn = self._drawn(indices)
        return (self.gyroscope.read(exact[0], drawn[0:3], drawn[6:9]),
                self.accelerometer.read(exact[1], drawn[3:6], drawn[9:12]))

    def bias(self, indices: range) -> tuple[Vector, Vector]:
        """Return the bias in consecutive samples: [rad/s], [m/s^2]."""
        drawn = self._drawn(indices)
        return (drawn[6], drawn[7], drawn[8]), (drawn[9], drawn[10], drawn[11])

    def _drawn(self, indices: range) -> Rows:
        """Return white noise (rates, force) and bias (rates, force) of samples, (12, n)."""
        if not self._random:
            return NO_NOISE
        if self._newest[0] != indices:      # streams of one rate ask for the same ones
            first, last = indices[0] // self.BLOCK, indices[-1] // self.BLOCK
            drawn = np.vstack([self._of_block(block) for block in range(first, last + 1)])
            begin = indices[0] - first * self.BLOCK
            self._newest = indices, np.ascontiguousarray(drawn[begin:begin + len(indices)].T)
        return self._newest[1]

    def _of_block(self, block: int) -> Rows:
        """Return a block (512, 12), by way of those before it whose last bias is not kept."""
        if self._block[0] == block:
            return self._block[1]
        starts = self._bias_starts
        nearest = max(b for b in starts if b <= block)
        start = starts[nearest]
        for at in range(nearest, block + 1):
            normal = self._normal(at, 12)
            steps = normal[:, 6:] * self._walk
            if at == 0:
                steps[0] = 0.0          # sample 0 has the turn-on bias itself
            bias = start + np.cumsum(steps, axis=0)
            start = bias[-1].copy()     # not a view that keeps all
        starts[block + 1] = starts.pop(block + 1, start)
        if len(starts) > self.STARTS_KEPT:
            del starts[list(starts)[1]]                 # the oldest; that of block 0 stays
        self._block = block, np.hstack((normal[:, :6] * self._white, bias))
        return self._block[1]

    def _normal(self, block: int, columns: int, turn_on: bool = False) -> Rows:
        """Draw the normal numbers of a block (512, columns), or the turn-on bias (1, columns)."""
        generator = np.random.Generator(np.random.Philox(
            key=self._seed, counter=[0, 0, int(turn_on), block]))
        return generator.standard_normal((1 if turn_on else self.BLOCK, columns))


def _rotation(roll: float, pitch: float, yaw: float) -> Rows:
    """Return R(body <- IMU) = Rz(yaw) Ry(pitch) Rx(roll), (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    return np.array(((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
                     (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
                     (-sp, cp * sr, cp * cr)))


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the same rotation as columns x, y, z, w of one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)


def _apply(m: Rows, v: Vector) -> Vector:
    """Return the product m v, without matrix products: their order of summation may vary."""
    x, y, z = v
    first, second, third = (a * x + b * y + c * z for a, b, c in m)
    return first, second, third
