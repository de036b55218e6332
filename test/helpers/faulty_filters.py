# SPDX-License-Identifier: Apache-2.0
"""Filters with one fault each, for the exam to find."""

from collections import deque
from functools import partial

import numpy as np

from spinning_top_sim.exam.reference import ReferenceFilter, product

HALF = 0.5 ** 0.5


class Misreading:
    """Another filter, of which readings or attitudes are taken for what they are not."""

    def __init__(self, make_filter, rates=1.0, force=1.0, said=lambda q: q):
        self._filter = make_filter()
        self._rates, self._force, self._said = rates, force, said

    def __getattr__(self, name):
        return getattr(self._filter, name)

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        return self._said(self._filter.update(self._rates * gyroscope, self._force * accelerometer,
                                              magnetometer, dt))


class Late(Misreading):
    """Its attitudes are 50 ms old."""

    def __init__(self, make_filter):
        super().__init__(make_filter)
        self._kept = deque()

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        self._kept.append(super().update(gyroscope, accelerometer, magnetometer, dt))
        return self._kept.popleft() if len(self._kept) > round(0.05 / dt) else self._kept[0]


# What every filter may misread.
MISREADINGS = {
    'gyroscope_units': partial(Misreading, rates=np.pi / 180.0),
    'conjugated': partial(Misreading, said=lambda q: q * (-1.0, -1.0, -1.0, 1.0)),
    'component_order': partial(Misreading, said=lambda q: q[[3, 0, 1, 2]]),
    'frame_ned': partial(Misreading, said=partial(product, np.array((HALF, HALF, 0.0, 0.0)))),
    'gravity_sign': partial(Misreading, force=-1.0),
    'stamp_offset': Late,
    'diverges': partial(Misreading, rates=-1.0),
    'invalid_output': partial(Misreading, said=lambda q: q * np.nan)}


class FirstOrder(ReferenceFilter):
    def integrate(self, quaternion, turn):
        return product(quaternion, np.array((*(0.5 * turn), 1.0)))


class TakesForceForGravity(ReferenceFilter):
    is_gravity_trusted = True


class WithoutBias(ReferenceFilter):
    def __init__(self):
        super().__init__(bias_stddev=1e-9)


class HalfCovariance(ReferenceFilter):
    covariance = property(lambda self: 0.5 * self._p[:3, :3])


class TwiceCovariance(ReferenceFilter):
    covariance = property(lambda self: 2.0 * self._p[:3, :3])


# The reference filter with each fault.
FAULTY = {
    'first_order_integration': FirstOrder, 'lever_arm': TakesForceForGravity,
    'no_bias_estimate': WithoutBias, 'covariance_small': HalfCovariance,
    'covariance_large': TwiceCovariance,
    **{name: partial(misread, ReferenceFilter) for name, misread in MISREADINGS.items()}}
