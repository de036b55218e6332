# SPDX-License-Identifier: Apache-2.0
"""What the top does between two samples of the IMU, across commands."""

from collections import deque
from functools import reduce
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import integrals
from spinning_top_sim.physics.integrals import Increments
from spinning_top_sim.physics.states import Point
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.parameters import LOWEST_RATE_OF_INTERVALS
from spinning_top_sim.streams.segment import Segment

LONGEST_NS = round(NANOSECONDS / LOWEST_RATE_OF_INTERVALS)
NOTHING = range(0)
NO_JUMP = 3 * (np.zeros(1),)


class Intervals:
    """
    The intervals between the samples of an IMU: of a sample at t, [t - length, t).

    The first one is empty, as the motion begins with the first sample.  After a change of the rate
    the first one begins with the last sample of the old rate, so that none of the motion is left
    out.  An interval may contain commands.  Before a command the motion is that of the earlier
    segment; its impulsive torque lets the velocity of the lever arm's end jump, and the jump
    belongs to the interval that contains it, with its begin and without its end.

    length_ns : of an interval, the period of the IMU [ns]
    """

    def __init__(self, lever_arm: Point, length_ns: int, now_ns: int) -> None:
        self._lever_arm, self.length_ns = lever_arm, length_ns
        # When the present rate began, and where the first interval after that begins [ns]: steps
        # before the first look at the motion may be forgotten.
        self._since_ns = self._first_begin_ns = max(now_ns, 0)
        self._segments: deque[Segment] = deque()
        self._newest: tuple[range, Increments | None] = NOTHING, None

    def follow(self, segment: Segment) -> None:
        """Go on with another segment; further calls with the same one change nothing."""
        if self._segments and self._segments[-1] is segment:
            return
        self._segments.append(segment)
        self._keep_steps()
        while len(self._segments) > 1 and (
                self._segments[1].start_ns < segment.start_ns - segment.kept_ns):
            self._segments.popleft()

    def set_length(self, length_ns: int, now_ns: int) -> None:
        """Let the intervals after `now_ns` have another length."""
        if length_ns != self.length_ns:
            now_ns = max(now_ns, 0)
            last_ns = now_ns // self.length_ns * self.length_ns
            if last_ns <= self._since_ns:       # no sample since the change before this one
                last_ns = self._first_begin_ns
            self._since_ns, self._first_begin_ns = now_ns, max(last_ns, now_ns - LONGEST_NS)
            self.length_ns = length_ns
            self._keep_steps()

    @property
    def change(self) -> tuple[int, int]:
        """When the present rate began, and where the first interval after that begins [ns]."""
        return self._since_ns, self._first_begin_ns

    @change.setter
    def change(self, times_ns: tuple[int, int]) -> None:
        self._since_ns, self._first_begin_ns = times_ns
        self._keep_steps()

    def _keep_steps(self) -> None:
        self._segments[-1].kept_ns = (
            min(self.length_ns, LONGEST_NS) + self._since_ns - self._first_begin_ns)
        self._newest = NOTHING, None

    def lengths(self, times: range) -> NDArray[np.float64]:
        """Return the lengths (n,) [s] of the intervals that end at these times [ns]."""
        return np.array([time - self._begin_ns(time) for time in times]) * 1e-9

    def _begin_ns(self, end_ns: int) -> int:
        begin_ns = end_ns - self.length_ns
        return begin_ns if begin_ns > self._since_ns else self._first_begin_ns

    def increments(self, times: range) -> Increments:
        """Return the increments over the intervals that end at these times [ns]."""
        known, result = self._newest        # streams of one rate ask for the same ones
        if known != times or result is None:
            # Those that may be shorter, or contain a command, are computed one by one.
            since_ns = self._since_ns
            if len(self._segments) > 1:
                since_ns = max(since_ns, self._segments[-1].start_ns)
            single = len(range(times.start, since_ns + self.length_ns + 1, times.step))
            parts = [self._over(time, 1, times.step) for time in times[:single]]
            if single < len(times):
                parts.append(self._over(times[single], len(times) - single, times.step))
            result = parts[0] if len(parts) == 1 else Increments(*(
                np.concatenate(rows, axis=1) for rows in zip(*parts, strict=True)))
            self._newest = times, result
        return result

    def _over(self, end_ns: int, count: int, step_ns: int) -> Increments:
        """Return the increments over intervals with the same parts, the first of which ends."""
        begin_ns = self._begin_ns(end_ns)
        pieces: list[Increments] = []
        for number, segment in enumerate(self._segments):
            start_ns = segment.start_ns
            if number and start_ns >= begin_ns:
                moment = range(start_ns, start_ns + 1)
                before, after = (one.states(moment).velocity(self._lever_arm)
                                 for one in (self._segments[number - 1], segment))
                pieces.append(integrals.impulse(
                    (after[0] - before[0], after[1] - before[1], after[2] - before[2])))
            from_ns, until_ns = max(begin_ns, start_ns), end_ns
            if number + 1 < len(self._segments):
                until_ns = min(until_ns, self._segments[number + 1].start_ns)
            if from_ns < until_ns:
                begins = range(from_ns, from_ns + count * step_ns, step_ns)
                pieces += self._within(segment, begins, until_ns - from_ns)
        return reduce(Increments.then, pieces or [integrals.impulse(NO_JUMP)])

    def _within(self, segment: Segment, begins: range, length_ns: int) -> list[Increments]:
        """Return the increments over consecutive parts of intervals within a segment."""
        rate = integrals.fastest_rate(segment.solver.top, segment.l3, segment.energy)
        count = integrals.panels(rate, length_ns)
        edges = [length_ns * k // count for k in range(count + 1)]
        return [integrals.increments(
            segment.states, range(begins.start + begin, begins.stop + begin, begins.step),
            end - begin, self._lever_arm, rate) for begin, end in pairwise(edges)]
