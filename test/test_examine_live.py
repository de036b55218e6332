# SPDX-License-Identifier: Apache-2.0
"""The exam of a ROS node: in lockstep, sample by sample."""

import importlib
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.node_harness import wait_for
from helpers.reference import ROOT

from spinning_top_sim.exam import feeding, motions
from spinning_top_sim.exam.adapters import Vqf

pytest.importorskip('rclpy')
pytest.importorskip('vqf')
live = importlib.import_module('spinning_top_sim.exam.live')
NODE = f'{sys.executable} {ROOT / "examples/attitude_node.py"}'
# A node that answers each sample with the parity of its number, once it has a reader.
PLAIN = """
import itertools, time, rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, Temperature
with open(__file__ + '.starts', 'a') as starts:
    starts.write('.')
    start = starts.tell()
rclpy.init()
node = rclpy.create_node('plain')
publisher = node.create_publisher(Imu, 'imu/data', PROFILE)
node.create_publisher(Temperature, 'imu/temperature', 1)
numbers = itertools.count(1)
def take(message):
    count = next(numbers)
    message.orientation.x, message.orientation.w = count % 2.0, 1.0 - count % 2.0
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    if (start, count) not in LEFT_OUT:
        publisher.publish(message)
node.create_subscription(Imu, 'imu/data_raw', take, PROFILE)
rclpy.spin(node)
"""


@pytest.fixture(scope='module')
def run():
    return motions.noisy('short', motions.CALIBRATED, 1, 0.2, 0.3)


@pytest.fixture
def plain(tmp_path):
    """Return what returns the command of a plain node; it leaves out a sample of a start."""
    def plain(*left_out, profile='qos_profile_sensor_data'):
        path = tmp_path / f'{len(os.listdir(tmp_path))}.py'
        path.write_text(PLAIN.replace('PROFILE', profile).replace('LEFT_OUT', repr(left_out)))
        return f'{sys.executable} {path}'
    return plain


def test_a_node_says_what_its_filter_says_in_every_run(run):
    # The node takes the first sample for the begin of its first step; so it is sent again.
    (direct,) = feeding.feed(partial(Vqf, magnetic=False), [run])
    with live.NodeExam(NODE, 'imu/data') as node:
        for outcome in feeding.feed(node.start, [run, run]):
            assert np.max(np.abs(outcome.estimates - direct.estimates)) < 1e-9
            assert np.isnan(outcome.covariances).all()


def test_a_lost_answer_is_no_fault_of_the_node(run, plain, monkeypatch):
    # The first after a start: the node has used the sample, so it starts anew, if that helps.
    with live.NodeExam(plain((2, 1), profile='10'), 'imu/data') as node:
        one, same = feeding.feed(node.start, [run, run])
        assert np.array_equal(one.estimates, same.estimates)
    with (live.NodeExam(plain((1, 1), profile='10'), 'imu/data') as node,
          pytest.raises(feeding.NodeError, match='starts answer sample 2 or 1 first: a mess')):
        feeding.feed(node.start, [run, run])
    monkeypatch.setattr(live, 'ANSWER_S', 0.3)
    with (live.NodeExam(plain((1, 30)), 'imu/data') as node,
          pytest.raises(feeding.NodeError, match='or a message is lost; make imu/data_raw')):
        feeding.feed(node.start, [run])


def test_another_publisher_is_told_whenever_it_comes(run, monkeypatch):
    monkeypatch.setattr(live, 'READ_EVERY', 1)
    with live.NodeExam(NODE, 'imu/data') as node:
        filter_ = node.start()
        readings = run.gyroscope[0], run.accelerometer[0], run.magnetometer[0], 0.01
        filter_.update(*readings)
        with (live.NodeExam(NODE, 'imu/data'),
              pytest.raises(feeding.NodeError, match='has 2 publishers: end the others')):
            wait_for('the graph', lambda: filter_.update(*readings) is None)


def test_the_node_ends_with_the_exam():
    with pytest.raises(KeyboardInterrupt), live.NodeExam('true', 'imu/data') as interrupted:
        signal.raise_signal(signal.SIGTERM)         # raises nothing within a call of rclpy
        interrupted.start()
    exam = subprocess.Popen([sys.executable, '-m', 'spinning_top_sim', 'examine', '--node', NODE,
                             '--topic', 'imu/data'], stderr=subprocess.PIPE, cwd=ROOT, text=True,
                            env={**os.environ, 'PYTHONPATH': str(ROOT)})
    try:
        children = Path(f'/proc/{exam.pid}/task/{exam.pid}/children')
        wait_for('the node to start', children.read_text)
        node = children.read_text().split()
        exam.send_signal(signal.SIGTERM)
        _, said = exam.communicate(timeout=120.0)    # its end is that of the node, too
        assert exam.returncode == 130 and 'interrupted' in said
        wait_for('the node to end', lambda: not any(os.path.exists(f'/proc/{one}')
                                                    for one in node))
    finally:
        exam.kill()
        exam.wait()


def test_a_node_that_does_not_start_or_answer_is_told(run, plain, monkeypatch):
    with (live.NodeExam('/nope', 'imu/data') as node,
          pytest.raises(feeding.NodeError, match='cannot start /nope')):
        node.start()
    with live.NodeExam(plain(*((1, k) for k in range(99))), 'imu/data') as node:
        filter_ = node.start()
        monkeypatch.setattr(live, 'PATIENCE_S', 1.0)
        with pytest.raises(RuntimeError, match='none of 4 samples has an answer with its'):
            filter_.update(run.gyroscope[0], run.accelerometer[0], None, 0.01)
    with (live.NodeExam(plain(), 'imu/temperature') as node, pytest.raises(
            feeding.NodeError, match='imu/temperature is sensor_msgs/msg/Temperature: must be')):
        node.start()
    with (live.NodeExam(f'{sys.executable} -c "import time; time.sleep(9)"', 'imu/data') as node,
          pytest.raises(feeding.InvalidOutputError, match='no node reads imu/data_raw and')):
        feeding.feed(node.start, [run])
