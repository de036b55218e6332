# SPDX-License-Identifier: Apache-2.0
"""
The satellite receiver (GNSS), with its antenna at the pivot: fixes, velocities, and their truth.

Axes of noise and covariances are those of the world: east, north, up.  docs/sensor.md describes
delay and outages.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.attitude import Vector
from spinning_top_sim.streams import messages, noise
from spinning_top_sim.streams.cdr import NANOSECONDS, Template
from spinning_top_sim.streams.stream import Encoded, Samples, Stream

NAN = 3 * (np.nan,)


class Gnss(Stream):
    """
    Fixes or velocities of the pivot, as a receiver measures them or exact.

    A measurement at t = k * period_ns is stamped with t, and sent `gnss.latency` later.

    is_exact : no noise, delay or outages
    """

    type_name: str
    _index: int             # of position or velocity in `Kinematics`
    _noise: str             # parameter of the standard deviations
    _purpose: noise.Purpose

    def __init__(self, values: Mapping[str, Any], topic: str, *, is_exact: bool = False) -> None:
        level, vertical = (0.0, 0.0) if is_exact else values[self._noise]
        super().__init__(values, 'gnss', topic, self.type_name, self._template_of(
            values, (level ** 2, level ** 2, vertical ** 2)))
        self._seed = values['seed']
        self._deviation = np.array([[level], [level], [vertical]])
        self.late_ns = 0 if is_exact else round(values['gnss.latency'] * NANOSECONDS)
        # Begin and end of each outage, in turn; an odd number of them is past within an outage.
        self._edges_ns = np.rint(np.array(() if is_exact else values['gnss.outages'])
                                 * NANOSECONDS).astype(np.int64)

    @staticmethod
    def _template_of(values: Mapping[str, Any], variances: tuple[float, ...]) -> Template:
        raise NotImplementedError

    def times(self, after_ns: int, until_ns: int) -> range:
        valid = super().times(max(after_ns - self.late_ns, -1), until_ns - self.late_ns)
        return range(valid.start + self.late_ns, valid.stop + self.late_ns, valid.step)

    def _measured(self, *samples: Samples) -> tuple[
            NDArray[np.int64], NDArray[np.int64], Vector, NDArray[np.bool_]]:
        """Return times and stamps of messages [ns], measurements, and which are in an outage."""
        t_ns = np.concatenate([one.t_ns for one in samples])
        valid_ns = t_ns - self.late_ns
        x, y, z = value = samples[0].path.pivot(valid_ns)[self._index]
        if self._deviation.any():
            x, y, z = value + self._deviation * noise.white(
                self._seed, self._purpose, valid_ns // self.period_ns, 3)
        return (t_ns, samples[0].epoch_ns + valid_ns, (x, y, z),
                np.searchsorted(self._edges_ns, valid_ns, 'right') % 2 == 1)


class Fix(Gnss):
    """sensor_msgs/NavSatFix; in an outage without a fix, and NaN."""

    type_name = 'sensor_msgs/msg/NavSatFix'
    _index, _noise, _purpose = 0, 'gnss.position_noise', noise.Purpose.GNSS_POSITION

    def __init__(self, values: Mapping[str, Any], topic: str, *, is_exact: bool = False) -> None:
        super().__init__(values, topic, is_exact=is_exact)
        self._origin = values['gnss.origin']
        self._no_fix = messages.nav_sat_fix(values['body_frame'], None)

    @staticmethod
    def _template_of(values: Mapping[str, Any], variances: tuple[float, ...]) -> Template:
        return messages.nav_sat_fix(values['body_frame'], messages.diagonal(*variances))

    def encode(self, *samples: Samples) -> Encoded:
        from pymap3d import enu2geodetic  # noqa: PLC0415 - not every node has a receiver
        t_ns, stamps_ns, position, is_out = self._measured(*samples)
        rows = self.template.encode(stamps_ns, enu2geodetic(*position, *self._origin))
        if is_out.any():
            rows = rows.copy()      # the template's own rows keep what is the same in all
            rows[is_out] = self._no_fix.encode(stamps_ns[is_out], NAN)
        return t_ns, rows


class Velocity(Gnss):
    """geometry_msgs/TwistWithCovarianceStamped in the axes of the world; none in an outage."""

    type_name = 'geometry_msgs/msg/TwistWithCovarianceStamped'
    _index, _noise, _purpose = 1, 'gnss.velocity_noise', noise.Purpose.GNSS_VELOCITY

    def __init__(self, values: Mapping[str, Any], topic: str, *, is_exact: bool = False) -> None:
        super().__init__(values, topic, is_exact=is_exact)
        edges_ns = self._edges_ns.tolist()
        self.silences_ns = list(zip(edges_ns[::2], edges_ns[1::2], strict=True))

    @staticmethod
    def _template_of(values: Mapping[str, Any], variances: tuple[float, ...]) -> Template:
        return messages.twist_with_covariance(values['world_frame'], variances)

    def encode(self, *samples: Samples) -> Encoded:
        t_ns, stamps_ns, velocity, is_out = self._measured(*samples)
        rows = self.template.encode(stamps_ns, velocity)
        return t_ns[~is_out], rows[~is_out]
