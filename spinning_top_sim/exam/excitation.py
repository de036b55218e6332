# SPDX-License-Identifier: Apache-2.0
"""A run without noise that excites one input at a time, and the response to the gyroscope."""

import itertools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.hypotheses import AXES
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import Outcome

# Turns about an axis of the sensor [deg], each followed by a rest; the last one leads back.
TURNS = ((0, 80.0), (1, -70.0), (2, 100.0), (0, -110.0), (1, 85.0), (2, -75.0), (0, 95.0),
         (1, 110.0), (2, -120.0))
TURN_RATE = 2.6                 # [rad/s]
FIRST_S, REST_S, ANSWER_S, MOTION_S = 6.0, 3.0, 4.0, 16.0
WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its response; the longest delay
# Some filters take no step while the rates are exactly zero [rad/s].
NEVER_ZERO = 1e-6
# Of the gyroscope only, about axes of the world.  Of two kicks with opposite headings the mean
# tells the tilt, and half the difference the heading.
KICK_S, KICK, OTHER_KICK = 0.1, np.radians((0.7, 0.0, 0.7)), np.array((1.0, 1.0, -1.0))


class Excitation(NamedTuple):
    """
    Rests between turns, the slow motion, and two kicks of the gyroscope alone at rest.

    run : with the kicks
    still : without them
    rests : index of the last sample of each rest (n,); the first and the last but one are equal
    turns : index of the first sample of each turn (n,)
    motion : where the slow motion is judged
    kicks : index of the first sample of each kick
    """

    run: Run
    still: Run
    rests: NDArray[np.intp]
    turns: NDArray[np.intp]
    motion: slice
    kicks: tuple[int, int]


def excite(imu: Mapping[str, Any]) -> Excitation:
    """Return the run for the IMU's place and field, sampled at the rate of the slow motion."""
    rate = scenarios.SLOW.rate
    motion = scenarios.record(replace(scenarios.PIVOT, duration=MOTION_S), imu, 0)
    goals = list(itertools.accumulate((Rotation.from_rotvec(
        math.radians(angle) * np.eye(3)[axis]) for axis, angle in TURNS), operator.mul))
    level = Rotation.identity()
    stops = Rotation.concatenate((level, *goals, level, motion.start))
    ways = (stops[:-1].inv() * stops[1:]).magnitude()
    lengths, rest, answer = (np.rint(seconds * rate).astype(int) for seconds in (
        ways / TURN_RATE, REST_S, ANSWER_S))
    # Begin and end of each rest.
    ends = np.cumsum([FIRST_S * rate, *(lengths + 1 + rest)]).astype(int)
    begins = np.append(0, ends[1:] - rest)
    path = Slerp(np.ravel((begins, ends), 'F'), stops[np.repeat(np.arange(len(stops)), 2)])
    lead = scenarios.along(path(np.arange(ends[-1] + 1)), imu)
    end = len(lead.t) + len(motion.t)
    last = np.tile(motion.truth[-1], (3 * answer + 1, 1))
    still = replace(scenarios.along(Rotation.from_quat(last), imu).preceded_by(
        motion.preceded_by(lead)), name='excitation')
    still.gyroscope[:] += NEVER_ZERO
    run = replace(still, gyroscope=still.gyroscope.copy())
    kicks = end + answer, end + 2 * answer
    for first, kick in zip(kicks, Rotation.from_quat(last[0]).inv().apply(
            (KICK, OTHER_KICK * KICK)), strict=True):
        run.gyroscope[first:first + round(KICK_S * rate)] += kick / KICK_S
    return Excitation(run, still, ends - 1, ends[:len(TURNS)],
                      slice(end - len(motion.t) // 2, end), kicks)


def gyroscope_of(outcome: Outcome, turns: NDArray[np.intp]) -> tuple[Reals, Reals, int]:
    """
    Fit the response to the gyroscope: increments of the attitude over those of the sensor.

    Returns two matrices (3, 3) from whole turns and from their begins, the identity for a right
    filter, and the delay in samples that leaves least of whole turns.
    """
    estimated, true = increments(outcome.estimates), increments(outcome.run.truth)

    def fit(length: int, late: int) -> tuple[Reals, float]:
        rows = (turns[:, np.newaxis] + np.arange(length)).ravel()
        given, response = true[rows - late], estimated[rows]
        matrix = np.linalg.lstsq(given, response, rcond=None)[0]
        return matrix.T, rms(response - given @ matrix)

    fits = [fit(WHOLE, late) for late in range(LATEST + 1)]
    late = int(np.argmin([left for _, left in fits]))
    return fits[late][0], fit(EARLY, 0)[0], late


def from_identity(*matrices: Reals) -> float:
    """Return how far the nearest of some matrices is from the identity."""
    return float(min(np.max(np.abs(matrix - np.eye(3))) for matrix in matrices))


def affine_of(readings: Reals, estimated: Rotation, level: Sequence[int],
              first: int) -> tuple[Reals, float]:
    """
    Fit the affine change of readings (n, 3) that attitudes at rest show.

    level : axes of the world along which changed readings are zero
    first : of the entries of matrix and offset that differ from the identity's

    Returns the change (4, 4) in homogeneous coordinates, and the share of the error that is left.
    """
    across = np.concatenate([estimated.inv().apply(np.eye(3)[axis]) for axis in level])
    readings = np.tile(readings, (len(level), 1))
    matrix = np.hstack(((across[:, :, np.newaxis] * readings[:, np.newaxis]).reshape(-1, 9),
                        across))
    wanted = -np.sum(across * readings, axis=1)
    # The readings have no scale: the trace remains.
    rows = np.vstack((matrix, 10.0 * np.append(np.eye(3), np.zeros(3))))[:, first:]
    found = np.linalg.lstsq(rows, np.append(wanted, 0.0), rcond=1e-3)[0]
    entries = np.append(np.zeros(first), found)
    change = np.eye(4)
    change[:3] += np.hstack((entries[:9].reshape(3, 3), entries[9:, np.newaxis]))
    change[:3] /= np.median(np.diag(change)[:3])    # most axes are right
    return change, rms(matrix @ entries - wanted) / max(rms(wanted), 1e-6)


def words(matrix: Reals) -> str:
    """Return in words how a matrix (3, 3) of the gyroscope differs from the identity."""
    large = 0.5 * np.max(np.abs(matrix - np.eye(3)))
    return '; '.join(
        f'a rate about {AXES[k]} turns it ' + (' and '.join(
            f'{column[j]:+.3g} times about {AXES[j]}' for j in range(3)
            if abs(column[j] - (j == k)) >= large and column[j]) or 'not at all')
        for k, column in enumerate(matrix.T) if np.max(np.abs(column - np.eye(3)[k])) >= large)
