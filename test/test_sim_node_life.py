# SPDX-License-Identifier: Apache-2.0
"""How a node in this process bears overload, stalled readers and full disks."""

import errno
import os
import subprocess
import sys
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip('rclpy')

import rclpy
from geometry_msgs.msg import PoseStamped
from helpers.node_logs import log_of, verified
from helpers.own_node import OwnNode
from rclpy.qos import HistoryPolicy, QoSProfile

from spinning_top_sim.nodes import clock, loop
from spinning_top_sim.recording.writer import McapWriter
from spinning_top_sim.streams import parameters


def test_readers_that_stall_are_counted_and_motion_and_recording_go_on(tmp_path):
    with OwnNode(tmp_path, '-p', 'qos_overrides./pose.publisher.history:=keep_all',
                 pose__rate=5000.0, record__enabled=True) as node:
        reader = rclpy.create_node('reader')        # nobody spins it
        taken = reader.create_subscription(
            PoseStamped, '/pose', print, QoSProfile(history=HistoryPolicy.KEEP_ALL))
        node.spin_until('failures', lambda: int(node.diagnostics()[2]['failed messages']) > 1000)
        _, _, said = node.diagnostics()
        assert (said['state'], said['recorder']) == ('running', 'recording')
        reader.destroy_subscription(taken)
        t_ns = node.simulation.sent_ns
        node.wait_until(t_ns + 100_000_000)
        reader.destroy_node()
    path = tmp_path / 'run.mcap'
    assert verified(path)['identical']
    assert set(np.diff([stamp for stamp, _ in log_of(path)[0]['/pose']])) == {200_000}


def test_overload_skips_what_is_live_records_everything_and_stays_reachable(
        tmp_path, capfd, monkeypatch):
    for name in ('LATEST_NS', 'LONGEST_LAG_NS'):
        monkeypatch.setattr(clock, name, 20_000_000)
    monkeypatch.setattr(loop, 'TICK_BUDGET_NS', 5_000_000)
    others = {f'{name}__enabled': name == 'pose' for name in parameters.STREAMS}
    with OwnNode(tmp_path, pose__rate=10000.0, **others, tick_rate=10000.0, time_scale=100.0,
                 record__enabled=True).listen('pose') as node:
        node.spin_until('a clock that slips, and samples that are skipped', lambda: (
            node.loop.slipped_ns and any(one.skipped for one in node.simulation.outputs)))
        level, message, said = node.diagnostics()
        assert (level, message) == (1, 'this machine cannot keep up')
        assert int(said['skipped samples']) > 0
        node.diagnostics()
        assert node.switch('set_pause', True).success
    assert capfd.readouterr().err.count('live topics skip samples') == 1
    assert verified(tmp_path / 'run.mcap')['identical']


def test_a_recording_that_fails_is_told_and_gives_way_to_the_next(
        tmp_path, monkeypatch, capfd):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, 'No space left on device')

    precious = tmp_path / 'run.mcap'
    precious.write_bytes(b'precious')
    with OwnNode(tmp_path, record__enabled=True) as node:
        node.spin_until('an error', lambda: node.diagnostics()[0] == 2)
        assert 'exists' in node.diagnostics()[1]
        answer = node.switch('record', True)
        assert not answer.success and 'exists' in answer.message
        assert not any(one.is_used for one in node.simulation.outputs)
        assert node.set(record__uri=f'{tmp_path}/new/er.mcap/').successful
        with monkeypatch.context() as patch:
            patch.setattr('threading.Thread.start', Mock(side_effect=RuntimeError('no thread')))
            assert node.switch('record', True).message == 'no thread'
        answers = [node.switch('record', True).message for _ in range(2)]
        (path,) = (tmp_path / 'new/er.mcap').iterdir()
        assert answers == 2 * [f'recording to {path}']
        with monkeypatch.context() as patch:
            patch.setattr(McapWriter, '_write_chunk', full)
            node.spin_until('an error', lambda: node.diagnostics()[0] == 2)
        level, message, said = node.diagnostics()
        assert (level, said['recorder'], said['state']) == (2, 'failed', 'running')
        assert f'{path}' in message and 'No space left' in message
    errors = [line for line in capfd.readouterr().err.splitlines() if 'ERROR' in line]
    assert ['not recording' in line for line in errors] == 3 * [True]
    assert precious.read_bytes() == b'precious' and log_of(path), 'it has a summary'


def test_who_ends_the_recording_behind_the_end_still_gets_an_answer(tmp_path):
    with OwnNode(tmp_path, duration=0.05, record__enabled=True) as node:
        node.spin_until('the end', lambda: node.loop.state is loop.LoopState.ENDED)
        answer = node.switch('record', False)
    assert answer.success and f'{tmp_path}/run.mcap: ' in answer.message


def test_a_reader_of_the_status_that_stalls_holds_nothing_up():
    program = ('from spinning_top_sim.nodes.executable import tell\n'
               'for _ in range(3000): tell(99 * "x")')
    for reading, writing in (os.pipe(), os.openpty()):
        subprocess.run([sys.executable, '-c', program], stdout=writing, timeout=60.0, check=True)
        assert os.get_blocking(writing) and os.read(reading, 100).split() == [99 * b'x']
        os.close(reading)
        os.close(writing)
