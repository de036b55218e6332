# SPDX-License-Identifier: Apache-2.0
"""
The random numbers of the sensors.

Each depends on the seed, on what it is for, and on the number of its sample or on its time; never
on what was drawn before.  A jump in time draws as few numbers as the next block does.
"""

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

# Samples as columns (columns, n), or as rows (n, columns).
Rows = NDArray[np.float64]
# A path changes this often, whatever the rate of its sensor.
STEP_NS = 1_000_000
# Random numbers are drawn for so many samples, or steps of a path, together: a power of two.
DRAWN_TOGETHER = 512
# Correlation times of a flicker grow by this factor.
SPACING = 8.0


class Purpose(enum.IntEnum):
    """What a random number is for: those of two purposes are independent."""

    WHITE, TURN_ON, WALK, GAUSS_MARKOV, FLICKER, ORIENTATION = range(6)
    TIMING, MAG_WHITE, MAG_WALK = range(6, 9)


def white(seed: int, purpose: Purpose, numbers: NDArray[np.int64], columns: int) -> Rows:
    """Return normal numbers (columns, n) of the samples of these ascending numbers."""
    return _columns(partial(_normal, seed, purpose, columns=columns), numbers)


def constant(seed: int, purpose: Purpose, columns: int) -> Rows:
    """Return a normal number for each column, (columns, 1)."""
    return _normal(seed, purpose, 0, columns, count=1).T


@dataclass(frozen=True)
class Path:
    """
    Independent random paths in time, one for each column: sums of Gauss-Markov processes.

    times : correlation time [s] of each part and column, parts x columns; inf: a random walk
        from 0, else the part is stationary
    scales : standard deviation of each part and column; density of a random walk [1/sqrt(s)]

    The steps have the exact law of the process, whatever the correlation time is (D. Gillespie,
    "Exact numerical simulation of the Ornstein-Uhlenbeck process and its integral", Phys. Rev. E
    54 (1996) 2084).  Half-way between two times that are known, a path has the law that follows
    from both (P. Levy's construction of Brownian motion).
    """

    seed: int
    purpose: Purpose
    times: tuple[tuple[float, ...], ...]
    scales: tuple[tuple[float, ...], ...]

    def at(self, t_ns: NDArray[np.int64]) -> Rows:
        """Return the paths at ascending times >= 0 [ns], (columns, n)."""
        return _columns(partial(_path, self), t_ns // STEP_NS)

    def law(self, steps: int) -> tuple[Rows, Rows]:
        """Return the decay over so many steps, and the variance that the path gains meanwhile."""
        times, seconds = np.array(self.times), steps * STEP_NS * 1e-9
        return np.exp(-seconds / times), np.where(
            np.isinf(times), seconds, -np.expm1(-2.0 * seconds / times))


class SensorNoise:
    """
    White noise, numbered by sample, and the bias, a path in time, of a sensor.

    deviation, offset : (columns, 1) standard deviation of the white noise, constant bias
    """

    def __init__(self, seed: int, purpose: Purpose, period_ns: int, deviation: Rows, offset: Rows,
                 paths: Sequence[Path]) -> None:
        self._seed, self._purpose, self._period_ns = seed, purpose, period_ns
        # + 0.0: no bias is -0.
        self._deviation, self._offset, self._paths = deviation, offset + 0.0, paths
        self._newest: tuple[range, Rows, Rows] = range(0), offset, offset

    def at(self, times: range) -> tuple[Rows, Rows]:
        """Return white noise and bias at these times [ns], (columns, n) or (columns, 1) each."""
        if self._newest[0] != times:      # streams of one rate ask for the same ones
            t_ns = np.arange(times.start, times.stop, times.step)
            noise, bias = np.zeros_like(self._deviation), self._offset
            if self._deviation.any():
                noise = self._deviation * white(self._seed, self._purpose,
                                                t_ns // self._period_ns, len(self._deviation))
            for path in self._paths:
                bias = bias + path.at(t_ns)
            self._newest = times, noise, bias
        return self._newest[1:]


def flicker_parts(shortest: float, longest: float) -> Sequence[tuple[float, float]]:
    """
    Return correlation time [s] and standard deviation of some Gauss-Markov processes.

    The Allan deviation of their sum is 1 from `shortest` to `longest` [s], within 6 %.  Each
    process has its largest Allan variance at 1.89 correlation times; the variances are those with
    which the sum is 1 at all these averaging times.
    """
    count = 1 + round(np.log(longest / shortest) / np.log(SPACING))
    tau = (np.geomspace(shortest, longest, count) if count > 1
           else np.array([np.sqrt(shortest * longest)]))
    times = tau / 1.89
    variances = np.linalg.solve(gauss_markov_allan_variance(tau[:, np.newaxis] / times),
                                np.ones(count))
    return list(zip(times.tolist(), np.sqrt(variances).tolist(), strict=True))


def gauss_markov_allan_variance(ratio: Rows) -> Rows:
    """
    Return the Allan variance of a Gauss-Markov process of variance 1.

    ratio : averaging time over correlation time

    (IEEE Std 952-1997, annex C, with the variance q^2 T/2.)
    """
    whole = 2.0 / ratio * (1.0 - (3.0 - 4.0 * np.exp(-ratio) + np.exp(-2.0 * ratio))
                           / (2.0 * ratio))
    # There its terms cancel.
    return np.where(ratio < 1e-3, ratio * (2.0 / 3.0 - 0.5 * ratio), whole)


def _columns(block: Callable[[int], Rows], numbers: NDArray[np.int64]) -> Rows:
    """Return the samples of these ascending numbers, (columns, n), from blocks of them."""
    edges = np.flatnonzero(np.diff(numbers // DRAWN_TOGETHER)) + 1
    return np.concatenate([block(int(part[0]) // DRAWN_TOGETHER)[part % DRAWN_TOGETHER]
                           for part in np.split(numbers, edges)]).T


@lru_cache(16)
def _normal(seed: int, purpose: Purpose, number: int, columns: int,
            count: int = DRAWN_TOGETHER, of_ends: bool = False) -> Rows:
    """
    Draw normal numbers (count, columns) that depend on nothing else that is drawn.

    Philox is counter-based (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11).
    """
    counter = [0, int(of_ends), int(purpose), number]
    return np.random.Generator(np.random.Philox(key=seed, counter=counter)
                               ).standard_normal((count, columns))


@lru_cache(8)
def _path(path: Path, block: int) -> Rows:
    """Return the paths in a block of steps, (512, columns), between its ends."""
    parts, columns = np.shape(path.times)
    normal = _normal(path.seed, path.purpose, block, parts * columns).reshape(-1, parts, columns)
    steps = np.empty((DRAWN_TOGETHER + 1, parts, columns))
    steps[0], steps[-1] = _end(path, block), _end(path, block + 1)
    apart = DRAWN_TOGETHER // 2
    while apart:
        steps[apart::2 * apart] = _between(path, apart, steps[:-1:2 * apart],
                                           steps[2 * apart::2 * apart], normal[apart::2 * apart])
        apart //= 2
    steps[:-1] *= path.scales
    total: Rows = steps[:-1, 0]
    for part in range(1, parts):
        total = total + steps[:-1, part]
    return total


@lru_cache(256)
def _end(path: Path, block: int) -> Rows:
    """
    Return the parts of a path where a block begins, by way of some log2(block) others.

    Those at powers of two follow from one another, all others lie half-way between two.
    """
    shape = np.shape(path.times)
    normal: Rows = _normal(path.seed, path.purpose, block, shape[0] * shape[1], 1, True
                           ).reshape(shape)
    if block == 0:
        return np.where(np.isinf(path.times), 0.0, normal)
    apart = block & -block          # the largest power of two that divides it
    if block == apart:
        before = block // 2
        decay, gained = path.law((block - before) * DRAWN_TOGETHER)
        return decay * _end(path, before) + np.sqrt(gained) * normal
    return _between(path, apart * DRAWN_TOGETHER, _end(path, block - apart),
                    _end(path, block + apart), normal)


def _between(path: Path, steps: int, before: Rows, after: Rows, normal: Rows) -> Rows:
    """Return the parts of a path half-way between two states, so many steps from either."""
    decay, gained = path.law(steps)
    square = 1.0 + decay * decay
    return decay / square * (before + after) + np.sqrt(gained / square) * normal
