# SPDX-License-Identifier: Apache-2.0
"""
`inspect`: the truth about a log, from logs that other tests trust and from damaged copies.

What is measured is compared with the closed form, which test_exact.py holds against 30 digits.
"""

import itertools
import json
import math
import re
import struct
import subprocess
import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.reference import ROOT, SCENES, scene_parameters
from mcap.reader import make_reader
from mcap.writer import Writer

from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.streams.pipeline import Simulation
from spinning_top_sim.tools import analysis, cli, inspect, recover, simulate
from spinning_top_sim.tools.recorded_run import read_run_description, verify
from spinning_top_sim.tools.survey import Series, survey

RUN_S = 20
NAMES = {'cusp': 'cusps', 'fast_gyroscope': 'cusps', 'free_top': 'free top', 'heavy_top': 'loops',
         'looping': 'loops', 'near_separatrix': 'waves',
         'planar_pendulum': 'planar pendulum, rotating', 'sleeping': 'sleeping',
         'spherical_pendulum': 'spherical pendulum', 'steady_fast': 'steady precession',
         'steady_slow': 'steady precession', 'waking_sleeper': 'cusps', 'wavy': 'waves'}
# The tilt rests, or nearly: there is no nutation in the data.
RESTING = {'sleeping', 'steady_fast', 'steady_slow'}


def log_of(path, *arguments):
    assert simulate.main(['-o', str(path), '--quiet', *map(str, arguments)]) == 0
    return path


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('inspect')


@pytest.fixture(scope='module')
def stepped(folder):
    """Four motions by steps, with noise, in a namespace."""
    return log_of(folder / 'stepped.mcap', '--duration', 3, '--command', '1.0:2.0:1.5',
                  '--command', '0:1.7:1.4', '--command', '2.0031:1.6:1.0', '--namespace', '/a/b',
                  '-p', 'imu.gyroscope_noise_density:=0.01', '-p', 'markers.enabled:=true')


@pytest.fixture(scope='module')
def columns(folder):
    """The exact solution in columns, with commands between the stretches."""
    return log_of(folder / 'columns.mcap', '--duration', 12, '--command', '1.7:2.0:1.5',
                  '--command', '3.1:1.7:1.4',
                  '-p', 'solver.method:=exact', '-p', 'imu.accelerometer_random_walk:=0.01',
                  '-p', 'markers.enabled:=true')


def told(capsys, *arguments):
    """Run inspect; return exit code, output and complaints."""
    code = inspect.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def as_json(capsys, *arguments):
    code, out, _ = told(capsys, *arguments, '--json')
    return code, json.loads(out)


def surveyed(path):
    with LogReader(path) as reader:
        return survey(reader)


def rewritten(source, target, change=lambda topic, number, data: data, metadata=None,
              stamp=lambda topic, number, stamp_ns, copy=0: stamp_ns):
    """
    Copy a log with checksums that are right.

    change : takes topic, number in it and data of a message; returns other data, None to drop it,
        or a list of data
    metadata : what is another in the metadata of the run
    stamp : takes topic, number and log time [ns], and the place in the list; returns the log time
    """
    numbers = {}
    with open(source, 'rb') as old, open(target, 'wb') as new:
        reader, writer = make_reader(old), Writer(new)
        writer.start('ros2')
        for record in reader.iter_metadata():
            ours = metadata if record.name == 'spinning_top_sim' else None
            writer.add_metadata(record.name, {**record.metadata, **(ours or {})})
        summary = reader.get_summary()
        schemas = {number: writer.register_schema(schema.name, schema.encoding, schema.data)
                   for number, schema in summary.schemas.items()}
        channels = {number: writer.register_channel(
            channel.topic, channel.message_encoding, schemas[channel.schema_id],
            channel.metadata) for number, channel in summary.channels.items()}
        for _, channel, message in reader.iter_messages():
            topic = channel.topic
            number = numbers[topic] = numbers.get(topic, -1) + 1
            data = change(topic, number, message.data)
            for copy, one in enumerate(data if isinstance(data, list) else [data]):
                if one is not None:
                    at_ns = stamp(topic, number, message.log_time, *filter(None, [copy]))
                    writer.add_message(channels[channel.id], at_ns, one, at_ns)
        writer.finish()
    return target


def with_flipped_bit(data, byte, bit=0):
    changed = bytearray(data)
    changed[byte] ^= 1 << bit
    return bytes(changed)


# --------------------------------------------------------------------------------- measuring


@pytest.mark.parametrize('method', ['exact', 'rk45'])
@pytest.mark.parametrize('scene', SCENES)
def test_every_scene_is_measured_from_its_data(tmp_path, scene, method):
    slow = (scene, method) == ('fast_gyroscope', 'rk45')        # 80 nutations a second
    arguments = ['--params', ROOT / f'config/{scene}.yaml', '--duration', 4 if slow else RUN_S,
                 '-p', f'solver.method:={method}', '-p', "record.streams:=['joint_states', "
                 "'ground_truth_imu']"]
    if (scene, method) == ('waking_sleeper', 'rk45'):   # grows what the tolerance leaves
        arguments += ['-p', 'solver.rtol:=1.0e-13']
    found = surveyed(log_of(tmp_path / 'run.mcap', *arguments))
    motion, = found.motions
    truth = motion.exact
    assert_exact_numbers(truth, parameters.checked(scene_parameters(scene)))
    assert truth.name == motion.regime == NAMES[scene]
    measured = motion.measured
    if scene in RESTING:
        assert measured.nutation_period is None and measured.nutations == 0
    else:
        assert measured.nutations >= 2
        assert measured.nutation_period == pytest.approx(truth.nutation_period, rel=1e-9)
    assert measured.mean_precession_rate == pytest.approx(
        truth.mean_precession_rate, rel=1e-9, abs=1e-9 if scene == 'free_top' else 0.0)
    assert measured.mean_spin_rate == pytest.approx(truth.mean_spin_rate, rel=1e-9)
    # Near a pole a tilt is the root of a square that doubles hold to 1e-16.
    assert measured.theta_min == pytest.approx(truth.theta_min, abs=1e-6)
    assert measured.theta_max == pytest.approx(truth.theta_max, abs=1e-6)
    assert not measured.missing


def assert_exact_numbers(described, values):
    """
    Compare the exact numbers with the cubic u'^2 = f(u), u = cos(theta), solved by numpy.

    The extremes of phi' are compared with phi' at tilts all over the swing.
    """
    top, start = parameters.top_of(values), parameters.start_state(values)
    torque, lambda1, l3, lz = top.gravity_torque, top.lambda1, start.l3, start.lz
    if torque == 0.0:
        assert described.gyroscopic_ratio == np.inf
    else:
        assert described.gyroscopic_ratio == pytest.approx(
            l3 * l3 / (4.0 * lambda1 * abs(torque)), rel=1e-12)
    u0 = np.cos(start.theta)
    kinetic = 0.5 * lambda1 * start.theta_dot ** 2
    if np.sin(start.theta):
        kinetic += 0.5 * (lz - l3 * u0) ** 2 / lambda1 / np.sin(start.theta) ** 2
    line = np.polynomial.Polynomial([kinetic + torque * u0, -torque])
    f = (2.0 / lambda1 * line * np.polynomial.Polynomial([1.0, 0.0, -1.0])
         - np.polynomial.Polynomial([lz / lambda1, -l3 / lambda1]) ** 2)
    roots = np.sort(f.trim().roots().real)
    low, high = (roots[:2] if torque >= 0.0 else roots[1:]).clip(-1.0, 1.0)
    # A root that is double, or at a pole, is known to the root of the last bit only.
    assert np.cos([described.theta_max, described.theta_min]) == pytest.approx(
        [low, high], abs=1e-7)
    if torque > 0.0:
        assert described.separatrix_distance == pytest.approx(
            (roots[2] - roots[1]) / (roots[2] - roots[0]), rel=1e-5, abs=1e-7)
    if l3 == lz == 0.0:
        assert described.precession_min == described.precession_max == 0.0
        return
    tilts = np.linspace(described.theta_min, described.theta_max, 100_001)
    if start.theta == 0.0:                  # upright: the limit at the pole
        rates = np.array([0.5 * l3 / lambda1])
    else:
        rates = (lz - l3 * np.cos(tilts)) / lambda1 / np.sin(tilts) ** 2
    close = {'rel': 1e-6, 'abs': 1e-7 * np.abs(rates).max()}
    assert described.precession_min == pytest.approx(rates.min(), **close)
    assert described.precession_max == pytest.approx(rates.max(), **close)


@pytest.mark.parametrize(('l3', 'lz'), [(1.6, 1.7), (1.6, -1.7), (-1.6, 1.7)])
def test_the_slowest_precession_may_be_within_the_swing(tmp_path, l3, lz):
    """|Lz| > |L3|: phi' is extreme at a tilt between the ends, where L3 u^2 - 2 Lz u + L3 = 0."""
    scene = {'initial.theta': 0.75 if l3 * lz > 0.0 else 2.39, 'initial.theta_dot': 3.0,
             'spin.l3': l3, 'spin.lz': lz}
    found = surveyed(log_of(tmp_path / 'run.mcap', '--duration', 2, '-p', 'solver.method:=exact',
                            *(argument for name, value in scene.items()
                              for argument in ('-p', f'{name}:={value}'))))
    motion, = found.motions
    assert_exact_numbers(motion.exact, parameters.checked(scene))
    inner = np.arccos((lz - np.copysign(np.sqrt(lz * lz - l3 * l3), lz)) / l3)
    assert motion.exact.theta_min < inner < motion.exact.theta_max
    # The samples reach the extremes, too, as far as samples do.
    for name in ('precession_min', 'precession_max'):
        assert getattr(motion.measured, name) == pytest.approx(
            getattr(motion.exact, name), rel=1e-2)


def test_a_slow_topic_says_that_it_does_not_resolve_the_nutation(tmp_path):
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--params', ROOT / 'config/fast_gyroscope.yaml', '--duration', 5,
        '-p', 'record.streams:=["joint_states"]', '-p', 'solver.method:=exact'))
    motion, = found.motions
    assert motion.measured.nutation_period is None
    assert motion.measured.mean_precession_rate is None
    assert 'a few samples' in motion.measured.missing[0]


@pytest.mark.parametrize('topic', ['pose', 'ground_truth_odom', 'ground_truth_imu', 'imu_data'])
def test_any_topic_with_an_attitude_measures_a_motion(tmp_path, topic):
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--duration', 10, '-p', f'record.streams:=["{topic}"]',
        '-p', 'imu_data.enabled:=true', '-p', 'imu.rpy:=[0.3, -0.2, 1.1]',
        '-p', 'solver.method:=exact', '--namespace', '/one'))
    motion, = found.motions
    for name in ('nutation_period', 'mean_precession_rate', 'mean_spin_rate'):
        assert getattr(motion.measured, name) == pytest.approx(
            getattr(motion.exact, name), rel=1e-9), name
    assert max(curve.largest for curve in found.errors.values()) < 1e-14
    drifts = [curve.largest for curves in found.drifts.values() for curve in curves.values()]
    assert len(drifts) == (3 if topic.startswith('ground_truth') else 0)
    assert all(drift < 1e-14 for drift in drifts)


def test_a_sleeping_top_is_measured_from_an_imu_alone(tmp_path):
    """At the pole phi is not defined, and theta' only where a topic has it."""
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--params', ROOT / 'config/sleeping.yaml', '--duration', 2,
        '-p', 'record.streams:=["ground_truth_imu"]'))
    motion, = found.motions
    assert motion.regime == 'sleeping'
    assert motion.measured.theta_min == motion.measured.theta_max == 0.0


def test_errors_and_drifts_are_those_in_the_data(stepped, tmp_path, capsys):
    """A pose turned by 1e-6 rad, a rate off by 1e-3: told as such, and where."""
    def change(topic, number, data):
        if topic == '/a/b/pose' and number == 250:
            x, y, z, w = struct.unpack_from('<4d', data, len(data) - 32)
            half = 5e-7                 # about z, in the body
            turned = (x + y * half, y - x * half, z + w * half, w - z * half)
            return data[:-32] + struct.pack('<4d', *turned)
        return data
    code, content = as_json(capsys, rewritten(stepped, tmp_path / 'run.mcap', change))
    assert code == 0
    errors = content['orientation_error']
    assert errors['/a/b/pose']['max'] == pytest.approx(1e-6, rel=1e-3)
    assert errors['/a/b/joint_states']['max'] < 1e-9
    assert errors['/a/b/pose']['rms'] == pytest.approx(1e-6 / np.sqrt(301), rel=1e-2)
    for drifts in content['drifts'].values():
        assert 0.0 < drifts['energy'] < 1e-11 and drifts['l3'] < 1e-13


def test_interpolation_is_as_good_as_its_bound():
    """Ten samples in a period: off by sin(pi/10)^24 of the amplitude at most."""
    samples = np.cos(2.0 * np.pi * np.arange(200) / 10.0 + 0.3)
    at = np.linspace(20.0, 180.0, 1001)
    off = analysis.interpolate(samples, at) - np.cos(2.0 * np.pi * at / 10.0 + 0.3)
    assert np.max(np.abs(off)) < 1.5 * np.sin(np.pi / 10.0) ** 24 + 2e-15
    assert np.array_equal(analysis.interpolate(samples, np.arange(200.0)), samples)


@pytest.mark.parametrize('number', [0.0, np.nan, np.inf])
def test_an_attitude_that_is_none_is_left_out(stepped, tmp_path, capsys, number):
    """Of one message; the rest is as accurate as before."""
    path = rewritten(stepped, tmp_path / 'run.mcap', lambda topic, index, data: (
        data[:-32] + struct.pack('<4d', *(4 * [number]))
        if (topic, index) == ('/a/b/pose', 250) else data))
    code, content = as_json(capsys, path)
    assert code == 0
    assert content['orientation_error']['/a/b/pose']['max'] < 1e-9
    assert content['motions'][-1]['measured']['nutations'] >= 1


def test_missing_samples_are_told_where_they_are(stepped, tmp_path, capsys):
    path = rewritten(stepped, tmp_path / 'gap.mcap', lambda topic, number, data: (
        None if topic == '/a/b/pose' and 50 <= number < 60 else data))
    _, content = as_json(capsys, path)
    pose = content['topics']['/a/b/pose']
    assert (pose['missing'], pose['count']) == (10, 291)
    assert pose['gaps_ns'] == [[1_500_000_000, 1_590_000_000]]
    assert all(topic['missing'] == 0 for name, topic in content['topics'].items()
               if topic['stream'] and name != '/a/b/pose')


@pytest.mark.parametrize(('kept', 'gaps'), [
    (range(3, 301), [[1_000_000_000, 1_020_000_000]]),
    (range(296), [[3_960_000_000, 4_000_000_000]]),
    (range(5, 290), [[1_000_000_000, 1_040_000_000], [3_900_000_000, 4_000_000_000]]),
    ((), [[1_000_000_000, 2_000_000_000], [2_010_000_000, 3_000_000_000],
          [3_010_000_000, 4_000_000_000]])])
def test_missing_samples_at_the_ends_are_found_too(folder, tmp_path, capsys, kept, gaps):
    """Of a topic without any, each part between two commands is a gap."""
    whole = folder / 'ends.mcap'
    if not whole.exists():
        log_of(whole, '--duration', 3, '--command', '1:2.0:1.5', '--command', '2:1.7:1.4')
    path = rewritten(whole, tmp_path / 'gap.mcap', lambda topic, number, data: (
        None if topic == '/pose' and number not in kept else data))
    _, content = as_json(capsys, path)
    pose = content['topics']['/pose']
    assert (pose['missing'], pose['count']) == (301 - len(kept), len(kept))
    assert pose['gaps_ns'] == gaps


def test_a_long_series_keeps_its_peaks():
    series, rng = Series(), np.random.default_rng(3)
    values = rng.normal(size=100_001)
    values[[7, 50_001, 99_999]] = 9.0, -10.0, 8.0
    values[20_000] = np.nan
    times = 10 * np.arange(len(values))
    for first in range(0, len(values), 4096):
        series.add(times[first:first + 4096], values[first:first + 4096])
    stamps, points = series.points
    assert 5_000 < len(points) <= 20_000 and np.all(np.diff(stamps) > 0)
    assert {9.0, -10.0, 8.0} <= set(points)
    assert np.array_equal(points, values[stamps.astype(int) // 10])
    assert series.largest == 10.0
    assert series.rms == pytest.approx(np.sqrt(np.nanmean(values ** 2)))


# ---------------------------------------------------------------------------------- verifying


def verified(capsys, path):
    code, content = as_json(capsys, path, '--verify')
    assert code == (0 if content['verify']['identical'] else 1)
    return content['verify']


@pytest.mark.parametrize('name', ['stepped', 'columns'])
def test_offline_logs_verify(name, capsys, request):
    path = request.getfixturevalue(name)
    verdict = verified(capsys, path)
    assert verdict['identical'] and verdict['warnings'] == []
    with LogReader(path) as reader:
        counts = {}
        for message in reader.messages():
            counts[message.topic] = counts.get(message.topic, 0) + 1
    counts.pop(next(name for name in counts if name.endswith('/events')))
    assert verdict['compared'] == counts


@pytest.mark.parametrize('method', ['rk45', 'exact'])
def test_a_command_exactly_at_the_end_verifies(tmp_path, capsys, method):
    verdict = verified(capsys, log_of(tmp_path / 'run.mcap', '--duration', 1, '--command',
                                      '1:2.0:1.5', '-p', f'solver.method:={method}'))
    assert verdict['identical'] and verdict['compared']['/spinning_top/commands'] == 1


@pytest.mark.parametrize('name', ['stepped', 'columns'])
def test_a_changed_bit_is_found_wherever_it_is(name, tmp_path, capsys, request):
    source = request.getfixturevalue(name)
    with LogReader(source) as reader:
        sizes = {message.topic: len(message.data) for message in reader.messages()}
    rng = np.random.default_rng(5)
    # Which topics, differs between the two logs.
    for topic, size in list(sizes.items())[name == 'columns'::2]:
        if topic.endswith('/events'):
            continue
        byte, bit = int(rng.integers(4, size)), int(rng.integers(8))
        def change(name, number, data, *, place=(topic, 1), byte=byte, bit=bit):
            return with_flipped_bit(data, byte, bit) if (name, number) == place else data
        path = rewritten(source, tmp_path / 'changed.mcap', change)
        verdict = verified(capsys, path)
        first = verdict['first']
        assert not verdict['identical'], topic
        assert (verdict['different'], first['topic'], first['byte']) == (1, topic, byte)
        assert first['logged'] != first['computed']
        path.unlink()


def test_a_difference_names_field_stamp_and_both_values(stepped, tmp_path, capsys):
    path = rewritten(stepped, tmp_path / 'run.mcap', lambda topic, number, data: (
        with_flipped_bit(data, len(data) - 8) if (topic, number) == ('/a/b/pose', 7) else data))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1
    said = re.search(r'first: /a/b/pose at 1\.070000000 s, byte \d+, pose\.orientation\[3\]: '
                     r'in the log (\S+), computed (\S+)', out)
    logged, computed = float(said[1]), float(said[2])
    assert 0.0 < abs(logged - computed) < 3e-16


def test_messages_too_few_and_too_many_are_told(stepped, tmp_path, capsys):
    verdict = verified(capsys, rewritten(
        stepped, tmp_path / 'fewer.mcap', lambda topic, number, data: (
            None if (topic, number) == ('/a/b/pose', 100) else data)))
    assert (verdict['missing'], verdict['unexpected'], verdict['different']) == (1, 0, 0)
    assert verdict['first']['stamp_ns'] == 2_000_000_000


def test_a_changed_journal_is_found(stepped, tmp_path, capsys):
    """A digit of a commanded momentum: the motion after it is another."""
    verdict = verified(capsys, rewritten(
        stepped, tmp_path / 'run.mcap', lambda topic, number, data: (
            data.replace(b'"l3": 2.0', b'"l3": 2.1') if topic.endswith('/events') else data)))
    assert not verdict['identical'] and verdict['different'] > 1000
    verdict = verified(capsys, rewritten(
        stepped, tmp_path / 'cut.mcap', lambda topic, number, data: (
            data.replace(b'"l3": 2.0', b'"l3"; 2.0') if topic.endswith('/events') else data)))
    assert not verdict['identical'] and verdict['first']['topic'].endswith('/events')


def test_another_machine_is_warned_of(stepped, capsys, monkeypatch):
    here = provenance.surroundings()
    monkeypatch.setattr(provenance, 'surroundings', lambda: {**here, 'platform': 'abacus'})
    verdict = verified(capsys, stepped)
    assert verdict['identical']
    assert len(verdict['warnings']) == 1 and 'abacus' in verdict['warnings'][0]


def test_a_long_verification_tells_how_far_it_is_without_a_terminal(
        columns, capsys, monkeypatch):
    def told_if_a_look_takes(seconds):
        looks = itertools.count()
        monkeypatch.setattr(cli, 'time', SimpleNamespace(
            monotonic=lambda: seconds * next(looks)))
        return [told(capsys, columns, '--verify', *more)[2] for more in ((), ('--json',))]

    long, silent = told_if_a_look_takes(6.0)
    percents = [int(number) for number in re.findall(r'^verified (\d+)%$', long, re.MULTILINE)]
    assert len(percents) == long.count('\n') > 2
    assert percents == sorted(percents) and 0 < percents[0] < percents[-1] <= 100
    assert silent == ''
    assert told_if_a_look_takes(1e-6) == ['', '']


@pytest.mark.parametrize('more', [{}, {'increments.enabled': True, 'imu.sampling': 'mean',
                                       'imu.lever_arm': [0.1, -0.2, 0.3]}])
def test_live_logs_verify(tmp_path, capsys, more):
    """From the start, and from the middle with commands before; rates change, resets happen."""
    pytest.importorskip('rclpy')
    from geometry_msgs.msg import PoseStamped
    from helpers.node_harness import Peer, SimNode

    whole, part = tmp_path / 'whole.mcap', tmp_path / 'part.mcap'
    options = {'status_period': 0.0, 'record.uri': str(whole), 'start_paused': True,
               'imu.gyroscope_noise_density': 0.01, **more}
    with SimNode(tmp_path, options, namespace='/live') as node, Peer() as peer:
        pose = peer.listen(node.topic('pose'), PoseStamped)

        def set_now(**values):
            assert all(result.successful for result in peer.set_each(node, **values))
            pose.wait_more(15)
        assert peer.set_together(node, spin__l3=1.7, spin__lz=1.4).successful
        assert peer.switch(node, 'record', True).success
        assert peer.set_together(node, spin__l3=1.65, spin__lz=1.4).successful   # before t = 0
        peer.switch(node, 'set_pause', False)
        pose.wait(20)
        set_now(imu__rate=125.0, pose__rate=50.0)
        set_now(spin__lz=1.3)
        assert peer.switch(node, 'record', False).success
        set_now(record__uri=str(part), joint_states__rate=33.0)
        assert peer.switch(node, 'record', True).success
        set_now(spin__l3=1.8)
        set_now(imu__rate=250.0, imu__gyroscope_noise_density=0.02, solver__method='exact')
        assert peer.trigger(node, 'reset').success
        pose.wait_more(15)
        peer.switch(node, 'set_pause', True)
        assert peer.trigger(node, 'reset').success
        assert peer.set_together(node, spin__l3=1.9, spin__lz=1.3).successful    # before t = 0
        assert peer.trigger(node, 'step').success
        peer.switch(node, 'set_pause', False)
        set_now(ground_truth_imu__rate=100.0)
        assert node.end() == 0, node.err
    for path, causes in ((whole, ['start', 'command', 'command']),
                         (part, ['start', 'command', 'reset', 'reset', 'command'])):
        code, content = as_json(capsys, path, '--verify')
        verdict = content['verify']
        assert verdict['identical'] and code == 0, verdict
        assert sum(verdict['compared'].values()) > 300
        assert [motion['cause'] for motion in content['motions']] == causes
        assert all(topic['missing'] == 0 and topic['off_grid'] == 0
                   for topic in content['topics'].values() if topic['stream'])
        assert all(error['max'] < 1e-9 for error in content['orientation_error'].values())


def test_an_euler_form_that_stops_verifies(tmp_path, capsys):
    """Where the equations cannot go on the log ends; so does what is computed again."""
    path = tmp_path / 'run.mcap'
    assert simulate.main(['-o', str(path), '--quiet', '--duration', '5',
                          '-p', 'solver.equations:=euler', '-p', 'spin.lz:=1.6']) == 1
    capsys.readouterr()
    verdict = verified(capsys, path)
    assert verdict['identical'] and sum(verdict['compared'].values()) > 100


# ------------------------------------------------------------------------------ what is told


def test_a_torn_file_is_told_and_what_is_left_verifies(columns, tmp_path, capsys):
    torn = tmp_path / 'torn.mcap'
    with open(columns, 'rb') as file:
        last = make_reader(file).get_summary().chunk_indexes[-1]
    torn.write_bytes(columns.read_bytes()[:last.chunk_start_offset + last.chunk_length // 2])
    code, out, _ = told(capsys, torn, '--verify')
    assert code == 1
    assert 'torn.mcap: truncated' in out and 'lost: ' in out
    assert re.search(r'verify: identical, all \d+ messages', out)
    code, content = as_json(capsys, torn)
    assert code == 1 and not content['whole'] and content['damage']['torn']
    assert content['damage']['lost_bytes'] > 0
    assert content['motions'][2]['measured']['nutations'] > 5


def test_text_tells_the_numbers(stepped, capsys):
    text = told(capsys, stepped)[1]
    assert 'whole, 3 s' in text and '/a/b/ground_truth/imu' in text
    assert 'motion 3 (command), 1 to 2.0031 s: loops' in text
    assert re.search(r'nutation period \[s\] +0\.433970\d+ +0\.433970\d+ +-?\d\.\de-1\d', text)
    assert 'orientation error against the exact solution' in text
    assert 'journal: 3 commands, 0 resets' in text


@pytest.mark.parametrize(('width', 'stacked'), [(120, False), (98, True), (80, True), (40, True)])
def test_a_table_breaks_no_cell_however_narrow(width, stacked, monkeypatch):
    """Where a line is too wide, the first column has lines of its own."""
    head = ('topic', 'type', 'messages', 'rate [Hz]', 'grid [Hz]', 'missing')
    rows = [('/ground_truth/imu_bias', 'visualization_msgs/msg/MarkerArray', '1000', '99.9', '',
             '0'), ('/markers', 'geometry_msgs/msg/PoseStamped', '', '', '100', '')]
    monkeypatch.setenv('COLUMNS', str(width))
    _, title, *lines = cli.table('topics', head, rows)
    assert title == 'topics'
    assert max(map(len, lines)) <= max(width, 80)
    cells = [' '.join(row).split() for row in (head, *rows)]
    if stacked:
        assert [line.split() for line in lines[::2]] == [row[:1] for row in cells]
        assert [line.split() for line in lines[1::2]] == [row[1:] for row in cells]
    else:
        assert [line.split() for line in lines] == cells


def test_a_terminal_of_80_columns_holds_every_line_and_whole_names(stepped, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '80')
    out = told(capsys, stepped, '--verify')[1]
    assert max(map(len, out.splitlines()[1:])) <= 80
    for name in ('visualization_msgs/msg/MarkerArray', 'sensor_msgs/msg/JointState',
                 '/a/b/ground_truth/imu_bias', '/a/b/spinning_top/invariants'):
        assert f'{name} ' in out or f'{name}\n' in out
    for tool in (inspect, recover, simulate):
        with pytest.raises(SystemExit):
            tool.main(['--help'])
        assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_json_is_strict_and_documented(columns, capsys):
    _, out, _ = told(capsys, columns, '--json', '--verify')
    content = json.loads(out, parse_constant=pytest.fail)
    page = (ROOT / 'docs/inspect.md').read_text()
    keys = set(content) | {key for name in ('damage', 'run', 'verify') for key in content[name]}
    keys |= set(content['motions'][0]) | set(content['motions'][0]['measured'])
    keys |= set(content['motions'][0]['exact']) | set(content['topics']['/pose'])
    assert {key for key in keys if f'`{key}`' not in page} == set()


def test_a_strangers_log_is_listed(tmp_path, capsys):
    path = tmp_path / 'stranger.mcap'
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema('some/Thing', 'jsonschema', b'{}')
        channel = writer.register_channel('/thing', 'json', schema)
        for number in range(11):
            writer.add_message(channel, number * 100_000_000, b'{}', number * 100_000_000)
        writer.finish()
    code, content = as_json(capsys, path)
    assert code == 0 and content['ours'] is False
    assert content['topics']['/thing']['count'] == 11
    assert content['topics']['/thing']['rate'] == pytest.approx(10.0)
    code, out, _ = told(capsys, path)
    assert code == 0 and 'not recorded by spinning_top_sim' in out and '/thing' in out
    assert told(capsys, path, '--verify')[0] == 1
    code, _, err = told(capsys, path, '--plot', tmp_path / 'no.png')
    assert code == 1 and 'nothing to draw' in err and not (tmp_path / 'no.png').exists()


@pytest.mark.parametrize('content', [None, b'', b'no log at all'])
def test_what_cannot_be_read_says_so(tmp_path, capsys, content):
    path = tmp_path / 'bad.mcap'
    if content is not None:
        path.write_bytes(content)
    code, out, err = told(capsys, path)
    assert code == 1 and not out and str(path) in err


def test_a_reader_that_leaves_is_no_error(stepped):
    run = subprocess.Popen([sys.executable, '-m', 'spinning_top_sim.tools.inspect', stepped],
                           stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    run.stdout.close()
    assert run.stderr.read() == b''
    assert run.wait(60) == 0


@pytest.mark.parametrize('tool', ['inspect', 'recover'])
def test_a_full_output_is_told_in_a_line(stepped, tmp_path, tool):
    option = ['-o', tmp_path / 'whole.mcap'] if tool == 'recover' else []
    with open('/dev/full', 'w') as full:
        run = subprocess.run(
            [sys.executable, '-m', f'spinning_top_sim.tools.{tool}', stepped, *option],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert run.returncode == 1
    assert run.stderr == f'{tool}: [Errno 28] No space left on device\n'


def test_wrong_arguments_are_2(capsys):
    with pytest.raises(SystemExit) as ended:
        inspect.main(['--no-such-thing'])
    assert ended.value.code == 2


@pytest.mark.parametrize(('option', 'name', 'endings'), [
    ('--plot', 'page', '.png or .pdf or .svg'), ('--plot', 'page.xyz', '.png or .pdf or .svg'),
    ('--animate', 'top.mp4', '.gif'), ('--animate', 'top', '.gif')])
def test_a_picture_whose_name_has_another_ending_is_refused(
        stepped, tmp_path, capsys, option, name, endings):
    with pytest.raises(SystemExit, match='2'):
        inspect.main([str(stepped), option, str(tmp_path / name)])
    assert f'{name}: must end in {endings}\n' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('streams', [['imu'], ['invariants'], ['pose']])
def test_says_what_it_cannot_tell(tmp_path, capsys, streams):
    path = log_of(tmp_path / 'run.mcap', '--duration', 2, '-p', f'record.streams:={streams}')
    code, out, _ = told(capsys, path, '--verify')
    assert code == 0
    assert 'drifts of E, L3, Lz: no topic with rates' in out
    assert ('no topic with an attitude' in out) == (streams != ['pose'])


@pytest.mark.parametrize(('key', 'text'), [
    *itertools.product(
        ('parameters', 'parameters_now', 'history', 'epoch_ns', 'begun_ns'),
        ('', '[]', '[' * 100_000, '"\\ud800"', '9' * 5000, str(2 ** 63), 'NaN')),
    ('history', '[[0, 1, NaN]]'), ('history', '[[5, 1.0, 1.0], [4, 1.0, 1.0]]'),
    ('history', '[[1e300, 1.0, 1.0]]'), ('history', '[[0, 1.0, 1.0, 1.0]]'),
    ('history', '[[0, 4.0, 0.0, 0.0, 0.0, 1.0, 1.0]]'), ('epoch_ns', '-1'),
    ('begun_ns', str(10 ** 18)), ('parameters', '{"spin.l3": {}}'),
    ('parameters', '{"world_frame": "\\ud800"}'), ('parameters', '{"top.lambda1": 1e-320}')])
def test_odd_metadata_end_in_words(stepped, tmp_path, capsys, key, text):
    path = rewritten(stepped, tmp_path / 'odd.mcap', metadata={key: text})
    code, out, _ = told(capsys, path, '--verify')
    assert code in (0, 1) and '/a/b/pose' in out
    assert 'cannot be used' in out or 'motion 1' in out or 'cannot be followed' in out


@pytest.mark.parametrize('event', [
    {'event': 'command', 'l3': math.nan, 'lz': 1.0}, {'event': 'command', 'l3': [], 'lz': None},
    {'event': 'command', 'sent_ns': 2 ** 63, 'l3': 1.0, 'lz': 1.0},
    {'event': 'command', 'sent_ns': 0.5, 'l3': 1.0, 'lz': 1.0}, {'event': 'parameters', 'x': 1},
    {'event': 'parameters', 'pose.rate': '\ud800'}, {'event': 'reset'}, {'event': []},
    {'event': 'state', 'l3': 1.0, 'lz': 1.0},
    {'event': 'state', 'theta': -1.0, 'theta_dot': 0.0, 'phi': 0.0, 'psi': 0.0, 'l3': 1.0,
     'lz': 1.0},
    {'event': 'state', 'theta': math.nan, 'theta_dot': 0.0, 'phi': 0.0, 'psi': 0.0, 'l3': 1.0,
     'lz': 1.0},
    {'event': 'reset', 'parameters': {}, 'epoch_ns': 10 ** 18},
    {'event': 'reset', 'parameters': [], 'epoch_ns': 3_500_000_000}])
def test_an_odd_entry_of_the_journal_is_told(stepped, tmp_path, capsys, event):
    """It is left out: the run is followed to its end all the same."""
    data = journal.event(**{'name': event['event'], 't_ns': 0, 'sent_ns': 2_500_000_000, **{
        name: value for name, value in event.items() if name != 'event'}})
    path = rewritten(stepped, tmp_path / 'odd.mcap', lambda topic, number, old: (
        [old, data] if topic.endswith('/events') and number == 3 else old))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1
    assert 'journal, entry at 3.003100000 s: ' in out or 'cannot be followed beyond' in out
    assert 'motion 4' in out
    _, content = as_json(capsys, path)
    assert any('entry at 3.003100000 s: ' in note or 'cannot be followed' in note
               for note in content['notes'])


def test_a_run_that_no_log_of_its_size_holds_is_not_computed(stepped, tmp_path, capsys):
    """A stamp of the year 2100: neither 10^10 samples nor 10^10 steps."""
    path = rewritten(stepped, tmp_path / 'late.mcap', lambda topic, number, data: data,
                     stamp=lambda topic, number, stamp_ns: (
                         4 * 10 ** 18 if (topic, number) == ('/a/b/pose', 300) else stamp_ns))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1 and 'lacks most samples of this run' in out
    path = rewritten(
        stepped, tmp_path / 'far.mcap', lambda topic, number, data: (
            data.replace(b'"sent_ns": 2003100000', b'"sent_ns": 3999999999000000000').replace(
                b'"t_ns": 2003100000', b'"t_ns": 3999999999000000000')
            if topic.endswith('/events') else data),
        stamp=lambda topic, number, stamp_ns: (
            4 * 10 ** 18 if (topic.endswith('/events') and number == 3) else stamp_ns))
    code, out, _ = told(capsys, path)
    assert 'journal, entry at 4000000000.000000000 s' in out or 'integration steps' in out


def test_changes_without_effect_cost_next_to_nothing(stepped, tmp_path, capsys, monkeypatch):
    """No block of samples ends at a change of parameters that acts on no sample."""
    calls = []
    advance = Simulation.advance_in_blocks
    monkeypatch.setattr(Simulation, 'advance_in_blocks', lambda self, *arguments: (
        calls.append(arguments[0]), advance(self, *arguments)))
    assert verified(capsys, stepped)['identical']
    before = len(calls)
    entries = [journal.event('parameters', t, t, status_period=float(t % 7), tick_rate=50.0)
               for t in range(2_100_000_000, 2_200_000_000, 100_000)]
    path = rewritten(
        stepped, tmp_path / 'run.mcap', lambda topic, number, data: (
            [data, *entries] if topic.endswith('/events') and number == 3 else data),
        stamp=lambda topic, number, stamp_ns, copy=0: stamp_ns + (copy and 200_000_000))
    calls.clear()
    assert verified(capsys, path)['identical']
    assert len(calls) == before


@pytest.mark.parametrize('when', [0, 1])
def test_a_log_that_ends_at_a_reset_or_a_start_verifies(tmp_path, capsys, when):
    """Before the first sample of the motion; nothing is missing."""
    values = parameters.checked({})
    path = log_of(tmp_path / 'run.mcap', '--duration', 1)
    end = journal.event('reset', 0, 1_000_000_000, epoch_ns=2_100_000_000, parameters=values)
    if when:
        path = rewritten(path, tmp_path / 'reset.mcap', lambda topic, number, data: (
            [data, end] if topic.endswith('/events') else data),
            stamp=lambda topic, number, stamp_ns, copy=0: (
                2_100_000_000 if copy else stamp_ns))
    else:
        path = rewritten(path, tmp_path / 'start.mcap', lambda topic, number, data: (
            data if topic.endswith('/events') else None))
    code, content = as_json(capsys, path, '--verify')
    assert content['verify']['identical'] and code == 0, content['verify']
    assert all(topic['missing'] in (0, None) for topic in content['topics'].values())


def test_the_journal_is_read_without_the_chunks_that_have_none_of_it(tmp_path, monkeypatch):
    path = log_of(tmp_path / 'run.mcap', '--duration', 30, '--command', '14:1.7:1.4')
    with open(path, 'rb') as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    with LogReader(path) as reader:
        read, plain = [], reader.open_part
        monkeypatch.setattr(reader, 'open_part', lambda span: (read.append(span), plain(span))[1])
        run = read_run_description(reader)
        assert [event.name for event in run.events] == ['start', 'command']
        assert len(read) <= 4 < len(chunks)


def test_names_do_not_act_on_the_terminal(tmp_path, capsys):
    path = tmp_path / 'evil.mcap'
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema('a/\x1b]0;b\x07', 'ros2msg', b'')
        channel = writer.register_channel('/\x1b[2J\u202e\x9b\nline', 'cdr', schema)
        writer.add_message(channel, 1, b'', 1)
        writer.finish()
    out = told(capsys, path)[1]
    assert out.replace('\n', '').isprintable()
    assert '/\\x1b[2J\\u202e\\x9b\\nline' in out and 'a/\\x1b]0;b\\x07' in out


def test_an_incomplete_log_is_told_in_the_same_words_before_and_after_recover(
        columns, tmp_path, capsys):
    torn, whole = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap'
    data = bytearray(columns.read_bytes())
    with open(columns, 'rb') as file:
        chunk = make_reader(file).get_summary().chunk_indexes[1]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle:middle + 99] = bytes(99)
    torn.write_bytes(data)
    assert recover.main([str(torn), '-o', str(whole)]) == 3
    capsys.readouterr()
    texts = []
    for path in (torn, whole):
        code, out, _ = told(capsys, path, '--verify')
        assert code == 1
        texts.append([line for line in out.splitlines() if line.startswith('verify: ')])
        verdict = verified(capsys, path)
        assert verdict['missing'] and not (verdict['different'] or verdict['unexpected'])
    assert texts[0] == texts[1]
    assert re.match(r'verify: incomplete, \d+ messages missing; the other \d+ are identical',
                    texts[0][0])


# ---------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize('method', ['exact', 'rk45'])
def test_the_path_that_is_drawn_has_cusps(tmp_path, method):
    """At the least tilt the tip stands still, and the motion along the meridian turns round."""
    pytest.importorskip('matplotlib')
    from spinning_top_sim.tools.plots import smooth_tip

    found = surveyed(log_of(tmp_path / 'run.mcap', '--duration', 6,
                            '-p', f'solver.method:={method}'))
    time, tip, height = smooth_tip(found.shown[1])
    points = np.stack((tip.real, tip.imag, height))
    velocity = np.diff(points, axis=1) / np.diff(time)
    speed = np.linalg.norm(velocity, axis=0)
    period = found.motions[0].measured.nutation_period
    step = time[1]
    # Near a cusp the speed grows in proportion to time: half a step away it is what the
    # acceleration makes of it, the greatest there is.
    acceleration = np.max(np.linalg.norm(np.diff(velocity, axis=1), axis=0)) / step
    for number in range(1, 9):
        at = round(number * period / step)
        near = slice(at - 2, at + 2)
        assert np.min(speed[near]) < 1.01 * acceleration * step
        assert np.min(speed[near]) < 2e-2 * np.max(speed)
        before, after = velocity[:, at - 12], velocity[:, at + 12]
        cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
        assert cosine < -0.9                            # a loop or a wave would go on
        assert height[at] > 0.99999 * np.max(height)


@pytest.mark.parametrize('duration', [3.0, 0.025])
def test_in_every_frame_the_tip_is_where_the_axis_is(tmp_path, monkeypatch, duration):
    pytest.importorskip('matplotlib')
    from spinning_top_sim.tools import plots
    ends = []
    monkeypatch.setattr(plots, 'draw_tip', lambda _, tip, height: ends.append(height[-1]))
    found = surveyed(log_of(tmp_path / 'run.mcap', '--duration', duration))
    motion, data = found.shown
    plots.animate(found, motion, data, tmp_path / 'top.gif')
    frames = max(2, int(data.time[-1] * plots.FRAMES_PER_S))
    each = np.arange(frames) / (plots.FRAMES_PER_S * data.period)
    expected = np.interp(each, np.arange(len(data.height)), data.height)
    assert ends[-frames:] == pytest.approx(expected, abs=1e-6)


def test_a_curve_of_a_slow_motion_has_no_more_points_than_can_be_seen():
    pytest.importorskip('matplotlib')
    from spinning_top_sim.tools.plots import smooth_tip
    rows = np.tile(np.array([[0.0], [0.6], [0.0], [0.8]]), 100_000)
    time, tip, height = smooth_tip(analysis.Attitudes(np.arange(100_000) * 10_000_000, rows))
    assert len(time) == len(tip) == len(height) <= 20_001
    assert time[-1] == pytest.approx(999.99)


def test_what_is_missing_takes_no_memory(tmp_path):
    path = log_of(tmp_path / 'run.mcap', '--duration', 60, '-p', 'solver.method:=exact')
    counts = {}
    with LogReader(path) as reader:
        for message in reader.messages():
            counts[message.topic] = counts.get(message.topic, 0) + 1
    thin = rewritten(path, tmp_path / 'thin.mcap', lambda topic, number, data: (
        data if number in (0, counts[topic] - 1) or 'spinning_top/' in topic else None))
    with LogReader(thin) as reader:
        run = read_run_description(reader)
        tracemalloc.start()
        verdict = verify(reader, run, reader.span[1], lambda _: None)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert verdict.missing == sum(
        count - 2 for topic, count in counts.items() if 'spinning_top/' not in topic)
    assert peak < 30e6


def test_a_page_is_drawn_where_the_first_readings_are_missing(tmp_path, capsys):
    pytest.importorskip('matplotlib')
    path = log_of(tmp_path / 'run.mcap', '--duration', 60, '-p', 'imu.rate:=1000.0')
    with LogReader(path) as reader:
        *others, middle = [span for span in reader.scan().parts
                           if span.channel_ids and span.start_ns < 30 * 10 ** 9]
    content = bytearray(path.read_bytes())
    for span in (*others, middle):
        content[span.offset + 100] ^= 1
    path.write_bytes(content)
    assert told(capsys, path, '--plot', tmp_path / 'page.png')[0] == 1
    assert (tmp_path / 'page.png').stat().st_size > 10_000


def test_pictures_are_drawn(stepped, tmp_path, capsys):
    pytest.importorskip('matplotlib')
    image = pytest.importorskip('PIL.Image')
    page, film = tmp_path / 'page.png', tmp_path / 'top.gif'
    code, out, _ = told(capsys, stepped, '--plot', page, '--animate', film)
    assert code == 0
    assert out.endswith(
        f'{page}: motion from 0.01 to 1 s of 3 s in the log; drifts and errors of all of it\n'
        f'{film}: motion from 0.01 to 0.96 s of 3 s in the log\n')
    pixels = np.asarray(image.open(page).convert('L'))
    assert min(pixels.shape) > 700 and 0.02 < np.mean(pixels < 250) < 0.5
    frames = image.open(film)
    assert frames.n_frames == 19 and frames.info['duration'] == 50
    assert film.stat().st_size < 400_000
    shown = []
    for number in (0, 10):
        frames.seek(number)
        shown.append(np.asarray(frames.convert('RGB'), int))
    assert np.mean(np.abs(shown[1] - shown[0]).max(axis=2) > 30) > 0.01


@pytest.mark.parametrize('scene', ['fast_gyroscope', 'heavy_top', 'near_separatrix',
                                   'planar_pendulum', 'sleeping'])
def test_a_page_is_drawn_of_odd_scenes(tmp_path, scene, capsys):
    pytest.importorskip('matplotlib')
    path = log_of(tmp_path / 'run.mcap', '--params', ROOT / f'config/{scene}.yaml', '--duration',
                  2, '-p', 'solver.method:=exact')
    assert told(capsys, path, '--plot', tmp_path / 'page.svg')[0] == 0
    assert (tmp_path / 'page.svg').stat().st_size > 10_000


def test_without_matplotlib_there_is_a_hint(stepped, tmp_path):
    code = ('import sys\nsys.modules["matplotlib"] = None\n'
            'from spinning_top_sim.tools.inspect import main\n'
            f'sys.exit(main([{str(stepped)!r}, "--plot", {str(tmp_path / "page.png")!r}]))')
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                         timeout=60, check=False)
    assert run.returncode == 1 and "pip install 'spinning_top_sim[plot]'" in run.stderr
    assert 'Traceback' not in run.stderr and len(run.stderr.splitlines()) == 1
    assert 'motion 3' in run.stdout                     # the rest is told all the same


def test_neither_ros_nor_pictures_are_imported_unasked(stepped):
    code = ('import sys\nfrom spinning_top_sim.tools.inspect import main\n'
            'early = sorted({"scipy"} & set(sys.modules))\n'
            f'main([{str(stepped)!r}, "--verify"])\n'
            'print("loaded:", early, sorted({"rclpy", "matplotlib"} & set(sys.modules)))')
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                         timeout=60, check=True)
    assert run.stdout.strip().endswith('loaded: [] []')
