# SPDX-License-Identifier: Apache-2.0
"""
What a rigid body does, by its poses at evenly spaced times: rates and accelerations.

Poses are smoothed by a kernel and then differentiated.  Whatever is compared with them is taken to
the world, smoothed by the same kernel, and taken back: as a convolution commutes with a
derivative, smoothing makes no reading wrong, however wide it is.  A smoothing spline would, by its
own bias.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import correlate1d
from scipy.spatial.transform import Rotation

Reals = NDArray[np.float64]
Parts = Mapping[str, tuple[Reals, Reals]]       # times (n,) [s] and values (n, k) by name
# Central differences of tenth order, for samples 0 .. 5: they are exact to (angle/step)^10/3000.
_FIRST = np.array([0.0, 5.0 / 6, -5.0 / 21, 5.0 / 84, -5.0 / 504, 1.0 / 1260])
_SECOND = np.array([-5269.0 / 1800, 5.0 / 3, -5.0 / 21, 5.0 / 126, -5.0 / 1008, 1.0 / 3150])
FIRST, SECOND = np.append(-_FIRST[:0:-1], _FIRST), np.append(_SECOND[:0:-1], _SECOND)
TENTH = _SECOND[-1] * np.array([(-1) ** k * math.comb(10, k) for k in range(11)])
SIDE = 5                        # samples that a derivative needs on each side
WIDTHS = 1, 3, 5, 9, 15, 25, 41, 65     # of kernels [samples]
ORDER = 10                      # of the differences in which motions vanish and noise does not
MEDIAN = 0.6745                 # of the absolute values of normal noise, in standard deviations
LOST, GAP = 1.5, 2.5            # intervals where a sample is missing, for differences; a gap
EVEN = 1e-4                     # share of the interval by which stamps may be uneven
DEGREE = 5                      # of the splines between samples
LEAST = 60                      # samples of a stretch
MOST = 0.7      # that a body turns in a step [rad]: in longer ones rates are not known
# A sample is left out if the error of its derivative is over OUTLIER times the median error and
# over ROUGH times the median second derivative; if more than FEW of all would be, none is.
OUTLIER, ROUGH, FEW = 20.0, 1e-3, 0.1


@cache
def kernel(width: int) -> Reals:
    """Return three boxes of a width, one after another: a quadratic spline of unit sum."""
    box = np.full(width, 1.0 / width)
    return np.convolve(np.convolve(box, box), box)


def margin(width: int) -> int:
    """Return how many samples a kernel and a derivative need on each side."""
    return 3 * (width - 1) // 2 + SIDE


def white(values: Reals, jumps: bool = True) -> float:
    """Return the deviation of white noise by high differences; `jumps` : these count, too."""
    differences = np.abs(np.diff(values, ORDER, axis=0))
    level = np.sqrt(np.mean(differences ** 2)) if jumps else np.median(differences) / MEDIAN
    return float(level) / math.sqrt(math.comb(2 * ORDER, ORDER))


def _hat(vectors: Reals) -> Reals:
    """Return the matrices (n, 3, 3) of cross products with vectors (n, 3)."""
    return np.cross(vectors[:, np.newaxis, :], np.eye(3)).transpose(0, 2, 1)


def _vee(matrices: Reals) -> Reals:
    """Return the vectors (n, 3) of the antisymmetric parts of matrices (n, 3, 3)."""
    upper, lower = matrices[:, [1, 2, 0], [2, 0, 1]], matrices[:, [2, 0, 1], [1, 2, 0]]
    return 0.5 * (lower - upper)


def along(matrices: Reals, vectors: Reals) -> Reals:
    """Return the products of matrices (n, 3, 3) and vectors (n, 3)."""
    return np.einsum('nij,nj->ni', matrices, vectors)


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

    def part(self, chosen: slice) -> 'Stretch':
        """Return some of the samples."""
        return replace(self, t=self.t[chosen], rotation=self.rotation[chosen],
                       positions=self.positions[chosen], readings={
                           name: values[chosen] for name, values in self.readings.items()})

    def noisier(self, random: np.random.Generator) -> 'Stretch':
        """Return the same with as much noise again."""
        def noise(name: str) -> Reals:
            return self.sigma.get(name, 0.0) * random.standard_normal((len(self.t), 3))

        return replace(
            self, rotation=self.rotation * Rotation.from_rotvec(noise('attitudes')),
            positions=self.positions + noise('positions'),
            readings={name: values + noise(name) for name, values in self.readings.items()})

    @property
    def coarse(self) -> bool:
        """Whether there are too few samples to know the rates."""
        angles = (self.rotation[:-1].inv() * self.rotation[1:]).magnitude()
        return float(np.quantile(angles, 1.0 - FEW)) > MOST

    @cached_property
    def matrices(self) -> Reals:
        """The rotations (n, 3, 3)."""
        return np.asarray(self.rotation.as_matrix())


class Smoothed:
    """
    A motion smoothed by a kernel, where a derivative is known: `inner` of its samples.

    turn, back : smoothed rotation matrices, and their transposes (m, 3, 3)
    rates : angular velocity in the body (m, 3) [rad/s]
    second : R^T R'' (m, 3, 3): its antisymmetric part is that of the angular acceleration, its
        symmetric part that of w x (w x ..) [1/s^2]
    acceleration : of the origin, along axes of the body (m, 3) [m/s^2]
    smooth : which samples (m,) are kept: none where a force sets in suddenly, which makes
        derivatives of samples wrong
    """

    def __init__(self, body: Stretch, width: int) -> None:
        self.body, self.width, edge = body, width, margin(width)
        self.inner = slice(edge, len(body.t) - edge)
        smooth = self._convolved(body.matrices.reshape(-1, 9))
        self.turn, first, second = (
            correlate1d(smooth, weights, axis=0)[self.inner].reshape(-1, 3, 3) / body.step ** k
            for k, weights in enumerate((np.ones(1), FIRST, SECOND)))
        self.back = self.turn.transpose(0, 2, 1)
        self.rates, self.second = _vee(self.back @ first), self.back @ second
        if body.rates is not None:
            change = correlate1d(body.rates, FIRST, axis=0)[self.inner] / body.step
            self.rates, turning = body.rates[self.inner], _hat(body.rates[self.inner])
            self.second = _hat(change) + turning @ turning
        places = self._convolved(body.positions)
        self.acceleration = along(self.back, correlate1d(places, SECOND, axis=0)[self.inner]
                                  / body.step ** 2)
        self.smooth = np.ones(len(self.rates), bool)
        for values in (smooth, places):
            error, size = (np.linalg.norm(correlate1d(values, weights, axis=0)[self.inner], axis=1)
                           for weights in (TENTH, SECOND))
            self.smooth &= error <= np.maximum(OUTLIER * np.median(error), ROUGH * np.median(size))
        if np.mean(self.smooth) < 1.0 - FEW:
            self.smooth[:] = True

    def _convolved(self, values: Reals) -> Reals:
        return np.asarray(correlate1d(values, kernel(self.width), axis=0))

    def rate(self, values: Reals) -> Reals:
        """Return rates in the body (n, 3), smoothed as `rates` are (m, 3)."""
        if self.width == 1:
            return values[self.inner]
        matrices = self._convolved((self.body.matrices @ _hat(values)).reshape(-1, 9))
        return _vee(self.back @ matrices[self.inner].reshape(-1, 3, 3))

    def vector(self, values: Reals) -> Reals:
        """Return vectors in the body (n, 3), smoothed as those of the world are (m, 3)."""
        return along(self.back, self._convolved(along(self.body.matrices, values))[self.inner])


def stretches(parts: Parts) -> tuple[list[Stretch], float]:
    """
    Return the motions between gaps, with the readings at the same times, and what is left out [s].

    parts : with 'attitudes', q(world <- body) as x, y, z, w; also 'positions', and readings

    The interval is that of the attitudes or of the readings, whichever is longer.
    """
    times, q = parts['attitudes']
    signs = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
    parts = {**parts, 'attitudes': (times, q * np.cumprod([1.0, *signs])[:, np.newaxis])}
    intervals = {name: float(np.median(np.diff(at))) for name, (at, _) in parts.items()}
    step, sigma, spans = max(intervals.values()), {}, [(-math.inf, math.inf)]
    for name, (at, rows) in parts.items():
        whole, pieces = ([*zip([0, *ends], [*ends, len(at)], strict=True)] for ends in (
            1 + np.flatnonzero(np.diff(at) > most * intervals[name]) for most in (LOST, GAP)))
        squares = [(_noise(name, rows[a:b]) ** 2, b - a) for a, b in whole if b - a > 2 * ORDER]
        sigma[name] = math.sqrt(sum(one * n for one, n in squares)
                                / max(sum(n for _, n in squares), 1))
        spans = [(max(first, at[a]), min(last, at[b - 1])) for first, last in spans
                 for a, b in pieces if at[a] < last and at[b - 1] > first]
    found, left_out = [], max(at[-1] for at, _ in parts.values()) - min(
        at[0] for at, _ in parts.values())
    for first, last in spans:
        count = int((last - first) / step + 1e-6) + 1
        if count < LEAST:
            continue
        left_out -= last - first
        even: Reals = first + step * np.arange(count, dtype=float)
        values = {name: _at(even, *one) for name, one in parts.items()}
        # Stamps that are not exact make noise, too.
        noise = {name: max(one, _noise(name, values[name])) for name, one in sigma.items()}
        rotation = Rotation.from_quat(values.pop('attitudes'))
        positions = values.pop('positions', np.zeros((count, 3)))
        found.append(Stretch(even, rotation, positions - positions[0], values, noise, intervals))
    return found, left_out if left_out > step else 0.0


def _noise(name: str, values: Reals) -> float:
    """Return the deviation of white noise of a part, of attitudes about each axis [rad]."""
    # Four components of half an angle.
    return white(values, name in ('attitudes', 'positions')) * (
        4.0 / math.sqrt(3.0) if name == 'attitudes' else 1.0)


def _at(even: Reals, times: Reals, values: Reals) -> Reals:
    """Return values at times, by splines where they are not there already."""
    rows = slice(max(int(np.searchsorted(times, even[0] + 1e-9)) - 1, 0),
                 int(np.searchsorted(times, even[-1] - 1e-9)) + 1)
    times, values = times[rows], values[rows]
    if len(times) == len(even) and np.max(np.abs(times - even)) < EVEN * (even[1] - even[0]):
        return values
    spline: Reals = make_interp_spline(times, values, DEGREE)(even)
    return spline
