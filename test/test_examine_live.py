# SPDX-License-Identifier: Apache-2.0
"""The exam of a running node: in lockstep, sample by sample."""

import importlib
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.node_harness import wait_for
from helpers.reference import ROOT

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.adapters import Vqf
from spinning_top_sim.exam.command import main
from spinning_top_sim.exam.trial import InvalidOutputError, NodeError, follow

pytest.importorskip('rclpy')
pytest.importorskip('vqf')
live = importlib.import_module('spinning_top_sim.exam.live')
NODE = f'{sys.executable} {ROOT / "examples/attitude_node.py"}'


@pytest.fixture(scope='module')
def run():
    return scenarios.record(replace(scenarios.SLOW, duration=1.5), scenarios.CALIBRATED, 1)


def test_a_node_says_what_its_filter_says_in_every_run(run):
    # The node takes the first sample for the begin of its first step.
    direct = follow(partial(Vqf, magnetic=False), run.part(slice(1, None)))
    with live.NodeExam('imu/data', NODE) as node:
        for _ in range(2):
            outcome = follow(node.start, run)
            assert np.max(np.abs(outcome.estimates[1:] - direct.estimates)) < 1e-9
            assert np.isnan(outcome.covariances).all()


@pytest.fixture
def running():
    process = subprocess.Popen([sys.executable, str(ROOT / 'examples/attitude_node.py')])
    yield process
    process.kill()
    process.wait()


def test_a_node_that_runs_gets_one_run_after_the_other(run, running, monkeypatch, capfd):
    twice = run.preceded_by(run)
    direct = follow(partial(Vqf, magnetic=False), twice.part(slice(1, None)))
    with monkeypatch.context() as alone, live.NodeExam('imu/data') as node:
        alone.setattr(live, 'DISCOVERY_S', 0.0)
        outcome = follow(node.start, twice)
        assert np.max(np.abs(outcome.estimates[1:] - direct.estimates)) < 1e-9
        filter_ = node.start()          # later than the first run, for the node
        readings = run.gyroscope[0], run.accelerometer[0], run.magnetometer[0], 0.01
        for _ in range(10):
            filter_.update(*readings)
        # Another source of samples is told.
        alone.undo()
        assert main(['--topic', 'imu/data']) == 1
        assert '/clock has 2 publishers: end the others' in capfd.readouterr().err
        running.send_signal(signal.SIGINT)
        running.wait()
        wait_for('the node to leave the graph', lambda: not node.is_there())
        monkeypatch.setattr(live, 'PATIENCE_S', 0.1)
        with pytest.raises(NodeError, match='publishes imu/data has gone'):
            filter_.update(*readings)


def test_an_interrupt_ends_the_exam(monkeypatch, capfd):
    monkeypatch.setattr(live.NodeExam, 'is_there', lambda _: signal.raise_signal(signal.SIGINT))
    assert main(['--topic', '/imu/data']) == 130
    assert 'spinning-top examine: interrupted' in capfd.readouterr().err


def test_a_node_that_does_not_run_is_told(monkeypatch, capfd):
    monkeypatch.setattr(live, 'PATIENCE_S', 0.5)
    assert main(['--topic', '/imu/data']) == 1
    said = capfd.readouterr().err
    assert 'no node reads imu/data_raw and publishes /imu/data within 0.5 s: check that' in said


@pytest.mark.parametrize(('arguments', 'says'), [
    (['--topic', 'a b'], 'a b'),
    (['--topic', 'a', '--node', "a 'b"], 'No closing quotation')])
def test_what_is_no_topic_or_command_is_told_in_one_line(arguments, says, capfd):
    assert main(arguments) == 2
    said = capfd.readouterr().err
    assert says in said and said.count('\n') == 1


def test_a_node_that_does_not_answer_is_told(run, monkeypatch):
    monkeypatch.setattr(live, 'FIRST_PATIENCE_S', 0.05)
    deaf = ("import rclpy; from sensor_msgs.msg import Imu; rclpy.init(); "
            "node = rclpy.create_node('deaf'); node.create_publisher(Imu, 'imu/data', 1); "
            "s = node.create_subscription(Imu, 'imu/data_raw', lambda message: None, 1); "
            'rclpy.spin(node)')
    with (live.NodeExam('imu/data', f'{sys.executable} -c "{deaf}"') as node,
          pytest.raises(InvalidOutputError, match='update 6 of 150 raises RuntimeError: no '
                        r'attitude has the stamp 1\.0600')):
        follow(node.start, run)


def test_the_example_for_launch_testing_passes(tmp_path):
    pytest.importorskip('launch_testing', reason='launch comes with ROS: it is not on PyPI')
    ended = subprocess.run(
        [sys.executable, '-m', 'launch_testing.launch_test',
         str(ROOT / 'examples/test_attitude_node.launch.py')],
        cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert 'Ran 1 test' in ended.stdout + ended.stderr
