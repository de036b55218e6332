# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit (IMU) on the body: what its sensor feels, and its increments.

Conventions: REP-145 (at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed),
URDF roll-pitch-yaw.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.bandwidth import LowPass
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.inertial_sensor import Sensor
from spinning_top_sim.streams.parameters import LOWEST_RATE_OF_INTERVALS
from spinning_top_sim.streams.path import Segment
from spinning_top_sim.streams.stream import Samples, period_ns
from spinning_top_sim.streams.vibration import Vibration

# The longest interval over which means and increments are taken [ns].
LONGEST_NS = round(NANOSECONDS / LOWEST_RATE_OF_INTERVALS)


class Imu:
    """
    The IMU at `imu.lever_arm` [m] with orientation `imu.rpy` [rad] on the body.

    `true`, `means` and `increments` are exact, `felt` adds bandwidth and vibration, `sensor` the
    errors.

    sensor : the errors of its readings
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
        """Return a vector given in the body frame in the frame of the IMU."""
        return attitude.rotated_back(self._mounting, vector) if self._is_rotated else vector


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll) as columns x, y, z, w with one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
