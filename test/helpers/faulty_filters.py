# SPDX-License-Identifier: Apache-2.0
"""Filters with one fault each, for the exam to find."""

from collections import deque
from functools import partial

import numpy as np

from spinning_top_sim.exam.adapters import Vqf
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


class FirstOrder(Vqf):
    """Its steps turn by 2 arctan(|w| dt / 2), as those of q + q w dt / 2 do."""

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        half = 0.5 * dt * np.linalg.norm(gyroscope)
        return super().update(gyroscope * (np.arctan(half) / half if half else 1.0),
                              accelerometer, magnetometer, dt)


class Tuned(Vqf):
    """VQF with other settings."""

    def __init__(self, **settings):
        super().__init__()
        self._make = partial(self._make, **settings)


class HalfCovariance(ReferenceFilter):
    covariance = property(lambda self: 0.5 * ReferenceFilter.covariance.fget(self))


class TwiceCovariance(ReferenceFilter):
    covariance = property(lambda self: 2.0 * ReferenceFilter.covariance.fget(self))


# A filter with each fault.
FAULTY = {
    'first_order_integration': FirstOrder,
    'covariance_small': HalfCovariance, 'covariance_large': TwiceCovariance,
    'lever_arm': partial(Tuned, tauAcc=0.1),
    'no_bias_estimate': partial(Tuned, motionBiasEstEnabled=False, restBiasEstEnabled=False),
    **{name: partial(misread, Vqf) for name, misread in MISREADINGS.items()}}
