# SPDX-License-Identifier: Apache-2.0
"""
Every error of the IMU, recovered from what it reads.

The estimators share nothing with the code under test.  All seeds are fixed; bounds are in standard
deviations of the estimate.  `python test/stress sensor` does the same for many seeds.
"""

import math
import subprocess
import sys
from statistics import NormalDist

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.sensor_logs import recorded
from helpers.simulations import SECOND, doubles, record, simulate, stream
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from stress import sensor as statistics

from spinning_top_sim.streams import noise, parameters
from spinning_top_sim.streams.imu import Sensor

STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
MILLISECOND = 1_000_000


def read(values, times, exact=STILL):
    """Return what a sensor reads, (n, 6)."""
    rates, force = Sensor(parameters.checked(values), times.step).read(exact, times)
    return np.column_stack([np.broadcast_to(axis, len(times)) for axis in (*rates, *force)])


# ------------------------------------------------------------------------- deterministic errors

def test_matrices_g_sensitivity_and_bias_are_found_by_least_squares(tmp_path):
    """All 27 elements and 6 offsets from one log, each within 3 of its standard deviations."""
    found, deviations, expected = statistics.calibration(0, tmp_path)
    assert np.abs((found - expected) / deviations).max() < 3.0
    assert deviations.max() < 3e-3


def test_the_chain_by_hand():
    """Matrices, g-sensitivity, then rounding, then the range; no reading is beyond a grid code."""
    values = {'imu.gyroscope_M': (2.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0),
              'imu.gyroscope_A': (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
              'imu.accelerometer_M': (1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0),
              'imu.gyroscope_resolution': 0.5, 'imu.gyroscope_range': 7.2,
              'imu.accelerometer_range': 10.5}
    rows = read(values, range(0, 2, 1), ((1.0, 2.0, 9.0), (0.3, 4.0, 10.0)))
    # x: 2 + 1 + 2.5 = 5.5; z: -9 + 0.3 = -8.7, cut at the code 7.0 within 7.2.
    assert rows.tolist() == 2 * [[5.5, 2.0, -7.0, 10.3, 10.5, 10.0]]


def test_g_sensitivity_acts_on_the_true_force_and_not_on_what_is_read():
    values = {'imu.gyroscope_A': (1.0, *8 * (0.0,)), 'imu.accelerometer_M': 9 * (0.0,)}
    assert read(values, range(1), ((0.0,) * 3, (7.0, 0.0, 0.0))).tolist() == [
        [7.0, 0.0, 0.0, 0.0, 0.0, 0.0]]


def test_a_perfect_sensor_hands_on_what_is_exact():
    exact = ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    sensor = Sensor(parameters.checked({}), MILLISECOND)
    assert sensor.read(exact, range(3)) is exact
    quaternion = (0.0, 0.0, 0.0, 1.0)
    assert sensor.orientation(quaternion, range(3)) is quaternion


@pytest.mark.parametrize('values', [{}, {'imu.gyroscope_M': (2.0, *8 * (0.0,))}])
def test_what_a_scene_does_not_need_is_not_imported(values):
    code = ('import sys\n'
            'from spinning_top_sim.streams import parameters\n'
            'from spinning_top_sim.streams.pipeline import Simulation\n'
            f'simulation = Simulation(parameters.checked({values}))\n'
            'simulation.log_to(lambda *_: None, [one for one in simulation.streams if one.topic '
            'not in ("imu/mag", "ground_truth/mag", "ground_truth/imu_timing")])\n'
            'simulation.advance(10 ** 8)\n'
            'print([name for name in sys.modules if name.endswith('
            '(".noise", ".timing", ".magnetometer", "scipy"))])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=60, check=True)
    assert done.stdout.strip() == '[]'


@pytest.mark.parametrize('band', [(2.0, 1.0), (3.0, 3.0)])
def test_a_band_that_does_not_ascend_is_refused(band):
    with pytest.raises(ValueError, match=r'imu\.bias_instability_band = \[\d.0, \d.0\]: the sec'):
        parameters.checked({'imu.bias_instability_band': band})


# ---------------------------------------------------------------------------- statistics of noise

def test_white_noise_and_walk_have_their_densities():
    """Within 3 %: the estimates have standard deviations of 0.3 % and 0.4 %."""
    density, walk = statistics.white_and_walk(0)
    assert density == pytest.approx(1.0, rel=0.03) and walk == pytest.approx(1.0, rel=0.03)


def test_a_gauss_markov_bias_has_its_variance_and_its_correlation_time():
    """Within 2 %, of which the estimates take some 0.5 %."""
    for found in statistics.gauss_markov(0):
        assert found == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize('time', [0.01, 3.0, 1e6])
def test_a_gauss_markov_bias_is_stationary_at_any_time(time):
    """At the start, at a second and after three years it has one variance: 2400 numbers each."""
    times_ns = np.array([0, SECOND, 94_608_000 * SECOND])
    rows = np.concatenate([noise.Path(seed, noise.Purpose.GAUSS_MARKOV, (6 * (time,),),
                                      (6 * (2.0,),)).at(times_ns) for seed in range(400)])
    assert np.std(rows, axis=0) == pytest.approx(2.0, rel=4.0 / math.sqrt(2.0 * len(rows)))
    correlation = np.mean(rows[:, 0] * rows[:, 1]) / 4.0
    assert correlation == pytest.approx(math.exp(-1.0 / time), abs=4.0 / math.sqrt(len(rows)))


def test_gauss_markov_has_no_seam_between_its_blocks():
    """Steps across the seams of 512 are distributed as all others."""
    path = noise.Path(3, noise.Purpose.GAUSS_MARKOV, (6 * (0.2,),), (6 * (1.0,),))
    rows = path.at(np.arange(1_024_000) * noise.STEP_NS)
    steps = np.diff(rows, axis=1)[:, 511::512]
    expected = math.sqrt(-2.0 * math.expm1(-0.001 / 0.2))
    assert np.std(steps) == pytest.approx(expected, rel=4.0 / math.sqrt(2.0 * steps.size))


@pytest.mark.parametrize('band', [(0.05, 5.0), (0.2, 0.4)])
def test_the_allan_deviation_of_a_flicker_bias_is_flat_over_its_band(band):
    """Within 10 % of the parameter."""
    tau, found = statistics.flicker(0, band)
    assert tau[0] <= 1.05 * band[0] and tau[-1] >= 0.95 * band[1]
    assert found == pytest.approx(1.0, rel=0.10)


@pytest.mark.parametrize('lowest', [0.01, 1.0])
def test_the_law_of_a_flicker_bias_is_flat_for_every_band(lowest):
    """By the closed form of its Allan variance: within 6 % for ratios up to 1e6."""
    for ratio in np.geomspace(1.01, 1e6, 60):
        tau = np.geomspace(lowest, ratio * lowest, 400)
        variance = sum(scale ** 2 * 2.0 * time / tau * (1.0 - time / (2.0 * tau) * (
            3.0 - 4.0 * np.exp(-tau / time) + np.exp(-2.0 * tau / time)))
            for time, scale in noise.flicker_parts(lowest, ratio * lowest))
        assert np.sqrt(variance) == pytest.approx(1.0, rel=0.06)


def test_a_jump_of_three_years_draws_few_numbers(monkeypatch):
    """By way of some log2 of the blocks before, for each of three paths."""
    draws, philox = [], np.random.Philox
    monkeypatch.setattr(np.random, 'Philox',
                        lambda **keys: (draws.append(keys), philox(**keys))[1])
    begin = 94_608_000 * SECOND
    there = read({**ALL_BIASES, 'seed': 77}, range(begin, begin + SECOND, MILLISECOND))
    assert 3 * 20 < len(draws) < 3 * 100
    assert np.isfinite(there).all() and np.std(there, axis=0).min() > 0.0


ALL_BIASES = {f'imu.{kind}_{name}': value for kind in ('gyroscope', 'accelerometer')
              for name, value in (('random_walk', 1e-2), ('bias_stddev', 0.1),
                                  ('turn_on_bias', 0.2), ('bias_instability', 0.05))}


def test_one_bias_does_not_move_another():
    """Their sum is the sum of each alone."""
    times = range(0, 3 * SECOND, MILLISECOND)
    alone = [read({name: value for name, value in ALL_BIASES.items() if name.endswith(end)}, times)
             for end in ('_walk', '_stddev', '_turn_on_bias', '_instability')]
    assert all(np.all(np.std(one, axis=0) + np.abs(one[0]) > 0.0) for one in alone)
    assert read(ALL_BIASES, times) == pytest.approx(sum(alone), abs=1e-15)


def test_a_change_of_the_rate_while_it_runs_leaves_the_bias_continuous():
    values = {**ALL_BIASES, 'solver.method': 'exact', 'imu.rate': 200.0}
    simulation = simulate(values)
    taken = record(simulation, 'ground_truth/imu_bias')
    for number, rate in enumerate((1000.0, 90.0, 400.0), 1):
        simulation.advance(number * SECOND // 2 + 7)
        simulation.apply({'imu.rate': rate})
    simulation.advance(2 * SECOND)
    times = np.array([t_ns for _, t_ns, _ in taken])
    rows = np.array([doubles(data, 24) for *_, data in taken])[:, [0, 1, 2, 12, 13, 14]]
    sensor = Sensor(parameters.checked(values), MILLISECOND)
    rates, force = sensor.bias(range(0, 2 * SECOND + 1, MILLISECOND))
    steady = np.column_stack((*rates, *force))
    assert len(times) > 700 and np.array_equal(rows, steady[times // MILLISECOND])


# ------------------------------------------------------------------------------------ covariances

def test_the_error_of_the_orientation_is_as_published(tmp_path):
    """NEES, error^T covariance^-1 error in the IMU's frame: chi-square over 100 seeds."""
    squares, inside = statistics.orientation_nees(range(100))
    low, high = chi2.ppf((0.025, 0.975), squares.size * 3)
    assert low < squares.sum() < high
    # Binomial of 100 and 0.95: from 89 to 99 with 99 %.
    assert 89 <= inside <= 99


@pytest.mark.parametrize('topic', ['imu/data_raw', 'imu/data'])
def test_the_errors_of_the_readings_are_as_published(topic):
    squares = statistics.readings_nees(range(100), topic)
    low, high = chi2.ppf((0.025, 0.975), squares.size)
    assert low < squares.sum() < high


def test_the_noise_of_the_orientation_turns_about_the_axes_of_the_imu():
    """Only about x of the IMU, which is mounted askew: the body's axis does not hide it."""
    values = {**scene_parameters('wavy'), 'imu.orientation_stddev': (0.1, 0.0, 0.0),
              'imu.rpy': (0.4, 1.2, -0.7), 'solver.method': 'exact'}
    simulation = simulate(values)
    taken = record(simulation, 'imu/data', 'ground_truth/imu')
    simulation.advance(SECOND)
    decode = stream(simulation, 'imu/data').template.decode
    noisy, exact = (Rotation.from_quat(np.vstack([decode(data)[0] for name, _, data in taken
                                                  if name == topic]))
                    for topic in ('imu/data', 'ground_truth/imu'))
    errors = (exact.inv() * noisy).as_rotvec()
    assert np.abs(errors[:, 1:]).max() < 1e-12
    assert np.std(errors[:, 0]) == pytest.approx(0.1, rel=4.0 / math.sqrt(2.0 * len(errors)))


# ----------------------------------------------------------------------------------- independence

def test_axes_sensors_samples_and_seeds_are_uncorrelated():
    """Over 1000 seeds; of m correlations the largest is below its bound but once in 10 000."""
    for name, (correlations, count) in statistics.correlations(range(1000)).items():
        bound = NormalDist().inv_cdf(1.0 - 0.5e-4 / correlations.size) / math.sqrt(count)
        assert np.abs(correlations).max() < bound, name


def test_a_log_with_every_error_is_verified(tmp_path):
    from spinning_top_sim.tools.inspect import main as inspect

    path, _ = recorded(tmp_path, {
        **ALL_BIASES, 'imu.gyroscope_noise_density': 1e-3, 'imu.orientation_stddev': (0.1,) * 3,
        'imu_data.enabled': True, 'mag.enabled': True, 'mag.noise_density': 1e-7,
        'mag.random_walk': 1e-8, 'imu_timing.enabled': True, 'imu.stamp_jitter': 1e-3,
        'imu.drop_rate': 0.3, 'imu.duplicate_rate': 0.3, 'imu.clock_drift': 50.0}, 3)
    assert inspect([str(path), '--verify']) == 0
