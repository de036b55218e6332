# SPDX-License-Identifier: Apache-2.0
"""A filter, fed with a run: what it says, and what is wrong with that."""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spinning_top_sim.exam.measures import Errors, errors_of
from spinning_top_sim.exam.scenarios import Reals, Run, Truth
from spinning_top_sim.tools.cli import printable

# A covariance and a bias are read after so many updates.
READ_EVERY = 10
# A filter may take this many times as long as the run lasts, and some time to compile itself [s].
SLOWEST, START_S = 2.0, 5.0
# Its second number is how long this thread has waited for a processor [ns].
WAITING = Path('/proc/thread-self/schedstat')
NORM_TOLERANCE = 1e-3


class Filter(Protocol):
    """
    What the exam takes for an attitude filter.

    It may also have `covariance` (3, 3), of the rotation vector from its attitude to the true one
    [rad^2], and `bias` (3,), of the gyroscope [rad/s].  The exam reads both after updates; None,
    and a covariance of zeros, is unknown.
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


class Known(NamedTuple):
    """What is known after some samples: their numbers (m,), and the values (m, ...)."""

    samples: NDArray[np.int64]
    values: Reals

    def since(self, first: int) -> 'Known':
        """Return what is known from a sample on."""
        kept = self.samples >= first
        return Known(self.samples[kept] - first, self.values[kept])


UNKNOWN = Known(np.empty(0, dtype=np.int64), np.empty(0))


class Said(NamedTuple):
    """
    What a filter said.

    estimates : q(world <- sensor) (n, 4), of norm 1
    covariances, biases : of (3, 3) [rad^2] and (3,) [rad/s]
    """

    estimates: Reals
    covariances: Known
    biases: Known


# Feeds a new filter.
Feed = Callable[[MakeFilter, Readings], Said]


@dataclass(frozen=True)
class Outcome:
    """What a filter said along a motion, as `Said` has it."""

    run: Truth
    estimates: Reals
    covariances: Known
    biases: Known

    @property
    def errors(self) -> Errors:
        """Tilt and heading errors [rad]."""
        return errors_of(self.estimates, self.run.truth)

    def last(self, fraction: float = 0.5) -> 'Outcome':
        """Return the last part of the outcome, by default where the filter has settled."""
        return self.since(round(len(self.estimates) * (1.0 - fraction)))

    def since(self, first: int) -> 'Outcome':
        """Return the outcome from a sample on."""
        return replace(self, run=self.run.part(slice(first, None)),
                       estimates=self.estimates[first:],
                       covariances=self.covariances.since(first), biases=self.biases.since(first))


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
    said: list[Reals] = []
    covariances: dict[int, Reals] = {}
    biases: dict[int, Reals] = {}
    # The filter may keep or change what it gets.
    gyroscope, accelerometer = readings.gyroscope.copy(), readings.accelerometer.copy()
    fields = ([None] * len(gyroscope) if readings.magnetometer is None else
              readings.magnetometer.copy())
    try:
        filter_ = make_filter()
        update = filter_.update
        allowed = START_S + getattr(filter_, 'slowest', SLOWEST) * np.cumsum(readings.dt)
        begin = _working_time()
        for k, (rate, force, field, dt) in enumerate(zip(
                gyroscope, accelerometer, fields, readings.dt.tolist(), strict=True), start=1):
            tell(k)
            said.append(_numbers(f'update {k} returns', update(rate, force, field, dt), (4,),
                                 '4 numbers x, y, z, w'))
            if k % READ_EVERY == 0:
                _check_speed(_working_time() - begin, allowed[k - 1], update_of(k, readings))
                if (covariance := _covariance_of(filter_)) is not None:
                    covariances[k - 1] = covariance
                if (bias := getattr(filter_, 'bias', None)) is not None:
                    biases[k - 1] = _finite('bias', bias, (3,))
    except (InvalidOutputError, NodeError):
        raise
    except (Exception, SystemExit) as error:
        raise InvalidOutputError(f'{update_of(k, readings)} raises '
                                 f'{type(error).__name__}: {one_line(error)}') from error
    return Said(_quaternions(np.array(said)), _known(covariances), _known(biases))


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
    return Outcome(run, read(said.estimates), said.covariances, said.biases)


def _working_time() -> float:
    """Return a time [s] that stands still while this thread waits for a processor."""
    waited_ns = 0
    with contextlib.suppress(OSError):      # there on Linux only
        waited_ns = int(WAITING.read_text(encoding='ascii').split()[1])
    return time.perf_counter() - 1e-9 * waited_ns


def _check_speed(spent: float, allowed: float, where: str) -> None:
    if spent > allowed:
        raise InvalidOutputError(f'too slow: {where} ends after {spent:.3g} s, and must within '
                                 f'{allowed:.3g} s')


def _quaternions(rows: Reals) -> Reals:
    """Return what was said (n, 4) as unit quaternions.  Raises InvalidOutputError."""
    if len(bad := no_attitudes(rows)):
        k = int(bad[0])
        what = (f'its norm is {math.hypot(*rows[k]):.6g}' if np.all(np.isfinite(rows[k])) else
                'it is not finite')
        raise InvalidOutputError(f'update {k + 1} returns {_short(rows[k])}: {what}, and must '
                                 'be 1')
    unit: Reals = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return unit


def no_attitudes(quaternions: Reals) -> NDArray[np.intp]:
    """Return the numbers of those (n, 4) whose norm is not 1."""
    with np.errstate(over='ignore'):
        norms = np.linalg.norm(quaternions, axis=1)
    return np.flatnonzero(~(np.abs(norms - 1.0) <= NORM_TOLERANCE))


def _covariance_of(filter_: Filter) -> Reals | None:
    """Return the covariance that a filter has, None: unknown.  Raises InvalidOutputError."""
    value = getattr(filter_, 'covariance', None)
    if value is None:
        return None
    covariance = _finite('covariance', value, (3, 3))
    if not np.any(covariance):      # as messages of ROS have it
        return None
    if is_indefinite(covariance):
        raise InvalidOutputError(f'covariance is {_short(covariance.tolist())}: must have no '
                                 'negative eigenvalue')
    return covariance


def is_indefinite(covariances: Reals) -> NDArray[np.bool_]:
    """Return which of the covariances (..., 3, 3), finite, have a negative eigenvalue (...)."""
    largest = np.maximum(np.max(np.abs(covariances), axis=(-1, -2), keepdims=True), 1e-300)
    scaled = covariances / largest      # else the largest doubles overflow
    eigenvalues = np.linalg.eigvalsh(0.5 * (scaled + np.swapaxes(scaled, -1, -2)))
    indefinite: NDArray[np.bool_] = eigenvalues[..., 0] < -1e-9
    return indefinite


def _finite(name: str, value: object, shape: tuple[int, ...]) -> Reals:
    """Return a copy of what a filter says of itself.  Raises InvalidOutputError."""
    allowed = f'{" x ".join(map(str, shape))} finite numbers'
    numbers = _numbers(f'{name} is', value, shape, allowed)
    if not np.all(np.isfinite(numbers)):
        raise InvalidOutputError(f'{name} is {_short(numbers.tolist())}: must be {allowed}')
    return numbers


def _numbers(what: str, value: object, shape: tuple[int, ...], allowed: str) -> Reals:
    """
    Return a copy of what a filter says, which may change it later.

    Raises InvalidOutputError for another shape.
    """
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InvalidOutputError(f'{what} {_short(value)}: must be {allowed}') from None
    if numbers.shape != shape:
        of_shape = f' of shape {numbers.shape}' if numbers.shape else ''
        raise InvalidOutputError(f'{what} {_short(value)}{of_shape}: must be {allowed}')
    return numbers


def _known(values: dict[int, Reals]) -> Known:
    return Known(np.array([*values]), np.array([*values.values()])) if values else UNKNOWN


def one_line(value: object) -> str:
    """Return what a filter says, or its name, as one printable line."""
    return printable(' '.join(str(value).split()))


def _short(value: object) -> str:
    text = one_line(value)
    return text if len(text) < 80 else f'{text[:77]}...'
