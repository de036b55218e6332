# SPDX-License-Identifier: Apache-2.0
"""
Every error of the IMU, recovered from what it reads.

The estimators share nothing with the code under test.  All seeds are fixed; bounds are in standard
deviations of the estimate.  `python test/stress sensor` does the same for many seeds.
"""

import math
from statistics import NormalDist

import numpy as np
import pytest
from helpers.simulations import MILLISECOND, SECOND, read
from scipy.special import chdtri
from stress import sensor as statistics

from spinning_top_sim.streams import noise


def test_what_a_seed_reads_is_as_commanded():
    """Matrices, g-sensitivity, biases, iron, correlation time, flat of the Allan deviation."""
    statistics.check(0, None)


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


def test_a_gauss_markov_bias_is_stationary(time=3.0):
    """At the start, at a second and after three years it has one variance: 2400 numbers each."""
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
    for found in statistics.nees(0, 50 * SECOND):
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
    for name, (correlations, count) in statistics.correlations(seeds, 4000).items():
        bound = NormalDist().inv_cdf(1.0 - 0.5e-4 / correlations.size) / math.sqrt(count)
        assert np.abs(correlations).max() < bound, name
