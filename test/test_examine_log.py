# SPDX-License-Identifier: Apache-2.0
"""The exam of logs: attitudes of other nodes beside the truth."""

import math

import numpy as np
import pytest
from helpers.inspected import log_of
from helpers.logs import flipped, records_of
from helpers.recordings import JAZZY, write_rows
from mcap.opcode import Opcode
from scipy.spatial.transform import Rotation

from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.log import examine_log
from spinning_top_sim.grade.files import read
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import RecordedTopic

IMU, QUATERNION, POSE, POSE_COVARIANCE, ODOMETRY = TYPES = (
    'sensor_msgs/msg/Imu', 'geometry_msgs/msg/QuaternionStamped', 'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped', 'nav_msgs/msg/Odometry')


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    return log_of(tmp_path_factory.mktemp('log') / 'run.mcap', '--duration', 10, '--scene', 'wavy',
                  '-p', 'imu_data.enabled:=true', '-p', 'imu.rpy:=[0.3, -0.2, 1.0]')


@pytest.fixture(scope='module')
def beside(log, tmp_path_factory):
    """Return what writes attitudes of a sensor beside its truth, as messages of another writer."""
    with LogReader(log) as reader:
        truth = [(0, message.log_time, message.data)
                 for message in reader.messages(['/ground_truth/imu'])]
    q = [JAZZY.deserialize_cdr(data, IMU).orientation for _, _, data in truth]
    quaternions = np.array([(one.x, one.y, one.z, one.w) for one in q])

    def made(type_name, *values):
        return JAZZY.types[type_name](*values)

    def filled(type_name, header, quaternion, variance):
        q = made('geometry_msgs/msg/Quaternion', *quaternion)
        zero = made('geometry_msgs/msg/Vector3', 1.0, 2.0, 3.0)
        pose = made('geometry_msgs/msg/Pose', made('geometry_msgs/msg/Point', 1.0, 2.0, 3.0), q)
        matrix = np.diag([-1.0, 9.0, 9.0] + [variance] * 3).ravel()     # position unknown
        with_covariance = made('geometry_msgs/msg/PoseWithCovariance', pose, matrix)
        twist = made('geometry_msgs/msg/TwistWithCovariance',
                     made('geometry_msgs/msg/Twist', zero, zero), np.zeros(36))
        return made(type_name, header, *{
            IMU: (q, (variance * np.eye(3)).ravel(), zero, np.zeros(9), zero, np.zeros(9)),
            QUATERNION: (q,), POSE: (pose,), POSE_COVARIANCE: (with_covariance,),
            ODOMETRY: ('sensor', with_covariance, twist)}[type_name])

    def write_beside(said, type_name=IMU, variance=0.0, delay_ns=0, every=1):
        rows = []
        for (_, stamp_ns, _), one in zip(truth, said(quaternions), strict=True):
            stamp = made('builtin_interfaces/msg/Time', *divmod(stamp_ns + delay_ns, 10 ** 9))
            header = made('std_msgs/msg/Header', stamp, 'a frame')
            rows.append((1, stamp_ns, bytes(JAZZY.serialize_cdr(
                filled(type_name, header, one, variance), type_name))))
        return write_rows(
            tmp_path_factory.mktemp('beside') / 'run.mcap',
            (RecordedTopic('/ground_truth/imu', IMU), RecordedTopic('/estimate', type_name)),
            truth[::every] + rows)
    return write_beside


def disturbed(quaternions):
    noise = 0.01 * np.random.default_rng(5).standard_normal((len(quaternions), 3))
    return (Rotation.from_quat(quaternions) * Rotation.from_rotvec(noise)).as_quat()


def test_a_chunk_that_cannot_be_read_is_noted_here_and_by_grade(log, tmp_path):
    content = log.read_bytes()
    chunks = [end for opcode, _, end in records_of(content) if opcode == Opcode.CHUNK]
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(flipped(content, chunks[len(chunks) // 2] - 9))
    for path, notes in ((log, []), (damaged, ['the log is damaged: what is whole is read'])):
        report = examine_log(path, 'imu/data')
        assert report.passed and report.notes == notes
        assert [note for note in read(path).notes if 'damaged' in note] == notes


@pytest.mark.parametrize('type_name', TYPES)
def test_attitudes_of_every_type_are_read(beside, type_name):
    report = examine_log(beside(disturbed, type_name, variance=1e-4), 'estimate')
    assert report.passed, report
    assert report.measures['tilt_rms_deg'] == pytest.approx(math.degrees(0.01 * 2 ** 0.5),
                                                            rel=0.05)
    assert ('nees' in report.measures) == (type_name in (IMU, POSE_COVARIANCE, ODOMETRY))
    assert report.measures.get('nees', 1.0) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(('name', 'said', 'options'), [
    ('convention', lambda q: np.roll(q, 1, axis=1), {}),
    ('timing', disturbed, {'delay_ns': 20_000_000}),
    # Late by a step of the filter, which is shorter than that of the truth.
    ('timing', np.array, {'delay_ns': 5_000_000, 'every': 5}),
    ('covariance', disturbed, {'variance': 0.2e-4}),
    ('accuracy', lambda q: np.roll(q, 100, axis=0), {}),
    ('invalid_output', lambda q: q * np.where(np.arange(len(q)) == 777, np.nan, 1.0)[:, None],
     {}),
    ('invalid_output', disturbed, {'variance': -1e-4})])
def test_faults_of_attitudes_in_a_log_are_named(beside, name, said, options):
    report = examine_log(beside(said, **options), '/estimate')
    assert report.faults == [name], report


def test_the_heading_in_a_log_is_steady_and_its_mean_is_told(beside):
    turned = beside(lambda q: (Rotation.from_euler('z', 1.0) * Rotation.from_quat(q)).as_quat())
    report = examine_log(turned, '/estimate')
    assert report.passed and report.measures['error_rms_deg'] < 1e-3
    assert report.measures['heading_mean_deg'] == pytest.approx(math.degrees(1.0))


@pytest.mark.parametrize(('path', 'topic', 'code', 'says'), [
    (None, '/nix', 2, 'has no topic /nix; it has /pose'),
    (None, '/joint_states', 2, 'has the type sensor_msgs/msg/JointState'),
    (None, '/imu/data_raw', 2, 'it has no orientation'), ('nix.mcap', '/a', 1, 'nix.mcap')])
def test_wrong_arguments_about_a_log(log, capsys, path, topic, code, says):
    assert main([str(path or log), '--topic', topic]) == code
    assert says in capsys.readouterr().err
