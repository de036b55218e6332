# SPDX-License-Identifier: Apache-2.0
"""How the node ends, and how it bears overload, readers that stall, and errors."""

import os
import re
import signal
import sys
import time

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import SimNode, wait_for
from helpers.node_logs import (
    SECOND,
    TRACEBACK,
    assert_clean_end,
    assert_received_from,
    decoded,
    log_of,
    the_log,
    verified,
)
from helpers.own_node import OwnNode

from spinning_top_sim.nodes import executable
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters

# A node whose log is opened when there is a file `go`
SLOW = """
import pathlib, sys, time
from spinning_top_sim.recording.writer import McapWriter
from spinning_top_sim.__main__ import main
ordinary = McapWriter.__init__
def opened(*arguments, **options):
    while not pathlib.Path('go').exists():
        time.sleep(0.01)
    ordinary(*arguments, **options)
McapWriter.__init__ = opened
sys.exit(main())
"""
INT, TERM = signal.SIGINT, signal.SIGTERM
ENDINGS = [     # executor, signals, other parameters, state of the recorder and of the motion then
    ('events', (signal.SIGHUP, signal.SIGQUIT), {}, 'recording', 'running'),
    ('single', (TERM, TERM), {'start_paused': True}, 'recording', 'paused'),
    ('events', (INT, INT), {}, 'opening', 'running'),
    ('single', (INT, TERM), {'use_sim_time': True}, 'off', 'waiting')]


@pytest.mark.parametrize(('executor', 'numbers', 'values', 'recorder', 'state'), ENDINGS)
def test_however_it_is_ended_the_log_is_whole(
        peer, diagnostics, tmp_path, executor, numbers, values, recorder, state):
    with SimNode(tmp_path, {'record.enabled': True, **values}, executor=executor,
                 program=('-c', SLOW, 'node') if recorder == 'opening' else None) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped)
        if state == 'running':
            pose.wait(10)
        wait_for('its state', lambda: (diagnostics.text(node, 'recorder'), diagnostics.text(
            node, 'state')) == (recorder, state))
        os.killpg(node.process.pid, numbers[0])
        time.sleep(0.05)
        (node.folder / 'go').touch()
        code = node.end(numbers[1])
        pose.muted = True
    assert_clean_end(node, code)
    if recorder == 'off':
        assert not list(node.folder.glob('*.mcap'))
        return
    path = the_log(node.folder)
    assert f'next: spinning-top inspect {path}\n      spinning-top view {path}\n' in node.out
    assert verified(path)['identical'] and path.name in node.out
    if state == 'running':
        logged = [data for _, data in log_of(path)[0][node.topic('pose')]]
        assert_received_from(pose.raw, logged)
        assert decoded(path)[node.topic('pose')] == len(logged)


@pytest.mark.parametrize(('number', 'delay'), [(INT, 0.35), (TERM, 0.5)])
def test_a_signal_while_it_starts_ends_it_quietly(monkeypatch, tmp_path, number, delay):
    # Python ignores what interrupts the module that starts coverage before the program.
    monkeypatch.delenv('COVERAGE_PROCESS_CONFIG', raising=False)
    with SimNode(tmp_path, {'record.enabled': True}) as node:
        time.sleep(delay)
        code = node.end(number)
    assert code != -signal.SIGKILL, ('it had to be killed', node.err)
    allowed = {0, 130} if number == INT else {0, -TERM}
    # Before our main() runs, Python itself answers; its `site` has a main(), too.
    if re.search(r'sim_node\.py", line \d+, in main', node.err) or code in (0, 130, 2):
        assert code in allowed, (code, node.err)
        assert TRACEBACK not in node.err, node.err
    for path in node.folder.glob('*.mcap'):
        with LogReader(path) as log:
            assert log.whole, (code, node.err)


def test_a_reader_of_the_terminal_who_goes_away_does_not_end_the_motion(monkeypatch):
    """As in `sim_node | head -1`."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, 'w') as out:
        monkeypatch.setattr(sys, 'stdout', out)
        for line in ('one', 'two'):
            executable.tell(line)


READER = """
import rclpy, sys
from geometry_msgs.msg import PoseStamped
from rclpy.qos import HistoryPolicy, QoSProfile
rclpy.init()
node = rclpy.create_node('reader')
node.create_subscription(PoseStamped, sys.argv[1], lambda _: print('.', end='', flush=True),
                         QoSProfile(history=HistoryPolicy.KEEP_ALL))
rclpy.spin(node)
"""


def test_readers_that_stall_are_counted_and_motion_and_recording_go_on(
        peer, diagnostics, tmp_path):
    values = {'record.enabled': True, 'pose.rate': 5000.0,
              'qos_overrides./keep/pose.publisher.history': 'keep_all'}
    with (SimNode(tmp_path, values, namespace='/keep') as node,
          SimNode(tmp_path, namespace='/reader', program=('-c', READER, '/keep/pose')) as reader):
        wait_for('messages', lambda: len(reader.out) > 100)
        os.kill(reader.process.pid, signal.SIGSTOP)
        wait_for('failures', lambda: int(diagnostics.text(node, 'failed messages')) > 1000)
        said = diagnostics.next(node)
        later = diagnostics.next(node)
        assert float(later['simulated time [s]']) > float(said['simulated time [s]'])
        assert (later['state'], later['recorder']) == ('running', 'recording')
        count = len(reader.out)
        os.kill(reader.process.pid, signal.SIGCONT)
        wait_for('more messages', lambda: len(reader.out) > count + 6000)
        assert_clean_end(node, node.end())
    path = the_log(node.folder)
    assert verified(path)['identical']
    assert set(np.diff([stamp for stamp, _ in log_of(path)[0]['/keep/pose']])) == {SECOND // 5000}


def test_overload_skips_what_is_live_records_everything_and_stays_reachable(tmp_path, capfd):
    streams = ('pose', 'joint_states', 'ground_truth_odom')
    rates = {f'{name}__rate': 10000.0 for name in streams}
    others = {f'{name}__enabled': name in streams for name in parameters.STREAMS}
    with OwnNode(tmp_path, **rates, **others, tick_rate=10000.0, time_scale=100.0,
                 record__enabled=True).listen('pose') as node:
        node.spin_until('a clock that slips, and samples that are skipped', lambda: (
            node.loop.slipped_ns and any(one.skipped for one in node.simulation.outputs)))
        level, message, said = node.diagnostics()
        node.diagnostics()
        assert (level, message) == (1, 'this machine cannot keep up')
        assert float(said['real-time factor']) < 99.0
        assert int(said['skipped samples']) > 0
        assert node.switch('set_pause', True).success
    assert capfd.readouterr().err.count('live topics skip samples') == 1
    assert verified(tmp_path / 'run.mcap')['identical']


@pytest.mark.parametrize('name', ['tick', 'set_parameters'])
def test_an_error_that_nobody_expects_stops_the_motion_loudly_until_a_reset(
        monkeypatch, tmp_path, capfd, name):
    def broken(*_, **__):
        raise ZeroDivisionError('nobody expected this')

    reason = 'unexpected ZeroDivisionError: nobody expected this'
    with OwnNode(tmp_path, record__enabled=True).listen('pose') as node:
        node.spin_until('samples', lambda: len(node.heard['pose']) > 5)
        with monkeypatch.context() as patch:
            patch.setattr(node.loop, name, broken)
            if name == 'set_parameters':
                assert 'nobody expected this' in node.set(pose__rate=50.0).reason
            node.spin_until('an error', lambda: node.loop.failure)
        node.spin_until('the end of the recording', lambda: (
            node.diagnostics()[:2] == (2, f'recording: {reason}')))
        assert node.loop.failure == reason
        said = capfd.readouterr().err
        assert 'until ~/reset' in said and TRACEBACK in said
        answer = node.switch('set_pause', False)
        assert not answer.success and f'stands still: {reason}' in answer.message
        heard = list(node.heard['pose'])
        assert node.trigger('reset').success
        node.wait_until(100_000_000)
    assert_received_from(heard, [data for _, data in log_of(tmp_path / 'run.mcap')[0]['/pose']])
