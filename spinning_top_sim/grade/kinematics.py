# SPDX-License-Identifier: Apache-2.0
"""
What a rigid body does, by its poses at evenly spaced times: rates and accelerations.

Poses are smoothed by a kernel and then differentiated.  Whatever is compared with them is taken to
the world, smoothed by the same kernel, and taken back: as a convolution commutes with a
derivative, smoothing makes no reading wrong, however wide it is.  A smoothing spline would, by its
own bias.  The noise of what comes out follows from the white noise of the poses.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import correlate1d
from scipy.spatial.transform import Rotation

Reals = NDArray[np.float64]
# Central differences of tenth order, for samples 0 .. 5: they are exact to (angle/step)^10/3000.
_FIRST = np.array([0.0, 5.0 / 6, -5.0 / 21, 5.0 / 84, -5.0 / 504, 1.0 / 1260])
_SECOND = np.array([-5269.0 / 1800, 5.0 / 3, -5.0 / 21, 5.0 / 126, -5.0 / 1008, 1.0 / 3150])
FIRST, SECOND = np.append(-_FIRST[:0:-1], _FIRST), np.append(_SECOND[:0:-1], _SECOND)
SIDE = 5                        # samples that a derivative needs on each side
WIDTHS = 1, 3, 5, 9, 15, 25, 41, 65     # of kernels [samples]
ORDER = 10                      # of the differences in which motions vanish and noise does not
MEDIAN = 0.6745                 # of the absolute values of normal noise, in standard deviations
CLEAR = 0.03                    # noise of what is differentiated, relative to it, that is small
GAP = 2.5                       # intervals that are a gap
EVEN = 1e-4                     # share of the interval by which stamps may be uneven
DEGREE = 5                      # of the splines between samples
LEAST = 60                      # samples of a stretch


@cache
def kernel(width: int) -> Reals:
    """Return three boxes of a width, one after another: a quadratic spline of unit sum."""
    box = np.full(width, 1.0 / width)
    return np.convolve(np.convolve(box, box), box)


def gain(width: int, derivative: Reals | None = None) -> float:
    """Return by how much a kernel, and a derivative by samples, multiply white noise."""
    weights = kernel(width) if derivative is None else np.convolve(kernel(width), derivative)
    return float(np.linalg.norm(weights))


def margin(width: int) -> int:
    """Return how many samples a kernel and a derivative need on each side."""
    return len(kernel(width)) // 2 + SIDE


def white(values: Reals) -> Reals:
    """Return the standard deviation of white noise of columns (k,), by high differences."""
    differences = np.abs(np.diff(values, ORDER, axis=0))    # the median does not see jumps
    level: Reals = np.median(differences, axis=0) / math.sqrt(math.comb(2 * ORDER, ORDER))
    return level / MEDIAN


def hat(vectors: Reals) -> Reals:
    """Return the matrices (n, 3, 3) of cross products with vectors (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)


def vee(matrices: Reals) -> Reals:
    """Return the vectors (n, 3) of the antisymmetric parts of matrices (n, 3, 3)."""
    return 0.5 * np.stack((matrices[:, 2, 1] - matrices[:, 1, 2],
                           matrices[:, 0, 2] - matrices[:, 2, 0],
                           matrices[:, 1, 0] - matrices[:, 0, 1]), axis=1)


@dataclass
class Stretch:
    """
    A motion without gaps.

    t : (n,) evenly spaced [s]
    rotation : world <- body
    positions : (n, 3) of the origin of the body in the world [m]
    readings : (n, 3) of sensors by name
    sigma : white noise of the attitudes about each axis [rad], of positions [m], of readings
    intervals : between the samples of each, as they were read [s]
    rates : (n, 3) in the body, where they are known better than by the attitudes [rad/s]
    """

    t: Reals
    rotation: Rotation
    positions: Reals
    readings: Mapping[str, Reals] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    intervals: Mapping[str, float] = field(default_factory=dict)
    rates: Reals | None = None

    @property
    def step(self) -> float:
        """Interval between samples [s]."""
        return float(self.t[-1] - self.t[0]) / (len(self.t) - 1)

    @cached_property
    def matrices(self) -> Reals:
        """The rotations (n, 3, 3)."""
        matrices: Reals = self.rotation.as_matrix()
        return matrices

    def at(self, width: int) -> 'Smoothed':
        """Return the motion smoothed by a kernel."""
        return Smoothed(self, width)

    def noise(self, width: int) -> tuple[float, float, float]:
        """Return the noise of rates, of R^T R'' and of accelerations of the origin."""
        turns, places = self.sigma.get('attitudes', 0.0), self.sigma.get('positions', 0.0)
        first, second = (gain(width, weights) / self.step ** k
                         for k, weights in ((1, FIRST), (2, SECOND)))
        return turns * first, turns * second, places * second


class Smoothed:
    """
    A motion smoothed by a kernel, where a derivative is known: `inner` of its samples.

    turn : smoothed rotation matrices (m, 3, 3)
    rates : angular velocity in the body (m, 3) [rad/s]
    second : R^T R'' (m, 3, 3): its antisymmetric part is that of the angular acceleration, its
        symmetric part that of w x (w x ..) [1/s^2]
    velocity : of the origin in the world (m, 3) [m/s]
    acceleration : of the origin, along axes of the body (m, 3) [m/s^2]
    """

    def __init__(self, body: Stretch, width: int) -> None:
        self.body, self.width, edge = body, width, margin(width)
        self.inner = slice(edge, len(body.t) - edge)
        smooth = self._convolved(body.matrices.reshape(-1, 9))
        self.turn, first, second = (
            correlate1d(smooth, weights, axis=0)[self.inner].reshape(-1, 3, 3) / body.step ** k
            for k, weights in enumerate((np.ones(1), FIRST, SECOND)))
        self.back = self.turn.transpose(0, 2, 1)
        self.rates, self.second = vee(self.back @ first), self.back @ second
        if body.rates is not None:
            change = correlate1d(body.rates, FIRST, axis=0)[self.inner] / body.step
            self.rates, turning = body.rates[self.inner], hat(body.rates[self.inner])
            self.second = hat(change) + turning @ turning
        places = self._convolved(body.positions)
        self.velocity, acceleration = (
            correlate1d(places, weights, axis=0)[self.inner] / body.step ** k
            for k, weights in ((1, FIRST), (2, SECOND)))
        self.acceleration = self._turned(self.back, acceleration)

    def _convolved(self, values: Reals) -> Reals:
        if self.width == 1:
            return values
        smooth: Reals = correlate1d(values, kernel(self.width), axis=0)
        return smooth

    @staticmethod
    def _turned(turn: Reals, vectors: Reals) -> Reals:
        turned: Reals = np.einsum('nij,nj->ni', turn, vectors)
        return turned

    def rate(self, values: Reals) -> Reals:
        """Return rates in the body (n, 3), smoothed as `rates` are (m, 3)."""
        if self.width == 1:
            return values[self.inner]
        matrices = self._convolved((self.body.matrices @ hat(values)).reshape(-1, 9))
        return vee(self.back @ matrices[self.inner].reshape(-1, 3, 3))

    def vector(self, values: Reals) -> Reals:
        """Return vectors in the body (n, 3), smoothed as those of the world are (m, 3)."""
        if self.width == 1:
            return values[self.inner]
        world = self._convolved(self._turned(self.body.matrices, values))
        return self._turned(self.back, world[self.inner])

    def of_world(self, vector: Reals) -> Reals:
        """Return a vector of the world along axes of the body (m, 3)."""
        along: Reals = self.back @ vector
        return along


def stretches(parts: Mapping[str, tuple[Reals, Reals]], notes: list[str]) -> list[Stretch]:
    """
    Return the motions between gaps, with the readings at the same times.

    parts : times (n,) [s] and values (n, k) by name, as of `files.Recorded`

    The interval is that of the attitudes or of the readings, whichever is longer.
    """
    times, quaternions = parts['attitudes']
    others = {name: part for name, part in parts.items() if name != 'attitudes'}
    intervals = {name: float(np.median(np.diff(at))) for name, (at, _) in parts.items()}
    step = max(intervals.values())
    q = quaternions * np.cumprod(np.append(1.0, np.sign(np.sum(
        quaternions[1:] * quaternions[:-1], axis=1) + 1e-300)))[:, np.newaxis]
    values = {'attitudes': (times, q), **others}
    sigma = {name: float(np.linalg.norm(_least([
        white(part) for part in _stretched(at, rows) if len(part) > 2 * ORDER])) / math.sqrt(3.0))
        for name, (at, rows) in values.items()}
    sigma['attitudes'] *= 2.0                   # of an angle
    edges = sorted({edge for at, _ in values.values() for edge in _edges(at)})
    found, left_out = [], 0.0
    for begin, end in pairwise(edges):
        inside = [(at >= begin - 1e-9) & (at <= end + 1e-9) for at, _ in values.values()]
        covered = [np.count_nonzero(one) > 0.5 * (end - begin) / intervals[name]
                   for one, name in zip(inside, values, strict=True)]
        first = max(at[one][0] if np.any(one) else end for (at, _), one in zip(
            values.values(), inside, strict=True))
        last = min(at[one][-1] if np.any(one) else begin for (at, _), one in zip(
            values.values(), inside, strict=True))
        count = int((last - first) / step + 1e-6) + 1
        if not all(covered) or count < LEAST:
            left_out += end - begin
            continue
        even = first + step * np.arange(count)
        at_even = {name: _at(even, at[one], rows[one]) for (name, (at, rows)), one in zip(
            values.items(), inside, strict=True)}
        rotation = Rotation.from_quat(at_even.pop('attitudes'))
        positions = at_even.pop('positions', np.zeros((count, 3)))
        found.append(Stretch(even, rotation, positions - positions[0], at_even, sigma,
                             intervals))
    if left_out > GAP * step:
        notes.append(f'gaps, and parts between them that are too short: {left_out:.3g} s are not '
                     'graded')
    return found


def _edges(times: Reals) -> list[float]:
    gaps = np.flatnonzero(np.diff(times) > GAP * np.median(np.diff(times)))
    return [float(times[0]), *times[gaps].tolist(), *times[gaps + 1].tolist(), float(times[-1])]


def _stretched(times: Reals, values: Reals) -> list[Reals]:
    return np.split(values, np.flatnonzero(np.diff(times) > GAP * np.median(np.diff(times))) + 1)


def _least(levels: list[Reals]) -> Reals:
    """Return the median over stretches."""
    return np.median(levels, axis=0) if levels else np.zeros(1)


def _at(even: Reals, times: Reals, values: Reals) -> Reals:
    """Return values at times, by splines where they are not there already."""
    if len(times) == len(even) and np.max(np.abs(times - even)) < EVEN * (even[1] - even[0]):
        return values
    spline: Reals = make_interp_spline(times, values, min(DEGREE, len(times) - 1))(even)
    return spline
