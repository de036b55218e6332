# SPDX-License-Identifier: Apache-2.0
"""
A recording node that is killed at a random moment: what the file still has.

KILLS=200 pytest test/test_kill.py is what `make stress` does; the suite kills three.
"""

import os
import random
import signal
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode
from helpers.node_logs import SECOND, log_of, stamp_of, the_log

from spinning_top_sim.tools.recover import main as recover

MAX_LOSS_S = 0.3
TICK_S = 0.002
# Three streams at 1 kHz: 3000 messages a second.
PARAMETERS = {
    'record.enabled': True, 'record.max_loss': MAX_LOSS_S, 'tick_rate': 1.0 / TICK_S,
    'pose.rate': 1000.0, 'joint_states.rate': 1000.0, 'ground_truth_imu.rate': 1000.0,
    'imu.enabled': False, 'ground_truth_odom.enabled': False,
    'invariants.enabled': False, 'status_period': 0.0}
TOPICS = ('pose', 'joint_states', 'ground_truth/imu')


@pytest.mark.parametrize('run', range(int(os.environ.get('KILLS', '3'))))
def test_a_killed_node_leaves_a_log_that_recovers(peer, tmp_path, run):
    """
    What was seen on the wire and is not in the file is not older than max_loss and a tick.

    Arrival counts, not the clock: a message that was received had been handed to the recorder.
    """
    moment = random.Random(run).uniform(0.0, 1.5)
    with SimNode(tmp_path, PARAMETERS, namespace=f'/kill{run}') as node:
        poses = peer.listen(node.topic('pose'), PoseStamped)
        poses.wait(200)
        time.sleep(moment)
        os.killpg(node.process.pid, signal.SIGKILL)
        node.process.wait()
        poses.muted = True
        torn = the_log(node.folder)
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
    last_kept, last_seen = max(kept), stamp_of(poses.raw[-1])
    assert last_seen - last_kept <= (MAX_LOSS_S + TICK_S) * SECOND
    seen = {stamp_of(data): data for data in poses.raw}
    assert all(kept[stamp] == data for stamp, data in seen.items() if stamp <= last_kept)
