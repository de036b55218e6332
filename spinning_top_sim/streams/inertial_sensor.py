# SPDX-License-Identifier: Apache-2.0
"""The errors of an IMU, with kalibr's names and units; docs/sensor.md describes the chain."""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.parameters import BY_NAME, IDENTITY

KINDS = ('gyroscope', 'accelerometer')


class Sensor:
    """
    The errors of an IMU that takes a sample every `period_ns`.

    White noise is numbered by sample: it depends on the seed and the number alone.  The bias is a
    path in time that depends on the seed alone: a change of the rate does not change it.  A
    reading between two samples has the white noise of the one before, as from a driver that
    repeats the newest sample.  So all streams agree at the times that they have in common.

    rate_variance, force_variance : variances of white noise and rounding together
    orientation_variances : about the axes of the IMU [rad^2]
    is_perfect : whether the readings are the true values

    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140; for the matrices J. Rehder et al., "Extending kalibr", ICRA
    2016)
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        self._rate_matrix, self._force_matrix = (values[f'imu.{kind}_M'] for kind in KINDS)
        self._g_sensitivity = values['imu.gyroscope_A']
        self.is_perfect = all(
            values[name] == one.default for name, one in BY_NAME.items()
            if name.startswith(('imu.gyroscope_', 'imu.accelerometer_'))
            and not name.endswith('correlation_time'))
        self._resolutions, self._ranges = _six(values, 'resolution'), _six(values, 'range')
        white = np.array(_six(values, 'noise_density')) / math.sqrt(period_ns * 1e-9)
        variances = (white ** 2 + np.array(self._resolutions) ** 2 / 12.0).tolist()
        self.rate_variance, self.force_variance = variances[0], variances[3]
        turn_on_bias = np.array(_six(values, 'turn_on_bias'))[:, np.newaxis]
        if turn_on_bias.any():
            turn_on_bias *= noise.constants(values['seed'], noise.Purpose.TURN_ON, 6)
        self._noise = noise.SensorNoise(
            values['seed'], noise.Purpose.WHITE, period_ns, white[:, np.newaxis], turn_on_bias,
            _bias_paths(values))
        deviations = values['imu.orientation_stddev']
        self.orientation_variances = tuple(deviation ** 2 for deviation in deviations)
        self._orientation_noise = noise.SensorNoise(
            values['seed'], noise.Purpose.ORIENTATION, period_ns,
            np.array(deviations)[:, np.newaxis], np.zeros((3, 1)))

    def read(self, true: tuple[Vector, Vector], times: range) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] of `true`, the true values at these times [ns]."""
        if self.is_perfect:
            return true
        white, bias = self._noise.at(times)
        # The chain of docs/sensor.md: matrices, g-sensitivity, bias, noise, rounding, range.
        rates, force = true
        rates = transformed(self._rate_matrix, rates)
        if any(self._g_sensitivity):
            x, y, z = transformed(self._g_sensitivity, force)
            rates = rates[0] + x, rates[1] + y, rates[2] + z
        w1, w2, w3, f1, f2, f3 = (
            converted(value + one_bias + one_white, resolution, largest)
            for value, one_bias, one_white, resolution, largest in zip(
                (*rates, *transformed(self._force_matrix, force)), bias, white, self._resolutions,
                self._ranges, strict=True))
        return (w1, w2, w3), (f1, f2, f3)

    def orientation(self, true: Quaternion, times: range) -> Quaternion:
        """Return the orientation that the IMU estimates; its error is in the IMU's frame."""
        if not any(self.orientation_variances):
            return true
        (x, y, z), _ = self._orientation_noise.at(times)
        return attitude.product(true, attitude.quaternion_of_vector((x, y, z)))

    def disturb(self, true: tuple[Quaternion, Vector], means: tuple[Vector, Vector],
                readings: tuple[Vector, Vector], seconds: Column,
                ) -> tuple[Quaternion, Vector]:
        """
        Return the measured increments over intervals.

        The error of the mean readings acts throughout the interval, in the frame of the sensor:
        it adds to the rotation vector, and to the velocity half-way through the rotation.

        true : the true increments
        means : the true mean rates [rad/s] and forces [m/s^2]
        readings : those of the sensor, of the same
        seconds : lengths of the intervals (n,) [s]
        """
        rotation, (v1, v2, v3) = true
        r1, r2, r3, *force = (
            seconds * (reading - mean) for reading, mean in zip(
                itertools.chain(*readings), itertools.chain(*means), strict=True))
        x, y, z = attitude.rotation_vector(rotation)
        f1, f2, f3 = attitude.rotated_back(
            attitude.quaternion_of_vector((-0.5 * x, -0.5 * y, -0.5 * z)),
            (force[0], force[1], force[2]))
        return (attitude.quaternion_of_vector((x + r1, y + r2, z + r3)),
                (v1 + f1, v2 + f2, v3 + f3))

    def bias(self, times: range) -> tuple[Vector, Vector]:
        """Return the biases [rad/s], [m/s^2] of the readings at these times [ns]."""
        _, (w1, w2, w3, f1, f2, f3) = self._noise.at(times)
        return (w1, w2, w3), (f1, f2, f3)


def _six(values: Mapping[str, Any], error: str) -> tuple[float, ...]:
    """Return a parameter for the three axes of the gyroscope and those of the accelerometer."""
    rate, force = (values[f'imu.{kind}_{error}'] for kind in KINDS)
    return 3 * (rate,) + 3 * (force,)


def _bias_paths(values: Mapping[str, Any]) -> list[noise.RandomPath]:
    """Return the parts of the bias that vary with time."""
    path, paths = partial(noise.RandomPath, values['seed']), []
    if any(walk := _six(values, 'random_walk')):
        paths.append(path(noise.Purpose.WALK, (6 * (math.inf,),), (walk,)))
    if any(deviation := _six(values, 'bias_stddev')):
        paths.append(path(noise.Purpose.GAUSS_MARKOV, (_six(values, 'bias_correlation_time'),),
                          (deviation,)))
    if any(flat := _six(values, 'bias_instability')):
        parts = noise.flicker_parts(*values['imu.bias_instability_band'])
        paths.append(path(noise.Purpose.FLICKER, tuple(6 * (time,) for time, _ in parts),
                          tuple(tuple(part * one for one in flat) for _, part in parts)))
    return paths


def converted(value: Column, resolution: float, largest: float) -> Column:
    """
    Return readings (n,) of an analog-to-digital converter: rounded, then clipped to a range.

    The limits are the largest multiples of the resolution within the range.  A resolution or a
    range of 0 means none.
    """
    limit = largest or math.inf
    if resolution:
        if largest:
            steps = math.floor(largest / resolution)
            limit = (steps if steps * resolution <= largest else steps - 1) * resolution
        # Adding 0.0 turns -0.0 into 0.0.
        value = (np.rint(value / resolution) + 0.0) * resolution
    return np.clip(value, -limit, limit)


def transformed(matrix: Sequence[float], vector: Vector) -> Vector:
    """Return a row-major matrix times a vector; the identity returns the vector unchanged."""
    if tuple(matrix) == IDENTITY:
        return vector
    x, y, z = vector
    a, b, c, d, e, f, g, h, i = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
