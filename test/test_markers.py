# SPDX-License-Identifier: Apache-2.0
"""The markers: a body with the top's inertia where the pose is, and a trace that is its path."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.reference import SCENES, scene_parameters
from helpers.simulations import EPOCH_NS, SECOND, record, simulate, stream

from spinning_top_sim import Top, solve
from spinning_top_sim.physics.top import LARGEST, SMALLEST, THINNEST, Shape
from spinning_top_sim.streams import parameters

PERIOD_NS = 50_000_000
CUSP = {'mass': 2.0, 'com_distance': 0.15, 'lambda1': 0.123, 'lambda3': 0.15, 'gravity': 9.8}
TRACE = {'markers.trace_length': 1.0, 'markers.trace_points': 40}


def markers_of(values=None, commands=(), duration_ns=3 * SECOND, *, recorded=(0, math.inf)):
    """
    Return {t: message} of a run; commands: (t, l3, lz).

    recorded: the markers are recorded between these times [ns]
    """
    simulation = simulate({**TRACE, **(values or {})})
    sent = {}

    def write(numbers, stamp_ns, messages, size):
        sent[stamp_ns - EPOCH_NS] = bytes(messages[0])

    stops = {(t, l3, lz) for t, l3, lz in commands}
    stops |= {(t, None, None) for t in (*recorded, duration_ns) if t < math.inf}
    for t, l3, lz in sorted(stops, key=lambda stop: stop[0]):
        if t > 0:
            simulation.advance(t)
        if l3 is not None:
            simulation.command(l3, lz)
        simulation.log_to(write, [stream(simulation, 'markers')]
                          if recorded[0] <= t < recorded[1] else [])
    return SimpleNamespace(sent=sent, stream=stream(simulation, 'markers'), simulation=simulation)


def decoded(run, t_ns):
    """Return position and orientation of the body, orientation of the axis, points (n, 3)."""
    position, body, axis, *points = run.stream.template.decode(run.sent[t_ns])
    return position[0], body[0], axis[0], points[0].reshape(-1, 3) if points else None


def axis_of(q):
    x, y, z, w = np.asarray(q).T
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)]).T


# ----------------------------------------------------------------------------------- the shape


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
    ({'com_distance': -0.0}, {'tip': 1.0}),
    ({'lambda3': 1.0}, {'height': THINNEST}),
    ({'com_distance': 1.0}, {'height': THINNEST * math.sqrt(0.15)}),
    ({'com_distance': 1e200, 'gravity': 0.0}, {'centre': 1e200}),
    ({'mass': 5e-324}, {'radius': LARGEST, 'height': LARGEST}),
    ({'lambda1': 1e300, 'lambda3': 1e300}, {'radius': LARGEST}),
    ({'lambda1': 5e-324, 'lambda3': 5e-324}, {'radius': SMALLEST}),
])
def test_every_top_can_be_drawn(changed, expected):
    top = Top(**{**CUSP, **changed})
    assert top.is_realizable in (False, True)
    shape = Shape(top)
    for name, value in expected.items():
        found = getattr(shape, name)
        if name == 'tip':
            assert math.copysign(1.0, found) == value
        else:
            assert found == pytest.approx(value, rel=1e-12), name
    assert SMALLEST <= shape.radius <= LARGEST
    assert SMALLEST <= shape.height <= LARGEST
    assert math.isfinite(shape.tip)


# ------------------------------------------------------------------------------ what is drawn


@pytest.mark.parametrize('values', [{}, {'top.com_distance': -0.2}, {'solver.method': 'exact'}])
def test_the_body_is_where_the_pose_is(values):
    run = markers_of(values)
    simulation = simulate(values)
    for k in (0, 7, 60):
        simulation.advance(k * PERIOD_NS)
        (attitude,) = simulation.state().quaternion
        position, body, axis, points = decoded(run, k * PERIOD_NS)
        assert tuple(body) == tuple(axis) == tuple(attitude)
        arm, shape = axis_of(attitude), Shape(simulation.top)
        assert position == pytest.approx(shape.centre * arm, abs=1e-15)
        assert points[-1] == pytest.approx(shape.tip * arm, abs=1e-15)


@pytest.mark.parametrize('scene', SCENES)
@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_the_trace_is_the_path_of_the_tip(scene, method):
    run = markers_of({**scene_parameters(scene), 'solver.method': method})
    tip = Shape(run.simulation.top).tip
    start = parameters.start_state(run.simulation.values)
    for t_ns in (0, PERIOD_NS, 10 * PERIOD_NS, 60 * PERIOD_NS):
        points = decoded(run, t_ns)[3]
        assert len(points) == 41
        # 25 ms apart, the newest before the sample; before t = 0 it stands at the start.
        grid = np.arange((t_ns - 1) // 25_000_000 - 39, (t_ns - 1) // 25_000_000 + 1)
        times = np.maximum(grid, 0) * 0.025
        exact = solve(run.simulation.top, start, times, method='exact')
        assert np.abs(points[:-1] - tip * axis_of(exact.quaternion)).max() < 1e-12 * abs(tip)


def test_a_coarse_solver_leaves_the_trace():
    """What is traced is the truth, and the body is where the solver has it."""
    points = decoded(markers_of({'solver.rtol': 1e-2, 'solver.atol': 1e-2}), 3 * SECOND)[3]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps[-1] > 1.5 * steps[-10:-1].max()


def test_the_trace_goes_on_through_commands():
    commands = ((700_000_000, 2.0, 1.5), (1_234_567_890, 0.5, -0.3), (1_240_000_000, 1.6, 1.0))
    run = markers_of(commands=commands)
    pose = simulate(pose__rate=40.0)
    taken = record(pose, 'pose')
    for t, l3, lz in commands:
        pose.advance(t)
        pose.command(l3, lz)
    pose.advance(3 * SECOND)
    poses = {t_ns: data for _, t_ns, data in taken}
    tip = run.stream.template.decode(run.sent[0])[3][0][-3:]
    for t_ns in (750_000_000, 1_250_000_000, 1_500_000_000, 2_200_000_000):
        points = decoded(run, t_ns)[3]
        found = {m * 25_000_000: point for m, point in zip(
            range((t_ns - 1) // 25_000_000 - 39, (t_ns - 1) // 25_000_000 + 1), points,
            strict=False)}
        for time, point in found.items():
            (q,) = stream(pose, 'pose').template.decode(poses[max(time, 0)])
            assert point == pytest.approx(np.linalg.norm(tip) * axis_of(q[0]), abs=1e-8)


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_who_comes_late_sees_the_same(method):
    """Bytes depend on the sample alone: not on when the stream began to have sinks."""
    values = {'solver.method': method}
    commands = ((700_000_000, 2.0, 1.5), (725_000_000, 1.9, 1.4), (1_600_000_001, 0.5, -0.3))
    early = markers_of(values, commands)
    for begin in (1, 710_000_000, 1_650_000_000, 2_900_000_000):
        late = markers_of(values, commands, recorded=(begin, math.inf))
        assert late.sent == {t: data for t, data in early.sent.items() if t > begin}
        assert late.sent
    interrupted = markers_of(values, commands, recorded=(1, 800_000_000))
    assert interrupted.sent == {t: data for t, data in early.sent.items()
                                if 1 < t <= 800_000_000}


def test_commands_for_hours_are_not_kept():
    simulation = simulate(TRACE)
    for k in range(200):
        simulation.advance(k * 100_000_000)
        simulation.command(1.6, 1.3 + 0.001 * (k % 2))
    assert len(stream(simulation, 'markers')._segments) < 15


@pytest.mark.parametrize(('length', 'points'), [(0.0, 200), (1e-9, 1), (3e-9, 200), (0.1, 1),
                                                (0.04, 5), (0.06, 7)])
def test_short_traces_and_none(length, points):
    run = markers_of({'markers.trace_length': length, 'markers.trace_points': points},
                     duration_ns=SECOND)
    found = decoded(run, SECOND)[3]
    if length == 0.0:
        assert found is None
        return
    count = min(points, round(length * SECOND))
    spacing_ns = round(length * SECOND) // count
    newest = (SECOND - 1) // spacing_ns
    grid_ns = spacing_ns * np.arange(newest - count + 1, newest + 1)
    top, start = run.simulation.top, parameters.start_state(run.simulation.values)
    axis = axis_of(solve(top, start, grid_ns * 1e-9, method='exact').quaternion)
    assert found.shape == (count + 1, 3)
    assert np.abs(found[:-1] - Shape(top).tip * axis).max() < 1e-12


def test_a_reset_begins_the_trace_anew():
    run = markers_of(commands=((SECOND, 2.0, 1.5),))
    first = dict(run.sent)
    run.simulation.restart(run.simulation.values)
    run.sent.clear()
    run.simulation.advance(SECOND)
    assert run.sent == {t: data for t, data in first.items() if t <= SECOND}


# ------------------------------------------------------------------------------------- as ROS

@pytest.mark.parametrize('values', [{}, {'top.com_distance': -0.3, 'world_frame': 'map'}])
def test_the_lines_are_drawn_to_the_scale_of_the_top(values):
    """The axis is 2 % of the distance to the tip wide, the trace half of that."""
    pytest.importorskip('rclpy')
    from rclpy.serialization import deserialize_message
    from visualization_msgs.msg import MarkerArray

    run = markers_of(values, duration_ns=SECOND)
    body, axis, trace = deserialize_message(run.sent[SECOND], MarkerArray).markers
    shape = Shape(run.simulation.top)
    assert (body.scale.x, body.scale.y, body.scale.z) == (
        2.0 * shape.radius, 2.0 * shape.radius, shape.height)
    assert axis.scale.x == pytest.approx(0.02 * abs(shape.tip), rel=1e-12)
    assert trace.scale.x == pytest.approx(0.01 * abs(shape.tip), rel=1e-12)
    assert (axis.scale.y, axis.scale.z, trace.scale.y, trace.scale.z) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize('frame', ['', 'world', 'a/map', 'x' * 7, 'θ'])
@pytest.mark.parametrize('count', [0, 1, 2, 41])
def test_the_message_is_what_ros_serializes(frame, count):
    pytest.importorskip('rclpy')
    from geometry_msgs.msg import Point
    from rclpy.serialization import deserialize_message
    from test_templates import STAMPS, assert_same, numbers
    from visualization_msgs.msg import Marker, MarkerArray

    from spinning_top_sim.streams import messages

    size, lines = (0.75, 0.75, 0.125), tuple(range(12))
    template = messages.markers(frame, size, lines, 0.0625, count)
    dice = numbers(11 + 3 * count)
    fields = [dice[:3], dice[3:7], dice[7:11], *([dice[11:]] if count else [])]
    for stamp_ns in STAMPS:
        ours = template.encode_one(stamp_ns, *fields)
        message = deserialize_message(ours, MarkerArray)
        assert_same(ours, message)
        body, axis, *trace = message.markers
        for marker in message.markers:
            assert marker.header.frame_id == frame
            stamp = marker.header.stamp
            assert stamp.sec * SECOND + stamp.nanosec == stamp_ns
            assert (marker.id, marker.action, marker.frame_locked) == (0, Marker.ADD, False)
            assert marker.color.a == 1.0
            assert marker.lifetime.sec == marker.lifetime.nanosec == 0
        assert len({marker.ns for marker in message.markers}) == len(message.markers)
        assert (body.type, axis.type) == (Marker.CYLINDER, Marker.LINE_LIST)
        assert (body.scale.x, body.scale.y, body.scale.z) == size
        position, q = body.pose.position, body.pose.orientation
        assert [position.x, position.y, position.z, q.x, q.y, q.z, q.w] == dice[:7]
        q = axis.pose.orientation
        assert [q.x, q.y, q.z, q.w] == dice[7:11]
        assert axis.points == [Point(x=float(i), y=i + 1.0, z=i + 2.0) for i in (0, 3, 6, 9)]
        assert len(trace) == bool(count)
        for marker in trace:
            assert marker.type == Marker.LINE_STRIP
            assert [c for p in marker.points for c in (p.x, p.y, p.z)] == dice[11:]
            assert marker.scale.x == 0.5 * axis.scale.x == 0.03125
