# SPDX-License-Identifier: Apache-2.0
"""
What a constant bias of the gyroscope does to a filter, and what the filter says of it.

A right filter either has no estimate of it, and its error stays at the bias times its time
constant; or it learns it, and error and estimate are right in the end.  Evidence against it is an
estimate that has settled elsewhere or moves away, an error that has settled beside an estimate,
and one that grows faster and faster.  What still moves cannot be judged.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.measures import up
from spinning_top_sim.exam.motions import NEAR, STILL, X_UP, Motion, Reals, Run, euler

# Of the gyroscope [rad/s], 0.7 deg/s in all: so large are those of consumer devices at power-on.
BIAS = np.array((0.006, -0.0055, 0.009))
RESTS_S = 20.0, 80.0    # a filter that still moves gets the longer one
LEFT = 0.3              # share that may be left: integrals that leak keep as much
STEADY = 0.01           # what changes by less in half of a rest has settled


class Course(NamedTuple):
    """
    About a level axis in a rest, from the begin to the end: gravity shows these errors.

    error : of the attitude, by the bias (n,) [rad]
    apart : of the reported bias from the true one, over it (m,); empty: there is none
    """

    axis: int
    error: Reals
    apart: Reals

    @property
    def left(self) -> float:
        """What is left of the largest error in the end; errors below STILL are none."""
        return last(self.error) / float(np.max(self.error)) if last(self.error) > STILL else 0.0


class Effects(NamedTuple):
    """The courses about x and y in a rest, y and z in another, and what is reported last (3,)."""

    courses: Sequence[Course]
    said: Reals


def effects(feed: Callable[[Sequence[Run]], list[Outcome]]) -> Effects:
    """Return the effects of a bias in rests that are as long as the filter needs."""
    for seconds in RESTS_S:
        motion = Motion(euler(NEAR)).rest(seconds).turn(euler(X_UP)).rest(seconds)
        run = motion.run('no bias')
        without, outcome = feed([run, replace(run, name='bias', gyroscope=run.gyroscope + BIAS)])
        # About axes of the sensor, because the heading may drift.
        tilt = np.abs(np.cross(up(without.estimates), up(outcome.estimates)))
        courses = []
        for part, axes in zip(motion.of('rest'), ((0, 1), (1, 2)), strict=True):
            told = outcome.biases[part.begin:part.end]
            told = np.abs(told[np.isfinite(told[:, 0])] / BIAS - 1.0)
            error = tilt[part.begin:part.end]
            courses += [Course(axis, error[:, axis], told[:, axis]) for axis in axes]
        if all(last(one.apart) <= LEFT and one.left <= LEFT if len(one.apart)
               else settled(one.error) for one in courses):
            break
    known = outcome.biases[np.isfinite(outcome.biases[:, 0])]
    return Effects(courses, known[-1] if len(known) else np.empty(0))


def last(course: Reals) -> float:
    """Return the largest value in the last quarter."""
    return float(np.max(course[3 * len(course) // 4:]))


def settled(course: Reals) -> bool:
    """Return whether a course has come to an end, be it the right one or not."""
    half = course[len(course) // 2:]
    return bool(np.ptp(half) <= STEADY * np.max(half))


def growth(course: Reals) -> float:
    """
    Return the largest value of the second half over that of the first.

    It is at most 2 where a course from 0 grows slower and slower, as in a filter of first order.
    """
    first, second = np.array_split(course, 2)
    return float(np.max(second) / max(np.max(first), STILL))
