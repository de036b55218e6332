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
from mcap.writer import Writer

from spinning_top_sim.tools import inspect, recover, simulate

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


@pytest.mark.parametrize('topic', ['pose', 'ground_truth_imu', 'imu_data'])
def test_any_topic_with_an_attitude_measures_a_motion(tmp_path, capsys, topic):
    _, content = as_json(capsys, log_of(
        tmp_path / 'run.mcap', '--duration', 3, '-p', f'record.streams:=["{topic}"]',
        '-p', 'imu_data.enabled:=true', '-p', 'imu.rpy:=[0.3, -0.2, 1.1]',
        '-p', 'solver.method:=exact', '--namespace', '/one'))
    motion, = content['motions']
    for name in ('nutation_period', 'mean_precession_rate', 'mean_spin_rate'):
        assert motion['measured'][name] == pytest.approx(motion['exact'][name], rel=1e-9), name
    assert max(error['max'] for error in content['orientation_error'].values()) < 1e-14
    drifts = [drift for drifts in content['drifts'].values() for drift in drifts.values()]
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
    ((), [[1_000_000_000, 1_500_000_000]])])
def test_missing_samples_are_told_where_they_are(short, tmp_path, capsys, kept, gaps):
    path = rewritten(short, tmp_path / 'gap.mcap', lambda topic, number, data: (
        None if topic == '/pose' and number not in kept else data))
    _, content = as_json(capsys, path)
    pose = content['topics']['/pose']
    assert (pose['missing'], pose['count']) == (51 - len(kept), len(kept))
    assert pose['gaps_ns'] == gaps
    assert all(topic['missing'] == 0 for name, topic in content['topics'].items()
               if topic['stream'] and name != '/pose')


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
    page = (ROOT / 'docs/logs.md').read_text()
    keys = set(content) | {key for name in ('damage', 'run', 'verify') for key in content[name]}
    keys |= set(content['motions'][0]) | set(content['motions'][0]['measured'])
    keys |= set(content['motions'][0]['exact']) | set(content['topics']['/pose'])
    assert {key for key in keys if f'`{key}`' not in page} == set()
    command = content['events'][1]
    assert (command['event'], command['t_ns'], command['stamp_ns'], command['l3']) == (
        'command', 300_000_000, 1_300_000_000, 1.7)


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
    assert code == 0 and content['ours'] is False
    assert content['topics']['/thing']['count'] == 11
    assert content['topics']['/thing']['rate'] == pytest.approx(10.0)
    code, out, _ = told(capsys, path)
    assert code == 0 and out.count('not recorded by spinning_top_sim') == 1
    assert out.replace('\n', '').isprintable()
    assert '/\\x1b[2J\\u202e\\x9b\\nline' in out and 'a/\\x1b]0;b\\x07' in out
    code, _, err = told(capsys, path, '--verify')
    assert code == 1 and err.startswith('spinning-top inspect: --verify: it was not recorded by')
    code, _, err = told(capsys, path, '--plot', tmp_path / 'no.png')
    assert code == 1 and 'nothing to draw' in err and not (tmp_path / 'no.png').exists()


@pytest.mark.parametrize(('key', 'text'), [
    ('parameters', '[' * 100_000), ('parameters', '{"top.lambda1": 1e-320}'),
    ('begun_ns', str(10 ** 18)), ('history', '[[5, 1.0, 1.0], [4, 1.0, 1.0]]'),
    ('history', '[[0, 1, NaN]]'), ('epoch_ns', 'NaN')])
def test_odd_metadata_end_in_words(short, tmp_path, capsys, key, text):
    path = rewritten(short, tmp_path / 'odd.mcap', metadata={key: text})
    code, out, _ = told(capsys, path, '--verify')
    assert code in (0, 1) and '/pose' in out
    assert 'cannot be used' in out or 'motion 1' in out or 'cannot be followed' in out


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


def test_samples_that_are_far_apart_are_drawn(tmp_path, capsys, monkeypatch):
    pytest.importorskip('matplotlib')
    pytest.importorskip('PIL.Image')
    monkeypatch.setattr(inspect, 'LONGEST_S', 0.1)
    log = log_of(tmp_path / 'run.mcap', '--duration', 2, '-p', 'record.streams:=[pose]',
                 '-p', 'pose.rate:=2.0')
    assert told(capsys, log, '--animate', tmp_path / 'top.gif')[0] == 0


@pytest.mark.parametrize('options', [
    ('--animate', 'a.png'), ('--export', 'tum:./a.png'),
    ('--export', 'tum:b', '--export', 'euroc_imu:sub/../b')])
def test_two_outputs_are_two_files(short, tmp_path, capsys, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'sub').mkdir()
    code, _, err = told(capsys, short, '--plot', 'a.png', *options)
    assert code == 2 and err.endswith(': must be different files\n')
    assert [path.name for path in tmp_path.iterdir()] == ['sub']


def test_without_a_reader_of_the_output_all_is_done_and_the_code_is_kept(short, tmp_path):
    torn, readings = tmp_path / 'torn.mcap', tmp_path / 'a.csv'
    torn.write_bytes(short.read_bytes()[:-100])
    ours, theirs = os.pipe()
    os.close(ours)
    ended = subprocess.run([sys.executable, '-m', 'spinning_top_sim', 'inspect', torn, '--verify',
                            f'--export=euroc_imu:{readings}'], stdout=theirs,
                           stderr=subprocess.PIPE, timeout=60, check=False)
    os.close(theirs)
    assert (ended.returncode, ended.stderr) == (1, b'') and readings.exists()


def test_neither_ros_nor_scipy_nor_pictures_are_imported_unasked(short, tmp_path):
    code = ('import sys\nfrom spinning_top_sim.tools import inspect, simulate\n'
            f'simulate.main(["-o", {str(tmp_path / "run.csv")!r}, "--duration", "1"])\n'
            'early = sorted({"scipy"} & set(sys.modules))\n'
            f'inspect.main([{str(short)!r}, "--verify"])\n'
            'print("loaded:", early, sorted({"rclpy", "matplotlib"} & set(sys.modules)))')
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                         timeout=60, check=True)
    assert run.stdout.strip().endswith('loaded: [] []')
