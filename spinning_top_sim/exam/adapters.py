# SPDX-License-Identifier: Apache-2.0
"""
Adapters of published attitude filters; the extra `exam` installs them.

Each filter has the default settings of its package, but for the options that are given, and starts
from the attitude of its first readings.  With `magnetic=False` it does not use the magnetometer.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.feeding import Filter
from spinning_top_sim.exam.measures import from_two_vectors
from spinning_top_sim.exam.motions import FIELD, GRAVITY, Reals

W_FIRST, W_LAST = [3, 0, 1, 2], [1, 2, 3, 0]
# From axes north, west, up to east, north, up.
FROM_NWU = Rotation.from_euler('z', 90.0, degrees=True)


class Vqf:
    """VQF (Laidig and Seel 2023), package vqf.  Its period is fixed, turns are not."""

    def __init__(self, magnetic: bool = True, **options: float) -> None:
        from vqf import VQF  # noqa: PLC0415

        self._make, self._magnetic, self._period = partial(VQF, **options), magnetic, 0.0

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        if not self._period:
            self._filter, self._period = self._make(dt), dt
        uses_field = self._magnetic and magnetometer is not None
        self._filter.update(gyroscope * (dt / self._period), accelerometer,
                            *([magnetometer] * uses_field))
        said = self._filter.getQuat9D() if uses_field else self._filter.getQuat6D()
        return np.asarray(said)[W_LAST]

    @property
    def bias(self) -> Reals:
        """Gyroscope bias [rad/s]."""
        return np.asarray(self._filter.getBiasEstimate()[0])


class Ahrs:
    """
    The filters of Madgwick and Mahony and the EKF of the package ahrs (M. Garcia 2020).

    The x axis of Madgwick's world points north.  The EKF calls its frame NED, but a resting
    accelerometer reads +g along z there, which is up here.
    """

    def __init__(self, name: str, magnetic: bool = True, **options: Any) -> None:
        from ahrs import filters  # noqa: PLC0415

        self._name, self._magnetic = name, magnetic
        if name == 'EKF':
            self._filter = filters.EKF(magnetic_ref=list(FIELD), **options)
        else:
            self._filter = getattr(filters, name)(**options)
        if name == 'Madgwick' and magnetic:
            self._filter.gain = self._filter.gain_marg
        self._turn = FROM_NWU if name == 'Madgwick' and magnetic else Rotation.identity()
        self._attitude: Reals | None = None

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        uses_field = self._magnetic and magnetometer is not None
        readings = [gyroscope, accelerometer, *([magnetometer] * uses_field)]
        if self._attitude is None:
            start = from_two_vectors(accelerometer, magnetometer if uses_field else None)
            self._attitude = (self._turn.inv() * Rotation.from_quat(start)).as_quat()[W_FIRST]
        else:
            # This attribute, not the argument, tells the EKF whether there is a magnetometer.
            self._filter.mag = np.empty(0) if uses_field else None
            update = ('update' if self._name == 'EKF' else
                      'updateMARG' if uses_field else 'updateIMU')
            self._attitude = getattr(self._filter, update)(self._attitude, *readings, dt=dt)
        attitude = Rotation.from_quat(np.asarray(self._attitude)[W_LAST])
        return np.asarray((self._turn * attitude).as_quat())


class Imufusion:
    """Madgwick's later filter (thesis of 2014, ch. 7), package imufusion; it takes deg/s and g."""

    def __init__(self, magnetic: bool = True, **options: float) -> None:
        import imufusion  # noqa: PLC0415

        self._magnetic = magnetic
        self._filter: Any = imufusion.Ahrs()
        settings = imufusion.AhrsSettings()
        settings.convention = imufusion.CONVENTION_ENU
        for name, value in options.items():
            setattr(settings, name, value)
        self._filter.set_settings(settings)

    def update(self, gyroscope: Reals, accelerometer: Reals, magnetometer: Reals | None,
               dt: float) -> Reals:
        self._filter.set_sample_period(dt)
        rates, force = np.degrees(gyroscope), accelerometer / GRAVITY
        if self._magnetic and magnetometer is not None:
            self._filter.update(rates, force, 1e6 * magnetometer)
        else:
            self._filter.update_no_magnetometer(rates, force)
        said: Reals = np.asarray(self._filter.get_quaternion(), dtype=float)[W_LAST]
        return said / np.linalg.norm(said)


# By name; '-6d' is without magnetometer.
FILTERS: dict[str, Callable[[], Filter]] = {
    'vqf': Vqf, 'vqf-6d': partial(Vqf, magnetic=False),
    'madgwick': partial(Ahrs, 'Madgwick'), 'madgwick-6d': partial(Ahrs, 'Madgwick', False),
    'mahony': partial(Ahrs, 'Mahony'), 'mahony-6d': partial(Ahrs, 'Mahony', False),
    'ekf': partial(Ahrs, 'EKF'), 'ekf-6d': partial(Ahrs, 'EKF', False),
    'imufusion': Imufusion, 'imufusion-6d': partial(Imufusion, False),
}
