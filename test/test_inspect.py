# SPDX-License-Identifier: Apache-2.0
"""
`inspect`: the truth about a log, from logs that other tests trust and from damaged copies.

What is measured is compared with the closed form, which test_exact.py holds against 30 digits.
"""

import itertools
import json
import math
import os
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
from helpers.reference import ROOT, SCENES, scene_parameters
from mcap.reader import make_reader
from mcap.writer import Writer

from spinning_top_sim import tools
from spinning_top_sim.recording import provenance
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import journal, parameters
from spinning_top_sim.tools import inspect, recorded_run, recover, simulate
from spinning_top_sim.tools.survey import survey

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
def short(folder):
    """Two motions in half a second."""
    return log_of(folder / 'short.mcap', '--duration', 0.5, '--command', '0.3:1.7:1.4')


@pytest.fixture(scope='module')
def columns(folder):
    """The exact solution in columns, with a command between two stretches; several chunks."""
    return log_of(folder / 'columns.mcap', '--duration', 11, '--command', '3.1:1.7:1.4',
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


def chunks_of(path):
    with open(path, 'rb') as file:
        return make_reader(file).get_summary().chunk_indexes


def rewritten(source, target, change=lambda topic, number, data: data, metadata=None,
              stamp=lambda topic, number, stamp_ns: stamp_ns):
    """
    Copy a log with checksums that are right.

    change : takes topic, number in it and data of a message; returns other data, None to drop it,
        or a list of data
    metadata : what is another in the metadata of the run
    stamp : takes topic, number and log time [ns]; returns the log time
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
            data, at_ns = (change(topic, number, message.data),
                           stamp(topic, number, message.log_time))
            for one in data if isinstance(data, list) else [data]:
                if one is not None:
                    writer.add_message(channels[channel.id], at_ns, one, at_ns)
        writer.finish()
    return target


def with_flipped_bit(data, byte, bit=0):
    changed = bytearray(data)
    changed[byte] ^= 1 << bit
    return bytes(changed)


# --------------------------------------------------------------------------------- measuring


@pytest.mark.parametrize(('scene', 'method'), [
    *((scene, 'exact') for scene in SCENES), ('cusp', 'rk45')])
def test_every_scene_is_measured_from_its_data(tmp_path, scene, method):
    duration = 20 if scene in ('near_separatrix', 'waking_sleeper') else 4
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--params', ROOT / f'config/{scene}.yaml', '--duration', duration,
        '-p', f'solver.method:={method}', '-p',
        "record.streams:=['joint_states', 'ground_truth_imu']"))
    motion, = found.motions
    truth = motion.exact
    assert truth.separatrix_distance == pytest.approx(
        separatrix_distance(parameters.checked(scene_parameters(scene))), rel=1e-5, abs=1e-7)
    assert truth.name == NAMES[scene]
    measured = motion.measured
    if scene in RESTING:
        assert measured.nutation_period is None and measured.nutations == 0
    else:
        assert measured.nutations >= 2
        assert measured.nutation_period == pytest.approx(truth.nutation_period, rel=1e-9)
    assert measured.mean_precession_rate == pytest.approx(
        truth.mean_precession_rate, rel=1e-9, abs=1e-9 if scene == 'free_top' else 0.0)
    assert measured.mean_spin_rate == pytest.approx(truth.mean_spin_rate, rel=1e-9)
    assert not measured.missing


def separatrix_distance(values):
    """Return 1 - m by the cubic u'^2 = f(u), u = cos(theta), solved by numpy."""
    top, start = parameters.top_of(values), parameters.start_state(values)
    torque, lambda1, l3, lz = top.gravity_torque, top.lambda1, start.l3, start.lz
    if torque == 0.0:
        return 1.0
    u0 = np.cos(start.theta)
    kinetic = 0.5 * lambda1 * start.theta_dot ** 2
    if np.sin(start.theta):
        kinetic += 0.5 * (lz - l3 * u0) ** 2 / lambda1 / np.sin(start.theta) ** 2
    line = np.polynomial.Polynomial([kinetic + torque * u0, -torque])
    f = (2.0 / lambda1 * line * np.polynomial.Polynomial([1.0, 0.0, -1.0])
         - np.polynomial.Polynomial([lz / lambda1, -l3 / lambda1]) ** 2)
    low, high, greatest = np.sort(f.roots().real)
    return (greatest - high) / (greatest - low)


def test_a_slow_topic_says_that_it_does_not_resolve_the_nutation(tmp_path):
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--params', ROOT / 'config/fast_gyroscope.yaml', '--duration', 2,
        '-p', 'record.streams:=["joint_states"]', '-p', 'solver.method:=exact'))
    measured = found.motions[0].measured
    assert measured.nutation_period is measured.mean_precession_rate is None
    assert measured.missing == ('1.3 samples in a nutation are too few',)


@pytest.mark.parametrize('topic', ['pose', 'ground_truth_imu', 'imu_data'])
def test_any_topic_with_an_attitude_measures_a_motion(tmp_path, topic):
    found = surveyed(log_of(
        tmp_path / 'run.mcap', '--duration', 3, '-p', f'record.streams:=["{topic}"]',
        '-p', 'imu_data.enabled:=true', '-p', 'imu.rpy:=[0.3, -0.2, 1.1]',
        '-p', 'solver.method:=exact', '--namespace', '/one'))
    motion, = found.motions
    for name in ('nutation_period', 'mean_precession_rate', 'mean_spin_rate'):
        assert getattr(motion.measured, name) == pytest.approx(
            getattr(motion.exact, name), rel=1e-9), name
    assert max(found.errors.values()) < 1e-14
    drifts = [drift for drifts in found.drifts.values() for drift in drifts.values()]
    assert len(drifts) == (3 if topic.startswith('ground_truth') else 0)
    assert all(drift < 1e-14 for drift in drifts)


def test_errors_and_drifts_are_those_in_the_data(stepped, tmp_path, capsys):
    """A pose turned by 1e-6 rad is told as such; one that is no attitude is left out."""
    def change(topic, number, data):
        if topic == '/a/b/pose' and number in (10, 20, 30):
            return data[:-32] + struct.pack('<4d', *(4 * [{10: 0.0, 20: np.nan, 30: np.inf}[
                number]]))
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
    for drifts in content['drifts'].values():
        assert 0.0 < drifts['energy'] < 1e-11 and drifts['l3'] < 1e-13
    assert content['motions'][-1]['measured']['nutations'] >= 1


@pytest.mark.parametrize(('kept', 'gaps'), [
    ([*range(5, 10), *range(20, 40)], [
        [1_000_000_000, 1_040_000_000], [1_100_000_000, 1_190_000_000],
        [1_400_000_000, 1_500_000_000]]),
    ((), [[1_000_000_000, 1_300_000_000], [1_310_000_000, 1_500_000_000]])])
def test_missing_samples_are_told_where_they_are(short, tmp_path, capsys, kept, gaps):
    """Of a topic without any, each part between two commands is a gap."""
    path = rewritten(short, tmp_path / 'gap.mcap', lambda topic, number, data: (
        None if topic == '/pose' and number not in kept else data))
    _, content = as_json(capsys, path)
    pose = content['topics']['/pose']
    assert (pose['missing'], pose['count']) == (51 - len(kept), len(kept))
    assert pose['gaps_ns'] == gaps
    assert all(topic['missing'] == 0 for name, topic in content['topics'].items()
               if topic['stream'] and name != '/pose')


# ---------------------------------------------------------------------------------- verifying


def verified(capsys, path):
    code, content = as_json(capsys, path, '--verify')
    assert code == (0 if content['verify']['identical'] else 1)
    return content['verify']


@pytest.mark.parametrize('name', ['stepped', 'columns'])
def test_offline_logs_verify_and_a_changed_bit_is_found_wherever_it_is(
        name, tmp_path, capsys, request):
    path = request.getfixturevalue(name)
    verdict = verified(capsys, path)
    assert verdict['identical'] and verdict['warnings'] == []
    counts, sizes = {}, {}
    with LogReader(path) as reader:
        for message in reader.messages():
            counts[message.topic] = counts.get(message.topic, 0) + 1
            sizes[message.topic] = len(message.data)
    counts.pop(next(name for name in counts if name.endswith('/events')))
    assert verdict['compared'] == counts
    rng = np.random.default_rng(5)
    places = {topic: (int(rng.integers(4, sizes[topic])), int(rng.integers(8)))
              for topic in counts}
    verdict = verified(capsys, rewritten(
        path, tmp_path / 'changed.mcap', lambda topic, number, data: (
            with_flipped_bit(data, *places[topic])
            if topic in places and number == min(1, counts[topic] - 1) else data)))
    first = verdict['first']
    assert verdict['different'] == len(counts)
    assert not (verdict['missing'] or verdict['unexpected'])
    assert first['byte'] == places[first['topic']][0]
    assert first['logged'] != first['computed']


def test_a_difference_names_field_stamp_and_both_values(short, tmp_path, capsys):
    path = rewritten(short, tmp_path / 'run.mcap', lambda topic, number, data: (
        with_flipped_bit(data, len(data) - 8) if (topic, number) == ('/pose', 7) else data))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1
    said = re.search(r'first: /pose at 1\.070000000 s, byte \d+, pose\.orientation\[3\]: '
                     r'in the log (\S+), computed (\S+)', out)
    logged, computed = float(said[1]), float(said[2])
    assert 0.0 < abs(logged - computed) < 3e-16


def test_a_missing_message_and_a_changed_journal_are_found(short, tmp_path, capsys):
    """A digit of a commanded momentum: the motion after it is another."""
    verdict = verified(capsys, rewritten(
        short, tmp_path / 'fewer.mcap', lambda topic, number, data: (
            None if (topic, number) == ('/pose', 10) else data)))
    assert (verdict['missing'], verdict['unexpected'], verdict['different']) == (1, 0, 0)
    assert verdict['first']['stamp_ns'] == 1_100_000_000
    verdict = verified(capsys, rewritten(
        short, tmp_path / 'run.mcap', lambda topic, number, data: (
            data.replace(b'"l3": 1.7', b'"l3": 1.8') if topic.endswith('/events') else data)))
    assert not verdict['identical'] and verdict['different'] > 100
    verdict = verified(capsys, rewritten(
        short, tmp_path / 'cut.mcap', lambda topic, number, data: (
            data.replace(b'"l3": 1.7', b'"l3"; 1.7') if topic.endswith('/events') else data)))
    assert not verdict['identical'] and verdict['first']['topic'].endswith('/events')


def test_another_machine_is_warned_of(short, capsys, monkeypatch):
    here = provenance.surroundings()
    monkeypatch.setattr(provenance, 'surroundings', lambda: {**here, 'platform': 'abacus'})
    verdict = verified(capsys, short)
    assert verdict['identical']
    assert len(verdict['warnings']) == 1 and 'abacus' in verdict['warnings'][0]


def test_live_logs_verify(tmp_path, capsys):
    """From the start, and from the middle with commands before; rates change, resets happen."""
    pytest.importorskip('rclpy')
    from geometry_msgs.msg import PoseStamped
    from helpers.node_harness import Peer, SimNode

    whole, part = tmp_path / 'whole.mcap', tmp_path / 'part.mcap'
    options = {'status_period': 0.0, 'record.uri': str(whole), 'start_paused': True,
               'imu.gyroscope_noise_density': 0.01, 'increments.enabled': True,
               'imu.sampling': 'mean', 'imu.lever_arm': [0.1, -0.2, 0.3]}
    with SimNode(tmp_path, options, namespace='/live') as node, Peer() as peer:
        pose = peer.listen(node.topic('pose'), PoseStamped)

        def set_now(**values):
            assert all(result.successful for result in peer.set_each(node, **values))
            pose.wait_more(5)
        assert peer.set_together(node, spin__l3=1.7, spin__lz=1.4).successful
        assert peer.switch(node, 'record', True).success
        assert peer.set_together(node, spin__l3=1.65, spin__lz=1.4).successful   # before t = 0
        peer.switch(node, 'set_pause', False)
        pose.wait(10)
        set_now(imu__rate=125.0, pose__rate=50.0)
        set_now(spin__lz=1.3)
        assert peer.switch(node, 'record', False).success
        set_now(record__uri=str(part), joint_states__rate=33.0)
        assert peer.switch(node, 'record', True).success
        set_now(spin__l3=1.8)
        set_now(imu__rate=250.0, imu__gyroscope_noise_density=0.02, solver__method='exact')
        assert peer.trigger(node, 'reset').success
        pose.wait_more(5)
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
        assert sum(verdict['compared'].values()) > 100
        assert [motion['cause'] for motion in content['motions']] == causes
        assert all(topic['missing'] == 0
                   for topic in content['topics'].values() if topic['stream'])
        assert all(error['max'] < 1e-9 for error in content['orientation_error'].values())


# ------------------------------------------------------------------------------ what is told


def test_a_torn_file_is_told_and_what_is_left_verifies(columns, tmp_path, capsys):
    torn = tmp_path / 'torn.mcap'
    last = chunks_of(columns)[-1]
    torn.write_bytes(columns.read_bytes()[:last.chunk_start_offset + last.chunk_length // 2])
    code, out, _ = told(capsys, torn, '--verify')
    assert code == 1
    assert 'torn.mcap: truncated' in out and 'lost: ' in out
    assert re.search(r'verify: identical, all \d+ messages', out)
    code, content = as_json(capsys, torn)
    assert code == 1 and not content['whole'] and content['damage']['torn']
    assert content['damage']['lost_bytes'] > 0
    assert content['motions'][0]['measured']['nutations'] > 3


def test_an_incomplete_log_is_told_in_the_same_words_before_and_after_recover(
        columns, tmp_path, capsys):
    torn, whole = tmp_path / 'torn.mcap', tmp_path / 'whole.mcap'
    data = bytearray(columns.read_bytes())
    chunk = chunks_of(columns)[1]
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
    assert texts[0] == texts[1]
    assert re.match(r'verify: incomplete, \d+ messages missing; the other \d+ are identical',
                    texts[0][0])


def test_text_tells_the_numbers_and_help_fits_into_80_columns(stepped, capsys):
    text = told(capsys, stepped)[1]
    assert 'whole, 3 s' in text and '/a/b/ground_truth/imu' in text
    assert 'motion 3 (command), 1 to 2.0031 s: loops' in text
    assert re.search(r'nutation period \[s\] +0\.433970\d+ +0\.433970\d+ +-?\d\.\de-1\d', text)
    assert 'orientation error against the exact solution' in text
    assert 'journal: 3 commands, 0 resets' in text
    for tool in (inspect, recover, simulate):
        with pytest.raises(SystemExit):
            tool.main(['--help'])
        assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


def test_json_is_strict_and_documented(short, capsys):
    _, out, _ = told(capsys, short, '--json', '--verify')
    content = json.loads(out, parse_constant=pytest.fail)
    page = (ROOT / 'docs/log_format.md').read_text()
    keys = set(content) | {key for name in ('damage', 'run', 'verify') for key in content[name]}
    keys |= set(content['motions'][0]) | set(content['motions'][0]['measured'])
    keys |= set(content['motions'][0]['exact']) | set(content['topics']['/pose'])
    assert {key for key in keys if f'`{key}`' not in page} == set()
    command = content['events'][1]
    assert (command['event'], command['t_ns'], command['stamp_ns'], command['l3']) == (
        'command', 300_000_000, 1_300_000_000, 1.7)


def test_a_strangers_log_is_listed_and_its_names_do_not_act_on_the_terminal(tmp_path, capsys):
    path = tmp_path / 'stranger.mcap'
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start()
        thing = writer.register_schema('some/Thing', 'jsonschema', b'{}')
        evil = writer.register_schema('a/\x1b]0;b\x07', 'ros2msg', b'')
        channels = (writer.register_channel('/thing', 'json', thing),
                    writer.register_channel('/\x1b[2J\u202e\x9b\nline', 'cdr', evil))
        for number, channel in itertools.product(range(11), channels):
            writer.add_message(channel, number * 100_000_000, b'{}', number * 100_000_000)
        writer.finish()
    code, content = as_json(capsys, path)
    assert code == 0 and content['ours'] is False
    assert content['topics']['/thing']['count'] == 11
    assert content['topics']['/thing']['rate'] == pytest.approx(10.0)
    code, out, _ = told(capsys, path)
    assert code == 0 and out.count('not recorded by spinning_top_sim') == 1 and '/thing' in out
    assert out.replace('\n', '').isprintable()
    assert '/\\x1b[2J\\u202e\\x9b\\nline' in out and 'a/\\x1b]0;b\\x07' in out
    code, _, err = told(capsys, path, '--verify')
    assert code == 1 and err.startswith('spinning-top inspect: --verify: it was not recorded by')
    code, _, err = told(capsys, path, '--plot', tmp_path / 'no.png')
    assert code == 1 and 'nothing to draw' in err and not (tmp_path / 'no.png').exists()


@pytest.mark.parametrize('content', [None, b'', b'no log at all'])
def test_what_cannot_be_read_says_so(tmp_path, capsys, content):
    path = tmp_path / 'bad.mcap'
    if content is not None:
        path.write_bytes(content)
    code, out, err = told(capsys, path)
    assert code == 1 and not out and str(path) in err


def test_a_reader_that_leaves_is_no_error(short, monkeypatch, capsys):
    left, output = os.pipe()
    os.close(left)
    with open(output, 'w') as closed:
        monkeypatch.setattr(sys, 'stdout', closed)
        assert inspect.main([str(short)]) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(('key', 'text'), [
    ('parameters', '[' * 100_000), ('parameters', '{"top.lambda1": 1e-320}'),
    ('begun_ns', str(10 ** 18)), ('history', '[[5, 1.0, 1.0], [4, 1.0, 1.0]]'),
    ('history', '[[1e300, 1.0, 1.0]]'), ('history', '[[0, 1, NaN]]')])
def test_odd_metadata_end_in_words(short, tmp_path, capsys, key, text):
    path = rewritten(short, tmp_path / 'odd.mcap', metadata={key: text})
    code, out, _ = told(capsys, path, '--verify')
    assert code in (0, 1) and '/pose' in out
    assert 'cannot be used' in out or 'motion 1' in out or 'cannot be followed' in out


@pytest.mark.parametrize('event', [
    {'event': 'command', 'l3': math.nan, 'lz': 1.0},
    {'event': 'command', 'sent_ns': 2 ** 63, 'l3': 1.0, 'lz': 1.0},
    {'event': []}, {'event': 'state', 'l3': 1.0, 'lz': 1.0},
    {'event': 'reset', 'parameters': {}, 'epoch_ns': 10 ** 18}])
def test_an_odd_entry_of_the_journal_is_told(short, tmp_path, capsys, event):
    """It is left out: the run is followed to its end all the same."""
    data = journal.event(**{'name': event['event'], 't_ns': 0, 'sent_ns': 300_000_000, **{
        name: value for name, value in event.items() if name != 'event'}})
    path = rewritten(short, tmp_path / 'odd.mcap', lambda topic, number, old: (
        [old, data] if topic.endswith('/events') and number == 1 else old))
    code, content = as_json(capsys, path, '--verify')
    assert code == 1 and len(content['motions']) >= 2
    assert any('entry at 1.300000000 s: ' in note or 'cannot be followed' in note
               for note in content['notes'])


def test_a_run_that_no_log_of_its_size_holds_is_not_computed(
        short, tmp_path, capsys, monkeypatch):
    """A stamp of the year 2096: neither 10^12 samples nor 10^12 steps."""
    path = rewritten(short, tmp_path / 'late.mcap', stamp=lambda topic, number, stamp_ns: (
        4 * 10 ** 18 if (topic, number) == ('/pose', 50) else stamp_ns))
    code, out, _ = told(capsys, path, '--verify')
    assert code == 1 and 'lacks most samples of this run' in out
    monkeypatch.setattr(recorded_run, 'STEPS_A_BYTE', 0)        # they would take a minute
    t_ns = 3_999_999_998_000_000_000
    far = journal.event('command', t_ns, t_ns, l3=1.7, lz=1.4)
    path = rewritten(short, tmp_path / 'far.mcap', lambda topic, number, data: (
        far if topic.endswith('/events') and number == 1 else data),
        stamp=lambda topic, number, stamp_ns: (
            4 * 10 ** 18 if topic.endswith('/events') and number == 1 else stamp_ns))
    assert 'integration steps are too many' in told(capsys, path)[1]


def test_topics_are_known_by_their_names_in_a_log_put_together_anew(stepped):
    with LogReader(stepped) as reader:
        run = recorded_run.read_run_description(reader)
        found = recorded_run._topics(reader.topics[::-1], run.values_at_recording)
    assert found.items() > run.topics.items()
    assert {*found} - {*run.topics} == {'~/commands', '~/events'}


# ---------------------------------------------------------------------------------- pictures


def test_pictures_are_drawn(short, tmp_path, capsys):
    pytest.importorskip('matplotlib')
    image = pytest.importorskip('PIL.Image')
    page, film = tmp_path / 'page.png', tmp_path / 'top.gif'
    assert told(capsys, short, '--plot', page, '--animate', film)[0] == 0
    pixels = np.asarray(image.open(page).convert('L'))
    assert min(pixels.shape) > 600 and 0.02 < np.mean(pixels < 250) < 0.5
    frames = image.open(film)
    assert frames.n_frames == 7 and frames.info['duration'] == 50 and frames.width == 640
    assert film.stat().st_size < 400_000
    shown = []
    for number in (0, 6):
        frames.seek(number)
        shown.append(np.asarray(frames.convert('RGB'), int))
    assert np.mean(np.abs(shown[1] - shown[0]).max(axis=2) > 30) > 0.01


@pytest.mark.parametrize('option', ['--plot', '--animate'])
def test_pictures_overwrite_nothing_and_an_interrupted_one_leaves_no_file(
        short, tmp_path, capsys, monkeypatch, option):
    plots = pytest.importorskip('spinning_top_sim.tools.plots')
    path = tmp_path / 'keep'
    path.write_text('precious')
    code, out, err = told(capsys, short, option, path)
    assert (code, out, path.read_text()) == (1, '', 'precious')
    assert err == (f'spinning-top inspect: cannot write {path}: it exists, and nothing is '
                   'overwritten\n')

    def interrupted(*arguments):
        arguments[-1].write_text('a part')
        raise KeyboardInterrupt

    path.unlink()
    monkeypatch.setattr(plots, {'--plot': 'draw_page', '--animate': 'animate'}[option],
                        interrupted)
    assert told(capsys, short, option, path)[0] == 130
    assert not any(tmp_path.iterdir())


def test_without_matplotlib_there_is_a_hint(short, tmp_path, capsys, monkeypatch):
    for name in ('matplotlib', 'matplotlib.animation', 'matplotlib.figure'):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, 'spinning_top_sim.tools.plots', raising=False)
    monkeypatch.delattr(tools, 'plots', raising=False)
    code, out, err = told(capsys, short, '--plot', tmp_path / 'page.png')
    assert code == 1 and "pip install 'matplotlib" in err
    assert len(err.splitlines()) == 1
    assert 'motion 2' in out                            # the rest is told all the same


def test_neither_ros_nor_scipy_nor_pictures_are_imported_unasked(short, tmp_path):
    code = ('import sys\nfrom spinning_top_sim.tools import inspect, simulate\n'
            f'simulate.main(["-o", {str(tmp_path / "run.csv")!r}, "--duration", "1"])\n'
            'early = sorted({"scipy"} & set(sys.modules))\n'
            f'inspect.main([{str(short)!r}, "--verify"])\n'
            'print("loaded:", early, sorted({"rclpy", "matplotlib"} & set(sys.modules)))')
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                         timeout=60, check=True)
    assert run.stdout.strip().endswith('loaded: [] []')


def test_a_folder_with_one_log_is_that_log(short, tmp_path, capsys):
    (tmp_path / 'bag').mkdir()
    assert inspect.main([str(tmp_path / 'bag')]) == 1
    assert capsys.readouterr().err == (
        f'spinning-top inspect: cannot read {tmp_path}/bag: a folder must hold one .mcap file; '
        'in it: none\n')
    (tmp_path / 'bag/bag_0.mcap').symlink_to(short)
    assert inspect.main([str(tmp_path / 'bag')]) == 0
    assert capsys.readouterr().out.startswith(f'{tmp_path}/bag/bag_0.mcap: whole')
