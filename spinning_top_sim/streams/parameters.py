# SPDX-License-Identifier: Apache-2.0
"""
The parameters of a simulation: name, default, unit, range, and when a change takes effect.

The node (descriptors, validation), the command line and the documentation use the same table.
The defaults describe the cusp scene: a bicycle wheel on a pivot, spun about its axis and let go.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

from spinning_top_sim.installation import remedy
from spinning_top_sim.physics.pivot import SHORTEST_S, PivotPath
from spinning_top_sim.physics.top import State, Top, shown
from spinning_top_sim.solvers.solve import EQUATIONS, METHODS
from spinning_top_sim.streams.parameter import Effect, Parameter

# Name, default rate [Hz], on by default, description.  Streams with None have the rate `imu.rate`.
STREAM_DEFAULTS: tuple[tuple[str, float | None, bool, str], ...] = (
    ('pose', 100.0, True, 'pose (geometry_msgs/PoseStamped)'),
    ('tf', 100.0, False, '/tf (tf2_msgs/TFMessage), world_frame -> body_frame'),
    ('joint_states', 100.0, True, 'joint_states (sensor_msgs/JointState)'),
    ('imu', 200.0, True, 'imu/data_raw and ground_truth/imu_bias (sensor_msgs/Imu)'),
    ('imu_data', 200.0, False, 'imu/data (sensor_msgs/Imu with orientation)'),
    ('ground_truth_imu', 200.0, True, 'ground_truth/imu (sensor_msgs/Imu, noise-free)'),
    ('imu_timing', None, False, 'ground_truth/imu_timing (std_msgs/Float64MultiArray)'),
    ('mag', 100.0, False, 'imu/mag and ground_truth/mag (sensor_msgs/MagneticField)'),
    ('gnss', 10.0, False, 'gnss/fix (sensor_msgs/NavSatFix), gnss/velocity '
     '(geometry_msgs/TwistWithCovarianceStamped), and ground_truth/gnss of both'),
    ('increments', None, False, 'imu/dq (geometry_msgs/QuaternionStamped), imu/dv '
     '(geometry_msgs/Vector3Stamped), both at imu.rate, and ground_truth/imu_odom'),
    ('ground_truth_odom', 100.0, True, 'ground_truth/odom (nav_msgs/Odometry)'),
    ('ground_truth_imu_odom', 200.0, False, 'ground_truth/imu_odom (nav_msgs/Odometry)'),
    ('invariants', 10.0, True, '~/invariants (std_msgs/Float64MultiArray)'),
    ('markers', 20.0, False, 'markers (visualization_msgs/MarkerArray)'),
    ('clock', 100.0, False, '/clock (rosgraph_msgs/Clock)'),
)
# Second parameter that switches a stream on.
OTHER_SWITCH = {'ground_truth_imu_odom': 'increments.enabled'}
# In logs of 1.x.
REMOVED = ('pacing', 'max_error', 'publish_clock')
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
HIGHEST_RATE = 10_000.0
LOWEST_RATE_OF_INTERVALS = 1.0      # of increments and means: the motion is kept for a second
LARGEST = 1e30                      # of a quantity: its squares and products are doubles
LONGEST = 1e8                       # time [s], three years
FASTEST = 1e4                       # speed of the pivot [m/s]

_at_once = partial(Parameter, effect=Effect.NOW)
_at_reset = partial(Parameter, effect=Effect.RESET)
_at_start = partial(Parameter, effect=Effect.START)
_at_recording = partial(Parameter, effect=Effect.RECORDING)


def _stream(name: str, rate: float | None, enabled: bool, text: str) -> Iterator[Parameter]:
    yield _at_once(f'{name}.enabled', enabled, f'Whether there is {text}; a recording keeps '
                   'the streams that it began with')
    if rate is not None:
        yield _at_once(f'{name}.rate', rate, f'Rate of {text}', 'Hz', 1e-6, HIGHEST_RATE)


def _axes(kind: str, unit: str, walk_unit: str) -> list[Parameter]:
    """Return the parameters of the errors of three axes, with the names and units of kalibr."""
    errors = [
        _at_reset(f'imu.{kind}_{name}', 0.0, text, unit_text, 0.0, 1e12, smallest=1e-12)
        for name, text, unit_text in (
            ('noise_density', f'White noise of the {kind}, 0 = none', f'{unit}/sqrt(Hz)'),
            ('random_walk', f'Random walk of the bias of the {kind}, 0 = none', walk_unit),
            ('turn_on_bias', f'Standard deviation of the bias of the {kind} at the start', unit),
            ('bias_stddev', f'Standard deviation of a Gauss-Markov bias of the {kind}, 0 = none',
             unit),
            ('bias_instability', f'Flat of the Allan deviation of a flicker bias of the {kind}, '
             '0 = none', unit),
            ('range', f'Largest reading of the {kind}, 0 = unlimited', unit),
            ('resolution', f'Smallest step of the readings of the {kind}, 0 = none', unit))]
    return [
        _at_reset(f'imu.{kind}_M', IDENTITY, f'Scale and misalignment of the {kind}, row by '
                  'row', '', -1e6, 1e6),
        *errors,
        _at_reset(f'imu.{kind}_bias_correlation_time', 100.0,
                  f'Correlation time of the Gauss-Markov bias of the {kind}', 's', 0.01, LONGEST)]


TABLE: tuple[Parameter, ...] = (
    _at_reset('top.mass', 2.0, 'Mass of the top', 'kg', 0.0, LARGEST),
    _at_reset('top.com_distance', 0.15, 'Signed distance from the pivot to the centre of mass '
              'along the axis', 'm', -LARGEST, LARGEST),
    _at_reset('top.lambda1', 0.123, 'Moment of inertia across the axis, about the pivot',
              'kg m^2', above=0.0, maximum=LARGEST),
    _at_reset('top.lambda3', 0.15, 'Moment of inertia along the axis', 'kg m^2', above=0.0,
              maximum=LARGEST),
    _at_reset('top.gravity', 9.80665, 'Gravity, downwards positive', 'm/s^2', -LARGEST, LARGEST),
    _at_reset('initial.theta', math.radians(30.0), 'Tilt at the start', 'rad', 0.0, math.pi),
    _at_reset('initial.theta_dot', 0.0, 'Nutation rate at the start', 'rad/s', -1e12, 1e12),
    _at_reset('initial.phi', 0.0, 'Precession angle at the start', 'rad', -1e12, 1e12),
    _at_reset('initial.psi', 0.0, 'Spin angle at the start', 'rad', -1e12, 1e12),
    _at_reset('pivot.path', 4 * (0.0,), 'Path of the pivot: duration [s] and acceleration x, y, z '
              '[m/s^2] in the world of each piece, one after the other; zeros: none', '', -1e6,
              1e8, is_repeated=True),
    _at_reset('pivot.waypoints', 3 * (0.0,), 'Path of the pivot: x, y, z in the world of each '
              'point at which it stops; zeros: none', 'm', -1e6, 1e6, is_repeated=True),
    _at_reset('pivot.speed', 1.0, 'Highest speed between the waypoints', 'm/s', above=0.0,
              maximum=FASTEST),
    _at_reset('pivot.acceleration', 1.0, 'Acceleration between the waypoints', 'm/s^2', above=0.0,
              maximum=1e6),
    _at_reset('pivot.repeat', False, 'Repeat the path for ever; the waypoints: back to the first '
              'one'),
    _at_reset('pivot.max_acceleration', 2.0, 'Acceleration with which ~/cmd_vel is followed',
              'm/s^2', 1e-6, 1e6),
    _at_reset('pivot.cmd_timeout', 0.5, 'The pivot brakes this long after the last ~/cmd_vel, '
              '0 = never', 's', 0.0, LONGEST, smallest=1e-3),
    # No range: the limit depends on the motion.
    _at_once('spin.l3', 1.6, 'Angular momentum along the axis; a change is a command',
             'kg m^2/s'),
    _at_once('spin.lz', None, 'Angular momentum along the vertical; a change is a command; unset: '
             'L3 cos(initial.theta), the cusp', 'kg m^2/s'),
    _at_reset('solver.method', 'rk45', 'Dormand-Prince steps or the closed form', choices=METHODS),
    _at_reset('solver.equations', 'transport',
              'rk45: equations of motion, regular everywhere or those of the paper',
              choices=EQUATIONS),
    _at_reset('solver.rtol', 1e-11, 'rk45: relative tolerance of a step', '', 1e-14, 1e-2),
    _at_reset('solver.atol', 1e-12, 'rk45: absolute tolerance of a step', '', 0.0, 1e-2),
    _at_once('tick_rate', 200.0, 'How often due samples are sent; below 4, it is 4', 'Hz', 1e-2,
             HIGHEST_RATE),
    _at_once('time_scale', 1.0, 'Simulated over real time', '', 1e-6, 1e6),
    _at_start('start_paused', False, 'Wait for ~/set_pause or ~/step'),
    _at_start('simulation_interfaces', True, 'Offer the services of simulation_interfaces if that '
              'package is installed'),
    _at_start('world_frame', 'world', 'Frame of the world, z up; its origin is the pivot at '
              't = 0, or that of the waypoints'),
    _at_start('body_frame', 'base_link', 'Frame of the body, z along its axis'),
    _at_reset('seed', 0, 'Seed of the noise', '', 0, 2 ** 63 - 1),
    *(parameter for row in STREAM_DEFAULTS for parameter in _stream(*row)),
    _at_start('imu.frame_id', 'imu_link', 'Frame of the IMU'),
    _at_reset('imu.lever_arm', (0.0, 0.0, 0.0), 'Position of the IMU in the body', 'm', -1e12,
              1e12),
    _at_reset('imu.rpy', (0.0, 0.0, 0.0), 'Orientation of the IMU in the body, roll, pitch and '
              'yaw about fixed axes', 'rad', -1e6, 1e6),
    _at_reset('imu.sampling', 'instant', 'A sample is the value at its stamp, or the mean over '
              'the period before it', choices=('instant', 'mean')),
    _at_reset('imu.bandwidth', 0.0, 'Frequency at which the gain of the IMU is -3 dB, 0 = '
              'unlimited; not with imu.sampling = mean', 'Hz', 0.0, 1e5, smallest=1.0),
    _at_reset('imu.bandwidth_order', 1, 'Order of this low pass; 2: Butterworth', '', 1, 2),
    _at_reset('imu.vibration.frequency', 100.0, 'Frequency of the sine that the IMU vibrates with',
              'Hz', above=0.0, maximum=1e6),
    _at_reset('imu.vibration.force', (0.0, 0.0, 0.0), 'Amplitude of this sine in the specific '
              'force', 'm/s^2', -1e6, 1e6),
    _at_reset('imu.vibration.rate', (0.0, 0.0, 0.0), 'Amplitude of this sine in the angular '
              'velocity', 'rad/s', -1e6, 1e6),
    *(_at_reset(f'imu.vibration.{kind}_psd', (0.0, 0.0), f'Vibration of the {text} of each axis: '
                f'ascending frequencies [Hz], each with its one-sided spectral density [{unit}]; '
                'zeros: none', '', 0.0, 1e6, smallest=1e-100, is_repeated=True)
      for kind, text, unit in (
          ('force', 'specific force', '(m/s^2)^2/Hz'),
          ('rate', 'angular velocity', '(rad/s)^2/Hz'))),
    *_axes('gyroscope', 'rad/s', 'rad/s^2/sqrt(Hz)'),
    *_axes('accelerometer', 'm/s^2', 'm/s^3/sqrt(Hz)'),
    _at_reset('imu.gyroscope_A', 9 * (0.0,), 'Sensitivity of the gyroscope to specific force, row '
              'by row', '(rad/s)/(m/s^2)', -1e6, 1e6),
    _at_reset('imu.bias_instability_band', (1.0, 1000.0), 'Shortest and longest averaging time '
              'with the flat of the flicker bias', 's', 0.01, 1e6),
    _at_reset('imu.orientation_stddev', (0.0, 0.0, 0.0), 'Standard deviation of the noise of the '
              'orientation in imu/data, about the axes of the IMU', 'rad', 0.0, 1.0,
              smallest=1e-12),
    _at_reset('imu.stamp_offset', 0.0, 'Added to the stamps of imu/data_raw, imu/data, imu/dq '
              'and imu/dv', 's', -1.0, 1.0),
    _at_reset('imu.stamp_jitter', 0.0, 'Standard deviation of the noise of these stamps, cut at '
              '0.45 periods', 's', 0.0, 1.0),
    _at_reset('imu.clock_drift', 0.0, 'How much faster than simulated time these stamps go',
              'ppm', -1e4, 1e4),
    _at_reset('imu.drop_rate', 0.0, 'Share of the samples that are lost', '', 0.0, 0.99),
    _at_reset('imu.duplicate_rate', 0.0, 'Share of the other samples that are sent twice', '', 0.0,
              0.99),
    _at_reset('mag.field', (1.57e-6, 21.02e-6, -43.99e-6), 'Magnetic field in the world, east, '
              'north, up; default: WMM2025 in Munich, 2026', 'T', -1e3, 1e3),
    _at_reset('mag.soft_iron', IDENTITY, 'Soft iron, row by row: the field is multiplied by it',
              '', -1e6, 1e6),
    _at_reset('mag.hard_iron', (0.0, 0.0, 0.0), 'Hard iron, added to the field in the frame of '
              'the IMU', 'T', -1e3, 1e3),
    *(_at_reset(f'mag.{name}', 0.0, text, unit, 0.0, 1e3, smallest=1e-18)
      for name, text, unit in (
          ('noise_density', 'White noise of the magnetometer, 0 = none', 'T/sqrt(Hz)'),
          ('random_walk', 'Random walk of the bias of the magnetometer, 0 = none', 'T/s/sqrt(Hz)'),
          ('range', 'Largest reading of the magnetometer, 0 = unlimited', 'T'),
          ('resolution', 'Smallest step of the readings of the magnetometer, 0 = none', 'T'))),
    *(_at_reset(f'mag.disturbance.{frame}', 5 * (0.0,), f'Events, each of five numbers: begin and '
                f'end [s], and {text}, x, y, z [T]', '', -LONGEST, LONGEST, is_repeated=True)
      for frame, text in (('world', 'a field that is added to that of the world'),
                          ('body', 'the field of a magnet on the body, in its frame'))),
    _at_reset('gnss.origin', (48.14, 11.58, 520.0), 'Latitude and longitude [deg] and height '
              'above the ellipsoid of WGS-84 [m] of the origin of the world', '', -1e6, 1e6),
    _at_reset('gnss.position_noise', (0.0, 0.0), 'Standard deviation of the white noise of a fix, '
              'for each horizontal axis and for the vertical one', 'm', 0.0, 1e6, smallest=1e-12),
    _at_reset('gnss.velocity_noise', (0.0, 0.0), 'The same of gnss/velocity', 'm/s', 0.0, 1e6,
              smallest=1e-12),
    _at_reset('gnss.latency', 0.0, 'How long after its stamp a measurement is sent', 's', 0.0,
              1.0),
    _at_reset('gnss.outages', (0.0, 0.0), 'Begin and end of each time without reception, '
              'ascending; zeros: none', 's', 0.0, LONGEST, is_repeated=True),
    _at_reset('markers.trace_length', 4.0, 'How far back the trace of the tip goes, 0 = no trace',
              's', 0.0, 3600.0),
    _at_reset('markers.trace_points', 200, 'Points of the trace, evenly spaced in time', '', 1,
              10_000),
    _at_once('duration', 0.0, 'End after this much simulated time, 0 = never', 's', 0.0,
             LONGEST, smallest=1e-9),
    _at_start('record.enabled', False, 'Record from the start'),
    _at_recording('record.uri', '', 'File or folder of a recording; empty: '
                  'spinning_top_<date>_<time>.mcap here'),
    _at_recording('record.streams', ('all',), 'Which streams to record, by the names before '
                  '.enabled; all: each enabled one'),
    _at_recording('record.max_loss', 0.5, 'At most this much is lost by a power cut', 's', 0.01,
                  60.0),
    _at_recording('record.compression', 'zstd', 'Compression of the chunks',
                  choices=('zstd', 'lz4', 'none')),
    _at_recording('record.min_free_bytes', 100_000_000, 'Stop recording when the disk has less '
                  'free', 'bytes', 0, 2 ** 62),
    _at_once('step.count', 1, 'Steps of one ~/step', '', 1, 1_000_000),
    _at_once('step.dt', 0.01, 'Simulated time of one step', 's', 1e-6, 1e3),
    _at_once('status_period', 1.0, 'Period of the status line on the terminal, 0 = none', 's', 0.0,
             LONGEST, smallest=0.01),
)
BY_NAME: Mapping[str, Parameter] = {parameter.name: parameter for parameter in TABLE}


def checked(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return all parameters: these values, else defaults.  Raises ValueError for bad values."""
    result = {parameter.name: parameter.default for parameter in TABLE} | checked_changes(values)
    _check_together(result)
    for name, value, library in (('gnss.enabled', True, 'pymap3d'),
                                 ('solver.method', 'exact', 'gmpy2')):
        if result[name] == value and find_spec(library) is None:
            raise ValueError(f'{name} = {value}: needs {library}, which is not installed: '
                             f'{remedy(library)}')
    for describe in (top_of, start_state, pivot_path):      # they refuse what cannot be
        describe(result)
    return result


def checked_changes(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return these values, each checked alone.  Raises ValueError."""
    for name, value in values.items():
        if name not in BY_NAME and name not in REMOVED:
            raise ValueError(f'{name} = {shown(value)}: there is no such parameter')
    return {name: BY_NAME[name].check(value) for name, value in values.items()
            if name not in REMOVED}


def _check_together(values: Mapping[str, Any]) -> None:
    """Raise ValueError for values that are wrong only together."""
    def need(allowed: bool, name: str, text: str) -> None:
        value = values[name]
        if not allowed:
            raise ValueError(
                f'{name} = {list(value) if isinstance(value, tuple) else value!r}: {text}')

    above: list[str] = []
    for name in ('world_frame', 'body_frame', 'imu.frame_id'):
        frame = values[name]
        need(frame != '' and not frame.startswith('/'), name,
             'must be the name of a frame, without a slash at its begin')
        need(frame not in above, name, 'must be another frame than its parent')
        above.append(frame)
    names = [row[0] for row in STREAM_DEFAULTS]
    for name in values['record.streams']:
        need(name in ('all', *names), 'record.streams',
             f'{name!r} is no stream; must be all or some of {", ".join(names)}')
    need(_ascend(values['imu.bias_instability_band']), 'imu.bias_instability_band',
         'the second number must be larger than the first')
    is_mean = values['imu.sampling'] == 'mean'
    need(values['imu.rate'] >= LOWEST_RATE_OF_INTERVALS
         or not (is_mean or values['increments.enabled']), 'imu.rate',
         f'must be >= {LOWEST_RATE_OF_INTERVALS:g} with increments.enabled, or with '
         'imu.sampling = mean')
    need(not (is_mean and values['imu.bandwidth']), 'imu.bandwidth',
         'must be 0 with imu.sampling = mean, which is a low pass itself')
    for name in ('imu.vibration.force_psd', 'imu.vibration.rate_psd'):
        profile = values[name]
        is_profile = len(profile) >= 4 and all(profile) and _ascend(profile[::2])
        need(is_profile or not any(profile), name,
             'must be two or more ascending frequencies > 0, each with a density > 0')
    for name in ('mag.disturbance.world', 'mag.disturbance.body'):
        times = values[name]
        for begin, end in zip(times[::5], times[1::5], strict=True):
            need(begin <= end, name,
                 f'an event from {begin!r} to {end!r} s: must not end before it begins')
    latitude, longitude, _ = values['gnss.origin']
    need(abs(latitude) <= 90.0 and abs(longitude) <= 180.0, 'gnss.origin',
         'must be a latitude from -90 to 90, a longitude from -180 to 180, and a height')
    need(not any(values['gnss.outages']) or _ascend(values['gnss.outages']), 'gnss.outages',
         'must be begin and end of each, ascending')


def _ascend(numbers: Iterable[float]) -> bool:
    return all(one < next_one for one, next_one in pairwise(numbers))


def is_enabled(stream: str, values: Mapping[str, Any]) -> bool:
    """Return whether the streams with this prefix of their parameters are switched on."""
    other = OTHER_SWITCH.get(stream)
    return bool(values[f'{stream}.enabled'] or (other and values[other]))


def top_of(values: Mapping[str, Any]) -> Top:
    """Return the top that these parameters describe.  Raises ValueError like `Top`."""
    return Top(**{name: values[f'top.{name}']
                  for name in ('lambda1', 'lambda3', 'mass', 'com_distance', 'gravity')})


def pivot_path(values: Mapping[str, Any]) -> PivotPath | None:
    """Return the path of the pivot; None if it rests.  Raises ValueError."""
    path, points = (
        list(zip(*count * [iter(values[name])], strict=True)) if any(values[name]) else []
        for name, count in (('pivot.path', 4), ('pivot.waypoints', 3)))
    if path and points:
        raise ValueError(f'pivot.waypoints = {points!r}: must be zeros with pivot.path')
    for duration, *_ in path:
        if not duration >= SHORTEST_S:
            raise ValueError(f'pivot.path: the duration {duration!r} s: must be >= '
                             f'{SHORTEST_S:g} s')
    repeat = values['pivot.repeat']
    try:
        if path:
            return PivotPath([(round(duration * 1e9), a) for duration, *a in path], repeat=repeat)
        return PivotPath.through(points, speed=values['pivot.speed'], repeat=repeat,
                                 acceleration=values['pivot.acceleration']) if points else None
    except ValueError as error:
        raise ValueError(f'pivot.{"path" if path else "waypoints"}: {error}') from error


def start_state(values: Mapping[str, Any]) -> State:
    """Return the start state; an unset `spin.lz` is that of the cusp.  Raises like `State`."""
    theta, l3, lz = values['initial.theta'], values['spin.l3'], values['spin.lz']
    if lz is None:      # "Analysis of Symmetric Spinning Top" (2023), sect. 4.1 and eq. (33)
        lz = l3 * math.cos(theta)
    return State(theta=theta, theta_dot=values['initial.theta_dot'], phi=values['initial.phi'],
                 psi=values['initial.psi'], l3=l3, lz=lz)
