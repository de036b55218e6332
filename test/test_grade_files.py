# SPDX-License-Identifier: Apache-2.0
"""`spinning-top grade FILE`: what is read, what is refused and how; logs; the top of a log."""

import json

import numpy as np
import pytest
from helpers.bodies import body, told
from helpers.recordings import JAZZY, write_rows
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top, solve
from spinning_top_sim.grade.command import main
from spinning_top_sim.grade.files import PARTS, read
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.tools.simulate import main as simulate

BODY = body(0, noisy=False, seconds=3.0, kind='forced', rate=200.0)
DECLARED = BODY.noise['accelerations'] ** 2 * np.eye(3).ravel()
T = BODY.t
NS = np.rint(1e9 * T).astype(np.int64) + 1_700_000_000_123_456_789
VALUES = {name: column for kind, (_, values) in told(BODY).items()
          for name, column in zip(PARTS[kind][0], values.T, strict=True)}
POSES = {name: VALUES[name] for name in ('px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')}
IMU = {name: VALUES[name] for name in ('gx', 'gy', 'gz', 'ax', 'ay', 'az')}
MAKE = {name.rpartition('/')[2]: one for name, one in JAZZY.types.items()}


def table(path, columns, separator=',', head='', lines=()):
    rows = [separator.join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n'.join([head + separator.join(columns), *lines, *rows]) + '\n')
    return path


def same(recorded, kinds=('attitudes', 'positions', 'gyroscope', 'accelerations')):
    """Assert that what is read is the motion of BODY."""
    assert {*recorded.parts} == {*kinds}
    for kind in kinds:
        times, values = recorded.parts[kind]
        assert times == pytest.approx(T, abs=2e-9), kind
        right = np.stack([VALUES[name] for name in PARTS[kind][0]], axis=1)
        assert values == pytest.approx(right, abs=1e-9), kind


def test_the_table_is_read_in_any_format(tmp_path):
    columns = {'t': T, **VALUES}
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

    parquet.write_table(pa.table(columns), tmp_path / 'a.parquet')
    np.savez(tmp_path / 'a.npz', **columns)
    brackets = {'t [ns]': NS, **{f'{name} [{next(iter(PARTS[kind][1]))}]': VALUES[name]
                                 for kind in told(BODY) for name in PARTS[kind][0]}}
    for path in (table(tmp_path / 'a.csv', columns), tmp_path / 'a.parquet', tmp_path / 'a.npz',
                 table(tmp_path / 'b.txt', columns, ' ', '# '), table(
                     tmp_path / 'c.csv', columns, ';'), table(tmp_path / 'd.csv', brackets)):
        same(read(path))


def test_columns_and_units_are_said_by_name_also_in_a_file(tmp_path):
    foreign = {'frame': range(len(T)), 'sec': NS // 10 ** 9, 'nanosec': NS % 10 ** 9, 'time': T,
               **{f'rot_{k}': POSES[name] for k, name in enumerate(('qw', 'qx', 'qy', 'qz'))},
               **{f'gyro_{axis} (deg/s)': np.degrees(IMU[f'g{axis}']) for axis in 'xyz'},
               **{f'acc {axis}': IMU[f'a{axis}'] / 9.80665 for axis in 'xyz'}, 'ax': 0.0 * T}
    said = ('t=sec:s+nanosec:ns, qw=rot_0, qx=rot_1, qy=rot_2:1, qz=rot_3\n' + ', '.join(
        f'g{axis}=gyro_{axis} (deg/s), a{axis}=acc {axis}:g' for axis in 'xyz'))
    (tmp_path / 'columns').write_text(said)
    for text in (said, str(tmp_path / 'columns')):
        recorded = read(table(tmp_path / 'a.csv', foreign), text)
        same(recorded, ('attitudes', 'gyroscope', 'accelerations'))
        assert recorded.notes[-1] == 'not used: frame, time, ax'
    assert 'accelerations of acc x:g, acc y:g, acc z:g: 600 rows, 200' in str(recorded.notes)
    dates = {'stamp': [f'{np.datetime64(ns, "ns")}+01:00' for ns in NS.tolist()], **VALUES}
    same(read(table(tmp_path / 'b.csv', dates), 't=stamp:iso'))


def test_what_tum_and_euroc_define_is_read(tmp_path):
    tum = {'t': T + 1.7e9, **{name: POSES[name] for name in (
        'px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')}}
    path = table(tmp_path / 'a.tum', tum, ' ')
    for head in ('', '# ground truth\n# timestamp tx ty tz qx qy qz qw\n'):
        path.write_text(head + path.read_text().partition('\n')[2])
        times, attitudes = read(path).parts['attitudes']
        assert times == pytest.approx(T[-len(times):] - T[-len(times)], abs=3e-7)
        assert len(attitudes) == len(times) > 590
    table(tmp_path / 'mav0/state_groundtruth_estimate0/data.csv', {
        '#timestamp': NS, **{f' {name} [{unit}]': POSES[ours] for name, unit, ours in (
            ('p_RS_R_x', 'm', 'px'), ('p_RS_R_y', 'm', 'py'), ('p_RS_R_z', 'm', 'pz'),
            ('q_RS_w', '', 'qw'), ('q_RS_x', '', 'qx'), ('q_RS_y', '', 'qy'),
            ('q_RS_z', '', 'qz'))}})
    table(tmp_path / 'mav0/imu0/data.csv', {'timestamp [ns]': NS, **{
        f'{name}_RS_S_{axis} [{unit}]': IMU[f'{ours}{axis}'] for name, unit, ours in (
            ('w', 'rad s^-1', 'g'), ('a', 'm s^-2', 'a')) for axis in 'xyz'}})
    same(read(tmp_path / 'mav0'))
    assert main([str(tmp_path)]) == 0
    path = tmp_path / 'mav0/imu0/data.csv'
    path.write_text(path.read_text().replace('17000', '17036'))
    with pytest.raises(ValueError, match='must be of one clock'):
        read(tmp_path / 'mav0')


ROWS = {'t': T, **VALUES}


def named(**names):
    """Return the table with some columns under other names."""
    return {names.get(name, name): values for name, values in ROWS.items()}


@pytest.mark.parametrize(('content', 'said', 'words'), [
    (named(t='stamp'), None, "say --columns 't=COLUMN:UNIT', or NAME= for none, with a UNIT of s, "
     'ms, us, ns, iso; the file has stamp, qx'),
    (named(gx='gx_dps'), 'gy=, gz=', "'gx=gx_dps:UNIT, gy=gy:UNIT, gz=gz:UNIT', or NAME= for"),
    (named(gx='gx [°/s]', gy='Gy', gz='imu.g_z'), None, 'gx=gx [°/s]:UNIT, gy=Gy:UNIT, gz=imu.g_z'),
    ({'t': T, **{f'{set_}_{name}': POSES[name] for set_ in ('ref', 'sim') for name in POSES}},
     None, 'px=ref_px or sim_px:UNIT'),
    ({**ROWS, 'gx [deg/s]': T}, None, 'gx=gx or gx [deg/s]:UNIT'),
    ({**ROWS, 't': 1e3 * T}, None, "5 s apart: must be 20 at least, 1e-05 to 0.5 s apart; the unit "
     "of times in a table: --columns 't=COLUMN:UNIT'"),
    ({**ROWS, 't': np.append(T[:300], T[:300])}, None, 'line 302: attitudes are at 0 s after 1.495 '
     's: must ascend, one motion a file'),
    ({**ROWS, 't': np.round(T, 2)}, None, 'must ascend, one motion a file, with enough digits'),
    ({**ROWS, 'qw': 1.5 * POSES['qw']}, None, 'line 2: |q| = '),
    *(({**ROWS, 'gx': [cell] * len(T)}, None, f"line 2: gx = '{cell}': must be a number such as -1")
      for cell in ('1_0', '1e400', 'deg/s', '-1;5')),
    *(({**ROWS, 't': [cell] * len(T)}, said, f"line 2: t = '{cell}': must be a {right}")
      for cell, said, right in (
          ('2026-01-01T00:00:00', None, "number such as -12.5 (of dates say --columns 't=COLUMN:i"),
          ('', None, 'number'), ('1.1.2026', 't=t:iso', 'date such as 2026-01-31T12:00:00.5'))),
    (ROWS, 'gx=gyro_x', '--columns gyro_x: the file has t, qx'),
    (ROWS, 'gx=gx:rpm/s', 'unit must be one of rad/s, mrad/s, deg/s, dps, rpm'),
    (ROWS, 'speed=gx', 'must be NAME=COLUMN:UNIT, with each NAME once, of t, qx'),
    ({'t': T, **POSES, **{f'gyro_{a}_dps': T for a in 'xyz'}}, None, 'nothing to grade; times of '
     't:s; the first time is 0 s'),
    ('t,qw\n1,2\n1,2,3\n', None, 'line 3 has 3 values, and there are 2 columns'),
    ('1,2,3\n1,2,3\n', None, 'the file has column 1, column 2, column 3'),
    ('t,qw,qw\n1,2,3\n', None, 'two columns are called qw'),
    ('t,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n', None, '2 rows of attitudes, 1 s apart: must be 20'),
    ('t,qw,qx,qy,qz\n', None, '0 rows of attitudes'), ('', None, "say --columns 't=COLUMN"),
    ('t,qw [°]\n1,2\n'.encode('latin-1'), None, 'no text in UTF-8: convert it')])
def test_what_is_not_understood_is_refused_in_a_line_that_says_what_to_type(
        tmp_path, capsys, content, said, words):
    path = tmp_path / 'a.csv'
    if isinstance(content, dict):
        table(path, content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert main([str(path), *(['--columns', said] if said else [])]) == 2
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1
    assert words in err and 'a.csv' in err


@pytest.mark.parametrize(('name', 'words', 'code'), [
    ('none.csv', 'No such file', 1), ('text.npz', 'must be .mcap, or a table .csv', 2),
    ('text.mcap', '', 1)])
def test_what_is_no_such_file_is_told(tmp_path, capsys, name, words, code):
    path = tmp_path / name
    if name != 'none.csv':
        path.write_bytes(b'Dear all')
    assert main([str(path)]) == code
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1
    assert words in err and name in err


def test_rows_that_are_there_twice_and_empty_cells_are_noted_or_left_out(tmp_path):
    twice = {name: np.repeat(values, 2) for name, values in ROWS.items()}
    recorded = read(table(tmp_path / 'a.csv', twice))
    same(recorded)
    assert 'attitudes: 600 rows are there twice: used once' in recorded.notes
    cells = {**ROWS, 'ay': [value if k % 2 else '' for k, value in enumerate(ROWS['ay'])],
             'gx_bias': T}
    recorded = read(table(tmp_path / 'b.csv', cells))
    assert [len(recorded.parts[kind][0]) for kind in ('accelerations', 'gyroscope')] == [300, 600]
    assert 'not used: gx_bias' in recorded.notes
    same(read(table(tmp_path / 'c.csv', named(ax='ax_world')), 'ax=, ay=, az='),
         ('attitudes', 'positions', 'gyroscope'))


def vector(values, kind='Vector3'):
    return MAKE[kind](*map(float, values))


def message(kind, k, late, declared):
    """Return a message of a kind about sample k."""
    header = MAKE['Header'](MAKE['Time'](*divmod(int(NS[k]), 10 ** 9)), 'world')
    place = [POSES[name][k] for name in ('px', 'py', 'pz')]
    turn = vector((POSES[name][k] for name in ('qx', 'qy', 'qz', 'qw')), 'Quaternion')
    if kind == 'PoseStamped':
        return MAKE[kind](header, MAKE['Pose'](vector(place, 'Point'), turn))
    if kind == 'TFMessage':
        moves = MAKE['TransformStamped'](header, 'body', MAKE['Transform'](vector(place), turn))
        still = MAKE['TransformStamped'](header, 'camera', MAKE['Transform'](
            vector((0, 0, 0)), vector((0, 0, 0, 1), 'Quaternion')))
        return MAKE[kind]([still, moves])
    now, unknown = max(k - late, 0), np.zeros(9)
    return MAKE['Imu'](header, vector((0, 0, 0, 1), 'Quaternion'), np.array([-1.0, *unknown[1:]]),
                       vector(IMU[f'g{axis}'][now] for axis in 'xyz'), unknown,
                       vector(IMU[f'a{axis}'][now] for axis in 'xyz'), declared * DECLARED)


def log(path, poses, late=0, declared=1.0):
    """Write a log of another program: poses by topic and type, and readings."""
    topics = {**poses, '/imu': 'Imu'}
    types = {'PoseStamped': 'geometry_msgs/msg/PoseStamped', 'TFMessage': 'tf2_msgs/msg/TFMessage',
             'Imu': 'sensor_msgs/msg/Imu'}
    rows = [(number, stamp + 3_000_000, bytes(JAZZY.serialize_cdr(
        message(kind, k, late, declared), types[kind]))) for k, stamp in enumerate(NS.tolist())
        for number, kind in enumerate(topics.values())]
    return str(write_rows(path, [RecordedTopic(name, types[kind])
                                 for name, kind in topics.items()], rows))


def test_logs_of_other_programs_are_graded_and_a_choice_is_asked_for(tmp_path, capsys):
    assert main([log(tmp_path / 'a.mcap', {'/pose': 'PoseStamped'})]) == 0
    assert main([log(tmp_path / 'b.mcap', {'/tf': 'TFMessage'}, 1), '--json']) == 1
    out = capsys.readouterr().out
    said = json.loads('{' + out.partition('\n{')[2])
    assert said['faults'] == ['late']
    assert 'attitudes of /tf:body: 600 rows, 200 Hz, from 0 to 2.995 s' in said['notes']
    assert main([log(tmp_path / 'd.mcap', {'/pose': 'PoseStamped'}, declared=2.0)]) == 1
    assert 'noise_scale: accelerations' in capsys.readouterr().out
    both = log(tmp_path / 'c.mcap', {'/pose': 'PoseStamped', '/odometry': 'PoseStamped'})
    assert main([both]) == 2
    assert 'are in /pose, /odometry: choose by --topic /pose' in capsys.readouterr().err
    assert main([both, '--topic', '/pose']) == 0
    assert 'not used: /odometry' in capsys.readouterr().out
    assert main([both, '--topic', '/pos']) == 2
    assert '--topic /pos: the log has /imu, /odometry, /pose' in capsys.readouterr().err


PIVOT = 'pivot.path:=[1.0, 2.0, 0.5, 1.0, 1.0, -2.0, 0.0, -1.0]'


@pytest.mark.parametrize('options', [['-p', PIVOT], ['--imu', 'bmi088', '-p', PIVOT]])
def test_a_log_of_this_package_is_graded_against_its_own_exact_motion(tmp_path, capsys, options):
    path = str(tmp_path / 'run.mcap')
    assert simulate(['--quiet', '-o', path, '--duration', '4', '--scene', 'looping',
                     '--command', '3:1.5:1.4', *options, '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]',
                     '-p', 'imu.rpy:=[0.3, 0.1, -1.0]']) == 0
    capsys.readouterr()
    assert main([path, '--json']) == 0
    said = json.loads(capsys.readouterr().out)
    assert said['marks']['total_error_deg']['value'] < 1e-7
    assert any('up to the first event, at 4.000000000 s' in note for note in said['notes'])
    assert main([path, '--topic', '/imu/data_raw']) == ('--imu' in options)
    assert ('bias: gyroscope' in capsys.readouterr().out) == ('--imu' in options)
    assert main([path, '-p', 'imu.rpy:=[0.0, 0.0, 0.0]']) == 1
    assert 'mounting: gyroscope: the readings are in axes that are turned by' in (
        capsys.readouterr().out)


@pytest.mark.parametrize(('hz', 'says'), [
    (200.0, 'lever_arm_z                       0.2'),
    (4.0, 'not judged: the motion'), (1e3, 'not judged: the motion')])
def test_the_lever_arm_of_a_scene_that_has_none_is_found_and_few_poses_are_told(
        tmp_path, capsys, hz, says):
    t = np.arange(59 if hz > 200.0 else 300) / hz
    motion = solve(TOP, START, t)
    w, arm = motion.angular_velocity, (0.1, 0.0, 0.2)
    force = (Rotation.from_quat(motion.quaternion).inv().apply((0.0, 0.0, TOP.gravity))
             + np.cross(motion.angular_acceleration, arm) + np.cross(w, np.cross(w, arm)))
    columns = dict(zip(('t', 'qx', 'qy', 'qz', 'qw', 'ax', 'ay', 'az'), np.column_stack(
        (t, motion.quaternion, force)).T, strict=True))
    path = str(table(tmp_path / 'a.csv', columns))
    assert main([path, '--scene', 'looping']) == 0
    assert says in capsys.readouterr().out
    assert main([path, '--scene', 'looping', '--lever-arm', '0.1', '0', '0.1']) == (hz == 200.0)


TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
START = State(theta=0.5235987755982988, l3=1.6, lz=1.3)         # config/looping.yaml


@pytest.mark.parametrize(('change', 'code', 'says'), [
    (lambda q: q, 0, 'total_error_deg'),
    (lambda q: q[100:], 0, 'another start than the one that is given'),
    (lambda q: (Rotation.from_quat(q) * Rotation.from_rotvec(np.random.default_rng(2).normal(
        0.0, 2e-3, (len(q), 3)))).as_quat(), 0, 'passed'),
    (lambda q: q[:, [3, 0, 1, 2]], 1, 'convention: the motion: attitudes are told as w, x, y, z'),
    (lambda q: q * (1, 1, 1, -1), 1, 'convention: the motion: attitudes are told as conjugated'),
    (lambda q: (Rotation.from_quat(q) * Rotation.from_rotvec(
        T[:len(q), np.newaxis] ** 2 * (0.02, 0.0, 0.0))).as_quat(), 1, 'inaccurate')])
def test_poses_of_a_top_that_is_known_are_graded_without_readings(
        tmp_path, capsys, change, code, says):
    q = change(solve(TOP, START, T).quaternion)
    columns = {'t': T[:len(q)], **dict(zip(('qx', 'qy', 'qz', 'qw'), q.T, strict=True))}
    assert main([str(table(tmp_path / 'a.csv', columns)), '--scene', 'looping']) == code
    out = capsys.readouterr().out
    assert says in out and 'no readings: the IMU is not graded' in out
    if not code:                        # readings of a top need no positions
        force = 9.0 * np.sin(np.outer(columns['t'], (20.0, 30.0, 40.0)))
        columns |= dict(zip(('ax', 'ay', 'az'), force.T, strict=True))
        assert main([str(table(tmp_path / 'b.csv', columns)), '--scene', 'looping']) == 1
        assert 'inaccurate: accelerations' in capsys.readouterr().out
