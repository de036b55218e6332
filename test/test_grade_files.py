# SPDX-License-Identifier: Apache-2.0
"""`spinning-top grade FILE`: what is read, what is refused and how; logs; the top of a log."""

import json
import re

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
T = BODY.t
NS = np.rint(1e9 * T).astype(np.int64) + 1_700_000_000_123_456_789
VALUES = {name: column for kind, (_, values) in told(BODY).items()
          for name, column in zip(PARTS[kind][0], values.T, strict=True)}
MAKE = {name.rpartition('/')[2]: one for name, one in JAZZY.types.items()}


def table(path, columns, separator=',', head=''):
    rows = [separator.join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('\n'.join([head + separator.join(columns), *rows]) + '\n')
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
    np.savez(tmp_path / 'b.npz', t=T, gx=T[1:])
    with pytest.raises(ValueError, match=r'columns have \[599, 600\] rows'):
        read(tmp_path / 'b.npz')
    brackets = {'t [ns]': NS, **{f'{name} [{next(iter(PARTS[kind][1]))}]': VALUES[name]
                                 for kind in told(BODY) for name in PARTS[kind][0]}}
    for path in (table(tmp_path / 'a.csv', columns), tmp_path / 'a.parquet', tmp_path / 'a.npz',
                 table(tmp_path / 'b.txt', columns, ' ', '# '), table(
                     tmp_path / 'c.csv', columns, ';'), table(tmp_path / 'd.txt', brackets, '|')):
        same(read(path))


def test_columns_and_units_are_said_by_name_also_in_a_file(tmp_path):
    foreign = {'frame': range(len(T)), 'ax': 0.0 * T, 'sec': NS // 10 ** 9, 'nsec': NS % 10 ** 9,
               **{f'rot[{k}]': VALUES[name] for k, name in enumerate(('qw', 'qx', 'qy', 'qz'))},
               **{f'gyro_{axis} (deg/s)': np.degrees(VALUES[f'g{axis}']) for axis in 'xyz'},
               **{f'acc {axis}': VALUES[f'a{axis}'] / 9.80665 for axis in 'xyz'}}
    said = ('t=sec:s+nsec:ns, qw=rot[0], qx=rot[1], qy=rot[2]:1, qz=rot[3]\n' + ', '.join(
        f'g{axis}=gyro_{axis} (deg/s), a{axis}=acc {axis}:g' for axis in 'xyz'))
    (tmp_path / 'columns').write_text(said)
    for text in (said, str(tmp_path / 'columns')):
        recorded = read(table(tmp_path / 'a.csv', foreign), text)
        same(recorded, ('attitudes', 'gyroscope', 'accelerations'))
        assert recorded.notes[-1] == 'not used: frame, ax'
    assert 'accelerations of acc x [g], acc y [g], acc z [g]: 600 rows, 200' in str(recorded.notes)
    assert 'the first time is 1700000000.123456789 s' in recorded.notes
    rows = table(tmp_path / 'c.csv', {'stamp': NS, **VALUES}).read_text().split('\n', 1)[1]
    (tmp_path / 'c.csv').write_text(rows)
    same(read(tmp_path / 'c.csv', 't=column 1:ns, qw=column 5, qx=column 2, qy=column 3, '
              'qz=column 4'), ('attitudes',))


def test_what_tum_and_euroc_define_is_read(tmp_path):
    path = table(tmp_path / 'a.tum', {'timestamp': T + 1.7e9, **{
        f't{axis}': VALUES[f'p{axis}'] for axis in 'xyz'}, **{
        f'q{axis}': VALUES[f'q{axis}'] for axis in 'xyzw'}}, ' ', '# ground truth\n# ')
    for text in (path.read_text(), path.read_text().split('\n', 2)[2]):
        path.write_text(text)
        times, attitudes = read(path).parts['attitudes']
        assert times == pytest.approx(T, abs=3e-7) and len(attitudes) == len(T)
    said = ', '.join(f'q{axis}=column {k}' for k, axis in enumerate('xyzw', 5))
    assert {*read(path, f't=column 1, {said}').parts} == {'attitudes'}
    table(tmp_path / 'mav0/state_groundtruth_estimate0/data.csv', {
        '#timestamp': NS, **{f' p_RS_R_{axis} [m]': VALUES[f'p{axis}'] for axis in 'xyz'},
        **{f' q_RS_{axis} []': VALUES[f'q{axis}'] for axis in 'wxyz'}})
    path = table(tmp_path / 'mav0/imu0/data.csv', {'timestamp [ns]': NS, **{
        f'{name}_RS_S_{axis} [{unit}]': VALUES[f'{ours}{axis}'] for name, unit, ours in (
            ('w', 'rad s^-1', 'g'), ('a', 'm s^-2', 'a')) for axis in 'xyz'}})
    (tmp_path / 'mav0/imu0/sensor.yaml').touch()
    same(recorded := read(tmp_path / 'mav0'))
    assert 'not used: imu0/sensor.yaml' in recorded.notes
    assert main([str(tmp_path)]) == 0
    for clock in ('17036', '16036'):
        path.write_text(re.sub('(?m)^1[67]0..', clock, path.read_text()))
        with pytest.raises(ValueError, match='must be of one clock'):
            read(tmp_path / 'mav0')


TEXT = 't,qw,qx,qy,qz,gx,gy,gz\n' + ''.join(f'{k / 100},1,0,0,0,{k},2,3\n' for k in range(25))


@pytest.mark.parametrize(('old', 'new', 'said', 'words'), [
    ('t,', 'stamp,', None, "say --columns 't=COLUMN:UNIT', each UNIT one of s, ms, us, ns; "
     "or leave a part out, such as 'ax=, ay=, az='; the file has stamp, qw"),
    ('gx', 'gx_dps', 'gy=', "'gx=gx_dps:UNIT, gy=gy:UNIT', each UNIT one of rad/s, mrad/s, deg/s"),
    ('gx,gy,gz', 'gx_dps,g_y,GZ', None, "'gx=gx_dps:UNIT, gy=g_y:UNIT, gz=GZ:UNIT', each UNIT"),
    ('gx', 'gx [°/s]', None, "--columns 'gx=gx [°/s]:°/s': the unit must be one of rad/s"),
    ('qw,qx,qy,qz,gx,gy', 'ref_qw,qx,qy,qz,sim_qw,gy', None, 'qw=ref_qw or sim_qw:UNIT'),
    ('gy', 'gx [deg/s]', None, 'gx=gx or gx [deg/s]:UNIT, gy=COLUMN:UNIT'),
    ('', '', 't=t:us', "25 rows of attitudes, 1e-08 s apart: must be 20 at least, 1e-05 to 0.5 s "
     "apart; the unit of times in a table: --columns 't=COLUMN:UNIT'"),
    ('0.2,', '0.1,', None, 'line 22: attitudes are at 0.1 s after 0.19 s: must ascend'),
    ('0.02,', '0.01,', None, 'line 4: gyroscope are at 0.01 s after 0.01 s: must ascend'),
    ('1,0,', '1.5,0,', None, 'line 2: |q| = 1.5: must be 1'),
    *((',2,', f',{cell},', None, f"line 2: gy = '{cell}': must be a number such as -12.5")
      for cell in ('1_0', '1e400', 'deg/s', '-1;5')),
    *(('0.0,', f'{cell},', None, f"line 2: t = '{cell}': must be a number such as -12.5")
      for cell in ('', 'nan', '2026-01-31T12:00:00')),
    ('', '', 'gx=gyro_x', "'gyro_x': must be one of t, qw, qx"),
    *(('', '', said, 'must be NAME=COLUMN:UNIT, with each NAME once, of t, qx')
      for said in ('speed=gx', 'gx=gx,gx=gy')),
    ('gx,gy,gz', 'wx,wy,wz', None, "'gx=COLUMN:UNIT, ...'); times of column t [s]"),
    (',3\n', ',3,4\n', None, 'line 2 has 9 values, and there are 8 columns'),
    (TEXT[:23], f'Take,1,s\n\n{TEXT[:23]}', None, 'numbers begin in line 4: keep it and a line'),
    ('gy', 'gx', None, 'two columns are called gx: each needs a name of its own; w'),
    (TEXT[TEXT.index('0.19'):], '', None, '19 rows of attitudes, 0.01 s apart: must be 20'),
    (TEXT, '', None, "say --columns 't=COLUMN"),
    ('gx', b'gx [\xb0/s]', None, 'no text in UTF-8: convert it'),
    (TEXT, f't,"{"x" * (1 << 18)}"', None, 'field larger than field limit'),
    ('a.csv', 'a.npz', None, 'is no file of numpy.savez'),
    ('a.csv', 'a.doc', None, 'must be .mcap, or a table .csv')])
def test_what_is_not_understood_is_refused_in_a_line_that_says_what_to_type(
        tmp_path, capsys, old, new, said, words):
    path = tmp_path / (new if old == 'a.csv' else 'a.csv')
    path.write_bytes(TEXT.encode().replace(
        old.encode(), new if isinstance(new, bytes) else new.encode(), 1))
    assert main([str(path), *(['--columns', said] if said else [])]) == 2
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1 and words in err and str(path) in err


def test_rows_that_are_there_twice_and_empty_cells_are_noted_or_left_out(tmp_path):
    rows = {'t': T, **VALUES}
    twice = {name: np.repeat(values, 2) for name, values in rows.items()}
    recorded = read(table(tmp_path / 'a.csv', twice))
    same(recorded)
    assert 'attitudes: 600 rows are there twice: used once' in recorded.notes
    cells = {**rows, 'ay': [value if k % 2 else '' for k, value in enumerate(rows['ay'])],
             'gx_bias': T}
    recorded = read(table(tmp_path / 'b.csv', cells))
    assert [len(recorded.parts[kind][0]) for kind in ('accelerations', 'gyroscope')] == [300, 600]
    assert 'not used: gx_bias' in recorded.notes
    del rows['ax']
    same(read(table(tmp_path / 'c.csv', {**rows, 'ax_world': T}), 'ax=, ay=, az='),
         ('attitudes', 'positions', 'gyroscope'))


def log(path, *names, late=0):
    """Write a log of another program: readings, and a body and a camera at rest by topics."""
    types, rows = ['tf2_msgs/msg/TFMessage'] * len(names) + ['sensor_msgs/msg/Imu'], []
    for k, stamp in enumerate(NS.tolist()):
        header = MAKE['Header'](MAKE['Time'](*divmod(stamp, 10 ** 9)), 'world')
        place, turn = ([VALUES[f'{name}{axis}'][k] for axis in axes]
                       for name, axes in (('p', 'xyz'), ('q', 'xyzw')))
        moves = MAKE['TFMessage']([MAKE['TransformStamped'](header, child, MAKE['Transform'](
            MAKE['Vector3'](*p), MAKE['Quaternion'](*q))) for child, p, q in (
                ('camera', np.zeros(3), (0.0, 0.0, 0.0, 1.0)), ('body', place, turn))])
        rates, force = (MAKE['Vector3'](*(VALUES[f'{name}{axis}'][max(k - late, 0)]
                                          for axis in 'xyz')) for name in 'ga')
        reads = MAKE['Imu'](header, MAKE['Quaternion'](0.0, 0.0, 0.0, 1.0), -np.eye(3).ravel(),
                            rates, np.zeros(9), force, np.zeros(9))
        rows += [(number, stamp + 3_000_000, bytes(JAZZY.serialize_cdr(one, types[number])))
                 for number, one in enumerate([moves] * len(names) + [reads])]
    return str(write_rows(path, [*map(RecordedTopic, (*names, '/imu'), types)], rows))


def test_logs_of_other_programs_are_graded_and_a_choice_is_asked_for(tmp_path, capsys):
    choice = ['--topic', '/tf:body']
    assert main([log(tmp_path / 'a.mcap', '/tf', late=1), *choice, '--json']) == 1
    said = json.loads(capsys.readouterr().out)
    assert said['faults'] == ['late']
    assert 'attitudes of /tf:body: 600 rows, 200 Hz, from 0 to 2.995 s' in said['notes']
    path = log(tmp_path / 'b.mcap', '/tf')
    assert main([path, *choice, '-p', 'top.gravity:=1.62']) == 1
    assert 'b.mcap: gravity\n' in capsys.readouterr().out
    both = log(tmp_path / 'c.mcap', '/tf', '/odometry')
    for options, code, says in (
            ([], 2, '/odometry:camera, /odometry:body: choose by --topic /tf:camera'),
            (choice, 0, 'not used: /odometry:body, /odometry:camera, /tf:camera'),
            (['--topic', '/pos'], 2, '--topic /pos: the log has /imu, /odometry:body')):
        assert main([both, *options]) == code
        assert says in ''.join(capsys.readouterr())


def test_a_log_of_this_package_is_graded_against_its_own_exact_motion(
        tmp_path, capsys, monkeypatch):
    path = str(tmp_path / 'run.mcap')
    assert simulate(['--quiet', '-o', path, '--duration', '4', '--scene', 'looping', '--command',
                     '3:1.5:1.4', '--imu', 'bmi088', '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]', '-p',
                     'imu.rpy:=[0.3, 0.1, -1.0]', '-p',
                     'pivot.path:=[1.0, 2.0, 0.5, 1.0, 1.0, -2.0, 0.0, -1.0]']) == 0
    capsys.readouterr()
    assert main([path, '--json']) == 0
    said = json.loads(capsys.readouterr().out)
    assert said['marks']['total_error_deg']['value'] < 1e-7
    assert 'read up to the first event, at 4.000000000 s' in said['notes']
    assert main([path, '--topic', '/imu/data_raw']) == 1
    assert '  bias: gyroscope' in capsys.readouterr().out
    assert main([path, '-p', 'top.mass:=2.1']) == 1
    assert '  inaccurate: the attitude is up to' in capsys.readouterr().out
    monkeypatch.setattr('spinning_top_sim.grade.command.TOLERANCE', -1.0)
    assert main([path, '-p', 'imu.rpy:=[0.0, 0.0, 0.0]']) == 1
    out = capsys.readouterr().out
    assert 'mounting: gyroscope: the axes of the readings are turned by' in out
    assert 'inaccurate: the attitude is up to' in out


TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
START = State(theta=0.5235987755982988, l3=1.6, lz=1.3)         # config/looping.yaml


def of_top(path, t, q, *force):
    """Return the options that grade a table of a top."""
    names = 't', 'qx', 'qy', 'qz', 'qw', 'ax', 'ay', 'az'
    return [str(table(path, dict(zip(names, np.column_stack((t, q, *force)).T, strict=False)))),
            '--scene', 'looping']


def test_the_lever_arm_of_a_scene_that_has_none_is_found_without_positions(tmp_path, capsys):
    motion = solve(TOP, START, T)
    w, arm = motion.angular_velocity, (0.1, 0.0, 0.2)
    force = (Rotation.from_quat(motion.quaternion).inv().apply((0.0, 0.0, TOP.gravity))
             + np.cross(motion.angular_acceleration, arm) + np.cross(w, np.cross(w, arm)))
    options = of_top(tmp_path / 'a.csv', T, motion.quaternion, force)
    assert main(options) == 0
    assert re.search('lever_arm_z +0.2 ', capsys.readouterr().out)
    assert main([*options, '--lever-arm', '0.1', '0', '0.1']) == 1


@pytest.mark.parametrize(('chosen', 'turned', 'code', 'says'), [
    (slice(None), 0.0, 0, 'total_error_deg'),
    (slice(100, None), 0.0, 0, 'another start than the one that is given'),
    (slice(None), np.random.default_rng(2).normal(0.0, 2e-3, (len(T), 3)), 0, 'passed, in what'),
    (slice(None), np.outer(T ** 2, (0.02, 0.0, 0.0)), 1, 'inaccurate'),
    (slice(None, None, 29), 0.0, 1, 'nothing was judged\n'),
    (slice(59), 0.0, 1, 'not judged: the motion')])
def test_poses_of_a_top_that_is_known_are_graded_without_readings(
        tmp_path, capsys, chosen, turned, code, says):
    q = (Rotation.from_quat(solve(TOP, START, T).quaternion) * Rotation.from_rotvec(
        turned + np.zeros((len(T), 3)))).as_quat()
    assert main(of_top(tmp_path / 'a.csv', T[chosen], q[chosen])) == code
    out = capsys.readouterr().out
    assert says in out and 'not judged: gyroscope: there is none' in out
