# SPDX-License-Identifier: Apache-2.0
"""
The top and the trace of its tip for Foxglove and RViz, in the world frame.

Every message has the whole trace, so that it is complete wherever a viewer starts or jumps in a
log.  Its points are on the exact path, at multiples of a fixed time step; the last one is the tip
of the body.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import Point
from spinning_top_sim.shape import Shape
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS, Values
from spinning_top_sim.streams.channel import Channel, Samples, period_ns
from spinning_top_sim.streams.trajectory import Trajectory


def markers(values: Mapping[str, Any]) -> Channel:
    """Return the channel of the markers."""
    shape = Shape(parameters.top_of(values))
    length_ns = round(values['markers.trace_length'] * NANOSECONDS)
    count = min(values['markers.trace_points'], length_ns)
    # Slightly outside of the body, so that it does not hide the lines.
    rim, side = 1.01 * shape.radius, 1.01 * math.copysign(0.5 * shape.height, shape.tip)
    far, near = shape.centre + side, shape.centre - side
    lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
             0.0, 0.0, far, rim, 0.0, far,
             rim, 0.0, far, rim, 0.0, near,
             rim, 0.0, near, 0.0, 0.0, near)
    template = messages.markers(
        values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
        0.02 * abs(shape.tip), count + 1 if count else 0)
    return Channel('markers', 'markers', 'visualization_msgs/msg/MarkerArray',
                   period_ns(values['markers.rate']), template,
                   partial(_fields, shape, count, length_ns // count if count else 0))


def _fields(shape: Shape, count: int, spacing_ns: int, samples: Samples) -> Sequence[Values]:
    states = samples.states
    body = (states.position((0.0, 0.0, shape.centre)), states.rows_quaternion,
            (*states.pivot.position,), states.rows_quaternion)
    if not count:
        return body
    newest = (samples.t_ns[:, np.newaxis] - 1) // spacing_ns
    # Traces share points, which are computed once.
    numbers, places = np.unique(np.maximum(newest + np.arange(1 - count, 1), 0),
                                return_inverse=True)
    points = _exact_places(samples.trajectory, numbers * spacing_ns, (0.0, 0.0, shape.tip))
    traces = points[places.reshape(len(newest), -1)]
    tip = np.stack(states.position((0.0, 0.0, shape.tip)), axis=-1)[:, np.newaxis]
    traces = np.where(np.isnan(traces), tip, traces)
    return *body, np.concatenate((traces, tip), axis=1).reshape(len(newest), -1)


def _exact_places(trajectory: Trajectory, t_ns: NDArray[np.int64], point: Point,
                  ) -> NDArray[np.float64]:
    """Return where a point of the body is, (n, 3) [m]; NaN where the solution is not known."""
    truths = [(times, piece.truth(times)) for piece, times in trajectory.pieces(t_ns)]
    return np.concatenate([
        np.full((len(times), 3), np.nan) if states is None
        else np.stack(states.position(point), axis=-1) for times, states in truths])
