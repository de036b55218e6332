# SPDX-License-Identifier: Apache-2.0
"""
The motions of the exam, and what an IMU on them reads.

Each motion shows a fault that the others hide.  A seed decides the noise, and varies the start.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.magnetometer import Magnetometer
from spinning_top_sim.streams.play import Simulation

Reals = NDArray[np.float64]

# East, north, up [T]: the strength and dip of mid-latitudes.
FIELD = (0.0, 20e-6, -43e-6)
# Noise densities of a BMI088, without its turn-on bias: a calibrated device.  That of the
# accelerometer is the mean of its axes.  The magnetometer has 0.2 uT in 100 samples a second.
CALIBRATED: Mapping[str, Any] = {
    'imu.gyroscope_noise_density': 1.72779e-4, 'imu.accelerometer_noise_density': 1.21360e-3,
    'mag.noise_density': 2e-8}
# The parameters of an IMU that a scenario without noise keeps.
OF_PLACE = ('imu.lever_arm', 'imu.rpy', 'mag.field')
GRAVITY = 9.80665


@dataclass(frozen=True)
class Scenario:
    """One motion and the IMU on it."""

    name: str
    values: Mapping[str, Any]       # parameters of the simulation that differ from their defaults
    duration: float = 30.0          # [s]
    rate: float = 100.0             # [Hz]
    reversals: tuple[float, ...] = ()   # when an impulsive torque reverses the momenta [s]
    noisy: bool = True              # the IMU has its errors


# A wheel of 2 kg on a pivot 2 cm below its centre: 4 rad/s of spin, slow precession, and a
# nutation of many degrees.  The rates are so low that the way of integrating them matters little.
SLOW = Scenario('slow', {'top.com_distance': 0.02, 'spin.l3': 0.6, 'initial.theta': 0.7})
# 10 cm off the axis, where the centripetal acceleration of the slow wheel is a sixth of gravity.
LEVER_ARM = replace(SLOW, name='lever_arm', duration=20.0, noisy=False, values={
    **SLOW.values, 'imu.lever_arm': (0.1, 0.0, 0.0)})
PIVOT = replace(LEVER_ARM, name='pivot', values={
    **SLOW.values, 'imu.lever_arm': (0.0, 0.0, 0.0)})
# Fast steady precession.  The errors of a step are odd in the rates: where these change their
# sign, no estimate of a bias can hide them.
FAST = Scenario('fast', {'spin.l3': 1.6, 'spin.lz': 1.7816, 'initial.theta': 0.5236},
                duration=8.0, reversals=(2.0, 4.0, 6.0), noisy=False)


@dataclass(frozen=True)
class Run:
    """
    What an IMU reads along a motion, at n times.

    The gyroscope's reading is the mean over the step that ends, as of an integrating sensor; the
    other readings are of its end.
    """

    name: str               # of the motion
    t: Reals                # by the stamps (n,) [s]
    dt: Reals               # length of the step that ends there (n,) [s]
    truth: Reals            # q(world <- sensor) as x, y, z, w (n, 4)
    rates: Reals            # true angular velocity in the frame of the sensor (n, 3) [rad/s]
    gyroscope: Reals        # readings in the frame of the IMU (n, 3) [rad/s]
    accelerometer: Reals    # [m/s^2]
    magnetometer: Reals     # [T]

    def part(self, rows: slice | NDArray[np.int64]) -> 'Run':
        """Return the run at these times only."""
        return Run(self.name, *(getattr(self, one.name)[rows] for one in fields(self)[1:]))

    def merged(self, counts: Sequence[int]) -> 'Run':
        """Return the run in steps of so many samples, in turn; rates are means over the steps."""
        begins = np.cumsum([0, *np.resize(counts, len(self.t) // min(counts))])
        begins = begins[begins < len(self.t)]
        dt = np.add.reduceat(self.dt, begins)
        turns = np.add.reduceat(self.dt[:, np.newaxis] * self.gyroscope, begins)
        return replace(self.part(np.append(begins[1:], len(self.t)) - 1), dt=dt,
                       name=f'{self.name}, uneven', gyroscope=turns / dt[:, np.newaxis])

    @property
    def start(self) -> Rotation:
        """The attitude at the begin of the first step."""
        return Rotation.from_quat(self.truth[0]) * Rotation.from_rotvec(
            -self.gyroscope[0] * self.dt[0])

    def preceded_by(self, lead: 'Run') -> 'Run':
        """Return this run with another one before it, of the same name; `t` is that of each."""
        return Run(self.name, *(np.concatenate((getattr(lead, one.name), getattr(self, one.name)))
                                for one in fields(self)[1:]))


def turning(imu: Mapping[str, Any], first: Rotation, last: Rotation, seconds: float) -> Run:
    """
    Return a slow tumbling from one attitude to another as `along`.

    After each third of it, the sensor has gone a third of the way.
    """
    n = round(seconds * SLOW.rate)
    part = np.arange(n + 1) / n
    turns = (Slerp((0.0, 1.0), Rotation.concatenate((first, last)))(part)
             * Rotation.from_euler('zx', np.stack((
                 12.0 * np.pi * part, 0.7 * np.sin(6.0 * np.pi * part)), axis=1)))
    return along(turns, imu)


def along(turns: Rotation, imu: Mapping[str, Any]) -> Run:
    """
    Return the readings along attitudes q(world <- sensor), without noise and acceleration; t <= 0.

    The readings have the sampling rate of the slow motion.  The sensor turns steadily from each of
    the n + 1 attitudes to the next.
    """
    n, rate = len(turns) - 1, SLOW.rate
    t: Reals = np.arange(1 - n, 1) / rate
    rates = (turns[:-1].inv() * turns[1:]).as_rotvec() * rate
    to_sensor = turns[1:].inv()
    return Run('', t, np.full(n, 1.0 / rate), turns[1:].as_quat(), rates, rates.copy(),
               to_sensor.apply((0.0, 0.0, GRAVITY)),
               to_sensor.apply(magnetic(imu.get('mag.field', FIELD))))


def magnetic(field: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a field (east, north, up) in a world whose north is magnetic north."""
    east, north, up = field
    return 0.0, math.hypot(east, north), up


def record(scenario: Scenario, imu: Mapping[str, Any], seed: int) -> Run:
    """
    Simulate a scenario with these parameters of an IMU and its magnetometer.

    Raises ValueError for parameters that are not allowed.
    """
    random = np.random.default_rng(seed)
    phi, psi = random.uniform(-np.pi, np.pi, 2).tolist()
    given = imu if scenario.noisy else {name: imu[name] for name in OF_PLACE if name in imu}
    values = parameters.checked({
        'initial.phi': phi, 'initial.psi': psi, 'seed': seed, 'solver.method': 'exact',
        'mag.field': FIELD, **given, **scenario.values, 'imu.rate': scenario.rate})
    values['mag.field'] = magnetic(values['mag.field'])
    simulation = Simulation(values)
    device, period_ns = simulation.imu, simulation.imu.period_ns
    magnetometer = Magnetometer(values, period_ns)
    parts, begin_ns = [], 0
    for end in (*scenario.reversals, scenario.duration):
        end_ns = round(end * scenario.rate) * period_ns
        steps = np.arange(begin_ns + period_ns, end_ns + 1, period_ns)
        halves = simulation.trajectory.after(begin_ns).states(
            np.arange(begin_ns, end_ns + 1, period_ns // 2))
        # Three rows of rates, three of force, four of the quaternion.
        signals: Any = np.stack(np.broadcast_arrays(*itertools.chain(
            *device.mounting.felt(halves)), *device.mounting.orientation(halves)))
        ends = signals[:, 2::2]
        # Simpson's rule.
        mean = (signals[:3, :-2:2] + 4.0 * signals[:3, 1::2] + ends[:3]) / 6.0
        parts.append(np.stack([
            *itertools.chain(*device.read((mean, ends[3:6]), steps)),
            *magnetometer.read(magnetometer.true(ends[6:]), magnetometer.errors(steps)),
            *ends[6:], *ends[:3]]))
        simulation.now_ns = begin_ns = end_ns
        if end < scenario.duration:
            motion = simulation.trajectory
            simulation.apply('command', l3=-motion.l3, lz=-motion.lz)
    gyroscope, accelerometer, field, truth, rates = np.split(
        np.concatenate(parts, axis=1).T, (3, 6, 9, 13), axis=1)
    period = period_ns / NANOSECONDS
    t = period * np.arange(1.0, len(truth) + 1.0)
    return Run(f'{scenario.name} at {scenario.rate:g} Hz, seed {seed}', t,
               np.full(len(t), period), truth, rates, gyroscope, accelerometer, field)
