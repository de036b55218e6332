# SPDX-License-Identifier: Apache-2.0
"""The magnetometer: directions, disturbances, and noise by its numbers."""

import math

import numpy as np
import pytest
from helpers.simulations import MILLISECOND, SECOND, run

STANDING = {'initial.theta': 0.0, 'spin.l3': 0.0, 'spin.lz': 0.0, 'solver.method': 'exact'}
ALONG = {'E': 1e-6, 'N': 20e-6, 'U': -40e-6, 'W': -1e-6, 'S': -20e-6, 'D': 40e-6}
QUARTER = 0.5 * math.pi


@pytest.mark.parametrize(('values', 'axes'), [
    # Roll, pitch and yaw of the IMU, and where its x, y and z then point: East, North, Up, West...
    ({}, 'ENU'), ({'imu.rpy': (2.0 * QUARTER, 0.0, QUARTER)}, 'NED'),
    ({'imu.rpy': (0.0, -QUARTER, -QUARTER)}, 'UEN'),
    # The body lies with its axis to the north, x of the body down: theta = phi = 90 deg.
    ({'initial.theta': QUARTER, 'initial.phi': QUARTER}, 'DWN'),
    ({'initial.psi': QUARTER}, 'NWU')])
def test_each_axis_reads_the_field_along_it(values, axes):
    _, found = run({**STANDING, 'mag.field': (1e-6, 20e-6, -40e-6), **values}, 0,
                   'imu/mag', 'ground_truth/mag')
    for _, _, field, _ in found.values():
        assert field == pytest.approx(np.array([[ALONG[axis] for axis in axes]]), abs=1e-19)


def test_noise_has_the_covariance_that_is_published_at_each_rate():
    _, found = run({**STANDING, 'mag.noise_density': 1e-7, 'mag.resolution': 1.5e-7}, 200 * SECOND,
                   'imu/mag', 'ground_truth/mag', events=[
                       (100 * SECOND, 'parameters', {'mag.rate': 50.0})])
    (_, _, field, covariances), (_, _, exact, (known, *_)) = found.values()
    for rows, rate in ((slice(10_001), 100.0), (slice(10_001, None), 50.0)):
        errors, variance = (field - exact)[rows], 1e-14 * rate + 1.5e-7 ** 2 / 12.0
        assert np.abs(covariances[rows] - np.diag(3 * [variance]).ravel()).max() < 1e-9 * variance
        assert np.var(errors) == pytest.approx(variance, abs=0.0, rel=0.05)
    assert known[[0, 4, 8]].tolist() == 3 * [1e-18]


def test_disturbances_begin_and_end():
    turned = {**STANDING, 'initial.psi': QUARTER, 'mag.field': (0.0, 2e-5, -4e-5)}
    values = {**turned, 'mag.disturbance.world': (0.1, 0.2, 3e-6, 0.0, 0.0),
              'mag.disturbance.body': (0.15, 0.3, 0.0, 0.0, 5e-6, 0.2, 0.25, 1e-6, 0.0, 0.0)}
    _, found = run(values, SECOND, 'imu/mag', 'ground_truth/mag')
    (times_ns, _, field, _), (_, _, exact, _) = found.values()
    k = times_ns // (10 * MILLISECOND)
    # The body's x axis points north, its y axis west.
    expected = np.stack((np.where((k >= 20) & (k < 25), 1e-6, 0.0),
                         np.where((k >= 10) & (k < 20), -3e-6, 0.0),
                         np.where((k >= 15) & (k < 30), 5e-6, 0.0)), axis=-1)
    assert field - exact == pytest.approx(expected, abs=1e-19)
