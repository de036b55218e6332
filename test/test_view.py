# SPDX-License-Identifier: Apache-2.0
"""What the page draws, as numbers; no browser, no ROS."""

import importlib
import math
import socket
import urllib.request

import numpy as np
import pytest
from helpers.reference import ROOT

from spinning_top_sim import State, solve
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.recording.writer import create_file
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.topics import all_streams
from spinning_top_sim.tools import recorded_run, simulate
from spinning_top_sim.view import command, model
from spinning_top_sim.view.track import Samples, Track, state_of

viser = pytest.importorskip('viser')
logs, pages, server, controls_of = (
    importlib.import_module(f'spinning_top_sim.view.{name}')
    for name in ('log', 'page', 'server', 'controls'))
COMMAND_S = 3.0


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp('view') / 'cusp.mcap'
    assert simulate.main([
        '--params', str(ROOT / 'config/cusp.yaml'), '--duration', '6', '-o', str(path),
        '-p', 'imu.rpy:=[0.3, -0.2, 1.0]', '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]',
        '--command', f'{COMMAND_S}:2.0:1.5']) == 0
    return path


@pytest.fixture(scope='module')
def shown(log):
    return logs.read_logs([log])[0]


def truth(shown, stamp_ns):
    """Return the exact state at a stamp before the command."""
    values = shown.values
    return solve(shown.top, parameters.start_state(values),
                 [(stamp_ns - shown.origin_ns) * 1e-9])


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    return float(np.einsum('ij,ij->', a, np.cross(b, c))) / 6.0


@pytest.mark.parametrize('angles', [(0.0, math.tau), (-0.3, 0.3), (0.3, math.tau - 0.3)])
def test_a_sector_is_closed_and_faces_outwards(angles):
    vertices, faces = model.sector(2.0, -0.5, 1.5, *angles)
    assert volume(vertices, faces) == pytest.approx(0.5 * 4.0 * (angles[1] - angles[0]) * 2.0,
                                                    rel=0.01)
    if angles[1] - angles[0] < math.tau:        # each edge once in each direction
        edges = [tuple(edge) for face in faces.tolist()
                 for edge in zip(face, [*face[1:], face[0]], strict=True)]
        assert len(set(edges)) == len(edges)
        assert {(b, a) for a, b in edges} == set(edges)


def test_samples_are_in_order_and_old_ones_are_forgotten():
    track = Track('', parameters.checked({}))
    for begin in range(0, 3000, 100):
        stamps = np.arange(begin + 149, begin - 1, -1)      # half of them are there already
        track.add('pose', Samples(stamps, np.column_stack(4 * (stamps + 0.001 * begin,))))
        track.forget(begin - 500)
    samples = track.samples['pose']
    assert samples.stamps_ns.tolist() == list(range(2400, 3050))
    assert samples.rows[-1].tolist() == 4 * [3049 + 2.9]
    assert samples.rows[110].tolist() == 4 * [2510 + 2.4]       # the first of its stamp
    assert samples.at(2399) is None
    assert samples.at(2500)[0] == 2500
    assert samples.at(99999)[0] == 3049
    assert samples.part(2500, 2502).stamps_ns.tolist() == [2500, 2501, 2502]


def test_a_log_shows_the_published_attitude_at_every_stamp(log, shown):
    template = next(stream.template for stream in all_streams(shown.values)
                    if stream.topic == 'pose')
    with LogReader(log) as reader:
        for message in reader.messages(topics=['/pose']):
            stamp_ns, row = shown.attitudes.at(message.log_time)
            assert stamp_ns == message.log_time
            assert row[:4] == pytest.approx(template.decode(message.data)[0][0], abs=1e-15)


def test_motions_of_a_log_begin_with_its_commands(shown):
    first, second = shown.motions
    assert (first.words[0], second.words[0]) == ('cusps', 'loops')
    assert (second.l3, second.lz) == (2.0, 1.5)
    assert shown.commands_ns == [second.begin_ns]
    assert second.begin_ns - shown.origin_ns == COMMAND_S * 1e9
    assert shown.motion_at(second.begin_ns - 1) is first
    assert shown.motion_at(second.begin_ns) is second
    assert first.theta_range[0] == pytest.approx(math.radians(30.0))


@pytest.mark.parametrize('name', model.ARROWS)
def test_arrows_are_the_vectors_in_the_world(shown, name):
    stamp_ns = shown.origin_ns + 1_230_000_000
    exact, top = truth(shown, stamp_ns), shown.top
    omega = exact.angular_velocity[0]
    body = {'angular velocity': omega,
            'angular momentum': omega * [top.lambda1, top.lambda1, top.lambda3],
            'specific force': np.ravel(exact.specific_force(shown.values['imu.lever_arm'])),
            }[name]
    x, y, z, w = exact.quaternion[0]
    rotation = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    drawn = model.arrow(shown, name, stamp_ns)
    expected = rotation @ body
    assert drawn / np.linalg.norm(drawn) == pytest.approx(expected / np.linalg.norm(expected),
                                                          abs=1e-8)
    if name == 'angular momentum':      # Lz is conserved, and L3 the usual length
        assert drawn[2] / model.reach(shown) == pytest.approx(
            exact.lz[0] / exact.l3[0], abs=1e-8)


def test_the_trace_ends_at_the_tip_and_breaks_where_it_jumps(shown):
    stamp_ns = shown.origin_ns + 2_000_000_000
    lines = model.trace(shown, stamp_ns)
    exact = truth(shown, stamp_ns)
    assert lines[-1, 1] == pytest.approx(
        model.reach(shown) * np.ravel(exact.rows_axis), abs=1e-6)
    assert len(lines) == 200            # 2 s at 100 Hz
    track = Track('', parameters.checked({}))
    half = math.sqrt(0.5)
    track.add('pose', Samples(np.arange(4), np.array(
        [(0, 0, 0, 1), (0, 0.01, 0, 1), (0, half, 0, half), (0, half, 0.01, half)], float)))
    assert len(model.trace(track, 3)) == 2


def test_the_trace_between_distant_samples_is_that_of_their_velocities(shown):
    moved = solve(shown.top, parameters.start_state(shown.values), np.arange(20) * 0.04)
    track = Track('', shown.values)
    track.add('joint_states', Samples(np.arange(20) * 40_000_000, np.column_stack(
        (moved.quaternion, moved.angular_velocity, moved.phi_dot))))
    stamps_ns, axis, joined = model.path(track, 0, NANOSECONDS)
    track.follow()
    assert track.motions[0].words == shown.motions[0].words     # those of the start
    assert len(stamps_ns) == 4 * 19 + 1 and joined.all()
    exact = solve(shown.top, parameters.start_state(shown.values), stamps_ns * 1e-9)
    assert axis == pytest.approx(np.column_stack(exact.rows_axis), abs=1e-4)


def test_curves_are_the_published_numbers(shown):
    end_ns = shown.origin_ns + 2_500_000_000
    for name, expected, tolerance in zip(model.CURVES[:2], (
            lambda exact: math.degrees(exact.theta[0]), lambda exact: exact.phi_dot[0]),
            (1e-8, 1e-7), strict=True):
        stamps_ns, values = model.curve(shown, name, shown.origin_ns, end_ns)
        for at in (0, 100, -1):
            assert values[at] == pytest.approx(expected(truth(shown, int(stamps_ns[at]))),
                                               abs=tolerance)
    for name in model.CURVES[2:]:
        _, values = model.curve(shown, name, shown.origin_ns, end_ns)
        assert len(values) == 26
        assert (values < -9.0).all()


@pytest.mark.parametrize(('start', 'words'), [
    (State(theta=0.5, l3=1.6, lz=1.6 * math.cos(0.5)), 'cusps'),
    (State(theta=0.5, l3=1.6, lz=1.3), 'loops'),
    (State(theta=0.0, l3=2.0, lz=2.0), 'sleeping'),
    (State(theta=0.0, theta_dot=2.0, l3=1.6, lz=1.6), 'through the top'),
    (State(theta=0.7, theta_dot=1.0, l3=1.6, lz=1.6), 'through the top'),
    (State(theta=1.0, theta_dot=0.5, l3=0.0, lz=0.0), 'planar pendulum, swinging')])
def test_a_live_track_names_the_motion_from_its_samples(start, words):
    values = parameters.checked({})
    track = Track('', values)
    moved = solve(track.top, start, np.arange(200) * 0.01)
    rows = np.column_stack((moved.quaternion, moved.angular_velocity, moved.phi_dot))
    for k, row in enumerate(rows):
        track.add('joint_states', Samples(np.array([k]), row[np.newaxis]))
        track.follow()
    (motion,) = track.motions           # one: rounding begins no other
    assert motion.words[0] == words
    (energy, l3, lz), _ = state_of(track.top, rows[50])
    assert (energy, l3, lz) == pytest.approx((moved.energy[50], start.l3, start.lz), abs=1e-9)


def test_means_of_the_rates_are_drawn_as_the_rates(tmp_path):
    rows = []
    for sampling in ('instant', 'mean'):
        path = tmp_path / f'{sampling}.mcap'
        assert simulate.main(['--duration', '1', '-o', str(path), '--quiet', '-p',
                              f'imu.sampling:={sampling}', '-p', 'imu.rpy:=[0.3, 0.0, 1.0]']) == 0
        rows.append(logs.read_logs([path])[0].samples['ground_truth/imu'].rows)
    assert rows[0].shape == rows[1].shape == (201, 10)
    assert (rows[0][:, :4] == rows[1][:, :4]).all()
    assert rows[1][1:, 4:7] == pytest.approx((rows[0][1:, 4:7] + rows[0][:-1, 4:7]) / 2, abs=2e-3)


@pytest.fixture(scope='module')
def later(tmp_path_factory):
    """Return logs of two seconds whose epochs are 1, 2 and 1000 s."""
    folder = tmp_path_factory.mktemp('later')
    paths = {epoch: folder / f'{epoch}.mcap' for epoch in (1, 2, 1000)}
    for epoch, path in paths.items():
        assert simulate.main(['--quiet', '--duration', '2', '-o', str(path), '--epoch',
                              str(epoch)]) == 0
    return paths


def test_a_log_that_begins_later_shows_nothing_before(page, later):
    player = logs.Player(page, logs.read_logs([later[1], later[2]]))
    player.draw_next(2.5)
    assert all(top.drawn and top._root.visible for top in page._tops)
    player._slider.value = 0.2
    for _ in range(pages.PLOT_EVERY):
        player.draw_next(0.0)
    assert page._tops[0].drawn and not page._tops[1].drawn and not page._tops[1]._root.visible
    assert 'no samples yet' in page._words.content
    assert 'angle between' not in page._words.content


def test_each_of_two_logs_has_its_own_time(page, later):
    player = logs.Player(page, logs.read_logs([later[1], later[1000]]))
    player.draw_next(0.5)
    assert player.length == 2.0
    assert page._words.content.count('- t = 0.500 s, stamp ') == 2
    assert all(np.isfinite(values).any() for values in page._plots[0].data)
    assert 'angle between the two: 0°' in page._words.content


@pytest.fixture(scope='module')
def torn(log, tmp_path_factory):
    path = tmp_path_factory.mktemp('torn') / 'torn.mcap'
    path.write_bytes(log.read_bytes()[:-60_000])
    return path


def test_a_truncated_log_that_cannot_be_followed_is_told_as_both(torn, monkeypatch):
    def odd(*_):
        raise recorded_run.DepartureError('nowhere')

    monkeypatch.setattr(recorded_run, 'rerun', odd)
    (shown,) = logs.read_logs([torn])
    assert shown.note == ('torn.mcap: it is truncated: shown as far as it goes; the run cannot be '
                          'followed: DepartureError: nowhere')


def test_two_logs_of_one_time_lie_on_each_other(log, torn):
    whole, part = logs.read_logs([log, torn])
    assert (whole.name, part.name) == ('cusp', 'torn')
    assert 'truncated' in part.note
    assert not whole.note
    assert whole.span[0] == part.span[0] < part.span[1] <= whole.span[1]
    row = part.attitudes.at(part.span[1])[1]
    assert model.angle_apart(row, whole.attitudes.at(part.span[1])[1]) == 0.0


def test_a_log_without_attitudes_is_refused(tmp_path):
    path = tmp_path / 'clock.mcap'
    assert simulate.main(['--duration', '1', '-o', str(path), '-p',
                          'record.streams:=[invariants]']) == 0
    with pytest.raises(LogError, match='no attitude of a top'):
        logs.read_logs([path])


@pytest.fixture
def estimate(log, tmp_path):
    """Return a log of another program: the attitudes of `log`, in disorder, of norm 1.5."""
    path = tmp_path / 'estimate.mcap'
    file = create_file(path, [RecordedTopic('/imu/data_raw', 'sensor_msgs/msg/Imu'),
                              RecordedTopic('/estimate', 'geometry_msgs/msg/PoseStamped')], {},
                       compression='zstd')
    with LogReader(log) as reader:
        poses = list(reader.messages(['/pose']))
        for reading in reader.messages(['/imu/data_raw']):      # without orientation
            file.append(0, reading.log_time, reading.data)
    for pose in [*poses[100:], *poses[:100]]:
        q = np.frombuffer(pose.data[-32:])
        file.append(1, pose.log_time, pose.data[:-32] + (1.5 * q).tobytes())
    file.append(1, poses[-1].log_time, bytes(len(poses[-1].data)))      # no attitude
    file.write_chunk()
    file.finish()
    return path


def test_the_log_of_another_program_is_shown_as_the_top_of_ours(log, estimate):
    ours, theirs = logs.read_logs([log, estimate])
    assert theirs.top == ours.top
    assert (theirs.span, theirs.commands_ns, theirs.note) == (ours.span, [], '')
    assert not theirs.motions
    for stamp_ns in np.linspace(*ours.span, 7).astype(int):
        one, other = (each.samples['pose'].at(stamp_ns) for each in (ours, theirs))
        assert one[0] == other[0]
        assert one[1][:4] == pytest.approx(other[1][:4], abs=1e-15)


def test_a_player_follows_its_buttons_and_the_slider(log, estimate, page):
    player = logs.Player(page, logs.read_logs([estimate, log]))
    assert player.length == pytest.approx(6.0)
    player.draw_next(1.0)
    assert player._slider.value == pytest.approx(1.0)
    player._go_to_next()
    player.draw_next(0.0)
    assert player._slider.value == pytest.approx(COMMAND_S)
    player._slider.value = 4.0
    player.draw_next(0.5)
    assert player._slider.value == pytest.approx(4.5)
    player._go_to_next()            # behind the last one
    player.draw_next(0.0)
    assert player._slider.value == pytest.approx(COMMAND_S)
    player.draw_next(9.0)
    assert (player._slider.value, player._button.label) == (pytest.approx(6.0), 'Play')
    player._switch()
    player.draw_next(0.5)
    assert (player._slider.value, player._button.label) == (pytest.approx(0.5), 'Pause')


@pytest.mark.skipif(not socket.has_ipv6, reason='no IPv6')
def test_the_server_may_be_on_ipv6():
    try:
        socket.create_server(('::1', 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip('no ::1')
    assert server._free_port('::1', None) >= 8080


def test_the_server_is_on_loopback_and_takes_the_next_free_port(page):
    other = pages.Page('two', '127.0.0.1', None)
    try:
        one, two = page.server.get_port(), other.server.get_port()
        assert one != two
        for each in (page, other):
            assert urllib.request.urlopen(each.address, timeout=30).status == 200
        with pytest.raises(OSError, match=f'127.0.0.1 port {one}: '):
            pages.Page('three', '127.0.0.1', one)
        assert page.server.request_share_url() is None
        host = socket.gethostbyname(socket.gethostname())
        if not host.startswith('127.'):
            with pytest.raises(OSError):        # nobody listens there
                socket.create_connection((host, one), 5.0)
    finally:
        other.close()


@pytest.mark.parametrize(('arguments', 'told'), [
    (['LOG', 'LOG', 'LOG'], '3 logs: must be one or two'),
    (['LOG', '--port', '99999'], '--port 99999: must be from 0 to 65535'),
    (['LOG', '--port', '-1'], '--port -1: must be from 0 to 65535')])
def test_wrong_arguments_are_told_in_one_line(log, capsys, arguments, told):
    assert command.main(['view', *(str(log) if word == 'LOG' else word
                                   for word in arguments)]) == 2
    assert capsys.readouterr().err == f'view: {told}\n'


@pytest.fixture
def page():
    page = pages.Page('one', '127.0.0.1', None)
    yield page
    page.close()


def test_a_part_that_is_switched_on_at_one_stamp_is_drawn_for_it(page, shown):
    stamp_ns = shown.origin_ns + NANOSECONDS
    page.set_tracks([shown])
    page._trace.value = page._bounds.value = False
    page.draw(stamp_ns, shown.origin_ns)
    (top,) = page._tops
    page.arrows[0].value = True
    page.draw(stamp_ns, shown.origin_ns)
    assert top._arrows[0].points[0, 1] == pytest.approx(
        model.arrow(shown, model.ARROWS[0], stamp_ns), abs=1e-6)
    page._trace.value = True
    page.draw(stamp_ns, shown.origin_ns)
    assert (top._trace.points == model.trace(shown, stamp_ns)).all()
    assert not any(bound.visible for bound in top._bounds)
    page._bounds.value = True
    page.draw(stamp_ns, shown.origin_ns)
    for bound, theta in zip(top._bounds, shown.motions[0].theta_range, strict=True):
        assert bound.visible
        assert (bound.points == model.circle(model.reach(shown), theta)).all()


def test_the_page_follows_a_pause_whatever_else_is_wrong(page):
    controls = controls_of.Controls(page, None, [])
    for state, label in (('paused', 'Resume'), ('failed', 'Resume'), ('running', 'Pause')):
        controls.tell_status('this machine cannot keep up', {
            'state': state, 'recorder': 'off', 'simulated time [s]': '1.0',
            'real-time factor': '0.9'})
        assert controls._pause.label == label


def test_a_page_tells_the_attitude_where_it_knows_no_motion(page):
    track = Track('', parameters.checked({}))
    page.set_tracks([track])
    page._tell(NANOSECONDS, 0)
    assert 'no samples yet' in page._words.content
    track.add('pose', Samples(np.array([NANOSECONDS]), np.array([[0.0, 0.6, 0.0, 0.8]])))
    page.draw(NANOSECONDS, 0)
    assert not any(bound.visible for bound in page._tops[0]._bounds)
    assert page._words.content.strip().splitlines() == [
        '- t = 1.000 s, stamp 1.000000000', '- q = 0.000000, 0.600000, 0.000000, 0.800000']


def test_a_page_of_another_site_is_refused(page):
    """Raw handshakes, as a browser sends them for a page that it has from elsewhere."""
    port = page.server.get_port()
    own = f'127.0.0.1:{port}'
    for host, origin, code in (
            (own, f'http://{own}', 101), (own, None, 101),      # None: no browser
            (own, 'http://evil.example', 403), (own, 'null', 403),      # a file
            # A name of another site that stands for this address.
            (f'evil.example:{port}', f'http://evil.example:{port}', 403)):
        lines = ['GET / HTTP/1.1', f'Host: {host}', 'Upgrade: websocket', 'Connection: Upgrade',
                 'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==', 'Sec-WebSocket-Version: 13',
                 f'Sec-WebSocket-Protocol: viser-v{viser.__version__}',
                 *([f'Origin: {origin}'] if origin else []), '', '']
        with socket.create_connection(('127.0.0.1', port), 30.0) as connection:
            connection.sendall('\r\n'.join(lines).encode())
            assert int(connection.recv(4096).split()[1]) == code, (host, origin)


@pytest.mark.parametrize(('asked', 'origin', 'allowed'), [
    ('[::1]:8080', 'http://[::1]:8080', True), ('192.0.2.7:8080', 'http://192.0.2.7:8080', True),
    ('robot:8080', 'http://robot:8080', True), ('ROBOT:8080', 'http://robot:8080', True),
    ('robot:8080', 'http://other:8080', False), ('other:8080', 'http://other:8080', False),
    ('robot:8080', 'http://robot', False), ('192.0.2.7:8080', 'http://192.0.2.8:8080', False),
    ('[::1', None, False)])
def test_names_and_addresses_of_the_page(asked, origin, allowed):
    assert (server.refusal(asked, origin, {'robot'}) == '') is allowed
