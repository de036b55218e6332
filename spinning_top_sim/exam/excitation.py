# SPDX-License-Identifier: Apache-2.0
"""A run without noise that excites one input at a time."""

import itertools
import math
import operator
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.scenarios import Run

# Turns about an axis of the sensor [deg], each followed by a rest; then one leads back, and a slow
# one to the motion.
TURNS = ((0, 80.0), (1, -70.0), (2, 100.0), (0, -110.0), (1, 85.0), (2, -75.0), (0, 95.0),
         (1, 110.0), (2, -120.0))
# Rates of these turns, and of the last one, so slow that a threshold would drop it or take it for
# a bias [rad/s].  It has a ripple, relative, because steady rates count as rest in some filters.
TURN_RATE, SLOW_RATE, RIPPLE = 2.6, 0.15, 0.3
FIRST_S, REST_S, MOTION_S = 6.0, 3.0, 16.0
# How long a kick is answered [s]; filters of long time constants are asked again.
ANSWER_S, LONG_ANSWER_S = 4.0, 20.0
# Some filters take no step while the rates are exactly zero [rad/s].
NEVER_ZERO = 1e-6
# Yaw, pitch and roll of the last rests [deg], the first of which is level, and a turn of the
# heading in the end.  The yaw passes 180 degrees in it, counted from the east or from the north.
LEVEL, DOWN = (30.0, 0.0, 0.0), (160.0, -40.0, 140.0)
ASTRAY, ASTRAY_S = np.radians(120.0), 0.5


# Turns of the gyroscope alone, about axes of the world [rad].  The heading comes first: the bias
# that a filter learns from a tilt may turn the heading for a while.
KICK_S, KICKS = 0.1, np.radians(0.7) * np.eye(3)[[2, 0, 1]]


class Excitation(NamedTuple):
    """Rests between turns, the slow motion, and kicks of the gyroscope alone at two rests."""

    run: Run                        # with the kicks
    still: Run                      # without them
    # Last sample of each rest; at the first and the last but one the attitude is the same.
    rests: NDArray[np.intp]
    turn_begins: NDArray[np.intp]   # first sample of each turn
    motion: slice                   # where the slow motion is judged
    kicks: list[list[int]]          # first sample of each of KICKS at each of the last rests
    answer_s: float                 # from each of KICKS to the next one [s]
    astray: slice                   # where the heading has been turned far off, up to the end


def excite(imu: Mapping[str, Any], goes_astray: bool, answer_s: float = ANSWER_S) -> Excitation:
    """
    Return the run for the IMU's place and field, sampled at the rate of the slow motion.

    goes_astray : whether the heading is turned far off at the end; a filter that goes on would
        begin its next run there
    """
    rate = scenarios.SLOW.rate
    motion = scenarios.record(replace(scenarios.PIVOT, duration=MOTION_S), imu, 0)
    level = Rotation.identity()         # some filters begin with it
    goals = list(itertools.accumulate((Rotation.from_rotvec(
        math.radians(angle) * np.eye(3)[axis]) for axis, angle in TURNS), operator.mul))
    stops = Rotation.concatenate((level, *goals, level, motion.start))
    ways = (stops[:-1].inv() * stops[1:]).magnitude()
    ways[:-1] /= TURN_RATE
    ways[-1] /= SLOW_RATE
    lengths, rest, answer = (np.rint(seconds * rate).astype(int) for seconds in (
        ways, REST_S, answer_s))
    # Begin and end of each rest.
    ends = np.cumsum([FIRST_S * rate, *(lengths + 1 + rest)]).astype(int)
    begins = np.append(0, ends[1:] - rest)
    path = Slerp(np.ravel((begins, ends), 'F'), stops[np.repeat(np.arange(len(stops)), 2)])
    samples = np.arange(ends[-1] + 1.0)
    samples[ends[-2] + 1:begins[-1]:2] += RIPPLE
    lead = scenarios.along(path(samples), imu)
    end = len(lead.t) + len(motion.t)
    last = Rotation.concatenate((Rotation.from_quat(motion.truth[-1]), Rotation.from_euler(
        'ZYX', (LEVEL, DOWN), degrees=True)))
    ways = np.rint((last[:-1].inv() * last[1:]).magnitude() / TURN_RATE * rate)
    kicked = (1 + len(KICKS)) * answer
    knots = np.cumsum((0, ways[0], kicked, ways[1], kicked + answer)).astype(int)
    still = replace(scenarios.along(Slerp(knots, last[[0, 1, 1, 2, 2]])(
        np.arange(knots[-1] + 1)), imu).preceded_by(motion.preceded_by(lead)), name='excitation')
    still.gyroscope[:] += NEVER_ZERO
    run = replace(still, gyroscope=still.gyroscope.copy())
    kicks = [(end + begin + answer * np.arange(1, 1 + len(KICKS))).tolist()
             for begin in knots[1::2]]
    for attitude, firsts in zip(last[1:], kicks, strict=True):
        for first, turn in zip(firsts, attitude.inv().apply(KICKS), strict=True):
            run.gyroscope[first:first + round(KICK_S * rate)] += turn / KICK_S
    far = slice(kicks[-1][-1] + answer, kicks[-1][-1] + answer + round(ASTRAY_S * rate))
    if goes_astray:
        run.gyroscope[far] += last[-1].inv().apply((0.0, 0.0, ASTRAY / ASTRAY_S))
    return Excitation(run, still, ends - 1, ends[:len(TURNS)],
                      slice(end - len(motion.t) // 2, end), kicks, answer_s,
                      slice(far.stop, None))
