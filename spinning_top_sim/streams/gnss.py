# SPDX-License-Identifier: Apache-2.0
"""
The satellite receiver (GNSS), with its antenna at the pivot: fixes, velocities, and their truth.

Axes of noise and covariances are those of the world: east, north, up.  docs/sensor.md describes
delay and outages.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams import messages, noise
from spinning_top_sim.streams.cdr import NANOSECONDS, Field, Header, Numbers, Values
from spinning_top_sim.streams.channel import Channel, Samples, period_ns
from spinning_top_sim.streams.messages import message

NO_FIX, FIX = -1, 0         # sensor_msgs/NavSatStatus
UNKNOWN, DIAGONAL_KNOWN = 0, 2      # sensor_msgs/NavSatFix


def channels(values: Mapping[str, Any]) -> list[Channel]:
    """Return fixes and velocities as the receiver measures them, each with its truth."""
    period = period_ns(values['gnss.rate'])
    delay_ns = round(values['gnss.latency'] * NANOSECONDS)
    # Begin and end of each outage, in turn.
    edges_ns = np.rint(np.array(values['gnss.outages']) * NANOSECONDS).astype(np.int64)
    channel = partial(Channel, 'gnss', period_ns=period)
    fix = partial(channel, type_name='sensor_msgs/msg/NavSatFix',
                  encoder=message(
                      Header(values['body_frame']), Field('status.status', 1, 'b'),
                      Numbers('H', (1,)), Field('position', 3), Field('position_covariance', 9),
                      Field('position_covariance_type', 1, 'B')))
    position_noise, velocity_noise = values['gnss.position_noise'], values['gnss.velocity_noise']
    none = 0.0, 0.0

    def velocity(topic: str, deviations: tuple[float, float], **more: Any) -> Channel:
        return channel(topic, 'geometry_msgs/msg/TwistWithCovarianceStamped',
                       encoder=message(
                           Header(values['world_frame']), Field('twist.twist.linear', 3),
                           Numbers('d', (*messages.ORIGIN, *messages.diagonal(
                               *_variances(deviations), *3 * (-1.0,))))),
                       fields=partial(_velocity, values, deviations), **more)

    return [
        fix('gnss/fix', delay_ns=delay_ns,
            fields=partial(_fix, values, position_noise, edges_ns)),
        fix('ground_truth/gnss/fix', fields=partial(_fix, values, none, edges_ns[:0])),
        velocity('gnss/velocity', velocity_noise, delay_ns=delay_ns,
                 copies=lambda t_ns: 1 - _is_out(edges_ns, t_ns)),
        velocity('ground_truth/gnss/velocity', none)]


def _is_out(edges_ns: NDArray[np.int64], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return 1 for each time in an outage: an odd number of edges is past then."""
    return np.searchsorted(edges_ns, t_ns, 'right') % 2


def _measured(values: Mapping[str, Any], deviations: tuple[float, float], kind: noise.Kind,
              samples: Samples, exact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return measurements (3, n); deviations are those of a horizontal axis and the vertical."""
    if not any(deviations):
        return exact
    level, vertical = deviations
    return exact + np.array([[level], [level], [vertical]]) * noise.white(
        values['seed'], kind, noise.Part.WHITE, samples.t_ns // samples.times.step, 3)


def _fix(values: Mapping[str, Any], deviations: tuple[float, float],
         edges_ns: NDArray[np.int64], samples: Samples) -> Sequence[Values]:
    """Return status, position, covariance and its kind; in an outage NaN, without a fix."""
    from pymap3d import enu2geodetic  # noqa: PLC0415 - not every node has a receiver
    position = _measured(values, deviations, noise.Kind.GNSS_POSITION, samples,
                         samples.trajectory.place(samples.t_ns).position)
    is_out = _is_out(edges_ns, samples.t_ns) == 1
    geodetic = [np.where(is_out, np.nan, part)
                for part in enu2geodetic(*position, *values['gnss.origin'])]
    covariance = np.where(is_out[:, np.newaxis], 0.0, messages.diagonal(*_variances(deviations)))
    return ([np.where(is_out, NO_FIX, FIX)], geodetic, covariance,
            [np.where(is_out, UNKNOWN, DIAGONAL_KNOWN)])


def _velocity(values: Mapping[str, Any], deviations: tuple[float, float],
              samples: Samples) -> Sequence[Values]:
    return list(_measured(values, deviations, noise.Kind.GNSS_VELOCITY, samples,
                          samples.trajectory.place(samples.t_ns).velocity)),


def _variances(deviations: tuple[float, float]) -> tuple[float, float, float]:
    level, vertical = deviations
    return level ** 2, level ** 2, vertical ** 2
