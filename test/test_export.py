# SPDX-License-Identifier: Apache-2.0
"""Exports, read as their formats are documented, beside what the log has."""

import csv

import numpy as np
import pytest
from helpers.inspected import log_of
from helpers.node_logs import xyz
from rosbags.highlevel import AnyReader

from spinning_top_sim.tools import inspect


def pose_in(message):
    pose = message.pose.pose
    return [*xyz(pose.position), *xyz(pose.orientation), pose.orientation.w]


def readings_in(message):
    return [*xyz(message.angular_velocity), *xyz(message.linear_acceleration)]


@pytest.mark.parametrize(('kind', 'topic', 'numbers_of', 'more'), [
    ('tum', 'ground_truth/imu_odom', pose_in,
     ('-p', 'ground_truth_imu_odom.enabled:=true', '-p', 'imu.lever_arm:=[0.1, -0.2, 0.3]')),
    ('tum', 'ground_truth/odom', pose_in, ()),
    ('euroc_imu', 'imu/data_raw', readings_in, ('-p', 'imu.gyroscope_noise_density:=1e-3'))])
def test_numbers_and_stamps_are_those_of_messages_to_the_last_bit(
        tmp_path, capsys, kind, topic, numbers_of, more):
    log, path = log_of(tmp_path / 'run.mcap', '--command', '0.503:2.0:1.5', '--duration', 1,
                       '--epoch', 1700000000, *more), tmp_path / 'a'
    assert inspect.main([str(log), '--export', f'{kind}:{path}']) == 0
    assert capsys.readouterr().err == f'{path}: {kind}, from {topic}\n'
    with AnyReader([log]) as reader:
        messages = [reader.deserialize(data, connection.msgtype)
                    for connection, _, data in reader.messages()
                    if connection.topic == f'/{topic}']
    with open(path, newline='') as file:
        rows = [row for row in csv.reader(file, delimiter=' ' if kind == 'tum' else ',')
                if not row[0].startswith('#')]
    assert [int(row[0].replace('.', '')) for row in rows] == [
        one.header.stamp.sec * 10 ** 9 + one.header.stamp.nanosec for one in messages]
    assert np.array_equal(np.array(rows, np.float64)[:, 1:], [*map(numbers_of, messages)])


def test_euroc_has_the_velocity_in_the_world_and_the_bias_of_the_newest_reading(tmp_path):
    """In the world the velocity is the rate of the position."""
    path, log = tmp_path / 'a', log_of(
        tmp_path / 'run.mcap', '--duration', 1, '-p', 'ground_truth_imu_odom.enabled:=true', '-p',
        'ground_truth_imu_odom.rate:=125.0', '-p', 'imu.lever_arm:=[0.1, -0.2, 0.3]', '-p',
        'imu.gyroscope_random_walk:=1e-2', '-p', 'imu.accelerometer_turn_on_bias:=0.1')
    assert inspect.main([str(log), '--export', f'euroc:{path}']) == 0
    found = {}
    with AnyReader([log]) as reader:
        for connection, at_ns, data in reader.messages():
            found.setdefault(connection.topic, {})[at_ns] = reader.deserialize(
                data, connection.msgtype)
    poses, biases = found['/ground_truth/imu_odom'], found['/ground_truth/imu_bias']
    rows = np.loadtxt(path, delimiter=',')
    assert rows[:, 0].tolist() == [*poses]
    places = np.array([pose_in(one) for one in poses.values()])
    assert np.array_equal(rows[:, 1:8], places[:, [0, 1, 2, 6, 3, 4, 5]])
    rate = (places[:-4] - 8.0 * places[1:-3] + 8.0 * places[3:-1] - places[4:])[:, :3] / 0.096
    assert np.abs(rate - rows[2:-2, 8:11]).max() <= 2e-4 * np.abs(rate).max()
    assert rows[:, 11:].tolist() == [
        readings_in(biases[max(at_ns for at_ns in biases if at_ns <= pose_ns)])
        for pose_ns in poses]


@pytest.mark.parametrize(('kind', 'reason', 'code'), [
    ('euroc_imu:DIR/a', 'no imu/data_raw', 2), ('euroc:DIR/a', 'no ground_truth/imu_odom', 2),
    ('euroc_imu:DIR/there', 'there: File exists', 1)])
def test_what_cannot_be_exported_is_told(tmp_path, capsys, kind, reason, code):
    (tmp_path / 'there').write_text('precious')
    log = log_of(tmp_path / 'run.mcap', '--duration', 1, '-p', 'imu.enabled:=false')
    assert inspect.main([str(log), '--export', kind.replace('DIR', str(tmp_path)),
                         '--export', f'tum:{tmp_path / "b"}']) == code
    assert reason in capsys.readouterr().err
    assert not (tmp_path / 'a').exists() and not (tmp_path / 'b').exists()
    assert (tmp_path / 'there').read_text() == 'precious'
