# SPDX-License-Identifier: Apache-2.0
"""`spinning-top grade FILE`: logs and tables of any program, the fit, errors in one line."""

import json
from functools import partial

import numpy as np
import pytest
from helpers.faulty_simulators import Stepped
from helpers.recordings import JAZZY, write_rows
from helpers.reference import ROOT
from scipy.spatial.transform import Rotation

from spinning_top_sim import State, Top, solve
from spinning_top_sim.grade.command import main, trajectory_of
from spinning_top_sim.grade.scenes import Start
from spinning_top_sim.recording.rosbag2 import RecordedTopic
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.tools import motion_files
from spinning_top_sim.tools.simulate import main as simulate

TOP = Top(lambda1=0.123, lambda3=0.15, mass=2.0, com_distance=0.15, gravity=9.80665)
START = State(theta=0.5235987755982988, l3=1.6, lz=1.3)         # config/looping.yaml
ARM = (0.1, -0.05, 0.2)
T = np.arange(600) / 200.0
MOTION = solve(TOP, START, T)
Q = MOTION.quaternion
RATES = MOTION.angular_velocity
FORCE = np.stack(np.broadcast_arrays(*MOTION.specific_force(ARM)), axis=1)
EXACT = ExactSolution(TOP, START)
NS = np.rint(1e9 * T).astype(np.int64) + 1_700_000_000_123_456_789
MAKE = {name.rpartition('/')[2]: one for name, one in JAZZY.types.items()}
FIT = '--fit', '--lever-arm', *map(str, ARM)
LOOPING = '--scene', 'looping', *FIT[1:]


def table(path, columns, separator=',', head=''):
    rows = zip(*columns.values(), strict=True)
    path.write_text(head + separator.join(columns) + '\n' + ''.join(
        separator.join(map(str, row)) + '\n' for row in rows))
    return path


def imu(gyroscope=RATES, force=FORCE, names=('gyro_x', 'gyro_y', 'gyro_z', 'acc_x', 'acc_y',
                                             'acc_z')):
    return dict(zip(names, np.hstack((gyroscope, force)).T, strict=True))


def wxyz(*names, q=Q):
    return dict(zip(names or ('qw', 'qx', 'qy', 'qz'), np.roll(q, 1, axis=1).T, strict=True))


def euler(unit):
    return {f'{name}{unit}': np.degrees(getattr(MOTION, name)) if unit else getattr(MOTION, name)
            for name in ('psi', 'theta', 'phi')}


TABLES = {
    'names of this package': ({'t [s]': T, 'theta_dot [rad/s]': T, **wxyz()}, ',', ''),
    'EuRoC': ({'timestamp [ns]': NS, 'p_RS_R_x [m]': T, 'p_RS_R_y [m]': T, 'p_RS_R_z [m]': T,
               **wxyz('q_RS_w []', 'q_RS_x []', 'q_RS_y []', 'q_RS_z []'),
               'b_w_RS_S_x [rad s^-1]': T, 'b_w_RS_S_y [rad s^-1]': T,
               'b_w_RS_S_z [rad s^-1]': T}, ',', '#'),
    'TUM': (dict(zip(('timestamp', 'tx', 'ty', 'tz', 'qx', 'qy', 'qz', 'qw'),
                     (T + 1.7e9, T, T, T, *Q.T), strict=True)), ' ', '# '),
    'messages': ({'/pose/header/stamp/sec': NS // 10 ** 9,
                  '/pose/header/stamp/nanosec': NS % 10 ** 9,
                  'frame': ['world'] * len(T), **wxyz(
                      'pose.orientation.w', 'pose.orientation.x', 'pose.orientation.y',
                      'pose.orientation.z')}, ';', ''),
    'comments and decimal commas': (
        {'time_us': [f'{1e6 * t:.1f}'.replace('.', ',') for t in T], **{
            name: [f'{value:.12f}'.replace('.', ',') for value in values] for name, values in
            wxyz('qpos_0', 'qpos_1', 'qpos_2', 'qpos_3').items()}}, ';', '# simulator\n# SI\n'),
    'names in a comment before the last': ({'# t': T, **wxyz()}, ',', '# 200 Hz\n'),
    'camel case': ({**wxyz('quatW', 'quatX', 'quatY', 'quatZ'), 'Time_ms': 1e3 * T}, '\t', ''),
    'dates and numbers': ({'time': [f'{np.datetime64(ns, "ns")}' for ns in NS.tolist()],
                           **wxyz('q0', 'q1', 'q2', 'q3')}, ',', ''),
    'nanoseconds before seconds': (
        {'nanosec': NS % 10 ** 9, **wxyz(), 'sec': NS // 10 ** 9}, ',', ''),
    'stamps of ROS 1': ({'a.nsecs': NS % 10 ** 9, **wxyz(), 'a.secs': NS // 10 ** 9}, ',', ''),
    'angles': ({'time': T, **euler('')}, ',', ''),
    'degrees': ({**euler('_deg'), 'stamp_ns': NS}, ',', '')}


@pytest.mark.parametrize('kind', TABLES)
def test_columns_are_known_by_their_names(tmp_path, kind):
    columns, separator, head = TABLES[kind]
    recorded = motion_files.read(table(tmp_path / 'a.csv', columns, separator, head))
    assert set(recorded.parts) == {'attitudes'}
    times, attitudes = recorded.parts['attitudes']
    assert times == pytest.approx(T, abs=3e-7)
    turns = Rotation.from_quat(np.roll(attitudes, -1, axis=1))
    assert (turns.inv() * Rotation.from_quat(Q)).magnitude().max() < 1e-6
    assert len(trajectory_of(recorded, EXACT).t) == len(T)


def test_a_trajectory_of_tum_needs_no_names(tmp_path):
    path = table(tmp_path / 'a.tum', *TABLES['TUM'])
    path.write_text(path.read_text().partition('\n')[2])
    assert motion_files.read(path).parts['attitudes'][1] == pytest.approx(np.roll(Q, 1, axis=1))


@pytest.mark.parametrize(('names', 'unit', 'force_unit'), [
    (('wx', 'wy', 'wz', 'ax', 'ay', 'az'), 1.0, 1.0),
    (('angular_velocity.x', 'angular_velocity.y', 'angular_velocity.z', 'linear_acceleration.x',
      'linear_acceleration.y', 'linear_acceleration.z'), 1.0, 1.0),
    (('gyr_x_dps', 'gyr_y_dps', 'gyr_z_dps', 'ax [m s^-2]', 'ay [m/s²]', 'az [m/s/s]'),
     np.pi / 180.0, 1.0),
    (('gx [mrad/s]', 'gy [mrad s-1]', 'gz [mrad]', 'ax [g]', 'ay [g]', 'az [g]'), 1e-3, 9.80665),
    (('gx [°/s]', 'gy [deg s^-1]', 'gz_deg', 'ax [mg]', 'ay [mg]', 'az [mg]'), np.pi / 180.0,
     9.80665e-3)])
def test_readings_are_known_by_their_names(tmp_path, names, unit, force_unit):
    path = table(tmp_path / 'a.csv', {
        'time': T, **imu(RATES / unit, FORCE / force_unit, names), 'mx [T]': T, 'my [µT]': 1e6 * T,
        'mz [gauss]': 1e4 * T, **wxyz()})
    recorded = motion_files.read(path)
    parts = recorded.parts
    assert {f'gyroscope of {", ".join(names[:3])}', f'accelerations of {", ".join(names[3:])}',
            'attitudes of qw, qx, qy, qz', 'magnetometer of mx [T], my [µT], mz [gauss]'} == {
                note.removesuffix(': 600 from 0 to 2.995 s') for note in recorded.notes}
    assert parts['gyroscope'][1] == pytest.approx(RATES)
    assert parts['accelerations'][1] == pytest.approx(FORCE)
    assert parts['magnetometer'][1] == pytest.approx(np.stack((T, T, T), axis=1))


def test_readings_of_a_fast_spin_are_compared(tmp_path, capsys):
    """At 60 rad/s and 100 Hz, derivatives of the attitudes would be wrong by far."""
    motion = solve(TOP, State(theta=0.5, theta_dot=0.3, l3=60.0 * TOP.lambda3, lz=8.0), 2.0 * T)
    force = np.stack(np.broadcast_arrays(*motion.specific_force(ARM)), axis=1)
    pose = {'t': 2.0 * T, **wxyz(q=motion.quaternion)}
    names = 'gx', 'gy', 'gz', 'ax', 'ay', 'az'
    for late, fault in ((0, 'passed'), (1, 'imu_one_step_late')):
        readings = [np.roll(one, late, axis=0) for one in (motion.angular_velocity, force)]
        path = table(tmp_path / f'{late}.csv', {**pose, **imu(*readings, names=names)})
        assert main([str(path), *FIT]) == late
        assert f'{late}.csv: {fault}\n' in capsys.readouterr().out


def test_arrays_and_parquet_are_read(tmp_path):
    pa = pytest.importorskip('pyarrow')
    from pyarrow import parquet

    parquet.write_table(pa.table({'t': T, **wxyz()}), tmp_path / 'a.parquet')
    np.savez(tmp_path / 'b.npz', t=T, quaternion=Q, rates=RATES, dt=0.005)
    np.savez(tmp_path / 'c.npz', t=T, attitudes=np.roll(Q, 1, axis=1), gyroscope=RATES)
    for name in ('a.parquet', 'b.npz', 'c.npz'):
        assert motion_files.read(tmp_path / name).parts['attitudes'][1] == pytest.approx(
            np.roll(Q, 1, axis=1)), name


def test_rows_may_be_uneven_out_of_order_or_without_some_sensors(tmp_path):
    random = np.random.default_rng(1)
    t = np.sort(T + random.uniform(-1e-3, 1e-3, len(T)))
    q = solve(TOP, START, t).quaternion
    order = random.permutation(len(T))
    rows = {'t': t, **wxyz(q=q), **imu()}
    cells = {name: [str(values[k]) for k in order] for name, values in rows.items()}
    for k in np.flatnonzero(order % 2):
        cells['acc_y'][k] = ''
    recorded = motion_files.read(table(tmp_path / 'a.csv', cells))
    assert [len(recorded.parts[name][0]) for name in ('attitudes', 'gyroscope', 'accelerations')
            ] == [600, 600, 300]
    even = trajectory_of(recorded, EXACT)
    assert 'not evenly spaced' in recorded.notes[-1]
    right = Rotation.from_quat(solve(TOP, START, even.t).quaternion)
    assert (right.inv() * even.rotation).magnitude().max() < 1e-4


def test_sensors_that_never_read_together_are_not_all_compared(tmp_path):
    mag = dict(zip(('mx', 'my', 'mz'), np.where(T > 1.5, FORCE.T, np.nan), strict=True))
    early = {name: np.where(T < 1.5, values, np.nan) for name, values in imu().items()}
    recorded = motion_files.read(table(tmp_path / 'a.csv', {**mag, 't': T, **early, **wxyz()}))
    assert trajectory_of(recorded, EXACT).magnetometer is None
    assert 'magnetometer: not at the times of the others, left out' in recorded.notes


def vector(v, kind='Vector3'):
    return MAKE[kind](*map(float, v))


quaternion = partial(vector, kind='Quaternion')


def header(k):
    return MAKE['Header'](MAKE['Time'](*divmod(int(NS[k]), 10 ** 9)), 'world')


def placed(k):
    return MAKE['Pose'](vector((0, 0, 0), 'Point'), quaternion(Q[k]))


def foreign_log(path, late):
    """Write a log of another program: poses, and readings that come some steps late."""
    pose, reading, rows = 'geometry_msgs/msg/PoseStamped', 'sensor_msgs/msg/Imu', []

    for k, stamp in enumerate(NS.tolist()):
        now, unknown = max(k - late, 0), np.zeros(9)
        imu_message = MAKE['Imu'](
            header(k), quaternion((0.0, 0.0, 0.0, 1.0)), np.array([-1.0, *unknown[1:]]),
            vector(RATES[now]), unknown, vector(FORCE[now]), unknown)
        received = stamp + 3_000_000 + 200_000 * (k % 7)
        rows += [(number, received, bytes(JAZZY.serialize_cdr(message, kind)))
                 for number, (message, kind) in enumerate((
                     (MAKE['PoseStamped'](header(k), placed(k)), pose), (imu_message, reading)))]
    return write_rows(path, [RecordedTopic('/a/imu_odom', pose), RecordedTopic('/imu', reading)],
                      rows)


def test_transforms_that_move_and_poses_without_a_header_are_read(tmp_path):
    from mcap.writer import Writer

    def transforms(k):
        return MAKE['TFMessage']([MAKE['TransformStamped'](header(k), frame, MAKE['Transform'](
            vector((0, 0, 0)), quaternion(q))) for frame, q in (
                ('camera', (0, 0, 0, 1)), ('top', Q[k]))])

    for name, content in (('tf2_msgs/msg/TFMessage', transforms),
                          ('geometry_msgs/msg/Pose', placed)):
        path = tmp_path / f'{content.__name__}.mcap'
        with open(path, 'wb') as file:
            writer = Writer(file)
            writer.start('ros2')
            channel = writer.register_channel('/a', 'cdr', writer.register_schema(
                name, 'ros2msg', b''))
            for k, stamp in enumerate(NS[:100].tolist()):
                writer.add_message(channel, stamp, bytes(JAZZY.serialize_cdr(content(k), name)),
                                   stamp)
            writer.finish()
        recorded = motion_files.read(path)
        times, attitudes = recorded.parts['attitudes']
        assert times == pytest.approx(T[:100], abs=1e-6)
        assert attitudes == pytest.approx(np.roll(Q[:100], 1, axis=1))


def test_a_log_of_another_program_is_graded(tmp_path, capsys):
    right, wrong = (foreign_log(tmp_path / f'{late}.mcap', late) for late in (0, 1))
    assert main([str(right), *LOOPING, '--topic', '/a/imu_odom']) == 0
    assert main([str(wrong), *LOOPING, '--json']) == 1
    _, _, text = capsys.readouterr().out.partition('{')
    faults = {fault['name'] for fault in json.loads('{' + text)['faults']}
    assert faults == {'imu_one_step_late'}


TURN = Rotation.from_rotvec((0.3, -0.2, 1.1)).inv().apply


@pytest.mark.parametrize(('fault', 'columns', 'options', 'says'), [
    ('no_lever_arm', imu(force=np.stack(MOTION.specific_force((0.0, 0.0, 0.0)), axis=1)), FIT,
     'P/lambda1'),
    ('units', imu(np.degrees(RATES)), FIT, 'P/lambda1'),
    ('rates_in_world', imu(Rotation.from_quat(Q).apply(RATES)), FIT, 'P/lambda1'),
    ('mounting', imu(TURN(RATES), TURN(FORCE)), LOOPING, 'by (0.3, -0.2, 1.1) rad')])
def test_faults_in_a_table_are_named(tmp_path, capsys, fault, columns, options, says):
    path = table(tmp_path / 'a.csv', {'t': T, **wxyz(), **columns})
    assert main([str(path), *options]) == 1
    out = capsys.readouterr().out
    assert f'a.csv: {fault}\n' in out and says in out


def test_faults_of_the_motion_of_a_known_top_are_named_without_its_start(tmp_path, capsys):
    start, times = Start.of(TOP, START), 0.005 * np.arange(500)
    q, w, _ = Stepped(method='semi-implicit')(TOP, start, times, 0.005)
    path = table(tmp_path / 'a.csv', {'t': times, **wxyz(q=q), **dict(zip(
        ('wx', 'wy', 'wz'), w.T, strict=True))})
    top = [word for name, value in vars(TOP).items() for word in ('-p', f'top.{name}:={value}')]
    assert main([str(path), '--fit', *top]) == 1
    assert 'a.csv: explicit_gyroscopic_term\n' in capsys.readouterr().out
    assert main([str(path), '--fit', '-p', 'initial.theta:=0.3']) == 2
    assert 'initial.theta must not be given' in capsys.readouterr().err


def test_a_simulator_whose_steps_show_passes_within_the_tolerance(tmp_path, capsys):
    """The residual of 1e-6 rad is not noise: the intervals mean nothing, the verdict counts."""
    times = 0.02 * np.arange(200)
    q, _, _ = Stepped(method='rk4')(TOP, Start.of(TOP, START), times, 0.02)
    path = table(tmp_path / 'a.csv', {'t': times, **wxyz(q=q)})
    assert main([str(path), '--imu', 'bmi088']) == 0
    out = capsys.readouterr().out
    assert 'the intervals mean nothing' in out and 'a.csv: passed' in out


@pytest.mark.parametrize('streams', ['all', 'joint_states, increments, imu'])
def test_a_log_of_this_package_brings_its_top(tmp_path, capsys, streams):
    path = tmp_path / 'run.mcap'
    assert simulate(['--quiet', '-o', str(path), '--duration', '3', '--command', '2:1.5:1.4',
                     '--params', str(ROOT / 'config/looping.yaml'),
                     '-p', 'imu.lever_arm:=[0.1, 0.0, 0.2]', '-p', 'imu.rpy:=[0.3, 0.1, -1.0]',
                     '-p', f'record.streams:=[{streams}]', '-p', 'increments.enabled:=true']) == 0
    assert main([str(path)]) == 0
    assert main([str(path), '-p', 'mag.field:=[0.0, 3e-5, 0.0]']) == 0      # beside the log's
    assert main([str(path), '--scene', 'cusp']) == 2
    out, err = capsys.readouterr()
    assert 'run.mcap: passed' in out
    assert 'accelerations_discrepancy' in out
    assert err.startswith('spinning-top grade: ') and '--fit' in err
    assert 'the parameters do not fit the trajectory' in err


def test_noise_of_the_attitudes_is_no_fault(tmp_path, capsys):
    noise = Rotation.from_rotvec(np.random.default_rng(2).normal(0.0, 2e-3, (len(T), 3)))
    noisy = (Rotation.from_quat(Q) * noise).as_quat()
    path = table(tmp_path / 'a.csv', {'t': T, **wxyz(q=noisy), **imu()})
    assert main([str(path), *LOOPING]) == 0
    assert 'exact but for noise of 0.00' in capsys.readouterr().out


@pytest.mark.parametrize(('name', 'content', 'words', 'code'), [
    ('none.csv', None, 'No such file', 1),
    ('empty.csv', '', 'is empty', 2),
    ('empty.mcap', '', 'it is empty', 1),
    ('text.csv', 'Dear all,\nthe log is\n', 'must have a line with the names', 2),
    ('text.mcap', 'Dear all', 'it is no MCAP file', 1),
    ('text.npz', 'Dear all', 'is no file of numpy.savez', 2),
    ('no.csv', 't,x\n1,2\n', 'has no attitudes', 2),
    ('no_time.csv', 'qw,qx,qy,qz\n1,0,0,0\n', 'no column of times', 2),
    ('unit.csv', 't,gx [rpm]\n1,2\n', 'gx [rpm]: the unit must be rad, mrad, deg, rad/s, ', 2),
    ('units.csv', 't,ax [m/s]\n1,2\n', 'ax [m/s]: the unit must be m/s^2, m/s/s, g, mg, or', 2),
    ('zero.csv', 't,qw,qx,qy,qz\n' + ''.join(f'{k},0,0,0,0\n' for k in range(50)),
     'the attitude at 0 s is 0, 0, 0, 0: must be', 2),
    ('rest.csv', 't,qw,qx,qy,qz\n' + ''.join(f'{k},1,0,0,0\n' for k in range(50)),
     'the attitude never changes', 2),
    ('short.csv', 't,qw,qx,qy,qz\n0,1,0,0,0\n1,1,0,0,0\n', 'has 2 attitudes: must have', 2),
    ('log.doc', 'x', 'the name must end in', 2)])
def test_errors_are_one_line(tmp_path, capsys, name, content, words, code):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    assert main([str(path)]) == code
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1
    assert words in err and name in err
    assert {*tmp_path.iterdir()} <= {path}
