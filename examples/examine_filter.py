#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Examine a complementary filter of ten lines: `python examples/examine_filter.py`.

It corrects the tilt by a small part of each specific force, and knows no bias.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam import examine


class Complementary:
    """Rates in closed form, corrected towards the specific force."""

    def __init__(self) -> None:
        self.attitude = Rotation.identity()

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        """Return the attitude of the sensor in the world, x, y, z, w."""
        up = self.attitude.inv().apply((0.0, 0.0, 1.0))
        correction = np.cross(accelerometer / np.linalg.norm(accelerometer), up)
        self.attitude *= Rotation.from_rotvec((gyroscope + 0.5 * correction) * dt)
        return self.attitude.as_quat()


if __name__ == '__main__':
    print(examine(Complementary, subject='complementary filter'))
