# SPDX-License-Identifier: Apache-2.0
"""The streams.  What a new one needs is said in docs/architecture.md."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import Shape
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.segment import Segment
from spinning_top_sim.streams.stream import Stream, period_ns

JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Pose(Stream):
    """The attitude, at the pivot."""

    parameter, topic, type_name = 'pose', 'pose', 'geometry_msgs/msg/PoseStamped'

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (states.rows_quaternion,)


class JointStates(Stream):
    """The Euler angles as joints of the URDF."""

    parameter, topic, type_name = 'joint_states', 'joint_states', 'sensor_msgs/msg/JointState'

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return ((states.phi, states.theta, states.psi),
                (states.phi_dot, states.theta_dot, states.psi_dot))


class GroundTruthOdometry(Stream):
    """Attitude and body rates, exact."""

    parameter, topic, type_name = ('ground_truth_odom', 'ground_truth/odom',
                                   'nav_msgs/msg/Odometry')

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return states.rows_quaternion, states.rows_angular_velocity


class ImuStream(Stream):
    """What all IMU topics share: the IMU, which takes its samples at `imu.rate`."""

    type_name = 'sensor_msgs/msg/Imu'
    has_orientation, is_noisy = True, False

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._frame_id, self._imu = values['imu.frame_id'], imu
        super().__init__(values, self._template(values['imu.rate']))

    @property
    def at_once(self) -> tuple[str, ...]:
        return (*super().at_once, 'imu.rate')

    def apply(self, changes: Mapping[str, Any]) -> None:
        super().apply(changes)
        if 'imu.rate' in changes:
            self.template = self._template(changes['imu.rate'])
            self.on_change()

    def _template(self, imu_rate: float) -> Template:
        """Use the sensor of this rate: a density says how much noise a sample has at a rate."""
        self._sensor = self._imu.sensor(period_ns(imu_rate))
        variances = self._sensor.rate_variance, self._sensor.force_variance
        return messages.imu(
            self._frame_id,
            messages.EXACT if self.has_orientation else messages.UNKNOWN_ORIENTATION,
            *(messages.diagonal(variance if self.is_noisy else 0.0) for variance in variances))


class ImuRaw(ImuStream):
    """What the sensor reads, without an orientation (REP-145)."""

    parameter, topic, has_orientation, is_noisy = 'imu', 'imu/data_raw', False, True

    def fields(self, states: States, times: range) -> Sequence[Field]:
        orientation = self._imu.orientation(states) if self.has_orientation else IDENTITY
        return (orientation, *self._sensor.read(self._imu.true(states), times))


class ImuData(ImuRaw):
    """What the sensor reads, with the exact orientation of its frame."""

    parameter, topic, has_orientation = 'imu_data', 'imu/data', True


class ImuBias(ImuStream):
    """The bias that the readings contain; it has the rate of the raw readings, `imu.rate`."""

    parameter, topic, has_orientation = 'imu', 'ground_truth/imu_bias', False

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (IDENTITY, *self._sensor.bias(times))


class GroundTruthImu(ImuStream):
    """What a perfect sensor in the same place reads, with its orientation."""

    parameter, topic = 'ground_truth_imu', 'ground_truth/imu'

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return (self._imu.orientation(states), *self._imu.true(states))


class Invariants(Stream):
    """How well the constants of the motion are kept: relative drifts, absolute where one is 0."""

    parameter, topic, type_name = 'invariants', '~/invariants', 'std_msgs/msg/Float64MultiArray'

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

    def fields(self, states: States, times: range) -> Sequence[Field]:
        return ()


class Markers(Stream):
    """
    The top and the trace of its tip for Foxglove and RViz, in the world frame: no TF is needed.

    A line along the axis and down the side of the body shows the spin.  Every message has the
    whole trace, so that a viewer who comes late, or moves about in a log, sees it at once.  Its
    points are those of the exact solution at fixed times m * spacing before the sample; the tip of
    the body ends it: with a coarse `solver.rtol` one sees the body leave the path.
    """

    parameter, topic, type_name = 'markers', 'markers', 'visualization_msgs/msg/MarkerArray'

    def __init__(self, values: Mapping[str, Any]) -> None:
        shape = self._shape = Shape(parameters.top_of(values))
        self._length_ns = round(values['markers.trace_length'] * NANOSECONDS)
        self._count = min(values['markers.trace_points'], self._length_ns)
        self._spacing_ns = max(1, self._length_ns // max(self._count, 1))
        self._segments: deque[Segment] = deque()
        # Slightly outside, to be seen.
        rim, side = 1.01 * shape.radius, 1.01 * math.copysign(0.5 * shape.height, shape.tip)
        far, near = shape.centre + side, shape.centre - side
        lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
                 0.0, 0.0, far, rim, 0.0, far,
                 rim, 0.0, far, rim, 0.0, near,
                 rim, 0.0, near, 0.0, 0.0, near)
        super().__init__(values, messages.markers(
            values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
            0.02 * abs(shape.tip), self._count + 1 if self._count else 0))

    def follow(self, segment: Segment) -> None:
        """Begin a new segment; forget those that the trace does not reach any more."""
        self._segments.append(segment)
        oldest_ns = segment.start_ns - self._length_ns
        while len(self._segments) > 1 and self._segments[1].start_ns < oldest_ns:
            self._segments.popleft()

    def fields(self, states: States, times: range) -> Sequence[Field]:
        centre = tuple(self._shape.centre * part for part in states.rows_axis)
        body = (centre, states.rows_quaternion, states.rows_quaternion)
        return (*body, self._traces(states, times)) if self._count else body

    def _traces(self, states: States, times: range) -> NDArray[np.float64]:
        """Return the points of the traces (n, 3 (count + 1)) that end at these times."""
        count = self._count
        newest = (np.arange(times.start, times.stop, times.step) - 1) // self._spacing_ns
        # A trace shares points with the one before it; there they are computed once.
        fresh = np.minimum(np.diff(newest, prepend=newest[0] - count), count)
        ends = np.cumsum(fresh)
        grid = np.repeat(newest + 1 - ends, fresh) + np.arange(ends[-1])
        points = self._past_axis(np.maximum(grid * self._spacing_ns, 0))
        traces = np.empty((len(times), count + 1, 3))
        for row, end in zip(traces, ends.tolist(), strict=True):
            row[:-1] = points[end - count:end]
        traces[:, -1] = np.stack(states.rows_axis, axis=-1)
        traces *= self._shape.tip
        return traces.reshape(len(times), -1)

    def _past_axis(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the axis in the world at ascending times of the last `trace_length`, (n, 3)."""
        begins = [segment.start_ns for segment in self._segments]
        # A segment ends with the command that begins the next one, that instant included.
        ends = np.searchsorted(times_ns, begins[1:], 'right')
        return np.concatenate([
            np.stack(segment.exact_axis(times), axis=-1) for segment, times in zip(
                self._segments, np.split(times_ns, ends), strict=True) if len(times)])


def all_streams(values: Mapping[str, Any]) -> list[Stream]:
    """Return every stream, in the order in which samples of one instant are sent."""
    imu, world, body = Imu(values), values['world_frame'], values['body_frame']
    return [Clock(values, messages.clock()), Pose(values, messages.pose_stamped(world)),
            JointStates(values, messages.joint_state(JOINTS)), ImuRaw(values, imu),
            ImuData(values, imu), ImuBias(values, imu), GroundTruthImu(values, imu),
            GroundTruthOdometry(values, messages.odometry(world, body)),
            Invariants(values, messages.float64_multi_array(INVARIANTS)), Markers(values)]
