# SPDX-License-Identifier: Apache-2.0
"""The streams.  What a new one needs is said in docs/architecture.md."""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Quaternion, Vector
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import Shape
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.stream import Samples, Stream, period_ns

if TYPE_CHECKING:
    from spinning_top_sim.streams.magnetometer import Magnetometer
    from spinning_top_sim.streams.timing import Timing

JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
TIMING = ('stamp_sec', 'stamp_nanosec', 'true_sec', 'true_nanosec', 'copies')
# Parameters of what goes wrong with the messages of the IMU.
TIMING_FAULTS = ('imu.stamp_offset', 'imu.stamp_jitter', 'imu.clock_drift', 'imu.drop_rate',
                 'imu.duplicate_rate')
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Pose(Stream):
    """The attitude, at the pivot."""

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
    """Attitude and body rates, exact."""

    parameter, topic, type_name = ('ground_truth_odom', 'ground_truth/odom',
                                   'nav_msgs/msg/Odometry')

    def fields(self, samples: Samples) -> Sequence[Field]:
        return samples.states.rows_quaternion, samples.states.rows_angular_velocity


class ImuStream(Stream):
    """What all IMU topics share: the IMU, which takes its samples at `imu.rate`."""

    type_name = 'sensor_msgs/msg/Imu'
    has_orientation, is_noisy = True, False

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self._frame_id, self.imu = values['imu.frame_id'], imu
        self._sensor = imu.sensor(period_ns(values['imu.rate']))
        super().__init__(values, self._template())

    @property
    def at_once(self) -> tuple[str, ...]:
        return (*super().at_once, 'imu.rate')

    def apply(self, changes: Mapping[str, Any]) -> None:
        super().apply(changes)
        if 'imu.rate' in changes:
            # The noise of a sample follows from its density and the rate.
            self._sensor = self.imu.sensor(period_ns(changes['imu.rate']))
            self.template = self._template()

    def _template(self) -> Template:
        sensor = self._sensor
        variances = (sensor.orientation_variances, 3 * (sensor.rate_variance,),
                     3 * (sensor.force_variance,)) if self.is_noisy else 3 * (3 * (0.0,),)
        orientation, *others = (messages.diagonal(*three) for three in variances)
        return messages.imu(
            self._frame_id,
            orientation if self.has_orientation else messages.UNKNOWN_ORIENTATION, *others)


class ImuRaw(ImuStream):
    """What the sensor reads, without an orientation (REP-145)."""

    parameter, topic, has_orientation, is_noisy = 'imu', 'imu/data_raw', False, True

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        super().__init__(values, imu)
        self._timing = _timing(values) if any(map(values.get, TIMING_FAULTS)) else None

    def encode(self, samples: Samples, epoch_ns: int,
               ) -> tuple[NDArray[np.int64], NDArray[Any]]:
        if self._timing is None:
            return super().encode(samples, epoch_ns)
        t_ns, timing = samples.t_ns, self._timing
        rows = self.template.encode(timing.stamps_ns(epoch_ns, t_ns, self.period_ns),
                                    *self.fields(samples))
        copies = timing.copies(t_ns, self.period_ns)
        return np.repeat(t_ns, copies), np.repeat(rows, copies, axis=0)

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (IDENTITY, *self._sensor.read(self.imu.sampled(samples), samples.times))


class ImuData(ImuRaw):
    """What the sensor reads, with the orientation of its frame."""

    parameter, topic, has_orientation = 'imu_data', 'imu/data', True

    def fields(self, samples: Samples) -> Sequence[Field]:
        _, *readings = super().fields(samples)
        exact = self.imu.orientation(samples.states)
        return (self._sensor.orientation(exact, samples.times), *readings)


class ImuBias(ImuStream):
    """The bias that the readings contain; it has the rate of the raw readings, `imu.rate`."""

    parameter, topic, has_orientation = 'imu', 'ground_truth/imu_bias', False

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (IDENTITY, *self._sensor.bias(samples.times))


class ImuTiming(Stream):
    """The stamp and the true time of each sample of the IMU, and how often it was sent."""

    parameter, topic, type_name = ('imu_timing', 'ground_truth/imu_timing',
                                   'std_msgs/msg/Float64MultiArray')
    rate_parameter = 'imu.rate'

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        super().__init__(values, messages.float64_multi_array(TIMING))

    @cached_property
    def _timing(self) -> 'Timing':
        return _timing(self._values)

    def encode(self, samples: Samples, epoch_ns: int,
               ) -> tuple[NDArray[np.int64], NDArray[Any]]:
        t_ns = samples.t_ns
        true_ns = epoch_ns + t_ns
        stamps_ns = self._timing.stamps_ns(epoch_ns, t_ns, self.period_ns)
        columns = (*np.divmod(stamps_ns, NANOSECONDS), *np.divmod(true_ns, NANOSECONDS),
                   self._timing.copies(t_ns, self.period_ns))
        return t_ns, self.template.encode(
            true_ns, [column.astype(np.float64) for column in columns])


def _timing(values: Mapping[str, Any]) -> 'Timing':
    from spinning_top_sim.streams.timing import Timing  # noqa: PLC0415 - not without faults

    return Timing(values)


class Mag(Stream):
    """What the magnetometer reads (REP-145)."""

    parameter, topic, type_name = 'mag', 'imu/mag', 'sensor_msgs/msg/MagneticField'

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self.imu, self._sensor = imu, lru_cache(2)(partial(_magnetometer, values))
        super().__init__(values, messages.magnetic_field(values['imu.frame_id']))

    def fields(self, samples: Samples) -> Sequence[Field]:
        sensor = self._sensor(self.period_ns)
        exact = sensor.true(self.imu.orientation(samples.states))
        return sensor.read(exact, samples.times), messages.diagonal(*3 * (sensor.variance,))


class GroundTruthMag(Mag):
    """What a perfect magnetometer reads."""

    topic = 'ground_truth/mag'

    def fields(self, samples: Samples) -> Sequence[Field]:
        exact = self._sensor(self.period_ns).true(self.imu.orientation(samples.states))
        return exact, messages.EXACT


def _magnetometer(values: Mapping[str, Any], period_ns: int) -> 'Magnetometer':
    from spinning_top_sim.streams.magnetometer import Magnetometer  # noqa: PLC0415 - off by default

    return Magnetometer(values, period_ns)


class GroundTruthImu(ImuStream):
    """What a perfect sensor in the same place reads, with its orientation."""

    parameter, topic = 'ground_truth_imu', 'ground_truth/imu'

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (self.imu.orientation(samples.states), *self.imu.sampled(samples))


class ImuIncrements(ImuRaw):
    """What the sensor measures over the interval that ends with a sample: docs/sensor.md."""

    parameter, rate_parameter = 'increments', 'imu.rate'

    def _measured(self, samples: Samples) -> tuple[Quaternion, Vector]:
        exact = self.imu.increments(samples)
        if self._sensor.is_perfect:
            return exact
        return self._sensor.disturb(exact, samples.once(self.imu.means), samples.times,
                                    self.imu.lengths(samples))


class ImuDq(ImuIncrements):
    """The rotation increment."""

    topic, type_name = 'imu/dq', 'geometry_msgs/msg/QuaternionStamped'

    def _template(self) -> Template:
        return messages.stamped(self._frame_id, 4)

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (self._measured(samples)[0],)


class ImuDv(ImuIncrements):
    """The velocity increment."""

    topic, type_name = 'imu/dv', 'geometry_msgs/msg/Vector3Stamped'

    def _template(self) -> Template:
        return messages.stamped(self._frame_id, 3)

    def fields(self, samples: Samples) -> Sequence[Field]:
        return (self._measured(samples)[1],)


class GroundTruthImuOdometry(Stream):
    """The IMU's frame in the world, exact: a lever arm moves it."""

    parameter, topic, type_name = ('ground_truth_imu_odom', 'ground_truth/imu_odom',
                                   'nav_msgs/msg/Odometry')

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        self.imu = imu
        super().__init__(values, messages.odometry(
            values['world_frame'], values['imu.frame_id'], moves=True))

    def fields(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        position, velocity = self.imu.motion(states)
        return position, self.imu.orientation(states), velocity, self.imu.true(states)[0]


class Invariants(Stream):
    """How well the constants of the motion are kept: relative drifts, absolute where one is 0."""

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

    def fields(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        centre = tuple(self._shape.centre * part for part in states.rows_axis)
        body = (centre, states.rows_quaternion, states.rows_quaternion)
        return (*body, self._traces(samples)) if self._count else body

    def _traces(self, samples: Samples) -> NDArray[np.float64]:
        """Return the points of the traces (n, 3 (count + 1)) that end with these samples."""
        count = self._count
        newest = (samples.t_ns - 1) // self._spacing_ns
        # A trace shares points with the one before it; there they are computed once.
        fresh = np.minimum(np.diff(newest, prepend=newest[0] - count), count)
        ends = np.cumsum(fresh)
        grid = np.repeat(newest + 1 - ends, fresh) + np.arange(ends[-1])
        points = samples.path.exact_axis(np.maximum(grid * self._spacing_ns, 0))
        traces = np.empty((len(newest), count + 1, 3))
        for row, end in zip(traces, ends.tolist(), strict=True):
            row[:-1] = points[end - count:end]
        traces[:, -1] = np.stack(samples.states.rows_axis, axis=-1)
        traces *= self._shape.tip
        return traces.reshape(len(newest), -1)


def all_streams(values: Mapping[str, Any]) -> list[Stream]:
    """Return every stream, in the order in which samples of one instant are sent."""
    imu, world, body = Imu(values), values['world_frame'], values['body_frame']
    return [Clock(values, messages.clock()), Pose(values, messages.pose_stamped(world)),
            JointStates(values, messages.joint_state(JOINTS)), ImuRaw(values, imu),
            ImuData(values, imu), ImuBias(values, imu), GroundTruthImu(values, imu),
            ImuTiming(values), Mag(values, imu), GroundTruthMag(values, imu),
            ImuDq(values, imu), ImuDv(values, imu),
            GroundTruthOdometry(values, messages.odometry(world, body)),
            GroundTruthImuOdometry(values, imu),
            Invariants(values, messages.float64_multi_array(INVARIANTS)), Markers(values)]
