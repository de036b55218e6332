# SPDX-License-Identifier: Apache-2.0
"""
The sensors on the body: where they are, and what they read.

Conventions: REP-145 (at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed),
URDF roll-pitch-yaw.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.felt import LowPass, Vibration
from spinning_top_sim.streams.noise import Kind
from spinning_top_sim.streams.sensor import Errors, Sensor, summed, transformed
from spinning_top_sim.times import NANOSECONDS, Times


class Mounting:
    """
    Where a sensor is on the body.

    lever_arm : its position in the body [m]
    rotation : q(body <- sensor) as columns x, y, z, w with one row; None: the axes of the body
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.lever_arm: Point = values['imu.lever_arm']
        rpy = values['imu.rpy']
        # Rz(yaw) Ry(pitch) Rx(roll)
        (cr, cp, cy), (sr, sp, sy) = (wave(0.5 * np.array(rpy)[:, np.newaxis])
                                      for wave in (np.cos, np.sin))
        self.rotation = (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
                         sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr
                         ) if any(rpy) else None

    def orientation(self, states: States) -> Quaternion:
        """Return q(world <- sensor) as columns x, y, z, w."""
        return (states.rows_quaternion if self.rotation is None
                else attitude.product(states.rows_quaternion, self.rotation))

    def from_body(self, vector: Vector) -> Vector:
        """Return a vector given in the body frame in the frame of the sensor."""
        return vector if self.rotation is None else attitude.rotated_back(self.rotation, vector)

    def to_body(self, orientation: Quaternion, rates: Vector) -> tuple[Quaternion, Vector]:
        """Return orientation and angular velocity of the body from those of the sensor."""
        if self.rotation is None:
            return orientation, rates
        x, y, z, w = self.rotation
        inverse = -x, -y, -z, w
        return attitude.product(orientation, inverse), attitude.rotated_back(inverse, rates)

    def true(self, states: States) -> tuple[Vector, Vector]:
        """Return angular velocity [rad/s] and specific force [m/s^2] in the sensor's frame."""
        return (self.from_body(states.rows_angular_velocity),
                self.from_body(states.specific_force(self.lever_arm)))


class Imu:
    """
    An IMU that takes a sample every `period_ns`, since a change of its rate.

    mounting : where it is
    gyroscope, accelerometer : the errors of its readings
    orientation_variances : of the orientation that it estimates, about its axes [rad^2]
    takes_means : whether a sample is the mean over the interval before it (`imu.sampling`)
    since_ns : when this rate began [ns]
    memory_ns : the time before a sample that its reading depends on [ns]

    Intervals [t - period, t) end with the samples; that of t = 0 is empty.  After a change of the
    rate the first one begins with the last sample of the old rate: no motion is left out.
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int, *, since_ns: int = 0,
                 first_begin_ns: int = 0) -> None:
        self._values, self.period_ns, self.since_ns = values, period_ns, since_ns
        self._first_begin_ns = first_begin_ns       # of the first interval
        self.mounting = Mounting(values)
        self.takes_means = values['imu.sampling'] == 'mean'
        self.gyroscope, self.accelerometer = (
            Sensor(values, f'imu.{kind.name.lower()}_', kind, period_ns,
                   matrix=values[f'imu.{kind.name.lower()}_M'])
            for kind in (Kind.GYROSCOPE, Kind.ACCELEROMETER))
        self._g_sensitivity = values['imu.gyroscope_A']
        self.orientation_variances = tuple(one * one for one in values['imu.orientation_stddev'])
        self.is_perfect = (self.gyroscope.is_perfect and self.accelerometer.is_perfect
                           and not any(self._g_sensitivity))
        bandwidth = values['imu.bandwidth']
        self.low_pass = LowPass(bandwidth, values['imu.bandwidth_order']) if bandwidth else None
        self._vibrations = [Vibration(
            values, name, self.low_pass.response if self.low_pass else np.ones_like)
            for name in ('rate', 'force')]
        self.vibrates = not all(one.is_off for one in self._vibrations)
        interval_ns = period_ns + since_ns - first_begin_ns
        self.memory_ns = max(interval_ns, self.low_pass.memory_ns if self.low_pass else 0)

    def vibrating(self, true: tuple[Vector, Vector], t_ns: Times,
                  seconds: Column | float) -> tuple[Vector, Vector]:
        """Return true rates and forces with vibration; see `Vibration.add`."""
        rates, force = (one.add(vector, t_ns, seconds)
                        for one, vector in zip(self._vibrations, true, strict=True))
        return rates, force

    def errors(self, t_ns: Times) -> tuple[Errors, Errors]:
        """Return white noise and bias of rates and of forces at times (n,) [ns]."""
        return self.gyroscope.errors(t_ns), self.accelerometer.errors(t_ns)

    def read(self, true: tuple[Vector, Vector],
             errors: tuple[Errors, Errors]) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] of true rates and forces with these errors."""
        if self.is_perfect:
            return true
        (rates, force), (of_rates, of_force) = true, errors
        added = (transformed(self._g_sensitivity, force) if any(self._g_sensitivity)
                 else (0.0, 0.0, 0.0))
        return (self.gyroscope.read(rates, of_rates, added),
                self.accelerometer.read(force, of_force))

    def estimated(self, orientation: Quaternion, t_ns: Times) -> Quaternion:
        """Return an orientation at times (n,) [ns] as the IMU estimates it, with noise."""
        if not any(self.orientation_variances):
            return orientation
        x, y, z = np.sqrt(self.orientation_variances)[:, np.newaxis] * noise.white(
            self._values['seed'], Kind.ORIENTATION, t_ns // self.period_ns)
        return attitude.product(orientation, attitude.quaternion_of_vector((x, y, z)))

    def at_period(self, period_ns: int, now_ns: int) -> 'Imu':
        """Return the IMU that takes samples with another period after `now_ns`."""
        if period_ns == self.period_ns:
            return self
        last_ns = now_ns // self.period_ns * self.period_ns
        if last_ns <= self.since_ns:        # no sample since the change before this one
            last_ns = self._first_begin_ns
        return Imu(self._values, period_ns, since_ns=now_ns, first_begin_ns=last_ns)

    def begins_ns(self, t_ns: Times) -> Times:
        """Return where the intervals that end with samples (n,) begin [ns]."""
        begins_ns = t_ns - self.period_ns
        return np.where(begins_ns > self.since_ns, begins_ns, self._first_begin_ns)


# Of a magnetometer: errors of a `Sensor` that have no parameter.
NO_ERRORS = dict.fromkeys(('mag.turn_on_bias', 'mag.bias_instability', 'mag.bias_stddev',
                           'mag.bias_correlation_time'), 0.0)


class Magnetometer(Sensor):
    """A magnetometer in the frame of the IMU that takes a sample every `period_ns`."""

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        super().__init__({**values, **NO_ERRORS}, 'mag.', Kind.MAGNETOMETER, period_ns,
                         matrix=values['mag.soft_iron'], offset=values['mag.hard_iron'])
        self._field, self._mounting = values['mag.field'], Mounting(values)
        # Of the world, and on the body.
        self._disturbances = [np.reshape(values[f'mag.disturbance.{frame}'], (-1, 5)).tolist()
                              for frame in ('world', 'body')]

    def true(self, orientation: Quaternion) -> Vector:
        """Return the field [T] in frames with these orientations in the world."""
        return attitude.rotated_back(orientation, self._field)

    def disturbed(self, orientation: Quaternion, t_ns: Times) -> Vector:
        """Return the field [T] with the disturbances at times (n,) [ns]."""
        true, (world, body) = self.true(orientation), self._disturbances
        if any(map(any, world)):
            true = summed(true, attitude.rotated_back(orientation, _sum(world, t_ns)))
        return summed(true, self._mounting.from_body(_sum(body, t_ns))) if any(
            map(any, body)) else true


def _sum(events: Sequence[Sequence[float]], t_ns: Times) -> Vector:
    """Return the sum of the fields [T] of events at times (n,) [ns]."""
    total = np.zeros((3, len(t_ns)))
    for begin, end, *field in events:
        goes_on = (t_ns >= round(begin * NANOSECONDS)) & (t_ns < round(end * NANOSECONDS))
        total += np.where(goes_on, np.array(field)[:, np.newaxis], 0.0)
    return total[0], total[1], total[2]
