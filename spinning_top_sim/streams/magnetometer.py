# SPDX-License-Identifier: Apache-2.0
"""The magnetometer, in the frame of the IMU: the magnetic field and the errors of the sensor."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion, Vector
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.inertial_sensor import converted, transformed


class Magnetometer:
    """
    A magnetometer that takes a sample every `period_ns`.

    variance : of white noise and rounding together [T^2]

    (V. Renaudin et al., "Complete triaxis magnetometer calibration in the magnetic domain",
    Journal of Sensors 2010: soft iron, hard iron, noise)
    """

    def __init__(self, values: Mapping[str, Any], period_ns: int) -> None:
        self._field, self._soft_iron = values['mag.field'], values['mag.soft_iron']
        self._resolution, self._range = values['mag.resolution'], values['mag.range']
        deviation = values['mag.noise_density'] / math.sqrt(period_ns * 1e-9)
        walk, seed = values['mag.random_walk'], values['seed']
        self.variance = deviation ** 2 + self._resolution ** 2 / 12.0
        self._noise = noise.SensorNoise(
            seed, noise.Purpose.MAG_WHITE, period_ns, np.full((3, 1), deviation),
            np.array(values['mag.hard_iron'])[:, np.newaxis],
            [noise.RandomPath(seed, noise.Purpose.MAG_WALK, (3 * (math.inf,),), (3 * (walk,),))]
            if walk else ())
        self._events = [np.reshape(values[f'mag.disturbance.{frame}'], (-1, 5)).tolist()
                        for frame in ('world', 'body')]
        self._is_disturbed = any(itertools.chain(*itertools.chain(*self._events)))

    def true(self, orientation: Quaternion) -> Vector:
        """Return the field [T] in frames with these orientations in the world."""
        return attitude.rotated_back(orientation, self._field)

    def disturbed(self, true: Vector, orientation: Quaternion,
                  from_body: Callable[[Vector], Vector], t_ns: NDArray[np.int64]) -> Vector:
        """
        Return the field `true` [T] with the disturbances at these times (n,) [ns].

        orientation : of the IMU in the world
        from_body : returns a vector of the body in the frame of the IMU
        """
        if not self._is_disturbed:
            return true
        world, body = (_at(events, t_ns) for events in self._events)
        x, y, z = (one + outside + magnet for one, outside, magnet in zip(
            true, attitude.rotated_back(orientation, world), from_body(body), strict=True))
        return x, y, z

    def read(self, true: Vector, times: range) -> Vector:
        """Return the readings [T] of the field `true` at these times [ns]."""
        white, bias = self._noise.at(times)
        x, y, z = (converted(value + one_bias + one_white, self._resolution, self._range)
                   for value, one_bias, one_white in zip(
                       transformed(self._soft_iron, true), bias, white, strict=True))
        return x, y, z


def _at(events: Sequence[Sequence[float]], t_ns: NDArray[np.int64]) -> Vector:
    """Return the sum of the fields [T] of those events that go on at times (n,) [ns]."""
    total = np.zeros((3, len(t_ns)))
    for begin, end, *field in events:
        goes_on = (t_ns >= round(begin * NANOSECONDS)) & (t_ns < round(end * NANOSECONDS))
        total += np.where(goes_on, np.array(field)[:, np.newaxis], 0.0)
    return total[0], total[1], total[2]
