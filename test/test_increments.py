# SPDX-License-Identifier: Apache-2.0
"""Increments and means of the IMU: against 30 digits, the truth at both ends, and a strapdown."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import EPOCH_NS, MILLISECOND, SECOND, fields, play, run, simulate
from scipy.spatial.transform import Rotation

from spinning_top_sim.streams import parameters

CASES = json.loads((Path(__file__).parent / 'data/increments.json').read_text())
MOUNTED = {'imu.lever_arm': (0.1, -0.2, 0.3), 'imu.rpy': (0.3, -0.7, 1.9)}
GRAVITY = parameters.checked({})['top.gravity']
TOPICS = DQ, DV, ODOMETRY = 'imu/dq', 'imu/dv', 'ground_truth/imu_odom'


def command(t_ns, l3, lz):
    """Return the event that the momenta are so many times those of the start."""
    return t_ns, 'command', {'l3': 1.6 * l3, 'lz': 1.38 * lz}


def rate(t_ns, hertz):
    return t_ns, 'parameters', {'imu.rate': hertz}


BOTH = pytest.mark.parametrize('method', ['exact', 'rk45'])


@pytest.mark.parametrize('case', CASES, ids=lambda case: f'{case["scene"]}-{case["length_ns"]}')
def test_increments_and_means_are_those_of_thirty_digits(case):
    """By the closed form: of rotations the rotation's part, however small, relative to itself."""
    simulation = simulate({
        **scene_parameters(case['scene']), 'solver.method': 'exact', 'imu.sampling': 'mean',
        'imu.lever_arm': case['lever_arm'], 'imu.rpy': case['rpy'],
        'imu.rate': SECOND / case['length_ns']})
    simulation.sent_ns = case['begin_ns']
    taken = play(simulation, case['begin_ns'] + case['length_ns'], DQ, DV, 'imu/data_raw')
    *_, (dq,) = fields(simulation, taken, DQ)
    *_, (dv,) = fields(simulation, taken, DV)
    *_, (rates,), (force,) = fields(simulation, taken, 'imu/data_raw')
    assert abs(dq[3] - float(case['dq'][3])) <= 5e-16
    # Over a short interval increments are integrals, else differences: with the ends' rounding.
    connected = 1e-14 if case['length_ns'] < MILLISECOND else 1e-13
    for name, found, bound in (('dq', dq[:3], connected), ('dv', dv, connected),
                               ('rates', rates, 1e-14), ('force', force, 1e-14)):
        expected = np.array(case[name][:3], np.float64)
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert error <= bound, (name, error)


# Parameters, end, events, and bounds of exact and rk45: parts of intervals are integrals, as good
# as its steps; whole ones are differences, so that errors do not add up in a strapdown.
MS = MILLISECOND
RUNS = {
    'no event': ({}, SECOND, (), (3e-15, 3e-15)),
    # Two in an interval, one at a sample, one at the first one.
    'commands': ({}, 200 * MS, (
        command(0, 1.1, 1.0), command(12_345_678, 1.2, 1.1), command(12_345_679, 0.8, 1.2),
        command(14_000_000, 0.9, 0.8), command(40 * MS, 1.1, 0.9), command(99_999_999, 0.7, 1.0)),
        (3e-15, 3e-12)),
    # Faster and slower, between two samples, twice before the next sample.
    'rates': ({'ground_truth_imu_odom.rate': 1000.0}, 120 * MS, (
        rate(22 * MS, 1000.0), rate(30_500_000, 100.0), rate(33_000_000, 50.0),
        command(34_000_000, 1.1, 0.9), rate(90 * MS, 200.0), rate(112 * MS, 1000.0),
        rate(112_500_000, 100.0)), (3e-15, 3e-12)),
    # One of the commands is where the acceleration changes.
    'path of the pivot': (
        {'pivot.path': (0.7, 1.0, 0.5, 9.0, 0.9025, -1.0, 0.0, -9.0)}, 2 * SECOND,
        (command(700 * MS, 1.1, 1.0), command(1_234_567_890, 0.9, 1.0)), (1e-14, 3e-12)),
    'slow': ({**scene_parameters('near_separatrix'), 'imu.rate': 3.0,
              'ground_truth_imu_odom.rate': 3.0}, SECOND, (), (1e-13, 1e-9)),
    'fast': ({'imu.rate': 10_000.0, 'ground_truth_imu_odom.rate': 10_000.0}, SECOND // 5, (),
             (1e-13, 1e-13))}


@pytest.mark.parametrize('name', RUNS)
@BOTH
def test_every_increment_leads_from_one_sample_of_the_odometry_to_the_next(method, name):
    values, until_ns, events, bounds = RUNS[name]
    tolerance = bounds[method == 'rk45']
    _, found = run({**MOUNTED, **values, 'solver.method': method}, until_ns, *TOPICS,
                   events=events)
    (times_ns, _, dq), (*_, dv), (odometry_ns, _, position, orientation, velocity, rates) = (
        found.values())
    places = np.searchsorted(odometry_ns, times_ns)
    assert np.array_equal(odometry_ns[places], times_ns)
    assert np.array_equal(dq[0], (0.0, 0.0, 0.0, 1.0)) and not dv[0].any()
    turned = Rotation.from_quat(orientation[places])
    world = turned.apply(velocity[places])
    step = turned[:-1].inv() * turned[1:]
    assert (step.inv() * Rotation.from_quat(dq[1:])).magnitude().max() <= tolerance
    change = np.diff(world, axis=0)
    change[:, 2] += GRAVITY * np.diff(times_ns) * 1e-9
    assert np.abs(turned[:-1].inv().apply(change) - dv[1:]).max() <= tolerance * (
        1.0 + np.abs(world).max())
    # The jumps of commands are far more than gravity and the motion give in an interval.
    assert name != 'commands' or np.abs(np.diff(world, axis=0)).max() > 0.2
    if 'pivot.path' not in values:      # the odometry is that of the lever arm's end
        arm = Rotation.from_euler('xyz', MOUNTED['imu.rpy']).inv().apply(MOUNTED['imu.lever_arm'])
        assert position == pytest.approx(Rotation.from_quat(orientation).apply(arm), abs=1e-14)
        assert velocity == pytest.approx(np.cross(rates, arm), abs=1e-13)


@BOTH
def test_switched_on_while_running_the_first_interval_is_a_whole_one(method):
    """The messages are those of a run in which they were on from the start."""
    values, until_ns = {'solver.method': method, **MOUNTED}, SECOND + 20 * MILLISECOND
    early = play(simulate(values), until_ns, *TOPICS)
    simulation, _ = run(values, SECOND + 3 * MILLISECOND, 'pose')
    taken = play(simulation, until_ns, *TOPICS)
    assert taken and sorted(taken) == sorted(
        one for one in early if one[1] - EPOCH_NS > SECOND + 3 * MILLISECOND)
