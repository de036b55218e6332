# SPDX-License-Identifier: Apache-2.0
"""The channels; docs/architecture.md says how to add one."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.physics.states import relative_drift
from spinning_top_sim.streams import gnss, messages, parameters
from spinning_top_sim.streams.channel import Channel, Samples
from spinning_top_sim.streams.imu import Imu, Magnetometer, Mounting
from spinning_top_sim.streams.markers import markers
from spinning_top_sim.streams.messages import Field, Header, Numbers, Template, Values, message
from spinning_top_sim.streams.sensor import Timing
from spinning_top_sim.times import NANOSECONDS, period_ns

NODE_NAME = 'spinning_top'
JOINTS = ('precession_joint', 'nutation_joint', 'spin_joint')
INVARIANTS = ('energy', 'l3', 'lz', 'energy_drift', 'l3_drift', 'lz_drift',
              'quaternion_norm_error', 'orientation_error')
TIMING = ('stamp_sec', 'stamp_nanosec', 'true_sec', 'true_nanosec', 'copies')
IMU, ODOMETRY = 'sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry'
ARRAY, MAGNETIC_FIELD = 'std_msgs/msg/Float64MultiArray', 'sensor_msgs/msg/MagneticField'
EXACT = 3 * (messages.EXACT,)


def _pose(samples: Samples) -> Sequence[Values]:
    states = samples.states
    return (*states.pivot.position,), states.rows_quaternion


def _odometry(samples: Samples) -> Sequence[Values]:
    states = samples.states
    return (*_pose(samples), states.world_velocity(messages.ORIGIN),
            states.rows_angular_velocity)


def _imu_odometry(mounting: Mounting, samples: Samples) -> Sequence[Values]:
    states, arm = samples.states, mounting.lever_arm
    return (states.position(arm), samples.orientation,
            mounting.from_body(states.world_velocity(arm)), mounting.true(states)[0])


def _joints(samples: Samples) -> Sequence[Values]:
    states = samples.states
    return ((states.phi, states.theta, states.psi),
            (states.phi_dot, states.theta_dot, states.psi_dot))


def _timing(timing: Timing, samples: Samples) -> Sequence[Values]:
    """Return stamp and true time of each sample of the IMU, and how often it was sent."""
    late_ns, copies = timing(samples.t_ns)
    return (*np.divmod(samples.stamps(late_ns), NANOSECONDS),
            *np.divmod(samples.stamps(), NANOSECONDS), copies),


def _invariants(samples: Samples) -> Sequence[Values]:
    """Return the constants of the motion, drifts, and errors of norm and orientation."""
    states = samples.states
    trajectory, now = samples.trajectory, (states.energy, states.l3, states.lz)
    drifts = (relative_drift(value, trajectory.constants(name, samples.t_ns))
              for name, value in zip(('energy', 'l3', 'lz'), now, strict=True))
    error = angle_between(states.rows_quaternion, trajectory.exact_attitude(samples.t_ns))
    return (*now, *drifts, states.norm_error, error),


def _magnetic_field(sensor: Magnetometer, samples: Samples) -> Sequence[Values]:
    field = sensor.disturbed(samples.orientation, samples.t_ns)
    return (sensor.read(field, sensor.errors(samples.t_ns)),
            messages.diagonal(*3 * (sensor.variance,)))


def all_channels(values: Mapping[str, Any], imu: Imu) -> list[Channel]:
    """
    Return every channel, in the order in which the samples of one time are sent.

    values : parameters in effect, with the present rates
    imu : at the present `imu.rate`
    """
    world, body, frame = values['world_frame'], values['body_frame'], values['imu.frame_id']
    timing = Timing(values, imu.period_ns)

    def channel(name: str, topic: str, type_name: str, template: Template,
                fields: Callable[[Samples], Sequence[Values]] = lambda _: (),
                rate_name: str = '', timed: bool = False) -> Channel:
        """Return a channel; one that is `timed` has the stamps and the losses of the IMU."""
        period = period_ns(values[rate_name or f'{name}.rate'])
        return Channel(name, topic, type_name, period, template, fields,
                       timing if timed and not timing.is_right else None)

    # Covariances of angular velocity, specific force and orientation.
    noisy = [messages.diagonal(*variances) for variances in (
        3 * (imu.gyroscope.variance,), 3 * (imu.accelerometer.variance,),
        imu.orientation_variances)]
    magnetometer = Magnetometer(values, period_ns(values['mag.rate']))
    magnetic_field = message(Header(frame), Field('magnetic_field', 3),
                             Field('magnetic_field_covariance', 9))
    return [
        channel('clock', '/clock', 'rosgraph_msgs/msg/Clock', message(Header(None))),
        channel('pose', 'pose', 'geometry_msgs/msg/PoseStamped', message(
            Header(world), Field('pose.position', 3), Field('pose.orientation', 4)), _pose),
        channel('tf', '/tf', 'tf2_msgs/msg/TFMessage', message(
            Numbers('I', (1,)), Header(world), body,
            Field('transforms[0].transform.translation', 3),
            Field('transforms[0].transform.rotation', 4)), _pose),
        channel('joint_states', 'joint_states', 'sensor_msgs/msg/JointState', message(
            Header(''), Numbers('I', (3,)), *JOINTS, Numbers('I', (3,)), Field('position', 3),
            Numbers('I', (3,)), Field('velocity', 3), Numbers('I', (0,))), _joints),
        channel('imu', 'imu/data_raw', IMU, messages.imu(frame, *noisy[:2]),
                lambda samples: samples.readings, timed=True),
        channel('imu_data', 'imu/data', IMU, messages.imu(frame, *noisy),
                lambda samples: (imu.estimated(samples.orientation, samples.t_ns),
                                 *samples.readings), timed=True),
        channel('imu', 'ground_truth/imu_bias', IMU, messages.imu(frame, *EXACT[:2]),
                lambda samples: [list(bias) for _, bias in samples.errors]),
        channel('ground_truth_imu', 'ground_truth/imu', IMU, messages.imu(frame, *EXACT),
                lambda samples: (samples.orientation, *samples.exact)),
        channel('imu_timing', 'ground_truth/imu_timing', ARRAY,
                messages.float64_multi_array(TIMING),
                partial(_timing, timing), 'imu.rate'),
        channel('mag', 'imu/mag', MAGNETIC_FIELD, magnetic_field,
                partial(_magnetic_field, magnetometer)),
        channel('mag', 'ground_truth/mag', MAGNETIC_FIELD, magnetic_field,
                lambda samples: (magnetometer.true(samples.orientation), messages.EXACT)),
        *gnss.channels(values),
        channel('increments', 'imu/dq', 'geometry_msgs/msg/QuaternionStamped', message(
            Header(frame), Field('quaternion', 4)), lambda samples: samples.increments[:1],
            'imu.rate', timed=True),
        channel('increments', 'imu/dv', 'geometry_msgs/msg/Vector3Stamped', message(
            Header(frame), Field('vector', 3)), lambda samples: samples.increments[1:],
            'imu.rate', timed=True),
        channel('ground_truth_odom', 'ground_truth/odom', ODOMETRY,
                messages.odometry(world, body), _odometry),
        channel('ground_truth_imu_odom', 'ground_truth/imu_odom', ODOMETRY,
                messages.odometry(world, frame), partial(_imu_odometry, imu.mounting)),
        channel('invariants', '~/invariants', ARRAY, messages.float64_multi_array(INVARIANTS),
                _invariants),
        markers(values)]


def recorded(channels: Sequence[Channel], values: Mapping[str, Any]) -> list[Channel]:
    """Return the channels that are recorded."""
    return [channel for channel in channels if is_recorded(channel.name, values)]


def is_recorded(name: str, values: Mapping[str, Any]) -> bool:
    """Return whether channels are switched on and `record.streams` chooses them."""
    chosen = values['record.streams']
    return parameters.is_enabled(name, values) and ('all' in chosen or name in chosen)


def resolve_topic(topic: str, namespace: str) -> str:
    """Return the full name of a topic, as ROS resolves it for the node in this namespace."""
    if topic.startswith('/'):
        return topic
    parts = [namespace.strip('/'), topic.replace('~', NODE_NAME, 1)]
    return '/' + '/'.join(filter(None, parts))
