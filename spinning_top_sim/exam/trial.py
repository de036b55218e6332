# SPDX-License-Identifier: Apache-2.0
"""Feeds a filter with the readings of a run, and checks what it returns."""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.exam.hypotheses import Hypothesis
from spinning_top_sim.exam.measures import Errors, errors_of
from spinning_top_sim.exam.scenarios import Reals, Run
from spinning_top_sim.tools.cli import one_line

# Covariance and bias are read after every tenth update.
READ_EVERY = 10
NORM_TOLERANCE = 1e-3
ASYMMETRIC = 0.01               # difference of a covariance from its transpose, relative
INTERRUPTED = threading.Event()     # ends the exam of a node; rclpy loses KeyboardInterrupts


class Filter(Protocol):
    """
    An attitude filter as the exam uses it.

    It may also have `covariance` (3, 3), of the rotation vector from its attitude to the true one
    [rad^2], and `bias` (3,), of the gyroscope [rad/s].  The exam reads both after updates.  None,
    and a covariance of zeros, means unknown.
    """

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> ArrayLike:
        """
        Take the readings of a step; return the attitude at its end.

        Parameters
        ----------
        gyroscope : (3,) array
            Mean angular velocity over the step [rad/s].
        accelerometer : (3,) array
            Specific force at its end [m/s^2], +g upwards at rest.
        magnetometer : (3,) array or None
            Field at its end [T].
        dt : float
            Length of the step [s].

        Returns
        -------
        (4,) array_like
            q(world <- sensor) as x, y, z, w; x of the world is east, y north and z up.
        """


MakeFilter = Callable[[], Filter]


class InvalidOutputError(Exception):
    """The filter raised an error or returned something invalid; the text is one line."""


class NodeError(RuntimeError):
    """A node cannot be examined: this ends the exam, any other error is a fault of the node."""


# Attitudes, covariances and biases as in `Outcome`.
Output = tuple[Reals, Reals, Reals]
# Feeds a new filter.
Feed = Callable[[MakeFilter, Run], Output]


@dataclass(frozen=True)
class Outcome:
    """Output of a filter along a motion."""

    run: Run
    estimates: Reals        # unit quaternions q(world <- sensor) (n, 4)
    covariances: Reals      # (n, 3, 3) [rad^2], NaN where unknown
    biases: Reals           # (n, 3) [rad/s], NaN where unknown

    @property
    def errors(self) -> Errors:
        """Tilt and heading errors [rad]."""
        return errors_of(self.estimates, self.run.truth)

    def part(self, rows: slice | NDArray[np.intp]) -> 'Outcome':
        """Return the outcome at these samples only."""
        return Outcome(self.run.part(rows), self.estimates[rows], self.covariances[rows],
                       self.biases[rows])

    def last(self, fraction: float = 0.5) -> 'Outcome':
        """Return the last part; by default the second half, in which the filter has settled."""
        return self.part(slice(round(len(self.estimates) * (1.0 - fraction)), None))


def feed(make_filter: MakeFilter, run: Run) -> Output:
    """Return the output of a new filter.  Raises InvalidOutputError if it fails."""
    k, n = 0, len(run.dt)
    attitudes = np.empty((n, 4))
    covariances, biases = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    # Copies, because the filter may keep or change its arguments.
    gyroscope, accelerometer = run.gyroscope.copy(), run.accelerometer.copy()
    fields = [None] * n if np.isnan(run.magnetometer[0, 0]) else run.magnetometer.copy()
    try:
        filter_ = make_filter()
        for k, (rate, force, field, dt) in enumerate(zip(
                gyroscope, accelerometer, fields, run.dt.tolist(), strict=True), start=1):
            attitudes[k - 1] = _numbers(
                f'update {k} returns', filter_.update(rate, force, field, dt), (4,))
            for name, rows in (('covariance', covariances), ('bias', biases)):
                said = getattr(filter_, name, None) if k % READ_EVERY == 0 else None
                if said is not None:
                    rows[k - 1] = _numbers(f'{name} is', said, rows.shape[1:])
    except (InvalidOutputError, NodeError):
        raise
    except (Exception, SystemExit) as error:
        where = f'update {k} of {n}' if k else 'making the filter'
        raise InvalidOutputError(
            f'{where} raises {type(error).__name__}: {one_line(error)}') from error
    covariances[~np.any(covariances, axis=(1, 2))] = np.nan     # in ROS, zeros mean unknown
    for k, why in invalid(attitudes, covariances):
        raise InvalidOutputError(f'update {k + 1}: {why}')
    attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
    return attitudes, covariances, biases


def follow(make_filter: MakeFilter, run: Run, undone: Sequence[Hypothesis] = (),
           feed: Feed = feed) -> Outcome:
    """
    Return the outcome of a run that is fed to a new filter.  Raises InvalidOutputError.

    undone : hypotheses that are inverted; the readings are changed in this order
    """
    fed = run
    for one in undone:
        fed = one.on_readings(fed) if one.on_readings else fed
    try:
        estimates, covariances, biases = feed(make_filter, fed)
    except InvalidOutputError as error:
        raise InvalidOutputError(f'{run.name}: {error}') from error
    for one in reversed(undone):
        estimates = one.on_attitudes(estimates)
    return Outcome(run, estimates, covariances, biases)


def invalid(quaternions: Reals, covariances: Reals) -> Iterator[tuple[int, str]]:
    """Yield the first row of each (n, 4), (n, 3, 3) that is invalid, and why; NaN: unknown."""
    with np.errstate(over='ignore'):
        norms = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))[:1].tolist():
        yield k, f'the quaternion is {quaternions[k].tolist()}: its norm must be 1'
    finite = np.all(np.isfinite(covariances), axis=(1, 2))
    wrong = ~finite & ~np.any(np.isnan(covariances), axis=(1, 2))
    known, other = covariances[finite], np.swapaxes(covariances[finite], 1, 2)
    eigenvalues = np.linalg.eigvalsh(0.5 * known + 0.5 * other)
    largest = np.abs(eigenvalues).max(axis=1)
    wrong[finite] = (eigenvalues[:, 0] < -1e-5 * largest) | (
        np.max(np.abs(known - other), axis=(1, 2)) > ASYMMETRIC * largest)
    for k in np.flatnonzero(wrong)[:1].tolist():
        yield k, (f'the covariance is {covariances[k].tolist()}: must be symmetric and have no '
                  'negative eigenvalue')


def _numbers(what: str, value: object, shape: tuple[int, ...]) -> Reals:
    """Return a copy of a value, which the filter may change later.  Raises InvalidOutputError."""
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != shape or not math.isfinite(np.vdot(numbers, numbers)):
        raise InvalidOutputError(f'{what} {one_line(value)[:80]}: must be '
                                 f'{" x ".join(map(str, shape))} finite numbers')
    return numbers
