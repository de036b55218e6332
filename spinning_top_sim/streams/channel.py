# SPDX-License-Identifier: Apache-2.0
"""A stream of messages: a topic, a grid of times, and how the motion becomes bytes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude, integrals
from spinning_top_sim.physics.attitude import Column, Quaternion, Vector
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.messages import Template, Values
from spinning_top_sim.streams.sensor import Errors
from spinning_top_sim.streams.trajectory import Trajectory, increments_within
from spinning_top_sim.times import LAST_STAMP_NS, Times, ns_array

# Messages as rows (n, size).
Rows = NDArray[np.uint8]
# A channel, times (n,) at which its messages are due [ns], and these.
Messages = tuple['Channel', Times, Rows]
# Returns how late the stamps of samples at times (n,) are [ns], and how often each is sent.
Faults = Callable[[Times], tuple[Times | int, NDArray[np.int64]]]


class Samples:
    """
    The motion at times of one grid; the channels with this grid share it.

    Each column is computed when it is first asked for.

    trajectory, imu : the motion, and the sensor on it
    times : of the samples [ns]
    epoch_ns : stamp of t = 0 [ns]
    """

    def __init__(self, trajectory: Trajectory, imu: Imu, times: range, epoch_ns: int) -> None:
        self.trajectory, self.times, self.epoch_ns = trajectory, times, epoch_ns
        self._imu = imu

    @cached_property
    def t_ns(self) -> Times:
        return ns_array(self.times)

    def stamps(self, late_ns: Times | int = 0) -> Times:
        """Return stamps (n,) that are so late [ns], within what a message holds."""
        due_ns: Times = self.epoch_ns + self.t_ns + late_ns
        return np.clip(due_ns, 0, LAST_STAMP_NS)

    @cached_property
    def states(self) -> States:
        return self.trajectory.evaluate(self.t_ns)

    @cached_property
    def orientation(self) -> Quaternion:
        """q(world <- IMU) as columns x, y, z, w."""
        return self._imu.mounting.orientation(self.states)

    @cached_property
    def exact(self) -> tuple[Vector, Vector]:
        """Rates [rad/s] and forces [m/s^2] of a perfect IMU: values or means."""
        return self._means if self._imu.takes_means else self._imu.mounting.true(self.states)

    @cached_property
    def readings(self) -> tuple[Vector, Vector]:
        """Rates [rad/s] and forces [m/s^2] as the IMU reads them."""
        imu, felt = self._imu, self.exact
        if imu.low_pass is not None:
            w1, w2, w3, f1, f2, f3 = imu.low_pass.filtered(
                self.trajectory, self.t_ns, lambda states: [*chain(*imu.mounting.true(states))])
            felt = (w1, w2, w3), (f1, f2, f3)
        felt = imu.vibrating(felt, self.t_ns, self._seconds if imu.takes_means else 0.0)
        return imu.read(felt, self.errors)

    @cached_property
    def errors(self) -> tuple[Errors, Errors]:
        """White noise and bias that are in `readings`."""
        return self._imu.errors(self.t_ns)

    @cached_property
    def increments(self) -> tuple[Quaternion, Vector]:
        """Measured rotation and velocity increment [m/s] over the intervals that end there."""
        imu = self._imu
        x, y, z, w = self._body_increments.rotation
        v1, v2, v3 = self._body_increments.velocity
        if imu.mounting.rotation is not None:
            x, y, z = attitude.rotated_back(imu.mounting.rotation, (x, y, z))
        v1, v2, v3 = imu.mounting.from_body((v1, v2, v3))
        if imu.is_perfect and not imu.vibrates:
            return (x, y, z, w), (v1, v2, v3)
        readings = imu.read(imu.vibrating(self._means, self.t_ns, self._seconds), self.errors)
        r1, r2, r3, *force = (self._seconds * (reading - mean) for reading, mean in zip(
            chain(*readings), chain(*self._means), strict=True))
        # The error of the means acts throughout an interval, in the frame of the sensor: it
        # adds to the rotation vector, and to the velocity half-way through the rotation.
        x, y, z = attitude.rotation_vector((x, y, z, w))
        f1, f2, f3 = attitude.rotated_back(
            attitude.quaternion_of_vector((-0.5 * x, -0.5 * y, -0.5 * z)),
            (force[0], force[1], force[2]))
        return (attitude.quaternion_of_vector((x + r1, y + r2, z + r3)),
                (v1 + f1, v2 + f2, v3 + f3))

    @cached_property
    def _seconds(self) -> Column:
        """Lengths (n,) of the intervals that end with the samples [s]."""
        return np.asarray((self.t_ns - self._imu.begins_ns(self.t_ns)) * 1e-9, float)

    @cached_property
    def _means(self) -> tuple[Vector, Vector]:
        """Means of rates and forces over the intervals that end with the samples."""
        seconds, increments = self._seconds, self._body_increments
        mounting, states = self._imu.mounting, self.states
        # The mean over an empty interval is the value itself.
        divisor = np.where(seconds > 0.0, seconds, 1.0)
        w1, w2, w3, f1, f2, f3 = (
            np.where(seconds > 0.0, integral / divisor, value) for integral, value in zip(
                (*increments.angles, *increments.forces),
                (*states.rows_angular_velocity, *states.specific_force(mounting.lever_arm)),
                strict=True))
        return mounting.from_body((w1, w2, w3)), mounting.from_body((f1, f2, f3))

    @cached_property
    def _body_increments(self) -> Increments:
        """Increments over the intervals that end with the samples, in the frame of the body."""
        imu, period_ns, step_ns, found = self._imu, self._imu.period_ns, self.times.step, []
        for piece, times in self.trajectory.pieces(self.t_ns):
            # Those that may be shorter, reach back or contain a jump are computed one by one.
            single = int(np.searchsorted(
                times, max(imu.since_ns, piece.start_ns) + period_ns, 'right'))
            found += [self.trajectory.increments(*edges, imu.mounting.lever_arm) for edges in zip(
                imu.begins_ns(times[:single]).tolist(), times[:single].tolist(), strict=True)]
            if single < len(times):
                begins = range(int(times[single]) - period_ns, int(times[-1]) - period_ns + 1,
                               step_ns)
                found.append(increments_within(piece, begins, period_ns, imu.mounting.lever_arm))
        return integrals.joined(found)


@dataclass(frozen=True, eq=False)
class Channel:
    """
    One topic, with samples at t = k * period_ns for k = 0, 1, 2, ...

    name : prefix of its parameters; several channels may have one
    topic, type_name : such as 'imu/data_raw' and 'sensor_msgs/msg/Imu'
    period_ns : time between two samples [ns]
    template : of its messages
    fields : returns the numbers that go into the fields of `template`
    faults : of stamps, and losses; None: every sample is sent once, with its time
    delay_ns : time from a sample to its message [ns]; the place of the pivot is known so long,
        states by steps for the memory of the IMU only
    """

    name: str
    topic: str
    type_name: str
    period_ns: int
    template: Template
    fields: Callable[[Samples], Sequence[Values]]
    faults: Faults | None = None
    delay_ns: int = 0

    @property
    def grid(self) -> tuple[int, int]:
        """Period and delay [ns]: channels that have the same share their samples."""
        return self.period_ns, self.delay_ns

    def times(self, after_ns: int, until_ns: int) -> range:
        """Return the times of the samples whose messages are due after one time, up to another."""
        first = max(after_ns - self.delay_ns, -1) // self.period_ns + 1
        return range(first * self.period_ns, until_ns - self.delay_ns + 1, self.period_ns)

    def encode(self, samples: Samples) -> tuple[Times, Rows]:
        """Return when the messages (n,) of samples are due [ns], and these as rows (n, size)."""
        late_ns, copies = self.faults(samples.t_ns) if self.faults else (0, 1)
        rows = self.template.encode(samples.stamps(late_ns), self.fields(samples))
        due_ns = samples.t_ns + self.delay_ns
        return (due_ns, rows) if self.faults is None else (
            np.repeat(due_ns, copies), np.repeat(rows, copies, axis=0))
