# SPDX-License-Identifier: Apache-2.0
"""What the page draws, as numbers; no browser, no ROS."""

import importlib
import math
import socket
import urllib.request
from importlib import metadata
from importlib.util import find_spec
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.inspected import rewritten
from helpers.recordings import write_rows
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation
from spinning_top_sim.view.track import Series, Track, attitude_rows

from spinning_top_sim import solve
from spinning_top_sim.installation import parameter_files
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.view import command, plots, shapes, svg, text

pytestmark = pytest.mark.skipif(find_spec('viser') is None, reason='viser is not there')


class Later:
    """A module that is imported where it is used: viser takes a second."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, name):
        if name[0] == '_':              # pytest looks whether it is a fixture
            raise AttributeError(name)
        return getattr(importlib.import_module(self._name), name)


logs, pages = Later('spinning_top_sim.view.log'), Later('spinning_top_sim.view.page')
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
    return logs.read_logs([log])[0][0]


def truth(shown, stamp_ns):
    """Return the exact state at a stamp before the command."""
    values = shown.values
    return solve(shown.top, parameters.start_state(values), [(stamp_ns - shown.epoch_ns) * 1e-9])


def test_a_log_shows_the_published_attitude_at_every_stamp(log, shown):
    template = shown.templates['pose']
    with LogReader(log) as reader:
        for message in reader.messages(topics=['/pose']):
            stamp_ns, row = shown.attitudes.at(message.log_time)
            assert stamp_ns == message.log_time
            assert row[:4] == pytest.approx(template.decode(message.data)[1][0], abs=1e-15)


def test_motions_of_a_log_begin_with_its_commands(shown):
    first, second = shown.motions
    assert (first.description.name, second.description.name) == ('cusps', 'loops')
    assert (second.l3, second.lz) == (2.0, 1.5)
    assert shown.commands_ns == [second.begin_ns]
    assert second.begin_ns - shown.epoch_ns == COMMAND_S * 1e9
    assert shown.motion_at(second.begin_ns - 1) is first
    assert first.description.theta_min == pytest.approx(math.radians(30.0))


@pytest.mark.parametrize('name', shapes.ARROWS)
def test_arrows_are_the_vectors_in_the_world(shown, name):
    stamp_ns = shown.epoch_ns + 1_230_000_000
    exact, top = truth(shown, stamp_ns), shown.top
    omega, turn = exact.angular_velocity[0], Rotation.from_quat(exact.quaternion[0])
    up = turn.inv().apply([0.0, 0.0, 1.0])
    body = {'angular velocity': omega,
            'angular momentum': omega * [top.lambda1, top.lambda1, top.lambda3],
            'torque': np.cross([0.0, 0.0, top.com_distance], -top.mass * top.gravity * up),
            'specific force': np.ravel(exact.specific_force(shown.values['imu.lever_arm'])),
            }[name]
    drawn = shapes.arrow(shown, name, stamp_ns)
    expected = turn.apply(body)
    assert drawn / np.linalg.norm(drawn) == pytest.approx(expected / np.linalg.norm(expected),
                                                          abs=1e-8)
    if name == 'torque':                # P sin(theta), about the line of nodes
        assert np.linalg.norm(drawn) / shapes.axis_length(shown) == pytest.approx(
            math.sin(exact.theta[0]), abs=1e-8)
        assert drawn @ [math.sin(exact.phi[0]), -math.cos(exact.phi[0]), 0.0] == pytest.approx(
            -np.linalg.norm(drawn))
    if name == 'angular momentum':      # Lz is conserved, and L3 the usual length
        assert drawn[2] / shapes.axis_length(shown) == pytest.approx(
            exact.lz[0] / exact.l3[0], abs=1e-8)


def test_the_trace_ends_at_the_tip_and_breaks_where_it_jumps(shown):
    stamp_ns = shown.epoch_ns + 2_000_000_000
    lines = shapes.trace(shown, stamp_ns)
    exact = truth(shown, stamp_ns)
    assert lines[-1, 1] == pytest.approx(
        shapes.axis_length(shown) * np.ravel(exact.rows_axis), abs=1e-6)
    assert len(lines) == 200            # 2 s at 100 Hz
    track = Track('', parameters.checked({}))
    half = math.sqrt(0.5)
    turns = np.array([(0, 0, 0, 1), (0, 0.01, 0, 1), (0, half, 0, half), (0, half, 0.01, half)])
    track.add('pose', Series(np.arange(4), attitude_rows(turns, place=0.0)))
    assert len(shapes.trace(track, 3)) == 2


def test_the_trace_between_distant_samples_is_that_of_their_velocities(shown):
    moved = solve(shown.top, parameters.start_state(shown.values), np.arange(20) * 0.04)
    track = Track('', shown.values)
    track.add('joint_states', Series(np.arange(20) * 40_000_000, attitude_rows(
        moved.quaternion, moved.angular_velocity, moved.phi_dot)))
    stamps_ns, axis, joined = shapes.trace_points(track, 0, NANOSECONDS)
    assert len(stamps_ns) == 4 * 19 + 1 and joined.all()
    exact = solve(shown.top, parameters.start_state(shown.values), stamps_ns * 1e-9)
    assert axis == pytest.approx(np.column_stack(exact.rows_axis), abs=1e-4)


def plotted(shown, stamp_ns):
    """Return the lines of the plots of 2.5 s, by plot and name."""
    top = plots.Plotted(shown, stamp_ns, shown.epoch_ns, stamp_ns, shown.epoch_ns)
    return {(plot.title, line.name): (plot, line) for plot in (
        *plots.motion_plots([top]), *plots.accuracy_plots([top])) for line in plot.lines}


def test_plots_are_the_published_numbers(shown):
    stamp_ns = shown.epoch_ns + 2_500_000_000
    found = plotted(shown, stamp_ns)
    for key, expected, tolerance in (
            (('Tilt', 'θ'), lambda exact: math.degrees(exact.theta[0]), 1e-8),
            (('Precession rate', 'φ′'), lambda exact: exact.phi_dot[0], 1e-7),
            (('Energy', 'potential'), lambda exact: shown.top.gravity_torque
             * math.cos(exact.theta[0]), 1e-9),
            (('Energy', 'sum'), lambda exact: exact.energy[0], 1e-9)):
        plot, line = found[key]
        assert plot.now == 2.5 and len(line.x) > 200
        for at in (0, 100, -1):
            exact = truth(shown, shown.epoch_ns + round(line.x[at] * 1e9))
            assert line.y[at] == pytest.approx(expected(exact), abs=tolerance)
    total, parts = (sum(found['Energy', name][1].y for name in names)
                    for names in (('sum',), ('kinetic', 'potential')))
    assert total == pytest.approx(parts)
    for title in ('Energy drift, relative', 'Orientation error'):
        _, line = found[title, '']
        assert len(line.y) == 26 and (line.y < -9.0).all()


def test_the_effective_potential_meets_the_energy_at_the_turning_points(shown):
    stamp_ns = shown.epoch_ns + 2_500_000_000
    exact, found = truth(shown, stamp_ns), plotted(shown, stamp_ns)
    plot, turning = found['Effective potential V(θ)', 'turning points']
    assert turning.dots and turning.x == pytest.approx([30.0, math.degrees(
        shown.motions[0].description.theta_max)])
    assert plot.now == pytest.approx(math.degrees(exact.theta[0]))
    energy = exact.energy[0] - exact.l3[0] ** 2 / (2.0 * shown.top.lambda3)
    assert turning.y == pytest.approx(energy)
    _, line = found['Effective potential V(θ)', 'V']
    at = 70
    theta, l3, lz = math.radians(line.x[at]), exact.l3[0], exact.lz[0]
    assert line.y[at] == pytest.approx(
        (lz - l3 * math.cos(theta)) ** 2 / (2 * shown.top.lambda1 * math.sin(theta) ** 2)
        + shown.top.gravity_torque * math.cos(theta))
    assert np.interp(turning.x, line.x, line.y) == pytest.approx(energy, abs=1e-3)
    still, moves = (plots.Plotted(track, stamp_ns, 0, stamp_ns, 0)
                    for track in (Track('', shown.values), shown))
    assert plots.motion_plots([moves, still])[0].point == pytest.approx(energy)
    assert math.isnan(plots.motion_plots([still, moves])[0].point)


def test_a_plot_is_svg_with_title_units_and_its_points():
    x = np.array([0.0, 1.0, 2.0])
    drawn = ElementTree.fromstring(svg.draw(svg.Plot('Tilt', 't [s]', 'θ [deg]', [
        svg.Line('θ', '#123456', x, 10.0 * x)], 1.0)))
    texts = [text for text in drawn.itertext() if text]
    assert {'Tilt', 't [s]', 'θ [deg]', '0.0', '2.0', '10', '20'} <= set(texts)
    (line,) = drawn.iter('polyline')
    (first, middle, last) = ([float(number) for number in point.split(',')]
                             for point in line.get('points').split())
    assert first[0] < middle[0] < last[0] and first[1] > middle[1] > last[1]
    (mark,) = (group for group in drawn.iter('g') if group.get('class') == 'now')
    assert mark.get('transform') == f'translate({middle[0]} 0)'
    assert svg.draw(svg.Plot('', '', '', [], 0.0)) == ''


@pytest.mark.parametrize('scene', parameter_files('scene'))
def test_every_scene_has_words_and_plots(scene):
    """And is one motion, in however many parts its samples come."""
    values = parameters.checked(read_scene(parameter_files('scene')[scene]))
    track, start = Track('', values), parameters.start_state(values)
    moved = solve(track.top, start, np.arange(300) * 0.01)
    rows = attitude_rows(moved.quaternion, moved.angular_velocity, moved.phi_dot)
    for part in np.array_split(np.arange(300), 60):
        track.add('joint_states', Series(part * 10_000_000, rows[part]))
        track.detect_motion()
    (motion,) = track.motions
    words = text.words(track, motion, 0, 0)
    assert text.SENTENCES[motion.description.name] in words and 'nan' not in words
    for plot in plots.motion_plots([plots.Plotted(track, 0, 0, NANOSECONDS, 0)]):
        ElementTree.fromstring(svg.draw(plot))
        assert 'nan' not in svg.draw(plot)


def test_the_ground_moves_under_a_pivot_that_moves(page, tmp_path):
    path = tmp_path / 'shuttle.mcap'
    assert simulate.main(['--scene', 'shuttle', '--duration', '3', '-o', str(path)]) == 0
    (track,), = logs.read_logs([path])
    player = logs.Player(page, [[track]])
    for t, x in ((1.0, 1.0), (2.2, 4.0 + 0.2 * 4.0)):       # 2 m/s^2, then 4 m/s
        player.draw(t)
        reach = abs(shapes.axis_length(track))
        assert page._ground.position == pytest.approx((-(x % reach), 0.0, -0.8 * reach), abs=1e-9)
        assert 'The pivot moves' in page._words.content
        stamp_ns = track.epoch_ns + round(t * NANOSECONDS)
        assert track.places(np.array([stamp_ns])) == pytest.approx(np.array([[x, 0.0, 0.0]]))
        # The trace has stayed where the tip was: at the start at x = 0.
        begin, end = (shapes.axis_length(track) * shapes.axis_of(track.attitudes.at(at_ns)[1])[0]
                      for at_ns in (track.epoch_ns, stamp_ns))
        lines = shapes.trace(track, stamp_ns)
        assert lines[0, 0] == pytest.approx(begin - (x, 0.0, 0.0), abs=1e-6)
        assert lines[-1, 1] == pytest.approx(end, abs=1e-6)


def test_a_reset_to_another_top_shows_that_one_from_its_begin_on(page, tmp_path):
    """And attitudes by the mounting of the IMU that is in effect."""
    own_node = pytest.importorskip('helpers.own_node')
    with own_node.OwnNode(tmp_path, start_paused=True, record__enabled=True,
                          record__streams=['ground_truth_imu']) as node:
        node.step(30)
        assert node.trigger('reset').success        # to the same top
        node.step(20)
        assert node.set(top__mass=0.3, imu__rpy=[0.0, 1.0, 0.0]).successful
        assert node.trigger('reset').success
        epoch_ns = node.simulation.epoch_ns
        node.step(50)
    (first, second), = logs.read_logs([tmp_path / 'run.mcap'])
    assert first.span[1] < epoch_ns == second.span[0] == second.begin_ns
    player = logs.Player(page, [[first, second]])
    for track, mass, begin_ns, t_ns in ((first, 2.0, first.epoch_ns, 300_000_000),
                                        (second, 0.3, epoch_ns, 500_000_000)):
        stamp_ns = begin_ns + t_ns
        player.draw((stamp_ns - first.epoch_ns) * 1e-9)
        top = page._tops[0].track.top
        exact = solve(top, parameters.start_state(track.values), [t_ns * 1e-9])
        assert top.mass == mass and track.motion_at(stamp_ns).energy == pytest.approx(
            exact.energy[0] - exact.l3[0] ** 2 / (2.0 * top.lambda3))
        assert track.attitudes.at(stamp_ns)[1][:4] == pytest.approx(exact.quaternion[0], abs=1e-9)
    assert player.write_html(tmp_path / 'page.html').startswith(
        f'{(first.span[1] - first.epoch_ns) * 1e-9:g} of {player.length:g} s, ')


def test_messages_that_show_no_attitude_are_left_out(log, shown, tmp_path):
    """Of another size, or with a quaternion of zeros."""
    decode = shown.templates['ground_truth/imu'].decode
    changed = {('/pose', 5): lambda data: data[:-1],
               ('/ground_truth/imu', 7): lambda data: data.replace(
                   decode(data)[0].tobytes(), bytes(32))}
    (track,), = logs.read_logs([rewritten(
        log, tmp_path / 'odd.mcap', lambda topic, number, data: changed.get(
            (topic, number), lambda data: data)(data))])
    for topic, number in (('pose', 5), ('ground_truth/imu', 7)):
        assert np.array_equal(track.samples[topic].stamps_ns,
                              np.delete(shown.samples[topic].stamps_ns, number))


def test_a_log_of_1_is_shown():
    """It was recorded from the middle of a run, and has a command and a reset to the same top."""
    (track,), = logs.read_logs([ROOT / 'test/data/log_of_1.mcap'])
    assert len(track.motions) == 3 and not track.note
    after = int(track.samples['pose'].stamps_ns[-1])
    state = solve(track.top, parameters.start_state(track.values), [
        (after - track.motions[-1].begin_ns) * 1e-9])
    assert track.attitudes.at(after)[1][:4] == pytest.approx(state.quaternion[0], abs=1e-9)


def test_a_truncated_log_is_shown_as_far_as_it_goes(log, shown, tmp_path):
    path = tmp_path / 'torn.mcap'
    path.write_bytes(log.read_bytes()[:-60_000])
    (part,), = logs.read_logs([path])
    assert part.note.startswith('torn.mcap: it is truncated') and not shown.note
    assert shown.span[0] == part.span[0] < part.span[1] <= shown.span[1]


def foreign(log, path, topics):
    """Write a log as another program would: topics of `log`, and their new names."""
    with LogReader(log) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics}
        return write_rows(
            path, [RecordedTopic(name, types[topic]) for topic, name in topics.items()],
            [(list(topics).index(message.topic), message.log_time, message.data)
             for message in reader.messages(topics=topics)])


@pytest.mark.parametrize('topic', ['/pose', '/ground_truth/imu', '/ground_truth/odom'])
def test_the_log_of_another_program_shows_its_attitudes(log, shown, page, tmp_path, topic):
    # The first topic has no orientation.
    path = foreign(log, tmp_path / 'run.mcap', {'/imu/data_raw': '/raw', topic: '/robot/state'})
    (track,), = logs.read_logs([path])
    assert not track.has_body and track.epoch_ns == track.span[0]
    if topic == '/pose':
        assert track.attitudes.rows == pytest.approx(
            shown.samples['pose'].rows, abs=1e-15, nan_ok=True)
    player = logs.Player(page, [[track]])
    player.draw_next(0.5)
    assert 'The body is not in this log' in page._words.content
    assert page._plots.content.count('<svg') == 1       # the tilt
    names = set(page.server.scene._handle_from_node_name)
    assert '/top0/body/disc' in names and '/top0/body/rim' not in names


def test_a_log_without_attitudes_is_refused(log, tmp_path):
    path = foreign(log, tmp_path / 'raw.mcap', {'/imu/data_raw': '/raw'})
    with pytest.raises(LogError, match=r'raw.mcap: no attitude in it \(sensor_msgs/msg/Imu, '):
        logs.read_logs([path])


def test_a_player_follows_its_buttons_and_the_slider(shown, page):
    player = logs.Player(page, [[shown]])
    assert player.length == pytest.approx(6.0)
    player.draw_next(1.0)
    assert player._slider.value == pytest.approx(1.0)
    player._go_to_next()
    player.draw_next(0.0)
    assert player._slider.value == pytest.approx(COMMAND_S)
    player._slider.value = 4.0
    player.draw_next(0.5)
    assert player._slider.value == pytest.approx(4.5)
    player.draw_next(9.0)
    assert (player._slider.value, player._button.label) == (pytest.approx(6.0), 'Play')
    player._switch()
    player.draw_next(0.5)
    assert (player._slider.value, player._button.label) == (pytest.approx(0.5), 'Pause')


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
    finally:
        other.close()


@pytest.mark.parametrize(('arguments', 'told'), [
    (['LOG', 'LOG', 'LOG'], '3 logs: must be one or two'),
    (['LOG', '--scene', 'wavy'], '--scene wavy: must be without a log, which has its own'),
    (['LOG', '--imu', 'bmi088'], '--imu bmi088: must be without a log, which has its own'),
    (['LOG', '--port', '99999'], '--port 99999: must be from 0 to 65535')])
def test_wrong_arguments_are_told_in_one_line(log, capsys, arguments, told):
    assert command.main([*(str(log) if word == 'LOG' else word for word in arguments)]) == 2
    assert capsys.readouterr().err == f'spinning-top view: {told}\n'


@pytest.fixture
def page():
    page = pages.Page('one', '127.0.0.1', None)
    yield page
    page.close()


def test_a_page_of_another_site_is_refused(page):
    """Raw handshakes, as a browser sends them for a page that it has from elsewhere."""
    port = page.server.get_port()
    own = f'127.0.0.1:{port}'
    for host, origin, code in (
            (own, f'http://{own}', 101), (own, None, 101),      # None: no browser
            (own, 'http://evil.example', 403), (own, 'null', 403),      # a file
            # A name of another site that stands for this address.
            (f'evil.example:{port}', f'http://evil.example:{port}', 403), ('[::1', None, 403),
            (f'LOCALHOST:{port}', f'http://localhost:{port}', 101)):
        lines = ['GET / HTTP/1.1', f'Host: {host}', 'Upgrade: websocket', 'Connection: Upgrade',
                 'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==', 'Sec-WebSocket-Version: 13',
                 'Sec-WebSocket-Protocol: viser-v' + metadata.version('viser'),
                 *([f'Origin: {origin}'] if origin else []), '', '']
        with socket.create_connection(('127.0.0.1', port), 30.0) as connection:
            connection.sendall('\r\n'.join(lines).encode())
            assert int(connection.recv(4096).split()[1]) == code, (host, origin)
