# SPDX-License-Identifier: Apache-2.0
"""
The streams: for each a topic, a message type, a rate, and how states become bytes.

A new stream is a subclass of `Stream` here, a template in messages.py, its place in all_streams.py
and a line in parameters.STREAM_DEFAULTS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import States
from spinning_top_sim.streams import messages
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.segment import Segment

JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Stream:
    """
    One topic: samples at t = k * period, k = 0, 1, 2.., whoever listens and however ticks fall.

    Attributes
    ----------
    parameter : prefix of its parameters
    topic, type_name : of its messages
    template : Template
    period_ns : of its samples [ns]
    log_index : its number in the log that records it, None for no log; see `Simulation.log_to`
    sent, skipped : counts of samples published, and of those that came too late for that
    on_change : called when its sinks, its rate or the numbers in its samples change
    """

    parameter: str
    topic: str
    type_name: str
    template: Template

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._publish: Callable[[bytes], object] | None = None
        self.log_index: int | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.sent = self.skipped = 0
        self._skipped_until_ns = 0
        self.period_ns = 1
        self.set_rate(values[f'{self.parameter}.rate'])

    @property
    def publish(self) -> Callable[[bytes], object] | None:
        """What a sample is handed to in time; None while there are no subscribers."""
        return self._publish

    @publish.setter
    def publish(self, sink: Callable[[bytes], object] | None) -> None:
        if sink != self._publish:
            self._publish = sink
            self.on_change()

    def follow(self, segment: Segment) -> None:
        """Begin with the samples of a motion, or of the one after a command."""

    def apply(self, values: Mapping[str, Any]) -> None:
        """
        Take over parameters that take effect at once: the rate, where it is among `values`.

        A stream with others of its own takes them here too, and calls `on_change`.
        """
        rate = values.get(f'{self.parameter}.rate')
        if rate is not None and _period_ns(rate) != self.period_ns:
            self.set_rate(rate)

    def set_rate(self, rate: float) -> None:
        """Put the samples on the grid of another rate [Hz]."""
        self.period_ns = _period_ns(rate)
        self.on_change()

    @property
    def has_sinks(self) -> bool:
        """Whether it has subscribers or is recorded: else nothing is computed."""
        return self._publish is not None or self.log_index is not None

    def first_after(self, t_ns: int) -> int:
        """Return the time of the first sample later than `t_ns` that is not skipped [ns]."""
        return (max(t_ns, self._skipped_until_ns - 1) // self.period_ns + 1) * self.period_ns

    def times(self, after_ns: int, until_ns: int) -> range:
        """Return the times of the samples after `after_ns` and up to `until_ns` [ns]."""
        return range(self.first_after(after_ns), until_ns + 1, self.period_ns)

    def skip(self, after_ns: int, before_ns: int) -> None:
        """Leave out and count the samples after `after_ns` and before `before_ns` [ns]."""
        count = len(self.times(after_ns, before_ns - 1))
        if count:
            self.skipped += count
            self._skipped_until_ns = before_ns
            self.on_change()

    def encode(self, states: States, epoch_ns: int, times: range) -> NDArray[np.uint8]:
        """
        Return the messages at sample times as rows of bytes (n, size), valid until the next call.

        states : the states at `times`
        epoch_ns : stamp of t = 0 [ns]
        times : of n samples [ns]; see `times`
        """
        stamps_ns = np.arange(epoch_ns + times.start, epoch_ns + times.stop, times.step)
        return self.template.encode(stamps_ns, *self.fields(states, times))

    def fields(self, states: States, times: range) -> Sequence[Field]:
        """Return the numbers that go into the fields of `template`."""
        raise NotImplementedError

    def indices(self, times: range) -> range:
        """Return the numbers k of the samples at these times."""
        first = times.start // self.period_ns
        return range(first, first + len(times))


def _period_ns(rate: float) -> int:
    return max(1, round(NANOSECONDS / rate))


class Pose(Stream):
    """The attitude, at the pivot."""

    parameter, topic, type_name = 'pose', 'pose', 'geometry_msgs/msg/PoseStamped'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.pose_stamped(values['world_frame'])

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (states.rows_quaternion,)


class JointStates(Stream):
    """The Euler angles as joints of the URDF."""

    parameter, topic, type_name = 'joint_states', 'joint_states', 'sensor_msgs/msg/JointState'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.joint_state(JOINTS)

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return ((states.phi, states.theta, states.psi),
                (states.phi_dot, states.theta_dot, states.psi_dot))


class GroundTruthOdometry(Stream):
    """Attitude and body rates, exact."""

    parameter, topic, type_name = ('ground_truth_odom', 'ground_truth/odom',
                                   'nav_msgs/msg/Odometry')

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.odometry(values['world_frame'], values['body_frame'])

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return states.rows_quaternion, states.rows_angular_velocity


class ImuStream(Stream):
    """What all IMU topics share: the mounting, and the sensor at the stream's rate."""

    type_name = 'sensor_msgs/msg/Imu'
    has_orientation, is_noisy = True, False

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._frame_id: str = values['imu.frame_id']
        self._imu = imu
        super().__init__(values)

    def set_rate(self, rate: float) -> None:
        super().set_rate(rate)
        # A density says how much noise a sample has at a rate.
        self._sensor = self._imu.sensor(self.period_ns)
        kinds = self._sensor.gyroscope, self._sensor.accelerometer
        self.template = messages.imu(
            self._frame_id,
            messages.EXACT if self.has_orientation else messages.UNKNOWN_ORIENTATION,
            *(messages.diagonal(kind.variance if self.is_noisy else 0.0) for kind in kinds))


class ImuRaw(ImuStream):
    """What the sensor reads, without an orientation (REP-145)."""

    parameter, topic, has_orientation, is_noisy = 'imu', 'imu/data_raw', False, True

    def fields(self, states: States, times: range) -> Sequence[Field]:
        orientation = self._imu.orientation(states) if self.has_orientation else IDENTITY
        return (orientation, *self._sensor.read(self._imu.true(states), self.indices(times)))


class ImuData(ImuRaw):
    """What the sensor reads, with the exact orientation of its frame."""

    parameter, topic, has_orientation = 'imu_data', 'imu/data', True


class ImuBias(ImuStream):
    """The bias that `ImuRaw` carries."""

    parameter, topic, has_orientation = 'imu', 'ground_truth/imu_bias', False

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (IDENTITY, *self._sensor.bias(self.indices(times)))


class GroundTruthImu(ImuStream):
    """What a perfect sensor in the same place reads, with its orientation."""

    parameter, topic = 'ground_truth_imu', 'ground_truth/imu'

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (self._imu.orientation(states), *self._imu.true(states))


class Invariants(Stream):
    """
    How well the constants of the motion are kept; see `INVARIANTS` for the columns.

    A drift is relative to the value that the motion began with (absolute where that is 0); the
    orientation error [rad] is against the exact solution.
    """

    parameter, topic, type_name = 'invariants', '~/invariants', 'std_msgs/msg/Float64MultiArray'
    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.float64_multi_array(INVARIANTS)

    def follow(self, segment: Segment) -> None:
        self._segment = segment

    def fields(self, states: States, times: range) -> Sequence[Field]:
        segment = self._segment
        now = (states.energy, states.l3, states.lz)
        drifts = [(values - start) / (abs(start) or 1.0) for values, start in zip(
            now, (segment.energy, segment.l3, segment.lz), strict=True)]
        return ((*now, *drifts, states.norm_error, segment.orientation_error(states, times)),)


class Clock(Stream):
    """Simulated time as the ROS clock."""

    parameter, topic, type_name = 'clock', '/clock', 'rosgraph_msgs/msg/Clock'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.clock()

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return ()
