# SPDX-License-Identifier: Apache-2.0
"""
The motions of the exam, and what an IMU on them reads.

A motion is a sequence of attitudes.  No attitude is degenerate to better than a degree: no axis of
the sensor is vertical, no heading is north, and no attitude is the identity.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

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
# Yaw, pitch and roll [deg]: near the identity, where many filters start, so that slow ones settle
# soon; and with another axis of the sensor level.
NEAR, X_UP = (4.0, 3.0, -2.5), (20.0, -80.0, 10.0)
TURN_RATE = 2.6         # [rad/s]: a turn of the sensor that every filter follows
# Turns about an axis of the sensor [deg] at a rate [rad/s], each followed by a rest: those that
# any filter sees, two as fast as a hand turns, and one so slow that a threshold would drop it.
TURNS = (*(('turn', axis, angle, TURN_RATE) for axis, angle in (
    (0, 80.0), (1, -70.0), (2, 100.0), (0, -110.0), (1, 85.0), (2, -75.0), (0, 95.0), (1, 110.0),
    (2, -120.0))), ('fast', 0, 220.0, 12.0), ('fast', 1, -200.0, 12.0), ('slow', 1, 60.0, 0.15))
RIPPLE = 0.3            # of the slow turn: some filters take a steady one for their bias
REST_S, TOP_S = 2.5, 12.0       # a time constant of fast filters; some nutations
STILL = math.radians(0.05)      # an attitude that moves by less is at rest [rad]
ROUNDING = float(np.finfo(np.float32).eps)      # of filters in single precision, relative
NEVER_ZERO = 1e-6       # [rad/s]; some filters take no step while the rates are zero
STEPS = 0.0025, 0.005, 0.015, 0.0025, 0.0125, 0.005, 0.0025, 0.0075     # uneven ones [s]


@dataclass(frozen=True)
class Run:
    """What an IMU reads along a motion, at the ends of n steps; `name` is that of the motion."""

    name: str
    dt: Reals               # length of the step (n,) [s]
    truth: Reals            # q(world <- sensor) as x, y, z, w (n, 4)
    gyroscope: Reals        # rotation of the step over its length (n, 3) [rad/s]
    accelerometer: Reals    # (n, 3) [m/s^2]
    magnetometer: Reals     # (n, 3) [T], NaN: there is none

    @property
    def t(self) -> Reals:
        """Times since the begin of the first step (n,) [s]."""
        return np.cumsum(self.dt)

    def part(self, rows: slice | NDArray[np.intp]) -> 'Run':
        """Return the run at these times only."""
        return Run(self.name, *(getattr(self, one.name)[rows] for one in fields(self)[1:]))

    def without_field(self) -> 'Run':
        """Return the run without a magnetometer."""
        return replace(self, magnetometer=np.full_like(self.magnetometer, np.nan))


class Part(NamedTuple):
    """Samples of a motion: 'rest', 'turn', 'fast', 'slow' or 'top'."""

    kind: str
    begin: int
    end: int


class Motion:
    """A motion that is put together from rests and turns, sampled at RATE."""

    def __init__(self, start: Rotation) -> None:
        self._attitudes: list[Any] = [start.as_quat()[np.newaxis]]
        self.parts: list[Part] = []

    def of(self, kind: str) -> list[Part]:
        """Return the parts of a kind."""
        return [part for part in self.parts if part.kind == kind]

    def _add(self, kind: str, attitudes: Rotation) -> 'Motion':
        begin = self.parts[-1].end if self.parts else 0
        self.parts.append(Part(kind, begin, begin + len(attitudes)))
        self._attitudes.append(attitudes.as_quat())
        return self

    @property
    def _now(self) -> Rotation:
        return Rotation.from_quat(self._attitudes[-1][-1])

    def rest(self, seconds: float) -> 'Motion':
        """Add a rest."""
        n = round(seconds * RATE)
        return self._add('rest', Rotation.from_quat(np.tile(self._now.as_quat(), (n, 1))))

    def turn(self, goal: Rotation | tuple[int, float], rate: float = TURN_RATE,
             kind: str = 'turn') -> 'Motion':
        """Add a turn to an attitude, or about an axis of the sensor by an angle [deg]."""
        vector = (self._now.inv() * goal).as_rotvec() if isinstance(goal, Rotation) else (
            math.radians(goal[1]) * np.eye(3)[goal[0]])
        n = max(2, math.ceil(float(np.linalg.norm(vector)) / rate * RATE))
        share = np.arange(1.0, n + 1.0)
        share[:-1:2] += RIPPLE * (kind == 'slow')
        return self._add(kind, self._now * Rotation.from_rotvec(
            share[:, np.newaxis] / n * vector))

    def top(self, seconds: float, seed: int = 0) -> 'Motion':
        """Add a turn to the start of the wheel's motion, and the motion; `seed` varies it."""
        phi, psi = np.random.default_rng(seed).uniform(-math.pi, math.pi, 2).tolist()
        t = np.arange(1.0, round(seconds * RATE) + 1.0) / RATE
        turns = Rotation.from_quat(solve(WHEEL, State(**START, phi=phi, psi=psi), t,
                                         method='exact').quaternion)
        return self.turn(turns[0])._add('top', turns)

    def run(self, name: str) -> Run:
        """Return what a perfect IMU reads."""
        attitudes = Rotation.from_quat(np.concatenate(self._attitudes))
        return perfect(name, attitudes, np.full(self.parts[-1].end, 1.0 / RATE))


def euler(angles: Sequence[float]) -> Rotation:
    """Return the attitude of yaw, pitch and roll [deg]."""
    return Rotation.from_euler('ZYX', angles, degrees=True)


def perfect(name: str, attitudes: Rotation, dt: Reals) -> Run:
    """Return the readings along attitudes (n + 1), between which the sensor turns steadily."""
    rates = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() / dt[:, np.newaxis]
    to_sensor = attitudes[1:].inv()
    return Run(name, dt, attitudes[1:].as_quat(), rates + NEVER_ZERO,
               to_sensor.apply((0.0, 0.0, GRAVITY)), to_sensor.apply(FIELD))


def excitation(lead_s: float) -> Motion:
    """Return turns about each axis between rests, and the motion of a top."""
    motion = Motion(euler(NEAR)).rest(lead_s)
    for kind, axis, angle, rate in TURNS:
        motion.rest(REST_S).turn((axis, angle), rate, kind)
    return motion.top(TOP_S).rest(REST_S)


def attitudes(lead_s: float) -> Motion:
    """Return a rest, and short rests in many attitudes."""
    motion = Motion(euler(NEAR)).rest(lead_s)
    for turn in Rotation.random(6, random_state=4):
        motion.turn(turn).rest(4.0)
    return motion


def uneven(count: int) -> Run:
    """Return a rest in so many steps of different lengths."""
    turns = Rotation.from_quat(np.tile(euler(NEAR).as_quat(), (count + 1, 1)))
    return perfect('uneven steps', turns, np.resize(STEPS, count))


def noisy(name: str, imu: Mapping[str, Any], seed: int, lead_s: float, seconds: float) -> Run:
    """
    Return a rest and the motion of a top, as an IMU with these parameters reads them.

    Raises ValueError for parameters that are not allowed.
    """
    run = Motion(euler(NEAR)).rest(lead_s).top(seconds, seed).run(name)
    values = parameters.checked({'mag.field': FIELD, **imu, 'seed': seed})
    period_ns = round(1e9 / RATE)
    times = period_ns * np.arange(1, len(run.dt) + 1)
    # North is magnetic north.
    east, north, up = values['mag.field']
    field: Any = Rotation.from_quat(run.truth).inv().apply((0.0, math.hypot(east, north), up))
    true: Any = tuple(run.gyroscope.T), tuple(run.accelerometer.T)
    device, magnetometer = Imu(values, period_ns), Magnetometer(values, period_ns)
    rates, force, field = (np.stack(columns, axis=1) for columns in (
        *device.read(true, device.errors(times)),
        magnetometer.read(tuple(field.T), magnetometer.errors(times))))
    return replace(run, gyroscope=rates, accelerometer=force, magnetometer=field)


def with_arm(motion: Motion, run: Run, arm: Sequence[float]) -> Run:
    """Return the run with the IMU at a point [m] in the motion of a top."""
    (part,) = motion.of('top')
    rows = slice(part.begin, part.end)
    turns, force = Rotation.from_quat(run.truth[rows]), run.accelerometer.copy()
    acceleration = np.gradient(np.gradient(turns.apply(arm), 1.0 / RATE, axis=0), 1.0 / RATE,
                               axis=0)
    force[rows] += turns.inv().apply(acceleration)
    return replace(run, name='lever arm', accelerometer=force)
