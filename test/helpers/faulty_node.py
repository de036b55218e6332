# SPDX-License-Identifier: Apache-2.0
"""The node of examples/, if named with a fault of helpers.faulty_filters."""

import contextlib
import sys
from functools import partial
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2] / 'examples')]

from attitude_node import AttitudeNode  # noqa: E402

from helpers.faulty_filters import MISREADINGS  # noqa: E402
from spinning_top_sim.exam.adapters import Vqf  # noqa: E402

rclpy.init()
node = AttitudeNode()
for name in sys.argv[1:]:
    node.filter = MISREADINGS[name](partial(Vqf, magnetic=False))
with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(node)
