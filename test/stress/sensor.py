# SPDX-License-Identifier: Apache-2.0
"""
The statistics of the sensors, seed by seed: what was commanded, estimated from what is read.

A seed fails where an estimate is further off than its own standard deviation allows in one of
some 1e5 seeds.  The estimators share nothing with the code under test.
"""

import math

import numpy as np
from helpers.reference import scene_parameters
from helpers.sensor_logs import recorded
from helpers.simulations import SECOND, record, simulate
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from spinning_top_sim.streams import noise, parameters
from spinning_top_sim.streams.imu import Sensor

PATIENCE_S = 120.0
MEMORY_MB = 1500
SIGMAS = 5.5
KINDS = ('gyroscope', 'accelerometer')
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
IDENTITY = np.eye(3).ravel()


def check(seed, folder):
    """Raise where a statistic of this seed is off."""
    found, deviations, expected = calibration(seed, folder)
    assert np.abs((found - expected) / deviations).max() < SIGMAS, (found, expected, deviations)
    found, deviations, expected = magnetic_calibration(seed, folder)
    assert np.abs((found - expected) / deviations).max() < SIGMAS, (found, expected, deviations)
    for value in white_and_walk(seed):
        assert abs(value - 1.0) < 0.03, value
    for value in gauss_markov(seed):
        assert abs(value - 1.0) < 0.02 * SIGMAS / 3.0, value
    _, deviation = flicker(seed, (0.05, 5.0))
    assert np.abs(deviation - 1.0).max() < 0.15, deviation
    squares, _ = orientation_nees([seed])
    low, high = chi2.ppf((1e-6, 1.0 - 1e-6), 3 * squares.size)
    assert low < squares.sum() < high
    for topic in ('imu/data_raw', 'imu/data'):
        squares = readings_nees([seed], topic)
        low, high = chi2.ppf((1e-6, 1.0 - 1e-6), squares.size)
        assert low < squares.sum() < high
    return 'as commanded'


# ---------------------------------------------------------------------------- from recorded logs

# Two commands, so that the spin is not one constant that a bias could be mistaken for.
EXCITED = {**scene_parameters('wavy'), 'solver.method': 'exact', 'imu.rpy': (0.4, -0.9, 1.3),
           'imu.lever_arm': (0.3, -0.2, 0.4), 'imu.rate': 200.0, 'ground_truth_imu.rate': 200.0,
           'pose.enabled': False, 'joint_states.enabled': False, 'invariants.enabled': False,
           'ground_truth_odom.enabled': False}
COMMANDS = ('--command', '3:1.0:0.8', '--command', '6:2.4:1.9')


def calibration(seed, folder):
    """Return matrices, g-sensitivity and biases of a log: found, their deviations, commanded."""
    rng = np.random.default_rng(seed)
    rate_matrix, force_matrix = IDENTITY + 0.03 * rng.standard_normal((2, 9))
    sensitivity = 3e-3 * rng.standard_normal(9)
    noises = (2e-4, 3e-3)
    _, log = recorded(folder, {
        **EXCITED, 'seed': seed, 'imu.gyroscope_M': tuple(rate_matrix.tolist()),
        'imu.accelerometer_M': tuple(force_matrix.tolist()),
        'imu.gyroscope_A': tuple(sensitivity.tolist()),
        'imu.gyroscope_noise_density': noises[0], 'imu.accelerometer_noise_density': noises[1],
        'imu.gyroscope_turn_on_bias': 0.02, 'imu.accelerometer_turn_on_bias': 0.1}, 10, *COMMANDS)
    read, exact = log['imu/data_raw'][2], log['ground_truth/imu'][2]
    bias = log['ground_truth/imu_bias'][2][0]
    ones = np.ones((len(exact), 1))
    rates = least_squares(np.hstack((exact[:, 4:], ones)), read[:, 4:7])
    force = least_squares(np.hstack((exact[:, 7:], ones)), read[:, 7:])
    expected = [np.vstack((rate_matrix.reshape(3, 3).T, sensitivity.reshape(3, 3).T, bias[4:7])),
                np.vstack((force_matrix.reshape(3, 3).T, bias[7:]))]
    return tuple(np.concatenate([np.ravel(part) for part in parts])
                 for parts in ((rates[0], force[0]), (rates[1], force[1]), expected))


def magnetic_calibration(seed, folder):
    """Return soft and hard iron of a log: found, their deviations, commanded [uT]."""
    rng = np.random.default_rng([seed, 1])
    soft, hard = IDENTITY + 0.1 * rng.standard_normal(9), 3e-5 * rng.standard_normal(3)
    _, log = recorded(folder, {
        **EXCITED, 'seed': seed, 'imu.enabled': False, 'ground_truth_imu.enabled': False,
        'mag.enabled': True, 'mag.soft_iron': tuple(soft.tolist()),
        'mag.hard_iron': tuple(hard.tolist()), 'mag.noise_density': 2e-8}, 10, *COMMANDS)
    exact, read = (1e6 * log[topic][2] for topic in ('ground_truth/mag', 'imu/mag'))
    found, deviations = least_squares(np.hstack((exact, np.ones((len(exact), 1)))), read)
    expected = np.vstack((soft.reshape(3, 3).T, 1e6 * hard))
    return found.ravel(), deviations.ravel(), expected.ravel()


def least_squares(regressors, readings):
    """Return coefficients, a column for each reading, and their standard deviations."""
    found, *_ = np.linalg.lstsq(regressors, readings, rcond=None)
    freedom = len(readings) - regressors.shape[1]
    variances = np.sum((readings - regressors @ found) ** 2, axis=0) / freedom
    unit = np.diag(np.linalg.inv(regressors.T @ regressors))
    return found, np.sqrt(np.outer(unit, variances))


# ------------------------------------------------------------------------- from a sensor at rest

def at_rest(seed, count, period_ns, **errors):
    """Return what is read at rest, (count, 6), with the same errors for both kinds of axes."""
    values = {f'imu.{kind}_{name}': value for kind in KINDS for name, value in errors.items()
              if name != 'band'}
    if 'band' in errors:
        values['imu.bias_instability_band'] = errors['band']
    sensor = Sensor(parameters.checked({**values, 'seed': seed}), period_ns)
    times = range(0, count * period_ns, period_ns)
    rates, force = sensor.read(STILL, times)
    return np.column_stack((*rates, *force))


def white_and_walk(seed):
    """Return densities of white noise and walk over those commanded."""
    white = at_rest(seed, 10_000, 5_000_000, noise_density=0.3)
    walk = at_rest(seed, 10_000, 5_000_000, random_walk=0.7)
    return (float(np.std(white)) * math.sqrt(0.005) / 0.3,
            float(np.std(np.diff(walk, axis=0))) / math.sqrt(0.005) / 0.7)


def gauss_markov(seed):
    """Return variance and correlation time over those commanded: 25 000 times of it, 6 axes."""
    time, lag = 0.02, 10
    rows = at_rest(seed, 500_000, 1_000_000, bias_stddev=0.5, bias_correlation_time=time)
    variance = np.mean(rows ** 2)
    correlation = np.mean(rows[lag:] * rows[:-lag]) / variance
    return variance / 0.25, -lag * 1e-3 / math.log(correlation) / time


def flicker(seed, band):
    """Return averaging times [s] and the Allan deviation over the parameter, over the band."""
    rows = at_rest(seed, 200_000, 10_000_000, bias_instability=0.3, band=band)
    samples = np.unique(np.round(np.geomspace(band[0], band[1], 9) / 0.01).astype(int))
    return samples * 0.01, np.array([allan_deviation(rows, m) for m in samples]) / 0.3


def allan_deviation(rows, m):
    """Return the overlapping Allan deviation for averages of m samples, over all columns."""
    sums = np.vstack((np.zeros(rows.shape[1]), np.cumsum(rows, axis=0)))
    averages = (sums[m:] - sums[:-m]) / m
    return math.sqrt(0.5 * np.mean((averages[m:] - averages[:-m]) ** 2))


# ------------------------------------------------------------------- against published covariances

NOISY = {**scene_parameters('looping'), 'solver.method': 'exact', 'imu.rpy': (0.4, -0.9, 1.3),
         'imu.orientation_stddev': (0.01, 0.05, 0.002), 'imu.gyroscope_noise_density': 1e-3,
         'imu.accelerometer_noise_density': 2e-2, 'imu.gyroscope_resolution': 1e-2}


def messages(seed, *topics):
    """Return the numbers of half a second of messages: {topic: (n, 37)} with covariances."""
    simulation = simulate({**NOISY, 'seed': seed})
    taken = record(simulation, *topics)
    simulation.advance(SECOND // 2)
    return {topic: np.array([np.frombuffer(data, '<f8', 37, len(data) - 296) for name, _, data
                             in taken if name == topic]) for topic in topics}


def orientation_nees(seeds):
    """Return the squares (seeds, samples), and how many seeds are in their own 95 % band."""
    squares = []
    for seed in seeds:
        found = messages(seed, 'imu/data', 'ground_truth/imu')
        noisy, exact = (Rotation.from_quat(rows[:, :4]) for rows in found.values())
        errors = (exact.inv() * noisy).as_rotvec()
        covariance = found['imu/data'][0, 4:13].reshape(3, 3)
        squares.append(np.sum(errors @ np.linalg.inv(covariance) * errors, axis=1))
    squares = np.array(squares)
    low, high = chi2.ppf((0.025, 0.975), 3 * squares.shape[1])
    totals = squares.sum(axis=1)
    return squares, int(np.sum((low < totals) & (totals < high)))


def readings_nees(seeds, topic):
    """Return the squares of errors over published deviations (seeds, samples, 6)."""
    squares = []
    for seed in seeds:
        found = messages(seed, topic, 'ground_truth/imu')
        rows, exact = found.values()
        errors = (rows - exact)[:, [13, 14, 15, 25, 26, 27]]
        squares.append(errors ** 2 / rows[0, [16, 20, 24, 28, 32, 36]])
    return np.array(squares)


# ----------------------------------------------------------------------------------- independence

def correlations(seeds):
    """
    Return {between what: (correlations, how many products each is the mean of)}.

    Columns are the axes of gyroscope, accelerometer, orientation and magnetometer, the numbers of
    timing, and steps of the paths of a Gauss-Markov and a flicker bias.
    """
    count, purpose = 40, noise.Purpose
    numbers = np.arange(500, 500 + count)       # across a seam of what is drawn together
    rows = []
    for seed in seeds:
        columns = [noise.white(seed, one, numbers, width) for one, width in (
            (purpose.WHITE, 6), (purpose.ORIENTATION, 3), (purpose.MAG_WHITE, 3),
            (purpose.TIMING, 3))]
        # Correlation times far below a step: every step is new.
        columns += [noise.Path(seed, one, (3 * (1e-5,),), (3 * (1.0,),)).at(numbers * 1_000_000)
                    for one in (purpose.GAUSS_MARKOV, purpose.FLICKER, purpose.WALK)]
        rows.append(np.concatenate(columns))
    drawn = np.array(rows)                      # (seeds, columns, numbers)

    def products(one, two):
        return np.einsum('ick,idk->cd', one, two) / one[:, 0].size, one[:, 0].size

    same, size = products(drawn, drawn)
    return {'axes and sensors': (same[np.triu_indices(len(same), 1)], size),
            'neighbouring samples': products(drawn[:, :, 1:], drawn[:, :, :-1]),
            'neighbouring seeds': products(drawn[1:], drawn[:-1])}
