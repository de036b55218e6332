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
from spinning_top_sim.tools.verdict import Fault

# Turns about an axis of the sensor [deg], each followed by a rest; then one leads back, and a slow
# one to the motion.
TURNS = ((0, 80.0), (1, -70.0), (2, 100.0), (0, -110.0), (1, 85.0), (2, -75.0), (0, 95.0),
         (1, 110.0), (2, -120.0))
# Of these, and of the slow one, which a filter must neither drop nor take for a bias [rad/s].
TURN_RATE, SLOW_RATE = 2.6, 0.15
FIRST_S, REST_S, ANSWER_S, MOTION_S = 6.0, 3.0, 4.0, 16.0
WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its response; the longest delay
# A kick is not corrected if more than STAYS is left, and grows if GROWN times its least is left.
STAYS, GROWN = 0.995, 1.1
# Some filters take no step while the rates are exactly zero [rad/s].
NEVER_ZERO = 1e-6
DELAY_LEAVES = 0.5              # most of the residual of the response, without a delay it is 1
# Yaw, pitch and roll of the last rest [deg], and a turn of the heading there.  The yaw passes 180
# degrees in this turn, whether it counts from the east or from the north.
DOWN, ASTRAY, ASTRAY_S = (160.0, 20.0, 140.0), np.radians(120.0), 0.5
FARTHER = 1.03                  # of the error after this turn is no right filter's


class Kick(NamedTuple):
    """A turn of the gyroscope only, about an axis of the world, and what must correct it."""

    sensor: str
    what: str
    turn: Reals         # (3,) [rad]
    part: slice         # of an error (3,) that is judged


# The tilt comes last: its correction may change the heading for a while.
KICK_S, KICKS = 0.1, (
    Kick('magnetometer', 'heading', np.radians((0.0, 0.0, 0.7)), slice(2, 3)),
    Kick('accelerometer', 'tilt', np.radians((0.7, 0.0, 0.0)), slice(2)))


class Excitation(NamedTuple):
    """
    Rests between turns, the slow motion, and kicks of the gyroscope alone at two rests.

    run : with the kicks
    still : without them
    rests : index of the last sample of each rest (n,); at the first and the last but one the
        attitude is the same
    turns : index of the first sample of each turn (n,)
    motion : where the slow motion is judged
    kicks : index of the first sample of each kick, two at each rest
    astray : where the heading has been turned far off, up to the end
    """

    run: Run
    still: Run
    rests: NDArray[np.intp]
    turns: NDArray[np.intp]
    motion: slice
    kicks: list[tuple[int, int]]
    astray: slice


def excite(imu: Mapping[str, Any], goes_astray: bool) -> Excitation:
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
        ways, REST_S, ANSWER_S))
    # Begin and end of each rest.
    ends = np.cumsum([FIRST_S * rate, *(lengths + 1 + rest)]).astype(int)
    begins = np.append(0, ends[1:] - rest)
    path = Slerp(np.ravel((begins, ends), 'F'), stops[np.repeat(np.arange(len(stops)), 2)])
    lead = scenarios.along(path(np.arange(ends[-1] + 1)), imu)
    end = len(lead.t) + len(motion.t)
    last = Rotation.concatenate((Rotation.from_quat(motion.truth[-1]), Rotation.from_euler(
        'ZYX', DOWN, degrees=True)))
    way = round((last[0].inv() * last[1]).magnitude() / TURN_RATE * rate)
    knots = np.array((0, 3 * answer, 3 * answer + way, 7 * answer + way))
    still = replace(scenarios.along(Slerp(knots, last[[0, 0, 1, 1]])(np.arange(knots[-1] + 1)), imu
                                    ).preceded_by(motion.preceded_by(lead)), name='excitation')
    still.gyroscope[:] += NEVER_ZERO
    run = replace(still, gyroscope=still.gyroscope.copy())
    kicks = [(end + begin + answer, end + begin + 2 * answer) for begin in knots[::2].tolist()]
    for attitude, pair in zip(last, kicks, strict=True):
        for first, kick in zip(pair, KICKS, strict=True):
            run.gyroscope[first:first + round(KICK_S * rate)] += (
                attitude.inv().apply(kick.turn) / KICK_S)
    far = slice(kicks[-1][-1] + answer, kicks[-1][-1] + answer + round(ASTRAY_S * rate))
    if goes_astray:
        run.gyroscope[far] += last[1].inv().apply((0.0, 0.0, ASTRAY / ASTRAY_S))
    return Excitation(run, still, ends - 1, ends[:len(TURNS)],
                      slice(end - len(motion.t) // 2, end), kicks, slice(far.stop, None))


def gyroscope_of(outcome: Outcome, turns: NDArray[np.intp]) -> tuple[Reals, Reals, int]:
    """
    Fit the response to the gyroscope: increments of the attitude over those of the sensor.

    Returns two matrices (3, 3) from whole turns and from their begins, the identity for a right
    filter, and the delay of whole turns in samples; 0 if none explains the response.
    """
    estimated, true = increments(outcome.estimates), increments(outcome.run.truth)

    def fit(length: int, late: int) -> tuple[Reals, float]:
        rows = (turns[:, np.newaxis] + np.arange(length)).ravel()
        given, response = true[rows - late], estimated[rows]
        matrix = np.linalg.lstsq(given, response, rcond=None)[0]
        return matrix.T, rms(response - given @ matrix)

    fits = [fit(WHOLE, late) for late in range(LATEST + 1)]
    late = int(np.argmin([left for _, left in fits]))
    if fits[late][1] > DELAY_LEAVES * fits[0][1]:
        late = 0
    return fits[late][0], fit(EARLY, 0)[0], late


def not_corrected(estimates: Reals, without: Reals, given: Excitation,
                  absolute: bool) -> list[Fault]:
    """
    Name the sensors that do not correct a kick.

    estimates, without : attitudes (n, 4) with kicks and without
    absolute : whether the heading is judged
    """
    n = round(ANSWER_S * scenarios.SLOW.rate)
    error = (Rotation.from_quat(estimates) * Rotation.from_quat(without).inv()).as_rotvec()

    def shares(first: int, kick: Kick) -> tuple[float, float]:
        """Return what is left of a kick in the end, and the least of it."""
        sizes = np.linalg.norm((error[first + LATEST:first + n] - error[first - 1])[:, kick.part],
                               axis=1)
        # Some filters correct most of it before the longest delay is over.
        whole = max(sizes[0], 0.5 * np.linalg.norm(kick.turn))
        return sizes[-1] / whole, np.min(sizes) / whole

    heading, tilt = ((kick, *max(shares(first, kick) for first in starts))
                     for kick, starts in zip(KICKS, zip(*given.kicks, strict=True), strict=True))
    found = [one for one in (tilt, heading)[:1 + absolute] if one[1] > STAYS]
    grown = [f'of the {kick.what} grows to {left:.0%}' for kick, left, least in found
             if left > GROWN * least]
    if grown:       # by which sensor, and whether by the bias, is not known
        return [Fault('inaccurate', f'an error {" and ".join(grown)} in {ANSWER_S:g} s at rest')]
    return [Fault(f'{kick.sensor}_wiring', f'{left:.1%} of an error of the {kick.what} are left '
                  f'after {ANSWER_S:g} s: the {kick.sensor} does not correct it')
            for kick, left, _ in found]


def astray(outcome: Outcome, given: Excitation, absolute: bool) -> list[Fault]:
    """Return the fault of a filter that, turned far off north, turns farther."""
    errors = np.abs(outcome.part(given.astray).errors.heading)
    if not absolute or np.max(errors) < max(ASTRAY, FARTHER * errors[0]):
        return []
    return [Fault('inaccurate', f'turned off north by {np.degrees(errors[0]):.0f} deg, it turns '
                  f'to {np.degrees(np.max(errors)):.0f} deg')]


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


def apart(estimates: Reals, others: Reals, absolute: bool) -> Reals:
    """Return the change of the axes of the world, in the sensor, from attitudes to others."""
    one, other = (Rotation.from_quat(rows).inv() for rows in (estimates, others))
    # Without a heading, the vertical alone.
    return np.concatenate([(other.apply(axis) - one.apply(axis)).ravel()
                           for axis in np.eye(3)[0 if absolute else 2:]])


def words(matrix: NDArray[np.floating[Any]]) -> str:
    """Return in words how a matrix (3, 3) of the gyroscope differs from the identity."""
    large = 0.5 * np.max(np.abs(matrix - np.eye(3)))
    return '; '.join(
        f'a rate about {AXES[k]} turns it ' + (' and '.join(
            f'{column[j]:+.3g} times about {AXES[j]}' for j in range(3)
            if abs(column[j] - (j == k)) >= large and column[j]) or 'not at all')
        for k, column in enumerate(matrix.T) if np.max(np.abs(column - np.eye(3)[k])) >= large)
