# SPDX-License-Identifier: Apache-2.0
"""The streams; docs/architecture.md says how to add one."""

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Vector
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.physics.top import Shape
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.gnss import Fix, Velocity
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.magnetometer import Magnetometer
from spinning_top_sim.streams.stream import Samples, Stream
from spinning_top_sim.streams.timing import Timing, timing_of

NODE_NAME = 'spinning_top'
JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
TIMING = ('stamp_sec', 'stamp_nanosec', 'true_sec', 'true_nanosec', 'copies')
ARRAY, ODOMETRY = 'std_msgs/msg/Float64MultiArray', 'nav_msgs/msg/Odometry'
MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'


def _place(samples: Samples) -> Sequence[Any]:
    return tuple(samples.pivot.position) if samples.pivot_moves else messages.ORIGIN


def _pose(samples: Samples) -> Sequence[Field]:
    return _place(samples), samples.states.rows_quaternion


def _odometry(samples: Samples) -> Sequence[Field]:
    states = samples.states
    return (*_pose(samples), samples.once(_velocity), states.rows_angular_velocity)


def _velocity(samples: Samples) -> Vector:
    if not samples.pivot_moves:
        return messages.ORIGIN
    x, y, z = samples.pivot.velocity
    return attitude.rotated_back(samples.states.rows_quaternion, (x, y, z))


def _joints(samples: Samples) -> Sequence[Field]:
    states = samples.states
    return ((states.phi, states.theta, states.psi),
            (states.phi_dot, states.theta_dot, states.psi_dot))


def _readings(imu: Imu, samples: Samples) -> Sequence[Field]:
    return (messages.NO_ROTATION, *imu.sensor.read(samples.once(imu.felt), samples.times))


def _estimates(imu: Imu, samples: Samples) -> Sequence[Field]:
    _, *readings = _readings(imu, samples)
    exact = imu.orientation(samples.states)
    return (imu.sensor.orientation(exact, samples.times), *readings)


def _timing(timing: Timing, imu: Imu, samples: Samples) -> Sequence[Field]:
    """Return stamp and true time of each sample of the IMU, and how often it was sent."""
    t_ns, period_ns = samples.t_ns, imu.length_ns
    stamps_ns = timing.stamps_ns(samples.epoch_ns, t_ns, period_ns)
    true_ns = samples.epoch_ns + t_ns
    columns = (*np.divmod(stamps_ns, NANOSECONDS), *np.divmod(true_ns, NANOSECONDS),
               timing.copies(t_ns, period_ns))
    return ([column.astype(np.float64) for column in columns],)


def _invariants(samples: Samples) -> Sequence[Field]:
    """Return the constants of the motion, drifts, and errors of norm and orientation."""
    states = samples.states
    now = (states.energy, states.l3, states.lz)
    drifts = map(relative_drift, now, map(samples.at_start, ('energy', 'l3', 'lz')))
    return ((*now, *drifts, states.norm_error, samples.orientation_error),)


class ImuStream(Stream):
    """Messages sensor_msgs/Imu, with the covariances for the present rate of the IMU."""

    def __init__(self, values: Mapping[str, Any], imu: Imu, parameter: str, topic: str,
                 fields: Callable[[Samples], Sequence[Field]], *, has_orientation: bool = True,
                 is_noisy: bool = False) -> None:
        self.imu, self._frame_id = imu, values['imu.frame_id']
        self.has_orientation, self._is_noisy = has_orientation, is_noisy
        super().__init__(values, parameter, topic, 'sensor_msgs/msg/Imu', self._template(),
                         fields=fields, timing=timing_of(values) if is_noisy else None)

    def apply(self, changes: Mapping[str, Any]) -> None:
        super().apply(changes)
        self.template = copy(self._template())      # `imu` has the new rate already

    def _template(self) -> Template:
        covariances = 3 * [messages.EXACT]
        if self._is_noisy:
            sensor = self.imu.sensor
            covariances = [messages.diagonal(*variances) for variances in (
                sensor.orientation_variances, 3 * (sensor.rate_variance,),
                3 * (sensor.force_variance,))]
        if not self.has_orientation:
            covariances[0] = messages.UNKNOWN_ORIENTATION
        return messages.imu(self._frame_id, *covariances)


class MagneticField(Stream):
    """Readings of the magnetometer, a sample of which is taken for each message."""

    def __init__(self, values: Mapping[str, Any], imu: Imu) -> None:
        super().__init__(values, 'mag', 'imu/mag', MAGNETIC_FIELD,
                         messages.stamped(values['imu.frame_id'], 3, 9), fields=self._field)
        self._imu, self._sensor_of = imu, lru_cache(4)(partial(Magnetometer, values))

    def _field(self, samples: Samples) -> Sequence[Field]:
        sensor = self._sensor_of(self.period_ns)
        orientation = self._imu.orientation(samples.states)
        field = sensor.disturbed(sensor.true(orientation), orientation, self._imu.from_body,
                                 samples.t_ns)
        return sensor.read(field, samples.times), messages.diagonal(*3 * (sensor.variance,))


class Markers(Stream):
    """
    The top and the trace of its tip for Foxglove and RViz, in the world frame.

    Every message has the whole trace, so that it is complete wherever a viewer starts or jumps in
    a log.  Its points are on the exact path, at multiples of a fixed time step; the last one is
    the tip of the body.
    """

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
        template = messages.markers(
            values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
            0.02 * abs(shape.tip), self._count + 1 if self._count else 0)
        super().__init__(values, 'markers', 'markers', 'visualization_msgs/msg/MarkerArray',
                         template, fields=self._markers)

    def _markers(self, samples: Samples) -> Sequence[Field]:
        states = samples.states
        body = (self._point(samples, self._shape.centre), states.rows_quaternion,
                _place(samples), states.rows_quaternion)
        return (*body, self._traces(samples)) if self._count else body

    def _traces(self, samples: Samples) -> NDArray[np.float64]:
        """Return the points of the traces that end at these samples, (n, 3 (count + 1))."""
        newest = (samples.t_ns[:, np.newaxis] - 1) // self._spacing_ns
        # Traces share points, which are computed once.
        numbers, places = np.unique(np.maximum(newest + np.arange(1 - self._count, 1), 0),
                                    return_inverse=True)
        points = samples.path.exact_points(numbers * self._spacing_ns, self._shape.tip)
        traces = points[places.reshape(len(newest), -1)]
        last = np.stack(self._point(samples, self._shape.tip), axis=-1)[:, np.newaxis]
        return np.concatenate((traces, last), axis=1).reshape(len(newest), -1)

    @staticmethod
    def _point(samples: Samples, along: float) -> Vector:
        x, y, z = (along * part for part in samples.states.rows_axis)
        if samples.pivot_moves:
            a, b, c = samples.pivot.position
            x, y, z = x + a, y + b, z + c
        return x, y, z


def all_streams(values: Mapping[str, Any], imu: Imu | None = None) -> list[Stream]:
    """
    Return every stream, in the order in which the samples of one time are sent.

    imu : of which they are; None: one of these parameters
    """
    imu, world, body = imu or Imu(values), values['world_frame'], values['body_frame']
    frame, timing = values['imu.frame_id'], timing_of(values)
    stream, of_imu = partial(Stream, values), partial(ImuStream, values, imu)
    increment = partial(stream, 'increments', timing=timing, rate_parameter='imu.rate')
    return [
        stream('clock', '/clock', 'rosgraph_msgs/msg/Clock', messages.clock()),
        stream('pose', 'pose', 'geometry_msgs/msg/PoseStamped', messages.stamped(world, 3, 4),
               fields=_pose),
        stream('tf', '/tf', 'tf2_msgs/msg/TFMessage', messages.transform(world, body),
               fields=_pose),
        stream('joint_states', 'joint_states', 'sensor_msgs/msg/JointState',
               messages.joint_state(JOINTS), fields=_joints),
        of_imu('imu', 'imu/data_raw', partial(_readings, imu), has_orientation=False,
               is_noisy=True),
        of_imu('imu_data', 'imu/data', partial(_estimates, imu), is_noisy=True),
        of_imu('imu', 'ground_truth/imu_bias', has_orientation=False, fields=lambda samples: (
            messages.NO_ROTATION, *imu.sensor.bias(samples.times))),
        of_imu('ground_truth_imu', 'ground_truth/imu',
               lambda samples: (imu.orientation(samples.states), *imu.sampled(samples))),
        stream('imu_timing', 'ground_truth/imu_timing', ARRAY,
               messages.float64_multi_array(TIMING), rate_parameter='imu.rate',
               fields=partial(_timing, Timing(values), imu)),
        MagneticField(values, imu),
        stream('mag', 'ground_truth/mag', MAGNETIC_FIELD, messages.stamped(frame, 3, 9),
               fields=lambda samples: (
                   attitude.rotated_back(imu.orientation(samples.states), values['mag.field']),
                   messages.EXACT)),
        Fix(values, 'gnss/fix'),
        Fix(values, 'ground_truth/gnss/fix', is_exact=True),
        Velocity(values, 'gnss/velocity'),
        Velocity(values, 'ground_truth/gnss/velocity', is_exact=True),
        increment('imu/dq', 'geometry_msgs/msg/QuaternionStamped', messages.stamped(frame, 4),
                  fields=lambda samples: samples.once(imu.measured_increments)[:1]),
        increment('imu/dv', 'geometry_msgs/msg/Vector3Stamped', messages.stamped(frame, 3),
                  fields=lambda samples: samples.once(imu.measured_increments)[1:]),
        stream('ground_truth_odom', 'ground_truth/odom', ODOMETRY, messages.odometry(world, body),
               fields=_odometry),
        stream('ground_truth_imu_odom', 'ground_truth/imu_odom', ODOMETRY,
               messages.odometry(world, frame),
               fields=lambda samples: (*imu.motion(samples), imu.true(samples.states)[0])),
        stream('invariants', '~/invariants', ARRAY, messages.float64_multi_array(INVARIANTS),
               fields=_invariants),
        Markers(values)]


def resolve_topic(topic: str, namespace: str) -> str:
    """Return the full name of a topic, as ROS resolves it for the node in this namespace."""
    if topic.startswith('/'):
        return topic
    parts = [namespace.strip('/'), topic.replace('~', NODE_NAME, 1)]
    return '/' + '/'.join(filter(None, parts))
