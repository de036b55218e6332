# SPDX-License-Identifier: Apache-2.0
"""The magnetometer, in the frame of the IMU: the magnetic field, and what disturbs it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion, Vector
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Mounting
from spinning_top_sim.streams.noise import Kind
from spinning_top_sim.streams.sensor import Sensor, summed


class Magnetometer(Sensor):
    """A magnetometer that takes a sample every `period_ns`."""

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        super().__init__(values, 'mag.', Kind.MAGNETOMETER, period_ns,
                         matrix=values['mag.soft_iron'], offset=values['mag.hard_iron'])
        self._field, self._mounting = values['mag.field'], Mounting.of(values)
        self._events = [np.reshape(values[f'mag.disturbance.{frame}'], (-1, 5)).tolist()
                        for frame in ('world', 'body')]

    def true(self, orientation: Quaternion) -> Vector:
        """Return the field [T] in frames with these orientations in the world."""
        return attitude.rotated_back(orientation, self._field)

    def felt(self, orientation: Quaternion, t_ns: NDArray[np.int64]) -> Vector:
        """Return the field [T] with the disturbances at times (n,) [ns]."""
        true = self.true(orientation)
        world, body = (_at(events, t_ns) for events in self._events)
        if world is not None:
            true = summed(true, attitude.rotated_back(orientation, world))
        return true if body is None else summed(true, self._mounting.from_body(body))


def _at(events: Sequence[Sequence[float]], t_ns: NDArray[np.int64]) -> Vector | None:
    """Return the sum of the fields [T] of the events at times (n,) [ns]; None without any."""
    if not any(map(any, events)):
        return None
    total = np.zeros((3, len(t_ns)))
    for begin, end, *field in events:
        goes_on = (t_ns >= round(begin * NANOSECONDS)) & (t_ns < round(end * NANOSECONDS))
        total += np.where(goes_on, np.array(field)[:, np.newaxis], 0.0)
    return total[0], total[1], total[2]
