# SPDX-License-Identifier: Apache-2.0
"""The markers: a body with the top's inertia where the pose is, and a trace that is its path."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.node_logs import xyz, xyzw
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import EPOCH_NS, SECOND, channel, play, run, simulate

from spinning_top_sim import Top, solve
from spinning_top_sim.physics.top import LARGEST, SMALLEST, THINNEST, Shape
from spinning_top_sim.streams import messages, parameters

PERIOD_NS = 50_000_000
CUSP = {'mass': 2.0, 'com_distance': 0.15, 'lambda1': 0.123, 'lambda3': 0.15, 'gravity': 9.8}
TRACE = {'markers.trace_length': 1.0, 'markers.trace_points': 40}


def markers_of(values=None, commands=(), duration_ns=3 * SECOND):
    """Return the messages of a run, {t [ns]: data}; commands: (t, l3, lz)."""
    simulation, sent = simulate({**TRACE, **(values or {})}), {}
    for t_ns, *momenta in (*commands, (duration_ns,)):
        sent |= {at - EPOCH_NS: data for _, at, data in play(simulation, t_ns, 'markers')}
        if momenta:
            simulation.apply('command', **dict(zip(('l3', 'lz'), momenta, strict=True)))
    return SimpleNamespace(sent=sent, template=channel(simulation, 'markers').template,
                           top=simulation.trajectory.top, simulation=simulation)


def decoded(run, t_ns):
    """Return position and orientation of the body, orientation of the axis, points (n, 3)."""
    position, body, pivot, axis, *points = run.template.decode(run.sent[t_ns])
    assert not pivot.any()
    return position[0], body[0], axis[0], points[0].reshape(-1, 3) if points else None


def axis_of(q):
    x, y, z, w = np.asarray(q).T
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]).T


@pytest.mark.parametrize('scene', SCENES)
def test_the_body_has_the_mass_and_the_moments_of_the_top(scene):
    top = parameters.top_of(parameters.checked(scene_parameters(scene)))
    shape = Shape(top)
    assert 0.5 * top.mass * shape.radius ** 2 == pytest.approx(top.lambda3, rel=1e-12)
    if top.is_realizable and shape.height > THINNEST * shape.radius:
        across = top.mass * (3.0 * shape.radius ** 2 + shape.height ** 2) / 12.0
        assert across + top.mass * shape.centre ** 2 == pytest.approx(top.lambda1, rel=1e-12)
    assert shape.centre == top.com_distance
    assert abs(shape.tip) > abs(shape.centre) + 0.5 * shape.height


@pytest.mark.parametrize(('changed', 'expected'), [
    ({'mass': 0.0}, {'radius': math.sqrt(0.3), 'centre': 0.15}),
    ({'com_distance': -0.15}, {'centre': -0.15, 'tip': -1.0}),
    ({'com_distance': 0.0}, {'centre': 0.0, 'tip': 1.0}),
    ({'lambda3': 1.0}, {'height': THINNEST}),
    ({'com_distance': 1.0}, {'height': THINNEST * math.sqrt(0.15)}),
    ({'mass': 5e-324}, {'radius': LARGEST, 'height': LARGEST}),
    ({'lambda1': 1e300, 'lambda3': 1e300}, {'radius': LARGEST}),
    ({'lambda1': 5e-324, 'lambda3': 5e-324}, {'radius': SMALLEST}),
])
def test_every_top_can_be_drawn(changed, expected):
    shape = Shape(Top(**{**CUSP, **changed}))
    assert math.copysign(1.0, shape.tip) == expected.pop('tip', math.copysign(1.0, shape.tip))
    for name, value in expected.items():
        assert getattr(shape, name) == pytest.approx(value, rel=1e-12), name
    assert SMALLEST <= shape.radius <= LARGEST
    assert SMALLEST <= shape.height <= LARGEST
    assert math.isfinite(shape.tip)


@pytest.mark.parametrize('values', [{'top.com_distance': -0.2}, {'solver.method': 'exact'}])
def test_the_body_is_where_the_pose_is(values):
    run = markers_of(values, duration_ns=SECOND)
    simulation, shape = simulate(values), Shape(run.top)
    for k in (0, 7, 20):
        list(simulation.play((), k * PERIOD_NS))
        (attitude,) = simulation.state().quaternion
        position, body, axis, points = decoded(run, k * PERIOD_NS)
        assert tuple(body) == tuple(axis) == tuple(attitude)
        arm = axis_of(attitude)
        assert position == pytest.approx(shape.centre * arm, abs=1e-15)
        assert points[-1] == pytest.approx(shape.tip * arm, abs=1e-15)


@pytest.mark.parametrize(('values', 'count'), [
    *(({**scene_parameters(scene), 'solver.method': ('rk45', 'exact')[number % 2]}, 40)
      for number, scene in enumerate(SCENES)),
    *(({'markers.trace_length': length, 'markers.trace_points': points}, count)
      for length, points, count in ((0.0, 200, 0), (1e-9, 1, 1), (3e-9, 200, 3), (0.1, 1, 1),
                                    (0.06, 7, 7)))])
def test_the_trace_is_the_path_of_the_tip(values, count):
    """Evenly spaced, the newest point before the sample; before t = 0 it stands at the start."""
    run = markers_of(values, duration_ns=3 * SECOND // 2)
    top, start = run.top, parameters.start_state(run.simulation.values)
    tip, length = Shape(top).tip, run.simulation.values['markers.trace_length']
    for t_ns in (0, PERIOD_NS, 10 * PERIOD_NS, 30 * PERIOD_NS):
        points = decoded(run, t_ns)[3]
        if not count:
            assert points is None
            continue
        spacing_ns = round(length * SECOND) // count
        newest = (t_ns - 1) // spacing_ns
        grid_ns = np.maximum(spacing_ns * np.arange(newest - count + 1, newest + 1), 0)
        exact = solve(top, start, grid_ns * 1e-9, method='exact')
        assert points.shape == (count + 1, 3)
        assert np.abs(points[:-1] - tip * axis_of(exact.quaternion)).max() < 1e-12 * abs(tip)


def test_a_coarse_solver_leaves_the_trace():
    """What is traced is the truth, and the body is where the solver has it."""
    points = decoded(markers_of({'solver.rtol': 1e-2, 'solver.atol': 1e-2}), 3 * SECOND)[3]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps[-1] > 1.5 * steps[-10:-1].max()


COMMANDS = ((700_000_000, 2.0, 1.5), (725_000_000, 1.9, 1.4), (1_234_567_890, 0.5, -0.3),
            (1_240_000_000, 1.6, 1.0))


def test_the_trace_goes_on_through_commands():
    drawn = markers_of(commands=COMMANDS)
    tip = np.linalg.norm(decoded(drawn, 0)[3][-1])
    _, found = run({'pose.rate': 40.0}, 3 * SECOND, 'pose', events=[
        (t_ns, 'command', {'l3': l3, 'lz': lz}) for t_ns, l3, lz in COMMANDS])
    axes = dict(zip(found['pose'][0].tolist(), axis_of(found['pose'][3]), strict=True))
    for t_ns in (750_000_000, 1_250_000_000, 1_500_000_000, 2_200_000_000):
        newest = (t_ns - 1) // 25_000_000
        expected = [axes[max(m, 0) * 25_000_000] for m in range(newest - 39, newest + 1)]
        assert decoded(drawn, t_ns)[3][:-1] == pytest.approx(tip * np.array(expected), abs=1e-8)


@pytest.mark.parametrize('frame', ['x' * 7, 'θ'])
def test_bodies_and_lines_are_drawn_to_the_scale_of_the_top(frame):
    """The axis is 2 % of the distance to the tip wide, the trace half of that."""
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message
    from test_templates import assert_same
    from visualization_msgs.msg import Marker, MarkerArray

    run = markers_of({'top.com_distance': -0.3, 'world_frame': frame}, duration_ns=0)
    shape, message = Shape(run.top), deserialize_message(run.sent[0], MarkerArray)
    assert_same(run.sent[0], message)
    position, body, axis_q, trace = decoded(run, 0)
    # From the pivot to the tip, then around the half-section of the cylinder, slightly outside.
    rim, far, near = 1.01 * shape.radius, shape.centre - 0.505 * shape.height, (
        shape.centre + 0.505 * shape.height)
    corners = ((0.0, 0.0), (0.0, shape.tip), (0.0, far), (rim, far), (rim, far), (rim, near),
               (rim, near), (0.0, near))
    size, width = (2.0 * shape.radius, 2.0 * shape.radius, shape.height), -0.02 * shape.tip
    for marker, kind, color, scale, place, q, points in zip(
            message.markers, (Marker.CYLINDER, Marker.LINE_LIST, Marker.LINE_STRIP),
            (messages.BODY_COLOR, messages.AXIS_COLOR, messages.TRACE_COLOR),
            (size, (width, 0.0, 0.0), (0.5 * width, 0.0, 0.0)),
            (position, np.zeros(3), np.zeros(3)), (body, axis_q, (0.0, 0.0, 0.0, 1.0)),
            ((), [(x, 0.0, z) for x, z in corners], trace), strict=True):
        assert (marker.type, marker.header.frame_id) == (kind, frame)
        assert (marker.color.r, marker.color.g, marker.color.b, marker.color.a) == tuple(
            np.float32(color).tolist())
        assert xyz(marker.scale) == pytest.approx(scale, abs=1e-15)
        assert xyz(marker.pose.position) == tuple(place)
        assert xyzw(marker.pose.orientation) == tuple(q)
        assert np.ravel([xyz(point) for point in marker.points]) == pytest.approx(np.ravel(points))
