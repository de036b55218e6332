# SPDX-License-Identifier: Apache-2.0
"""The exam of a running node: in lockstep, sample by sample."""

import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from helpers.reference import ROOT

from spinning_top_sim.exam import scenarios
from spinning_top_sim.exam.adapters import Vqf
from spinning_top_sim.exam.trial import InvalidOutputError, follow

pytest.importorskip('rclpy')
pytest.importorskip('vqf')
NODE = f'{sys.executable} {ROOT / "examples/attitude_node.py"}'


@pytest.fixture(scope='module')
def run():
    return scenarios.record(replace(scenarios.SLOW, duration=3.0), scenarios.CALIBRATED, 1)


def test_a_node_says_what_its_filter_says_in_every_run(run):
    from spinning_top_sim.exam.live import NodeExam

    # The node takes the first sample for the begin of its first step.
    direct = follow(partial(Vqf, magnetic=False), run.part(slice(1, None)))
    with NodeExam('imu/data', NODE) as node:
        for _ in range(2):
            outcome = follow(node.make_filter, run)
            assert np.max(np.abs(outcome.estimates[1:] - direct.estimates)) < 1e-9
            assert outcome.covariances is None


def test_a_node_that_ends_is_told(run):
    from spinning_top_sim.exam.live import NodeExam

    with (NodeExam('imu/data', f'{sys.executable} -c pass') as node,
          pytest.raises(InvalidOutputError, match='the node has ended with 0')):
        follow(node.make_filter, run)


def test_a_node_that_does_not_answer_is_told(run, monkeypatch):
    from spinning_top_sim.exam import live

    monkeypatch.setattr(live, 'FIRST_PATIENCE_S', 0.05)
    deaf = ("import rclpy; from sensor_msgs.msg import Imu; rclpy.init(); "
            "node = rclpy.create_node('deaf'); node.create_publisher(Imu, 'imu/data', 1); "
            "s = node.create_subscription(Imu, 'imu/data_raw', lambda message: None, 1); "
            'rclpy.spin(node)')
    with (live.NodeExam('imu/data', f'{sys.executable} -c "{deaf}"') as node,
          pytest.raises(InvalidOutputError, match='update 6 of 300 raises RuntimeError: no '
                        r'attitude has the stamp 1\.0600')):
        follow(node.make_filter, run)
