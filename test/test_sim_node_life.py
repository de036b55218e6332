# SPDX-License-Identifier: Apache-2.0
"""How the node ends, what it does not do while nobody listens, and how it bears overload."""

import json
import os
import signal
import subprocess
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import PATIENCE_S, Diagnostics, SimNode, wait_for
from helpers.node_logs import (
    KINDS,
    PERIODS_NS,
    QUIET,
    SECOND,
    TRACEBACK,
    assert_clean_end,
    assert_received_from,
    by_parameters,
    decoded,
    log_of,
    settled,
    stamp_of,
    the_log,
)
from sensor_msgs.msg import JointState

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.solvers.exact import ExactSolution
from spinning_top_sim.streams import parameters

# What there is after 1000 ticks, and after 3000.
OBJECTS = """
import gc, json, sys
from spinning_top_sim.nodes.sim_node import main
from spinning_top_sim.nodes.simulator import Simulator
ordinary, ticks, counts = Simulator._tick, [], []
def tick(self):
    wanted = ordinary(self)
    ticks.append(None)
    # What is computed ahead comes and goes: the least of ten.
    if len(ticks) in (*range(910, 1001, 10), *range(2910, 3001, 10)):
        gc.collect()
        counts.append(len(gc.get_objects()))
    if len(ticks) == 3000:
        open('objects.json', 'w').write(json.dumps([min(counts[:10]), min(counts[10:])]))
        self.finished.set_result(None)
    return wanted
Simulator._tick = tick
sys.exit(main())
"""
EXIT_HOOK = """
import atexit, json, os, runpy, sys
atexit.register(lambda: open('modules.json', 'w').write(json.dumps(sorted(sys.modules))))
runpy.run_module('spinning_top_sim.nodes.sim_node', run_name='__main__')
"""


@pytest.fixture(scope='module')
def finished(tmp_path_factory):
    """Runs of 1.5 s that ended by themselves: two alike, a third paced by a thread, one silent."""
    folder = tmp_path_factory.mktemp('finished')
    values = {'duration': 1.5, 'record.enabled': True, 'invariants.rate': 100.0,
              'imu.gyroscope_noise_density': 0.001, 'seed': 5}
    runs = {'/one': values, '/two': {**values, 'tick_rate': 77.0},
            '/three': {**values, 'pacing': 'thread', 'tick_rate': 500.0},
            '/silent': {'duration': 1.5, **QUIET}}
    nodes = [SimNode(folder, values, namespace=name, program=('-c', EXIT_HOOK))
             for name, values in runs.items()]
    for node in nodes:
        node.__enter__()
    codes = [node.wait() for node in nodes]
    for node in nodes:
        node.__exit__()
    return SimpleNamespace(nodes=nodes, codes=codes)


def test_the_duration_ends_the_run_and_its_last_sample_is_in_the_log(finished):
    for node, code in zip(finished.nodes, finished.codes, strict=True):
        assert_clean_end(node, code)
    for node in finished.nodes[:3]:
        path = the_log(node.folder)
        log, metadata = log_of(path)
        epoch = int(metadata['spinning_top_sim']['epoch_ns'])
        for name, period in PERIODS_NS.items():
            times = [time - epoch for time, _ in log[node.topic(name)]]
            assert times == list(range(0, 3 * SECOND // 2 + 1, period))
        assert path.name in node.out


def test_runs_of_the_same_parameters_are_the_same_bytes_but_for_stamps(finished):
    """However often ticks come; `pacing` is accepted, and without effect."""
    logs = []
    for node in finished.nodes[:3]:
        log, _ = log_of(the_log(node.folder))
        logs.append({topic[len(node.namespace):]: [
            data if 'invariants' in topic else data[:4] + data[12:] for _, data in rows]
            for topic, rows in log.items() if not topic.endswith(('/events', '/commands'))})
    assert logs[0] == logs[1]
    assert logs[0] == logs[2]
    assert len(logs[0]) == 7
    assert len(set(logs[0]['/imu/data_raw'])) == 301


def test_the_published_orientation_error_is_the_one_computed_from_the_log(finished):
    """Column 7 of ~/invariants against the pose of the same instant and the exact solution."""
    node = finished.nodes[0]
    log, metadata = log_of(the_log(node.folder))
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    values = parameters.checked({})
    exact = ExactSolution(parameters.top_of(values), parameters.start_state(values))
    poses = {t: np.frombuffer(data[-32:], '<f8') for t, data in log[node.topic('pose')]}
    rows = log[node.topic('~/invariants')]
    assert len(rows) == 151
    published, computed = [], []
    truth = exact.states(np.array([t - epoch for t, _ in rows])).rows_quaternion
    for (t, data), q in zip(rows, np.transpose(truth), strict=True):
        p = poses[t]
        computed.append(4.0 * np.arctan2(np.linalg.norm(p - q), np.linalg.norm(p + q)))
        published.append(np.frombuffer(data[-64:], '<f8')[7])
    assert 1e-13 < max(published) < 1e-9
    assert published == pytest.approx(computed, rel=1e-6, abs=2e-15)


def test_an_error_beyond_max_error_is_warned_about(peer, diagnostics, tmp_path):
    with SimNode(tmp_path, {'solver.rtol': 1e-3, 'solver.atol': 1e-3, 'max_error': 1e-9}) as node:
        status = diagnostics.wait_for(node, 'a warning', lambda s: s.level == b'\x01')
        assert 'max_error = 1e-09 rad' in status.message
        assert_clean_end(node, node.end())


def test_what_a_scene_does_not_need_is_not_imported(finished):
    for node in finished.nodes:
        modules = json.loads((node.folder / 'modules.json').read_text())
        roots = {name.split('.')[0] for name in modules}
        assert 'spinning_top_sim' in roots
        assert not roots & {'scipy', 'matplotlib', 'pandas', 'yaml.cyaml', 'tqdm'}
        records = node.namespace != '/silent'
        assert ('mcap' in roots) == records
        assert 'visualization_msgs' not in roots
        assert ('spinning_top_sim.recording.writer' in modules) == records


def test_wake_ups_leave_no_objects_behind(tmp_path):
    with SimNode(tmp_path, {**QUIET, 'tick_rate': 1000.0},
                 program=('-c', OBJECTS)) as node:
        assert_clean_end(node, node.wait())
    early, late = json.loads((node.folder / 'objects.json').read_text())
    assert 0 < late < early + 500, 'two thousand wake-ups'


def test_the_default_scene_imports_just_what_it_uses(finished):
    node = next(node for node in finished.nodes if node.namespace == '/silent')
    modules = json.loads((node.folder / 'modules.json').read_text())
    ours = {name.removeprefix('spinning_top_sim.') for name in modules
            if name.startswith('spinning_top_sim.') and name.count('.') == 2}
    assert {name for name in ours if name.startswith(('nodes.', 'recording.', 'tools.'))} == {
        'nodes.executable', 'nodes.pacing', 'nodes.recording_session', 'nodes.reports',
        'nodes.ros_parameters', 'nodes.simulator', 'nodes.throttle', 'nodes.tick_loop',
        'recording.errors'}
    messages = {name.split('.')[0] for name in modules if name.endswith('_msgs')}
    assert messages <= {
        'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'sensor_msgs', 'std_msgs',      # ours
        'rosgraph_msgs', 'service_msgs', 'unique_identifier_msgs'}                    # rclpy's


# ------------------------------------------------------------------------------------ the end

ENDS = {'sigint': (signal.SIGINT, 1, 0.0), 'sigterm': (signal.SIGTERM, 1, 0.0),
        'twice at once': (signal.SIGINT, 2, 0.0), 'twice, 50 ms': (signal.SIGINT, 2, 0.05),
        'twice, 200 ms': (signal.SIGINT, 2, 0.2), 'term twice': (signal.SIGTERM, 2, 0.02),
        'five times': (signal.SIGINT, 5, 0.01), 'sighup': (signal.SIGHUP, 1, 0.0),
        'sigquit': (signal.SIGQUIT, 1, 0.0), 'hup and hup': (signal.SIGHUP, 2, 0.05)}


@pytest.mark.parametrize('case', ENDS)
def test_however_it_is_ended_the_log_is_whole(peer, tmp_path, case):
    number, times, gap = ENDS[case]
    with SimNode(tmp_path, {'record.enabled': True}) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(20)
        code = node.end(number, times, gap)
        peer.stop_listening(pose)
    print(f'{case}: ended within {node.seconds_to_end:.2f} s')
    assert_clean_end(node, code)
    path = the_log(node.folder)
    log, _ = log_of(path)
    logged = [data for _, data in log[node.topic('pose')]]
    assert_received_from(pose.raw, logged)
    assert decoded(path)[node.topic('pose')] == len(logged)
    assert path.name in node.out, 'it says what it has recorded'


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_it_starts_ends_it_quietly(monkeypatch, tmp_path, number):
    """From 0.15 s (python is there) on to where it runs."""
    # Python ignores what interrupts the module that starts coverage before the program.
    monkeypatch.delenv('COVERAGE_PROCESS_CONFIG', raising=False)
    seen = set()
    for delay in (0.15, 0.25, 0.35, 0.5, 0.7, 0.9, PATIENCE_S):
        with SimNode(tmp_path / str(delay), {'record.enabled': True}) as node:
            end = time.monotonic() + delay
            while time.monotonic() < end and 'recording to' not in node.err:
                time.sleep(0.01)
            code = node.end(number)
        seen.add(code)
        allowed = {0, 130} if number == signal.SIGINT else {0, -signal.SIGTERM}
        # Before our main() runs, Python itself answers.
        if 'in main' in node.err or code in (0, 130, 2):
            assert code in allowed, (delay, code, node.err)
            assert TRACEBACK not in node.err, (delay, node.err)
        for path in node.folder.glob('*.mcap'):
            log_of(path)
        print(f'{number.name} after {delay} s: {code} within {node.seconds_to_end:.2f} s')
    assert 0 in seen


def test_a_sigint_that_python_drops_ends_it_all_the_same(tmp_path):
    """One that comes in a weak reference's callback, of which imports have many."""
    program = """
import signal, sys, weakref
from spinning_top_sim.nodes import executable
def prepare(argv):
    class Thing:
        pass
    thing = Thing()
    reference = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
    del thing
    return lambda: print('made')
sys.exit(executable.run('program', sys.argv, prepare))
"""
    with SimNode(tmp_path, program=('-c', program)) as node:
        assert node.wait() == 130
    assert node.out == node.err == ''


def test_a_reader_of_the_terminal_who_goes_away_does_not_end_the_motion(peer, tmp_path):
    """As in `sim_node | head -1`: the status line has no reader, the topics have."""
    with SimNode(tmp_path, {'status_period': 0.05}, program=(
            '-c', 'import os, runpy; r, w = os.pipe(); os.dup2(w, 1); os.close(r); os.close(w)\n'
            'runpy.run_module("spinning_top_sim.nodes.sim_node", run_name="__main__")')) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(60)
        assert node.alive, node.err
        code = node.end()
        peer.stop_listening(pose)
    assert code == 0, node.err
    assert TRACEBACK not in node.err


def test_without_the_events_executor_the_node_works_too(peer, tmp_path):
    program = ('import runpy, sys; sys.modules["rclpy.experimental"] = None\n'
               'runpy.run_module("spinning_top_sim.nodes.sim_node", run_name="__main__")')
    with SimNode(tmp_path, {**QUIET, 'record.enabled': True}, program=('-c', program)) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(30)
        assert peer.switch(node, 'set_pause', True).success
        by_parameters(peer, node, 2.0, 1.0)
        assert_clean_end(node, node.end())
        peer.stop_listening(pose)
    log_of(the_log(node.folder))


# ------------------------------------------------------------------- nobody listens, overload

def test_only_what_is_listened_to_is_encoded(peer, tmp_path):
    """The node counts the samples whose numbers it puts into messages, stream by stream."""
    counting = """
import atexit, json, runpy
from spinning_top_sim.streams import topics
counts = {}
def count(kind):
    original = kind.fields
    def fields(self, states, times):
        counts[self.topic] = counts.get(self.topic, 0) + len(times)
        return original(self, states, times)
    kind.fields = fields
for kind in list(vars(topics).values()):
    if isinstance(kind, type) and issubclass(kind, topics.Stream) and 'fields' in vars(kind):
        count(kind)
atexit.register(lambda: open('counts.json', 'w').write(json.dumps(counts)))
runpy.run_module('spinning_top_sim.nodes.sim_node', run_name='__main__')
"""
    for listens in (False, True):
        with SimNode(tmp_path / str(listens), QUIET, program=('-c', counting)) as node:
            clock = Diagnostics(peer)
            if listens:
                pose = peer.listen(node.topic('pose'), PoseStamped).wait(30)
            said = clock.next(node)
            assert float(said['simulated time [s]']) > 0.5
            code = node.end()
        assert_clean_end(node, code)
        counts = json.loads((node.folder / 'counts.json').read_text())
        if listens:
            assert set(counts) == {'pose'}
            assert counts['pose'] >= len(pose.raw) >= 30
            peer.stop_listening(pose)
        else:
            assert counts == {}


def test_overload_skips_what_is_live_records_everything_and_stays_reachable(
        peer, diagnostics, tmp_path):
    rates = {f'{row[0]}.rate': 10000.0 for row in parameters.STREAM_DEFAULTS if row[1]}
    with SimNode(tmp_path, {**rates, **QUIET, 'tick_rate': 10000.0, 'time_scale': 50.0,
                            'record.enabled': True}) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(1)
        samples = []
        wait_for('a clock that slips', lambda: diagnostics.number(node, 'clock slip [s]') > 0)
        for _ in range(2):
            samples.append((node.memory(), diagnostics.next(node)))
        assert peer.get(node, 'time_scale') == [50.0]
        begun = time.monotonic()
        assert peer.get(node, 'tick_rate') == [10000.0]
        answered = time.monotonic() - begun
        code = node.end()
        err = node.err
        peer.stop_listening(pose)
    print(f'answered within {answered:.2f} s, ended within {node.seconds_to_end:.2f} s, '
          f'{max(memory for memory, _ in samples) / 1e6:.0f} MB, {samples[-1][1]}')
    assert_clean_end(node, code)
    assert max(memory for memory, _ in samples) < 400e6
    assert 0.0 < float(samples[-1][1]['real-time factor']) < 49.0
    assert int(samples[-1][1]['skipped samples']) > 0
    assert err.count('cannot keep up') == 1
    log, metadata = log_of(the_log(node.folder))
    epoch = int(metadata['spinning_top_sim']['epoch_ns'])
    for name in (*KINDS, '~/invariants'):
        times = np.array([time for time, _ in log[node.topic(name)]])
        assert times[0] == epoch
        assert set(np.diff(times)) == {100_000}, name


def test_a_top_that_spins_too_fast_for_real_time_leaves_the_node_reachable(
        peer, diagnostics, tmp_path):
    """Millions of steps a second: a tick ends in the midst of an integration."""
    with SimNode(tmp_path, {'spin.l3': 1e5, 'status_period': 0.2}) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped)
        said = diagnostics.next(node)
        assert float(said['real-time factor']) < 1.0
        peer.introduce(node, diagnostics)
        by_parameters(peer, node, 1.6, 1.4)
        pose.wait_more(20)
        assert peer.trigger(node, 'reset').success
        assert node.alive, node.err
        assert_clean_end(node, node.end())
        peer.stop_listening(pose)


def test_the_euler_form_at_a_pole_stands_still_and_says_why(peer, diagnostics, tmp_path):
    with SimNode(tmp_path, {'solver.equations': 'euler', 'initial.theta': 0.5,
                            'initial.theta_dot': -3.0, 'spin.l3': 0.2, 'spin.lz': -0.2,
                            'status_period': 0.2}) as node:
        status = diagnostics.wait_for(node, 'a failure', lambda s: s.level == b'\x02')
        assert 'pole' in status.message
        assert not peer.set_together(node, spin__l3=1.0).successful
        assert peer.set_together(node, solver__equations='transport').successful
        assert peer.trigger(node, 'reset').success
        joints = peer.listen(node.topic('joint_states'), JointState).wait(50)
        assert node.alive
        assert_clean_end(node, node.end())
        peer.stop_listening(joints)
    assert 'leapt over a pole' in node.err


# In a tick, in idle work, in reports, in a service, by a topic, in a parameter's change.
BREAKABLE = (
    'tick_loop.TickLoop.tick', 'tick_loop.TickLoop.idle', 'reports.MotionReport.diagnostics',
    'reports.MotionReport.status_line', 'tick_loop.TickLoop.pause', 'tick_loop.TickLoop.command',
    'tick_loop.TickLoop.set_pace')
# Each of these methods raises as long as there is a file of its name.
BREAKING = f"""
import importlib, os, sys
from spinning_top_sim.nodes.sim_node import main
def break_(path):
    module, kind, name = path.rsplit('.', 2)
    kind = getattr(importlib.import_module('spinning_top_sim.nodes.' + module), kind)
    ordinary = getattr(kind, name)
    def method(*arguments):
        if os.path.exists(path):
            raise ZeroDivisionError('nobody expected this')
        return ordinary(*arguments)
    setattr(kind, name, method)
for path in {BREAKABLE!r}:
    break_(path)
sys.exit(main())
"""


@pytest.fixture(scope='module')
def breakable(peer, diagnostics, tmp_path_factory):
    with SimNode(tmp_path_factory.mktemp('breakable'), {'status_period': 0.2},
                 program=('-c', BREAKING)) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped)
        peer.introduce(node, diagnostics)
        yield SimpleNamespace(node=node, pose=pose)
        assert node.end() == 0, node.err
        peer.stop_listening(pose)


@pytest.mark.parametrize('method', BREAKABLE)
def test_an_error_that_nobody_expects_stops_the_motion_loudly_until_a_reset(
        peer, diagnostics, breakable, method):
    node, pose = breakable.node, breakable.pose
    log = node.folder / f'{method}.mcap'
    assert peer.set_together(node, record__uri=str(log)).successful
    assert peer.switch(node, 'record', True).success
    before, said = len(pose.raw), node.err.count('until ~/reset')
    pose.wait(before + 20)
    (node.folder / method).touch()
    if method.endswith('pause'):
        answer = peer.switch(node, 'set_pause', True)
        assert not answer.success and 'nobody expected this' in answer.message
    elif method.endswith('command'):
        peer.send_command(node, 1.0, 1.0)
    elif method.endswith('pace'):
        answer = peer.set_together(node, pose__rate=50.0)
        assert not answer.successful and 'nobody expected this' in answer.reason
    wait_for('an error', lambda: node.err.count('until ~/reset') > said)
    (node.folder / method).unlink()
    status = diagnostics.wait_for(node, 'an error', lambda s: s.level == b'\x02')
    assert 'unexpected ZeroDivisionError: nobody expected this' in status.message
    wait_for('the status line', lambda: ' FAILED |' in node.out.splitlines()[-1])
    count = settled(pose)
    logged = [data for _, data in log_of(log)[0][node.topic('pose')]]
    assert_received_from([data for data in pose.raw if stamp_of(data) >= stamp_of(logged[0])],
                         logged)
    assert peer.trigger(node, 'reset').success
    pose.wait(count + 50)
    status = diagnostics.wait_for(node, 'the recording that ended',
                                  lambda s: 'recording: unexpected' in s.message)
    assert status.level == b'\x02'


HUNG_DISK = """
import os, runpy, time
ordinary = os.fsync
os.fsync = lambda file: time.sleep(1000.0) if os.path.exists('hung') else ordinary(file)
runpy.run_module('spinning_top_sim.nodes.sim_node', run_name='__main__')
"""


def test_with_a_hung_disk_the_node_ends_all_the_same(peer, tmp_path):
    with SimNode(tmp_path, {**QUIET, 'record.enabled': True, 'record.max_loss': 0.1},
                 program=('-c', HUNG_DISK)) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped).wait(50)
        (node.folder / 'hung').touch()
        pose.wait_more(100)                 # the motion goes on meanwhile
        os.killpg(node.process.pid, signal.SIGINT)
        assert node.wait(60.0) == 0, node.err
        peer.stop_listening(pose)
    assert 'could not be closed within' in node.out
    assert TRACEBACK not in node.err


SMALL_FILES = """
import resource, runpy, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
runpy.run_module('spinning_top_sim.nodes.sim_node', run_name='__main__')
"""


def test_a_full_disk_stops_the_recording_and_nothing_else(peer, diagnostics, tmp_path):
    """A file may not grow beyond 300 kB: the write that would fails, as on a full disk."""
    with SimNode(tmp_path, {'record.enabled': True, 'record.compression': 'none',
                            'record.max_loss': 0.2, 'status_period': 0.2},
                 program=('-c', SMALL_FILES)) as node:
        status = diagnostics.wait_for(node, 'an error', lambda s: s.level == b'\x02')
        assert 'File too large' in status.message
        poses = peer.listen(node.topic('pose'), PoseStamped).wait(50)
        again = peer.switch(node, 'record', True)
        assert again.success, again.message
        assert_clean_end(node, node.end())
        peer.stop_listening(poses)
    assert node.err.count('recording stopped') >= 1
    logs = sorted(node.folder.glob('*.mcap'))
    assert len(logs) == 2
    with LogReader(logs[0]) as reader:      # there may have been no room for an index
        stamps = [message.log_time for message in reader.messages([node.topic('pose')])]
        assert not reader.damage.losses
    assert len(stamps) > 20 and set(np.diff(stamps)) == {PERIODS_NS['pose']}


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 2 MB, half of it taken by a file `ballast`."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    mounted = subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', 'size=2m', 'tmpfs', disk], check=False,
        capture_output=True, text=True, timeout=20)
    if mounted.returncode:
        pytest.skip(f'mounting a small disk is not allowed: {mounted.stderr.strip()}')
    (disk / 'ballast').write_bytes(bytes(1_000_000))
    yield disk
    subprocess.run(['umount', '--lazy', disk], check=True, timeout=20)


def test_a_full_disk_and_a_new_recording_when_there_is_room(
        peer, diagnostics, tmp_path, small_disk):
    with SimNode(tmp_path, {'record.enabled': True, 'record.compression': 'none',
                            'record.uri': str(small_disk / 'first.mcap'), 'record.max_loss': 0.2,
                            'record.min_free_bytes': 0, 'status_period': 0.2}) as node:
        status = diagnostics.wait_for(node, 'an error', lambda s: s.level == b'\x02')
        assert 'No space left on device' in status.message
        poses = peer.listen(node.topic('pose'), PoseStamped).wait(50)
        refused = peer.switch(node, 'record', True)     # the first file is still there
        assert not refused.success and 'first.mcap' in refused.message
        (small_disk / 'ballast').unlink()
        assert peer.set_together(node, record__uri=str(small_disk / 'second.mcap')).successful
        assert peer.switch(node, 'record', True).success
        diagnostics.wait_for(node, 'no error', lambda s: s.level == b'\x00')
        poses.wait_more(50)
        assert_clean_end(node, node.end())
        peer.stop_listening(poses)
    for name in ('first', 'second'):
        with LogReader(small_disk / f'{name}.mcap') as reader:
            stamps = [message.log_time for message in reader.messages([node.topic('pose')])]
            assert not reader.damage.losses
        assert len(stamps) > 20 and set(np.diff(stamps)) == {PERIODS_NS['pose']}
