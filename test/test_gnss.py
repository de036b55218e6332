# SPDX-License-Identifier: Apache-2.0
"""The satellite receiver: its place on Earth, noise, delay and outages, from logs."""

import math

import numpy as np
import pytest
from helpers.simulations import SECOND, run

pymap3d = pytest.importorskip('pymap3d')

FIX, VELOCITY = 'gnss/fix', 'gnss/velocity'
TRUE_FIX, TRUE_VELOCITY = 'ground_truth/gnss/fix', 'ground_truth/gnss/velocity'
TOPICS = FIX, VELOCITY, TRUE_FIX, TRUE_VELOCITY
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
    return run(NOISY, 400 * SECOND, *TOPICS)[1]


def test_the_truth_is_the_path_of_the_pivot_on_the_ellipsoid():
    simulation, found = run({**SHUTTLE, 'gnss.latency': 0.3}, 60 * SECOND, TRUE_FIX, TRUE_VELOCITY)
    t_ns, stamps_ns, _, fixes, *_ = found[TRUE_FIX]
    assert np.array_equal(stamps_ns - simulation.epoch_ns, t_ns)
    assert np.array_equal(t_ns, np.arange(601) * PERIOD_NS)
    position, velocity = enu(fixes), found[TRUE_VELOCITY][2]
    # Along the line between the waypoints, from one to the other, at 3 m/s at most.
    line = np.array((40.0, 20.0, 5.0))
    share = position @ line / (line @ line)
    assert position == pytest.approx(share[:, np.newaxis] * line, abs=1e-7)
    assert (share.min(), share.max()) == pytest.approx((0.0, 1.0), abs=1e-3)
    assert np.linalg.norm(velocity, axis=1).max() == pytest.approx(3.0, rel=1e-6)
    # The rule of Simpson is exact for a piecewise quadratic path, but where its pieces meet.
    middle = (position[2:] - position[:-2]) / (2.0 * PERIOD_NS * 1e-9)
    error = np.linalg.norm(middle - (velocity[2:] + 4.0 * velocity[1:-1] + velocity[:-2]) / 6.0,
                           axis=1)
    assert np.median(error) < 1e-6 and error.max() < 0.05


def test_noise_is_white_with_the_standard_deviations(noisy):
    for topic, exact, field, convert, levels in (
            (FIX, TRUE_FIX, 3, enu, (1.5, 1.5, 3.0)),
            (VELOCITY, TRUE_VELOCITY, 2, np.asarray, (0.05, 0.05, 0.1))):
        stamps_ns, measured, truth = noisy[topic][1], noisy[topic][field], noisy[exact][field]
        is_valid = np.isfinite(measured).all(axis=1)
        known_ns = noisy[exact][1]
        errors = (convert(measured[is_valid])
                  - convert(truth[np.isin(known_ns, stamps_ns[is_valid])]))
        count = len(errors)
        assert count > 3700
        assert np.std(errors, axis=0) == pytest.approx(levels, rel=4.0 / math.sqrt(2.0 * count))
        assert np.abs(errors.mean(axis=0) / levels).max() < 4.0 / math.sqrt(count)
        assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 4.0 / math.sqrt(count)
        assert np.abs((errors[1:] * errors[:-1]).mean(axis=0) / np.square(levels)).max() < (
            4.0 / math.sqrt(count))


def test_delay_and_outages_are_exact(noisy):
    t_ns, stamps_ns, status, fixes, covariance, kind = noisy[FIX]
    late_ns = t_ns - (stamps_ns - noisy[TRUE_FIX][1][0])
    assert (late_ns.min(), late_ns.max()) == (120_000_000, 120_000_000)
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
    velocity_ns = noisy[VELOCITY][0] - 120_000_000
    assert np.array_equal(velocity_ns, valid_ns[~is_out])


def test_a_late_fix_is_where_the_pivot_was_before_it_was_driven():
    _, found = run(
        {'gnss.enabled': True, 'gnss.latency': 0.5, 'gnss.rate': 50.0}, 3 * SECOND, *TOPICS,
        events=[(SECOND, 'drive', {'x': 1.0, 'y': 0.0, 'z': 0.0, 'stop_ns': 3 * SECOND // 2})])
    for topic, exact in ((FIX, TRUE_FIX), (VELOCITY, TRUE_VELOCITY)):
        count = len(found[topic][1])
        for one, true in zip(found[topic][1:], found[exact][1:], strict=True):
            assert np.array_equal(one, true[:count])
    assert found[VELOCITY][2].max() > 0.5
