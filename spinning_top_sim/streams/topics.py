# SPDX-License-Identifier: Apache-2.0
"""
The streams: for each a topic, a message type, a rate, and how a state becomes bytes.

A new stream is a subclass of `Stream` here, a template in messages.py and a line in
parameters.STREAM_DEFAULTS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from spinning_top_sim.physics.kinematics import Columns, OneState
from spinning_top_sim.physics.shape import shape_of
from spinning_top_sim.streams import messages, parameters
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

    sent, skipped: counts of samples published, and of those that came too late to be published
    log_index: its number in a log that takes the samples of all streams, None for none; see
    `Simulation.log_to`
    next_ns: when the next sample is due, if anybody takes it
    one_by_one: whether live samples are computed so: few, each with an exact solution of its own
    changed: called when what comes next is not what it would have been
    """

    parameter: str
    topic: str
    type_name: str
    template: Template
    one_by_one = False

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._publish: Callable[[bytes], Any] | None = None
        self._record: Callable[[int, bytes], Any] | None = None
        self.log_index: int | None = None
        self.changed: Callable[[], None] = lambda: None
        self.sent = self.skipped = 0
        self.next_ns = 0
        self.period_ns = 1
        self.set_rate(values[f'{self.parameter}.rate'])

    @property
    def publish(self) -> Callable[[bytes], Any] | None:
        """What a sample is handed to in time; None while nobody listens."""
        return self._publish

    @publish.setter
    def publish(self, sink: Callable[[bytes], Any] | None) -> None:
        if sink != self._publish:
            self._publish = sink
            self.changed()

    @property
    def record(self) -> Callable[[int, bytes], Any] | None:
        """What every sample is handed to, with its stamp [ns]; None for nothing."""
        return self._record

    @record.setter
    def record(self, sink: Callable[[int, bytes], Any] | None) -> None:
        if sink != self._record:
            self._record = sink
            self.changed()

    def set_rate(self, rate: float) -> None:
        """Put the samples on the grid of another rate [Hz]; call `resume` after."""
        self.period_ns = max(1, round(NANOSECONDS / rate))

    def resume(self, after_ns: int) -> None:
        """Make the first grid point later than `after_ns` the next sample."""
        self.next_ns = (after_ns // self.period_ns + 1) * self.period_ns
        self.changed()

    @property
    def wanted(self) -> bool:
        """Whether anybody takes the samples: else nothing is computed."""
        return self._publish is not None or self.recorded

    @property
    def recorded(self) -> bool:
        """Whether somebody takes every sample, however late."""
        return self._record is not None or self.log_index is not None

    @property
    def index(self) -> int:
        """Number k of the next sample."""
        return self.next_ns // self.period_ns

    def encode(self, state: OneState, stamp_ns: int, t_ns: int) -> bytes:
        """Return the serialized message of a state, its stamp, and its time [ns]."""
        return self.template.encode(stamp_ns, *self.runs(state, t_ns // self.period_ns))

    def encode_many(self, states: Columns, stamps_ns: Any) -> Any:
        """Return the messages of the next n samples as rows of bytes, (n, size) uint8."""
        first = self.index
        return self.template.encode_many(
            stamps_ns, *self.runs(states, range(first, first + len(stamps_ns))))

    def encode_columns(self, states: Columns, epoch_ns: int, times: range,
                       ) -> Iterator[list[bytes]]:
        """
        Yield the messages at these times [ns] after the stamp epoch_ns, each by itself.

        In pieces, of which some are empty: so that long work can be interrupted.
        """
        import numpy  # noqa: PLC0415 - where it is there already

        first = times.start // self.period_ns
        runs = self.runs(states, range(first, first + len(times)))
        yield []
        stamps_ns = numpy.arange(epoch_ns + times.start, epoch_ns + times.stop, times.step)
        data = self.template.encode_many(stamps_ns, *runs).tobytes()
        size = len(self.template)
        yield [data[at:at + size] for at in range(0, len(data), size)]

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
        return state.euler_angles, state.euler_rates


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

    def set_rate(self, rate: float) -> None:
        super().set_rate(rate)
        if not self._sensor.is_random:
            self.template = self.template.with_fixed(IDENTITY, *self._sensor.bias(0))

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        return (IDENTITY, *self._sensor.bias(index)) if self._sensor.is_random else ()


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
    one_by_one = True

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.template = messages.float64_multi_array(INVARIANTS)
        self._start = (0.0, 0.0, 0.0)
        self.orientation_error: Callable[[Columns, int], Any] = lambda state, t_ns: NAN

    def start_from(self, state: OneState) -> None:
        """Measure drifts from this state on."""
        self._start = (state.energy, state.l3_start, state.lz_start)

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        first = index.start if isinstance(index, range) else index
        now = (state.energy, state.l3, state.lz)
        drifts = [(value - start) / (abs(start) or 1.0)
                  for value, start in zip(now, self._start, strict=True)]
        return ((*now, *drifts, state.norm_error,
                 self.orientation_error(state, first * self.period_ns)),)


class Markers(Stream):
    """
    The top and the trace of its tip for Foxglove and RViz, in the world frame: no TF is needed.

    The body is the cylinder of `shape_of`; a line along the axis and down its side shows the spin.

    Every message has the whole trace, so that a viewer who comes late, or moves about in a log,
    sees it at once; yet it remembers no sample, for what is sent must not depend on who listened
    when.  Its points are those of the exact solution at fixed times m x spacing before the sample,
    and the tip of the body ends it: with a coarse `solver.rtol` one sees the body leave the path.
    Before t = 0 it rests at the start.
    """

    parameter, topic, type_name = 'markers', 'markers', 'visualization_msgs/msg/MarkerArray'
    one_by_one = True

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        shape = self._shape = shape_of(parameters.top_of(values))
        length_ns = round(values['markers.trace_length'] * NANOSECONDS)
        self._count = min(values['markers.trace_points'], length_ns)
        self._spacing_ns = max(1, length_ns // max(self._count, 1))
        self._points: dict[int, tuple[float, float, float]] = {}    # of the last trace, by m
        self.axis_at: Callable[[int], tuple[float, float, float]] = lambda t_ns: (0.0, 0.0, 1.0)
        side = math.copysign(0.5 * shape.height, shape.tip)
        # Slightly outside, to be seen.
        rim, far, near = (1.01 * shape.radius, shape.centre + 1.01 * side,
                          shape.centre - 1.01 * side)
        lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
                 0.0, 0.0, far, rim, 0.0, far,
                 rim, 0.0, far, rim, 0.0, near,
                 rim, 0.0, near, 0.0, 0.0, near)
        self.template = messages.markers(
            values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
            0.02 * abs(shape.tip), self._count + 1 if self._count else 0)

    def runs(self, state: Columns, index: int | range) -> tuple[Any, ...]:
        across, along = state.axis
        axis = across.real, across.imag, along
        centre = tuple(self._shape.centre * part for part in axis)
        body = centre, state.quaternion, state.quaternion
        if not self._count:
            return body
        tip = tuple(self._shape.tip * part for part in axis)
        if isinstance(index, int):
            return (*body, [number for point in (*self._trace(index * self.period_ns), tip)
                            for number in point])
        return (*body, self._traces(len(index), tip))

    def forget_after(self, t_ns: int) -> None:
        """Drop what was computed ahead of a time, at which another motion begins."""
        self._points = {m: point for m, point in self._points.items()
                        if m * self._spacing_ns <= t_ns}

    def _trace(self, t_ns: int) -> list[tuple[float, float, float]]:
        """Return where the tip was at the times of the grid before t."""
        newest = (t_ns - 1) // self._spacing_ns
        known = self._points
        self._points = {m: known.get(m) or self._tip_at(m * self._spacing_ns)
                        for m in range(newest - self._count + 1, newest + 1)}
        return list(self._points.values())

    def _traces(self, count: int, tips: tuple[Any, ...]) -> Any:
        """Return the points of the next `count` samples as rows of numbers."""
        import numpy  # noqa: PLC0415 - offline only

        rows = numpy.empty((count, self._count + 1, 3))
        for k in range(count):
            rows[k, :-1] = self._trace(self.next_ns + k * self.period_ns)
        for axis, column in enumerate(tips):
            rows[:, -1, axis] = column
        return rows.reshape(count, -1)

    def _tip_at(self, t_ns: int) -> tuple[float, float, float]:
        x, y, z = self.axis_at(max(t_ns, 0))
        tip = self._shape.tip
        return tip * x, tip * y, tip * z


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
            GroundTruthOdometry(values), Invariants(values), Markers(values)]
