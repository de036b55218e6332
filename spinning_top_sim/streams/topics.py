# SPDX-License-Identifier: Apache-2.0
"""
The streams: for each a topic, a message type, a rate, and how a state becomes bytes.

A new stream is a subclass of `Stream` here, a template in messages.py and a line in
parameters.STREAM_DEFAULTS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from spinning_top_sim.physics.kinematics import Columns, OneState
from spinning_top_sim.streams import messages
from spinning_top_sim.streams.cdr import NANOSECONDS, Template
from spinning_top_sim.streams.imu import Imu, Sensor

JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
NAN = math.nan
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Stream:
    """
    One topic: samples at t = k x period, k = 0, 1, 2.., whoever listens and however ticks fall.

    publish, record: what a sample is handed to, None while nobody wants it;  sent, skipped:
    counts of samples published, and of those that came too late to be published.
    """

    parameter: str
    topic: str
    type_name: str
    template: Template

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.publish: Callable[[bytes], None] | None = None
        self.record: Callable[[int, bytes], None] | None = None
        self.sent = self.skipped = 0
        self.next_ns = 0
        self.period_ns = 1
        self.set_rate(values[f'{self.parameter}.rate'])

    def set_rate(self, rate: float) -> None:
        """Put the samples on the grid of another rate [Hz]; call `resume` after."""
        self.period_ns = max(1, round(NANOSECONDS / rate))

    def resume(self, after_ns: int) -> None:
        """Make the first grid point later than `after_ns` the next sample."""
        self.next_ns = (after_ns // self.period_ns + 1) * self.period_ns

    @property
    def wanted(self) -> bool:
        """Whether anybody takes the samples: else nothing is computed."""
        return self.publish is not None or self.record is not None

    @property
    def index(self) -> int:
        """Number k of the next sample."""
        return self.next_ns // self.period_ns

    def encode(self, state: OneState, stamp_ns: int) -> bytes:
        """Return the serialized message of the next sample: a state, and its stamp [ns]."""
        return self.template.encode(stamp_ns, *self.runs(state, self.index))

    def encode_many(self, states: Columns, stamps_ns: Any) -> Any:
        """Return the messages of the next n samples as rows of bytes, (n, size) uint8."""
        first = self.index
        return self.template.encode_many(
            stamps_ns, *self.runs(states, range(first, first + len(stamps_ns))))

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        """
        Return the numbers that go into `template`, for one state or for many.

        index: number k of the sample, or the range of many
        """
        raise NotImplementedError


class Pose(Stream):
    """The attitude, at the pivot."""

    parameter, topic, type_name = 'pose', 'pose', 'geometry_msgs/msg/PoseStamped'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.pose_stamped(values['world_frame'])

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return (state.quaternion,)


class JointStates(Stream):
    """The Euler angles as joints of the URDF."""

    parameter, topic, type_name = 'joint_states', 'joint_states', 'sensor_msgs/msg/JointState'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.joint_state(JOINTS)

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return ((state.phi, state.theta, state.psi),
                (state.phi_dot, state.theta_dot, state.psi_dot))


class GroundTruthOdometry(Stream):
    """Attitude and body rates, exact."""

    parameter, topic, type_name = ('ground_truth_odom', 'ground_truth/odom',
                                   'nav_msgs/msg/Odometry')

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.odometry(values['world_frame'], values['body_frame'])

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return state.quaternion, state.body_rates


class ImuStream(Stream):
    """What all IMU topics share: the mounting, and the sensor at the stream's rate."""

    type_name = 'sensor_msgs/msg/Imu'
    oriented = True

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._values, self._imu = values, imu
        super().__init__(values)

    def set_rate(self, rate: float) -> None:
        super().set_rate(rate)
        # A density says how much noise a sample has at a rate.
        self._sensor = Sensor(self._values, self.period_ns)
        gyroscope, accelerometer = self._variances()
        self.template = messages.imu(
            self._values['imu.frame_id'],
            messages.EXACT if self.oriented else messages.UNKNOWN_ORIENTATION,
            messages.diagonal(gyroscope), messages.diagonal(accelerometer))

    def _variances(self) -> tuple[float, float]:
        """Return the variances of angular velocity and linear acceleration."""
        return 0.0, 0.0


class ImuRaw(ImuStream):
    """What the sensor reads, without an orientation (REP-145)."""

    parameter, topic, oriented = 'imu', 'imu/data_raw', False

    def _variances(self) -> tuple[float, float]:
        return self._sensor.gyroscope.variance, self._sensor.accelerometer.variance

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return (self._orientation(state), *self._sensor.read(self._imu.true(state), index))

    def _orientation(self, state: Columns) -> Any:
        return IDENTITY


class ImuData(ImuRaw):
    """What the sensor reads, with the exact orientation of its frame."""

    parameter, topic, oriented = 'imu_data', 'imu/data', True

    def _orientation(self, state: Columns) -> Any:
        return self._imu.orientation(state)


class ImuBias(ImuStream):
    """The bias that `ImuRaw` carries."""

    parameter, topic, oriented = 'imu', 'ground_truth/imu_bias', False

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return (IDENTITY, *self._sensor.bias(index))


class GroundTruthImu(ImuStream):
    """What a perfect sensor in the same place reads, with its orientation."""

    parameter, topic = 'ground_truth_imu', 'ground_truth/imu'

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return (self._imu.orientation(state), *self._imu.true(state))


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
        self._start = (0.0, 0.0, 0.0)
        self.orientation_error: Callable[[Columns, int], Any] = lambda state, t_ns: NAN

    def start_from(self, state: OneState) -> None:
        """Measure drifts from this state on."""
        self._start = (state.energy, state.l3_start, state.lz_start)

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        now = (state.energy, state.l3, state.lz)
        drifts = [(value - start) / (abs(start) or 1.0)
                  for value, start in zip(now, self._start, strict=True)]
        return ((*now, *drifts, state.norm_error,
                 self.orientation_error(state, self.next_ns)),)


class Clock(Stream):
    """Simulated time as the ROS clock."""

    parameter, topic, type_name = 'clock', '/clock', 'rosgraph_msgs/msg/Clock'

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.clock()

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return ()


def all_streams(values: Mapping[str, Any], imu: Imu) -> list[Stream]:
    """Return every stream there is, in the order in which samples of one instant are sent."""
    return [Clock(values), Pose(values), JointStates(values), ImuRaw(values, imu),
            ImuData(values, imu), ImuBias(values, imu), GroundTruthImu(values, imu),
            GroundTruthOdometry(values), Invariants(values)]
