# SPDX-License-Identifier: Apache-2.0
"""A run without noise that shows one input at a time, and the answer to the gyroscope on it."""

import itertools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.exam.trial import ChangeReadings, Outcome

AXES = 'xyz'
# Turns about an axis of the sensor [deg], each followed by a rest; the last one leads back.
TURNS = ((0, 80.0), (1, -70.0), (2, 100.0), (0, -110.0), (1, 85.0), (2, -75.0), (0, 95.0),
         (1, 110.0), (2, -120.0))
TURN_RATE = 2.6                 # [rad/s]
FIRST_S, REST_S, ANSWER_S, MOTION_S = 6.0, 3.0, 4.0, 16.0
WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its answer; the longest delay
# Some filters take no step while the rates are exactly zero [rad/s].
NEVER_ZERO = 1e-6
KICK_S, KICK = 0.1, np.radians((0.7, 0.0, 0.7))     # of the gyroscope only; axes of the world

# Limits of a right filter; docs/exam.md compares them with the values of filters.
TILT, HEADING = np.radians(0.3), np.radians(0.8)    # rms errors [rad]


class Course(NamedTuple):
    """
    The run of this exam: rests between turns, the slow motion, and two kicks at rest.

    rests : index of the last sample of each rest (n,); the first and the last but one are equal
    turns : index of the first sample of each turn (n,)
    motion : where the slow motion is judged
    kicks : index of the first sample of each kick
    """

    run: Run
    rests: NDArray[np.intp]
    turns: NDArray[np.intp]
    motion: slice
    kicks: tuple[int, int]


def course(imu: Mapping[str, Any], rate: float) -> Course:
    """Return the run for the IMU's place and field, sampled at a rate [Hz]."""
    motion = scenarios.record(replace(scenarios.PIVOT, duration=MOTION_S, rate=rate), imu, 0)
    at = Rotation.identity()
    path = [np.tile(at.as_quat(), (round(FIRST_S * rate) + 1, 1))]
    ways = [math.radians(angle) * np.eye(3)[axis] for axis, angle in TURNS]
    ends = list(itertools.accumulate(map(Rotation.from_rotvec, ways), operator.mul))
    rests, turns = [len(path[0]) - 2], []
    for goal in (*ends, at, Rotation.from_quat(motion.truth[0])):
        way = (at.inv() * goal).as_rotvec()
        n = round(float(np.linalg.norm(way)) / TURN_RATE * rate) + 1
        turns.append(rests[-1] + 1)
        path += [(at * Rotation.from_rotvec(np.outer(np.arange(1, n + 1) / n, way))).as_quat(),
                 np.tile(goal.as_quat(), (round(REST_S * rate), 1))]
        rests.append(rests[-1] + n + round(REST_S * rate))
        at = goal
    lead = scenarios.along('', Rotation.from_quat(np.concatenate(path)), imu, rate)
    n = round(ANSWER_S * rate)
    tail = scenarios.along('', Rotation.from_quat(np.tile(motion.truth[-1], (3 * n + 1, 1))), imu,
                           rate)
    for sign, first in ((1.0, n), (-1.0, 2 * n)):
        tail.gyroscope[first:first + round(KICK_S * rate)] += sign / KICK_S * Rotation.from_quat(
            tail.truth[0]).inv().apply(KICK)
    run = replace(tail.after(motion.after(lead)), name='course')
    run.gyroscope[:] += NEVER_ZERO
    end = len(lead.t) + len(motion.t)
    return Course(run, np.array(rests), np.array(turns[:len(TURNS)]),
                  slice(end - len(motion.t) // 2, end), (end + n, end + 2 * n))


class Gyroscope(NamedTuple):
    """
    The answer to the gyroscope: increments of the attitude over those of the sensor.

    matrix : (3, 3), the identity for a right filter
    late : delay in samples
    scatter : share of the squared increments that the matrix leaves
    """

    matrix: Reals
    late: int
    scatter: float

    @property
    def off(self) -> float:
        """The largest deviation of the matrix from the identity."""
        return float(np.max(np.abs(self.matrix - np.eye(3))))


def increments(quaternions: Reals, of_world: bool = False) -> Reals:
    """Return the rotation vectors of the steps (n, 3) about axes of the sensor or the world."""
    turns = Rotation.from_quat(quaternions)
    steps = turns[1:] * turns[:-1].inv() if of_world else turns[:-1].inv() * turns[1:]
    return np.concatenate((np.zeros((1, 3)), steps.as_rotvec()))


def gyroscope_of(outcome: Outcome, turns: NDArray[np.intp], length: int, latest: int = LATEST,
                 of_world: bool = False) -> Gyroscope:
    """Fit the answer to the first samples of turns, at the delay that leaves least."""
    said, true = increments(outcome.estimates, of_world), increments(outcome.run.truth)
    fits = []
    for late in range(latest + 1):
        rows = (turns[:, np.newaxis] + np.arange(length)).ravel()
        given, answer = np.roll(true, late, axis=0)[rows], said[rows]
        matrix = np.linalg.lstsq(given, answer, rcond=None)[0]
        fits.append(Gyroscope(matrix.T, late, float(
            np.sum((answer - given @ matrix) ** 2) / max(np.sum(answer ** 2), 1e-12))))
    return min(fits, key=lambda fit: fit.scatter)


def words(matrix: Reals) -> str:
    """Return in words how a matrix (3, 3) of the gyroscope differs from the identity."""
    return '; '.join(
        f'a rate about {AXES[k]} turns it ' + (' and '.join(
            f'{column[j]:+.2g} times about {AXES[j]}' for j in range(3)
            if abs(column[j]) > 0.2 * np.max(np.abs(column))) or 'not at all')
        for k, column in enumerate(matrix.T) if np.max(np.abs(column - np.eye(3)[k])) > 0.03)


def axes(matrix: Reals) -> str:
    """Return a signed permutation in words."""
    return ', '.join(f'{"-" if row.sum() < 0 else ""}{AXES[int(np.argmax(np.abs(row)))]}'
                     for row in matrix)


def mapped(name: str, matrix: NDArray[np.floating[Any]]) -> ChangeReadings:
    """Return the multiplication of the readings of a sensor by a matrix."""
    def change(run: Run) -> Run:
        readings: Any = {name: getattr(run, name) @ matrix.T}
        return replace(run, **readings)
    return change


def shifted(names: Sequence[str], samples: int) -> ChangeReadings:
    """Return what gives the readings of sensors so many samples earlier."""
    def change(run: Run) -> Run:
        readings: Any = {name: moved(getattr(run, name), samples) for name in names}
        return replace(run, **readings)
    return change


def moved(rows: Reals, samples: int) -> Reals:
    """Return the rows so many samples later; the first or the last is repeated."""
    return rows[np.clip(np.arange(len(rows)) + samples, 0, len(rows) - 1)]


def with_iron(iron: Reals, run: Run) -> Run:
    """Return a field with this added [uT]."""
    return replace(run, magnetometer=run.magnetometer + 1e-6 * iron)


def of_world(run: Run) -> Run:
    """Return rates about axes of the world."""
    return replace(run, gyroscope=Rotation.from_quat(run.truth).apply(run.gyroscope))


def untilted(run: Run) -> Run:
    """Return the field as if the sensor were level, with the same heading (z, y', x'')."""
    true = Rotation.from_quat(run.truth)
    level = Rotation.from_euler('z', true.as_euler('ZYX')[:, :1])
    return replace(run, magnetometer=level.inv().apply(true.apply(run.magnetometer)))


class Clean(NamedTuple):
    """Errors without noise, rms [rad]: at rest, and in motion."""

    tilt: float
    heading: float
    tilt_moving: float
    heading_moving: float

    @property
    def wrong(self) -> bool:
        """Whether one is larger than that of a right filter."""
        return (max(self.tilt, self.tilt_moving) > TILT
                or max(self.heading, self.heading_moving) > HEADING)
