# SPDX-License-Identifier: Apache-2.0
"""The time between two samples of the IMU, and what the top does in it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import Point
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.parameters import LOWEST_RATE_OF_INTERVALS
from spinning_top_sim.streams.path import Path, Segment

LONGEST_NS = round(NANOSECONDS / LOWEST_RATE_OF_INTERVALS)


@dataclass(frozen=True)
class Intervals:
    """
    The intervals [t - length, t) that end with the samples of an IMU.

    The first one is empty, as the motion begins with the first sample.  After a change of the rate
    the first one begins with the last sample of the old rate, so that no motion is left out.

    length_ns : period of the IMU [ns]
    since_ns : when this rate began [ns]
    first_begin_ns : where the first interval after that begins [ns]
    """

    length_ns: int
    since_ns: int = 0
    first_begin_ns: int = 0

    def changed(self, length_ns: int, now_ns: int) -> 'Intervals':
        """Return the intervals after a change of the rate at `now_ns`."""
        last_ns = now_ns // self.length_ns * self.length_ns
        if last_ns <= self.since_ns:        # no sample since the change before this one
            last_ns = self.first_begin_ns
        return Intervals(length_ns, now_ns, max(last_ns, now_ns - LONGEST_NS))

    @property
    def keep_ns(self) -> int:
        """The time before a sample that its interval may need [ns]."""
        return min(self.length_ns, LONGEST_NS) + self.since_ns - self.first_begin_ns

    def begin_ns(self, end_ns: int) -> int:
        """Return where the interval that ends with a sample begins [ns]."""
        begin_ns = end_ns - self.length_ns
        return begin_ns if begin_ns > self.since_ns else self.first_begin_ns

    def lengths(self, times: range) -> NDArray[np.float64]:
        """Return the lengths (n,) [s] of the intervals that end at these times [ns]."""
        return np.array([time - self.begin_ns(time) for time in times]) * 1e-9

    def increments(self, path: Path, parts: Sequence[tuple[Segment, range]],
                   point: Point) -> Increments:
        """Return the increments over the intervals that end at times in segments [ns]."""
        found: list[Increments] = []
        for segment, times in parts:
            # Those that may be shorter, or contain a command, are computed one by one.
            since_ns = max(self.since_ns, segment.start_ns)
            single = len(range(times.start, since_ns + self.length_ns + 1, times.step))
            found += [path.increments(self.begin_ns(end_ns), end_ns, point)
                      for end_ns in times[:single]]
            if single < len(times):
                first_ns = times[single]
                found.append(path.increments(self.begin_ns(first_ns), first_ns, point,
                                             len(times) - single, times.step))
        return found[0] if len(found) == 1 else Increments(*(
            np.concatenate(rows, axis=1) for rows in zip(*found, strict=True)))
