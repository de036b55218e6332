# SPDX-License-Identifier: Apache-2.0
"""
The top and the trace of its tip for Foxglove and RViz, in the world frame.

Every message has the whole trace, as a viewer may start anywhere.  Its points are on the exact
path, at multiples of a fixed time step; the last one is the tip of the body.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spinning_top_sim.physics.attitude import rotated
from spinning_top_sim.shape import Shape
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.channel import Channel, Samples
from spinning_top_sim.streams.messages import Field, Header, Numbers, Part, Template, Values
from spinning_top_sim.times import NANOSECONDS, period_ns

CYLINDER, LINE_STRIP, LINE_LIST = 3, 4, 5       # visualization_msgs/Marker
BODY_COLOR = (0.20, 0.40, 0.70, 1.0)            # red, green, blue, alpha
AXIS_COLOR = (0.95, 0.75, 0.20, 1.0)
TRACE_COLOR = (0.90, 0.30, 0.20, 1.0)


def markers(values: Mapping[str, Any]) -> Channel:
    """Return the channel of the markers."""
    shape = Shape(parameters.top_of(values))
    length_ns = round(values['markers.trace_length'] * NANOSECONDS)
    count = min(values['markers.trace_points'], length_ns)
    spacing_ns = length_ns // count if count else 0

    def fields(samples: Samples) -> Sequence[Values]:
        states = samples.states
        body = (states.position((0.0, 0.0, shape.centre)), states.rows_quaternion,
                (*states.pivot.position,), states.rows_quaternion)
        if not count:
            return body
        newest = (samples.t_ns[:, np.newaxis] - 1) // spacing_ns
        # Traces share points, which are computed once.
        numbers, places = np.unique(np.maximum(newest + np.arange(1 - count, 1), 0),
                                    return_inverse=True)
        t_ns, tip = numbers * spacing_ns, (0.0, 0.0, shape.tip)
        points = (np.stack(rotated(samples.trajectory.exact_attitude(t_ns), tip))
                  + samples.trajectory.pivot_at(t_ns).position).T
        traces = points[places.reshape(len(newest), -1)]
        now = np.stack(states.position(tip), axis=-1)[:, np.newaxis]
        traces = np.where(np.isnan(traces), now, traces)
        return *body, np.concatenate((traces, now), axis=1).reshape(len(newest), -1)

    return Channel('markers', 'markers', 'visualization_msgs/msg/MarkerArray',
                   period_ns(values['markers.rate']),
                   _template(shape, values['world_frame'], count + 1 if count else 0), fields)


def _template(shape: Shape, frame_id: str, trace_points: int) -> Template:
    """Return a cylinder, lines on it, and a trace if it has points."""
    # Slightly outside of the body, so that it does not hide the lines.
    rim, side = 1.01 * shape.radius, 1.01 * math.copysign(0.5 * shape.height, shape.tip)
    far, near = shape.centre + side, shape.centre - side
    # Begin and end of each line.
    lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
             0.0, 0.0, far, rim, 0.0, far,
             rim, 0.0, far, rim, 0.0, near,
             rim, 0.0, near, 0.0, 0.0, near)
    diameter, width = 2.0 * shape.radius, 0.02 * abs(shape.tip)
    parts = [
        *_marker(0, frame_id, 'body', CYLINDER, (diameter, diameter, shape.height), BODY_COLOR,
                 Numbers('I', (0,))),
        *_marker(1, frame_id, 'axis', LINE_LIST, (width, 0.0, 0.0), AXIS_COLOR,
                 Numbers('I', (len(lines) // 3,)), Numbers('d', lines))]
    if trace_points:
        parts += _marker(2, frame_id, 'trace', LINE_STRIP, (0.5 * width, 0.0, 0.0), TRACE_COLOR,
                         Numbers('I', (trace_points,)),
                         Field('markers[2].points', 3 * trace_points))
    return messages.message(Numbers('I', (3 if trace_points else 2,)), *parts)


def _marker(number: int, frame_id: str, namespace: str, kind: int, scale: tuple[float, ...],
            color: tuple[float, ...], *points: Part) -> list[Part]:
    """Return a visualization_msgs/Marker; the points of a line strip are in the world."""
    place = f'markers[{number}].pose'
    pose: list[Part] = [Field(f'{place}.position', 3), Field(f'{place}.orientation', 4)]
    if kind == LINE_STRIP:
        pose = [Numbers('d', (*messages.ORIGIN, *messages.NO_ROTATION))]
    return [
        Header(frame_id), namespace, Numbers('i', (0, kind, 0)),    # id, type, action: add
        *pose, Numbers('d', scale), Numbers('f', color),
        Numbers('I', (0, 0)), Numbers('?', (False,)),               # lifetime, frame_locked
        *points, Numbers('I', (0,)), '',                            # colors, texture_resource
        Numbers('I', (0, 0)), '', '', Numbers('I', (0, 0)),         # texture, uv_coordinates
        '', '', '', Numbers('I', (0,)),                             # text, mesh, its file and data
        Numbers('?', (False,))]                                     # mesh_use_embedded_materials
