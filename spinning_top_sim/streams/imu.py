# SPDX-License-Identifier: Apache-2.0
"""
The inertial measurement unit (IMU) on the body: where it is, what it feels, and what it reads.

Conventions: REP-145 (at rest an accelerometer reads +g upwards), REP-103 (x, y, z right-handed),
URDF roll-pitch-yaw.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import chain, pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.pivot import ns_array
from spinning_top_sim.physics.states import Point, States
from spinning_top_sim.solvers.handover import Piece
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.bandwidth import LowPass
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.noise import Kind, Part
from spinning_top_sim.streams.parameters import LOWEST_RATE_OF_INTERVALS
from spinning_top_sim.streams.sensor import Errors, Sensor, transformed
from spinning_top_sim.streams.trajectory import Trajectory
from spinning_top_sim.streams.vibration import Vibration

# The longest interval over which means and increments are taken [ns].
LONGEST_NS = round(NANOSECONDS / LOWEST_RATE_OF_INTERVALS)


@dataclass(frozen=True)
class Mounting:
    """
    Where a sensor is on the body.

    lever_arm : its position in the body [m]
    rotation : q(body <- sensor) as columns x, y, z, w with one row; None: the axes of the body
    """

    lever_arm: tuple[float, float, float]
    rotation: Quaternion | None

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        rpy = values['imu.rpy']
        return cls(values['imu.lever_arm'], _quaternion(*rpy) if any(rpy) else None)

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

    def felt(self, states: States) -> tuple[Vector, Vector]:
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
    memory_ns : the time before a sample that its reading depends on [ns]

    Intervals [t - period, t) end with the samples.  The first one is empty, as the motion begins
    with the first sample.  After a change of the rate the first one begins with the last sample of
    the old rate, so that no motion is left out.
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int, *, since_ns: int = 0,
                 first_begin_ns: int = 0) -> None:
        self._values, self.period_ns = values, period_ns
        # When this rate began, and where the first interval after that begins [ns].
        self.since_ns, self.first_begin_ns = since_ns, first_begin_ns
        self.mounting = Mounting.of(values)
        self.takes_means = values['imu.sampling'] == 'mean'
        self.gyroscope = Sensor(values, 'imu.gyroscope_', Kind.GYROSCOPE, period_ns,
                                matrix=values['imu.gyroscope_M'])
        self.accelerometer = Sensor(values, 'imu.accelerometer_', Kind.ACCELEROMETER, period_ns,
                                    matrix=values['imu.accelerometer_M'])
        self._g_sensitivity = values['imu.gyroscope_A']
        self.orientation_variances = tuple(one * one for one in values['imu.orientation_stddev'])
        self.is_perfect = (self.gyroscope.is_perfect and self.accelerometer.is_perfect
                           and not any(self._g_sensitivity))
        bandwidth = values['imu.bandwidth']
        self.low_pass = LowPass(bandwidth, values['imu.bandwidth_order']) if bandwidth else None
        self.vibration = Vibration(
            values, self.low_pass.response if self.low_pass else np.ones_like)

    def errors(self, t_ns: NDArray[np.int64]) -> tuple[Errors, Errors]:
        """Return white noise and bias of rates and of forces at times (n,) [ns]."""
        return self.gyroscope.errors(t_ns), self.accelerometer.errors(t_ns)

    def read(self, true: tuple[Vector, Vector],
             errors: tuple[Errors, Errors]) -> tuple[Vector, Vector]:
        """Return the readings [rad/s], [m/s^2] of true rates and forces with these errors."""
        if self.is_perfect:
            return true
        (rates, force), (of_rates, of_force) = true, errors
        added = transformed(self._g_sensitivity, force) if any(self._g_sensitivity) else None
        return (self.gyroscope.read(rates, of_rates, added),
                self.accelerometer.read(force, of_force))

    def estimated(self, orientation: Quaternion, t_ns: NDArray[np.int64]) -> Quaternion:
        """Return an orientation at times (n,) [ns] as the IMU estimates it, with noise."""
        if not any(self.orientation_variances):
            return orientation
        x, y, z = np.sqrt(self.orientation_variances)[:, np.newaxis] * noise.white(
            self._values['seed'], Kind.ORIENTATION, Part.WHITE, t_ns // self.period_ns, 3)
        return attitude.product(orientation, attitude.quaternion_of_vector((x, y, z)))

    @property
    def memory_ns(self) -> int:
        interval_ns = min(self.period_ns, LONGEST_NS) + self.since_ns - self.first_begin_ns
        return max(interval_ns, self.low_pass.memory_ns if self.low_pass else 0)

    def at_period(self, period_ns: int, now_ns: int) -> 'Imu':
        """Return the IMU that takes samples with another period after `now_ns`."""
        if period_ns == self.period_ns:
            return self
        last_ns = now_ns // self.period_ns * self.period_ns
        if last_ns <= self.since_ns:        # no sample since the change before this one
            last_ns = self.first_begin_ns
        return Imu(self._values, period_ns, since_ns=now_ns,
                   first_begin_ns=max(last_ns, now_ns - LONGEST_NS))

    def begin_ns(self, end_ns: int) -> int:
        """Return where the interval that ends with a sample begins [ns]."""
        begin_ns = end_ns - self.period_ns
        return begin_ns if begin_ns > self.since_ns else self.first_begin_ns


class Readings:
    """
    What an IMU reads in a motion at some times, and what is true there.

    imu, trajectory : the sensor and the motion
    times : of the samples [ns]
    states : at these times
    """

    def __init__(self, imu: Imu, trajectory: Trajectory, times: range, states: States) -> None:
        self._imu, self._trajectory, self._times, self._states = imu, trajectory, times, states
        self._t_ns = ns_array(times)

    @cached_property
    def orientation(self) -> Quaternion:
        """q(world <- IMU) as columns x, y, z, w."""
        return self._imu.mounting.orientation(self._states)

    @cached_property
    def exact(self) -> tuple[Vector, Vector]:
        """Rates and forces of a perfect sensor: values or means, as `imu.sampling` says."""
        return self._means if self._imu.takes_means else self._imu.mounting.felt(self._states)

    @cached_property
    def read(self) -> tuple[Vector, Vector]:
        """Rates [rad/s] and forces [m/s^2] as the sensor reads them."""
        return self._imu.read(self._felt, self._errors)

    @cached_property
    def bias(self) -> tuple[Vector, Vector]:
        """The biases that are in `read`."""
        (_, (a, b, c)), (_, (d, e, f)) = self._errors
        return (a, b, c), (d, e, f)

    @cached_property
    def _errors(self) -> tuple[Errors, Errors]:
        return self._imu.errors(self._t_ns)

    @cached_property
    def estimated_orientation(self) -> Quaternion:
        """`orientation` with the noise of an IMU that estimates it."""
        return self._imu.estimated(self.orientation, self._t_ns)

    @cached_property
    def increments(self) -> tuple[Quaternion, Vector]:
        """
        Measured rotation and velocity increment [m/s] over the intervals that end there.

        The error of the mean readings acts throughout an interval, in the frame of the sensor: it
        adds to the rotation vector, and to the velocity half-way through the rotation.
        """
        imu = self._imu
        x, y, z, w = self._body_increments.rotation
        v1, v2, v3 = self._body_increments.velocity
        if imu.mounting.rotation is not None:
            x, y, z = attitude.rotated_back(imu.mounting.rotation, (x, y, z))
        v1, v2, v3 = imu.mounting.from_body((v1, v2, v3))
        if imu.is_perfect and imu.vibration.is_off:
            return (x, y, z, w), (v1, v2, v3)
        readings = imu.read(imu.vibration.add(self._means, self._t_ns, self._seconds),
                            self._errors)
        r1, r2, r3, *force = (self._seconds * (reading - mean) for reading, mean in zip(
            chain(*readings), chain(*self._means), strict=True))
        x, y, z = attitude.rotation_vector((x, y, z, w))
        f1, f2, f3 = attitude.rotated_back(
            attitude.quaternion_of_vector((-0.5 * x, -0.5 * y, -0.5 * z)),
            (force[0], force[1], force[2]))
        return (attitude.quaternion_of_vector((x + r1, y + r2, z + r3)),
                (v1 + f1, v2 + f2, v3 + f3))

    @cached_property
    def motion(self) -> tuple[Vector, Quaternion, Vector]:
        """Position [m] and orientation in the world, velocity in the IMU's frame [m/s]."""
        states, mounting = self._states, self._imu.mounting
        return (states.position(mounting.lever_arm), self.orientation,
                mounting.from_body(states.world_velocity(mounting.lever_arm)))

    @cached_property
    def _seconds(self) -> Column:
        """Lengths (n,) of the intervals that end with the samples [s]."""
        return np.array([end_ns - self._imu.begin_ns(end_ns) for end_ns in self._times]) * 1e-9

    @cached_property
    def _means(self) -> tuple[Vector, Vector]:
        """Means of rates and forces over the intervals that end with the samples."""
        seconds, increments = self._seconds, self._body_increments
        mounting, states = self._imu.mounting, self._states
        # The mean over an empty interval is the value itself.
        divisor = np.where(seconds > 0.0, seconds, 1.0)
        w1, w2, w3, f1, f2, f3 = (
            np.where(seconds > 0.0, integral / divisor, value) for integral, value in zip(
                (*increments.angles, *increments.forces),
                (*states.rows_angular_velocity, *states.specific_force(mounting.lever_arm)),
                strict=True))
        return mounting.from_body((w1, w2, w3)), mounting.from_body((f1, f2, f3))

    @property
    def _felt(self) -> tuple[Vector, Vector]:
        """`exact` with bandwidth and vibration of the sensor, before its errors."""
        imu, exact = self._imu, self.exact
        if imu.low_pass is not None:
            w1, w2, w3, f1, f2, f3 = imu.low_pass.filtered(
                self._trajectory, self._t_ns, self._signal)
            exact = (w1, w2, w3), (f1, f2, f3)
        if imu.vibration.is_off:
            return exact
        return imu.vibration.add(exact, self._t_ns,
                                 self._seconds if imu.takes_means else 0.0)

    def _signal(self, states: States) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(
            *chain(*self._imu.mounting.felt(states)), np.zeros(len(states)))[:6])

    @cached_property
    def _body_increments(self) -> Increments:
        """Increments over the intervals that end with the samples, in the frame of the body."""
        imu, period_ns, found = self._imu, self._imu.period_ns, []
        for piece, times in self._trajectory.pieces(self._t_ns):
            # Those that may be shorter, reach back or contain a jump are computed one by one.
            since_ns = max(imu.since_ns, piece.start_ns) + 1
            single = len(range(int(times[0]), since_ns + period_ns, self._times.step))
            found += [self._increments(imu.begin_ns(end_ns), end_ns)
                      for end_ns in map(int, times[:single])]
            if single < len(times):
                begins = range(int(times[single]) - period_ns, int(times[-1]) - period_ns + 1,
                               self._times.step)
                found.append(_within(piece, begins, period_ns, imu.mounting.lever_arm))
        return integrals.joined(found)

    def _increments(self, begin_ns: int, end_ns: int) -> Increments:
        """
        Return the increments over an interval that events may divide (n = 1).

        The impulsive torque of a command lets the velocity of the IMU jump; the jump counts toward
        the interval [begin, end) that contains it.
        """
        point, trajectory = self._imu.mounting.lever_arm, self._trajectory
        parts = []
        edges = {begin_ns, *trajectory.starts(begin_ns, end_ns), end_ns}
        for begin, end in pairwise(sorted(edges)):
            parts.append(integrals.impulse(trajectory.velocity_jump(begin, point)))
            parts.append(_within(trajectory.after(begin), range(begin, begin + 1), end - begin,
                                 point))
        return reduce(Increments.then, parts or [integrals.impulse(3 * (np.zeros(1),))])


def _within(piece: Piece, begins: range, length_ns: int, point: Point) -> Increments:
    """Return the increments over intervals within a piece, which begin at these times [ns]."""
    count = integrals.panels(piece.fastest_rate, length_ns)
    edges = [length_ns * k // count for k in range(count + 1)]
    return reduce(Increments.then, [integrals.increments(
        piece.states, range(begins.start + begin, begins.stop + begin, begins.step), end - begin,
        point, piece.fastest_rate) for begin, end in pairwise(edges)])


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation Rz(yaw) Ry(pitch) Rx(roll) as columns x, y, z, w with one row."""
    half = 0.5 * np.array([[roll], [pitch], [yaw]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return (cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr, cy * cp * cr + sy * sp * sr)
