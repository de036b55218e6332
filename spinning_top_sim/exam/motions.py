# SPDX-License-Identifier: Apache-2.0
"""
The motions of the exam, and what an IMU on them reads.

A motion is a sequence of attitudes.  No attitude is degenerate to better than a degree: no axis of
the sensor is vertical, no heading is north, and no attitude is the identity.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top, solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.imu import Imu, Magnetometer

Reals = NDArray[np.float64]

GRAVITY = 9.80665
RATE = 100.0                    # samples a second, but for uneven steps
# Magnetic north and up [T]: the strength and dip of mid-latitudes.
FIELD = (0.0, 20e-6, -43e-6)
# Noise densities of a BMI088 without its turn-on bias; the magnetometer has 0.2 uT in 100 Hz.
CALIBRATED: Mapping[str, Any] = {
    'imu.gyroscope_noise_density': 1.72779e-4, 'imu.accelerometer_noise_density': 1.21360e-3,
    'mag.noise_density': 2e-8}
# Parameters of the sensor that noisy motions take, and that only the scenes take.
TAKEN = ('imu.gyroscope_', 'imu.accelerometer_', 'imu.bias_', 'mag.field', 'mag.soft_iron',
         'mag.hard_iron', 'mag.noise_density', 'mag.random_walk', 'mag.range', 'mag.resolution',
         'mag.enabled')
OF_SCENES = 'imu.bandwidth', 'imu.vibration.', 'mag.disturbance.'

# A wheel on a pivot 2 cm below its centre, which starts at a tilt of 0.7 rad: 4 rad/s of spin,
# slow precession and large nutation.
WHEEL = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.02, gravity=GRAVITY)
START = {'theta': 0.7, 'theta_dot': 0.0, 'l3': 0.6, 'lz': 0.6 * math.cos(0.7)}
TOP_S = 12.0            # some nutations
# Yaw, pitch and roll to start from [deg]; the first, with which motions begin, is near the
# identity, where many filters start, so that slow ones settle soon.
STARTS = (4.0, 3.0, -2.5), (60.0, -35.0, 20.0), (-110.0, 15.0, -50.0)
# Turns about an axis of the sensor [deg] at a rate [rad/s], each after a rest: those that any
# filter follows, two as fast as a hand turns, and one so slow that a threshold would drop it.
# Each axis of the sensor is near the vertical in some rests, upwards and downwards.
TURNS = (*(('turns', axis, angle, 2.6) for axis, angle in (
    (0, -115.0), (1, -85.0), (2, -70.0), (0, -85.0), (1, -115.0), (2, 100.0), (0, -100.0),
    (1, -110.0), (2, -90.0))), ('fast turns', 0, 220.0, 12.0), ('fast turns', 1, -200.0, 12.0),
    ('slow turns', 1, 60.0, 0.15))
REST_S = 2.5                    # time for answers, and for gravity to lead a tilt back
STEPS = 0.0025, 0.005, 0.0125, 0.015    # uneven ones [s]
NEVER_ZERO = 1e-6       # [rad/s]; some filters take no step while the rates are zero


@dataclass(frozen=True)
class Run:
    """What an IMU reads along a motion, at the ends of n steps; `name` is that of the motion."""

    name: str
    dt: Reals               # length of the step (n,) [s]
    truth: Reals            # q(world <- sensor) as x, y, z, w (n, 4)
    gyroscope: Reals        # rotation of the step over its length (n, 3) [rad/s]
    accelerometer: Reals    # (n, 3) [m/s^2]
    magnetometer: Reals     # (n, 3) [T], NaN: there is none

    def part(self, rows: slice | NDArray[np.intp]) -> 'Run':
        """Return the run at these times only."""
        return Run(self.name, *(getattr(self, one.name)[rows] for one in fields(self)[1:]))

    def without_field(self) -> 'Run':
        """Return the run without a magnetometer."""
        return replace(self, magnetometer=np.full_like(self.magnetometer, np.nan))


# A run, and the samples of it whose errors count.
Scored = tuple[Run, NDArray[np.intp]]


class Motion:
    """A motion that is put together from rests and turns, from an attitude [deg] on."""

    def __init__(self, start: Sequence[float]) -> None:
        # Of each sample: 'start', 'rests', 'turns', 'fast turns', 'slow turns' or 'top'.
        self._attitudes = [Rotation.from_euler('ZYX', [start], degrees=True)]
        self.kinds: list[str] = []

    def add(self, kind: str, attitudes: Rotation) -> 'Motion':
        """Add attitudes at the ends of steps."""
        self.kinds += [kind] * len(attitudes)
        self._attitudes.append(attitudes)
        return self

    def rest(self, seconds: float, kind: str = 'rests') -> 'Motion':
        """Add a rest."""
        return self.add(kind, self._attitudes[-1][[-1] * round(seconds * RATE)])

    def turn(self, vector: Sequence[float] | Reals, rate: float = 2.6,
             kind: str = 'turns') -> 'Motion':
        """Add a turn by a rotation vector about axes of the sensor [rad]."""
        n = max(2, math.ceil(float(np.linalg.norm(vector)) / rate * RATE))
        return self.add(kind, self._attitudes[-1][-1] * Rotation.from_rotvec(
            np.arange(1.0, n + 1.0)[:, np.newaxis] / n * vector))

    def top(self, seconds: float, seed: int = 0) -> 'Motion':
        """Add a turn to the start of the wheel's motion, and the motion; `seed` varies it."""
        phi, psi = np.random.default_rng(seed).uniform(-math.pi, math.pi, 2).tolist()
        t = np.arange(1.0, round(seconds * RATE) + 1.0) / RATE
        turns = Rotation.from_quat(solve(WHEEL, State(**START, phi=phi, psi=psi), t,
                                         method='exact').quaternion)
        return self.turn((self._attitudes[-1][-1].inv() * turns[0]).as_rotvec()).add('top', turns)

    def run(self, name: str) -> Run:
        """Return what a perfect IMU reads, which turns steadily in a step."""
        attitudes = Rotation.concatenate(self._attitudes)
        rates = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() * RATE
        to_sensor = attitudes[1:].inv()
        return Run(name, np.full(len(rates), 1.0 / RATE), attitudes[1:].as_quat(),
                   rates + NEVER_ZERO, to_sensor.apply((0.0, 0.0, GRAVITY)),
                   to_sensor.apply(FIELD))


def excitation(lead_s: float) -> Motion:
    """Return turns about each axis between rests, and the motion of a top."""
    motion = Motion(STARTS[0]).rest(lead_s, 'start')
    for kind, axis, angle, rate in TURNS:
        motion.rest(REST_S).turn(np.radians(angle) * np.eye(3)[axis], rate, kind)
    return motion.rest(REST_S).top(TOP_S).rest(REST_S)


def noisy(name: str, imu: Mapping[str, Any], seed: int, lead_s: float, seconds: float) -> Run:
    """
    Return a rest and the motion of a top, as an IMU with these parameters reads them.

    Raises ValueError for parameters that are not allowed.
    """
    run = Motion(STARTS[0]).rest(lead_s).top(seconds, seed).run(name)
    values = dict(parameters.checked({'mag.field': FIELD, **imu, 'seed': seed}))
    east, north, up = values['mag.field']       # north is magnetic north
    values['mag.field'] = 0.0, math.hypot(east, north), up
    period_ns = round(1e9 / RATE)
    rates, force, field = readings(
        values, period_ns, run.gyroscope, run.accelerometer, Rotation.from_quat(run.truth),
        period_ns * np.arange(1, len(run.dt) + 1))
    return replace(run, gyroscope=rates, accelerometer=force, magnetometer=field)


def readings(values: Mapping[str, Any], period_ns: int, rates: Reals, force: Reals,
             turns: Rotation, field_ns: NDArray[np.int64]) -> list[Reals]:
    """
    Return what gyroscope, accelerometer and magnetometer read at the ends of steps, (n, 3) each.

    turns, field_ns : attitudes and times of the field that is read (n,)
    """
    times = period_ns * np.arange(1, len(rates) + 1)
    true: Any = tuple(rates.T), tuple(force.T)
    x, y, z, w = turns.as_quat().T
    device, magnetometer = Imu(values, period_ns), Magnetometer(values, period_ns)
    field = magnetometer.read(magnetometer.disturbed((x, y, z, w), field_ns),
                              magnetometer.errors(times))
    return [np.stack(np.broadcast_arrays(*columns), axis=1) for columns in (
        *device.read(true, device.errors(times)), field)]
