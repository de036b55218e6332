#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Compare attitude filters, fed from `imu/data_raw`, with the true `pose`, live or
from a log:

  python examples/attitude_filter.py run.mcap --filter vqf madgwick ekf
  python examples/attitude_filter.py --duration 60 --ros-args -r __ns:=/top

Needs `pip install 'spinning_top_sim[examples]'`.  Frames: x, y, z right-handed,
z of the world up (REP-103); a resting accelerometer reads +g upwards (REP-145);
attitudes are q(world <- IMU).  The pose is the body's, so the mounting of the
IMU (`imu.rpy`) must be known: a log has it, live it is --rpy.  An IMU without a
magnetometer knows no heading: tilt is compared as it is, heading from the end
of --settle on.  `vqf9` takes `imu/mag` too (mag.enabled:=true); its heading is
relative to the horizontal part of the magnetic field: a log has its direction,
live it is --declination.  The exit code is 1 where nothing could be compared.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.nodes import executable

NANOSECONDS = 1_000_000_000
IMU_TOPIC, MAG_TOPIC, POSE_TOPIC = 'imu/data_raw', 'imu/mag', 'pose'
# The filters that use the magnetometer.
NINE_AXES = {'vqf9'}
# The period is the smallest of so many first distances, so that a lost message does not decide it.
LEARNED_FROM = 10
# Over this much of lost samples nothing can be said of the motion: the filter starts anew.
LONGEST_GAP_NS = NANOSECONDS // 10
# What has not met its partner by then never will.
KEPT_NS = 5 * NANOSECONDS
CONVERGED_DEG = 1.0
REPORT_NS = 2 * NANOSECONDS

# One step of a filter: mean rates [rad/s] over the step and specific force [m/s^2] at its end, in
# the frame of the IMU; returns q(world <- IMU) as w, x, y, z.
Step = Callable[[np.ndarray, np.ndarray], Sequence[float]]


# ----------------------------------------------------------------------------------- the filters

def vqf(period: float) -> Step:
    """
    VQF without a magnetometer (D. Laidig, T. Seel, Information Fusion 91 (2023) 187-204).

    Rates are integrated in closed form; what corrects the tilt is the specific force averaged over
    seconds in a frame that does not turn.
    """
    from vqf import VQF

    filter_ = VQF(period)

    def step(rates: np.ndarray, force: np.ndarray) -> Sequence[float]:
        filter_.update(rates, force)
        return filter_.getQuat6D()
    return step


class vqf9:      # noqa: N801 - its name on the command line
    """
    VQF with a magnetometer.

    The magnetometer corrects the heading within 9 s, in which errors of the integrated rates add
    up.  With `third_order` the rotation of a step is right to third order: the curvature is
    taken from the mean of both ends, and the coning term is added (P. Savage, "Strapdown inertial
    navigation integration algorithm design part 1", J. Guid. Control Dyn. 21 (1998) 19).
    """

    def __init__(self, period: float, mag_period: float, third_order: bool = True) -> None:
        from vqf import VQF

        self._filter, self._period = VQF(period, magTs=mag_period), period
        self._third_order = third_order
        self._means: list[np.ndarray] = []

    def __call__(self, rates: np.ndarray, force: np.ndarray) -> Sequence[float]:
        a, b, c = self._means = [*(self._means or 2 * [rates]), rates][-3:]
        if self._third_order:
            change = 1.5 * (c - b) - 0.5 * (b - a)
            rates = (c - (c - 2.0 * b + a) / 12.0
                     + self._period / 12.0 * np.cross(c, change))
        self._filter.update(rates, force)
        return self._filter.getQuat9D()

    def mag(self, field: np.ndarray) -> None:
        """Take a magnetic field [T] that has the stamp of the last step."""
        self._filter.updateMag(field)


def madgwick(period: float, gain: float = 0.033) -> Step:
    """
    Madgwick's filter (S. Madgwick et al., ICORR 2011); gain [rad/s], as in the paper.

    A first-order step; each sample of the specific force is taken for gravity.
    """
    from ahrs.filters import Madgwick

    return _from_rest(Madgwick(Dt=period, gain=gain).updateIMU)


def ekf(period: float) -> Step:
    """
    The extended Kalman filter of `ahrs` with its default noises (A. Sabatini, Sensors 11 (2011)).

    A first-order step; each sample of the specific force is taken for gravity.
    """
    from ahrs.filters import EKF

    return _from_rest(EKF(Dt=period).update)


def _from_rest(update: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> Step:
    """Return the steps of a filter that is given its attitude, from the identity on."""
    attitude = np.array((1.0, 0.0, 0.0, 0.0))

    def step(rates: np.ndarray, force: np.ndarray) -> Sequence[float]:
        nonlocal attitude
        attitude = update(attitude, rates, force)
        return attitude
    return step


FILTERS: dict[str, Callable[..., Step]] = {
    'vqf': vqf, 'vqf9': vqf9, 'madgwick': madgwick, 'ekf': ekf}


# -------------------------------------------------------------------------------- the comparison

class Error(NamedTuple):
    """Of an attitude: stamp [ns]; angle between the verticals, turn about the vertical [rad]."""

    stamp_ns: int
    tilt: float
    heading: float


def product(one: Sequence[float], other: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the Hamilton product of quaternions x, y, z, w: of two, faster than `Rotation`."""
    (a, b, c, d), (x, y, z, w) = one, other
    return (d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z)


def error_of(estimate: Sequence[float], truth: Sequence[float]) -> tuple[float, float]:
    """Return tilt and heading of an estimate relative to the truth, in the world frame [rad]."""
    a, b, c, d = truth
    x, y, z, w = product(estimate, (-a, -b, -c, d))
    return 2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w)), 2.0 * math.atan2(z, w)


class Comparison:
    """
    One filter, fed with samples of the IMU and compared with poses of the same stamps.

    name : one of FILTERS
    rpy : mounting of the IMU in the body: roll, pitch and yaw as in URDF [rad]
    declination : of the magnetic field, from north towards east [rad]
    errors : so far
    lost : samples that never came, bridged by a straight line
    restarts : of the filter, after gaps too long for that or stamps that went back
    """

    def __init__(self, name: str, rpy: Sequence[float] = (0.0, 0.0, 0.0),
                 declination: float = 0.0) -> None:
        self.name = name
        self.has_mag = name in NINE_AXES
        # The world, from a frame whose y axis is magnetic north.
        self._north = Rotation.from_euler(
            'z', -declination if self.has_mag else 0.0).as_quat().tolist()
        self._mag_stamps: list[int] = []
        # The newest field: it may come before or after the sample of the IMU.
        self._field: tuple[int, np.ndarray] = -1, np.zeros(3)
        self.errors: list[Error] = []
        self.lost = self.restarts = 0
        self._mounting = Rotation.from_euler('xyz', rpy).as_quat().tolist()
        self._first: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._period_ns = 0
        self._step: Step
        self._last: tuple[int, np.ndarray, np.ndarray]
        self._estimates: dict[int, Sequence[float]] = {}        # w, x, y, z
        self._truths: dict[int, Sequence[float]] = {}
        self._missing = [IMU_TOPIC, *([MAG_TOPIC] if self.has_mag else []), POSE_TOPIC]

    def imu(self, stamp_ns: int, rates: Sequence[float], force: Sequence[float]) -> None:
        """Take a sample: rates [rad/s] and specific force [m/s^2]."""
        self._came(IMU_TOPIC)
        sample = stamp_ns, np.array(rates, dtype=float), np.array(force, dtype=float)
        if self._period_ns:
            self._advance(sample)
            return
        self._first.append(sample)
        if self.has_mag and len(self._mag_stamps) < 2:      # its period is not known yet
            del self._first[:-LEARNED_FROM]
        elif len(self._first) > LEARNED_FROM:
            self._period_ns = min(abs(b[0] - a[0])
                                  for a, b in itertools.pairwise(self._first)) or 1
            self._start(self._first[0])
            for one in self._first[1:]:
                self._advance(one)

    def mag(self, stamp_ns: int, field: Sequence[float]) -> None:
        """Take a magnetic field [T]; it counts where a sample of the IMU has the same stamp."""
        self._came(MAG_TOPIC)
        if not self.has_mag:
            return
        if not self._period_ns:
            self._mag_stamps.append(stamp_ns)
        else:
            self._field = stamp_ns, np.array(field, dtype=float)
            self._take_field()

    def _take_field(self) -> None:
        stamp_ns, field = self._field
        if stamp_ns == self._last[0] and isinstance(self._step, vqf9):
            self._step.mag(field)

    def pose(self, stamp_ns: int, attitude: Sequence[float]) -> None:
        """Take the body's true attitude, x, y, z, w."""
        self._came(POSE_TOPIC)
        self._truths[stamp_ns] = attitude
        self._match(stamp_ns)

    def _came(self, topic: str) -> None:
        if topic in self._missing:
            self._missing.remove(topic)

    def _start(self, sample: tuple[int, np.ndarray, np.ndarray]) -> None:
        periods = [self._period_ns / NANOSECONDS]
        if self.has_mag:
            periods.append(min(abs(b - a) for a, b in itertools.pairwise(self._mag_stamps))
                           / NANOSECONDS)
        self._step = FILTERS[self.name](*periods)
        self._last = sample

    def _advance(self, sample: tuple[int, np.ndarray, np.ndarray]) -> None:
        stamp_ns, rates, force = sample
        last_ns, last_rates, last_force = self._last
        gap_ns = stamp_ns - last_ns
        if not 0 < gap_ns <= max(LONGEST_GAP_NS, 2 * self._period_ns):
            self.restarts += 1
            self._start(sample)
            return
        steps = max(1, round(gap_ns / self._period_ns))
        self.lost += steps - 1
        for k in range(steps):
            # A filter takes the rates for constant over its step; the samples are instants, and
            # the top turns by 3 degrees from one to the next.
            middle = (k + 0.5) / steps
            estimate = self._step(last_rates + middle * (rates - last_rates),
                                  last_force + (k + 1) / steps * (force - last_force))
        self._last = sample
        self._take_field()
        self._estimates[stamp_ns] = estimate
        self._match(stamp_ns)

    def _match(self, stamp_ns: int) -> None:
        if stamp_ns in self._estimates and stamp_ns in self._truths:
            w, x, y, z = self._estimates.pop(stamp_ns)
            self.errors.append(Error(stamp_ns, *error_of(
                product(self._north, (x, y, z, w)),
                product(self._truths.pop(stamp_ns), self._mounting))))
        for waiting in (self._estimates, self._truths):
            while waiting and (oldest := next(iter(waiting))) < stamp_ns - KEPT_NS:
                del waiting[oldest]

    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return t [s] from the first error on, tilt and continuous heading [deg], (n,) each."""
        stamps, tilt, heading = zip(*sorted(self.errors), strict=True)
        t = (np.array(stamps) - stamps[0]) / NANOSECONDS
        return t, np.degrees(tilt), np.degrees(np.unwrap(heading))

    def summary(self, settle: float) -> Summary:
        """Return the errors after `settle` seconds.  Raises ValueError where there are none."""
        if self._missing:
            raise ValueError(f'{self.name}: no message of {" and ".join(self._missing)} has come')
        if not self.errors:
            raise ValueError(f'{self.name}: no sample of {IMU_TOPIC} had the stamp of a '
                             f'{POSE_TOPIC}')
        t, tilt, heading = self.columns()
        if t[-1] <= settle:
            raise ValueError(f'{self.name}: {t[-1]:g} s are compared; --settle {settle:g} must be '
                             'less')
        above = np.flatnonzero(tilt > CONVERGED_DEG)
        end = 0 if not len(above) else above[-1] + 1
        later = t > settle
        drift = heading[later] - heading[later][0]
        return Summary(
            name=self.name, compared=len(t), seconds=float(t[-1]),
            converged=float(t[end]) if end < len(t) else math.inf,
            tilt_rms=float(np.sqrt(np.mean(tilt[later] ** 2))), tilt_max=float(tilt[later].max()),
            heading_rate=float(drift[-1] / (t[-1] - t[later][0] or 1.0)),
            heading_max=(float(np.abs((heading[later] + 180.0) % 360.0 - 180.0).max())
                         if self.has_mag else math.nan),
            lost=self.lost, restarts=self.restarts)


class Summary(NamedTuple):
    """
    How a filter did after it has settled, angles in degrees.

    converged : when the tilt has fallen below CONVERGED_DEG for good [s], inf: never
    heading_rate : drift of the heading [deg/s]
    heading_max : largest error of the heading; NaN where the filter has no magnetometer
    """

    name: str
    compared: int
    seconds: float
    converged: float
    tilt_rms: float
    tilt_max: float
    heading_rate: float
    heading_max: float
    lost: int
    restarts: int

    def __str__(self) -> str:
        converged = (f'tilt below {CONVERGED_DEG:g} deg from {self.converged:.2f} s on'
                     if math.isfinite(self.converged) else
                     f'tilt not below {CONVERGED_DEG:g} deg for good')
        holes = f'; {self.lost} samples lost, {self.restarts} restarts' * bool(
            self.lost or self.restarts)
        heading = (f'error {self.heading_max:.3g} deg max' if math.isfinite(self.heading_max)
                   else f'drift {self.heading_rate:+.3g} deg/s')
        return (f'{self.name}: {converged}; after settling tilt error {self.tilt_rms:.3g} deg '
                f'rms, {self.tilt_max:.3g} deg max, heading {heading} '
                f'({self.compared} poses in {self.seconds:.2f} s{holes})')


# -------------------------------------------------------------------------------------- from a log

def compare(path: Path, names: Sequence[str], namespace: str = '/',
            rpy: Sequence[float] | None = None,
            declination: float | None = None) -> list[Comparison]:
    """
    Run filters through a log.

    rpy, declination : mounting of the IMU and of the field [rad], None: what the log says

    Raises ValueError for a log without these topics, and LogError for what is no log.
    """
    from rosbags.typesys import Stores, get_typestore

    from spinning_top_sim.recording.reader import LogReader
    from spinning_top_sim.streams.topics import resolve_topic

    typestore = get_typestore(Stores.ROS2_JAZZY)
    topics = [resolve_topic(topic, namespace) for topic in _topics(names)]
    with LogReader(path) as reader:
        there = {topic.name: topic.type_name for topic in reader.topics}
        for topic in topics:
            if topic not in there:
                raise ValueError(f'{path} has no topic {topic}; it has {", ".join(there)} '
                                 '(--namespace)')
        provenance = reader.metadata.get('spinning_top_sim', {})
        used = json.loads(provenance.get('parameters', '{}'))
        if rpy is None:
            rpy = used.get('imu.rpy', (0.0, 0.0, 0.0))
        if declination is None:
            east, north, _ = used.get('mag.field', (0.0, 1.0, 0.0))
            declination = math.atan2(east, north)
        comparisons = [Comparison(name, rpy, declination) for name in names]
        for message in reader.messages(topics):
            decoded = typestore.deserialize_cdr(message.data, there[message.topic])
            for comparison in comparisons:
                take(comparison, decoded)
    return comparisons


def _topics(names: Sequence[str]) -> list[str]:
    """Return the topics that these filters and the comparison need."""
    return [IMU_TOPIC, *([MAG_TOPIC] if NINE_AXES.intersection(names) else []), POSE_TOPIC]


def take(comparison: Comparison, message: Any) -> None:
    """Hand over an Imu, MagneticField or PoseStamped of rclpy or rosbags."""
    stamp = message.header.stamp
    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
    if hasattr(message, 'angular_velocity'):
        rates, force = message.angular_velocity, message.linear_acceleration
        comparison.imu(stamp_ns, (rates.x, rates.y, rates.z), (force.x, force.y, force.z))
    elif hasattr(message, 'magnetic_field'):
        field = message.magnetic_field
        comparison.mag(stamp_ns, (field.x, field.y, field.z))
    else:
        q = message.pose.orientation
        comparison.pose(stamp_ns, (q.x, q.y, q.z, q.w))


def draw(panels: Sequence[Any], comparison: Comparison, settle: float, **style: Any) -> None:
    """Draw the tilt error, and if there is a second panel the drift of the heading."""
    t, tilt, heading = comparison.columns()
    panels[0].semilogy(t, np.maximum(tilt, 1e-6), label=comparison.name, **style)
    panels[0].set_ylabel('tilt error [deg]')
    if len(panels) > 1:
        panels[1].plot(t, heading - heading[np.searchsorted(t, settle)], **style)
        panels[1].set_ylabel('heading error, 0 when settled [deg]')
    panels[-1].set_xlabel('t [s]')


def plot(path: Path, comparisons: Sequence[Comparison], settle: float) -> None:
    """Write a picture of the errors over time."""
    import matplotlib as mpl
    mpl.use('Agg')
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 1, figsize=(9.0, 6.0), sharex=True)
    for comparison in comparisons:
        draw(panels, comparison, settle, linewidth=1.0)
    for panel in panels:
        panel.grid(color='#DDDDDD', linewidth=0.6)
        panel.axvline(settle, color='#888888', linestyle=':', linewidth=1.0)
    panels[0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


# -------------------------------------------------------------------------------------------- live

def make_node(comparisons: Sequence[Comparison], duration: float) -> Any:
    """Return a node that feeds filters; `finished` completes after this much of stamps [s]."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.task import Future
    from sensor_msgs.msg import Imu, MagneticField

    kinds = {IMU_TOPIC: Imu, MAG_TOPIC: MagneticField, POSE_TOPIC: PoseStamped}
    topics = _topics([comparison.name for comparison in comparisons])

    class AttitudeFilter(Node):
        """Filters `imu/data_raw`, compares with `pose`, says every two seconds how well."""

        def __init__(self) -> None:
            super().__init__('attitude_filter')
            self.finished: Future = Future()
            self._reported_ns = 0
            # Deep: a sample lost is lost for the filter.
            profile = QoSProfile(depth=1000)
            for topic in topics:
                self.create_subscription(kinds[topic], topic, self._take, profile)

        def start(self) -> None:
            self.get_logger().info(
                f'waiting for {" and ".join(map(self.resolve_topic_name, topics))}')

        def _take(self, message: Any) -> None:
            if self.finished.done():
                return
            for comparison in comparisons:
                take(comparison, message)
            errors = comparisons[0].errors
            if not errors:
                return
            first_ns, last_ns = errors[0].stamp_ns, errors[-1].stamp_ns
            if last_ns - self._reported_ns >= REPORT_NS:
                self._reported_ns = last_ns
                for comparison in filter(lambda one: one.errors, comparisons):
                    self.get_logger().info(
                        f'{comparison.name} at {(last_ns - first_ns) / NANOSECONDS:.2f} s: tilt '
                        f'error {math.degrees(comparison.errors[-1].tilt):.3g} deg')
            if duration and last_ns - first_ns >= duration * NANOSECONDS:
                self.finished.set_result(0)

        def stop(self) -> None:
            """Hold nothing that must be closed."""

    return AttitudeFilter()


# ---------------------------------------------------------------------------------------- commands

def report(comparisons: Sequence[Comparison], arguments: argparse.Namespace) -> bool:
    """Print a line for each filter, draw if asked; return whether there was anything to say."""
    try:
        for comparison in comparisons:
            print(comparison.summary(arguments.settle), flush=True)
    except ValueError as error:
        print(f'attitude_filter: {error}', file=sys.stderr, flush=True)
        return False
    if arguments.plot:
        plot(arguments.plot, comparisons, arguments.settle)
        print(f'wrote {arguments.plot}', flush=True)
    return True


def main(argv: list[str] | None = None) -> int:
    """Compare; return 0, 1 where nothing could be compared, 2 for what could not be started."""
    argv = sys.argv if argv is None else argv
    own = argv[1:argv.index('--ros-args')] if '--ros-args' in argv else argv[1:]
    parser = _parser()
    arguments = parser.parse_args(own)
    if arguments.log is None and 0.0 < arguments.duration <= arguments.settle:
        parser.error(f'--duration {arguments.duration:g} must be more than --settle '
                     f'{arguments.settle:g}: errors count from then on')
    if arguments.log is None:
        comparisons = [Comparison(name, arguments.rpy or (0.0, 0.0, 0.0),
                                  arguments.declination or 0.0)
                       for name in arguments.filter]
        code = executable.run_node('attitude_filter', argv, lambda argv: (
            argv, lambda: make_node(comparisons, arguments.duration)))
        return code or (0 if report(comparisons, arguments) else 1)
    from spinning_top_sim.recording.errors import LogError
    try:
        comparisons = compare(arguments.log, arguments.filter, arguments.namespace, arguments.rpy,
                              arguments.declination)
    except (ValueError, LogError) as error:
        print(f'attitude_filter: {error}', file=sys.stderr)
        return 1
    return 0 if report(comparisons, arguments) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='attitude_filter', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('log', type=Path, nargs='?', metavar='LOG',
                        help='a log (.mcap); without it a node listens')
    parser.add_argument('--filter', nargs='+', choices=FILTERS, default=['vqf'], metavar='NAME',
                        help=f'of {", ".join(FILTERS)}; default vqf')
    parser.add_argument('--rpy', type=float, nargs=3, metavar=('R', 'P', 'Y'),
                        help='mounting of the IMU [rad]; default: as in the log, live 0 0 0')
    parser.add_argument('--declination', type=float, metavar='D',
                        help='of the magnetic field, towards east [rad]; default: as in the log, '
                             'live 0')
    parser.add_argument('--settle', type=_not_negative, default=15.0, metavar='S',
                        help='errors count from then on [s], default %(default)g')
    parser.add_argument('--plot', type=Path, metavar='PNG', help='draw the errors over time')
    parser.add_argument('--namespace', default='/', help='of the topics in the log')
    parser.add_argument('--duration', type=_not_negative, default=0.0, metavar='S',
                        help='live: end after this much of compared stamps, 0 = never')
    return parser


def _not_negative(text: str) -> float:
    with contextlib.suppress(ValueError):
        if 0.0 <= float(text) < math.inf:
            return float(text)
    raise argparse.ArgumentTypeError(f'{text}: must be a finite number >= 0')


if __name__ == '__main__':
    sys.exit(main())
