# SPDX-License-Identifier: Apache-2.0
"""Feeds a filter with the readings of runs, and checks what it returns."""

import contextlib
import math
import signal
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.exam.motions import Reals, Run
from spinning_top_sim.tools.cli import one_line

READ_EVERY = 10                 # updates after which covariance and bias are read
# Of a norm of 1, and of the symmetry of a covariance: some filters normalise to first order.
TOLERANCE = 1e-3
ANSWER_S = 5.0                  # a program may take as long for an answer
UPDATE_S = 0.01                 # an update may take, in the mean, as long as a sample lasts


class Filter(Protocol):
    """
    An attitude filter as the exam uses it; `examine` describes the arguments of `update`.

    It may also have `covariance` (3, 3), of the rotation vector from its attitude to the true one
    [rad^2], and `bias` (3,), of the gyroscope [rad/s].  The exam reads both after updates.  None,
    and a covariance of zeros, means unknown.
    """

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> ArrayLike:
        """Take the readings of a step; return the attitude at its end."""


MakeFilter = Callable[[], Filter]


class InvalidOutputError(Exception):
    """The filter raised an error or returned something invalid; the text is one line."""


class NodeError(RuntimeError):
    """A node cannot be examined: this ends the exam, any other error is a fault of the node."""


@dataclass(frozen=True)
class Outcome:
    """What a filter has said along a run."""

    run: Run
    estimates: Reals        # unit quaternions as the filter tells them (n, 4)
    covariances: Reals      # (n, 3, 3) [rad^2], NaN where unknown
    biases: Reals           # (n, 3) [rad/s], NaN where unknown

    def part(self, rows: slice | NDArray[np.intp]) -> 'Outcome':
        """Return the outcome at these samples only."""
        return Outcome(self.run.part(rows), self.estimates[rows], self.covariances[rows],
                       self.biases[rows])


# Feeds a new filter with each run.
Feed = Callable[[MakeFilter, Sequence[Run]], list[Outcome]]


def feed(make_filter: MakeFilter, runs: Sequence[Run]) -> list[Outcome]:
    """Return the outcomes of new filters, one for each run.  Raises InvalidOutputError."""
    return [_feed(make_filter, run) for run in runs]


def _feed(make_filter: MakeFilter, run: Run) -> Outcome:
    k, n = 0, len(run.dt)
    attitudes = np.empty((n, 4))
    covariances, biases = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    # Copies, because the filter may keep or change its arguments.
    gyroscope, accelerometer = run.gyroscope.copy(), run.accelerometer.copy()
    fields = [None] * n if np.isnan(run.magnetometer[0, 0]) else run.magnetometer.copy()
    filter_: Any = None
    try:
        filter_ = make_filter()
        for k, (rate, force, field, dt) in enumerate(zip(
                gyroscope, accelerometer, fields, run.dt.tolist(), strict=True), start=1):
            attitudes[k - 1] = _numbers('update returns', filter_.update(rate, force, field, dt),
                                        (4,))
            for name, rows in (('covariance', covariances), ('bias', biases)):
                said = getattr(filter_, name, None) if k % READ_EVERY == 0 else None
                if said is not None:
                    rows[k - 1] = _numbers(f'{name} is', said, rows.shape[1:])
    except NodeError:
        raise
    except (Exception, SystemExit) as error:
        what = error if isinstance(error, InvalidOutputError) else (
            f'raises {type(error).__name__}: {one_line(error)}')
        raise InvalidOutputError(f'{run.name}, update {k} of {n}: {what}') from error
    finally:
        if callable(close := getattr(filter_, 'close', None)):
            close()
    covariances[~np.any(covariances, axis=(1, 2))] = np.nan     # in ROS, zeros mean unknown
    if (wrong := invalid(attitudes, covariances)) is not None:
        raise InvalidOutputError(f'{run.name}, update {wrong[0] + 1} of {n}: {wrong[1]}')
    attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
    return Outcome(run, attitudes, covariances, biases)


def feed_apart(make_filter: MakeFilter, runs: Sequence[Run]) -> list[Outcome]:
    """
    Do as `feed` in a fork of this process, so that hanging or crashing harms nothing else.

    Raises InvalidOutputError for a filter that crashes or never returns, too.
    """
    context = get_context('fork')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(make_filter, runs, sender))
    with warnings.catch_warnings():
        # The fork runs the filter only, and needs no other thread.
        warnings.simplefilter('ignore', DeprecationWarning)
        process.start()
    sender.close()
    updates = sum(len(run.dt) for run in runs)
    patience = ANSWER_S + UPDATE_S * updates
    try:
        if not receiver.poll(patience):
            raise InvalidOutputError(f'{runs[0].name}: {updates} updates take more than '
                                     f'{patience:g} s')
        with contextlib.suppress(EOFError):
            output: list[Outcome] | Exception = receiver.recv()
            if isinstance(output, Exception):
                raise output
            return output
        process.join()
        raise InvalidOutputError(f'{runs[0].name}: the filter ends the process, exit code '
                                 f'{process.exitcode}')
    finally:
        process.kill()
        process.join()
        receiver.close()


def _serve(make_filter: MakeFilter, runs: Sequence[Run], sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)        # no traceback after Ctrl-C
    try:
        sender.send(feed(make_filter, runs))
    except InvalidOutputError as error:
        sender.send(error)


def invalid(quaternions: Reals, covariances: Reals) -> tuple[int, str] | None:
    """Return the first row of (n, 4) or (n, 3, 3) that is invalid, and why; NaN: unknown."""
    with np.errstate(over='ignore'):
        norms = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(~(np.abs(norms - 1.0) <= TOLERANCE))[:1].tolist():
        return k, f'the quaternion is {quaternions[k].tolist()}: its norm must be 1'
    for k in np.flatnonzero(~np.all(np.isnan(covariances), axis=(1, 2))).tolist():
        matrix = covariances[k]
        size = float(np.max(np.abs(matrix)))
        if not (np.isfinite(size) and np.max(np.abs(matrix - matrix.T)) <= TOLERANCE * size
                and np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0] >= -TOLERANCE * size):
            return k, (f'the covariance is {matrix.tolist()}: must be symmetric and have no '
                       'negative eigenvalue')
    return None


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
