# SPDX-License-Identifier: Apache-2.0
"""What every stream has: a topic, a message type, a rate, sinks, and how states become bytes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Template
from spinning_top_sim.streams.segment import Segment


class Stream:
    """
    One topic: samples at t = k * period, k = 0, 1, 2.., whoever listens and however ticks fall.

    parameter : prefix of its parameters
    log_index : its number in the log that records it, None for no log; see `Simulation.log_to`
    sent, skipped : counts of samples published, and of those that came too late for that
    on_change : called when its sinks, its rate or the numbers in its samples change
    """

    parameter: str
    topic: str
    type_name: str

    def __init__(self, values: Mapping[str, Any], template: Template) -> None:
        self.template = template
        self._publish: Callable[[bytes], object] | None = None
        self.log_index: int | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.sent = self.skipped = 0
        self._skipped_until_ns = 0
        self.period_ns = period_ns(values[self.rate_parameter])

    @property
    def rate_parameter(self) -> str:
        """Name of the parameter that is its rate."""
        return f'{self.parameter}.rate'

    @property
    def publish(self) -> Callable[[bytes], object] | None:
        """What a sample is handed to in time; None while there are no subscribers."""
        return self._publish

    @publish.setter
    def publish(self, sink: Callable[[bytes], object] | None) -> None:
        if sink != self._publish:
            self._publish = sink
            self.on_change()

    def follow(self, segment: Segment) -> None:
        """Begin with the samples of a motion, or of the one after a command."""

    def begin(self, now_ns: int) -> None:
        """Prepare for samples after the simulated time `now_ns`: it will be recorded."""
        self.readmit(now_ns)        # what is too late to be published is not too late for a log

    @property
    def at_once(self) -> tuple[str, ...]:
        """Names of the parameters that change its samples at once: a run is replayed by them."""
        return (self.rate_parameter,)

    def apply(self, changes: Mapping[str, Any], now_ns: int) -> None:
        """Take over values of parameters from the simulated time `now_ns` on."""
        rate = changes.get(self.rate_parameter)
        if rate is not None and period_ns(rate) != self.period_ns:
            self.period_ns = period_ns(rate)
            self.on_change()

    @property
    def has_sinks(self) -> bool:
        """Whether it has subscribers or is recorded: else nothing is computed."""
        return self._publish is not None or self.log_index is not None

    def first_after(self, t_ns: int) -> int:
        """Return the time of the first sample later than `t_ns` that is not skipped [ns]."""
        return (max(t_ns, self._skipped_until_ns - 1) // self.period_ns + 1) * self.period_ns

    def times(self, after_ns: int, until_ns: int) -> range:
        """Return the times of the samples after `after_ns` and up to `until_ns` [ns]."""
        return range(self.first_after(after_ns), until_ns + 1, self.period_ns)

    def skip(self, after_ns: int, before_ns: int) -> None:
        """Leave out and count the samples after `after_ns` and before `before_ns` [ns]."""
        count = len(self.times(after_ns, before_ns - 1))
        if count:
            self.skipped += count
            self._skipped_until_ns = before_ns
            self.on_change()

    def readmit(self, now_ns: int) -> None:
        """Leave out no more samples after `now_ns` than are skipped from now on."""
        until_ns, self._skipped_until_ns = self._skipped_until_ns, 0
        count = len(self.times(now_ns, until_ns - 1))
        if count:
            self.skipped -= count
            self.on_change()

    def sent_ns(self, times: range) -> NDArray[np.int64]:
        """Return the times of the messages of these samples: some may be lost, some repeated."""
        return np.arange(times.start, times.stop, times.step)

    def encode(self, states: States, epoch_ns: int, times: range) -> NDArray[np.uint8]:
        """Return messages, at `sent_ns`, of states at times [ns]; see `Template.encode`."""
        stamps_ns = np.arange(epoch_ns + times.start, epoch_ns + times.stop, times.step)
        return self.template.encode(stamps_ns, *self.fields(states, times))

    def fields(self, states: States, times: range) -> Sequence[Field]:
        """Return the numbers that go into the fields of `template`."""
        raise NotImplementedError


def period_ns(rate: float) -> int:
    """Return the time from one sample to the next at a rate [Hz], in whole nanoseconds."""
    return max(1, round(NANOSECONDS / rate))
