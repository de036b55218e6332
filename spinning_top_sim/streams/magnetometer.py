# SPDX-License-Identifier: Apache-2.0
"""The magnetometer, in the frame of the IMU: the magnetic field and the errors of the sensor."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.attitude import Quaternion, Vector
from spinning_top_sim.streams import noise
from spinning_top_sim.streams.imu import converted, transformed


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
            [noise.Path(seed, noise.Purpose.MAG_WALK, (3 * (math.inf,),), (3 * (walk,),))]
            if walk else ())

    def true(self, orientation: Quaternion) -> Vector:
        """Return the field [T] in frames with these orientations in the world."""
        return attitude.in_body(orientation, self._field)

    def read(self, exact: Vector, times: range) -> Vector:
        """Return the readings [T] of the field `exact` at these times [ns]."""
        white, bias = self._noise.at(times)
        x, y, z = (converted(value + one_bias + one_white, self._resolution, self._range)
                   for value, one_bias, one_white in zip(
                       transformed(self._soft_iron, exact), bias, white, strict=True))
        return x, y, z
