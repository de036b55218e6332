# SPDX-License-Identifier: Apache-2.0
"""The stamps of an IMU, and the number of messages that are sent for each of its samples."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import numpy as np

from spinning_top_sim.streams import noise
from spinning_top_sim.times import NANOSECONDS, Times

# Jitter is cut at this share of the period, so that no stamp is before that of an earlier sample.
MOST_JITTER = 0.45
FAULTS = ('imu.stamp_offset', 'imu.stamp_jitter', 'imu.clock_drift', 'imu.drop_rate',
          'imu.duplicate_rate')


class Timing:
    """
    The clock of an IMU, and its losses, by seed, number and time of a sample alone.

    period_ns : of its samples [ns]
    is_right : whether there are no faults
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        self._seed, self._period_ns = values['seed'], period_ns
        self._offset_ns = round(values['imu.stamp_offset'] * NANOSECONDS)
        self._jitter_ns = values['imu.stamp_jitter'] * NANOSECONDS
        self._drift = values['imu.clock_drift'] * 1e-6
        # A standard normal number is below these with the probability of the fault.
        self._dropped_below, self._repeated_below = (
            NormalDist().inv_cdf(rate) if rate else -np.inf
            for rate in (values['imu.drop_rate'], values['imu.duplicate_rate']))
        self.is_right = not any(map(values.get, FAULTS))

    def __call__(self, t_ns: Times) -> tuple[Times, Times]:
        """
        Return how late the stamps of samples at times (n,) are [ns], and how often each is sent.

        The latter is 0, 1 or 2.
        """
        jitter, drop, repeat = noise.white(self._seed, noise.Kind.TIMING, noise.Part.WHITE,
                                           t_ns // self._period_ns)
        most = MOST_JITTER * self._period_ns
        errors = self._drift * t_ns + np.clip(self._jitter_ns * jitter, -most, most)
        return self._offset_ns + np.rint(errors).astype(np.int64), np.where(
            drop < self._dropped_below, 0, np.where(repeat < self._repeated_below, 2, 1))
