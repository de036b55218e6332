# SPDX-License-Identifier: Apache-2.0
"""What goes wrong between a sample and its message: wrong stamps, lost and repeated messages."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams import noise
from spinning_top_sim.streams.cdr import LAST_STAMP_NS, NANOSECONDS

Integers = NDArray[np.int64]
# Of the period: jitter is cut there, so that no stamp is before that of an earlier sample.
MOST_JITTER = 0.45


class Timing:
    """
    The stamps of an IMU, and how many messages each of its samples becomes.

    The clock of the IMU has an offset, a drift and a jitter.  All three depend on the seed, the
    number of the sample and its time alone.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._seed = values['seed']
        self._offset_ns = round(values['imu.stamp_offset'] * NANOSECONDS)
        self._jitter_ns = values['imu.stamp_jitter'] * NANOSECONDS
        self._drift = values['imu.clock_drift'] * 1e-6
        # Normal numbers below these: with such a probability.
        self._dropped_below, self._repeated_below = (
            NormalDist().inv_cdf(rate) if rate else -np.inf
            for rate in (values['imu.drop_rate'], values['imu.duplicate_rate']))

    def stamps_ns(self, epoch_ns: int, t_ns: Integers, period_ns: int) -> Integers:
        """Return the stamps [ns] of the samples at these times; epoch_ns is that of t = 0."""
        jitter, _, _ = self._draw(t_ns, period_ns)
        most = MOST_JITTER * period_ns
        errors = self._drift * t_ns + np.clip(self._jitter_ns * jitter, -most, most)
        stamps: Integers = epoch_ns + self._offset_ns + t_ns + np.rint(errors).astype(np.int64)
        return np.clip(stamps, 0, LAST_STAMP_NS)

    def copies(self, t_ns: Integers, period_ns: int) -> Integers:
        """Return how often the samples at these times are sent: 0, 1 or 2 times."""
        _, drop, repeat = self._draw(t_ns, period_ns)
        return np.where(drop < self._dropped_below, 0,
                        np.where(repeat < self._repeated_below, 2, 1))

    def _draw(self, t_ns: Integers, period_ns: int) -> noise.Rows:
        return noise.white(self._seed, noise.Purpose.TIMING, t_ns // period_ns, 3)
