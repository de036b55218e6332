# SPDX-License-Identifier: Apache-2.0
"""Every error of the IMU and the magnetometer, recovered from what they read."""

import math
from statistics import NormalDist

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, SECOND, run
from scipy.spatial.transform import Rotation

from spinning_top_sim.streams import noise, parameters
from spinning_top_sim.streams.imu import Imu

KINDS = ('gyroscope', 'accelerometer')
SENSITIVITY, *others = 0.03 * np.random.default_rng(1).standard_normal((4, 3, 3))
M_RATES, M_FORCE, SOFT_IRON = np.eye(3) + others
HARD_IRON = np.array((1e-5, -3e-5, 2e-5))
NOISY = {**scene_parameters('looping'), 'solver.method': 'exact', 'imu.rpy': (0.4, -0.9, 1.3),
         'imu.lever_arm': (0.3, -0.2, 0.4), 'imu.orientation_stddev': (0.01, 0.05, 0.002),
         'imu.gyroscope_M': M_RATES.ravel().tolist(), 'imu.gyroscope_noise_density': 2e-4,
         'imu.accelerometer_M': M_FORCE.ravel().tolist(), 'imu.accelerometer_noise_density': 3e-3,
         'imu.gyroscope_A': SENSITIVITY.ravel().tolist(), 'imu.gyroscope_random_walk': 2e-4,
         'imu.gyroscope_turn_on_bias': 0.02, 'imu.accelerometer_turn_on_bias': 0.1,
         'mag.soft_iron': SOFT_IRON.ravel().tolist(), 'mag.hard_iron': HARD_IRON.tolist(),
         'mag.noise_density': 2e-8}


def test_readings_are_the_truth_with_the_errors_and_the_noise_that_is_left_is_white():
    _, found = run(NOISY, 50 * SECOND, 'imu/data_raw', 'imu/data', 'ground_truth/imu',
                   'ground_truth/imu_bias', 'imu/mag', 'ground_truth/mag')
    ((*_, read_rates, read_force), (_, _, estimated, *_), (_, _, attitude, rates, force),
     (*_, rate_bias, force_bias), (_, _, read_field, _), (_, _, field, _)) = found.values()
    turned = Rotation.from_quat(attitude).inv() * Rotation.from_quat(estimated)
    for noise_left, deviation in (
            (read_rates - rates @ M_RATES.T - force @ SENSITIVITY.T - rate_bias,
             2e-4 * math.sqrt(200.0)),
            (read_force - force @ M_FORCE.T - force_bias, 3e-3 * math.sqrt(200.0)),
            (read_field - field @ SOFT_IRON.T - HARD_IRON, 2e-8 * math.sqrt(100.0)),
            (turned.as_rotvec(), (0.01, 0.05, 0.002))):
        count = len(noise_left)
        assert np.std(noise_left, axis=0) / deviation == pytest.approx(
            np.ones(3), rel=4.5 / math.sqrt(2.0 * count))
        assert np.abs(noise_left.mean(axis=0) / deviation).max() < 4.5 / math.sqrt(count)


SENSORS = ('imu.gyroscope_', 'imu.accelerometer_', 'mag.')
NO_ERROR = (0.0, 3 * (0.0,), 9 * (0.0,), parameters.IDENTITY)


@pytest.mark.parametrize('name', [
    one.name for one in parameters.TABLE
    if one.name.startswith(SENSORS) and one.kind is float and one.default in NO_ERROR])
def test_each_error_alone_is_in_the_readings_of_its_sensor(name):
    """So `is_perfect` knows of all."""
    none = parameters.BY_NAME[name].default
    value = tuple(one + 1e-7 for one in none) if isinstance(none, tuple) else 1e-7
    _, found = run({**scene_parameters('looping'), name: value}, 50 * MILLISECOND, 'imu/data_raw',
                   'ground_truth/imu', 'imu/mag', 'ground_truth/mag')
    (*_, rates, force), (*_, true_rates, true_force), (*_, field, _), (*_, true, _) = (
        found.values())
    assert [not np.array_equal(*pair) for pair in (
        (rates, true_rates), (force, true_force), (field, true))] == [
            name.startswith(sensor) for sensor in SENSORS]


def read(values, times_ns, exact=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
    """Return what an IMU with a sample at each of these times reads, and its bias, (n, 6) each."""
    imu, shape = Imu(parameters.checked(values), times_ns.step), (3, len(times_ns))
    errors = imu.errors(np.asarray(times_ns))
    return (np.vstack([np.broadcast_to(one, shape) for one in imu.read(exact, errors)]).T,
            np.vstack([np.broadcast_to(bias, shape) for _, bias in errors]).T)


def at_rest(count, band=(1.0, 1000.0), **errors):
    """Return `count` readings at rest, a millisecond apart, with errors of both kinds of axes."""
    values = {f'imu.{kind}_{name}': value for kind in KINDS for name, value in errors.items()}
    return read({**values, 'imu.bias_instability_band': band},
                range(0, count * MILLISECOND, MILLISECOND))[0]


def test_a_gauss_markov_bias_has_its_variance_and_correlation_from_the_start_on():
    """Over 25 000 times of it, 6 axes; at the start and after three years."""
    time, lag = 0.01, 5
    rows = at_rest(250_000, bias_stddev=0.5, bias_correlation_time=time)
    variance = np.mean(rows ** 2)
    correlation = np.mean(rows[lag:] * rows[:-lag]) / variance
    assert variance / 0.25 == pytest.approx(1.0, abs=0.04)
    assert -lag * 1e-3 / math.log(correlation) / time == pytest.approx(1.0, abs=0.04)
    times_ns = np.array([0, 94_608_000 * SECOND])
    rows = np.concatenate([noise.RandomPath(
        seed, noise.Kind.GYROSCOPE, noise.Part.GAUSS_MARKOV, ((3.0, 2.0),)).at(times_ns)
        for seed in range(300)])
    assert np.std(rows, axis=0) == pytest.approx(2.0, rel=4.0 / math.sqrt(2.0 * len(rows)))


def allan_deviation(rows, m):
    """Return the overlapping Allan deviation for averages of m samples, over all columns."""
    sums = np.vstack((np.zeros(rows.shape[1]), np.cumsum(rows, axis=0)))
    averages = (sums[m:] - sums[:-m]) / m
    return math.sqrt(0.5 * np.mean((averages[m:] - averages[:-m]) ** 2))


def test_the_allan_deviation_of_a_flicker_bias_is_flat():
    """By the closed form of the law within 6 % for ratios up to 1e6, and in what is drawn."""
    for lowest in (0.01, 1.0):
        for ratio in np.geomspace(1.01, 1e6, 60):
            tau = np.geomspace(lowest, ratio * lowest, 400)
            variance = sum(scale ** 2 * 2.0 * time / tau * (1.0 - time / (2.0 * tau) * (
                3.0 - 4.0 * np.exp(-tau / time) + np.exp(-2.0 * tau / time)))
                for time, scale in noise.flicker_parts(lowest, ratio * lowest))
            assert np.sqrt(variance) == pytest.approx(1.0, rel=0.06)
    band = (0.02, 0.5)
    rows = at_rest(200_000, band, bias_instability=0.3)
    samples = np.unique(np.round(np.geomspace(*band, 9) * 1000.0).astype(int))
    found = np.array([allan_deviation(rows, m) for m in samples])
    assert found / 0.3 == pytest.approx(1.0, abs=0.15)


def test_the_chain_by_hand():
    """Matrices, g-sensitivity, then rounding, then the range; no reading is beyond a grid code."""
    values = {'imu.gyroscope_M': (2.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0),
              'imu.gyroscope_A': (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
              'imu.accelerometer_M': (1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0),
              'imu.gyroscope_resolution': 0.5, 'imu.gyroscope_range': 7.3,
              'imu.accelerometer_range': 10.5}
    rows, _ = read(values, range(0, 2, 1), ((1.0, 2.0, 9.0), (0.3, 4.0, 10.0)))
    # x: 2 + 1 + 2.5 = 5.5; z: -9 + 0.3 of the true force = -8.7, cut at the code 7.0 within 7.3.
    assert rows.tolist() == 2 * [[5.5, 2.0, -7.0, 10.3, 10.5, 10.0]]


def test_the_bias_begins_with_the_turn_on_bias_and_walks_with_its_density():
    walk = {'imu.gyroscope_random_walk': 2e-4, 'imu.accelerometer_random_walk': 3e-3}
    turn_on = {'imu.gyroscope_turn_on_bias': 0.01, 'imu.accelerometer_turn_on_bias': 0.05}
    times = range(0, 200 * SECOND, 5 * MILLISECOND)
    _, biases = read(walk, times)
    assert np.all(biases[0] == 0.0)
    _, constant = read(turn_on, times[:1000])
    assert np.all(constant == constant[0]) and np.all(constant[0] != 0.0)
    assert np.array_equal(read({**walk, **turn_on}, times[:1000])[1], constant + biases[:1000])
    # A random walk at every scale, and no seam between the blocks in which it is drawn.
    deviations = np.repeat([2e-4, 3e-3], 3) * math.sqrt(0.005)
    for apart in (1, 10, 100, 1000):
        far = (biases[apart:] - biases[:-apart])[::apart]
        assert np.std(far, axis=0) == pytest.approx(
            deviations * math.sqrt(apart), rel=5.0 / math.sqrt(2.0 * len(far)))
    seams = np.flatnonzero(np.diff(np.arange(40_000) * 5 // 512))
    assert np.abs(np.diff(biases, axis=0)[seams] / deviations).max() < 5.0


def test_axes_sensors_samples_and_seeds_are_uncorrelated():
    """Of all correlations the largest is below its bound but once in 10 000."""
    kinds, part, numbers, drawn = noise.Kind, noise.Part, np.arange(4000), []
    for seed in (0, 1, 2 ** 63 - 1):
        drawn += [noise.white(seed, kind, numbers) for kind in kinds]
        # Correlation times far below a step: every step is new.
        drawn += [noise.RandomPath(seed, kind, one, ((1e-5, 1.0),)).at(numbers * MILLISECOND)
                  for kind in (kinds.GYROSCOPE, kinds.ACCELEROMETER, kinds.MAGNETOMETER)
                  for one in (part.WALK, part.GAUSS_MARKOV, part.FLICKER)]
    columns = np.concatenate(drawn)
    found = np.corrcoef(np.vstack((columns[:, 1:], columns[:, :-1])))   # neighbours, too
    found = found[np.triu_indices(len(found), 1)]
    bound = NormalDist().inv_cdf(1.0 - 0.5e-4 / found.size) / math.sqrt(len(numbers))
    assert np.abs(found).max() < bound
