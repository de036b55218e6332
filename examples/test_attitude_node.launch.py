# SPDX-License-Identifier: Apache-2.0
"""
Start a node with an attitude filter and examine it, with launch_testing.

  launch_test examples/test_attitude_node.launch.py
"""

import sys
import unittest
from pathlib import Path

from launch import LaunchDescription
from launch.actions import ExecuteProcess
from launch_testing.actions import ReadyToTest

from spinning_top_sim.exam.live import examine_node

NODE = Path(__file__).with_name('attitude_node.py')


def generate_test_description():
    """Start the node; the tests may begin at once, because the exam waits for it."""
    return LaunchDescription([ExecuteProcess(cmd=[sys.executable, str(NODE)]), ReadyToTest()])


class TestAttitude(unittest.TestCase):
    """Of the node while it runs."""

    def test_it_has_no_faults(self):
        """Feed the node, and look at the verdict."""
        report = examine_node('imu/data', seeds=1)
        self.assertTrue(report.passed, str(report))
