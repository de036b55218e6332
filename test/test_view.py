# SPDX-License-Identifier: Apache-2.0
"""What the page draws, as numbers, and what its controls do; no browser, no ROS."""

import base64
import importlib
import math
import os
import socket
import subprocess
import sys
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

from spinning_top_sim import State, Top, solve
from spinning_top_sim.installation import parameter_files
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.streams import parameters
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.view import command, plots
from spinning_top_sim.view.samples import SampledTrack

pytestmark = pytest.mark.skipif(find_spec('viser') is None, reason='viser is not there')


class Later:
    """A module that is imported where it is used: viser takes a second."""

    def __init__(self, name):
        self._name = name

    def __getattr__(self, name):
        if name[0] == '_':              # pytest looks whether it is a fixture
            raise AttributeError(name)
        return getattr(importlib.import_module(f'spinning_top_sim.view.{self._name}'), name)


logs, pages, drawn, simulation, player, text = map(Later, (
    'log', 'page', 'drawn', 'simulation', 'player', 'text'))
COMMAND_S = 3.0


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp('view') / 'cusp.mcap'
    assert simulate.main([
        '--params', str(ROOT / 'config/cusp.yaml'), '--duration', '6', '-o', str(path),
        '-p', 'imu.rpy:=[0.3, -0.2, 1.0]', '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]',
        '--command', f'{COMMAND_S}:2.0:1.5']) == 0
    return path


@pytest.fixture
def page():
    page = pages.Page('one', '127.0.0.1', None)
    yield page
    page.close()


@pytest.fixture(scope='module')
def source(log):
    source = logs.LogSource(log, lambda: pages.Page('log', '127.0.0.1', None))
    yield source
    source.page.close()


@pytest.fixture(scope='module')
def shown(source):
    return source.track_at(0)


def truth(shown, t_ns):
    """Return the exact state at a time before the command."""
    return solve(shown.top, parameters.start_state(shown.values), [t_ns * 1e-9])


def values_of(scene, **changes):
    return parameters.checked({'solver.method': 'exact',
                               **read_scene(parameter_files('scene')[scene]), **changes})


def sampled(top_values, states, times_ns, **columns):
    """Return a track with samples of a motion."""
    track, rows = SampledTrack(top_values), np.full((len(times_ns), 10), np.nan)
    rows[:, :4], rows[:, 4:7] = states.quaternion, states.angular_velocity
    track.add(np.asarray(times_ns, np.int64), rows)
    return track


def test_a_log_shows_the_published_attitude_at_every_stamp(log, shown):
    template = shown.templates['ground_truth/odom']
    with LogReader(log) as reader:
        for message in reader.messages(topics=['/ground_truth/odom']):
            t_ns = message.log_time - shown.epoch_ns
            assert shown.newest(t_ns) == t_ns
            assert shown.state(t_ns).quaternion[0] == pytest.approx(
                template.decode(message.data)[1][0], abs=1e-15)


def test_motions_of_a_log_begin_with_its_commands(source, shown):
    (change_ns,) = source.player.motions_ns
    assert change_ns == COMMAND_S * 1e9 + 10_000_000        # the first sample behind it
    first, second = shown.motion_at(change_ns - 1), shown.motion_at(change_ns)
    assert (first.description.name, second.description.name) == ('cusps', 'loops')
    assert (second.l3, second.lz) == pytest.approx((2.0, 1.5))
    assert first.description.theta_min == pytest.approx(math.radians(30.0))
    assert shown.motion_at(change_ns + NANOSECONDS) is second


def test_arrows_are_the_vectors_in_the_world(shown):
    t_ns = 1_230_000_000
    exact, top = truth(shown, t_ns), shown.top
    omega, turn = exact.angular_velocity[0], Rotation.from_quat(exact.quaternion[0])
    up = turn.inv().apply([0.0, 0.0, 1.0])
    far = abs(drawn.axis_length(shown))
    momentum, torque = (drawn.arrow(shown, name, t_ns) / far for name in drawn.ARROWS)
    assert momentum * exact.l3[0] == pytest.approx(         # L3 is the usual length
        turn.apply(omega * [top.lambda1, top.lambda1, top.lambda3]), abs=1e-8)
    assert torque * top.gravity_torque == pytest.approx(turn.apply(
        np.cross([0.0, 0.0, top.com_distance], -top.mass * top.gravity * up)), abs=1e-8)


def test_the_trace_ends_at_the_tip_and_breaks_where_it_jumps(shown):
    lines = drawn.tip_path(shown, 2_000_000_000)
    exact = truth(shown, 2_000_000_000)
    assert lines[-1, 1] == pytest.approx(
        drawn.axis_length(shown) * np.ravel(exact.rows_axis), abs=1e-6)
    assert len(lines) == 200            # 2 s at 100 Hz
    half = math.sqrt(0.5)
    jumps = SampledTrack(parameters.checked({}))
    rows = np.zeros((4, 10))
    rows[:, :4] = (0, 0, 0, 1), (0, 0.01, 0, 1), (0, half, 0, half), (0, half, 0.01, half)
    jumps.add(np.arange(4), rows)
    assert len(drawn.tip_path(jumps, 3)) == 2


def lines_of(track, t_ns):
    """Return the plots from t = 0 to a time, and their lines, by title and name."""
    return {(plot.title, line.name): (plot, line)
            for plot in plots.motion_plots(track, t_ns, 0, t_ns) for line in plot.lines}


@pytest.mark.parametrize('kind', ['log', 'simulation'])
def test_plots_are_the_numbers_of_the_motion(shown, kind):
    track = shown if kind == 'log' else simulation.SimulatedTrack(values_of('cusp'), '')
    found = lines_of(track, 2_500_000_000)
    for key, expected, tolerance in (
            (('Tilt', 'θ'), lambda exact: math.degrees(exact.theta[0]), 1e-8),
            (('Precession rate', 'φ′'), lambda exact: exact.phi_dot[0], 1e-7),
            (('Energy', 'potential'), lambda exact: shown.top.gravity_torque
             * math.cos(exact.theta[0]), 1e-9),
            (('Energy', 'sum'), lambda exact: exact.energy[0], 1e-9)):
        plot, line = found[key]
        assert plot.now == 2.5 and len(line.x) > 200
        for at in (0, 100, -1):
            exact = truth(shown, round(line.x[at] * 1e9))
            assert line.y[at] == pytest.approx(expected(exact), abs=tolerance)
    assert found['Energy', 'sum'][1].y == pytest.approx(
        found['Energy', 'kinetic'][1].y + found['Energy', 'potential'][1].y)


def test_the_effective_potential_meets_the_energy_at_the_turning_points(shown):
    t_ns = 2_500_000_000
    exact, found = truth(shown, t_ns), lines_of(shown, t_ns)
    plot, turning = found['Effective potential V(θ)', 'turning points']
    assert turning.dots and turning.x == pytest.approx([30.0, math.degrees(
        shown.motion_at(t_ns).description.theta_max)])
    assert plot.now == pytest.approx(math.degrees(exact.theta[0]))
    energy = exact.energy[0] - exact.l3[0] ** 2 / (2.0 * shown.top.lambda3)
    assert turning.y == pytest.approx(energy) and plot.point == pytest.approx(energy)
    _, line = found['Effective potential V(θ)', 'V']
    theta, l3, lz = math.radians(line.x[70]), exact.l3[0], exact.lz[0]
    assert line.y[70] == pytest.approx(
        (lz - l3 * math.cos(theta)) ** 2 / (2 * shown.top.lambda1 * math.sin(theta) ** 2)
        + shown.top.gravity_torque * math.cos(theta))
    assert np.interp(turning.x, line.x, line.y) == pytest.approx(energy, abs=1e-3)


def test_a_plot_is_svg_with_title_units_and_its_points():
    x = np.array([0.0, 1.0, 2.0])
    svg = ElementTree.fromstring(plots.draw(plots.Plot('Tilt', 't [s]', 'θ [deg]', [
        plots.Line('θ', '#123456', x, 10.0 * x)], 1.0)))
    texts = [text for text in svg.itertext() if text]
    assert {'Tilt', 't [s]', 'θ [deg]', '0.0', '2.0', '10', '20'} <= set(texts)
    (line,) = svg.iter('polyline')
    (first, middle, last) = ([float(number) for number in point.split(',')]
                             for point in line.get('points').split())
    assert first[0] < middle[0] < last[0] and first[1] > middle[1] > last[1]
    (mark,) = (group for group in svg.iter('g') if group.get('class') == 'now')
    assert mark.get('transform') == f'translate({middle[0]} 0)'
    assert plots.draw(plots.Plot('', '', '', [], 0.0)) == ''


@pytest.mark.parametrize('scene', parameter_files('scene'))
def test_every_scene_has_words_and_plots(scene):
    """And samples of it tell the motion that the solution has."""
    track = simulation.SimulatedTrack(values_of(scene), 'from here')
    motion, description = track.motion_at(0), track.trajectory.after(0).describe()
    assert motion.pivot_moves is (description is None)
    words = text.words(track, 0)
    assert 'nan' not in words and 'from here' in words
    svg = [*filter(None, map(plots.draw, plots.motion_plots(
        track, NANOSECONDS, 0, NANOSECONDS)))]
    assert len(svg) == (4 if description else 3)
    for plot in svg:
        ElementTree.fromstring(plot)
        assert 'nan' not in plot
    if description is None:
        return
    assert motion.description.name == description.name
    assert text.SENTENCES[description.name] in words
    times_ns = np.arange(300) * 10_000_000
    seen = sampled(track.values, track.at(times_ns), times_ns)
    for t_ns in times_ns[::50].tolist():
        assert seen.motion_at(t_ns).description.name == description.name


def test_the_ground_moves_under_a_pivot_that_moves(page, tmp_path):
    path = tmp_path / 'shuttle.mcap'
    assert simulate.main(['--scene', 'shuttle', '--duration', '3', '-o', str(path)]) == 0
    track = logs.LogSource(path, lambda: page).track_at(0)
    for t, x in ((1.0, 1.0), (2.2, 4.0 + 0.2 * 4.0)):       # 2 m/s^2, then 4 m/s
        t_ns = round(t * NANOSECONDS)
        for shown in (track, simulation.SimulatedTrack(track.values, '')):
            page._number = 0        # the words are new in each sixth picture
            page.draw(t_ns, shown)
            far = abs(drawn.axis_length(shown))
            assert page._ground.position == pytest.approx((-(x % far), 0.0, -0.8 * far), abs=1e-9)
            assert 'The pivot moves' in page._words.content
            # The trace has stayed where the tip was: at the start at x = 0.
            begin, end = (drawn.axis_length(shown) * np.ravel(shown.state(at_ns).rows_axis)
                          for at_ns in (0, t_ns))
            lines = drawn.tip_path(shown, t_ns)
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
    source = logs.LogSource(tmp_path / 'run.mcap', lambda: page)
    first, second = source._tops
    begin_ns = epoch_ns - first.epoch_ns
    assert first.span[1] < begin_ns == second.span[0] == second.begin_ns
    for track, mass, since_ns, t_ns in ((first, 2.0, 0, 300_000_000),
                                        (second, 0.3, begin_ns, 500_000_000)):
        page.draw(since_ns + t_ns, source.track_at(since_ns + t_ns))
        top = page._top.track.top
        exact = solve(top, parameters.start_state(track.values), [t_ns * 1e-9])
        assert top.mass == mass
        assert track.motion_at(since_ns + t_ns).energy == pytest.approx(
            exact.energy[0] - exact.l3[0] ** 2 / (2.0 * top.lambda3))
        assert track.state(since_ns + t_ns).quaternion[0] == pytest.approx(
            exact.quaternion[0], abs=1e-9)
    assert player.write_file(
        tmp_path / 'page.html', page, source.player, source.track_at).startswith(
        f'{first.span[1] * 1e-9:g} s, ')


def test_messages_that_show_no_attitude_are_left_out(log, shown, page, tmp_path):
    """Of another size, or with a quaternion of zeros."""
    decode = shown.templates['ground_truth/odom'].decode
    changed = {5: lambda data: data[:-1],
               7: lambda data: data.replace(decode(data)[1].tobytes(), bytes(32))}
    odd = rewritten(log, tmp_path / 'odd.mcap', lambda topic, number, data: changed.get(
        number * (topic == '/ground_truth/odom'), lambda data: data)(data))
    track = logs.LogSource(odd, lambda: page).track_at(0)
    assert np.array_equal(track.stamps_ns, np.delete(shown.stamps_ns, [5, 7]))


def test_a_log_of_1_is_shown(page):
    """It was recorded from the middle of a run, and has a command and a reset to the same top."""
    source = logs.LogSource(ROOT / 'test/data/log_of_1.mcap', lambda: page)
    track = source.track_at(0)
    assert len(source.player.motions_ns) == 2 and not page.message.content
    with LogReader(ROOT / 'test/data/log_of_1.mcap') as reader:
        messages = list(reader.messages(topics=['/ground_truth/odom']))
    assert len(track.rows) == len(messages) > 10


def test_a_truncated_log_is_shown_as_far_as_it_goes(log, shown, page, tmp_path):
    path = tmp_path / 'torn.mcap'
    path.write_bytes(log.read_bytes()[:-60_000])
    part = logs.LogSource(path, lambda: page).track_at(0)
    assert page.message.content == '*torn.mcap is truncated: shown as far as it goes*'
    assert shown.span[0] == part.span[0] < part.span[1] <= shown.span[1]


def test_a_log_without_a_top_is_refused(log, tmp_path, capsys):
    with LogReader(log) as reader:
        types = {topic.name: topic.type_name for topic in reader.topics}
        foreign = write_rows(tmp_path / 'other.mcap', [RecordedTopic('/pose', types['/pose'])], [
            (0, message.log_time, message.data) for message in reader.messages(topics=['/pose'])])
    with pytest.raises(LogError, match=r'other\.mcap: its metadata'):
        logs.LogSource(foreign, lambda: None)
    empty = rewritten(log, tmp_path / 'empty.mcap', lambda topic, number, data: (
        None if topic in ('/ground_truth/odom', '/joint_states', '/pose', '/ground_truth/imu')
        else data))
    assert command.main([str(empty), '--no-browser']) == 1
    assert 'no attitude of the top in it' in capsys.readouterr().err


def test_a_player_follows_its_buttons_and_the_slider(page):
    played = player.Player(page, 1_000_000_000, 7_000_000_000, [4_000_000_000])
    seconds = 1e-9
    assert played.advance(1.0) * seconds == pytest.approx(2.0)
    assert played._slider.value == pytest.approx(1.0)
    played._asked.put(played._go_to_next)
    assert played.advance(0.0) == 4_000_000_000
    played._slider.value = 4.0
    assert played.advance(0.5) * seconds == pytest.approx(5.5)
    played._speed.value = '2'
    assert played.advance(9.0) == 7_000_000_000 and played._pause.label == 'Play'
    assert played.advance(1.0) == 7_000_000_000
    played._asked.put(played._switch)
    assert played.advance(0.5) == 2_000_000_000 and played._pause.label == 'Pause'
    played._asked.put(played._step)
    assert played.advance(1.0) == 2_020_000_000 and played._pause.label == 'Play'
    played._asked.put(played._reset)
    assert played.advance(1.0) == 1_000_000_000


@pytest.fixture
def own(page):
    return simulation.OwnSimulation(page, 'looping', values_of('looping'))


def slide(own, label, value):
    """Move a slider, as a browser does."""
    (slider,) = (one for one in own._sliders if one.label.startswith(label))
    slider.value = value
    return slider


def test_a_slider_begins_the_motion_of_its_numbers(own, page):
    assert own.update(1.5) == 1_500_000_000
    before = own.track_at(0)
    assert own._field.value == 'looping' and before.about.startswith('Scene looping; ')
    for label, value in (('mass', 3.0), ('length', 0.1), ('moment λ₁', 0.2), ('moment λ₃', 0.1),
                         ('tilt', 50.0), ('spin', 20.0), ('precession', 1.0)):
        slide(own, label, value)
        assert own.update(0.0) == 0
    top = Top(mass=3.0, com_distance=0.1, lambda1=0.2, lambda3=0.1, gravity=9.80665)
    start = State.from_rates(math.radians(50.0), 1.0, 0.0, 20.0, top=top)
    exact, track = solve(top, start, [1.0]), own.track_at(0)
    assert track.top == top
    assert track.state(NANOSECONDS).quaternion == pytest.approx(exact.quaternion, abs=1e-12)
    assert 'Scene looping with another mass M, length R, ' in track.about
    # The motion is drawn at once, and its body when the sliders rest.
    page.draw(0, before)
    page.draw(0, track)
    assert page._top.track is track and page._top.top == before.top
    for _ in range(30):
        page.draw(0, track)
    assert page._top.top == top


def test_a_number_that_is_not_touched_keeps_all_its_digits(own):
    """A slider is rounded to its steps."""
    before = parameters.start_state(own.track_at(0).values)
    slide(own, 'mass', 2.5)
    own.update(0.0)
    after = own.track_at(0).values
    assert after['top.mass'] == 2.5
    assert (after['spin.l3'], after['spin.lz'], after['initial.theta']) == pytest.approx(
        (before.l3, before.lz, before.theta), rel=1e-14)


def test_what_cannot_be_is_refused_and_the_motion_goes_on(own, page, monkeypatch):
    own.update(1.0)
    before = own.track_at(0)

    def refuse(values, numbers):
        raise ValueError('tilt = 7: must be less')
    monkeypatch.setattr(importlib.import_module(
        'spinning_top_sim.view.simulation'), 'with_numbers', refuse)
    slider = slide(own, 'tilt', 70.0)
    assert own.update(0.5) == 1_500_000_000
    assert page.message.content == '**refused:** tilt = 7: must be less'
    assert slider.value == pytest.approx(30.0) and own.track_at(0) is before


def test_a_chosen_scene_is_shown_from_its_start(own):
    slide(own, 'mass', 2.5)
    own.update(1.0)
    own._field.value = 'sleeping'
    assert own.update(0.25) == 250_000_000
    track = own.track_at(0)
    assert track.motion_at(0).description.name == 'sleeping'
    assert track.top == parameters.top_of(values_of('sleeping'))
    assert track.about.startswith('Scene sleeping; ')
    assert [slider.value for slider in own._sliders][4] == 0.0


def test_a_scene_of_a_file_and_parameters_are_in_the_field(page, tmp_path):
    path = tmp_path / 'mine.yaml'
    path.write_text(parameter_files('scene')['wavy'].read_text())
    own = simulation.OwnSimulation(page, str(path), values_of('wavy', **{'top.mass': 1.0}))
    assert own._field.value == 'mine'
    assert own.track_at(0).about.startswith('Scene mine with another mass M')


def test_equations_that_end_stop_the_page_there(page):
    values = values_of('planar_pendulum', **{
        'solver.method': 'rk45', 'solver.equations': 'euler', 'initial.theta': 0.1,
        'initial.theta_dot': 5.0})
    own = simulation.OwnSimulation(page, 'planar_pendulum', values)
    reached = [own.update(0.2) for _ in range(100)]
    assert 0 < reached[-1] == reached[-2] < 20 * NANOSECONDS
    assert 'The equations end at' in page.message.content
    own.player._asked.put(own.player._reset)
    assert own.update(0.0) == 0


def test_a_simulation_imports_no_ros_and_writes_a_file(tmp_path):
    path = tmp_path / 'page.html'
    done = subprocess.run([sys.executable, '-c', f"""
import sys
for name in ('rclpy', 'ament_index_python', 'rosbags', 'geometry_msgs', 'std_msgs'):
    sys.modules[name] = None        # importing it raises an error
from spinning_top_sim.__main__ import main
sys.exit(main(['view', '--scene', 'wavy', '--html', {str(path)!r}, '-p', 'duration:=0.5']))
"""], capture_output=True, text=True, timeout=120, env=os.environ, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith(f'{path}: 0.5 s, ')
    page = path.read_text()
    for words in ('<h1>waves</h1>', 'Scene wavy; ', 'data-epoch="1000000000"', 'bounds of θ'):
        assert words in page


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
    (['LOG', '--scene', 'wavy'], '--scene wavy: cannot be given for a log'),
    (['LOG', '--imu', 'bmi088'], '--imu bmi088: cannot be given for a log'),
    (['LOG', '--node'], '--node True: cannot be given for a log'),
    (['--namespace', 'left'], '--namespace left: cannot be given for a simulation'),
    (['--ros-args', '-r', '__ns:=/left'], '--ros-args -r __ns:=/left: must be with --node'),
    (['-p', 'top.mas:=3'], 'top.mas:=3: there is no parameter top.mas; did you mean top.mass?'),
    (['LOG', '--port', '99999'], '--port 99999: must be from 0 to 65535')])
def test_wrong_arguments_are_told_in_one_line(log, capsys, arguments, told):
    with pytest.raises(SystemExit, match='2'):       # as argparse ends
        sys.exit(command.main([*(str(log) if word == 'LOG' else word for word in arguments)]))
    assert told in capsys.readouterr().err


def test_a_page_of_another_site_is_refused(page):
    """Raw handshakes, as a browser sends them for a page that it has from elsewhere."""
    port = page.server.get_port()
    own = f'127.0.0.1:{port}'
    for host, origin, is_taken in (
            (own, f'http://{own}', True), (own, None, True),        # None: no browser
            (own, 'http://evil.example', False), (own, 'null', False),      # a file
            # A name of another site that stands for this address.
            (f'evil.example:{port}', f'http://evil.example:{port}', False), ('[::1', None, False),
            (f'LOCALHOST:{port}', f'http://localhost:{port}', True)):
        lines = ['GET / HTTP/1.1', f'Host: {host}', 'Upgrade: websocket', 'Connection: Upgrade',
                 f'Sec-WebSocket-Key: {base64.b64encode(bytes(16)).decode()}',
                 'Sec-WebSocket-Version: 13',
                 'Sec-WebSocket-Protocol: viser-v' + metadata.version('viser'),
                 *([f'Origin: {origin}'] if origin else []), '', '']
        with socket.create_connection(('127.0.0.1', port), 30.0) as connection:
            connection.sendall('\r\n'.join(lines).encode())
            stream = connection.makefile('rb')
            while stream.readline().strip():
                pass
            # The first frame: binary messages, or the end with a code.
            opcode, _, *code = stream.read(4)
            assert (opcode & 15 == 2) is is_taken, (host, origin)
            assert is_taken or int.from_bytes(code) == 1008
