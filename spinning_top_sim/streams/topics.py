# SPDX-License-Identifier: Apache-2.0
"""The streams, a class for each topic.  docs/architecture.md says how to add one."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Vector
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import Shape
from spinning_top_sim.streams import messages, parameters, timing
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.imu import Imu, Sensor
from spinning_top_sim.streams.magnetometer import Magnetometer
from spinning_top_sim.streams.stream import Encoded, Samples, Stream

JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
TIMING = ('stamp_sec', 'stamp_nanosec', 'true_sec', 'true_nanosec', 'copies')
NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Pose(Stream):
    """The pose of the body frame: the attitude, at the pivot."""

    parameter, topic, type_name = 'pose', 'pose', 'geometry_msgs/msg/PoseStamped'

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (samples.states.rows_quaternion,)


class JointStates(Stream):
    """The Euler angles as joints of the URDF."""

    parameter, topic, type_name = 'joint_states', 'joint_states', 'sensor_msgs/msg/JointState'

    def fields(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        return ((states.phi, states.theta, states.psi),
                (states.phi_dot, states.theta_dot, states.psi_dot))


class GroundTruthOdometry(Stream):
    """Attitude and body rates, without errors."""

    parameter, topic, type_name = ('ground_truth_odom', 'ground_truth/odom',
                                   'nav_msgs/msg/Odometry')

    def fields(self, samples: Samples) -> Sequence[Field]:
        return samples.states.rows_quaternion, samples.states.rows_angular_velocity


class ImuStream(Stream):
    """A topic of the IMU, which takes its samples at `imu.rate`."""

    type_name = 'sensor_msgs/msg/Imu'
    has_orientation, is_noisy = True, False

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._frame_id, self.imu = values['imu.frame_id'], imu
        super().__init__(values, self._template())

    def apply(self, changes: Mapping[str, Any]) -> None:
        super().apply(changes)
        self.template = self._template()

    @property
    def _sensor(self) -> Sensor:
        return self.imu.sensor(self.imu.intervals.length_ns)

    def _template(self) -> Template:
        """Return the template with the covariances for the present rate of the IMU."""
        covariances = 3 * [messages.EXACT]
        if self.is_noisy:
            sensor = self._sensor
            covariances = [messages.diagonal(*variances) for variances in (
                sensor.orientation_variances, 3 * (sensor.rate_variance,),
                3 * (sensor.force_variance,))]
        if not self.has_orientation:
            covariances[0] = messages.UNKNOWN_ORIENTATION
        return messages.imu(self._frame_id, *covariances)


class ImuRaw(ImuStream):
    """The readings of the sensor, without an orientation (REP-145)."""

    parameter, topic, has_orientation, is_noisy = 'imu', 'imu/data_raw', False, True

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        super().__init__(values, imu)
        self._timing = (timing.Timing(values) if any(map(values.get, timing.FAULTS)) else None)

    def encode(self, samples: Samples, epoch_ns: int) -> Encoded:
        if self._timing is None:
            return super().encode(samples, epoch_ns)
        t_ns = samples.t_ns
        rows = self.template.encode(self._timing.stamps_ns(epoch_ns, t_ns, self.period_ns),
                                    *self.fields(samples))
        copies = self._timing.copies(t_ns, self.period_ns)
        return np.repeat(t_ns, copies), np.repeat(rows, copies, axis=0)

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (NO_ROTATION, *self._sensor.read(self.imu.sampled(samples), samples.times))


class ImuData(ImuRaw):
    """The readings of the sensor, with the orientation that it estimates."""

    parameter, topic, has_orientation = 'imu_data', 'imu/data', True

    def fields(self, samples: Samples) -> Sequence[Field]:
        _, *readings = super().fields(samples)
        exact = self.imu.orientation(samples.states)
        return (self._sensor.orientation(exact, samples.times), *readings)


class ImuBias(ImuStream):
    """The bias in the readings, at the rate of `imu/data_raw`."""

    parameter, topic, has_orientation = 'imu', 'ground_truth/imu_bias', False

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (NO_ROTATION, *self._sensor.bias(samples.times))


class ImuTiming(Stream):
    """The stamp and the true time of each sample of the IMU, and how often it was sent."""

    parameter, topic, type_name = ('imu_timing', 'ground_truth/imu_timing',
                                   'std_msgs/msg/Float64MultiArray')
    rate_parameter = 'imu.rate'

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._timing = timing.Timing(values)
        super().__init__(values, messages.float64_multi_array(TIMING))

    def encode(self, samples: Samples, epoch_ns: int) -> Encoded:
        t_ns = samples.t_ns
        true_ns = epoch_ns + t_ns
        stamps_ns = self._timing.stamps_ns(epoch_ns, t_ns, self.period_ns)
        columns = (*np.divmod(stamps_ns, NANOSECONDS), *np.divmod(true_ns, NANOSECONDS),
                   self._timing.copies(t_ns, self.period_ns))
        return t_ns, self.template.encode(
            true_ns, [column.astype(np.float64) for column in columns])


class Mag(Stream):
    """The readings of the magnetometer (REP-145)."""

    parameter, topic, type_name = 'mag', 'imu/mag', 'sensor_msgs/msg/MagneticField'

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        super().__init__(values, messages.magnetic_field(values['imu.frame_id']))
        self._values, self._imu = values, imu
        self._sensor = Magnetometer(values, self.period_ns)

    def apply(self, changes: Mapping[str, Any]) -> None:
        super().apply(changes)
        self._sensor = Magnetometer(self._values, self.period_ns)

    def _exact(self, samples: Samples) -> Vector:
        return self._sensor.true(self._imu.orientation(samples.states))

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (self._sensor.read(self._exact(samples), samples.times),
                messages.diagonal(*3 * (self._sensor.variance,)))


class GroundTruthMag(Mag):
    """The readings of a perfect magnetometer."""

    topic = 'ground_truth/mag'

    def fields(self, samples: Samples) -> Sequence[Field]:
        return self._exact(samples), messages.EXACT


class GroundTruthImu(ImuStream):
    """The readings of a perfect sensor in the same place, with its orientation."""

    parameter, topic = 'ground_truth_imu', 'ground_truth/imu'

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (self.imu.orientation(samples.states), *self.imu.sampled(samples))


class ImuIncrements(ImuRaw):
    """
    An increment over the interval that ends at a sample (docs/sensor.md).

    place, count : which of the increments it is, and its number of components
    """

    parameter, rate_parameter = 'increments', 'imu.rate'
    place: int
    count: int

    def _template(self) -> Template:
        return messages.stamped(self._frame_id, self.count)

    def fields(self, samples: Samples) -> Sequence[Field]:
        increments = self.imu.increments(samples)
        if not self._sensor.is_perfect:
            increments = self._sensor.disturb(
                increments, samples.once(self.imu.means), samples.times,
                self.imu.intervals.lengths(samples.times))
        return (increments[self.place],)


class ImuDq(ImuIncrements):
    """The rotation increment."""

    topic, type_name = 'imu/dq', 'geometry_msgs/msg/QuaternionStamped'
    place, count = 0, 4


class ImuDv(ImuIncrements):
    """The velocity increment."""

    topic, type_name = 'imu/dv', 'geometry_msgs/msg/Vector3Stamped'
    place, count = 1, 3


class GroundTruthImuOdometry(Stream):
    """Pose and velocity of the IMU in the world, without errors."""

    parameter, topic, type_name = ('ground_truth_imu_odom', 'ground_truth/imu_odom',
                                   'nav_msgs/msg/Odometry')

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._imu = imu
        super().__init__(values, messages.odometry(
            values['world_frame'], values['imu.frame_id'], moves=True))

    def fields(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        position, velocity = self._imu.motion(states)
        return position, self._imu.orientation(states), velocity, self._imu.true(states)[0]


class Invariants(Stream):
    """The constants of the motion, with their drifts: relative, or absolute where one is 0."""

    parameter, topic, type_name = 'invariants', '~/invariants', 'std_msgs/msg/Float64MultiArray'

    def fields(self, samples: Samples) -> Sequence[Field]:
        segment, states = samples.path.present, samples.states
        now = (states.energy, states.l3, states.lz)
        drifts = map(relative_drift, now, (segment.energy, segment.l3, segment.lz))
        error = segment.orientation_error(states, samples.times)
        return ((*now, *drifts, states.norm_error, error),)


class Clock(Stream):
    """Simulated time as the ROS clock."""

    parameter, topic, type_name = 'clock', '/clock', 'rosgraph_msgs/msg/Clock'

    def fields(self, samples: Samples) -> Sequence[Field]:
        return ()


class Markers(Stream):
    """
    The top and the trace of its tip for Foxglove and RViz, in the world frame.

    Every message has the whole trace, so that it is complete wherever a viewer starts or jumps in
    a log.  Its points are on the exact path, at multiples of a fixed time step; the last one is
    the tip of the body.
    """

    parameter, topic, type_name = 'markers', 'markers', 'visualization_msgs/msg/MarkerArray'

    def __init__(self, values: Mapping[str, Any]) -> None:
        shape = self._shape = Shape(parameters.top_of(values))
        length_ns = round(values['markers.trace_length'] * NANOSECONDS)
        self._count = min(values['markers.trace_points'], length_ns)
        self._spacing_ns = max(1, length_ns // max(self._count, 1))
        # Slightly outside of the body, so that it does not hide the lines.
        rim, side = 1.01 * shape.radius, 1.01 * math.copysign(0.5 * shape.height, shape.tip)
        far, near = shape.centre + side, shape.centre - side
        lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
                 0.0, 0.0, far, rim, 0.0, far,
                 rim, 0.0, far, rim, 0.0, near,
                 rim, 0.0, near, 0.0, 0.0, near)
        super().__init__(values, messages.markers(
            values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
            0.02 * abs(shape.tip), self._count + 1 if self._count else 0))

    def fields(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        centre = tuple(self._shape.centre * part for part in states.rows_axis)
        body = (centre, states.rows_quaternion, states.rows_quaternion)
        return (*body, self._traces(samples)) if self._count else body

    def _traces(self, samples: Samples) -> NDArray[np.float64]:
        """Return the points of the traces that end at these samples, (n, 3 (count + 1))."""
        n, steps = len(samples.times), np.arange(1 - self._count, 1)
        newest = (samples.t_ns[:, np.newaxis] - 1) // self._spacing_ns
        numbers = newest + steps
        # The points that a trace shares with the one before it are computed once.
        is_new = numbers > np.vstack((numbers[0, 0] - 1, newest[:-1]))
        points = samples.path.exact_axis(np.maximum(numbers[is_new], 0) * self._spacing_ns)
        ends = np.cumsum(np.count_nonzero(is_new, axis=1))[:, np.newaxis]
        last = np.stack(samples.states.rows_axis, axis=-1)[:, np.newaxis]
        traces = np.concatenate((points[ends - 1 + steps], last), axis=1)
        return self._shape.tip * traces.reshape(n, -1)


def all_streams(values: Mapping[str, Any]) -> list[Stream]:
    """Return every stream, in the order in which the samples of one time are sent."""
    imu, world, body = Imu(values), values['world_frame'], values['body_frame']
    return [Clock(values, messages.clock()), Pose(values, messages.pose_stamped(world)),
            JointStates(values, messages.joint_state(JOINTS)), ImuRaw(values, imu),
            ImuData(values, imu), ImuBias(values, imu), GroundTruthImu(values, imu),
            ImuTiming(values), Mag(values, imu), GroundTruthMag(values, imu),
            ImuDq(values, imu), ImuDv(values, imu),
            GroundTruthOdometry(values, messages.odometry(world, body)),
            GroundTruthImuOdometry(values, imu),
            Invariants(values, messages.float64_multi_array(INVARIANTS)), Markers(values)]
