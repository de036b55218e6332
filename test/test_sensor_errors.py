# SPDX-License-Identifier: Apache-2.0
"""
Every error of the IMU, recovered from what it reads.

The estimators share nothing with the code under test.  A seed fails where an estimate is further
off than its own standard deviation allows in one of some 1e5 seeds; SEEDS=300 in the environment
tries so many.
"""

import math
import os
from statistics import NormalDist

import numpy as np
import pytest
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, SECOND, channel, read, run
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from spinning_top_sim.streams import noise

SIGMAS = 5.5
KINDS = ('gyroscope', 'accelerometer')
IDENTITY = np.eye(3).ravel()
# Two commands, so that the spin is not one constant that a bias could be mistaken for.
EXCITED = {**scene_parameters('wavy'), 'solver.method': 'exact', 'imu.rpy': (0.4, -0.9, 1.3),
           'imu.lever_arm': (0.3, -0.2, 0.4)}
COMMANDS = ((3 * SECOND, 'command', {'l3': 1.0, 'lz': 0.8}),
            (6 * SECOND, 'command', {'l3': 2.4, 'lz': 1.9}))


def calibration(seed):
    """
    Return what least squares find in a run, their standard deviations, and what was commanded.

    Matrices, g-sensitivity and biases of the IMU, soft and hard iron [uT] of the magnetometer.
    """
    rng = np.random.default_rng(seed)
    rate_matrix, force_matrix = IDENTITY + 0.03 * rng.standard_normal((2, 9))
    sensitivity, soft = 3e-3 * rng.standard_normal(9), IDENTITY + 0.1 * rng.standard_normal(9)
    hard = 3e-5 * rng.standard_normal(3)
    _, found = run({
        **EXCITED, 'seed': seed, 'imu.gyroscope_M': rate_matrix.tolist(),
        'imu.accelerometer_M': force_matrix.tolist(), 'imu.gyroscope_A': sensitivity.tolist(),
        'imu.gyroscope_noise_density': 2e-4, 'imu.accelerometer_noise_density': 3e-3,
        'imu.gyroscope_turn_on_bias': 0.02, 'imu.accelerometer_turn_on_bias': 0.1,
        'mag.soft_iron': soft.tolist(), 'mag.hard_iron': hard.tolist(),
        'mag.noise_density': 2e-8}, 10 * SECOND, 'imu/data_raw', 'ground_truth/imu',
        'ground_truth/imu_bias', 'imu/mag', 'ground_truth/mag', events=COMMANDS)
    ((*_, read_rates, read_force), (*_, rates, force), (*_, rate_bias, force_bias),
     (_, _, read_field, _), (_, _, field, _)) = found.values()
    results = [[], [], []]
    for regressors, readings, commanded in (
            ((rates, force), read_rates, (rate_matrix, sensitivity, rate_bias[0])),
            ((force,), read_force, (force_matrix, force_bias[0])),
            ((1e6 * field,), 1e6 * read_field, (soft, 1e6 * hard))):
        *matrices, offset = commanded
        expected = np.vstack((*(matrix.reshape(3, 3).T for matrix in matrices), offset))
        ones = np.ones((len(readings), 1))
        for result, numbers in zip(results, (*least_squares(
                np.hstack((*regressors, ones)), readings), expected), strict=True):
            result.append(numbers.ravel())
    return map(np.concatenate, results)


def least_squares(regressors, readings):
    """Return coefficients, a column for each reading, and their standard deviations."""
    found, *_ = np.linalg.lstsq(regressors, readings, rcond=None)
    freedom = len(readings) - regressors.shape[1]
    variances = np.sum((readings - regressors @ found) ** 2, axis=0) / freedom
    unit = np.diag(np.linalg.inv(regressors.T @ regressors))
    return found, np.sqrt(np.outer(unit, variances))


def at_rest(seed, count, band=(1.0, 1000.0), **errors):
    """Return `count` readings at rest, a millisecond apart, with errors of both kinds of axes."""
    values = {f'imu.{kind}_{name}': value for kind in KINDS for name, value in errors.items()}
    return read({**values, 'imu.bias_instability_band': band, 'seed': seed},
                range(0, count * MILLISECOND, MILLISECOND))[0]


def gauss_markov(seed):
    """Return variance and correlation time over those commanded: 25 000 times of it, 6 axes."""
    time, lag = 0.01, 5
    rows = at_rest(seed, 250_000, bias_stddev=0.5, bias_correlation_time=time)
    variance = np.mean(rows ** 2)
    correlation = np.mean(rows[lag:] * rows[:-lag]) / variance
    return variance / 0.25, -lag * 1e-3 / math.log(correlation) / time


def flicker(seed):
    """Return averaging times [s] and the Allan deviation over the parameter, over the band."""
    band = (0.02, 0.5)
    rows = at_rest(seed, 200_000, band, bias_instability=0.3)
    samples = np.unique(np.round(np.geomspace(*band, 9) * 1000.0).astype(int))
    return samples * 1e-3, np.array([allan_deviation(rows, m) for m in samples]) / 0.3


def allan_deviation(rows, m):
    """Return the overlapping Allan deviation for averages of m samples, over all columns."""
    sums = np.vstack((np.zeros(rows.shape[1]), np.cumsum(rows, axis=0)))
    averages = (sums[m:] - sums[:-m]) / m
    return math.sqrt(0.5 * np.mean((averages[m:] - averages[:-m]) ** 2))


NOISY = {**scene_parameters('looping'), 'solver.method': 'exact', 'imu.rpy': (0.4, -0.9, 1.3),
         'imu.orientation_stddev': (0.01, 0.05, 0.002), 'imu.gyroscope_noise_density': 1e-3,
         'imu.accelerometer_noise_density': 2e-2, 'imu.gyroscope_resolution': 1e-2}


def nees(seed, duration_ns):
    """
    Return squares of errors over published deviations, whose mean is 1, (n, columns) each.

    Of the orientation, in the frame of the IMU, and of the readings in imu/data and imu/data_raw.
    """
    simulation, found = run({**NOISY, 'seed': seed}, duration_ns, 'imu/data', 'imu/data_raw',
                            'ground_truth/imu')
    exact = found.pop('ground_truth/imu')
    turned = (Rotation.from_quat(exact[2]).inv() * Rotation.from_quat(found['imu/data'][2]))
    squares = [turned.as_rotvec() ** 2 / covariances(simulation, 'imu/data')[:3]]
    for topic, fields in found.items():
        errors = np.hstack(fields[-2:]) - np.hstack(exact[-2:])
        squares.append(errors ** 2 / covariances(simulation, topic)[3:])
    return squares


def covariances(simulation, topic):
    """Return the variances in a sensor_msgs/Imu: of orientation, rates and force, (9,)."""
    template = channel(simulation, topic).template
    message = template.encode_one(0, *(np.zeros((1, one.size)) for one in template.fields))
    # Quaternion, rates and force come before nine numbers each.
    numbers = np.frombuffer(message, '<f8', 37, len(message) - 296)
    return np.concatenate([numbers[begin:begin + 9:4] for begin in (4, 16, 28)])


def correlations(seeds, count):
    """
    Return {between what: (correlations, how many products each is the mean of)}.

    Columns are white noise of every kind, and steps of the paths of biases; there are `count`
    numbers of each.
    """
    kinds, part, numbers, drawn = noise.Kind, noise.Part, np.arange(count), []
    for seed in seeds:
        columns = [noise.white(seed, kind, numbers) for kind in kinds]
        # Correlation times far below a step: every step is new.
        columns += [noise.RandomPath(seed, kind, one, ((1e-5, 1.0),)).at(numbers * MILLISECOND)
                    for kind in (kinds.GYROSCOPE, kinds.ACCELEROMETER, kinds.MAGNETOMETER)
                    for one in (part.WALK, part.GAUSS_MARKOV, part.FLICKER)]
        drawn.append(np.concatenate(columns))
    drawn = np.array(drawn)                     # (seeds, columns, numbers)

    def products(one, two):
        return np.einsum('ick,idk->cd', one, two) / one[:, 0].size, one[:, 0].size

    same, size = products(drawn, drawn)
    each = drawn.reshape(-1, count)
    return {'axes and sensors': (same[np.triu_indices(len(same), 1)], size),
            'neighbouring samples': products(drawn[:, :, 1:], drawn[:, :, :-1]),
            'seeds': ((each @ each.T)[np.triu_indices(len(each), 1)] / count, count)}


@pytest.mark.parametrize('seed', range(int(os.environ.get('SEEDS', '1'))))
def test_what_is_read_is_as_commanded(seed):
    """Matrices, g-sensitivity, biases and iron by least squares; the laws of random biases."""
    found, deviations, expected = calibration(seed)
    assert np.abs((found - expected) / deviations).max() < SIGMAS
    assert deviations[:33].max() < 3e-3 and deviations[33:].max() < 0.05
    for value in gauss_markov(seed):
        assert value == pytest.approx(1.0, abs=0.02 * SIGMAS / 3.0)
    _, deviation = flicker(seed)
    assert deviation == pytest.approx(1.0, abs=0.15)
    for squares in nees(seed, SECOND // 2):
        low, high = chdtri(squares.size, (1.0 - 1e-6, 1e-6))
        assert low < squares.sum() < high


def test_the_chain_by_hand():
    """Matrices, g-sensitivity, then rounding, then the range; no reading is beyond a grid code."""
    values = {'imu.gyroscope_M': (2.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0),
              'imu.gyroscope_A': (0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
              'imu.accelerometer_M': (1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0),
              'imu.gyroscope_resolution': 0.5, 'imu.gyroscope_range': 7.2,
              'imu.accelerometer_range': 10.5}
    rows, _ = read(values, range(0, 2, 1), ((1.0, 2.0, 9.0), (0.3, 4.0, 10.0)))
    # x: 2 + 1 + 2.5 = 5.5; z: -9 + 0.3 of the true force = -8.7, cut at the code 7.0 within 7.2.
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


def test_a_gauss_markov_bias_is_stationary():
    """At the start, at a second and after three years it has one variance: 2400 numbers each."""
    time = 3.0
    times_ns = np.array([0, SECOND, 94_608_000 * SECOND])
    rows = np.concatenate([noise.RandomPath(
        seed, noise.Kind.GYROSCOPE, noise.Part.GAUSS_MARKOV, ((time, 2.0),)).at(times_ns)
        for seed in range(800)])
    assert np.std(rows, axis=0) == pytest.approx(2.0, rel=4.0 / math.sqrt(2.0 * len(rows)))
    correlation = np.mean(rows[:, 0] * rows[:, 1]) / 4.0
    assert correlation == pytest.approx(math.exp(-1.0 / time), abs=4.0 / math.sqrt(len(rows)))


@pytest.mark.parametrize('lowest', [0.01, 1.0])
def test_the_law_of_a_flicker_bias_is_flat_for_every_band(lowest):
    """By the closed form of its Allan variance: within 6 % for ratios up to 1e6."""
    for ratio in np.geomspace(1.01, 1e6, 60):
        tau = np.geomspace(lowest, ratio * lowest, 400)
        variance = sum(scale ** 2 * 2.0 * time / tau * (1.0 - time / (2.0 * tau) * (
            3.0 - 4.0 * np.exp(-tau / time) + np.exp(-2.0 * tau / time)))
            for time, scale in noise.flicker_parts(lowest, ratio * lowest))
        assert np.sqrt(variance) == pytest.approx(1.0, rel=0.06)


def test_errors_are_distributed_as_published():
    """NEES of orientation and readings: chi-square of an axis, and in 100 parts of a run."""
    for found in nees(0, 50 * SECOND):
        low, high = chdtri(len(found), (1.0 - 1e-5, 1e-5))
        assert (low < found.sum(axis=0)).all() and (found.sum(axis=0) < high).all()
        parts = found[:10_000].reshape(100, -1)
        low, high = chdtri(parts.shape[1], (0.975, 0.025))
        # Binomial of 100 and 0.95: from 89 to 99 with 99 %.
        assert 89 <= np.count_nonzero(
            (low < parts.sum(axis=1)) & (parts.sum(axis=1) < high)) <= 99


def test_axes_sensors_samples_and_seeds_are_uncorrelated():
    """Near or far apart; of m correlations the largest is below its bound but once in 10 000."""
    seeds = (*range(7), 1000, 2 ** 32, 2 ** 63 - 1)
    for name, (found, count) in correlations(seeds, 4000).items():
        bound = NormalDist().inv_cdf(1.0 - 0.5e-4 / found.size) / math.sqrt(count)
        assert np.abs(found).max() < bound, name
