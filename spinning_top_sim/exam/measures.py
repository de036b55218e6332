# SPDX-License-Identifier: Apache-2.0
"""Error measures of an attitude filter; docs/exam.md has the definitions and their sources."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.motions import ROUNDING, Reals
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.identify import autocorrelation_time, rms

# Of the band of a squared error: standard deviations; factors by which a covariance may be too
# small and, to be on the safe side, too large.
SIGMAS, SMALL, LARGE = 4.0, 2.0, 10.0


def rmse(estimates: Reals, truth: Reals) -> Reals:
    """
    Return the root mean squares of the whole error of attitudes (n, 4), of heading and tilt [deg].

    They are those of BROAD's evaluation; the heading is absolute.
    """
    errors = errors_of(estimates, truth)
    whole = np.linalg.norm(turns(truth, estimates), axis=1)
    return np.degrees([rms(one) for one in (whole, errors.heading, errors.tilt)])


def increments(quaternions: Reals) -> Reals:
    """Return the rotation vectors of the steps (n, 3) about axes of the sensor."""
    attitudes = Rotation.from_quat(quaternions)
    return np.concatenate((np.zeros((1, 3)), (attitudes[:-1].inv() * attitudes[1:]).as_rotvec()))


def up(quaternions: Reals) -> Reals:
    """Return where attitudes (..., 4) take the vertical to be, in axes of the sensor (..., 3)."""
    vertical: Reals = Rotation.from_quat(quaternions).inv().apply((0.0, 0.0, 1.0))
    return vertical


def turns(one: Reals, other: Reals) -> Reals:
    """Return the rotation vector from attitudes to others about axes of the world (..., 3)."""
    vector: Reals = (Rotation.from_quat(other) * Rotation.from_quat(one).inv()).as_rotvec()
    return vector


def largest_turn(one: Reals, other: Reals) -> float:
    """Return the largest turn from attitudes (n or 1, 4) to others (n, 4) [rad]."""
    return float(np.max(np.linalg.norm(turns(one, other), axis=1)))


def differ(one: Reals, other: Reals) -> bool:
    """Return whether attitudes (n, 4) are others than these, beyond rounding."""
    return bool(np.max(np.abs(one - other)) > ROUNDING)


def degrees(angle: float) -> str:
    """Return an angle [rad] in words."""
    return f'{math.degrees(angle):.3g} deg'


class Nees(NamedTuple):
    """Mean squared error of the tilt over its covariance, 1 if consistent, and its band."""

    ratio: float
    low: float
    high: float

    @property
    def band(self) -> str:
        """The band in words."""
        return f'consistent are {self.low:.3g} to {self.high:.3g}'

    def __str__(self) -> str:
        return (f'the squared error of the tilt is {self.ratio:.3g} times what the covariance '
                f'says; {self.band}')


def nees_of(outcomes: Sequence[Outcome]) -> Nees | None:
    """
    Return the normalised squared error of the tilt (Bar-Shalom et al. 2001, 5.4.2).

    The covariance may refer to the axes of the sensor or of the world: the assumption with the
    greater likelihood counts.  One error of each autocorrelation time is independent.  None: there
    is no covariance, or it has no inverse.  The first quarter of each outcome does not count.
    """
    last = [one.part(slice(len(one.run.dt) // 4, None)) for one in outcomes]
    known = [one.part(np.flatnonzero(np.isfinite(one.covariances[:, 0, 0]))) for one in last]
    found = []
    for in_sensor in (True, False):
        pairs = [_squares(one, in_sensor) for one in known if len(one.run.dt)]
        if not pairs or not np.all(np.isfinite(np.concatenate([size for _, size in pairs]))):
            continue
        mean = max(float(np.mean(np.concatenate([squares for squares, _ in pairs]))), 1e-300)
        count = sum(len(one) / autocorrelation_time(one) for one, _ in pairs)
        spread = math.exp(SIGMAS / math.sqrt(count))
        # Negative log-likelihood for the best common factor of the covariances.
        unlikely = 2.0 * math.log(mean) + float(np.mean([np.mean(size) for _, size in pairs]))
        found.append((unlikely, Nees(0.5 * mean, 1.0 / (LARGE * spread), SMALL * spread)))
    return min(found)[1] if found else None


def _squares(outcome: Outcome, in_sensor: bool) -> tuple[Reals, Reals]:
    """Return e^T P^-1 e of the tilts e (n,), and the logarithms of det P, NaN if not positive."""
    estimated, p = Rotation.from_quat(outcome.estimates), outcome.covariances
    if in_sensor:
        turn = estimated.as_matrix()
        p = turn @ p @ turn.transpose(0, 2, 1)
    x, y, _ = (estimated * Rotation.from_quat(outcome.run.truth).inv()).apply((0.0, 0.0, 1.0)).T
    (a, b), (_, c) = p[:, :2, :2].transpose(1, 2, 0)
    with np.errstate(all='ignore'):
        determinant = a * c - b * b
        return (c * y * y + 2.0 * b * x * y + a * x * x) / determinant, np.log(determinant)


def from_two_vectors(up: Reals, magnetometer: Reals | None) -> Reals:
    """
    Return the attitude in which `up` is vertical and the field has no east component (TRIAD).

    up, magnetometer : (3,) or (n, 3); without a field (3,), and the heading is arbitrary
    """
    z = up / np.linalg.norm(up, axis=-1, keepdims=True)
    north = magnetometer if magnetometer is not None else np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(north, z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    quaternion: Reals = Rotation.from_matrix(np.stack((x, np.cross(z, x), z), axis=-2)).as_quat()
    return quaternion
