# SPDX-License-Identifier: Apache-2.0
"""What the page draws, as numbers, and what its controls do; no browser, no ROS."""

import math
import subprocess
import sys
import threading
from importlib import metadata
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.desk import Desk
from helpers.inspected import rewritten
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation
from test_physics import AT_A_POLE, NOT_ABOVE, SCENE_NAMES

from spinning_top_sim import State, Top, solve
from spinning_top_sim.installation import parameter_files
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.times import NANOSECONDS
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.scene_file import read_scene

pytest.importorskip('viser')
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from spinning_top_sim.view import command, drawn, player, plots, server, simulation, text
from spinning_top_sim.view.log import LogSource
from spinning_top_sim.view.page import Page
from spinning_top_sim.view.samples import TOPICS, SampledTrack
from spinning_top_sim.view.source import POINTS, WINDOW_NS

COMMAND_S = 3.0


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp('view') / 'cusp.mcap'
    assert simulate.main([
        '--scene', 'cusp', '--duration', '6', '-o', str(path), '-p', 'imu.rpy:=[0.3, -0.2, 1.0]',
        '--command', f'{COMMAND_S}:2.0:1.5']) == 0
    return path


@pytest.fixture(scope='module')
def source(log):
    return LogSource(log, Desk)


@pytest.fixture(scope='module')
def shown(source):
    return source.track


def truth(shown, t_ns):
    """Return the exact state at a time before the command."""
    return solve(shown.top, parameters.start_state(shown.values), [t_ns * 1e-9])


def values_of(scene, **changes):
    return parameters.checked({'solver.method': 'exact',
                               **read_scene(parameter_files('scene')[scene]), **changes})


def test_a_log_shows_its_attitudes_and_motions(log, source, shown):
    template = shown.templates['ground_truth/odom']
    with LogReader(log) as reader:
        for message in reader.messages(topics=['/ground_truth/odom']):
            t_ns = message.log_time - shown.epoch_ns
            assert shown.newest(t_ns) == t_ns
            assert shown.state(t_ns).quaternion[0] == pytest.approx(
                template.decode(message.data)[1][0], abs=1e-15)
    # Another motion begins with the first sample behind the command.
    (change_ns,) = source.player.motions_ns
    assert change_ns == COMMAND_S * 1e9 + 10_000_000
    first, second = shown.motion_at(change_ns - 1), shown.motion_at(change_ns)
    assert (first.description.name, second.description.name) == ('cusps', 'loops')
    assert (second.l3, second.lz) == pytest.approx((2.0, 1.5))
    assert first.description.theta_min == pytest.approx(math.radians(30.0))
    assert shown.motion_at(change_ns + NANOSECONDS) is second


def test_arrows_are_the_vectors_in_the_world():
    track = simulation.SimulatedTrack(values_of('cusp', **{'top.com_distance': -0.15}))
    t_ns, top = 1_230_000_000, track.top
    exact = truth(track, t_ns)
    turn, up = Rotation.from_quat(exact.quaternion[0]), [0.0, 0.0, 1.0]
    momentum, torque = (drawn.arrow(track, name, t_ns) / abs(drawn.axis_length(track))
                        for name in drawn.ARROWS)
    assert momentum * exact.l3[0] == pytest.approx(turn.apply(          # L3 is the usual length
        exact.angular_velocity[0] * [top.lambda1, top.lambda1, top.lambda3]), abs=1e-8)
    assert torque * abs(top.gravity_torque) == pytest.approx(
        top.gravity_torque * np.cross(turn.apply(up), np.negative(up)), abs=1e-8)


def test_plots_are_the_numbers_of_the_motion(shown):
    t_ns, top = 2_500_000_000, shown.top
    found = {(plot.title, line.name): (plot, line) for plot in (plots.potential_plot(
        shown, t_ns), *plots.time_plots(shown, t_ns, 0, t_ns)) for line in plot.lines}
    _, tilt = found['Tilt', 'θ']
    svg = ElementTree.fromstring(plots.draw(plots.Plot('Tilt', 't [s]', 'θ [deg]', [tilt], 2.5)))
    assert {'Tilt', 't [s]', 'θ [deg]', '0.0', '2.0', '30', '40'} <= {*svg.itertext()}
    (line,) = svg.iter('polyline')
    points = np.array([point.split(',') for point in line.get('points').split()], float)
    assert points[-1, 0] == plots.RIGHT and points[tilt.y.argmax(), 1] == points[:, 1].min()
    for key, expected in (
            (('Tilt', 'θ'), lambda exact: math.degrees(exact.theta[0])),
            (('Precession rate', 'φ′'), lambda exact: exact.phi_dot[0]),
            (('Energy', 'potential'),
             lambda exact: top.gravity_torque * math.cos(exact.theta[0])),
            (('Energy', 'sum'), lambda exact: exact.energy[0])):
        plot, line = found[key]
        assert plot.now == 2.5 and len(line.x) > 200
        for at in (0, 100, -1):
            exact = truth(shown, round(line.x[at] * 1e9))
            assert line.y[at] == pytest.approx(expected(exact), abs=1e-7)
    # The effective potential meets the energy at the turning points.
    exact = truth(shown, t_ns)
    plot, level = found['Effective potential V(θ)', 'E − L₃²/2λ₃']
    assert level.x == pytest.approx([30.0, math.degrees(
        shown.motion_at(t_ns).description.theta_max)])
    assert plot.now == pytest.approx(math.degrees(exact.theta[0]))
    energy = exact.energy[0] - exact.l3[0] ** 2 / (2.0 * top.lambda3)
    assert level.y == pytest.approx(energy) and plot.point == pytest.approx(energy)
    _, line = found['Effective potential V(θ)', 'V']
    assert np.interp(level.x, line.x, line.y) == pytest.approx(energy, abs=1e-3)


@pytest.mark.parametrize('name', parameter_files('scene'))
def test_every_scene_has_words_and_plots(name):
    """Words are true, and samples of it tell the motion that the solution has."""
    track = simulation.SimulatedTrack(values_of(name))
    motion, description = track.motion_at(0), track.trajectory.after(0).describe()
    assert motion.pivot_moves is (description is None)
    words = text.words(track, 0)
    svg = [*filter(None, map(plots.draw, (plots.potential_plot(track, NANOSECONDS),
                                          *plots.time_plots(track, 0, 0, NANOSECONDS))))]
    assert len(svg) == (4 if description else 3)
    assert 'nan' not in words + ''.join(svg)
    if description is None:
        return
    assert motion.description.name == description.name
    assert text.SENTENCES[description.name] in words
    found = track.at(np.arange(0, 3 * NANOSECONDS, NANOSECONDS // 1000))
    (w1, w2, _), up = found.rows_angular_velocity, found.rows_axis[2]
    with_spin, across = found.l3 * found.phi_dot, np.hypot(w1, w2)
    if description.name == 'cusps':
        assert across[up.argmax()] < 0.01 * across.max()
    elif description.name == 'loops':
        assert with_spin[up.argmax()] < 0.0 < with_spin[up.argmin()]
    elif 'goes round the same way' in text.SENTENCES[description.name]:
        assert np.all(found.phi_dot * found.phi_dot[0] > 0.0)
    times_ns = np.arange(0, 3 * NANOSECONDS, NANOSECONDS // 2)
    seen, states = SampledTrack(track.values), track.at(times_ns)
    seen.add(times_ns, np.hstack((states.quaternion, states.angular_velocity,
                                  np.zeros((len(times_ns), 3)))))
    for t_ns in times_ns.tolist():
        assert seen.motion_at(t_ns).description.name == description.name


def test_every_motion_has_a_sentence():
    names = {name for *_, name in (*AT_A_POLE, *NOT_ABOVE)}
    assert names | {*SCENE_NAMES.values()} == {*text.SENTENCES}


@pytest.mark.parametrize('changes', [
    {'spin.lz': 1.59, 'initial.theta': 0.5}, {'spin.l3': 150.0, 'spin.lz': 140.0},
    {'top.mass': 0.25, 'top.com_distance': -0.05, 'top.lambda1': 0.002, 'top.lambda3': 0.0005,
     'initial.theta': 2.9, 'spin.l3': -0.05, 'spin.lz': 0.02}])
def test_a_fast_motion_has_its_peaks_and_its_trace(changes):
    track, t_ns = simulation.SimulatedTrack(values_of('cusp', **changes)), 17_300_000_000
    (line,) = plots.time_plots(track, t_ns, t_ns - WINDOW_NS, t_ns)[-1].lines
    found = track.motion_at(t_ns).description
    nutations = np.array_split(line.y, int(np.ptp(line.x) / found.nutation_period))
    reach = found.precession_max - found.precession_min
    for peaks, peak in ((map(np.min, nutations[1:]), found.precession_min),
                        (map(np.max, nutations[1:]), found.precession_max)):
        assert np.abs(np.subtract([*peaks], peak)).max() < 0.05 * reach
    assert len(nutations) >= 4 and len(line.y) <= POINTS + 2 and line.x[-1] == 17.3
    assert len(drawn.tip_path(track, t_ns)) == len(line.y) - 1
    first, = plots.time_plots(track, 0, 0, t_ns)[-1].lines
    assert first.x[0] == 0.0 and len(first.y) <= POINTS + 2


def test_a_trace_stays_where_the_tip_was_and_breaks_where_it_jumps():
    track = simulation.SimulatedTrack(values_of('shuttle'))
    for t, x in ((1.0, 1.0), (2.2, 4.0 + 0.2 * 4.0)):       # 2 m/s^2, then 4 m/s
        t_ns = round(t * NANOSECONDS)
        begin, end = (drawn.axis_length(track) * np.ravel(track.state(at_ns).rows_axis)
                      for at_ns in (0, t_ns))
        lines = drawn.tip_path(track, t_ns)
        assert lines[0, 0] == pytest.approx(begin - (x, 0.0, 0.0), abs=1e-6)
        assert lines[-1, 1] == pytest.approx(end, abs=1e-6)
    half = math.sqrt(0.5)
    jumps = SampledTrack(parameters.checked({}))
    rows = np.zeros((4, 10))
    rows[:, :4] = (0, 0, 0, 1), (0, 0.01, 0, 1), (0, half, 0, half), (0, half, 0.01, half)
    jumps.add(np.arange(4), rows)
    assert len(drawn.tip_path(jumps, 3)) == 2


def test_a_log_is_shown_up_to_a_reset_to_another_top(tmp_path):
    own_node = pytest.importorskip('helpers.own_node')
    with own_node.OwnNode(tmp_path, start_paused=True,
                          record__streams=['ground_truth_imu']) as node:
        assert node.set(top__mass=0.3).successful and node.switch('record', True).success
        node.step(50)
        assert node.trigger('reset').success
        node.step(50)
    source = LogSource(tmp_path / 'run.mcap', Desk)
    assert source.page.message.content == '*run.mcap is shown up to the reset to another top*'
    assert source.track.top.mass == 2.0 and source.track.span == (0, NANOSECONDS // 2)


def test_a_log_is_shown_as_far_as_it_can_be_read(log, shown, tmp_path, capsys):
    """Torn; with messages of another size, a quaternion of zeros, and no time; of 1; of no top."""
    torn = tmp_path / 'torn.mcap'
    torn.write_bytes(log.read_bytes()[:-60_000])
    part = LogSource(torn, Desk)
    assert part.page.message.content == '*torn.mcap is damaged: what is whole is shown*'
    assert shown.span[0] == part.track.span[0] < part.track.span[1] <= shown.span[1]

    decode = shown.templates['ground_truth/odom'].decode
    changed = {5: lambda data: data[:-1],
               7: lambda data: data.replace(decode(data)[1].tobytes(), bytes(32))}
    odd = rewritten(log, tmp_path / 'odd.mcap', lambda topic, number, data: changed.get(
        number * (topic == '/ground_truth/odom'), lambda data: data)(data),
        stamp=lambda topic, number, stamp_ns: stamp_ns if number != 9 else 1 << 63)
    assert np.array_equal(LogSource(odd, Desk).track.stamps_ns,
                          np.delete(shown.stamps_ns, [5, 7, 9]))

    old = LogSource(ROOT / 'test/data/log_of_1.mcap', Desk)     # a command, a reset
    assert len(old.player.motions_ns) == 2 and not old.page.message.content
    assert len(old.track.rows) > 10

    empty = rewritten(log, tmp_path / 'empty.mcap',
                      lambda topic, number, data: None if topic[1:] in TOPICS else data)
    assert command.main([str(empty), '--no-browser']) == 1
    assert 'no attitude of the top in it' in capsys.readouterr().err


def test_a_player_follows_its_buttons_and_the_slider():
    desk = Desk()
    played = player.Player(desk, 1_000_000_000, 7_000_000_000, [4_000_000_000])
    pause = desk.inputs['Pause']
    for act, seconds, t, label in (
            (lambda: None, 1.0, 2.0, 'Pause'),
            (lambda: desk.put('time [s]', 4.0), 0.5, 5.5, 'Pause'),
            (lambda: desk.put('speed', '2'), 9.0, 7.0, 'Play'),     # the end
            (lambda: None, 1.0, 7.0, 'Play'),
            (lambda: desk.press('Pause'), 0.5, 2.0, 'Pause'),       # from the begin, twice as fast
            (lambda: desk.press('time', 'Step'), 1.0, 2.02, 'Play'),
            (lambda: desk.press('time', 'Reset'), 1.0, 1.0, 'Play')):
        act()
        assert (played.advance(seconds), pause.label) == (round(t * NANOSECONDS), label)
        assert desk.inputs['time [s]'].value == pytest.approx(t - 1.0)


def test_sliders_and_scenes_begin_the_motions_of_their_numbers():
    desk = Desk()
    own = simulation.OwnSimulation(desk, 'looping', values_of(
        'looping', **{'solver.method': 'rk45'}))
    assert own.track.about.startswith('Scene looping; ')
    # A reset goes back to what was forgotten.
    begin = own.track.state(0).quaternion
    assert own.update(50.0) == 50 * NANOSECONDS
    with pytest.raises(IntegrationError, match='steps go forward'):
        own.track.state(0)
    desk.press('time', 'Reset')
    assert own.update(0.0) == 0 and np.array_equal(own.track.state(0).quaternion, begin)
    assert own.update(1.5) == 1_500_000_000
    # What cannot be is refused, and the motion goes on.
    desk.put('moment λ₁', -1.0)
    assert own.update(0.5) == 2_000_000_000
    assert desk.message.content.startswith('**refused:** ')
    # A key moves a slider by a round step.
    for slider in (one for one in desk.inputs.values() if hasattr(one, 'precision')):
        assert 500 <= (slider.max - slider.min) / slider.step <= 5000
        assert round(slider.step, slider.precision) == slider.step
    for label, value in (('mass', 3.0), ('length', 0.1), ('moment λ₁', 0.2), ('moment λ₃', 0.1),
                         ('tilt', 50.0), ('spin', 60.0), ('precession', 1.0)):
        desk.put(label, value)
        assert own.update(0.0) == 0
    top = Top(mass=3.0, com_distance=0.1, lambda1=0.2, lambda3=0.1, gravity=9.80665)
    start = State.from_rates(math.radians(50.0), 1.0, 0.0, 60.0, top=top)
    track = own.track
    assert track.top == top and desk.inputs['spin ψ′ [rad/s]'].max == 60.0    # beyond its end
    assert track.state(NANOSECONDS).quaternion == pytest.approx(
        solve(top, start, [1.0]).quaternion, abs=1e-9)
    assert track.about.startswith('Scene looping with other numbers; ')
    desk.put('scene', 'sleeping')
    assert own.update(0.25) == 250_000_000
    assert own.track.motion_at(0).description.name == 'sleeping'


def test_a_source_that_raises_an_error_is_asked_again_and_the_reason_is_shown(monkeypatch):
    monkeypatch.setattr('spinning_top_sim.view.page.AFTER_ERROR_S', 0.0)
    desk, stopped, asked = Desk(), threading.Event(), []
    desk.server = SimpleNamespace(get_clients=dict)

    def update(seconds):
        asked.append(seconds)
        if len(asked) == 3:
            stopped.set()
        raise OSError('the disk has gone')

    Page.show(desk, SimpleNamespace(update=update), stopped)
    assert len(asked) == 3 and desk.message.content == '**the disk has gone**'


def test_a_simulation_imports_no_ros_and_writes_a_file(tmp_path):
    path = tmp_path / 'page.html'
    done = subprocess.run([sys.executable, '-c', f"""
import sys
for name in ('rclpy', 'ament_index_python', 'rosbags', 'geometry_msgs', 'std_msgs'):
    sys.modules[name] = None        # importing it raises an error
from spinning_top_sim.__main__ import main
sys.exit(main(['view', '--scene', 'wavy', '--html', {str(path)!r}, '-p', 'duration:=0.5']))
"""], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith(f'{path}: 0.5 s, ')
    page = path.read_text()
    for words in ('<h1>waves</h1>', 'Scene wavy; ', 'data-epoch="1000000000"', 'bounds of θ'):
        assert words in page


@pytest.mark.parametrize(('arguments', 'told'), [
    (['LOG', '--imu', 'bmi088'], '--imu: cannot be given for a log'),
    (['LOG', '--node'], '--node: cannot be given for a log'),
    (['--namespace', 'left'], '--namespace: cannot be given for a simulation'),
    (['--ros-args', '-r', '__ns:=/left'], '--ros-args -r __ns:=/left: must be with --node'),
    (['-p', 'top.mas:=3'], 'there is no parameter top.mas; did you mean top.mass?'),
    (['LOG', '--port', '99999'], '--port 99999: must be from 0 to 65535')])
def test_wrong_arguments_are_told_in_one_line(log, capsys, arguments, told):
    with pytest.raises(SystemExit, match='2'):       # as argparse ends
        sys.exit(command.main([*(str(log) if word == 'LOG' else word for word in arguments)]))
    assert told in capsys.readouterr().err


def test_a_page_of_another_site_is_refused(monkeypatch):
    monkeypatch.setenv('no_proxy', '*')
    page = Page('one', '127.0.0.1', None)
    port = page.server.get_port()
    with pytest.raises(OSError, match=f'127.0.0.1 port {port}: '):
        Page('two', '127.0.0.1', port)
    protocol = 'viser-v' + metadata.version('viser')
    with connect(f'ws://127.0.0.1:{port}', origin=page.address, subprotocols=[protocol]) as one:
        assert isinstance(one.recv(), bytes)
    with (connect(f'ws://127.0.0.1:{port}', origin='http://evil.example',
                  subprotocols=[protocol]) as one,
          pytest.raises(ConnectionClosed, match=r'1008.*Origin: http://evil')):
        one.recv()
    page.close()
    for host, origin, is_refused in (
            ('LOCALHOST:8', 'http://localhost:8', False), ('127.0.0.1:8', 'null', True),
            ('localhost:8', None, False),       # no browser
            # A name of another site that stands for this address.
            ('evil.example:8', 'http://evil.example:8', True), ('[::1', None, True)):
        headers = {'Host': host} | ({'Origin': origin} if origin else {})
        assert bool(server.refusal(headers, {'localhost'})) is is_refused
