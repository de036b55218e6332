# SPDX-License-Identifier: Apache-2.0
"""A stream of messages: a topic, a grid of times, and how the motion becomes bytes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams.cdr import Template, Values
from spinning_top_sim.streams.samples import Samples
from spinning_top_sim.times import LAST_STAMP_NS, Times

# Messages as rows (n, size): bytes or, of a table, numbers.
Rows = NDArray[Any]
# A channel, times (n,) at which its messages are due [ns], and these.
Messages = tuple['Channel', Times, Rows]
# Returns how late the stamps of samples at times (n,) are [ns], and how often each is sent.
Faults = Callable[[Times], tuple[Times | int, NDArray[np.int64]]]


class Encoder(Protocol):
    """Makes rows of stamps (n,) [ns] and fields; its length is the size of a row [bytes]."""

    def __len__(self) -> int: ...
    def encode(self, stamps_ns: Times, fields: Sequence[Values]) -> Rows: ...


@dataclass(frozen=True, eq=False)
class Channel:
    """
    One topic, with samples at t = k * period_ns for k = 0, 1, 2, ...

    name : prefix of its parameters; several channels may have one
    topic, type_name : such as 'imu/data_raw' and 'sensor_msgs/msg/Imu'
    period_ns : time between two samples [ns]
    encoder : of its messages
    fields : returns the numbers that go into the fields of `encoder`
    faults : of stamps, and losses; None: every sample is sent once, with its time
    delay_ns : time from a sample to its message [ns]
    """

    name: str
    topic: str
    type_name: str
    period_ns: int
    encoder: Encoder
    fields: Callable[[Samples], Sequence[Values]]
    faults: Faults | None = None
    delay_ns: int = 0

    @property
    def template(self) -> Template:
        """The encoder of a channel of messages."""
        assert isinstance(self.encoder, Template)
        return self.encoder

    @property
    def grid(self) -> tuple[int, int]:
        """Period and delay [ns]: channels that have the same share their samples."""
        return self.period_ns, self.delay_ns

    def times(self, after_ns: int, until_ns: int) -> range:
        """Return the times of the samples whose messages are due after one time, up to another."""
        first = max(after_ns - self.delay_ns, -1) // self.period_ns + 1
        return range(first * self.period_ns, until_ns - self.delay_ns + 1, self.period_ns)

    def encode(self, samples: Samples) -> tuple[Times, Rows]:
        """Return when the messages (n,) of samples are due [ns], and these as rows (n, size)."""
        late_ns, copies = self.faults(samples.t_ns) if self.faults else (0, 1)
        try:
            rows = self.encoder.encode(stamps(samples, late_ns), self.fields(samples))
        except ValueError as error:
            raise ValueError(f'fields of {self.topic}: {error}') from error
        due_ns = samples.t_ns + self.delay_ns
        return (due_ns, rows) if self.faults is None else (
            np.repeat(due_ns, copies), np.repeat(rows, copies, axis=0))

    def due(self, t_ns: Times) -> Times:
        """Return when the messages of samples at times (n,) are due [ns]."""
        return np.repeat(t_ns + self.delay_ns, self.faults(t_ns)[1] if self.faults else 1)


def stamps(samples: Samples, late_ns: Times | int = 0) -> Times:
    """Return the stamps (n,) of samples, so late [ns], within what a message holds."""
    due_ns: Times = samples.epoch_ns + samples.t_ns + late_ns
    return np.clip(due_ns, 0, LAST_STAMP_NS)
