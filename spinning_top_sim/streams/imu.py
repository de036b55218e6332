# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit: where it sits on the body, and what it adds to the truth.

The errors follow kalibr's model, with its names and units.  Conventions: REP-145 (at rest an
accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
docs/sensor.md has the whole chain.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.intervals import Intervals
from spinning_top_sim.streams.parameters import IDENTITY
from spinning_top_sim.streams.stream import Samples, period_ns

if TYPE_CHECKING:
    from spinning_top_sim.streams.noise import SensorNoise

# Six columns: three axes of the gyroscope, three of the accelerometer.
Rows = NDArray[np.float64]
NO_ERRORS = np.zeros((6, 1))


class Imu:
    """
    The kinematics of an ideal IMU at `imu.lever_arm` [m] and `imu.rpy` [rad] on the body.

    sensor : returns the `Sensor` for a sample period [ns]; it adds the errors
    takes_means : whether a sample is the mean over the interval before it, by `imu.sampling`
    intervals : the intervals between its samples
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: tuple[float, float, float] = values['imu.lever_arm']
        self._is_rotated = any(values['imu.rpy'])
        self._mounting = _quaternion(*values['imu.rpy'])
        self.sensor: Callable[[int], Sensor] = lru_cache(4)(partial(Sensor, values))
        self.takes_means = values['imu.sampling'] == 'mean'
        self.intervals = Intervals(period_ns(values['imu.rate']))

    def set_rate(self, rate: float, now_ns: int) -> bool:
        """Take samples at this rate [Hz] after `now_ns`; return whether that is a change."""
        length_ns = period_ns(rate)
        if length_ns == self.intervals.length_ns:
            return False
        self.intervals = self.intervals.changed(length_ns, now_ns)
        return True

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
        return (self._from_body(states.rows_angular_velocity),
                self._from_body(states.specific_force(self._lever_arm)))

    def means(self, samples: Samples) -> tuple[Vector, Vector]:
        """Return the means of `true` over the intervals that end with these samples."""
        increments, seconds = samples.once(self._body_increments), self.lengths(samples)
        # Over no time the mean is the value.
        divisor = np.where(seconds > 0.0, seconds, 1.0)
        states = samples.states
        w1, w2, w3, f1, f2, f3 = (
            np.where(seconds > 0.0, integral / divisor, value) for integral, value in zip(
                (*increments.angles, *increments.forces),
                (*states.rows_angular_velocity, *states.specific_force(self._lever_arm)),
                strict=True))
        return self._from_body((w1, w2, w3)), self._from_body((f1, f2, f3))

    def sampled(self, samples: Samples) -> tuple[Vector, Vector]:
        """Return what a perfect sensor reads, by `imu.sampling`."""
        return samples.once(self.means) if self.takes_means else self.true(samples.states)

    def lengths(self, samples: Samples) -> Column:
        """Return the lengths (n,) [s] of the intervals that end with these samples."""
        return self.intervals.lengths(samples.times)

    def increments(self, samples: Samples) -> tuple[Quaternion, Vector]:
        """Return rotation and velocity increment [m/s] over these intervals."""
        increments = samples.once(self._body_increments)
        x, y, z, w = increments.rotation
        v1, v2, v3 = increments.velocity
        if self._is_rotated:
            x, y, z = attitude.in_body(self._mounting, (x, y, z))
        return (x, y, z, w), self._from_body((v1, v2, v3))

    def _body_increments(self, samples: Samples) -> Increments:
        return self.intervals.increments(samples.path, samples.times, self._lever_arm)

    def motion(self, states: States) -> tuple[Vector, Vector]:
        """Return position in the world [m], and velocity in the IMU's frame [m/s]."""
        x, y, z, w = states.rows_quaternion
        return (attitude.in_body((-x, -y, -z, w), self._lever_arm),
                self._from_body(states.velocity(self._lever_arm)))

    def _from_body(self, vector: Vector) -> Vector:
        # What the world is to the body, the body is to the IMU.
        return attitude.in_body(self._mounting, vector) if self._is_rotated else vector


class Sensor:
    """
    The readings of an IMU that takes a sample every `period_ns`.

    White noise is numbered by sample: that of sample k depends on the seed and on k alone.  The
    bias is a path in time, which depends on the seed alone: a change of the rate does not move it.
    A reading between two samples has the noise of the one before, as of a driver that sends the
    newest sample, so that all streams agree where they have a time in common.

    rate_variance, force_variance : of white noise and rounding together
    orientation_variances : about the axes of the IMU [rad^2]
    is_perfect : whether the readings are the truth

    (kalibr, "IMU Noise Model"; N. Trawny, S. Roumeliotis, "Indirect Kalman filter for 3D attitude
    estimation", 2005, eqs. 133, 140; for the matrices J. Rehder et al., "Extending kalibr", ICRA
    2016)
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        def six(name: str) -> Rows:
            rate, force = values[f'imu.gyroscope_{name}'], values[f'imu.accelerometer_{name}']
            return np.repeat((rate, force), 3)[:, np.newaxis]

        self._rate_matrix, self._force_matrix = (
            values[f'imu.{kind}_M'] for kind in ('gyroscope', 'accelerometer'))
        self._g_sensitivity = values['imu.gyroscope_A']
        white = six('noise_density') / math.sqrt(period_ns * 1e-9)
        resolution, limit = six('resolution'), six('range')
        self._converters = [Converter(*pair) for pair in zip(
            resolution[:, 0].tolist(), limit[:, 0].tolist(), strict=True)]
        variances = white ** 2 + resolution ** 2 / 12.0
        self.rate_variance, self.force_variance = variances[[0, 3], 0].tolist()
        is_noisy = any(six(name).any() for name in (
            'noise_density', 'turn_on_bias', 'random_walk', 'bias_stddev', 'bias_instability'))
        self._noise = _noise(values, period_ns, white) if is_noisy else None
        deviations = values['imu.orientation_stddev']
        self.orientation_variances = tuple(deviation ** 2 for deviation in deviations)
        self._orientation_noise = (_orientation_noise(values['seed'], period_ns, deviations)
                                   if any(deviations) else None)
        self.is_perfect = not (
            is_noisy or resolution.any() or limit.any() or any(self._g_sensitivity)
            or (*self._rate_matrix, *self._force_matrix) != 2 * IDENTITY)

    def read(self, exact: tuple[Vector, Vector], times: range) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] at these times [ns] of what is exact there."""
        if self.is_perfect:
            return exact
        white, bias = self._errors(times)
        # The chain of docs/sensor.md: matrices, g-sensitivity, bias, noise, rounding, range.
        rows = [converter.convert(value + one_bias + one_white)
                for value, one_bias, one_white, converter in zip(
                    itertools.chain(*self._distorted(*exact)), bias, white, self._converters,
                    strict=True)]
        return (rows[0], rows[1], rows[2]), (rows[3], rows[4], rows[5])

    def orientation(self, exact: Quaternion, times: range) -> Quaternion:
        """Return the orientation as the IMU estimates it; its error is in the IMU's frame."""
        if self._orientation_noise is None:
            return exact
        (x, y, z), _ = self._orientation_noise.at(times)
        return attitude.product(exact, attitude.quaternion_of_vector((x, y, z)))

    def disturb(self, exact: tuple[Quaternion, Vector], means: tuple[Vector, Vector],
                times: range, seconds: Column) -> tuple[Quaternion, Vector]:
        """
        Return measured increments over intervals of these lengths that end at these times [ns].

        The error of the reading of the means acts throughout the interval, in the sensor's frame:
        it adds to the rotation vector, and to the velocity half-way through the rotation.
        """
        rotation, (v1, v2, v3) = exact
        r1, r2, r3, *force = (
            seconds * (reading - mean) for reading, mean in zip(
                itertools.chain(*self.read(means, times)), itertools.chain(*means), strict=True))
        x, y, z = attitude.rotation_vector(rotation)
        f1, f2, f3 = attitude.in_body(
            attitude.quaternion_of_vector((-0.5 * x, -0.5 * y, -0.5 * z)),
            (force[0], force[1], force[2]))
        return (attitude.quaternion_of_vector((x + r1, y + r2, z + r3)),
                (v1 + f1, v2 + f2, v3 + f3))

    def bias(self, times: range) -> tuple[Vector, Vector]:
        """Return the bias at these times [ns]: [rad/s], [m/s^2]."""
        _, bias = self._errors(times)
        return tuple(bias[:3]), tuple(bias[3:])

    def _distorted(self, rates: Vector, force: Vector) -> tuple[Vector, Vector]:
        """Return rates and force by scale, misalignment and g-sensitivity (kalibr's M and A)."""
        read_rates, read_force = (transformed(self._rate_matrix, rates),
                                  transformed(self._force_matrix, force))
        if any(self._g_sensitivity):
            x, y, z = transformed(self._g_sensitivity, force)
            read_rates = read_rates[0] + x, read_rates[1] + y, read_rates[2] + z
        return read_rates, read_force

    def _errors(self, times: range) -> tuple[Rows, Rows]:
        """Return white noise and bias at these times, (6, n) or (6, 1) each."""
        return self._noise.at(times) if self._noise else (NO_ERRORS, NO_ERRORS)


def _noise(values: Mapping[str, Any], period_ns: int, white: Rows) -> 'SensorNoise':
    """Return the noise of an IMU whose white noise has these standard deviations, (6, 1)."""
    from spinning_top_sim.streams import noise  # noqa: PLC0415 - not for a perfect IMU

    def six(name: str) -> tuple[float, ...]:
        return (*3 * (values[f'imu.gyroscope_{name}'],),
                *3 * (values[f'imu.accelerometer_{name}'],))

    seed, path = values['seed'], partial(noise.Path, values['seed'])
    paths = []
    if any(walk := six('random_walk')):
        paths.append(path(noise.Purpose.WALK, (6 * (math.inf,),), (walk,)))
    if any(deviation := six('bias_stddev')):
        paths.append(path(noise.Purpose.GAUSS_MARKOV, (six('bias_correlation_time'),),
                          (deviation,)))
    if any(flat := six('bias_instability')):
        parts = noise.flicker_parts(*values['imu.bias_instability_band'])
        paths.append(path(noise.Purpose.FLICKER, tuple(6 * (time,) for time, _ in parts),
                          tuple(tuple(part * one for one in flat) for _, part in parts)))
    turn_on = np.array(six('turn_on_bias'))[:, np.newaxis] * noise.constant(
        seed, noise.Purpose.TURN_ON, 6)
    return noise.SensorNoise(seed, noise.Purpose.WHITE, period_ns, white, turn_on, paths)


def _orientation_noise(seed: int, period_ns: int, deviations: Sequence[float]) -> 'SensorNoise':
    from spinning_top_sim.streams import noise  # noqa: PLC0415 - not for a perfect IMU

    return noise.SensorNoise(seed, noise.Purpose.ORIENTATION, period_ns,
                             np.array(deviations)[:, np.newaxis], np.zeros((3, 1)), ())


class Converter:
    """What turns a value into a reading: rounded to the resolution, then cut at the range."""

    def __init__(self, resolution: float, limit: float) -> None:
        self._step, self._limit = resolution, _largest_reading(limit, resolution)

    def convert(self, value: Column) -> Column:
        """Return the readings of these values, (n,)."""
        if self._step:
            # + 0.0: no reading is -0.
            value = (np.rint(value / self._step) + 0.0) * self._step
        return np.clip(value, -self._limit, self._limit)


def transformed(matrix: Sequence[float], vector: Vector) -> Vector:
    """Return a matrix, given row by row, times a vector; the identity changes no bit of it."""
    if tuple(matrix) == IDENTITY:
        return vector
    x, y, z = vector
    a, b, c, d, e, f, g, h, i = matrix
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def _largest_reading(limit: float, step: float) -> float:
    """Return the largest multiple of the resolution within the range; 0 is no limit."""
    if not limit:
        return math.inf
    if not step:
        return limit
    count = math.floor(limit / step)
    return (count if count * step <= limit else count - 1) * step


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll) as columns x, y, z, w of one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
