# SPDX-License-Identifier: Apache-2.0
"""Wrong stamps, lost and repeated messages of the IMU, and the topic that tells the truth."""

import math
from collections import Counter

import numpy as np
import pytest
from helpers.simulations import EPOCH_NS, SECOND, run

from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.sensor import Timing

FAULTS = {'imu.stamp_offset': -0.02, 'imu.stamp_jitter': 3e-4, 'imu.clock_drift': 200.0,
          'imu.drop_rate': 0.1, 'imu.duplicate_rate': 0.05}
PERIOD_NS = 5_000_000


def test_each_message_is_labelled_with_its_true_time():
    _, found = run({**FAULTS, 'solver.method': 'exact'}, 30 * SECOND, 'ground_truth/imu_timing',
                   'imu/data_raw', 'imu/data', 'ground_truth/imu')
    (*_, labels), *sent, (times_ns, true_stamps, *_, exact_rates, _) = found.values()
    whole = labels.astype(np.int64)
    assert np.array_equal(whole, labels)
    stamps, true, copies = (whole[:, 0] * SECOND + whole[:, 1], whole[:, 2] * SECOND + whole[:, 3],
                            whole[:, 4])
    assert np.array_equal(true, EPOCH_NS + PERIOD_NS * np.arange(6001))
    assert np.array_equal(true, true_stamps) and np.all(np.diff(stamps) > 0)
    # All messages, with those lost left out and those repeated twice; values are of the true time.
    for sent_ns, sent_stamps, *_, rates, _ in sent:
        assert np.array_equal(sent_stamps, np.repeat(stamps, copies))
        assert np.array_equal(EPOCH_NS + sent_ns, np.repeat(true, copies))
        assert np.array_equal(rates, exact_rates[np.searchsorted(times_ns, sent_ns)])
    # Offset and drift by a straight line.
    t = (true - true[0]) * 1e-9
    regressors, errors = np.stack((np.ones(len(t)), t), axis=1), (stamps - true) * 1e-9
    line, *_ = np.linalg.lstsq(regressors, errors, rcond=None)
    jitter = np.std(errors - regressors @ line)
    deviations = jitter * np.sqrt(np.diag(np.linalg.inv(regressors.T @ regressors)))
    assert np.abs((line - (-0.02, 200e-6)) / deviations).max() < 3.0
    assert jitter == pytest.approx(3e-4, rel=4.0 / math.sqrt(2.0 * len(t)))


def test_one_imu_has_one_clock_and_one_noise_at_whatever_rate_it_is_read():
    noise = {'imu.gyroscope_noise_density': 2e-4, 'imu.gyroscope_random_walk': 2e-4}
    _, found = run({**FAULTS, **noise, 'imu_data.rate': 100.0, 'increments.enabled': True},
                   3 * SECOND, 'imu/data_raw', 'imu/data', 'imu/dq', 'imu/dv')
    (raw_ns, *raw), (times_ns, *data), *increments = found.values()
    for one in increments:
        assert np.array_equal(one[:2], (raw_ns, raw[0])), 'times and stamps'
    both = raw_ns % (2 * PERIOD_NS) == 0
    assert np.array_equal(raw_ns[both], times_ns)
    for column in (0, -2, -1):          # stamps, rates and forces
        assert np.array_equal(raw[column][both], data[column])


def test_losses_and_repetitions_have_their_rates_and_are_independent():
    timing, other = (Timing(parameters.checked({**FAULTS, 'seed': seed}), PERIOD_NS)
                     for seed in (0, 1))
    t_ns = np.arange(0, 200_000 * PERIOD_NS, PERIOD_NS)
    copies = timing(t_ns)[1]
    assert np.corrcoef(copies, other(t_ns)[1])[0, 1] < 4.0 / math.sqrt(len(t_ns))
    counts, n = Counter(copies.tolist()), len(copies)
    for value, share in ((0, 0.1), (2, 0.9 * 0.05)):
        assert counts[value] / n == pytest.approx(share, abs=4.0 * math.sqrt(share / n))
        is_it = (copies == value) - share
        assert abs(np.mean(is_it[1:] * is_it[:-1])) < 4.0 * share / math.sqrt(n)


@pytest.mark.parametrize(('rate', 'drift'), [(1.0, 1e4), (10_000.0, -1e4)])
def test_no_jitter_puts_a_stamp_before_an_earlier_one(rate, drift):
    period_ns = round(SECOND / rate)
    timing = Timing(parameters.checked({'imu.stamp_jitter': 1.0, 'imu.clock_drift': drift}),
                    period_ns)
    for start in (0, 94_608_000 * SECOND // period_ns):
        t_ns = (start + np.arange(20_000)) * period_ns
        stamps = t_ns + timing(t_ns)[0]
        assert np.diff(stamps).min() > 0
        assert np.ptp(stamps - np.polyval((1.0 + drift * 1e-6, 0.0), t_ns)) > 0.5 * period_ns
