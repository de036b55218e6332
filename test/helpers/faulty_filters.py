# SPDX-License-Identifier: Apache-2.0
"""The reference filter of the exam, with one fault each."""

from collections import deque

import numpy as np

from spinning_top_sim.exam import reference
from spinning_top_sim.exam.reference import ReferenceFilter


class FirstOrder(ReferenceFilter):
    def integrate(self, quaternion, turn):
        return reference.product(quaternion, np.array((*(0.5 * turn), 1.0)))


class DegreesPerSecond(ReferenceFilter):
    def update(self, gyroscope, accelerometer, magnetometer, dt):
        return super().update(np.radians(gyroscope), accelerometer, magnetometer, dt)


class Conjugated(ReferenceFilter):
    def update(self, *readings):
        return super().update(*readings) * (-1.0, -1.0, -1.0, 1.0)


class WFirst(ReferenceFilter):
    def update(self, *readings):
        return super().update(*readings)[[3, 0, 1, 2]]


class NorthEastDown(ReferenceFilter):
    def update(self, *readings):
        half = np.array((0.5 ** 0.5, 0.5 ** 0.5, 0.0, 0.0))
        return reference.product(half, super().update(*readings))


class GravityDown(ReferenceFilter):
    def update(self, gyroscope, accelerometer, magnetometer, dt):
        return super().update(gyroscope, -accelerometer, magnetometer, dt)


class TakesForceForGravity(ReferenceFilter):
    is_gravity_trusted = True


class Late(ReferenceFilter):
    """Its attitudes are 50 ms old."""

    def __init__(self):
        super().__init__()
        self._said = deque()

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        self._said.append(super().update(gyroscope, accelerometer, magnetometer, dt))
        return self._said.popleft() if len(self._said) > round(0.05 / dt) else self._said[0]


class WithoutBias(ReferenceFilter):
    def __init__(self):
        super().__init__(bias_stddev=1e-9)


class HalfCovariance(ReferenceFilter):
    covariance = property(lambda self: 0.5 * self._p[:3, :3])


class TwiceCovariance(ReferenceFilter):
    covariance = property(lambda self: 2.0 * self._p[:3, :3])


class Mirrored(ReferenceFilter):
    """The gyroscope has the wrong sign."""

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        return super().update(-gyroscope, accelerometer, magnetometer, dt)


class NotANumber(ReferenceFilter):
    def update(self, gyroscope, accelerometer, magnetometer, dt):
        return super().update(gyroscope, accelerometer, magnetometer, dt) * np.nan


FAULTY = {
    'first_order_integration': FirstOrder, 'gyroscope_units': DegreesPerSecond,
    'conjugated': Conjugated, 'component_order': WFirst, 'frame_ned': NorthEastDown,
    'gravity_sign': GravityDown, 'lever_arm': TakesForceForGravity, 'stamp_offset': Late,
    'no_bias_estimate': WithoutBias, 'covariance_small': HalfCovariance,
    'covariance_large': TwiceCovariance, 'diverges': Mirrored, 'invalid_output': NotANumber}
