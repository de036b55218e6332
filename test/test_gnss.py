# SPDX-License-Identifier: Apache-2.0
"""The satellite receiver: its place on Earth, noise, delay and outages, from logs."""

import math

import numpy as np
import pytest
from helpers.simulations import SECOND, run

pymap3d = pytest.importorskip('pymap3d')

TOPICS = FIX, VELOCITY, TRUE_FIX, TRUE_VELOCITY = (
    'gnss/fix', 'gnss/velocity', 'ground_truth/gnss/fix', 'ground_truth/gnss/velocity')
ORIGIN = (48.14, 11.58, 520.0)
# Forth and back along a slanted line, for ever.
SHUTTLE = {'gnss.enabled': True, 'solver.method': 'exact', 'pivot.speed': 3.0,
           'pivot.waypoints': (0.0, 0.0, 0.0, 40.0, 20.0, 5.0), 'pivot.repeat': True}
NOISY = {**SHUTTLE, 'gnss.position_noise': (1.5, 3.0), 'gnss.velocity_noise': (0.05, 0.1),
         'gnss.latency': 0.12, 'gnss.outages': (100.0, 120.0, 200.05, 200.15)}
PERIOD_NS = SECOND // 10


def enu(fixes):
    """Return positions (n, 3) in the world [m]."""
    return np.stack(pymap3d.geodetic2enu(*fixes.T, *ORIGIN), axis=-1)


@pytest.fixture(scope='module')
def noisy():
    return run(NOISY, 400 * SECOND, *TOPICS)


def test_the_truth_is_the_path_of_the_pivot_on_the_ellipsoid(noisy):
    simulation, found = noisy
    t_ns, stamps_ns, _, fixes, *_ = found[TRUE_FIX]
    assert np.array_equal(stamps_ns - simulation.epoch_ns, t_ns)
    assert np.array_equal(t_ns, np.arange(4001) * PERIOD_NS)
    simulation, _ = run(SHUTTLE, -1)
    place = simulation.trajectory.pivot_at(t_ns)
    assert enu(fixes) == pytest.approx(place.position.T, abs=1e-7)
    assert np.array_equal(found[TRUE_VELOCITY][2], place.velocity.T)
    assert np.linalg.norm(place.velocity, axis=0).max() == pytest.approx(3.0, rel=1e-6)


def test_noise_is_white_with_the_standard_deviations(noisy):
    _, found = noisy
    for topic, exact, field, convert, levels in (
            (FIX, TRUE_FIX, 3, enu, (1.5, 1.5, 3.0)),
            (VELOCITY, TRUE_VELOCITY, 2, np.asarray, (0.05, 0.05, 0.1))):
        stamps_ns, measured = found[topic][1:field + 1:field - 1]
        known = np.isin(found[exact][1], stamps_ns)
        errors = (convert(measured) - convert(found[exact][field][known])) / levels
        errors = errors[np.isfinite(errors).all(axis=1)]
        bound = 4.0 / math.sqrt(len(errors))
        assert len(errors) > 3700 and np.abs(errors.mean(axis=0)).max() < bound
        assert np.abs(np.corrcoef(errors[1:].T, errors[:-1].T) - np.eye(6)).max() < bound
        assert np.std(errors, axis=0) == pytest.approx(np.ones(3), rel=bound / math.sqrt(2.0))


def test_delay_and_outages_are_exact(noisy):
    _, found = noisy
    t_ns, stamps_ns, status, fixes, covariance, kind = found[FIX]
    assert set(t_ns - (stamps_ns - found[TRUE_FIX][1][0])) == {120_000_000}
    valid_ns = t_ns - 120_000_000
    assert np.array_equal(valid_ns, np.arange(len(t_ns)) * PERIOD_NS)
    is_out = ((valid_ns >= 100 * SECOND) & (valid_ns < 120 * SECOND)) | (
        valid_ns == 200_100_000_000)
    assert np.array_equal(np.isnan(fixes), np.repeat(is_out[:, np.newaxis], 3, axis=1))
    # sensor_msgs: no fix and an unknown covariance, else a fix with the diagonal known.
    assert np.array_equal(status[:, 0], np.where(is_out, -1, 0))
    assert np.array_equal(kind[:, 0], np.where(is_out, 0, 2))
    known = np.diag((1.5 ** 2, 1.5 ** 2, 3.0 ** 2)).ravel()
    assert np.array_equal(covariance, np.where(is_out[:, np.newaxis], 0.0, known))
    assert np.array_equal(found[VELOCITY][0] - 120_000_000, valid_ns[~is_out])


def test_a_late_fix_is_where_the_pivot_was_before_it_was_driven():
    _, found = run(
        {'gnss.enabled': True, 'gnss.latency': 0.5, 'gnss.rate': 50.0}, 3 * SECOND, *TOPICS,
        events=[(SECOND, 'drive', {'x': 1.0, 'y': 0.0, 'z': 0.0, 'stop_ns': 3 * SECOND // 2})])
    measured, exact = found[VELOCITY][2], found[TRUE_VELOCITY][2]
    assert np.array_equal(measured, exact[:len(measured)]) and measured.max() > 0.5
