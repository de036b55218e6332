# SPDX-License-Identifier: Apache-2.0
"""
`inspect`: the truth about a log, from logs that other tests trust and from damaged copies.

What is measured is compared with the closed form, which test_exact.py holds against 30 digits.
"""

import json
import os
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
from helpers.inspected import as_json, log_of, rewritten, told
from helpers.reference import ROOT, SCENES
from helpers.simulations import SECOND
from mcap.writer import Writer

from spinning_top_sim.streams.events import Event
from spinning_top_sim.tools import inspect

# The tilt rests, or nearly: there is no nutation in the data.
RESTING = {'sleeping', 'steady_fast', 'steady_slow'}


@pytest.mark.parametrize('scene', SCENES)
def test_every_scene_is_measured_from_its_data(tmp_path, capsys, scene):
    duration = 20 if scene in ('near_separatrix', 'waking_sleeper') else 4
    _, content = as_json(capsys, log_of(
        tmp_path / 'run.mcap', '--params', ROOT / f'config/{scene}.yaml', '--duration', duration,
        '-p', f'solver.method:={"rk45" if scene == "cusp" else "exact"}', '-p',
        "record.streams:=['joint_states', 'ground_truth_imu']"))
    motion, = content['motions']
    truth, measured = motion['exact'], motion['measured']
    if scene in RESTING:
        assert measured['nutation_period'] is None and measured['nutations'] == 0
    else:
        assert measured['nutations'] >= 2
        assert measured['nutation_period'] == pytest.approx(truth['nutation_period'], rel=1e-9)
    assert measured['mean_precession_rate'] == pytest.approx(
        truth['mean_precession_rate'], rel=1e-9, abs=1e-9 if scene == 'free_top' else 0.0)
    assert measured['mean_spin_rate'] == pytest.approx(truth['mean_spin_rate'], rel=1e-9)
    assert not measured['missing']


def test_a_motion_ends_where_its_stamps_jump(short, tmp_path, capsys):
    """Behind that, a command that the samples do not obey."""
    jump, command = (event.entries()[0][1] for event in (
        Event('epoch', 400_000_000, 400_000_000, {'epoch_ns': 3 * SECOND}),
        Event('command', 450_000_000, 450_000_000, {'l3': 1.0, 'lz': 1.0})))
    path = rewritten(short, tmp_path / 'run.mcap', lambda topic, number, data: (
        [data, jump, command] if topic.endswith('/events') and number == 1 else data),
        stamp=lambda topic, number, stamp_ns: stamp_ns + 2 * SECOND * (
            stamp_ns > 1_400_000_000 or (topic.endswith('/events') and number == 1)))
    *motions, last = as_json(capsys, path)[1]['motions']
    assert [motion['cause'] for motion in motions] == ['start', 'command', 'epoch']
    assert max(motion['orientation_error'] for motion in motions) < 1e-9
    assert last['begin_ns'] == motions[-1]['end_ns'] == 3_450_000_000


@pytest.mark.parametrize('topic', ['pose', 'ground_truth_imu', 'ground_truth_odom'])
def test_any_topic_with_an_attitude_measures_a_motion(tmp_path, capsys, topic):
    _, content = as_json(capsys, log_of(
        tmp_path / 'run.mcap', '--duration', 3, '-p', f'record.streams:=["{topic}"]',
        '-p', 'imu.rpy:=[0.3, -0.2, 1.1]', '-p', 'solver.method:=exact', '--namespace', '/one'))
    motion, = content['motions']
    for name in ('nutation_period', 'mean_precession_rate', 'mean_spin_rate'):
        assert motion['measured'][name] == pytest.approx(motion['exact'][name], rel=1e-9), name
    assert motion['orientation_error'] < 1e-14
    assert len(motion['drifts']) == (0 if topic == 'pose' else 3)
    assert all(drift < 1e-14 for drift in motion['drifts'].values())


def test_a_nutation_faster_than_the_samples_is_not_measured_as_a_slow_one(tmp_path, capsys):
    rate = 1.65
    _, content = as_json(capsys, log_of(
        tmp_path / 'run.mcap', '--duration', 100, '-p', f'joint_states.rate:={rate}', '-p',
        'record.streams:=[joint_states]', '-p', 'solver.method:=exact'))
    motion, = content['motions']
    assert 1.0 < motion['exact']['nutation_period'] * rate < 1.1 and not motion['measured'][
        'nutation_period'] and 'fewer than 9 samples' in motion['measured']['missing']


def test_errors_and_drifts_are_those_in_the_data(stepped, tmp_path, capsys):
    """An angle and a rate that are off are told as such; one that is no number is left out."""
    def change(topic, number, data):
        factor, at = {10: (np.nan, -60), 20: (np.inf, -60), 250: (1.0 + 1e-6, -44),
                      260: (1.0 + 1e-3, -12)}.get(number, (1.0, -60))
        if topic != '/a/b/joint_states':
            return data
        end = len(data) + at + 8
        value, = struct.unpack('<d', data[end - 8:end])
        return data[:end - 8] + struct.pack('<d', factor * value) + data[end:]
    code, content = as_json(capsys, rewritten(stepped, tmp_path / 'run.mcap', change))
    assert code == 0
    *others, last = content['motions']
    assert 1e-6 < last['orientation_error'] < 1e-4
    assert 1e-4 < last['drifts']['l3'] < 1e-3 and last['measured']['nutations'] >= 1
    for motion in (motion for motion in others if motion['drifts']):
        assert motion['orientation_error'] < 1e-9
        assert 0.0 < motion['drifts']['energy'] < 1e-11 and motion['drifts']['l3'] < 1e-13


def test_the_longest_gap_of_a_topic_is_told_and_what_has_gaps_is_not_measured(
        short, tmp_path, capsys):
    path = rewritten(short, tmp_path / 'gap.mcap', lambda topic, number, data: (
        None if topic == '/joint_states' and number in (3, *range(10, 20)) else data))
    _, content = as_json(capsys, path)
    pose, joints = (content['topics'][name] for name in ('/pose', '/joint_states'))
    assert (joints['count'], joints['longest_gap_ns']) == (40, [1_090_000_000, 1_200_000_000])
    assert (pose['rate'], np.ptp(pose['longest_gap_ns'])) == (pytest.approx(100.0), 10_000_000)
    first, second = content['motions']
    assert first['measured'] is None and first['orientation_error'] < 1e-9
    assert second['measured']['samples'] == 20


def test_text_tells_the_numbers(stepped, tmp_path, capsys):
    ride = log_of(tmp_path / 'run.mcap', '--scene', 'shuttle', '--duration', 15)    # psi jumps
    assert re.search(r'closed form\n(.*\n){3}  mean_spin_rate +19\.\d+\n', told(capsys, ride)[1])
    text = told(capsys, stepped)[1]
    assert 'whole, 3 s' in text and '/a/b/ground_truth/imu' in text
    assert 'motion 3 (command), 1 to 2.0031 s: loops' in text
    assert re.search(r'nutation_period +0\.433970\d+ +0\.433970\d+ +-?\d\.\de-1\d\n', text)


def test_json_is_strict_and_documented(short, capsys):
    _, out, _ = told(capsys, short, '--json', '--verify')
    content = json.loads(out, parse_constant=pytest.fail)
    page = (ROOT / 'docs/logs.md').read_text()
    keys = set(content) | {key for name in ('damage', 'run', 'verify') for key in content[name]}
    motion = content['motions'][0]
    keys |= set(motion) | set(motion['measured']) | set(motion['exact'])
    keys |= set(content['topics']['/pose'])
    assert {key for key in keys if f'`{key}`' not in page} == set()
    stamp_ns, command = content['run']['events'][1]
    assert (stamp_ns, command['kind'], command['t_ns'], command['details']['l3']) == (
        1_300_000_000, 'command', 300_000_000, 1.7)


def test_a_strangers_log_is_listed_and_its_names_do_not_act_on_the_terminal(tmp_path, capsys):
    path, channels = tmp_path / 'stranger.mcap', []
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start()
        for name, kind in (('/thing', 'some/Thing'),
                           ('/\x1b[2J\u202e\x9b\nline', 'a/\x1b]0;b\x07')):
            channels.append(writer.register_channel(
                name, 'json', writer.register_schema(kind, 'jsonschema', b'{}')))
        for number in range(11):
            for channel in channels:
                writer.add_message(channel, number * 100_000_000, b'{}', 0)
        writer.finish()
    code, content = as_json(capsys, path)
    assert code == 0 and content['run'] is None
    thing = content['topics']['/thing']
    assert (thing['count'], thing['rate']) == (11, 10.0)
    code, out, _ = told(capsys, path)
    assert code == 0 and out.count('not recorded by spinning_top_sim') == 1
    assert out.replace('\n', '').isprintable()
    assert '/\\x1b[2J\\u202e\\x9b\\nline' in out and 'a/\\x1b]0;b\\x07' in out
    for option in ('--verify', f'--export=tum:{tmp_path / "a"}'):
        code, _, err = told(capsys, path, option)
        assert code == 1 and err.startswith('spinning-top inspect: it was not recorded by')
    code, _, err = told(capsys, path, '--plot', tmp_path / 'no.png')
    assert code == 1 and 'nothing to draw' in err and not (tmp_path / 'no.png').exists()


def test_pictures_are_drawn(short, tmp_path, capsys):
    pytest.importorskip('matplotlib')
    image = pytest.importorskip('PIL.Image')
    page, film = tmp_path / 'page.png', tmp_path / 'top.gif'
    assert told(capsys, short, '--plot', page, '--animate', film)[0] == 0
    pixels = np.asarray(image.open(page).convert('L'))
    assert min(pixels.shape) > 600 and 0.02 < np.mean(pixels < 250) < 0.5
    frames = image.open(film)
    assert frames.n_frames == 7 and frames.info['duration'] == 50 and frames.width == 640
    shown = []
    for number in (0, 6):
        frames.seek(number)
        shown.append(np.asarray(frames.convert('RGB'), int))
    assert np.mean(np.abs(shown[1] - shown[0]).max(axis=2) > 30) > 0.01


def test_a_plot_of_many_motions_is_of_the_first_and_says_so(stepped, tmp_path, capsys,
                                                            monkeypatch):
    pytest.importorskip('matplotlib')
    for seconds, title in ((20.0, '4 motions, up to 3 s of 3 s'),
                           (0.5, '4 motions, up to 0.51 s of 3 s')):
        monkeypatch.setattr(inspect, 'PLOTTED_S', seconds)
        path = tmp_path / f'{seconds}.svg'
        assert told(capsys, stepped, '--plot', path)[0] == 0
        assert re.findall('<!-- stepped.mcap: . of (.*) -->', path.read_text()) == [title]


@pytest.mark.parametrize('options', [
    ('--animate', 'a.png'), ('--export', 'tum:./a.png'),
    ('--export', 'tum:b', '--export', 'euroc_imu:sub/../b')])
def test_two_outputs_are_two_files(short, tmp_path, capsys, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'sub').mkdir()
    code, _, err = told(capsys, short, '--plot', 'a.png', *options)
    assert code == 2 and err.endswith(': must be different files\n')
    assert [path.name for path in tmp_path.iterdir()] == ['sub']


def test_without_a_reader_of_the_output_all_is_done_and_nothing_is_imported_unasked(
        short, tmp_path):
    torn = tmp_path / 'torn.mcap'
    torn.write_bytes(short.read_bytes()[:-100])
    code = ('import sys\nfrom spinning_top_sim.tools import inspect, simulate\n'
            f'simulate.main(["-o", {str(tmp_path / "run.csv")!r}, "--duration", "1"])\n'
            'early = {"scipy"} & set(sys.modules)\n'
            f'code = inspect.main([{str(torn)!r}, "--verify"])\n'
            'print(code, *early, *({"rclpy", "matplotlib"} & set(sys.modules)), file=sys.stderr)')
    ours, theirs = os.pipe()
    os.close(ours)
    ended = subprocess.run([sys.executable, '-c', code], stdout=theirs, stderr=subprocess.PIPE,
                           timeout=60, check=True)
    os.close(theirs)
    assert ended.stderr == b'1\n'
