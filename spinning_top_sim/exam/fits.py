# SPDX-License-Identifier: Apache-2.0
"""What the outcome of the excitation shows: fits of a filter's response to its inputs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.excitation import ANSWER_S, ASTRAY, KICKS, Excitation, Kick
from spinning_top_sim.exam.hypotheses import AXES
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.scenarios import Reals
from spinning_top_sim.exam.trial import Outcome
from spinning_top_sim.tools.verdict import Fault

WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its response; the longest delay
DELAY_LEAVES = 0.5              # most of the residual of the response, without a delay it is 1
# A kick is not corrected if more than STAYS is left, and grows if GROWN times its least is left.
STAYS, GROWN = 0.995, 1.15
FARTHER = 1.03                  # of the error after the heading is turned: no right filter's


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
        given, response = true[rows - late], estimated[rows]
        matrix = np.linalg.lstsq(given, response, rcond=None)[0]
        return matrix.T, rms(response - given @ matrix)

    fits = [fit(WHOLE, late) for late in range(LATEST + 1)]
    late = int(np.argmin([left for _, left in fits]))
    if fits[late][1] > DELAY_LEAVES * fits[0][1]:
        late = 0
    return Turns(fits[late][0], fit(EARLY, 0)[0], late)


def from_identity(matrix: Reals) -> float:
    """Return how far a matrix is from the identity."""
    return float(np.max(np.abs(matrix - np.eye(3))))


def not_corrected(estimates: Reals, without: Reals, given: Excitation,
                  absolute: bool) -> list[Fault]:
    """Name the sensors that do not correct a kick; attitudes with kicks and `without`, (n, 4)."""
    n = round(ANSWER_S * scenarios.SLOW.rate)
    error = (Rotation.from_quat(estimates) * Rotation.from_quat(without).inv()).as_rotvec()

    def shares(first: int, kick: Kick) -> tuple[float, float]:
        """Return what is left of a kick in the end, and the least of it."""
        sizes = np.linalg.norm((error[first + LATEST:first + n] - error[first - 1])[:, kick.part],
                               axis=1)
        # Some filters correct most of it before the longest delay is over.
        whole = max(sizes[0], 0.5 * np.linalg.norm(kick.turn))
        return sizes[-1] / whole, np.min(sizes) / whole

    heading, tilt = ((kick, *max(shares(first, kick) for first in starts))
                     for kick, starts in zip(KICKS, zip(*given.kicks, strict=True), strict=True))
    found = [one for one in (tilt, heading)[:1 + absolute] if one[1] > STAYS]
    grown = [f'of the {kick.what} grows to {left:.0%}' for kick, left, least in found
             if left > GROWN * least]
    if grown:       # by which sensor, and whether by the bias, is not known
        return [Fault('inaccurate', f'an error {" and ".join(grown)} in {ANSWER_S:g} s at rest')]
    return [Fault(f'{kick.sensor}_wiring', f'{left:.1%} of an error of the {kick.what} are left '
                  f'after {ANSWER_S:g} s: the {kick.sensor} does not correct it')
            for kick, left, _ in found]


def astray(outcome: Outcome, given: Excitation, absolute: bool) -> list[Fault]:
    """Return the fault of a filter that, turned far off north, turns farther."""
    errors = np.abs(outcome.part(given.astray).errors.heading)
    if not absolute or np.max(errors) < max(ASTRAY, FARTHER * errors[0]):
        return []
    return [Fault('inaccurate', f'turned off north by {np.degrees(errors[0]):.0f} deg, it turns '
                  f'to {np.degrees(np.max(errors)):.0f} deg')]


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
