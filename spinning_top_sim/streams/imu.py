# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit (IMU): its ideal readings, and the errors of the sensor.

The errors follow kalibr's model, with its names and units.  Conventions: REP-145 (at rest an
accelerometer reads +g upwards), REP-103 (x, y, z right-handed), URDF roll-pitch-yaw.
docs/sensor.md describes the whole chain.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.bandwidth import LowPass
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.parameters import BY_NAME, IDENTITY, LOWEST_RATE_OF_INTERVALS
from spinning_top_sim.streams.path import Segment
from spinning_top_sim.streams.stream import Samples, period_ns
from spinning_top_sim.streams.vibration import Vibration

# The longest interval over which means and increments are taken [ns].
LONGEST_NS = round(NANOSECONDS / LOWEST_RATE_OF_INTERVALS)
KINDS = ('gyroscope', 'accelerometer')


class Imu:
    """
    An ideal IMU at `imu.lever_arm` [m] with orientation `imu.rpy` [rad] on the body.

    sensor : adds the errors
    takes_means : whether a sample is the mean over the interval before it (`imu.sampling`)
    length_ns : period of its samples [ns]

    Intervals [t - length, t) end with the samples.  The first one is empty, as the motion begins
    with the first sample.  After a change of the rate the first one begins with the last sample of
    the old rate, so that no motion is left out.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._lever_arm: tuple[float, float, float] = values['imu.lever_arm']
        self._is_rotated = any(values['imu.rpy'])
        self._mounting = _quaternion(*values['imu.rpy'])
        self.takes_means = values['imu.sampling'] == 'mean'
        self._values, self.length_ns = values, period_ns(values['imu.rate'])
        self.sensor = Sensor(values, self.length_ns)
        # When this rate began, and where the first interval after that begins [ns].
        self._since_ns = self._first_begin_ns = 0
        bandwidth = values['imu.bandwidth']
        self._low_pass = (LowPass(bandwidth, values['imu.bandwidth_order']) if bandwidth
                          else None)
        self._vibration = Vibration(
            values, self._low_pass.response if self._low_pass else np.ones_like)

    @property
    def keep_ns(self) -> int:
        """The time before a sample that its reading may need [ns]."""
        interval_ns = min(self.length_ns, LONGEST_NS) + self._since_ns - self._first_begin_ns
        return max(interval_ns, self._low_pass.memory_ns if self._low_pass else 0)

    def set_rate(self, rate: float, now_ns: int) -> bool:
        """Take samples at this rate [Hz] after `now_ns`; return whether the period changes."""
        length_ns = period_ns(rate)
        if length_ns == self.length_ns:
            return False
        last_ns = now_ns // self.length_ns * self.length_ns
        if last_ns <= self._since_ns:       # no sample since the change before this one
            last_ns = self._first_begin_ns
        self.length_ns, self._since_ns = length_ns, now_ns
        self.sensor = Sensor(self._values, length_ns)
        self._first_begin_ns = max(last_ns, now_ns - LONGEST_NS)
        return True

    def _begin_ns(self, end_ns: int) -> int:
        """Return where the interval that ends with a sample begins [ns]."""
        begin_ns = end_ns - self.length_ns
        return begin_ns if begin_ns > self._since_ns else self._first_begin_ns

    def _lengths(self, times: range) -> Column:
        """Return the lengths (n,) [s] of the intervals that end at these times [ns]."""
        return np.array([time - self._begin_ns(time) for time in times]) * 1e-9

    def orientation(self, states: States) -> Quaternion:
        """Return q(world <- IMU) as columns x, y, z, w."""
        if not self._is_rotated:
            return states.rows_quaternion
        return attitude.product(states.rows_quaternion, self._mounting)

    def in_body(self, orientation: Quaternion, rates: Vector) -> tuple[Quaternion, Vector]:
        """Return orientation and angular velocity of the body from those of the IMU."""
        x, y, z, w = self._mounting
        inverse = -x, -y, -z, w
        return attitude.product(orientation, inverse), attitude.rotated_back(inverse, rates)

    def true(self, states: States) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the frame of the IMU."""
        return (self.from_body(states.rows_angular_velocity),
                self.from_body(states.specific_force(self._lever_arm)))

    def means(self, samples: Samples) -> tuple[Vector, Vector]:
        """Return the means of `true` over the intervals that end at these samples."""
        increments = samples.once(self._body_increments)
        seconds = self._lengths(samples.times)
        # The mean over an empty interval is the value itself.
        divisor = np.where(seconds > 0.0, seconds, 1.0)
        states = samples.states
        w1, w2, w3, f1, f2, f3 = (
            np.where(seconds > 0.0, integral / divisor, value) for integral, value in zip(
                (*increments.angles, *increments.forces),
                (*states.rows_angular_velocity, *states.specific_force(self._lever_arm)),
                strict=True))
        return self.from_body((w1, w2, w3)), self.from_body((f1, f2, f3))

    def sampled(self, samples: Samples) -> tuple[Vector, Vector]:
        """Return the readings of a perfect sensor: values or means, as `imu.sampling` says."""
        return samples.once(self.means) if self.takes_means else self.true(samples.states)

    def felt(self, samples: Samples) -> tuple[Vector, Vector]:
        """Return `sampled` with bandwidth and vibration of the sensor, before its errors."""
        if self._low_pass is None:
            exact = self.sampled(samples)
        else:
            w1, w2, w3, f1, f2, f3 = np.concatenate([
                self._low_pass.filtered(segment, times, self._signal)
                for segment, times in samples.shares], axis=1)
            exact = (w1, w2, w3), (f1, f2, f3)
        if self._vibration.is_off:
            return exact
        return self._vibration.add(exact, samples.t_ns, self._lengths(samples.times)
                                   if self.takes_means else 0.0)

    def _signal(self, states: States) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(*itertools.chain(*self.true(states))))

    def carry(self, before: Segment, after: Segment) -> None:
        """Let a segment begin with the state of the filter at the end of the one before it."""
        if self._low_pass is not None:
            after.filter_state = self._low_pass.carried(before, after.start_ns, self._signal)

    def measured_increments(self, samples: Samples) -> tuple[Quaternion, Vector]:
        """Return `increments` with the errors of the sensor and its vibration."""
        exact, sensor = self.increments(samples), self.sensor
        if sensor.is_perfect and self._vibration.is_off:
            return exact
        means, seconds = samples.once(self.means), self._lengths(samples.times)
        felt = self._vibration.add(means, samples.t_ns, seconds)
        return sensor.disturb(exact, means, sensor.read(felt, samples.times), seconds)

    def increments(self, samples: Samples) -> tuple[Quaternion, Vector]:
        """Return rotation and velocity increment [m/s] over the intervals that end there."""
        increments = samples.once(self._body_increments)
        x, y, z, w = increments.rotation
        v1, v2, v3 = increments.velocity
        if self._is_rotated:
            x, y, z = attitude.rotated_back(self._mounting, (x, y, z))
        return (x, y, z, w), self.from_body((v1, v2, v3))

    def _body_increments(self, samples: Samples) -> Increments:
        """Return the increments over the intervals that end at these samples, n of each."""
        path, point = samples.path, self._lever_arm
        found: list[Increments] = []
        for segment, times in samples.shares:
            # Those that may be shorter, reach back or contain a jump are computed one by one.
            since_ns = max(self._since_ns + 1, segment.start_ns + segment.jumps)
            single = len(range(times.start, since_ns + self.length_ns, times.step))
            found += [path.increments(self._begin_ns(end_ns), end_ns, point)
                      for end_ns in times[:single]]
            if single < len(times):
                first_ns = times[single]
                found.append(path.increments(self._begin_ns(first_ns), first_ns, point,
                                             len(times) - single, times.step))
        return integrals.joined(found)

    def motion(self, samples: Samples) -> tuple[Vector, Quaternion, Vector]:
        """Return position [m] and orientation in the world, velocity in the IMU's frame [m/s]."""
        states = samples.states
        x, y, z = attitude.rotated(states.rows_quaternion, self._lever_arm)
        v1, v2, v3 = states.velocity(self._lever_arm)
        if samples.pivot_moves:
            (a, b, c), (u, v, w), _ = samples.pivot
            x, y, z = x + a, y + b, z + c
            u, v, w = attitude.rotated_back(states.rows_quaternion, (u, v, w))
            v1, v2, v3 = v1 + u, v2 + v, v3 + w
        return (x, y, z), self.orientation(states), self.from_body((v1, v2, v3))

    def from_body(self, vector: Vector) -> Vector:
        return attitude.rotated_back(self._mounting, vector) if self._is_rotated else vector


class Sensor:
    """
    The errors of an IMU that takes a sample every `period_ns`.

    White noise is numbered by sample: it depends on the seed and the number alone.  The bias is a
    path in time that depends on the seed alone: a change of the rate does not change it.  A
    reading between two samples has the white noise of the one before, as from a driver that
    repeats the newest sample.  So all streams agree at the times that they have in common.

    rate_variance, force_variance : variances of white noise and rounding together
    orientation_variances : about the axes of the IMU [rad^2]
    is_perfect : whether the readings are exact

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

    def read(self, exact: tuple[Vector, Vector], times: range) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] of `exact`, the true values at these times [ns]."""
        if self.is_perfect:
            return exact
        white, bias = self._noise.at(times)
        # The chain of docs/sensor.md: matrices, g-sensitivity, bias, noise, rounding, range.
        rates, force = exact
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

    def orientation(self, exact: Quaternion, times: range) -> Quaternion:
        """Return the orientation that the IMU estimates; its error is in the IMU's frame."""
        if not any(self.orientation_variances):
            return exact
        (x, y, z), _ = self._orientation_noise.at(times)
        return attitude.product(exact, attitude.quaternion_of_vector((x, y, z)))

    def disturb(self, exact: tuple[Quaternion, Vector], means: tuple[Vector, Vector],
                readings: tuple[Vector, Vector], seconds: Column,
                ) -> tuple[Quaternion, Vector]:
        """
        Return the measured increments over intervals.

        The error of the mean readings acts throughout the interval, in the frame of the sensor:
        it adds to the rotation vector, and to the velocity half-way through the rotation.

        exact : the true increments
        means : the true mean rates [rad/s] and forces [m/s^2]
        readings : those of the sensor, of the same
        seconds : lengths of the intervals (n,) [s]
        """
        rotation, (v1, v2, v3) = exact
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


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll) as columns x, y, z, w with one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
