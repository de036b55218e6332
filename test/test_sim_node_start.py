# SPDX-License-Identifier: Apache-2.0
"""What a user of the node meets first: arguments, overrides, what it says, and clocks."""

import shlex
import shutil

import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from helpers.node_harness import DrivenClock, SimNode, wait_for
from helpers.node_logs import QUIET, TRACEBACK, assert_clean_end, stamp_of, the_log
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile

from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.recorded_run import read_run_description

MODULE = ('-m', 'spinning_top_sim.nodes.sim_node')


FORM = 'is not expected here; the form is: sim_node --ros-args -p NAME:=VALUE --params-file FILE'


@pytest.mark.parametrize('stray', [
    ['config/wavy.yaml'], ['-p', 'seed:=7'], ['seed:=7', 'a.yaml'], ['--params-file', 'a.yaml'],
    ['run'], ['--verbose']])
def test_arguments_that_ros_does_not_take_are_refused_with_the_right_form(tmp_path, stray):
    for program, arguments in (((*MODULE, *stray), ()), (MODULE, ('--', *stray))):
        with SimNode(tmp_path, program=program, arguments=arguments) as node:
            assert node.wait() == 2
        assert node.err == f"sim_node: cannot start: '{' '.join(stray)}' {FORM}\n"


@pytest.mark.parametrize('stray', ['a.yaml', '--verbose'])
def test_what_stands_behind_ros_args_and_rcl_does_not_know_is_refused_too(tmp_path, stray):
    with SimNode(tmp_path, arguments=[stray]) as node:
        assert node.wait() == 2
    assert stray in node.err and node.err.endswith(f'{FORM}\n')
    assert len(node.err.splitlines()) == 1


def test_the_version_and_the_help_are_printed_and_nothing_runs(tmp_path):
    for expected in ('sim_node', 'replay_node'):
        program = ('-m', f'spinning_top_sim.nodes.{expected}', '--version')
        with SimNode(tmp_path, program=program) as node:
            assert node.wait() == 0
        name, version = node.out.split()
        assert name == expected and version[0].isdigit()
    with SimNode(tmp_path, program=(*MODULE, '--help')) as node:
        assert node.wait() == 0
    for said in ('~/commands', '~/set_pause', '~/record', '~/step', '~/reset', '/diagnostics',
                 'imu/data_raw', '~/invariants', '/clock', *parameters.BY_NAME):
        assert said in node.out
    assert 'effect fixed' not in node.out


def write_scene(path, **values):
    path.write_text('/**:\n  ros__parameters:\n' + ''.join(
        f'    {name.replace("__", ".")}: {value}\n' for name, value in values.items()))
    return str(path)


def test_the_last_value_wins_whatever_the_types_and_as_in_simulate(peer, tmp_path):
    """Of one name, rclpy takes an integer rather than a double that comes later."""
    file = write_scene(tmp_path / 'a.yaml', spin__l3=3, max_error=1, time_scale=2, imu__rate=250,
                       imu__lever_arm='[1, 2, 3]')
    given = ['spin.l3:=2.25', 'max_error:=1e-7', 'imu.rate:=0.4e3', 'top.mass:=1e0',
             'imu.lever_arm:=[0, 0, 1]']
    options = [word for rule in given for word in ('-p', rule)]
    assert simulate.main(['-o', str(tmp_path / 'ours.mcap'), '--quiet', '--duration', '0.1',
                          '--params', file, *options]) == 0
    with LogReader(tmp_path / 'ours.mcap') as log:
        ours = read_run_description(log).values_at_recording
    names = ('spin.l3', 'max_error', 'imu.rate', 'top.mass', 'time_scale')
    for arguments, expected in (
            (['--params-file', file, *options], [2.25, 1e-7, 400.0, 1.0, 2.0, (0.0, 0.0, 1.0)]),
            ([*options, '--params-file', file], [3.0, 1.0, 250.0, 1.0, 2.0, (1.0, 2.0, 3.0)])):
        with SimNode(tmp_path, QUIET, arguments=arguments) as node:
            found = peer.get(node, *names)
            (lever_arm,) = peer.get(node, 'imu.lever_arm')
            assert_clean_end(node, node.end())
        assert [*found, tuple(lever_arm)] == expected
        if arguments[0] == '--params-file':
            assert found == [ours[name] for name in names]
            assert tuple(ours['imu.lever_arm']) == tuple(lever_arm)


def test_of_several_files_the_last_that_is_for_the_node_wins(peer, tmp_path):
    one, two = (write_scene(tmp_path / f'{l3}.yaml', spin__l3=l3) for l3 in (2, 1.5))
    other = tmp_path / 'other.yaml'
    other.write_text('/last/other:\n  ros__parameters:\n    spin:\n      l3: 9\n'
                     '/*/spinning_top:\n  ros__parameters:\n    spin:\n      l3: 7\n')
    for given, expected in (((one, two), 1.5), ((two, one), 2.0), ((one, two, str(other)), 7.0),
                            ((str(other), one, two), 1.5)):
        arguments = [word for file in given for word in ('--params-file', file)]
        with SimNode(tmp_path, QUIET, namespace='/last', arguments=arguments) as node:
            assert peer.get(node, 'spin.l3') == [expected]
            assert_clean_end(node, node.end())


def test_a_node_runs_where_the_shell_has_closed_its_standard_streams(tmp_path):
    node = SimNode(tmp_path, {'duration': 0.05, 'record.enabled': True, 'record.uri': 'run.mcap'})
    node.command = ['sh', '-c', '"$@" >&- 2>&-', 'sh', *node.command]
    with node:
        assert node.wait() == 0
    with LogReader(node.folder / 'run.mcap') as log:
        assert log.whole


def test_the_help_fits_80_columns(tmp_path):
    for name in ('sim_node', 'replay_node'):
        with SimNode(tmp_path, program=('-m', f'spinning_top_sim.nodes.{name}', '--help')) as node:
            assert node.wait() == 0
        assert [line for line in node.out.splitlines() if len(line) > 80] == []


@pytest.fixture(scope='module')
def node(peer, tmp_path_factory):
    with SimNode(tmp_path_factory.mktemp('start'), QUIET) as node:
        yield node
        assert_clean_end(node, node.end())


def test_texts_that_are_numbers_are_taken_as_ros2_param_sends_them(peer, node):
    """YAML 1.1 takes 1e-9 for a text, and so do `ros2 param set` and `ros2 param load`."""
    for result in peer.set_each(node, max_error='1e-9', imu__gyroscope_noise_density='5e-5',
                                duration=0, imu__lever_arm=['1e-2', '0', '2e0']):
        assert result.successful, result.reason
    assert peer.get(node, 'max_error', 'imu.gyroscope_noise_density', 'duration') == [
        1e-9, 5e-5, 0.0]
    assert list(peer.get(node, 'imu.lever_arm')[0]) == [0.01, 0.0, 2.0]
    for value in ('1e-9x', '', 'nan', '-1e-9'):
        (result,) = peer.set_each(node, max_error=value)
        assert not result.successful
        assert 'max_error' in result.reason
    assert peer.set_together(node, imu__lever_arm=[0, 0, 0]).successful
    refused = peer.set_together(node, imu__lever_arm=[0.0, 1.5])
    assert 'imu.lever_arm = [0.0, 1.5]: must be' in refused.reason


def test_what_waits_for_a_reset_or_a_recording_is_said_when_it_is_set(peer, node):
    assert peer.set_together(node, top__mass=2.5, initial__phi=1.0, pose__rate=50.0).successful
    wait_for('a line', lambda: 'initial.phi, top.mass: a change takes effect at the next ~/reset'
             in node.err)
    assert peer.set_together(node, record__max_loss=1.0).successful
    wait_for('a line', lambda: 'record.max_loss: a change takes effect at the next start of a '
             'recording' in node.err)
    assert peer.set_together(node, top__mass=2.5, imu__lever_arm=[0.0, 0.0, 1.0]).successful
    wait_for('a line', lambda: ': imu.lever_arm: a change takes' in node.err)
    assert 'pose.rate' not in node.err


def test_the_source_of_time_is_not_changed_while_the_node_runs(peer, node):
    result = peer.set_together(node, use_sim_time=True)
    assert not result.successful
    assert 'use_sim_time = True: cannot be changed' in result.reason
    assert peer.set_together(node, use_sim_time=False).successful
    peer.listen(node.topic('pose'), PoseStamped).wait(3)


def test_a_second_node_of_the_same_name_is_warned_about(peer, tmp_path):
    with (SimNode(tmp_path / 'one', namespace='/twins') as one,
          SimNode(tmp_path / 'two', namespace='/twins') as two):
        for node in (one, two):
            wait_for('a warning', lambda node=node:
                     'there is another node /twins/spinning_top' in node.err)
        for node in (one, two):
            assert_clean_end(node, node.end())


def test_what_is_said_at_the_start_is_on_rosout_and_at_the_end_what_to_do_next(peer, tmp_path):
    heard = []
    subscription = peer.node.create_subscription(
        Log, '/rosout', heard.append,
        QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    with SimNode(tmp_path, {'record.enabled': True}, namespace='/said') as node:
        for text in ('recording to ', 'cusp'):
            wait_for(text, lambda text=text: any(
                log.name == 'said.spinning_top' and text in log.msg for log in heard))
            assert text in node.err
        wait_for('a status line', lambda: ' log ' in node.out)
        assert_clean_end(node, node.end())
    assert subscription.topic_name == '/rosout'
    path = the_log(node.folder)
    next_step = node.out.splitlines()[-1]
    assert next_step.endswith(f'inspect {path} --plot top.png')
    inspect = shlex.split(next_step.removeprefix('next: '))
    assert shutil.which(inspect[0])
    assert '\x1b' not in node.out and '\r' not in node.out


def test_times_that_no_stamp_can_have_are_not_followed(peer, tmp_path):
    clock = DrivenClock(peer, 1_000_000_000_000)
    with SimNode(tmp_path, {**QUIET, 'use_sim_time': True}) as node:
        pose = peer.listen(node.topic('pose'), PoseStamped)
        # It would follow itself.
        assert 'follows another /clock' in peer.set_together(node, clock__enabled=True).reason

        def warned():       # -1 is no time to rclpy
            for seconds in (-1, 2 ** 31 - 1):
                clock.publish(seconds)
            return 'stamps cannot be later than 2038' in node.err

        wait_for('a warning', warned)
        clock.publish(-1)
        clock.drive('the motion', lambda: len(pose.raw) > 50)
        clock.publish(-1)
        clock.drive('more', lambda: len(pose.raw) > 100)
        assert_clean_end(node, node.end())
        peer.stop_listening(pose)
    assert TRACEBACK not in node.err
    clock.stop()


def test_a_clock_that_has_not_begun_or_has_stopped_is_waited_for_aloud(
        peer, diagnostics, tmp_path):
    clock = DrivenClock(peer, 1_000_000_000_000)

    def waits():
        status = diagnostics.wait_for(node, 'a warning', lambda s: s.level == b'\x01')
        assert status.message == 'waiting for /clock'
        wait_for('the status line', lambda: ' s waiting for /clock | ' in
                 node.out.splitlines()[-1])
        return node.err.count('[WARN]') == node.err.count('waiting for /clock')

    with SimNode(tmp_path, {'use_sim_time': True, 'status_period': 0.2}) as node:
        assert waits()
        assert node.err.count('waiting for /clock') == 1
        refused = peer.set_together(node, spin__l3=2.0)     # it would send t = 0 to nobody
        assert not refused.successful and 'waiting for /clock' in refused.reason
        pose = peer.listen(node.topic('pose'), PoseStamped)
        clock.now_ns += 3_000_000           # not on the grid of the stamps

        def is_ahead():
            assert all(stamp_of(data) <= clock.now_ns for data in pose.raw[-1:])
            return len(pose.raw) > 50 and '/clock goes on' in node.err

        clock.drive('the motion', is_ahead)
        clock.drive('no warning', lambda: diagnostics.statuses(node)[-1].level == b'\x00')
        assert waits()
        assert node.err.count('waiting for /clock') == 2
        count = len(pose.raw)
        clock.drive('the motion', lambda: (
            len(pose.raw) > count + 50 and node.err.count('/clock goes on') == 2))
        assert_clean_end(node, node.end())
    assert TRACEBACK not in node.err
    peer.stop_listening(pose)
    clock.stop()
