# SPDX-License-Identifier: Apache-2.0
"""The exam of a ROS node beside two busy processes: each fault is named, and no other."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import helpers.own_domain  # noqa: F401, before any node starts
from helpers.node_harness import DIE_WITH_PARENT

from spinning_top_sim.exam.live import examine_node

PATIENCE_S = 1800.0
MEMORY_MB = 4000            # DDS maps memory that it does not use
BUSY = 2
NODE = Path(__file__).parents[1] / 'helpers/faulty_node.py'
FAULTS = ('', 'conjugated', '', 'stamp_offset', '')


def check(seed, folder):
    fault = FAULTS[seed % len(FAULTS)]
    node = [*DIE_WITH_PARENT, sys.executable, str(NODE), *([fault] if fault else [])]
    runs = seed % 5 == 4
    processes = [subprocess.Popen([sys.executable, '-c', 'while True: pass'], cwd=folder)
                 for _ in range(BUSY)]
    try:
        if runs:
            processes.append(subprocess.Popen(node, cwd=folder))
        report = examine_node('imu/data', None if runs else ' '.join(node), seeds=[seed])
    finally:
        for process in processes:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
    assert report.faults == [fault] * bool(fault), str(report)
    return f'{"running" if runs else "started"} node: {fault or "passed"}'
