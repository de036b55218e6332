# SPDX-License-Identifier: Apache-2.0
"""
Scenes of the field: an IMU of consumer grade in a hand, with what disturbs it there.

The motion of a top is too regular for that: the sensor turns at the end of an arm, and the arm
moves.  Rates, accelerations, their frequencies and lever arms are those of the trials of BROAD
(Laidig et al., Data 2021, 6, 72), and so are bias, noise, lateness and field of the sensor.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.motions import GRAVITY, Reals, Run, Scored, readings
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.felt import Vibration

# The motion is computed every half step.
PERIOD_NS = 7_000_000
HALF_NS, HALF = PERIOD_NS // 2, 0.5e-9 * PERIOD_NS
# Begin and end of each motion [s]; the sensor rests before it.  A motion sets in within RAMP.
ONE, BREAKS = ((30.0, 90.0),), ((30.0, 52.0), (60.0, 80.0), (88.0, 106.0))
RAMP = 1.0
# A calibrated device, in a building.
DEVICE: Mapping[str, Any] = {
    'imu.bandwidth': 50.0, 'imu.gyroscope_noise_density': 1e-4, 'imu.gyroscope_bias_stddev': 3e-4,
    'imu.gyroscope_range': 34.9, 'imu.accelerometer_noise_density': 2.7e-3,
    'imu.accelerometer_turn_on_bias': 0.03, 'imu.accelerometer_range': 156.9,
    'mag.noise_density': 7e-8, 'mag.field': (0.0, 16.5e-6, -41.7e-6)}
# Standard deviations of what its calibration leaves, [T] of the last.
LEFT = {'imu.gyroscope_M': 3e-3, 'imu.accelerometer_M': 3e-3, 'mag.soft_iron': 1e-2,
        'mag.hard_iron': 3e-7}
BIAS = 7e-3                     # norm of the gyroscope's at the start [rad/s]
MAG_LATE = 4                    # half steps until the field is in a reading
PASSING = 2.0                   # of a magnet [s]
UP = np.array((0.0, 0.0, GRAVITY))
TAP = 60.0                      # standard deviation of its acceleration [m/s^2]


@dataclass(frozen=True)
class Scene:
    """A motion of a hand, and what disturbs its sensor."""

    name: str
    rates: tuple[float, float, float]           # rms of yaw, pitch and roll [rad/s]
    rates_hz: float
    acceleration: tuple[float, float, float]    # rms of the arm's pivot, east, north, up [m/s^2]
    acceleration_hz: float
    arm: float                                  # its length [m]; it is level at first
    pitch: float = 0.0                          # of the sensor on it [rad]
    taps: float = 0.0                           # on the sensor, a second
    magnet: float = 5e-7                        # standard deviation of the fields it passes [T]
    motions: tuple[tuple[float, float], ...] = ONE      # begin and end of each [s]
    # Parameters of the vibration and of a magnet on the sensor; they override `imu`.
    values: Mapping[str, Any] = field(default_factory=dict)


SCENES = (
    Scene('slow_rotation', (0.8, 0.7, 1.2), 0.2, (0.3, 0.3, 0.3), 4.0, 0.05, motions=BREAKS),
    Scene('fast_rotation', (4.3, 4.3, 4.3), 1.8, (1.4, 1.4, 1.4), 4.0, 0.01, motions=BREAKS),
    Scene('slow_translation', (0.4, 0.35, 0.4), 1.0, (1.2, 1.2, 1.2), 0.6, 0.1),
    Scene('fast_translation', (1.5, 2.5, 1.0), 1.8, (5.0, 5.0, 10.0), 1.8, 0.4),
    Scene('combined', (3.5, 1.8, 4.6), 0.75, (3.5, 3.5, 3.5), 1.5, 0.25, 0.65, motions=BREAKS),
    Scene('tapping', (0.5, 0.5, 0.5), 1.0, (1.4, 1.4, 1.4), 0.6, 0.16, taps=2.0),
    Scene('vibration', (1.0, 1.4, 2.8), 0.4, (0.5, 0.5, 0.5), 1.5, 0.05, values={
        'imu.vibration.frequency': 160.0, 'imu.vibration.force': (4.0, 4.0, 4.0)}),
    Scene('magnet_near', (3.5, 1.8, 4.6), 0.75, (3.5, 3.5, 3.5), 1.5, 0.25, 0.65, magnet=3e-6),
    Scene('magnet_on_it', (1.6, 0.8, 1.8), 0.5, (1.2, 1.2, 1.2), 0.6, 0.35, values={
        'mag.disturbance.body': (0.0, 1e3, -2e-6, 5e-7, 9e-6)}))


def record(scene: Scene, seed: int, imu: Mapping[str, Any]) -> Scored:
    """
    Return a scene as an IMU reads it.  Raises ValueError for parameters not allowed.

    A seed decides on motions, noise and device; `imu` has the parameters imu.* and mag.* that
    differ from those of DEVICE.
    """
    random = np.random.default_rng((seed, *scene.name.encode()))
    values = _device(random, scene, imu)
    turns, rates, acceleration, moves = _motion(random, scene)
    bias = random.standard_normal(3)
    readings = _readings(values, turns, rates + BIAS * bias / np.linalg.norm(bias),
                         turns.inv().apply(acceleration + UP))
    step = np.full(len(moves) // 2, 1e-9 * PERIOD_NS)
    run = Run(scene.name, step, turns[1::2].as_quat(), *readings)
    return run, np.flatnonzero(moves[1::2] > 0.5)


def _device(random: np.random.Generator, scene: Scene,
            imu: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the parameters of the sensor, and of what it passes."""
    begins = np.arange(0.0, scene.motions[-1][1], PASSING)[:, np.newaxis]
    events = np.hstack((begins, begins + PASSING, scene.magnet * random.standard_normal(
        (len(begins), 3))))
    left = {name: (np.array(parameters.BY_NAME[name].default) + deviation
                   * random.standard_normal(len(parameters.BY_NAME[name].default))).tolist()
            for name, deviation in LEFT.items()}
    return parameters.checked({
        **DEVICE, **left, 'mag.disturbance.world': events.ravel().tolist(),
        'seed': int(random.integers(2 ** 31)), **imu, **scene.values})


def _motion(random: np.random.Generator, scene: Scene) -> tuple[Rotation, Reals, Reals, Reals]:
    """Return attitudes, rates, accelerations and share of the motion at all half steps."""
    # The first and the last half step are for differences only.
    n = 2 * round(1e9 * (scene.motions[-1][1] + RAMP) / PERIOD_NS) + 2
    t = HALF * np.arange(n, dtype=np.float64)
    moves = np.sum([_step((t - begin) / RAMP) * _step((end - t) / RAMP)
                    for begin, end in scene.motions], axis=0)
    yaw, pitch, roll = moves * _waves(random, n, scene.rates_hz, 1, scene.rates)
    turns = Rotation.from_euler('ZYX', np.stack((
        yaw + random.uniform(-np.pi, np.pi), pitch - scene.pitch, roll), axis=1))
    arm = scene.arm * np.array((math.cos(scene.pitch), 0.0, -math.sin(scene.pitch)))
    strokes = moves * _waves(random, n, scene.acceleration_hz, 2, scene.acceleration)
    place = strokes.T + turns.apply(arm)
    acceleration = np.diff(place, 2, axis=0) / HALF ** 2
    # A blow, and the one back that leaves the sensor where it was.
    taps = round(scene.taps * HALF * float(np.sum(moves)))
    for k in random.choice(np.flatnonzero(moves[1:-2] > 0.5), taps, replace=False):
        blow = TAP * random.standard_normal(3)
        acceleration[k] += blow
        acceleration[k + 1] -= blow
    rates = (turns[:-2].inv() * turns[2:]).as_rotvec() / (2.0 * HALF)
    return turns[1:-1], rates, acceleration, moves[1:-1]


def _step(x: Reals) -> Reals:
    """Return a step from 0 at x = 0 to 1 at x = 1 whose second derivative has no jump."""
    x = np.clip(x, 0.0, 1.0)
    return x ** 3 * (10.0 - 15.0 * x + 6.0 * x * x)


def _waves(random: np.random.Generator, n: int, frequency: float, order: int,
           sizes: tuple[float, float, float]) -> Reals:
    """Return noise of two octaves (3, n) whose derivatives of an order have these rms."""
    f = np.fft.rfftfreq(n, HALF)
    spectrum = np.where((f > 0.5 * frequency) & (f < 2.0 * frequency), (
        random.standard_normal((3, len(f))) + 1j * random.standard_normal((3, len(f)))), 0.0)
    spectrum[:, 1:] /= (math.tau * f[1:]) ** order
    derivative = np.fft.irfft(spectrum * (1j * math.tau * f) ** order, n)
    scale = np.array(sizes) / np.sqrt(np.mean(derivative ** 2, axis=1))
    waves: Reals = scale[:, np.newaxis] * np.fft.irfft(spectrum, n)
    return waves


def _readings(values: Mapping[str, Any], turns: Rotation, rates: Reals, force: Reals,
              ) -> list[Reals]:
    """Return what gyroscope, accelerometer and magnetometer read at the steps, (n, 3) each."""
    t_ns = HALF_NS * np.arange(1, len(rates) + 1)
    exact: Any = rates.T, force.T
    signals: Any = np.concatenate([
        np.stack(Vibration(values, name, np.ones_like).add(true, t_ns))
        for name, true in (('rate', exact[0]), ('force', exact[1]))])
    if 0.0 < values['imu.bandwidth'] < 0.5 / HALF:
        from scipy.signal import butter, lfilter, lfilter_zi  # noqa: PLC0415 - slow

        low_pass = butter(values['imu.bandwidth_order'], 2.0 * HALF * values['imu.bandwidth'])
        signals = lfilter(*low_pass, signals, zi=lfilter_zi(*low_pass) * signals[:, :1])[0]
    late = np.maximum(np.arange(1, len(t_ns), 2) - MAG_LATE, 0)
    return readings(values, PERIOD_NS, signals[:3, 1::2].T, signals[3:, 1::2].T, turns[late],
                    t_ns[late])
