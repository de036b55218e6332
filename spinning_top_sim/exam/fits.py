# SPDX-License-Identifier: Apache-2.0
"""What the outcome of the excitation shows: fits of a filter's response to turns and at rest."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.hypotheses import AXES
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.scenarios import Reals
from spinning_top_sim.exam.trial import Outcome

WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its response; the longest delay
DELAY_LEAVES = 0.5              # most of the residual of the response, without a delay it is 1


class Turns(NamedTuple):
    """Increments of the attitude over those of the sensor; the identity for a right filter."""

    whole: Reals        # matrix (3, 3) of whole turns
    early: Reals        # of their begins
    late: int           # delay of whole turns in samples; 0 if none explains the response

    @property
    def off(self) -> float:
        """How far the nearer matrix is from the identity."""
        return min(from_identity(self.whole), from_identity(self.early))


def turns_of(outcome: Outcome, begins: NDArray[np.intp]) -> Turns:
    """Fit the response to turns that begin with these samples."""
    estimated, true = increments(outcome.estimates), increments(outcome.run.truth)

    def fit(length: int, late: int) -> tuple[Reals, float]:
        rows = (begins[:, np.newaxis] + np.arange(length)).ravel()
        turned, response = true[rows - late], estimated[rows]
        matrix = np.linalg.lstsq(turned, response, rcond=None)[0]
        return matrix.T, rms(response - turned @ matrix)

    fits = [fit(WHOLE, late) for late in range(LATEST + 1)]
    late = int(np.argmin([left for _, left in fits]))
    if fits[late][1] > DELAY_LEAVES * fits[0][1]:
        late = 0
    return Turns(fits[late][0], fit(EARLY, 0)[0], late)


def from_identity(matrix: Reals) -> float:
    """Return how far a matrix is from the identity."""
    return float(np.max(np.abs(matrix - np.eye(3))))


def affine_of(readings: Reals, estimated: Rotation, level: Sequence[int],
              offset_only: bool) -> tuple[Reals, float]:
    """
    Fit the affine change of readings (n, 3) that attitudes at rest show.

    level : axes of the world along which changed readings are zero
    offset_only : the matrix is the identity

    Returns the change (4, 4) in homogeneous coordinates, and the share of the error that is left.
    """
    across = np.concatenate([estimated.inv().apply(np.eye(3)[axis]) for axis in level])
    readings = np.tile(readings, (len(level), 1))
    matrix = np.hstack(((across[:, :, np.newaxis] * readings[:, np.newaxis]).reshape(-1, 9),
                        across))
    wanted = -np.sum(across * readings, axis=1)
    first = 9 * offset_only         # of the entries of matrix and offset that are fitted
    # The readings have no scale: the trace remains.
    rows = np.vstack((matrix, 10.0 * np.append(np.eye(3), np.zeros(3))))[:, first:]
    found = np.linalg.lstsq(rows, np.append(wanted, 0.0), rcond=1e-3)[0]
    entries = np.append(np.zeros(first), found)
    change = np.eye(4)
    change[:3] += np.hstack((entries[:9].reshape(3, 3), entries[9:, np.newaxis]))
    change[:3] /= np.median(np.diag(change)[:3])    # most axes are right
    return change, rms(matrix @ entries - wanted) / max(rms(wanted), 1e-6)


def axes_moved(estimates: Reals, others: Reals, absolute: bool) -> Reals:
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
