# SPDX-License-Identifier: Apache-2.0
"""
How a filter answers small changes of its inputs: what it does with them, by least squares.

A kick is a turn that the gyroscope alone reads, in one step of a rest.  The difference of the
attitudes with and without it is the filter's answer.  Without a field, nothing but the gyroscope
shows a kick about what a filter takes for the vertical: the answer is its use of the rates, in
axes of the sensor that differ from start to start.  After other kicks, gravity or the field leads
it back.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.measures import increments, up
from spinning_top_sim.exam.motions import RATE, ROUNDING, Reals, Run
from spinning_top_sim.tools.identify import in_words

SMALL, LARGE = 0.02, 0.3        # kicks [rad], of first order; that a step of first order misses
# Sample of a kick in a rest, from its end: there is time for late answers.
EARLY = -40
LONG = -200     # of a kick that gravity leads back: filters that smooth it do that late
FIT = 0.2       # of an effect: what a matrix may leave of it, if the matrix is what is wrong


class Rates(NamedTuple):
    """
    How turns of the sensor move the attitude.

    matrix : of a turn in axes of the sensor (3, 3); the identity if right
    left : deviation of an answer from this matrix over its kick, the median
    in_world : whether it is one in axes of the world
    delay : of the answer, in samples; negative: ahead
    """

    matrix: Reals
    left: float
    in_world: bool
    delay: float

    @property
    def off_identity(self) -> float:
        """The largest deviation of an entry of the matrix from the identity."""
        return float(np.max(np.abs(self.matrix - np.eye(3)))) if not self.in_world else 1.0

    def __str__(self) -> str:
        text = in_words(self.matrix)
        return f'a rate about {text}' + (', axes of the world' if self.in_world else '')


def with_kick(run: Run, sample: int, turn: Reals) -> Run:
    """Return the run with a kick, a turn of the gyroscope alone (3,) [rad]."""
    gyroscope = run.gyroscope.copy()
    gyroscope[sample] += turn / run.dt[sample]
    return replace(run, name=f'{run.name}, kick', gyroscope=gyroscope)


def rates(still: Sequence[Outcome], moved: Sequence[Outcome]) -> Rates:
    """Identify the use of the rates from rests without and with kicks about the vertical."""
    apart = np.array([increments(other.estimates) - increments(one.estimates)
                      for one, other in zip(still, moved, strict=True)])[:, EARLY:]
    turns = _turns(still, moved)
    moves = np.cumsum(apart, axis=1)                # (rests, samples, 3)
    size = np.median(np.linalg.norm(moves, axis=2), axis=0)
    delay = float(np.sum(1.0 - size / max(size[-1], 1e-300)))
    matrix, left = _fit(moves[:, -1], turns)
    world = Rotation.from_quat([one.estimates[EARLY] for one in moved])
    of_world, left_of_world = _fit(world.apply(moves[:, -1]), turns)
    if in_world := left_of_world < left and left > FIT:
        matrix, left = of_world, left_of_world
    return Rates(matrix, left, in_world, delay)


def _turns(still: Sequence[Outcome], moved: Sequence[Outcome]) -> Reals:
    """Return the kicks (n, 3) [rad]."""
    return np.array([(other.run.gyroscope - one.run.gyroscope)[EARLY] * one.run.dt[EARLY]
                     for one, other in zip(still, moved, strict=True)])


def off_rotation(still: Sequence[Outcome], moved: Sequence[Outcome]) -> float:
    """Return how far the answers to large kicks are off them, relative, the median."""
    found = [(increments(other.estimates) - increments(one.estimates))[EARLY]
             for one, other in zip(still, moved, strict=True)]
    return float(np.median(_off(np.array(found), _turns(still, moved))))


def _off(answers: Reals, turns: Reals) -> Reals:
    off: Reals = np.linalg.norm(answers - turns, axis=1) / np.linalg.norm(turns, axis=1)
    return off


def _fit(answers: Reals, turns: Reals) -> tuple[Reals, float]:
    """Return the matrix from turns to answers, and the median deviation from it over a turn."""
    matrix = np.asarray(np.linalg.lstsq(turns, answers, rcond=None)[0].T, dtype=np.float64)
    return matrix, float(np.median(_off(answers - turns @ matrix.T + turns, turns)))


def kicked_steps(still: Outcome) -> Run:
    """Return a run of uneven steps with kicks about what the filter takes for the vertical."""
    run, lengths = still.run, still.run.dt.round(6)
    place = 4 * len(lengths) // 5                   # the filter is settled from its start
    vertical = up(still.estimates[place])
    for length in np.unique(lengths):
        place += 20 + int(np.argmax(lengths[place + 20:] == length))
        run = with_kick(run, place, SMALL * RATE * length * vertical)     # as fast in each
    return run


def gains_of_steps(still: Outcome, moved: Outcome) -> dict[float, float]:
    """Return for each length of a step [s] how far a turn in it moves the attitude, relative."""
    turns = (moved.run.gyroscope - still.run.gyroscope) * still.run.dt[:, np.newaxis]
    steps = np.flatnonzero(np.any(turns, axis=1))
    answers = (increments(moved.estimates) - increments(still.estimates))[steps]
    gains = np.sum(answers * turns[steps], axis=1) / np.sum(turns[steps] ** 2, axis=1)
    return dict(sorted(zip(still.run.dt[steps].round(6).tolist(), gains.tolist(), strict=True)))


def pull(errors: Sequence[Reals], least: float = ROUNDING) -> float:
    """
    Return whether errors go straight to zero: the cosine of the angle between the ways, weighted.

    errors : before and after (n, axes)
    least : share by which they must fall, else 0 is returned
    """
    first, last = errors
    way = last - first
    size, length = np.linalg.norm(first, axis=1), np.linalg.norm(way, axis=1)
    if np.sum(np.linalg.norm(last, axis=1)) >= (1.0 - least) * np.sum(size):
        return 0.0
    return float(-np.sum(first * way) / np.sum(size * length))


def led_back(still: Outcome, moved: Outcome) -> float:
    """Return which share of the tilt by a kick is led back until the end."""
    first, last = (np.cross(up(moved.estimates[k]), up(still.estimates[k])) for k in (LONG, -1))
    return float(1.0 - first @ last / (first @ first))
