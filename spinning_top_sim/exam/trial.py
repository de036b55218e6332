# SPDX-License-Identifier: Apache-2.0
"""A filter, fed with a run: what it says, and what is wrong with that."""

import contextlib
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.exam.measures import Errors, errors_of
from spinning_top_sim.exam.scenarios import Reals, Run, Truth

# A covariance and a bias are read after so many updates.
READ_EVERY = 10
# A filter may take this many times as long as the run lasts; it may compile itself first.
SLOWEST = 2.0
# Its second number is how long this thread has waited for a processor [ns].
WAITING = Path('/proc/thread-self/schedstat')
NORM_TOLERANCE = 1e-3


class Filter(Protocol):
    """
    What the exam takes for an attitude filter.

    It may also have `covariance` (3, 3), of the rotation vector from its attitude to the true one
    [rad^2], and `bias` (3,), of the gyroscope [rad/s].  The exam reads both after updates.
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
# Takes gyroscope and accelerometer (n, 3) and the steps (n,); returns what to give instead.
Input = Callable[[Reals, Reals, Reals], tuple[Reals, Reals]]
Output = Callable[[Reals], Reals]


class InvalidOutputError(Exception):
    """What a filter returned, or that it raised an error, in one line."""


class NodeError(Exception):
    """A node cannot be examined; the text says why, and what to check."""


class Readings(NamedTuple):
    """What a filter gets: (n, 3) each, the field None for none, and the steps (n,) [s]."""

    gyroscope: Reals
    accelerometer: Reals
    magnetometer: Reals | None
    dt: Reals


class Said(NamedTuple):
    """
    What a filter said.

    estimates : q(world <- sensor) (n, 4), of norm 1
    read : numbers of the samples after which covariance and bias were read (m,)
    covariances, biases : (m, 3, 3) [rad^2] and (m, 3) [rad/s]; None if the filter has none
    """

    estimates: Reals
    read: NDArray[np.int64]
    covariances: Reals | None
    biases: Reals | None


# Feeds a new filter.
Feed = Callable[[MakeFilter, Readings], Said]


@dataclass(frozen=True)
class Outcome:
    """What a filter said along a motion, as `Said` has it."""

    run: Truth
    estimates: Reals
    read: NDArray[np.int64]
    covariances: Reals | None
    biases: Reals | None

    @property
    def errors(self) -> Errors:
        """Tilt and heading errors [rad]."""
        return errors_of(self.estimates, self.run.truth)

    def later(self, fraction: float = 0.5) -> 'Outcome':
        """Return the last part of the outcome: when the filter has settled."""
        return self.since(round(len(self.estimates) * (1.0 - fraction)))

    def since(self, first: int) -> 'Outcome':
        """Return the outcome from a sample on."""
        kept = self.read >= first
        return replace(
            self, run=self.run.part(slice(first, None)), estimates=self.estimates[first:],
            read=self.read[kept] - first,
            covariances=None if self.covariances is None else self.covariances[kept],
            biases=None if self.biases is None else self.biases[kept])


def same(estimates: Reals) -> Reals:
    """Return what is given."""
    return estimates


def feed(make_filter: MakeFilter, readings: Readings,
         tell: Callable[[int], object] = lambda number: None) -> Said:
    """
    Feed a new filter.

    tell : is called before each update with its number, from 1 on

    Raises InvalidOutputError for a filter that raises, returns no unit quaternion or is too slow.
    """
    k = 0
    said: list[object] = []
    numbers: list[int] = []
    covariances: list[object] = []
    biases: list[object] = []
    # The filter may keep or change what it gets.
    gyroscope, accelerometer = readings.gyroscope.copy(), readings.accelerometer.copy()
    fields = ([None] * len(gyroscope) if readings.magnetometer is None else
              readings.magnetometer.copy())
    try:
        filter_ = make_filter()
        update = filter_.update
        allowed = getattr(filter_, 'slowest', SLOWEST) * float(np.sum(readings.dt))
        begin = _working_time()
        for k, (rate, force, field, dt) in enumerate(zip(
                gyroscope, accelerometer, fields, readings.dt.tolist(), strict=True), start=1):
            tell(k)
            # A filter may return the array that its next update changes.
            said.append(copy(update(rate, force, field, dt)))
            if k % READ_EVERY == 0:
                _check_speed(_working_time() - begin, allowed, update_of(k, readings))
                numbers.append(k - 1)
                covariances.append(np.array(getattr(filter_, 'covariance', None), dtype=float))
                biases.append(np.array(getattr(filter_, 'bias', None), dtype=float))
    except (InvalidOutputError, NodeError):
        raise
    except (Exception, SystemExit) as error:
        raise InvalidOutputError(f'{update_of(k, readings)} raises '
                                 f'{type(error).__name__}: {error}') from error
    return Said(_quaternions(said), np.array(numbers), _checked('covariance', covariances, (3, 3)),
                _checked('bias', biases, (3,)))


def update_of(number: int, readings: Readings) -> str:
    """Return in words which update it is, from 1 on; 0: the filter is not made yet."""
    return f'update {number} of {len(readings.dt)}' if number else 'making the filter'


def follow(make_filter: MakeFilter, run: Run, given: Input | None = None, read: Output = same,
           magnetometer: bool = True, feed: Feed = feed) -> Outcome:
    """
    Feed a new filter with a run.

    given, read : how the readings are changed before the filter gets them, and its attitudes after
    magnetometer : False gives None

    Raises InvalidOutputError as `feed` does.
    """
    gyroscope, accelerometer = run.gyroscope, run.accelerometer
    if given is not None:
        gyroscope, accelerometer = given(gyroscope, accelerometer, run.dt)
    said = feed(make_filter, Readings(gyroscope, accelerometer,
                                      run.magnetometer if magnetometer else None, run.dt))
    return Outcome(run, read(said.estimates), said.read, said.covariances, said.biases)


def _working_time() -> float:
    """Return a time [s] that stands still while this thread waits for a processor."""
    waited_ns = 0
    with contextlib.suppress(OSError):      # there on Linux only
        waited_ns = int(WAITING.read_text(encoding='ascii').split()[1])
    return time.perf_counter() - 1e-9 * waited_ns


def _check_speed(spent: float, allowed: float, where: str) -> None:
    if spent > allowed:
        raise InvalidOutputError(f'too slow: {where} ends after {spent:.3g} s, and the last one '
                                 f'must end within {allowed:.3g} s')


def _quaternions(said: list[object]) -> Reals:
    """Return what was said as unit quaternions (n, 4).  Raises InvalidOutputError."""
    try:
        rows = np.array(said, dtype=float)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.shape != (len(said), 4):
        for k, one in enumerate(said):
            if (shape := _shape(one)) != (4,):
                raise InvalidOutputError(
                    f'update {k + 1} returns {_short(one)}'
                    + (f' of shape {shape}' if shape else '') + ': must be 4 numbers x, y, z, w')
        raise InvalidOutputError(f'update 1 returns {_short(said[0])}: must be 4 numbers')
    norms = np.linalg.norm(rows, axis=1)
    bad = np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))
    if len(bad):
        k = int(bad[0])
        what = (f'its norm is {norms[k]:.6g}' if np.isfinite(norms[k]) else 'it is not finite')
        raise InvalidOutputError(f'update {k + 1} returns {_short(rows[k])}: {what}, and must '
                                 'be 1')
    unit: Reals = rows / norms[:, np.newaxis]
    return unit


def _shape(value: Any) -> tuple[int, ...] | None:
    try:
        return np.shape(value)
    except ValueError:          # rows of several lengths
        return None


def _short(value: object) -> str:
    text = ' '.join(str(value).split())
    return text if len(text) < 80 else f'{text[:77]}...'


def _checked(name: str, values: list[object], shape: tuple[int, ...]) -> Reals | None:
    """Return what a filter says of itself (m, ...), None if it says nothing."""
    if any(_shape(value) == () for value in values):
        return None
    for value in values:
        array = np.asarray(value)
        if array.shape != shape or not np.all(np.isfinite(array)):
            raise InvalidOutputError(f'{name} is {_short(array.tolist())}: must be '
                                     f'{" x ".join(map(str, shape))} finite numbers')
        if name == 'covariance':
            eigenvalues = np.linalg.eigvalsh(0.5 * (array + array.T))
            if eigenvalues[-1] <= 0.0 or eigenvalues[0] < -1e-9 * eigenvalues[-1]:
                raise InvalidOutputError(f'covariance is {_short(array.tolist())}: must have no '
                                         'negative eigenvalue')
    return np.array(values)
