# SPDX-License-Identifier: Apache-2.0
"""The top and the trace of its tip as markers for Foxglove and RViz."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import Top
from spinning_top_sim.streams import messages, parameters
from spinning_top_sim.streams.cdr import NANOSECONDS, Field
from spinning_top_sim.streams.segment import Axis, Segment
from spinning_top_sim.streams.stream import Stream

# The thinnest disc that can still be seen, by its radius.
THINNEST = 0.02
# What can be drawn in single precision [m].
SMALLEST, LARGEST = 1e-6, 1e6


class Shape:
    """
    The solid cylinder about the axis e3 that is drawn for a top, and the end of the axis [m].

    It has lambda3 = M r^2/2 along its axis and M (3 r^2 + h^2)/12 across it, about the centre of
    mass.  Where there is none (see `Top.is_realizable`) it is a thin disc with the same lambda3,
    and without a mass it is drawn as of 1 kg.

    centre : of the cylinder along e3, signed: the centre of mass
    tip : along e3, on the side of the centre of mass, half a radius out of the cylinder
    """

    def __init__(self, top: Top) -> None:
        mass = top.mass or 1.0
        square = 12.0 * ((top.lambda1_at_com - 0.5 * top.lambda3) / mass)
        self.radius = _drawable(math.sqrt(2.0 * (top.lambda3 / mass)))
        self.height = _drawable(max(math.sqrt(max(square, 0.0)), THINNEST * self.radius))
        self.centre = top.com_distance
        reach = abs(self.centre) + 0.5 * self.height + 0.5 * self.radius
        self.tip = math.copysign(reach, self.centre or 1.0)


def _drawable(length: float) -> float:
    return min(max(length, SMALLEST), LARGEST)


class Markers(Stream):
    """
    The top and the trace of its tip, in the world frame: no TF is needed.

    A line along the axis and down the side of the body shows the spin.  Every message has the
    whole trace, so that a viewer who comes late, or moves about in a log, sees it at once.  Its
    points are those of the exact solution at fixed times m * spacing before the sample; the tip of
    the body ends it: with a coarse `solver.rtol` one sees the body leave the path.
    """

    parameter, topic, type_name = 'markers', 'markers', 'visualization_msgs/msg/MarkerArray'

    def __init__(self, values: Mapping[str, Any]) -> None:
        shape = self._shape = Shape(parameters.top_of(values))
        self._length_ns = round(values['markers.trace_length'] * NANOSECONDS)
        self._count = min(values['markers.trace_points'], self._length_ns)
        self._spacing_ns = max(1, self._length_ns // max(self._count, 1))
        self._segments: deque[Segment] = deque()
        # Slightly outside, to be seen.
        rim, side = 1.01 * shape.radius, 1.01 * math.copysign(0.5 * shape.height, shape.tip)
        far, near = shape.centre + side, shape.centre - side
        lines = (0.0, 0.0, 0.0, 0.0, 0.0, shape.tip,
                 0.0, 0.0, far, rim, 0.0, far,
                 rim, 0.0, far, rim, 0.0, near,
                 rim, 0.0, near, 0.0, 0.0, near)
        super().__init__(values, messages.markers(
            values['world_frame'], (2.0 * shape.radius, 2.0 * shape.radius, shape.height), lines,
            0.02 * abs(shape.tip), self._count + 1 if self._count else 0))

    def follow(self, segment: Segment) -> None:
        """Begin a new segment; forget those that the trace does not reach any more."""
        self._segments.append(segment)
        oldest_ns = segment.start_ns - self._length_ns
        while len(self._segments) > 1 and self._segments[1].start_ns < oldest_ns:
            self._segments.popleft()

    def fields(self, states: States, times: range) -> Sequence[Field]:
        axis = states.rows_axis
        body = (tuple(self._shape.centre * part for part in axis), states.rows_quaternion,
                states.rows_quaternion)
        return (*body, self._traces(times, axis)) if self._count else body

    def _traces(self, times: range, axis: Axis) -> NDArray[np.float64]:
        """Return the points of the traces (n, 3 (count + 1)) that end at these times."""
        count = self._count
        newest = (np.arange(times.start, times.stop, times.step) - 1) // self._spacing_ns
        # A trace shares points with the one before it; there they are computed once.
        fresh = np.minimum(np.diff(newest, prepend=newest[0] - count), count)
        ends = np.cumsum(fresh)
        grid = np.repeat(newest + 1 - ends, fresh) + np.arange(ends[-1])
        points = self._past_axis(np.maximum(grid * self._spacing_ns, 0))
        traces = np.empty((len(times), count + 1, 3))
        for row, end in zip(traces, ends.tolist(), strict=True):
            row[:-1] = points[end - count:end]
        traces[:, -1] = np.stack(axis, axis=-1)
        traces *= self._shape.tip
        return traces.reshape(len(times), -1)

    def _past_axis(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the axis in the world at ascending times of the last `trace_length`, (n, 3)."""
        begins = [segment.start_ns for segment in self._segments]
        # A segment ends with the command that begins the next one, that instant included.
        ends = np.searchsorted(times_ns, begins[1:], 'right')
        return np.concatenate([
            np.stack(segment.exact_axis(times), axis=-1) for segment, times in zip(
                self._segments, np.split(times_ns, ends), strict=True) if len(times)])
