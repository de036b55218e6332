# SPDX-License-Identifier: Apache-2.0
"""
Random numbers of the sensors.

A number depends on the seed, on its purpose, and on the number or the time of its sample, not on
what was drawn before.  A jump in time therefore draws as few numbers as the next block does.
"""

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

# Step of the paths, whatever the rate of the sensor is.
STEP_NS = 1_000_000
# Number of samples, or steps of a path, whose random numbers are drawn together: a power of two.
DRAWN_TOGETHER = 512
# Ratio of the correlation times of two neighbouring parts of a flicker noise.
SPACING = 8.0


class Purpose(enum.IntEnum):
    """What a random number is used for; numbers for different purposes are independent."""

    WHITE, TURN_ON, WALK, GAUSS_MARKOV, FLICKER, ORIENTATION = range(6)
    TIMING, MAG_WHITE, MAG_WALK, VIBRATION_RATE, VIBRATION_FORCE = range(6, 11)
    GNSS_POSITION, GNSS_VELOCITY = range(11, 13)


def white(seed: int, purpose: Purpose, numbers: NDArray[np.int64], columns: int,
          ) -> NDArray[np.float64]:
    """Return standard normal numbers (columns, n) for samples with ascending numbers (n,)."""
    return _gathered(partial(_normal, seed, purpose, columns=columns), numbers)


def constants(seed: int, purpose: Purpose, columns: int) -> NDArray[np.float64]:
    """Return standard normal numbers (columns, 1): those of `white` for the sample 0."""
    return _normal(seed, purpose, 0, columns, 1).T


@dataclass(frozen=True)
class RandomPath:
    """
    Independent random functions of time, each a sum of Gauss-Markov processes.

    times : correlation time [s] of each process, parts x columns; inf for a random walk from 0,
        all others are stationary
    scales : standard deviation of each process; of a random walk, its density [1/sqrt(s)]

    Steps are exact for any correlation time (D. Gillespie, "Exact numerical simulation of the
    Ornstein-Uhlenbeck process and its integral", Phys. Rev. E 54 (1996) 2084).  Values between
    two known ones are those of the Brownian bridge, by bisection (P. Levy's construction).
    """

    seed: int
    purpose: Purpose
    times: tuple[tuple[float, ...], ...]
    scales: tuple[tuple[float, ...], ...]

    def at(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the values (columns, n) at ascending times (n,) >= 0 [ns]."""
        return _gathered(partial(_path, self), t_ns // STEP_NS)

    def law(self, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the decay of each process over a number of steps, and the variance it gains."""
        times, seconds = np.array(self.times), steps * STEP_NS * 1e-9
        return np.exp(-seconds / times), np.where(
            np.isinf(times), seconds, -np.expm1(-2.0 * seconds / times))


class SensorNoise:
    """
    The noise of a sensor: white noise, numbered by sample, and a bias, which is a path in time.

    deviation : standard deviation of the white noise, (columns, 1)
    offset : constant part of the bias, (columns, 1)
    """

    def __init__(self, seed: int, purpose: Purpose, period_ns: int,
                 deviation: NDArray[np.float64], offset: NDArray[np.float64],
                 paths: Sequence[RandomPath] = ()) -> None:
        self._seed, self._purpose, self._period_ns = seed, purpose, period_ns
        # Adding 0.0 turns -0.0 into 0.0.
        self._deviation, self._offset, self._paths = deviation, offset + 0.0, paths
        self._newest = range(0), offset, offset

    def at(self, times: range) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return white noise and bias at these times [ns], (columns, n) or (columns, 1) each."""
        if self._newest[0] != times:      # streams of one rate ask for the same times
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
    Return correlation times [s] and standard deviations of some Gauss-Markov processes.

    The Allan deviation of their sum is 1 within 6 % for averaging times from `shortest` to
    `longest` [s].  The Allan variance of each process has its maximum at 1.89 correlation times;
    there the sum is exactly 1.
    """
    count = 1 + round(np.log(longest / shortest) / np.log(SPACING))
    tau = (np.geomspace(shortest, longest, count) if count > 1
           else np.array([np.sqrt(shortest * longest)]))
    times = tau / 1.89
    variances = np.linalg.solve(gauss_markov_allan_variance(tau[:, np.newaxis] / times),
                                np.ones(count))
    return list(zip(times.tolist(), np.sqrt(variances).tolist(), strict=True))


def gauss_markov_allan_variance(ratio: NDArray[np.float64]) -> NDArray[np.float64]:
    """
    Return the Allan variance of a Gauss-Markov process of variance 1.

    ratio : averaging time over correlation time

    (IEEE Std 952-1997, annex C, with the variance q^2 T/2.)
    """
    closed = 2.0 / ratio * (1.0 - (3.0 - 4.0 * np.exp(-ratio) + np.exp(-2.0 * ratio))
                            / (2.0 * ratio))
    # The closed form cancels at small ratios; use its series there.
    return np.where(ratio < 1e-3, ratio * (2.0 / 3.0 - 0.5 * ratio), closed)


def _gathered(block: Callable[[int], NDArray[np.float64]], numbers: NDArray[np.int64],
              ) -> NDArray[np.float64]:
    """Return samples (columns, n) by ascending numbers, from blocks (DRAWN_TOGETHER, columns)."""
    edges = np.flatnonzero(np.diff(numbers // DRAWN_TOGETHER)) + 1
    return np.concatenate([block(int(part[0]) // DRAWN_TOGETHER)[part % DRAWN_TOGETHER]
                           for part in np.split(numbers, edges)]).T


@lru_cache(16)
def _normal(seed: int, purpose: Purpose, number: int, columns: int,
            count: int = DRAWN_TOGETHER, of_ends: bool = False) -> NDArray[np.float64]:
    """
    Return standard normal numbers (count, columns) that depend on the arguments alone.

    Philox is a counter-based generator (J. Salmon et al., "Parallel random numbers: as easy as 1,
    2, 3", SC11).
    """
    counter = [0, int(of_ends), int(purpose), number]
    return np.random.Generator(np.random.Philox(key=seed, counter=counter)
                               ).standard_normal((count, columns))


@lru_cache(8)
def _path(path: RandomPath, block: int) -> NDArray[np.float64]:
    """Return the values of a path at the steps of a block, (DRAWN_TOGETHER, columns)."""
    parts, columns = np.shape(path.times)
    normal = _normal(path.seed, path.purpose, block, parts * columns).reshape(-1, parts, columns)
    steps = np.empty((DRAWN_TOGETHER + 1, parts, columns))
    steps[0], steps[-1] = _begin(path, block), _begin(path, block + 1)
    apart = DRAWN_TOGETHER // 2
    while apart:
        steps[apart::2 * apart] = _between(path, apart, steps[:-1:2 * apart],
                                           steps[2 * apart::2 * apart], normal[apart::2 * apart])
        apart //= 2
    steps[:-1] *= path.scales
    total: NDArray[np.float64] = steps[:-1, 0]
    for part in range(1, parts):        # np.sum may add in another order
        total = total + steps[:-1, part]
    return total


@lru_cache(256)
def _begin(path: RandomPath, block: int) -> NDArray[np.float64]:
    """
    Return the processes of a path where a block begins, (parts, columns).

    The block with the number 2^k follows from the block 2^(k-1).  Every other block is half-way
    between two with fewer digits, so that some log2(block) values are computed.
    """
    shape = np.shape(path.times)
    normal: NDArray[np.float64] = _normal(path.seed, path.purpose, block, shape[0] * shape[1], 1,
                                          True).reshape(shape)
    if block == 0:
        return np.where(np.isinf(path.times), 0.0, normal)
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
