# SPDX-License-Identifier: Apache-2.0
"""
The statistics of the sensors, seed by seed: what was commanded, estimated from what is read.

A seed fails where an estimate is further off than its own standard deviation allows in one of
some 1e5 seeds.  The estimators share nothing with the code under test.
"""

import math

import numpy as np
from helpers.reference import scene_parameters
from helpers.simulations import MILLISECOND, SECOND, channel, read, run
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from spinning_top_sim.streams import noise

PATIENCE_S = 120.0
MEMORY_MB = 1500
SIGMAS = 5.5
KINDS = ('gyroscope', 'accelerometer')
IDENTITY = np.eye(3).ravel()


def check(seed, folder):
    """Raise where a statistic of this seed is off."""
    found, deviations, expected = calibration(seed)
    errors = (found - expected) / deviations
    assert np.abs(errors).max() < SIGMAS, errors
    for value in gauss_markov(seed):
        assert abs(value - 1.0) < 0.02 * SIGMAS / 3.0, value
    _, deviation = flicker(seed)
    assert np.abs(deviation - 1.0).max() < 0.15, deviation
    for squares in nees(seed, SECOND // 2):
        low, high = chdtri(squares.size, (1.0 - 1e-6, 1e-6))
        assert low < squares.sum() < high
    return 'as commanded'


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
