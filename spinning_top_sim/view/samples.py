# SPDX-License-Identifier: Apache-2.0
"""A top as published samples show it, from a running node or from a log."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.physics.pivot import Kinematics
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.topics import all_channels
from spinning_top_sim.times import NANOSECONDS, Times, period_ns
from spinning_top_sim.tools.survey import SampledStates, attitudes_of
from spinning_top_sim.view.source import Reals, Track

# The topics that tell the attitude, the one that tells most first.
TOPICS = ('ground_truth/odom', 'joint_states', 'pose', 'ground_truth/imu')
# Columns of a sample: attitude and rates, as in `survey`; place of the pivot.  NaN: not known.
MOTION, PLACE, WIDTH = slice(0, 7), slice(7, 10), 10


class SampledTrack(Track):
    """The samples of a top."""

    def __init__(self, values: Mapping[str, Any], epoch_ns: int = 0) -> None:
        super().__init__(values, epoch_ns=epoch_ns)
        self.stamps_ns, self.rows = np.empty(0, np.int64), np.empty((0, WIDTH))
        self._imu = Imu(values, period_ns(values['imu.rate']))
        self.templates = {channel.topic: channel.template for channel in all_channels(
            values, self._imu) if channel.topic in TOPICS}

    def times(self, begin_ns: int, end_ns: int, step_ns: int) -> Times:
        begin, end = np.searchsorted(self.stamps_ns, [begin_ns + self.epoch_ns,
                                                      end_ns + self.epoch_ns + 1])
        times = self.stamps_ns[begin:end] - self.epoch_ns
        stride = max(1, step_ns * len(times) // (end_ns - begin_ns + 1))
        return times[(len(times) - 1) % stride::stride]

    def newest(self, t_ns: int) -> int | None:
        index = int(np.searchsorted(self.stamps_ns, t_ns + self.epoch_ns, 'right')) - 1
        return None if index < 0 else int(self.stamps_ns[index]) - self.epoch_ns

    def pivot_moves(self, t_ns: int) -> bool:
        index = int(np.searchsorted(self.stamps_ns, t_ns + self.epoch_ns))
        places = np.nan_to_num(self.rows[max(index - 1, 0):index + 1, PLACE])
        return bool(np.diff(places, axis=0).any())

    def at(self, times: Times) -> SampledStates:
        rows = self.rows[np.searchsorted(self.stamps_ns, times + self.epoch_ns)].T
        states = SampledStates(self.top, times / NANOSECONDS, rows[MOTION])
        place = np.nan_to_num(rows[PLACE])
        states.pivot = Kinematics(place, 0.0 * place, 0.0 * place)
        return states

    @property
    def span(self) -> tuple[int, int]:
        """The times of the first and the last sample, if there are samples."""
        return int(self.stamps_ns[0]) - self.epoch_ns, int(self.stamps_ns[-1]) - self.epoch_ns

    def add(self, stamps_ns: Times, rows: Reals) -> None:
        """Add samples with stamps (n,) [ns] in any order; of equal stamps the first is kept."""
        self.stamps_ns, order = np.unique(np.concatenate((self.stamps_ns, stamps_ns)),
                                          return_index=True)
        self.rows = np.concatenate((self.rows, rows))[order]
        if len(order) > 1:
            self.least_step_ns = int(np.ptp(self.stamps_ns)) // (len(order) - 1)

    def add_messages(self, topic: str, messages: Sequence[bytes]) -> None:
        """Add messages of one of TOPICS, but those whose quaternion is no attitude."""
        template, data = self.templates[topic], b''.join(messages)
        stamps, fields = template.stamps_ns(data), template.decode(data)
        known_ns, samples = attitudes_of(topic, self._imu, stamps, fields)
        place = np.full((len(known_ns), 3), np.nan)
        if topic in ('pose', 'ground_truth/odom'):
            place = fields[0][np.isin(stamps, known_ns)]
        self.add(known_ns, np.column_stack((samples[MOTION].T, place)))

    def drop_before(self, stamp_ns: int) -> None:
        """Drop the samples before a stamp [ns]."""
        kept = self.stamps_ns >= stamp_ns
        self.stamps_ns, self.rows = self.stamps_ns[kept], self.rows[kept]
