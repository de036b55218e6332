# SPDX-License-Identifier: Apache-2.0
"""
The satellite receiver (GNSS), with its antenna at the pivot: fixes, velocities, and their truth.

Axes are those of the world: east, north, up.  docs/sensor.md describes delay and outages.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.streams import messages, noise
from spinning_top_sim.streams.channel import Channel, Samples
from spinning_top_sim.streams.messages import Field, Header, Numbers, Values, message
from spinning_top_sim.streams.noise import Kind
from spinning_top_sim.times import NANOSECONDS, Times, period_ns

NO_FIX, FIX = -1, 0         # sensor_msgs/NavSatStatus
UNKNOWN, DIAGONAL_KNOWN = 0, 2      # sensor_msgs/NavSatFix
# Standard deviations along the axes.
Deviations = tuple[float, float, float]
EXACT = 0.0, 0.0, 0.0


def channels(values: Mapping[str, Any]) -> list[Channel]:
    """Return fixes and velocities as the receiver measures them, each with its truth."""
    delay_ns = round(values['gnss.latency'] * NANOSECONDS)
    # Begin and end of each outage, in turn.
    edges_ns = np.rint(np.array(values['gnss.outages']) * NANOSECONDS).astype(np.int64)
    channel = partial(Channel, 'gnss', period_ns=period_ns(values['gnss.rate']))

    def fix(topic: str, deviations: Deviations, edges_ns: Times, **more: Any) -> Channel:
        variances = messages.diagonal(*(one ** 2 for one in deviations))

        def fields(samples: Samples) -> Sequence[Values]:
            """Return status, position (NaN in an outage), covariance and its kind."""
            from pymap3d import enu2geodetic  # noqa: PLC0415 - not every node has a receiver
            position = _measured(values, deviations, Kind.GNSS_POSITION, samples,
                                 samples.trajectory.pivot_at(samples.t_ns).position)
            out = _is_out(edges_ns, samples.t_ns)
            return ([np.where(out, NO_FIX, FIX)],
                    [np.where(out, np.nan, part)
                     for part in enu2geodetic(*position, *values['gnss.origin'])],
                    np.where(out[:, np.newaxis], 0.0, variances),
                    [np.where(out, UNKNOWN, DIAGONAL_KNOWN)])

        return channel(topic, 'sensor_msgs/msg/NavSatFix', fields=fields, template=message(
            Header(values['body_frame']), Field('status.status', 1, 'b'), Numbers('H', (1,)),
            Field('position', 3), Field('position_covariance', 9),
            Field('position_covariance_type', 1, 'B')), **more)

    def velocity(topic: str, deviations: Deviations, **more: Any) -> Channel:
        covariance = messages.diagonal(*(one ** 2 for one in deviations), *3 * (-1.0,))
        return channel(
            topic, 'geometry_msgs/msg/TwistWithCovarianceStamped', template=message(
                Header(values['world_frame']), Field('twist.twist.linear', 3),
                Numbers('d', (*messages.ORIGIN, *covariance))),
            fields=lambda samples: [list(_measured(
                values, deviations, Kind.GNSS_VELOCITY, samples,
                samples.trajectory.pivot_at(samples.t_ns).velocity))], **more)

    of_fix, of_velocity = ((level, level, vertical) for level, vertical in (
        values['gnss.position_noise'], values['gnss.velocity_noise']))
    return [
        fix('gnss/fix', of_fix, edges_ns, delay_ns=delay_ns),
        fix('ground_truth/gnss/fix', EXACT, edges_ns[:0]),
        velocity('gnss/velocity', of_velocity, delay_ns=delay_ns,
                 faults=lambda t_ns: (0, 1 - _is_out(edges_ns, t_ns))),
        velocity('ground_truth/gnss/velocity', EXACT)]


def _is_out(edges_ns: Times, t_ns: Times) -> NDArray[np.int64]:
    """Return 1 for each time in an outage: an odd number of edges is past then."""
    return np.searchsorted(edges_ns, t_ns, 'right') % 2


def _measured(values: Mapping[str, Any], deviations: Deviations, kind: Kind,
              samples: Samples, exact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return measurements (3, n)."""
    return exact if not any(deviations) else exact + np.array([deviations]).T * noise.white(
        values['seed'], kind, samples.t_ns // samples.times.step)
