# SPDX-License-Identifier: Apache-2.0
"""Exports, read as their formats are documented, beside what the log has."""

import csv

import numpy as np
import pytest
from helpers.inspected import log_of
from rosbags.highlevel import AnyReader

from spinning_top_sim.tools import inspect

VALUES = {'ground_truth_imu_odom.enabled': True, 'ground_truth_imu_odom.rate': 125.0,
          'imu.gyroscope_noise_density': 1e-3, 'imu.lever_arm': [0.1, -0.2, 0.3]}
FILES = {'tum': 'truth.tum', 'euroc_imu': 'imu.csv'}


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A log, and what is exported from it."""
    folder = tmp_path_factory.mktemp('exports')
    log = log_of(folder / 'run.mcap', '--command', '0.503:2.0:1.5', '--duration', 1, '--epoch',
                 1700000000, *(text for name, value in VALUES.items()
                               for text in ('-p', f'{name}:={str(value).lower()}')))
    assert inspect.main([str(log), *(
        f'--export={kind}:{folder / name}' for kind, name in FILES.items())]) == 0
    return folder


@pytest.fixture(scope='module')
def messages(folder):
    found = {}
    with AnyReader([folder / 'run.mcap']) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype))
    return found


def rows(path, delimiter):
    with open(path, newline='') as file:
        return [row for row in csv.reader(file, delimiter=delimiter) if not row[0].startswith('#')]


def stamps(messages):
    return [one.header.stamp.sec * 10 ** 9 + one.header.stamp.nanosec for one in messages]


def xyz(vector):
    return [vector.x, vector.y, vector.z]


@pytest.mark.parametrize(('name', 'topic', 'numbers_of'), [
    ('truth.tum', '/ground_truth/imu_odom', lambda one: [
        *xyz(one.pose.pose.position), *xyz(one.pose.pose.orientation),
        one.pose.pose.orientation.w]),
    ('imu.csv', '/imu/data_raw',
     lambda one: [*xyz(one.angular_velocity), *xyz(one.linear_acceleration)])])
def test_numbers_and_stamps_are_those_of_messages_to_the_last_bit(
        folder, messages, name, topic, numbers_of):
    found = rows(folder / name, ' ' if 'tum' in name else ',')
    assert [int(row[0].replace('.', '')) for row in found] == stamps(messages[topic])
    assert np.array_equal(np.array(found, np.float64)[:, 1:], [*map(numbers_of, messages[topic])])


def test_tum_takes_the_body_where_the_log_has_no_odometry_of_the_imu(tmp_path, capsys):
    log, path = log_of(tmp_path / 'run.mcap', '--duration', 0.1), tmp_path / 'a'
    assert inspect.main([str(log), '--export', f'tum:{path}']) == 0
    assert capsys.readouterr().err == f'{path}: tum, from ground_truth/odom\n'
    with AnyReader([log]) as reader:
        poses = [reader.deserialize(data, connection.msgtype).pose.pose
                 for connection, _, data in reader.messages()
                 if connection.topic == '/ground_truth/odom']
    assert np.array_equal(np.array(rows(path, ' '), np.float64)[:, 1:], [
        [*xyz(one.position), *xyz(one.orientation), one.orientation.w] for one in poses])


@pytest.mark.parametrize(('kind', 'reason', 'code'), [
    ('euroc_imu:DIR/a', 'no imu/data_raw', 2),
    ('euroc_imu:DIR/there', 'there: File exists', 1)])
def test_what_cannot_be_exported_is_told(tmp_path, capsys, kind, reason, code):
    (tmp_path / 'there').write_text('precious')
    log = log_of(tmp_path / 'run.mcap', '--duration', 1, '-p', 'imu.enabled:=false')
    assert inspect.main([str(log), '--export', kind.replace('DIR', str(tmp_path)),
                         '--export', f'tum:{tmp_path / "b"}']) == code
    assert reason in capsys.readouterr().err
    assert not (tmp_path / 'a').exists() and not (tmp_path / 'b').exists()
    assert (tmp_path / 'there').read_text() == 'precious'
