# SPDX-License-Identifier: Apache-2.0
"""
A recording node that is killed at a random moment: what the file still has.

test_recording.py tests on a simulated clock that messages are on the disk within max_loss.
KILLS=200 pytest test/test_kill.py is what `make stress` does; the suite kills one.
"""

import os
import random
import signal
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import SECOND, log_of, stamp_of, the_log

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools.recover import main as recover

# Three streams at 1 kHz: 3000 messages a second.
PARAMETERS = {
    'record.enabled': True, 'record.max_loss': 0.1, 'tick_rate': 500.0,
    'pose.rate': 1000.0, 'joint_states.rate': 1000.0, 'ground_truth_imu.rate': 1000.0,
    'imu.enabled': False, 'ground_truth_odom.enabled': False,
    'invariants.enabled': False, 'status_period': 0.0}
TOPICS = ('pose', 'joint_states', 'ground_truth/imu')


@pytest.mark.parametrize('run', range(int(os.environ.get('KILLS', '1'))))
def test_a_killed_node_leaves_a_log_that_recovers(peer, tmp_path, run):
    """What is in it is right, and as it was published."""
    moment = random.Random(run).uniform(0.0, 1.5)
    with SimNode(tmp_path, PARAMETERS, namespace=f'/kill{run}') as node:
        poses = peer.listen(node.topic('pose'), PoseStamped)
        wait_for('a log', lambda: len(poses) > 200 and list(node.folder.glob('*.mcap')))
        torn = the_log(node.folder)
        wait_for('some chunks', lambda: torn.stat().st_size > 100_000)
        time.sleep(moment)
        with LogReader(torn) as reader:
            in_file = reader.span[1]
        os.killpg(node.process.pid, signal.SIGKILL)
        node.process.wait()
        whole = node.folder / 'whole.mcap'
        assert recover([str(torn), '-o', str(whole)]) in {0, 3}
    log, metadata = log_of(whole)
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    for name in TOPICS:
        rows = log[node.topic(name)]
        stamps = np.array([stamp for stamp, _ in rows])
        # From t = 0 on, every sample, none twice, each with the bytes it was sent with.
        assert stamps[0] == epoch and set(np.diff(stamps)) == {SECOND // 1000}
        assert all(stamp_of(data) == stamp for stamp, data in rows)
    kept = dict(log[node.topic('pose')])
    assert (last_kept := max(kept)) >= in_file
    seen = {stamp_of(data): data for data in poses}
    assert all(kept[stamp] == data for stamp, data in seen.items() if stamp <= last_kept)
