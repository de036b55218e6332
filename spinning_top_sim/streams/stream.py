# SPDX-License-Identifier: Apache-2.0
"""What every stream has: a topic, a message type, a grid of times, and how states become bytes."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.pivot import Kinematics
from spinning_top_sim.physics.states import States, joined
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.path import Path, Segment
from spinning_top_sim.streams.timing import Timing

Result = TypeVar('Result')
# Messages as rows (n, size): bytes or, of a table, numbers.
Rows = NDArray[Any]
# A segment and times in it [ns].
Share = tuple[Segment, range]
# Times (n,) [ns] of messages, and the messages.
Encoded = tuple[NDArray[np.int64], Rows]


class Samples:
    """
    The motion at times of a block; the streams of one rate share it.

    path : the motion
    shares : a segment and its times [ns], or several segments that chain
    times : of the samples [ns]
    epoch_ns : stamp of t = 0 [ns]
    """

    def __init__(self, path: Path, shares: Sequence[Share], epoch_ns: int) -> None:
        self.path, self.shares, self.epoch_ns = path, shares, epoch_ns
        self._segments = [segment for segment, _ in shares]
        (_, first), (_, last) = shares[0], shares[-1]
        self.times = range(first.start, last.stop, first.step)
        self._counts = [len(times) for _, times in shares]
        self._results: dict[Callable[..., Any], Any] = {}

    @cached_property
    def t_ns(self) -> NDArray[np.int64]:
        return np.arange(self.times.start, self.times.stop, self.times.step)

    @property
    def pivot_moves(self) -> bool:
        return self._segments[0].ride is not None

    @cached_property
    def states(self) -> States:
        if len(self.shares) == 1:
            return self._segments[0].states(self.times)
        return joined([segment.states(times) for segment, times in self.shares])

    @cached_property
    def pivot(self) -> Kinematics:
        """Position, velocity and acceleration of the pivot in the world, (3, n) each."""
        return self.path.pivot(self.t_ns)

    def at_start(self, name: str) -> NDArray[np.float64]:
        """Return a constant of the motion, (n,), as it is at the start of each segment."""
        return np.repeat([getattr(segment, name) for segment in self._segments], self._counts)

    @property
    def orientation_error(self) -> NDArray[np.float64]:
        """The angles (n,) [rad] to the exact attitudes; NaN where these are not known."""
        # Segments that chain are exact.
        return self._segments[0].orientation_error(self.states, self.times)

    def once(self, compute: Callable[['Samples'], Result]) -> Result:
        """
        Return `compute(self)`, which is called for the first of the streams that ask for it.

        Bound methods of one object are equal.
        """
        if compute not in self._results:
            self._results[compute] = compute(self)
        result: Result = self._results[compute]
        return result


class Stream:
    """
    One topic, with samples at t = k * period_ns for k = 0, 1, 2, ...

    parameter : prefix of its parameters
    topic, type_name : such as 'imu/data_raw' and 'sensor_msgs/msg/Imu'
    template : of its messages; the stream keeps a copy
    fields : returns the numbers that go into the fields of `template`
    timing : the timing faults of its messages
    rate_parameter : name of the parameter that is its rate
    period_ns : time between two samples [ns]
    size : of a message [bytes]
    late_ns : time from a sample to its message [ns]
    silences_ns : begin and end of the times without messages [ns]

    Raises LookupError if there is no parameter of its rate.
    """

    late_ns = 0
    silences_ns: Sequence[tuple[int, int]] = ()

    def __init__(self, values: Mapping[str, Any], parameter: str, topic: str, type_name: str,
                 template: Template, *,
                 fields: Callable[[Samples], Sequence[Field]] = lambda _: (),
                 timing: Timing | None = None, rate_parameter: str = '') -> None:
        self.parameter, self.topic, self.type_name = parameter, topic, type_name
        # A copy, with rows of its own: equal streams share the template.
        self.template, self.fields, self._timing = copy(template), fields, timing
        self.rate_parameter = rate_parameter or f'{parameter}.rate'
        if self.rate_parameter not in values:
            raise LookupError(f'{topic}: parameters.STREAM_DEFAULTS has no {self.rate_parameter}')
        self.period_ns = period_ns(values[self.rate_parameter])

    @property
    def size(self) -> int:
        return len(self.template)

    def apply(self, changes: Mapping[str, Any]) -> None:
        """
        Take over checked parameters that act at once on the samples that follow.

        A stream extends it for parameters of its own; `Simulation.apply` calls it.
        """
        if self.rate_parameter in changes:
            self.period_ns = period_ns(changes[self.rate_parameter])

    def times(self, after_ns: int, until_ns: int) -> range:
        """Return the times of the samples after `after_ns` and up to `until_ns` [ns]."""
        return range((after_ns // self.period_ns + 1) * self.period_ns, until_ns + 1,
                     self.period_ns)

    def encode(self, *samples: Samples) -> Encoded:
        """
        Return the messages of samples, whose times ascend.

        Returns
        -------
        t_ns : (n,)
            Time of each message [ns]; a sample may have none, or two.
        rows : (n, size)
            The messages, valid until the next call.
        """
        t_ns, epoch_ns = np.concatenate([one.t_ns for one in samples]), samples[0].epoch_ns
        stamps_ns = (epoch_ns + t_ns if self._timing is None
                     else self._timing.stamps_ns(epoch_ns, t_ns, self.period_ns))
        try:
            rows = self.template.encode_runs(stamps_ns, [
                (len(one.times), self.fields(one)) for one in samples])
        except ValueError as error:
            raise ValueError(f'fields of {self.topic}: {error}') from error
        if self._timing is None:
            return t_ns, rows
        copies = self._timing.copies(t_ns, self.period_ns)
        return np.repeat(t_ns, copies), np.repeat(rows, copies, axis=0)


def period_ns(rate: float) -> int:
    """Return the time from one sample to the next at a rate [Hz], in whole nanoseconds."""
    return max(1, round(NANOSECONDS / rate))
