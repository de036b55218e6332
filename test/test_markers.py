# SPDX-License-Identifier: Apache-2.0
"""The markers: a body with the top's inertia where the pose is, and a trace that is its path."""


import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import SECOND, play, run, simulate

from spinning_top_sim import solve
from spinning_top_sim.shape import Shape
from spinning_top_sim.streams import markers, parameters

PERIOD_NS = 50_000_000


def drawn(values, until_ns, *topics, events=()):
    """Return simulation, other topics, and {t [ns]: (body's place and attitude, its trace)}."""
    simulation, found = run({'markers.trace_length': 1.0, 'markers.trace_points': 40, **values},
                            until_ns, 'markers', *topics, events=events)
    times_ns, _, position, body, pivot, axis, *trace = found.pop('markers')
    assert np.array_equal(body, axis) and not pivot.any()
    traces = trace[0].reshape(len(times_ns), -1, 3) if trace else len(times_ns) * [None]
    return simulation, found, dict(zip(times_ns.tolist(), zip(position, body, traces, strict=True),
                                       strict=True))


def axis_of(q):
    x, y, z, w = np.asarray(q).T
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]).T


@pytest.mark.parametrize('values', [{'top.com_distance': -0.2}, {'solver.method': 'exact'}])
def test_the_body_is_where_the_pose_is(values):
    simulation, found, there = drawn(values, SECOND, 'pose')
    shape, poses = Shape(simulation.trajectory.top), found['pose']
    for t_ns, attitude in zip(poses[0].tolist()[::5], poses[3][::5], strict=True):
        position, body, trace = there[t_ns]
        assert np.array_equal(body, attitude)
        assert position == pytest.approx(shape.centre * axis_of(attitude), abs=1e-15)
        assert trace[-1] == pytest.approx(shape.tip * axis_of(attitude), abs=1e-15)


@pytest.mark.parametrize(('values', 'count'), [
    *(({**scene_parameters(scene), 'solver.method': ('rk45', 'exact')[number % 2]}, 40)
      for number, scene in enumerate(SCENES)),
    *(({'markers.trace_length': length, 'markers.trace_points': points}, count)
      for length, points, count in ((0.0, 200, 0), (1e-9, 1, 1), (3e-9, 200, 3), (0.1, 1, 1),
                                    (0.06, 7, 7)))])
def test_the_trace_is_the_path_of_the_tip(values, count):
    """Evenly spaced, the newest point before the sample; before t = 0 it stands at the start."""
    simulation, _, there = drawn(values, 3 * SECOND // 2)
    top, start = simulation.trajectory.top, parameters.start_state(simulation.values)
    tip, length = Shape(top).tip, simulation.values['markers.trace_length']
    for t_ns in (0, PERIOD_NS, 10 * PERIOD_NS, 30 * PERIOD_NS):
        trace = there[t_ns][2]
        if not count:
            assert trace is None
            continue
        spacing_ns = round(length * SECOND) // count
        newest = (t_ns - 1) // spacing_ns
        grid_ns = np.maximum(spacing_ns * np.arange(newest - count + 1, newest + 1), 0)
        exact = solve(top, start, grid_ns * 1e-9, method='exact')
        assert trace.shape == (count + 1, 3)
        assert np.abs(trace[:-1] - tip * axis_of(exact.quaternion)).max() < 1e-12 * abs(tip)


def test_bodies_and_lines_are_drawn_to_the_scale_of_the_top():
    """The axis is 2 % of the distance to the tip wide, the trace half of that."""
    frame = 'θ'
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message
    from test_templates import assert_same, axes_of
    from visualization_msgs.msg import Marker, MarkerArray

    values = {'top.com_distance': -0.3, 'world_frame': frame}
    simulation, _, there = drawn(values, 0)
    shape, (position, body, trace) = Shape(simulation.trajectory.top), there[0]
    ((_, _, data),) = play(simulate({**simulation.values}), 0, 'markers')
    message = deserialize_message(data, MarkerArray)
    assert_same(data, message)
    # From the pivot to the tip, then around the half-section of the cylinder, slightly outside.
    rim, far, near = 1.01 * shape.radius, shape.centre - 0.505 * shape.height, (
        shape.centre + 0.505 * shape.height)
    corners = [(x, 0.0, z) for x, z in (
        (0.0, 0.0), (0.0, shape.tip), (0.0, far), (rim, far), (rim, far), (rim, near), (rim, near),
        (0.0, near))]
    size, width = (2.0 * shape.radius, 2.0 * shape.radius, shape.height), -0.02 * shape.tip
    nowhere, level = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for marker, kind, color, scale, place, q, points in zip(
            message.markers, (Marker.CYLINDER, Marker.LINE_LIST, Marker.LINE_STRIP),
            (markers.BODY_COLOR, markers.AXIS_COLOR, markers.TRACE_COLOR),
            (size, (width, 0.0, 0.0), (0.5 * width, 0.0, 0.0)), (position, nowhere, nowhere),
            (body, body, level), ((), corners, trace), strict=True):
        assert (marker.type, marker.header.frame_id) == (kind, frame)
        assert (marker.color.r, marker.color.g, marker.color.b, marker.color.a) == tuple(
            np.float32(color).tolist())
        assert axes_of(marker.scale) == pytest.approx(scale, abs=1e-15)
        assert axes_of(marker.pose.position) == list(place)
        assert axes_of(marker.pose.orientation) == list(q)
        assert np.ravel([axes_of(one) for one in marker.points]) == pytest.approx(np.ravel(points))
