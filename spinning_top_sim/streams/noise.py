# SPDX-License-Identifier: Apache-2.0
"""
Random numbers of the sensors.

A number depends on the seed, on its purpose, and on the number or the time of its sample, not on
what was drawn before: Philox is a counter-based generator (J. Salmon et al., "Parallel random
numbers: as easy as 1, 2, 3", SC11).
"""

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.times import Times

STEP_NS = 1_000_000     # of the paths, whatever the rate of the sensor is
DRAWN_TOGETHER = 512    # samples, or steps of a path: a power of two
SPACING = 8.0           # ratio of neighbouring correlation times of a flicker noise


class Kind(enum.IntEnum):
    """What random numbers are for; those of different kinds are independent."""

    GYROSCOPE, ACCELEROMETER, MAGNETOMETER, ORIENTATION, TIMING = range(5)
    VIBRATION_RATE, VIBRATION_FORCE, GNSS_POSITION, GNSS_VELOCITY = range(5, 9)


class Part(enum.IntEnum):
    """Of what error of a sensor; these are independent, too."""

    WHITE, TURN_ON, WALK, GAUSS_MARKOV, FLICKER = range(5)


def white(seed: int, kind: Kind, numbers: Times, columns: int = 3,
          part: Part = Part.WHITE) -> NDArray[np.float64]:
    """Return standard normal numbers (columns, n) for samples with ascending numbers (n,)."""
    return _gathered(partial(_normal, seed, kind, part, columns), numbers)


@dataclass(frozen=True)
class RandomPath:
    """
    Random functions of time of three axes, each a sum of independent Gauss-Markov processes.

    processes : correlation time [s] and standard deviation of each; with the time inf a random
        walk from 0, and its density [1/sqrt(s)]; all others are stationary

    Steps are exact for any correlation time (D. Gillespie, "Exact numerical simulation of the
    Ornstein-Uhlenbeck process and its integral", Phys. Rev. E 54 (1996) 2084).  Values between
    two known ones are those of the Brownian bridge, by bisection (P. Levy's construction).
    """

    seed: int
    kind: Kind
    part: Part
    processes: tuple[tuple[float, float], ...]

    def at(self, t_ns: Times) -> NDArray[np.float64]:
        """Return the values (3, n) at ascending times (n,) >= 0 [ns]."""
        return _gathered(partial(_path, self), t_ns // STEP_NS)

    def law(self, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the decay of each process over a number of steps, and the variance it gains."""
        times, seconds = np.array([[time] for time, _ in self.processes]), steps * STEP_NS * 1e-9
        return np.exp(-seconds / times), np.where(
            np.isinf(times), seconds, -np.expm1(-2.0 * seconds / times))

    def draw(self, block: int, count: int, of_ends: bool = False) -> NDArray[np.float64]:
        """Return standard normal numbers (count, processes, 3) of a block."""
        return _normal(self.seed, self.kind, self.part, 3 * len(self.processes), block, count,
                       of_ends).reshape(count, -1, 3)


def flicker_parts(shortest: float, longest: float) -> Sequence[tuple[float, float]]:
    """
    Return correlation times [s] and standard deviations of some Gauss-Markov processes.

    The Allan deviation of their sum is 1 within 6 % for averaging times from `shortest` to
    `longest` [s].  The Allan variance of each process has its maximum at 1.89 correlation times;
    there the sum is exactly 1.
    """
    count = 1 + round(np.log(longest / shortest) / np.log(SPACING))
    tau = (np.geomspace(shortest, longest, count) if count > 1
           else np.array([np.sqrt(shortest * longest)]))
    times = tau / 1.89
    # IEEE Std 952-1997, annex C, with the variance q^2 T/2; a series where this cancels.
    ratio = tau[:, np.newaxis] / times
    closed = 2.0 / ratio * (1.0 - (3.0 - 4.0 * np.exp(-ratio) + np.exp(-2.0 * ratio))
                            / (2.0 * ratio))
    rows = [[*row, 1.0] for row in np.where(
        ratio < 1e-3, ratio * (2.0 / 3.0 - 0.5 * ratio), closed).tolist()]
    # By elimination: the last bits of LAPACK depend on the processor.  The diagonal dominates.
    for k in range(count):
        pivot = rows[k]
        rows = [row if j == k else [x - row[k] / pivot[k] * y for x, y in zip(
            row, pivot, strict=True)] for j, row in enumerate(rows)]
    return [(time, math.sqrt(row[-1] / row[k]))
            for k, (time, row) in enumerate(zip(times.tolist(), rows, strict=True))]


def _gathered(block: Callable[[int], NDArray[np.float64]], numbers: Times,
              ) -> NDArray[np.float64]:
    """Return samples (columns, n) by ascending numbers, from blocks (DRAWN_TOGETHER, columns)."""
    edges = np.flatnonzero(np.diff(numbers // DRAWN_TOGETHER)) + 1
    return np.concatenate([block(int(part[0]) // DRAWN_TOGETHER)[part % DRAWN_TOGETHER]
                           for part in np.split(numbers, edges)]).T


@lru_cache(16)
def _normal(seed: int, kind: Kind, part: Part, columns: int, block: int,
            count: int = DRAWN_TOGETHER, of_ends: bool = False) -> NDArray[np.float64]:
    """Return standard normal numbers (count, columns) that depend on the arguments alone."""
    # The counter is part of the format of logs: it never changes, whatever Kind or Part is added.
    # There were five parts when it was fixed.
    more, place = divmod(int(part), 5)
    counter = [0, 2 * more + int(of_ends), 5 * int(kind) + place, block]
    return np.random.Generator(np.random.Philox(key=seed, counter=counter)
                               ).standard_normal((count, columns))


@lru_cache(16)
def _path(path: RandomPath, block: int) -> NDArray[np.float64]:
    """Return the values of a path at the steps of a block, (DRAWN_TOGETHER, 3)."""
    normal = path.draw(block, DRAWN_TOGETHER)
    steps = np.empty((DRAWN_TOGETHER + 1, len(path.processes), 3))
    steps[0], steps[-1] = _begin(path, block), _begin(path, block + 1)
    apart = DRAWN_TOGETHER // 2
    while apart:
        steps[apart::2 * apart] = _between(path, apart, steps[:-1:2 * apart],
                                           steps[2 * apart::2 * apart], normal[apart::2 * apart])
        apart //= 2
    total = np.zeros((DRAWN_TOGETHER, 3))
    for number, (_, scale) in enumerate(path.processes):    # np.sum may add in another order
        total = total + scale * steps[:-1, number]
    return total


@lru_cache(512)
def _begin(path: RandomPath, block: int) -> NDArray[np.float64]:
    """
    Return the processes of a path where a block begins, (processes, 3).

    The block 2^k follows from the block 2^(k-1), and every other one from two with fewer digits.
    """
    normal: NDArray[np.float64] = path.draw(block, 1, of_ends=True)[0]
    if block == 0:
        return np.array([[0.0 if math.isinf(time) else 1.0] for time, _ in path.processes]
                        ) * normal
    apart = block & -block          # the largest power of two that divides the number
    if block == apart:
        before = block // 2
        decay, gained = path.law((block - before) * DRAWN_TOGETHER)
        return decay * _begin(path, before) + np.sqrt(gained) * normal
    return _between(path, apart * DRAWN_TOGETHER, _begin(path, block - apart),
                    _begin(path, block + apart), normal)


def _between(path: RandomPath, steps: int, before: NDArray[np.float64], after: NDArray[np.float64],
             normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the processes half-way between two known values, `steps` away from each."""
    decay, gained = path.law(steps)
    square = 1.0 + decay * decay
    return decay / square * (before + after) + np.sqrt(gained / square) * normal
