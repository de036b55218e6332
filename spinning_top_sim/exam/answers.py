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
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.measures import increments, up
from spinning_top_sim.exam.motions import Reals, Run
from spinning_top_sim.tools.identify import AXES

SMALL, LARGE = 0.02, 0.3        # kicks [rad], of first order; that a step of first order misses
# Samples from a kick to the end of its rest: there is time for late answers, and for gravity to
# lead the attitude back where a filter smooths it.
SHORT, LONG = -40, -200
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
        off = np.abs(self.matrix - np.eye(3))
        large = 0.5 * np.max(off)
        text = '; '.join(
            f'{AXES[k]} turns the attitude about ' + (' and '.join(
                f'{AXES[j]} by {column[j]:.3g}' for j in range(3)
                if abs(column[j]) >= min(large, 0.5)) or 'nothing')
            for k, column in enumerate(self.matrix.T) if np.max(off[:, k]) >= large)
        return f'a rate about {text}' + (', axes of the world' if self.in_world else '')


class Kicks(NamedTuple):
    """Kicks at steps of a run (n,), turns (n, 3), and the answers until then (n, samples, 3)."""

    steps: NDArray[np.intp]
    turns: Reals
    moves: Reals

    @property
    def off(self) -> float:
        """The median of how far answers of the same step are off their turns, relative."""
        return _left(self.moves[:, 0], self.turns, np.eye(3))

    @property
    def gains(self) -> Reals:
        """How far the turns move the attitude in the same step, relative (n,)."""
        gains: Reals = (np.sum(self.moves[:, 0] * self.turns, axis=1)
                        / np.sum(self.turns ** 2, axis=1))
        return gains


def kicked(run: Run, steps: Sequence[int] | NDArray[np.intp], turns: Reals) -> Run:
    """Return the run with turns of the gyroscope alone (n, 3) [rad] in some steps (n,)."""
    gyroscope = run.gyroscope.copy()
    gyroscope[steps] += turns / run.dt[steps][:, np.newaxis]
    return replace(run, name=f'{run.name}, kick', gyroscope=gyroscope)


def kicks(still: Outcome, moved: Outcome) -> Kicks:
    """Return the kicks in which a run differs from another, and their answers."""
    turns = (moved.run.gyroscope - still.run.gyroscope) * still.run.dt[:, np.newaxis]
    steps = np.flatnonzero(np.any(turns, axis=1))
    apart = increments(moved.estimates) - increments(still.estimates)
    return Kicks(steps, turns[steps], np.cumsum(apart[steps[:, np.newaxis] + np.arange(-SHORT)],
                                                axis=1))


def rates(still: Outcome, moved: Outcome) -> Rates:
    """Identify the use of the rates from runs without and with kicks about the vertical."""
    steps, turns, moves = kicks(still, moved)
    size = np.median(np.linalg.norm(moves, axis=2), axis=0)
    delay = float(np.sum(1.0 - size / max(size[-1], 1e-300)))
    matrix, left = _fit(moves[:, -1], turns)
    world = Rotation.from_quat(moved.estimates[steps])
    of_world, left_of_world = _fit(world.apply(moves[:, -1]), turns)
    if in_world := left_of_world < left and left > FIT:
        matrix, left = of_world, left_of_world
    return Rates(matrix, left, in_world, delay)


def _fit(answers: Reals, turns: Reals) -> tuple[Reals, float]:
    """Return the matrix from turns to answers, and the median deviation from it over a turn."""
    matrix = np.asarray(np.linalg.lstsq(turns, answers, rcond=None)[0].T, dtype=np.float64)
    return matrix, _left(answers, turns, matrix)


def _left(answers: Reals, turns: Reals, matrix: Reals) -> float:
    return float(np.median(np.linalg.norm(answers - turns @ matrix.T, axis=1)
                           / np.linalg.norm(turns, axis=1)))


def led_back(still: Outcome, moved: Outcome) -> float:
    """Return which share of the tilt by a kick is led back until the end."""
    first, last = (np.cross(up(moved.estimates[k]), up(still.estimates[k])) for k in (LONG, -1))
    return float(1.0 - first @ last / (first @ first))
