# SPDX-License-Identifier: Apache-2.0
"""A stream of messages: a topic, a grid of times, and how the motion becomes bytes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.physics.pivot import ns_array
from spinning_top_sim.physics.states import States
from spinning_top_sim.streams.cdr import NANOSECONDS, Template, Values
from spinning_top_sim.streams.imu import Imu, Readings
from spinning_top_sim.streams.trajectory import Trajectory

# Messages as rows (n, size): bytes or, of a table, numbers.
Rows = NDArray[Any]
Stamps = NDArray[np.int64]


class Samples:
    """
    The motion at times of one grid; the channels with this grid share it.

    trajectory, imu : the motion, and the sensor on it
    times : of the samples [ns]
    epoch_ns : stamp of t = 0 [ns]
    """

    def __init__(self, trajectory: Trajectory, imu: Imu, times: range, epoch_ns: int) -> None:
        self.trajectory, self.times, self.epoch_ns = trajectory, times, epoch_ns
        self._imu = imu

    @cached_property
    def t_ns(self) -> Stamps:
        return ns_array(self.times)

    @cached_property
    def states(self) -> States:
        return self.trajectory.evaluate(self.t_ns)

    @cached_property
    def imu(self) -> Readings:
        """What the IMU reads, and what is true of it."""
        return Readings(self._imu, self.trajectory, self.times, self.states)

    def at_start(self, name: str) -> Column:
        """Return `energy`, `l3` or `lz` as it was when the motion of each sample began, (n,)."""
        return self.trajectory.constants(name, self.t_ns)


class Encoder(Protocol):
    """Makes rows of stamps (n,) [ns] and fields; its length is the size of a row [bytes]."""

    def __len__(self) -> int: ...
    def encode(self, stamps_ns: Stamps, fields: Sequence[Values]) -> Rows: ...


@dataclass(frozen=True, eq=False)
class Channel:
    """
    One topic, with samples at t = k * period_ns for k = 0, 1, 2, ...

    name : prefix of its parameters; several channels may have one
    topic, type_name : such as 'imu/data_raw' and 'sensor_msgs/msg/Imu'
    period_ns : time between two samples [ns]
    encoder : of its messages
    fields : returns the numbers that go into the fields of `encoder`
    stamps : returns the stamps (n,) [ns] of samples, from that of t = 0 and their times [ns];
        None: they are right
    copies : returns how many messages samples at times (n,) [ns] have, 0 if lost; None: 1
    delay_ns : time from a sample to its message [ns]
    """

    name: str
    topic: str
    type_name: str
    period_ns: int
    encoder: Encoder
    fields: Callable[[Samples], Sequence[Values]]
    stamps: Callable[[int, Stamps], Stamps] | None = None
    copies: Callable[[Stamps], NDArray[np.int64]] | None = None
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

    def encode(self, samples: Samples) -> tuple[Stamps, Rows]:
        """
        Return the messages of samples.

        Returns
        -------
        t_ns : (n,)
            When each message is due [ns].
        rows : (n, size)
            The messages.
        """
        stamps = (samples.epoch_ns + samples.t_ns if self.stamps is None
                  else self.stamps(samples.epoch_ns, samples.t_ns))
        try:
            rows = self.encoder.encode(stamps, self.fields(samples))
        except ValueError as error:
            raise ValueError(f'fields of {self.topic}: {error}') from error
        due_ns = samples.t_ns + self.delay_ns
        if self.copies is None:
            return due_ns, rows
        copies = self.copies(samples.t_ns)
        return np.repeat(due_ns, copies), np.repeat(rows, copies, axis=0)

    def due(self, t_ns: Stamps) -> Stamps:
        """Return when the messages of samples at times (n,) are due [ns]."""
        due_ns = t_ns + self.delay_ns
        return due_ns if self.copies is None else np.repeat(due_ns, self.copies(t_ns))


def period_ns(rate: float) -> int:
    """Return the time from one sample to the next at a rate [Hz], in whole nanoseconds."""
    return max(1, round(NANOSECONDS / rate))
