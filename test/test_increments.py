# SPDX-License-Identifier: Apache-2.0
"""Increments and means of the IMU: against 30 digits, the truth at both ends, and a strapdown."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, SECOND, record, simulate, stream
from scipy.spatial.transform import Rotation

from spinning_top_sim.streams import parameters

CASES = json.loads((Path(__file__).parent / 'data/increments.json').read_text())
MOUNTED = {'increments.enabled': True, 'imu.lever_arm': (0.1, -0.2, 0.3),
           'imu.rpy': (0.3, -0.7, 1.9)}
NOISY = {'imu.gyroscope_noise_density': 1e-3, 'imu.gyroscope_turn_on_bias': 0.02,
         'imu.accelerometer_noise_density': 2e-2, 'imu.accelerometer_turn_on_bias': 0.1}
DQ, DV, ODOMETRY = 'imu/dq', 'imu/dv', 'ground_truth/imu_odom'
T = 5 * MILLISECOND


def fields(simulation, taken, topic):
    """Return times [ns] and the fields of the messages of a topic."""
    times_ns, data = zip(*((t_ns, data) for name, t_ns, data in taken if name == topic),
                         strict=True)
    parts = stream(simulation, topic).template.decode(b''.join(data))
    return np.array(times_ns), *map(np.array, parts)


def run(values, duration_ns, events=(), topics=(DQ, DV, ODOMETRY)):
    """Simulate; events: time [ns] and what then is done with the simulation."""
    simulation = simulate(values)
    taken = record(simulation, *topics)
    for t_ns, act in events:
        simulation.advance(t_ns)
        act(simulation)
    simulation.advance(duration_ns)
    return simulation, taken


# ------------------------------------------------------------------------- against 30 digits

@pytest.mark.parametrize('case', CASES, ids=lambda case: f'{case["scene"]}-{case["length_ns"]}')
def test_increments_and_means_are_those_of_thirty_digits(case):
    """By the closed form: of rotations the rotation's part, however small, relative to itself."""
    simulation = simulate({
        **scene_parameters(case['scene']), 'solver.method': 'exact', 'imu.sampling': 'mean',
        'imu.lever_arm': case['lever_arm'], 'imu.rpy': case['rpy'],
        'imu.rate': SECOND / case['length_ns']})
    simulation.skip_to(case['begin_ns'])
    taken = record(simulation, DQ, DV, 'imu/data_raw')
    simulation.advance(case['begin_ns'] + case['length_ns'])
    (_, (dq,)), (_, (dv,)) = (fields(simulation, taken, topic) for topic in (DQ, DV))
    _, _, (rates,), (force,) = fields(simulation, taken, 'imu/data_raw')
    assert abs(dq[3] - float(case['dq'][3])) <= 5e-16
    # Over a short interval increments are integrals, else differences: with the ends' rounding.
    connected = 1e-14 if case['length_ns'] < MILLISECOND else 1e-13
    for name, found, bound in (('dq', dq[:3], connected), ('dv', dv, connected),
                               ('rates', rates, 1e-14), ('force', force, 1e-14)):
        expected = np.array(case[name][:3], np.float64)
        error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
        assert error <= bound, (name, error)


# -------------------------------------------------------------- against the truth at both ends

def assert_they_connect(simulation, taken, tolerance):
    """Every increment leads from one sample of the odometry to the next."""
    times_ns, dq = fields(simulation, taken, DQ)
    _, dv = fields(simulation, taken, DV)
    odometry_ns, position, orientation, velocity, _ = fields(simulation, taken, ODOMETRY)
    places = np.searchsorted(odometry_ns, times_ns)
    assert np.array_equal(odometry_ns[places], times_ns)
    turned = Rotation.from_quat(orientation[places])
    world = turned.apply(velocity[places])
    assert np.array_equal(dq[0], (0.0, 0.0, 0.0, 1.0))
    assert not dv[0].any()
    step = turned[:-1].inv() * turned[1:]
    apart = (step.inv() * Rotation.from_quat(dq[1:])).magnitude()
    assert apart.max() <= tolerance
    change = np.diff(world, axis=0)
    change[:, 2] += simulation.top.gravity * np.diff(times_ns) * 1e-9
    assert np.abs(turned[:-1].inv().apply(change) - dv[1:]).max() <= tolerance * (
        1.0 + np.abs(world).max())
    return times_ns, position[places], world


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_increments_connect_the_samples_across_commands(method):
    """Two commands within an interval, one at a sample, one at the first: jumps belong to dv."""
    def command(l3, lz):
        return lambda simulation: simulation.command(l3 * simulation.l3, lz * simulation.lz)
    events = [(0, command(1.1, 1.0)), (12_345_678, command(1.2, 1.1)),
              (12_345_679, command(0.8, 1.2)), (14_000_000, command(0.9, 0.8)),
              (40 * MILLISECOND, command(1.1, 0.9)), (99_999_999, command(0.7, 1.0))]
    simulation, taken = run({**MOUNTED, 'solver.method': method}, 200 * MILLISECOND, events)
    # Parts of intervals are integrals, which rk45 has to its own accuracy.
    tolerance = 3e-15 if method == 'exact' else 3e-12
    times_ns, _, world = assert_they_connect(simulation, taken, tolerance)
    assert len(times_ns) == 41
    # They are jumps: far more than gravity and the motion give in an interval.
    assert np.abs(np.diff(world, axis=0)).max() > 0.2


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_after_a_change_of_the_rate_nothing_is_left_out(method):
    """Faster and slower, between two samples, twice before the next sample, with a command."""
    def rate(hertz):
        return lambda simulation: simulation.apply({'imu.rate': hertz})
    events = [(22 * MILLISECOND, rate(1000.0)), (30_500_000, rate(100.0)),
              (33_000_000, rate(50.0)), (34_000_000, lambda one: one.command(1.7, 1.3)),
              (90 * MILLISECOND, rate(200.0))]
    simulation, taken = run(
        {**MOUNTED, 'solver.method': method, 'ground_truth_imu_odom.rate': 1000.0},
        120 * MILLISECOND, events)
    times_ns, *_ = assert_they_connect(simulation, taken, 3e-15 if method == 'exact' else 3e-12)
    assert times_ns.tolist() == [ms * MILLISECOND for ms in (
        0, 5, 10, 15, 20, 23, 24, 25, 26, 27, 28, 29, 30, 40, 60, 80, 95, 100, 105, 110, 115, 120)]


@pytest.mark.parametrize('values', [
    {'imu.rate': 1.0, 'spin.l3': 3.0}, {'imu.rate': 3.0, **scene_parameters('near_separatrix')},
    {'imu.rate': 10_000.0}, {'imu.rate': 1.0, 'spin.l3': 500.0}])
def test_long_intervals_are_divided(values):
    simulation, taken = run({**MOUNTED, **values, 'solver.method': 'exact',
                             'ground_truth_imu_odom.rate': values['imu.rate']},
                            2 * SECOND if values['imu.rate'] < 10.0 else 20 * MILLISECOND)
    assert_they_connect(simulation, taken, 1e-13)


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_at_200_hz_increments_connect_the_samples_of_every_solver(method):
    """They are differences: the errors of the solver do not add up in a strapdown."""
    simulation, taken = run({**MOUNTED, 'solver.method': method}, 2 * SECOND)
    assert_they_connect(simulation, taken, 3e-15)


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_odometry_is_that_of_the_lever_arms_end(method):
    simulation, taken = run({**MOUNTED, 'solver.method': method}, 2 * SECOND)
    _, position, orientation, velocity, rates = fields(simulation, taken, ODOMETRY)
    turned = Rotation.from_quat(orientation)
    mounting = Rotation.from_euler('xyz', MOUNTED['imu.rpy'])
    arm = mounting.inv().apply(MOUNTED['imu.lever_arm'])
    assert position == pytest.approx(turned.apply(arm), abs=1e-14)
    assert velocity == pytest.approx(np.cross(rates, arm), abs=1e-13)


# ------------------------------------------------------------------------------ a strapdown

def test_a_strapdown_of_the_increments_stays_with_the_truth():
    """60 s here; benchmark/increments.py has 1000 s, and the bounds for that."""
    simulation, taken = run({**MOUNTED, 'solver.method': 'exact'}, 60 * SECOND)
    _, dq = fields(simulation, taken, DQ)
    _, dv = fields(simulation, taken, DV)
    _, _, orientation, velocity, _ = fields(simulation, taken, ODOMETRY)
    attitude, total = Rotation.from_quat(orientation[0]), np.zeros(3)
    for rotation, change in zip(Rotation.from_quat(dq[1:]), dv[1:], strict=True):
        total += attitude.apply(change)
        attitude = attitude * rotation
    total[2] -= simulation.top.gravity * 60.0
    last = Rotation.from_quat(orientation[-1])
    assert (last.inv() * attitude).magnitude() <= 2e-13
    start = Rotation.from_quat(orientation[0]).apply(velocity[0])
    assert np.abs(start + total - last.apply(velocity[-1])).max() <= 1e-11


# ---------------------------------------------------------------------------------- errors

def test_the_noise_of_increments_is_that_of_the_readings():
    """Of sample k: the error of the mean, throughout the interval."""
    topics = (DQ, DV, 'imu/data_raw', 'ground_truth/imu')
    values = {**MOUNTED, **NOISY, 'imu.sampling': 'mean', 'imu.gyroscope_M': (
        1.01, 0.002, 0.0, -0.003, 0.98, 0.0, 0.001, 0.0, 1.0)}
    simulation, taken = run(values, SECOND, topics=topics)
    exact, truth = run(MOUNTED, SECOND, topics=topics)
    errors = [a - b for a, b in zip(fields(simulation, taken, 'imu/data_raw')[2:],
                                    fields(simulation, taken, 'ground_truth/imu')[2:],
                                    strict=True)]
    found, expected = (Rotation.from_quat(fields(*one, DQ)[1]).as_rotvec()
                       for one in ((simulation, taken), (exact, truth)))
    assert found[1:] - expected[1:] == pytest.approx(5e-3 * errors[0][1:], abs=1e-14)
    half = Rotation.from_rotvec(0.5 * expected)
    assert fields(simulation, taken, DV)[1][1:] - fields(exact, truth, DV)[1][1:] == pytest.approx(
        5e-3 * half.apply(errors[1])[1:], abs=1e-14)
    assert np.abs(errors[0]).max() > 0.01
    assert np.abs(errors[1]).max() > 0.1


def test_instant_readings_have_the_same_noise_as_means():
    """White noise and bias are numbered by sample, whatever the sample is taken of."""
    found = {}
    for sampling in ('instant', 'mean'):
        simulation, taken = run({**NOISY, 'imu.sampling': sampling}, SECOND // 4,
                                topics=('imu/data_raw', 'ground_truth/imu'))
        raw, truth = (np.hstack(fields(simulation, taken, topic)[2:])
                      for topic in ('imu/data_raw', 'ground_truth/imu'))
        found[sampling] = raw - truth, truth
    assert found['instant'][0] == pytest.approx(found['mean'][0], abs=1e-14)
    # The first mean is over no time.  Later ones differ from the values at the stamps.
    assert np.array_equal(found['instant'][1][0], found['mean'][1][0])
    assert np.abs(found['instant'][1] - found['mean'][1])[1:, 0].min() > 1e-4


# ------------------------------------------------------------------------------ off, and on

def test_off_nothing_is_kept_nor_imported():
    code = ('import sys\n'
            'from spinning_top_sim.streams import parameters, pipeline\n'
            'one = pipeline.Simulation(parameters.checked({}), 10 ** 9)\n'
            'one.log_to(lambda *_: None, [stream for stream in one.streams if stream.parameter in '
            '("pose", "imu", "imu_data", "ground_truth_imu")])\n'
            'one.advance(10 ** 8); one.command(1.0, 0.9); one.advance(2 * 10 ** 8)\n'
            'assert one.segment.kept_ns == 0\n'
            'print([name for name in sys.modules if name.endswith(("integrals", "intervals"))])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True,
                          timeout=60)
    assert done.stdout == '[]\n'


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_switched_on_while_running_the_first_interval_begins_there(method):
    simulation = simulate(solver__method=method, imu__lever_arm=(0.1, 0.0, 0.2))
    simulation.advance(1_003_000_000)
    simulation.apply({'increments.enabled': True})
    taken = record(simulation, DQ, DV, ODOMETRY)
    simulation.advance(SECOND + 20 * MILLISECOND)
    times_ns, dq = fields(simulation, taken, DQ)
    assert times_ns[0] == SECOND + 5 * MILLISECOND
    rates = stream(simulation, ODOMETRY).template.decode(
        next(data for name, _, data in taken if name == ODOMETRY))[-1]
    angle = 2.0 * np.linalg.norm(dq[0, :3])
    assert angle == pytest.approx(2e-3 * np.linalg.norm(rates), rel=1e-3)


def test_a_rate_that_no_interval_may_have_is_refused():
    for values in ({'increments.enabled': True}, {'imu.sampling': 'mean'}):
        with pytest.raises(ValueError, match=r'imu\.rate = 0\.5: must be >= 1'):
            parameters.checked({**values, 'imu.rate': 0.5})
    parameters.checked({'imu.rate': 0.5})
