# SPDX-License-Identifier: Apache-2.0
"""The errors of a sensor and of its clock, with kalibr's names; docs/sensor.md has the chain."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column, Vector
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.noise import Part, RandomPath
from spinning_top_sim.streams.parameters import IDENTITY
from spinning_top_sim.times import NANOSECONDS, Times

# Jitter is cut at this share of the period, so that no stamp is before that of an earlier sample.
MOST_JITTER = 0.45
# White noise and bias, (3, n) or (3, 1) each.
Errors = tuple[NDArray[np.float64], NDArray[np.float64]]


class Sensor:
    """
    A sensor that takes a sample of three axes every `period_ns`.

    White noise depends on the seed and the number of a sample; a reading between two samples has
    that of the one before.  The bias is a path in time that depends on the seed alone.  So all
    streams agree at the times that they have in common.

    values, prefix : parameters, and what their names begin with
    kind : tells the random numbers of sensors apart
    matrix : scale and misalignment, or soft iron, row by row
    offset : constant part of the bias, x, y, z
    variance : of white noise and rounding together
    is_perfect : whether the readings are the true values

    (J. Rehder et al., "Extending kalibr", ICRA 2016; V. Renaudin et al., "Complete triaxis
    magnetometer calibration in the magnetic domain", Journal of Sensors 2010)
    """

    def __init__(self, values: Mapping[str, Any], prefix: str, kind: noise.Kind, period_ns: int, *,
                 matrix: Sequence[float], offset: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        def given(error: str) -> float:
            return float(values[prefix + error])

        seed = self._seed = values['seed']
        self._kind, self._period_ns = kind, period_ns
        self._matrix, self._resolution, self._range = matrix, given('resolution'), given('range')
        self._deviation = given('noise_density') / math.sqrt(period_ns * 1e-9)
        self.variance = self._deviation ** 2 + self._resolution ** 2 / 12.0
        # Adding 0.0 turns -0.0 into 0.0.
        self._offset = np.array(offset)[:, np.newaxis] + 0.0
        if turn_on := given('turn_on_bias'):
            self._offset = self._offset + turn_on * noise.white(
                seed, kind, np.zeros(1, np.int64), part=Part.TURN_ON)
        flat = given('bias_instability')
        self._paths = [RandomPath(seed, kind, part, tuple(processes)) for part, processes in (
            (Part.WALK, [(math.inf, given('random_walk'))]),
            (Part.GAUSS_MARKOV, [(given('bias_correlation_time'), given('bias_stddev'))]),
            (Part.FLICKER, [(time, share * flat) for time, share in noise.flicker_parts(
                *values['imu.bias_instability_band'])] if flat else []),
        ) if any(deviation for _, deviation in processes)]
        self.is_perfect = not (self.variance or self._range or self._paths or self._offset.any()
                               or tuple(matrix) != IDENTITY)

    def errors(self, t_ns: Times) -> Errors:
        """Return white noise and bias at times (n,) [ns]."""
        white, bias = np.zeros((3, 1)), self._offset
        if self._deviation:
            white = self._deviation * noise.white(
                self._seed, self._kind, t_ns // self._period_ns)
        for path in self._paths:
            bias = bias + path.at(t_ns)
        return white, bias

    def read(self, true: Vector, errors: Errors, added: Vector = (0.0, 0.0, 0.0)) -> Vector:
        """Return the readings of true values; `added` comes behind the matrix."""
        x, y, z = (converted(value + bias + white, self._resolution, self._range)
                   for value, white, bias in zip(
                       summed(transformed(self._matrix, true), added), *errors, strict=True))
        return x, y, z


class Timing:
    """
    The clock of an IMU, and its losses, by seed, number and time of a sample alone.

    period_ns : of its samples [ns]
    is_right : whether there are no faults
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        self._seed, self._period_ns = values['seed'], period_ns
        self._offset_ns = round(values['imu.stamp_offset'] * NANOSECONDS)
        self._jitter_ns = values['imu.stamp_jitter'] * NANOSECONDS
        self._drift = values['imu.clock_drift'] * 1e-6
        # A standard normal number is below these with the probability of the fault.
        rates = values['imu.drop_rate'], values['imu.duplicate_rate']
        self._dropped_below, self._repeated_below = (
            NormalDist().inv_cdf(rate) if rate else -np.inf for rate in rates)
        self.is_right = not any((self._offset_ns, self._jitter_ns, self._drift, *rates))

    def __call__(self, t_ns: Times) -> tuple[Times, Times]:
        """Return how late stamps of samples (n,) are [ns], and how often each is sent: 0 to 2."""
        jitter, drop, repeat = noise.white(
            self._seed, noise.Kind.TIMING, t_ns // self._period_ns)
        most = MOST_JITTER * self._period_ns
        errors = self._drift * t_ns + np.clip(self._jitter_ns * jitter, -most, most)
        return self._offset_ns + np.rint(errors).astype(np.int64), np.where(
            drop < self._dropped_below, 0, np.where(repeat < self._repeated_below, 2, 1))


def summed(one: Vector, other: Vector) -> Vector:
    """Return the sum of two vectors, in columns (n,)."""
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def converted(value: Column, resolution: float, largest: float) -> Column:
    """Return values (n,) rounded, then clipped to multiples within a range; 0 means none."""
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
