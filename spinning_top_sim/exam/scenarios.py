# SPDX-License-Identifier: Apache-2.0
"""
The motions of the exam, and what an IMU on them reads.

Each motion shows a fault that the others hide.  A seed decides the noise, and varies the start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.pipeline import Simulation

Reals = NDArray[np.float64]

# Noise densities of config/imu/bmi088.yaml, without its turn-on bias: a calibrated device.
CALIBRATED: Mapping[str, Any] = {'imu.gyroscope_noise_density': 1.72779e-4,
                                 'imu.accelerometer_noise_density': 1.21360e-3}
# East, north, up [T]: the strength and dip of mid-latitudes.  North is magnetic north, so that
# the heading of a filter needs no declination.
FIELD = (0.0, 20e-6, -43e-6)
FIELD_NOISE = 0.2e-6            # of a sample of the magnetometer [T]
GRAVITY = 9.80665


@dataclass(frozen=True)
class Scenario:
    """
    One motion and the IMU on it.

    values : parameters of the simulation that differ from their defaults
    duration, rate : of the run [s], [Hz]
    reversals : times at which the momenta change their sign, by an impulsive torque [s]
    bias : of the gyroscope, added to what the IMU has itself (3,) [rad/s]
    noisy : whether the IMU has its errors
    drop_rate : share of the samples that never come
    jitter : standard deviation of the stamps [s]
    """

    name: str
    values: Mapping[str, Any]
    duration: float = 40.0
    rate: float = 100.0
    reversals: tuple[float, ...] = ()
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noisy: bool = True
    drop_rate: float = 0.0
    jitter: float = 0.0


# A wheel of 2 kg on a pivot 2 cm below its centre: 4 rad/s of spin, slow precession, and a
# nutation of many degrees.  The rates are so low that the way of integrating them matters little.
SLOW = Scenario('slow', {'top.com_distance': 0.02, 'spin.l3': 0.6, 'initial.theta': 0.7})
# The wheel 15 cm from the pivot with 10.7 rad/s of spin: waves.
WAVES = Scenario('waves', {'spin.l3': 1.6, 'spin.lz': 1.42, 'initial.theta': 0.5236})
# 10 cm off the axis, where the centripetal acceleration of the slow wheel is a sixth of gravity.
LEVER_ARM = replace(SLOW, name='lever_arm', noisy=False, values={
    **SLOW.values, 'imu.lever_arm': (0.1, 0.0, 0.0)})
PIVOT = replace(LEVER_ARM, name='pivot', values={
    **SLOW.values, 'imu.lever_arm': (0.0, 0.0, 0.0)})
# Fast steady precession.  The errors of a step are odd in the rates: where these change their
# sign, no estimate of a bias can hide them.
FAST = Scenario('fast', {'spin.l3': 1.6, 'spin.lz': 1.7816, 'initial.theta': 0.5236},
                duration=12.0, reversals=(3.0, 6.0, 9.0), noisy=False)
# Small waves through the upward vertical, and a top that falls from it.
POLE = Scenario('pole', {'spin.l3': 1.6, 'spin.lz': 1.6, 'initial.theta': 0.0,
                         'initial.theta_dot': 2.0})
SATURATION = replace(WAVES, name='saturation', values={
    **WAVES.values, 'imu.gyroscope_range': 10.6})
DROPS = replace(WAVES, name='drops', drop_rate=0.05, jitter=0.5e-3)
COMMAND = replace(WAVES, name='command', reversals=(20.0,))


@dataclass(frozen=True)
class Run:
    """
    What an IMU reads along a motion, and the truth, at the ends of n steps.

    The gyroscope's reading is the mean over the step that ends, as of an integrating sensor; the
    other readings are of its end.

    t, dt : time and length of the step, by the stamps [s], (n,)
    gyroscope, accelerometer, magnetometer : in the frame of the IMU, (n, 3) [rad/s], [m/s^2], [T]
    truth : q(world <- IMU) as x, y, z, w (n, 4)
    rates : true angular velocity at the end of the step (n, 3) [rad/s]
    """

    scenario: Scenario
    seed: int
    t: Reals
    dt: Reals
    gyroscope: Reals
    accelerometer: Reals
    magnetometer: Reals
    truth: Reals
    rates: Reals
    values: Mapping[str, Any] = field(repr=False)

    def part(self, rows: slice | NDArray[np.int64]) -> 'Run':
        """Return the run with these samples only."""
        return replace(self, **{name: getattr(self, name)[rows] for name in (
            't', 'dt', 'gyroscope', 'accelerometer', 'magnetometer', 'truth', 'rates')})


def record(scenario: Scenario, imu: Mapping[str, Any], seed: int) -> Run:
    """
    Simulate a scenario with these parameters of an IMU.

    Raises ValueError for parameters that are not allowed.
    """
    random = np.random.default_rng(seed)
    phi, psi = random.uniform(-np.pi, np.pi, 2).tolist()
    given = {**imu, **scenario.values} if scenario.noisy else {
        **{name: value for name, value in imu.items() if name in ('imu.lever_arm', 'imu.rpy')},
        **scenario.values}
    values = parameters.checked({'initial.phi': phi, 'initial.psi': psi, 'seed': seed,
                                 'solver.method': 'exact', **given})
    simulation, device = Simulation(values), Imu(values)
    period_ns = 2 * round(0.5 * NANOSECONDS / scenario.rate)
    end_ns = round(scenario.duration * scenario.rate) * period_ns
    stops = [round(t * scenario.rate) * period_ns for t in scenario.reversals]
    parts: list[tuple[Sequence[Any], ...]] = []
    begin_ns = 0
    for stop_ns in (*stops, end_ns):
        halves = simulation.segment.states(range(begin_ns, stop_ns + 1, period_ns // 2))
        steps = range(begin_ns + period_ns, stop_ns + 1, period_ns)
        rates, force = (np.broadcast_arrays(*vector, np.empty(len(halves)))[:3]
                        for vector in device.true(halves))
        # Simpson's rule: exact to 1e-6 of the change within a step.
        mean = tuple((rate[:-2:2] + 4.0 * rate[1::2] + rate[2::2]) / 6.0 for rate in rates)
        at_end = tuple(column[2::2] for column in force)
        readings = device.sensor(period_ns).read((mean, at_end), steps)
        orientation = tuple(column[2::2] for column in device.orientation(halves))
        parts.append((*readings[0], *readings[1], *attitude.in_body(orientation, FIELD),
                      *orientation, *(rate[2::2] for rate in rates)))
        if stop_ns < end_ns:
            simulation.skip_to(stop_ns)
            simulation.command(-simulation.l3, -simulation.lz)
        begin_ns = stop_ns
    columns = np.concatenate([np.stack(np.broadcast_arrays(*part)) for part in parts], axis=1).T
    gyroscope, accelerometer, magnetometer, truth, rates_at_end = np.split(
        columns, (3, 6, 9, 13), axis=1)
    if scenario.noisy:
        magnetometer = magnetometer + FIELD_NOISE * random.standard_normal(magnetometer.shape)
    period = period_ns / NANOSECONDS
    t = period * np.arange(1, len(columns) + 1)
    stamps = t + scenario.jitter * random.standard_normal(len(t))
    run = Run(scenario, seed, stamps, np.full(len(t), period), gyroscope + scenario.bias,
              accelerometer, magnetometer, truth, rates_at_end, values)
    if not (scenario.jitter or scenario.drop_rate):
        return run
    kept = np.flatnonzero(random.random(len(t)) >= scenario.drop_rate)
    run = run.part(kept)
    return replace(run, dt=np.diff(run.t, prepend=0.0))
