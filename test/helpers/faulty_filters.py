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

    def __init__(self, make_filter, rates=1.0, force=1.0, field=1.0, iron=0.0, step=None,
                 said=lambda q: q):
        self._filter = make_filter()
        self._rates, self._force, self._field, self._iron = rates, force, field, iron
        self._step, self._said = step, said

    def __getattr__(self, name):
        return getattr(self._filter, name)

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        if magnetometer is not None:
            magnetometer = self._field * magnetometer + self._iron
        return self._said(self._filter.update(self._rates * gyroscope, self._force * accelerometer,
                                              magnetometer, self._step or dt))


class Late(Misreading):
    """Its attitudes, or the rates that it gets, are 50 ms old."""

    def __init__(self, make_filter, of_rates=False):
        super().__init__(make_filter)
        self._kept, self._of_rates = deque(), of_rates

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        def late(value):
            self._kept.append(value)
            return self._kept.popleft() if len(self._kept) > round(0.05 / dt) else self._kept[0]

        q = super().update(late(gyroscope) if self._of_rates else gyroscope, accelerometer,
                           magnetometer, dt)
        return q if self._of_rates else late(q)


class Drifting(Misreading):
    """Its heading drifts by the noise of the accelerometer."""

    _angle = 0.0

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        self._angle += 0.6 * abs(np.linalg.norm(accelerometer) - 9.80665) * dt
        return product(np.array((0.0, 0.0, np.sin(self._angle), np.cos(self._angle))),
                       super().update(gyroscope, accelerometer, magnetometer, dt))


def longer(q):
    scaled = q * (1.05, 1.05, 1.05, 1.0)
    return scaled / np.linalg.norm(scaled)


# What every filter may misread.
MISREADINGS = {
    'gyroscope_units': partial(Misreading, rates=np.pi / 180.0),
    'conjugated': partial(Misreading, said=lambda q: q * (-1.0, -1.0, -1.0, 1.0)),
    'component_order': partial(Misreading, said=lambda q: q[[3, 0, 1, 2]]),
    'frame_ned': partial(Misreading, said=partial(product, np.array((HALF, HALF, 0.0, 0.0)))),
    'gravity_sign': partial(Misreading, force=-1.0),
    'stamp_offset': Late,
    'gyroscope_wiring': partial(Misreading, rates=-1.0),
    'accelerometer_wiring': partial(Misreading, force=np.array((1.0, 1.0, -1.0))),
    'magnetometer_wiring': partial(Misreading, field=np.array((1.0, -1.0, 1.0))),
    'time_step': partial(Misreading, step=0.01),
    'heading_offset': partial(Misreading, said=partial(product, np.array(
        (0.0, 0.0, np.sin(0.04), np.cos(0.04))))),
    'hard_iron': partial(Misreading, iron=np.array((10e-6, 0.0, 0.0))),
    'lag': partial(Late, of_rates=True), 'inaccurate': partial(Misreading, said=longer),
    'diverges': Drifting, 'invalid_output': partial(Misreading, said=lambda q: q * np.nan)}


class FirstOrder(Vqf):
    """Its steps turn by 2 arctan(|w| dt / 2), as those of q + q w dt / 2 do."""

    def update(self, gyroscope, accelerometer, magnetometer, dt):
        half = 0.5 * dt * np.linalg.norm(gyroscope)
        return super().update(gyroscope * (np.arctan(half) / half if half else 1.0),
                              accelerometer, magnetometer, dt)


class Negated(Vqf):
    bias = property(lambda self: -super().bias)


class OtherCovariance(ReferenceFilter):
    def __init__(self, factor):
        super().__init__()
        self._factor = factor

    covariance = property(lambda self: self._factor * ReferenceFilter.covariance.fget(self))


# A filter with each fault.
FAULTY = {
    'first_order_integration': FirstOrder,
    'covariance_small': partial(OtherCovariance, 0.5),
    'covariance_large': partial(OtherCovariance, 2.0),
    'bias_report': Negated, 'lever_arm': partial(Vqf, tauAcc=0.1),
    'no_bias_estimate': partial(Vqf, motionBiasEstEnabled=False, restBiasEstEnabled=False),
    **{name: partial(misread, Vqf) for name, misread in MISREADINGS.items()}}
