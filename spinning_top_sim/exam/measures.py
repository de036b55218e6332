# SPDX-License-Identifier: Apache-2.0
"""Error measures of an attitude filter; docs/exam.md has the definitions and their sources."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Outcome
from spinning_top_sim.exam.motions import Reals
from spinning_top_sim.tools.conventions import errors_of
from spinning_top_sim.tools.identify import rms

ROUNDING = float(np.finfo(np.float32).eps)      # of filters in single precision, relative
# Factors by which a covariance may be too small, and too large: those tuned for accelerations are
# some 100, degrees instead of radians 3283.
NEES_OFF = 4.0, 1000.0
USELESS_DEG = 10.0      # a larger error than that of any published filter with tuned gains


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


def settled(quaternions: Reals, most: float) -> bool:
    """Return whether the second half of attitudes (n, 4) turns by less [rad]."""
    later = quaternions[len(quaternions) // 2:]
    return largest_turn(later[:1], later) < most


def degrees(angle: float) -> str:
    """Return an angle [rad] in words."""
    return f'{math.degrees(angle):.3g} deg'


def nees_of(outcomes: Sequence[Outcome]) -> float | None:
    """
    Return the normalised squared error of the tilt (Bar-Shalom et al. 2001, 5.4.2).

    It is 1 if consistent, below 1 that of the worse principal axis.  The covariance may be about
    the axes of the sensor or of the world: the better one counts.  None: there is no covariance.
    """
    squares = []
    for outcome in outcomes:
        one = outcome.part(np.flatnonzero(np.isfinite(outcome.covariances[:, 0, 0])))
        if not len(one.run.dt):
            return None
        turn = Rotation.from_quat(one.estimates).as_matrix()
        variances, axes = np.linalg.eigh(np.stack((
            one.covariances, turn @ one.covariances @ turn.transpose(0, 2, 1)))[..., :2, :2])
        tilt = np.einsum('ni,fnij->fnj', turns(one.estimates, one.run.truth)[:, :2], axes)
        least = ROUNDING ** 2 * np.trace(one.covariances, axis1=1, axis2=2)[:, np.newaxis]
        squares.append(tilt ** 2 / np.maximum(variances, least))
    means = np.maximum(np.mean(np.concatenate(squares, axis=1), axis=1), ROUNDING)
    both, least = np.mean(means, axis=1), np.min(means, axis=1)
    return float(min(np.where(both * least > 1.0, both, least),
                     key=lambda ratio: abs(math.log(ratio))))


def from_two_vectors(up: Reals, magnetometer: Reals | None) -> Reals:
    """
    Return the attitude in which `up` is vertical and the field has no east component (TRIAD).

    up, magnetometer : (3,); without a field the heading is arbitrary
    """
    north = magnetometer if magnetometer is not None else np.eye(3)[np.argmin(np.abs(up))]
    x = np.cross(north, up)
    rows = np.stack((x, np.cross(up, x), up))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    quaternion: Reals = Rotation.from_matrix(rows).as_quat()
    return quaternion
