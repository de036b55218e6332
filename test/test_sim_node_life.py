# SPDX-License-Identifier: Apache-2.0
"""How the node ends, what it imports, how it bears overload, faults and full disks."""

import os
import re
import signal
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
    stamp_of,
    the_log,
)
from helpers.own_node import OwnNode
from helpers.simulations import play, simulate, stream

from spinning_top_sim.nodes import terminal
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters


def test_the_published_orientation_error_is_that_of_the_published_pose():
    """Column 7 of ~/invariants against the pose of the same instant and the exact solution."""
    run = simulate(invariants__rate=100.0)
    taken = play(run, SECOND // 2, 'pose', '~/invariants')
    invariants, poses = (np.vstack([stream(run, topic).template.decode(data)[place]
                                    for name, _, data in taken if name == topic])
                         for topic, place in (('~/invariants', 0), ('pose', 1)))
    exact = ExactSolution(run.top, parameters.start_state(run.values))
    truth = exact.states(range(0, SECOND // 2 + 1, SECOND // 100)).quaternion
    computed = 4.0 * np.arctan2(*(np.linalg.norm(part, axis=1)
                                  for part in (poses - truth, poses + truth)))
    assert 1e-14 < invariants[:, 7].max() < 1e-9
    assert invariants[:, 7] == pytest.approx(computed, rel=1e-6, abs=2e-15)


@pytest.mark.parametrize('numbers', [
    (signal.SIGINT, signal.SIGINT), (signal.SIGHUP, signal.SIGQUIT)], ids=['int', 'hup'])
def test_however_it_is_ended_the_log_is_whole(peer, tmp_path, numbers):
    with SimNode(tmp_path, {'record.enabled': True}) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(20)
        os.killpg(node.process.pid, numbers[0])
        time.sleep(0.05)
        code = node.end(numbers[1])
        pose.muted = True
    assert_clean_end(node, code)
    path = the_log(node.folder)
    log, _ = log_of(path)
    logged = [data for _, data in log[node.topic('pose')]]
    assert_received_from(pose.raw, logged)
    assert decoded(path)[node.topic('pose')] == len(logged)
    assert path.name in node.out, 'it says what it has recorded'
    assert f'next: spinning-top inspect {path}\n      spinning-top view {path}\n' in node.out


@pytest.mark.parametrize(('number', 'delay'), [(signal.SIGINT, 0.35), (signal.SIGTERM, 0.5)])
def test_a_signal_while_it_starts_ends_it_quietly(monkeypatch, tmp_path, number, delay):
    # Python ignores what interrupts the module that starts coverage before the program.
    monkeypatch.delenv('COVERAGE_PROCESS_CONFIG', raising=False)
    with SimNode(tmp_path, {'record.enabled': True}) as node:
        time.sleep(delay)
        code = node.end(number)
    assert code != -signal.SIGKILL, ('it had to be killed', node.err)
    allowed = {0, 130} if number == signal.SIGINT else {0, -signal.SIGTERM}
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
        monkeypatch.setattr(terminal.sys, 'stdout', out)
        shown = terminal.Terminal()
        shown.show('one')
        shown.show('two')


def test_overload_skips_what_is_live_records_everything_and_stays_reachable(tmp_path, capfd):
    streams = ('pose', 'joint_states', 'ground_truth_odom')
    rates = {f'{name}__rate': 10000.0 for name in streams}
    others = {f'{row[0]}__enabled': row[0] in streams for row in parameters.STREAM_DEFAULTS}
    with OwnNode(tmp_path, **rates, **others, tick_rate=10000.0, time_scale=100.0,
                 record__enabled=True) as node:
        node.listen('pose')
        wait_for('a clock that slips, and samples that are skipped', lambda: (
            node.loop.slipped_ns and any(one.skipped for one in node.simulation.outputs)))
        level, message, said = node.diagnostics()
        node.diagnostics()
        assert (level, message) == (1, 'this machine cannot keep up')
        assert float(said['real-time factor']) < 99.0
        assert int(said['skipped samples']) > 0
        assert node.switch('set_pause', True).success
    assert capfd.readouterr().err.count('live topics skip samples') == 1
    log, metadata = log_of(tmp_path / 'run.mcap')
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    for name in ('pose', 'joint_states', 'ground_truth/odom'):
        times = np.array([time for time, _ in log[f'/{name}']])
        assert times[0] == epoch
        assert set(np.diff(times)) == {100_000}, name
    assert len(node.heard['pose']) < len(log['/pose'])


# In a tick, in reports, in a parameter's change.
BREAKABLE = {
    'loop.tick': None, '_report.diagnostics': None,
    'loop.set_pace': lambda node: node.set(pose__rate=50.0)}


@pytest.mark.parametrize('path', BREAKABLE)
def test_an_error_that_nobody_expects_stops_the_motion_loudly_until_a_reset(
        monkeypatch, tmp_path, capfd, path):
    def broken(*_, **__):
        raise ZeroDivisionError('nobody expected this')

    with OwnNode(tmp_path, status_period=0.05, record__enabled=True) as node:
        node.listen('pose')
        wait_for('samples', lambda: len(node.heard['pose']) > 5)
        wait_for('a recording', lambda: node.node._session._recorder)
        owner, name = path.split('.')
        with monkeypatch.context() as patch:
            patch.setattr(getattr(node.node, owner), name, broken)
            if BREAKABLE[path]:
                answer = BREAKABLE[path](node)
                if answer is not None:
                    assert 'nobody expected this' in str(answer)
            elif owner == '_report':
                for timer in node.node.timers:
                    timer.callback()
            wait_for('an error', lambda: node.loop.failure)
        wait_for('the end of the recording', lambda: node.node._session.error)
        node.node._session.stop()           # waits until the log is closed
        level, message, _ = node.diagnostics()
        reason = 'unexpected ZeroDivisionError: nobody expected this'
        assert (level, message) == (2, f'recording: {reason}')
        assert node.loop.failure == reason
        said = capfd.readouterr().err
        assert 'until ~/reset' in said and TRACEBACK in said
        node.node._show_status()
        assert ' FAILED |' in capfd.readouterr().out.splitlines()[-1]
        logged = [data for _, data in log_of(tmp_path / 'run.mcap')[0]['/pose']]
        assert_received_from([data for data in node.heard['pose']
                              if stamp_of(data) >= stamp_of(logged[0])], logged)
        answer = node.switch('set_pause', False)
        assert not answer.success and f'stands still: {reason}' in answer.message
        assert node.trigger('reset').success
        node.wait_until(100_000_000)
