# SPDX-License-Identifier: Apache-2.0
"""What the outcome of the excitation shows: fits of a filter's response to its inputs."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.excitation import ANSWER_S, ASTRAY, KICKS, Excitation
from spinning_top_sim.exam.hypotheses import AXES
from spinning_top_sim.exam.measures import increments, rms
from spinning_top_sim.exam.scenarios import Reals
from spinning_top_sim.exam.trial import Outcome
from spinning_top_sim.tools.verdict import Fault

WHOLE, EARLY, LATEST = 90, 10, 25       # samples of a turn and its response; the longest delay
DELAY_LEAVES = 0.5              # most of the residual of the response, without a delay it is 1
# An error is not corrected if more than STAYS of it is left, and grows if more than GROWN; where
# less than NEARLY is left, nothing is measured again.
NEARLY, STAYS, GROWN = 0.9, 0.995, 1.02
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


def answer_to_kicks(estimates: Reals, without: Reals, excitation: Excitation,
                    absolute: bool) -> Reals:
    """
    Return the matrix from an attitude error at rest to what is left of it after ANSWER_S.

    An error is a rotation vector about axes of the world.  An eigenvalue of 1 is that of an error
    that stays, such as one about an axis of the sensor that nothing corrects.

    estimates, without : attitudes (n, 4) with kicks and without them
    absolute : the matrix is (3, 3); otherwise (2, 2), of tilts

    Of the matrices at two rests, that of the level one counts if an error stays there, else the
    one with the larger spectral radius.
    """
    n = round(ANSWER_S * scenarios.SLOW.rate)
    errors = Rotation.from_quat(estimates) * Rotation.from_quat(without).inv()
    kicks, axes = (slice(None), slice(None)) if absolute else (slice(1, None), slice(2))
    answers = []
    for firsts in excitation.kicks:
        left = errors[np.append(firsts, firsts[-1] + n) - 1]
        left = left * left[0].inv()
        begin, end = (left[:-1] * Rotation.from_rotvec(KICKS)).as_rotvec(), left[1:].as_rotvec()
        answers.append(np.linalg.lstsq(begin[kicks, axes], end[kicks, axes], rcond=None)[0].T)
    # At the second rest, heading and tilt are still moved by what earlier kicks have left.
    answers[1][:2, 2:] = answers[1][2:, :2] = 0.0
    return max(answers[:1] if most_left(answers[0]) > STAYS else answers, key=most_left)


def most_left(answer: Reals) -> float:
    """Return the spectral radius of what `answer_to_kicks` returns."""
    return float(np.max(np.abs(np.linalg.eigvals(answer))))


def not_corrected(answer: Reals) -> list[Fault]:
    """Name the sensors that do not correct kicks; `answer` as from `answer_to_kicks`."""
    most = most_left(answer)
    if most > GROWN:        # by which sensor, and whether by the bias, is not known
        return [Fault('inaccurate', f'an error grows to {most:.0%} in {ANSWER_S:g} s at rest')]
    heading = float(np.linalg.norm(answer[:, 2])) if len(answer) == 3 else 0.0
    tilt = np.sum(np.abs(np.linalg.eigvals(answer)) > STAYS) > (heading > STAYS)
    return [Fault(f'{sensor}_wiring', f'{left:.1%} of an error of the {what} are left after '
                  f'{ANSWER_S:g} s: the {sensor} does not correct it')
            for stays, sensor, what, left in (
                (tilt, 'accelerometer', 'tilt', most),
                # One that grows is turned by a tilt that stays.
                (STAYS < heading < GROWN, 'magnetometer', 'heading', heading)) if stays]


def astray(outcome: Outcome, excitation: Excitation, absolute: bool) -> list[Fault]:
    """Return the fault of a filter that, turned far off north, turns farther."""
    errors = np.abs(outcome.part(excitation.astray).errors.heading)
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
