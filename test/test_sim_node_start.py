# SPDX-License-Identifier: Apache-2.0
"""The start of a node: arguments, values given twice, refusals, and what a run of it says."""

import re

import pytest

pytest.importorskip('rclpy')

from helpers.node_harness import SimNode
from helpers.node_logs import TRACEBACK, log_of, the_log
from helpers.own_node import run_main
from test_scene_file import scene

from spinning_top_sim.nodes import replay_node, sim_node, simulation_handlers
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.recording.rosbag2 import qos_profiles
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import simulate
from spinning_top_sim.tools.recorded_run import read_run_description


@pytest.fixture
def main(capfd):
    """Run `sim_node` with these arguments; return its exit code and what it has printed."""
    return lambda *arguments: run_main(sim_node.main, capfd, *arguments)


def test_the_help_names_all_parameters_and_nothing_runs(main, capfd):
    for module in (sim_node, replay_node):
        run = run_main(module.main, capfd, '--help')
        assert run.code == 0 and '--help' in run.out
        assert [line for line in run.out.splitlines() if len(line) > 80] == []
    said = main('--help-parameters').out
    assert all(f'{name}  (default' in said for name in parameters.BY_NAME)


# Without what rosdep cannot install for ROS 2 Jazzy, and what only some users need.
BARE = """
import sys
sys.modules.update(dict.fromkeys(
    ('gmpy2', 'mcap', 'rosbags', 'scipy', 'tqdm', 'zstandard', 'lz4')))
from spinning_top_sim.nodes import sim_node
for rule in ('seed:=1', 'solver.method:=exact', 'record.enabled:=true'):
    print('code', sim_node.main(['-p', 'duration:=0.1', '-p', rule]))
"""


def test_rk45_needs_only_what_rosdep_can_install(tmp_path):
    with SimNode(tmp_path, program=('-c', BARE)) as node:
        assert node.process.wait(60.0) == 0, node.err
    assert re.findall(r'code \d', node.out) == ['code 0', 'code 2', 'code 0']
    refused, not_recording = node.err.splitlines()
    assert 'solver.method = exact: needs gmpy2, which is not installed' in refused
    assert 'not recording: a recording needs ' in not_recording


STARTS_REFUSED = {
    'nan': (['-p', 'spin.l3:=.nan'], ('spin.l3', 'nan', 'a number')),
    'pole': (['-p', 'initial.theta:=0.0', '-p', 'spin.lz:=1.0'], ('lz', '1.0', '1.6')),
    'no YAML': (['--params-file', 'bad.yaml'], ('bad.yaml', 'Error at line 1')),
    'use_sim_time': (['-p', 'use_sim_time:=perhaps'], ('use_sim_time', 'perhaps')),
    'another scene': (['--', '--scene', 'other.yaml'],
                      ('other.yaml', 'has no parameters for the node /spinning_top: ', '/other')),
    'bad qos': (['-p', 'qos_overrides./pose.publisher.reliability:=often'], ('often',)),
    'a word': (['--', 'config/wavy.yaml'], ('unrecognized arguments: config/wavy.yaml',)),
}


@pytest.mark.parametrize('case', STARTS_REFUSED)
def test_what_cannot_be_started_is_said_in_a_line_with_exit_code_2(
        main, monkeypatch, tmp_path, case):
    arguments, named = STARTS_REFUSED[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'bad.yaml').write_text('a: [1, 2\n  : {{{\n')
    (tmp_path / 'other.yaml').write_text('other:\n  ros__parameters:\n    a: 1\n')
    run = main('--ros-args', *arguments)
    assert (run.code, run.out) == (2, '')
    line = run.err.splitlines()[-1]
    assert line.startswith('spinning-top node: ') and TRACEBACK not in run.err
    for text in named:
        assert text in line, (text, line)


def test_a_run_warns_of_what_is_odd_and_tells_where_its_log_is(main, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    run = main('-p', 'record.enabled:=true', '-p', 'duration:=0.5', '-p', 'status_period:=0.1',
               '-p', 'top.lambda3:=0.5', '-p', 'qos_overrides./attitude.publisher.depth:=4',
               '--ros-args', '-p', 'spin.l33:=1.0', '-r', 'pose:=attitude', '-p',
               'qos_overrides./attitude.publisher.depth:=3', '-p',
               'qos_overrides./pose.publisher.depth:=3')
    assert (run.code, TRACEBACK in run.err) == (0, False)
    path = the_log(tmp_path)
    assert len(log_of(path)[0]['/attitude']) == 51
    with LogReader(path) as log:        # overrides are for the remapped topic
        (channel,) = (one for one in log.channels.values() if one.topic == '/attitude')
        assert qos_profiles(channel)[0]['depth'] == 3
    for text in ('there is no parameter spin.l33: ignored; did you mean spin.l3?',
                 'qos_overrides./pose.publisher.depth is not obeyed',
                 'top.lambda3 = 0.5 kg m^2: no rigid body', f'recording to {path}'):
        assert text in run.err
    assert ' s running | ' in run.out and '\x1b' not in run.out and '\r' not in run.out


@pytest.fixture
def start_values(main, tmp_path):
    """Return, of a node with these arguments, the topic of its events and the first values."""
    def started(*arguments):
        path = tmp_path / 'start.mcap'
        path.unlink(missing_ok=True)
        ros = [] if '--ros-args' in arguments else ['--ros-args']
        run = main(*arguments, *ros, '-p', 'duration:=0.01', '-p', 'record.enabled:=true', '-p',
                   f'record.uri:={path}')
        assert run.code == 0, run.err
        with LogReader(path) as log:
            (events,) = (topic.name for topic in log.topics if topic.name.endswith('/events'))
            return events, read_run_description(log).values_at_start
    return started


def test_the_last_value_of_the_options_wins_as_in_simulate_and_ros_overrides_it(
        tmp_path, start_values):
    first, second = (scene(tmp_path / f'{name}.yaml', **values) for name, values in (
        ('a', {'spin.l3': 3, 'imu.rate': 250, 'imu.lever_arm': '[1, 2, 3]'}),
        ('b', {'imu.rate': 300.5, 'seed': 9})))
    options = ['--scene', 'wavy', '--params', str(first), '--params', str(second), '-p',
               'spin.l3:=2.25', '-p', 'solver.rtol:=1e-7', '-p', 'imu.lever_arm:=[0, 0, 1]']
    assert simulate.main(['-o', str(tmp_path / 'ours.mcap'), '--quiet', '--duration', '0.1',
                          *options]) == 0
    with LogReader(tmp_path / 'ours.mcap') as log:
        ours = read_run_description(log).values_in_effect
    names = 'spin.l3', 'solver.rtol', 'imu.rate', 'imu.lever_arm', 'seed', 'spin.lz'
    _, found = start_values(*options)
    assert [found[name] for name in names] == [ours[name] for name in names] == [
        2.25, 1e-7, 300.5, (0.0, 0.0, 1.0), 9, 1.42]
    _, found = start_values(*options, '--ros-args', '--params-file', str(first), '-p', 'seed:=7')
    assert [found[name] for name in names] == [3.0, 1e-7, 250.0, (1.0, 2.0, 3.0), 7, 1.42]


def test_a_file_is_read_for_the_name_that_the_node_gets(tmp_path, start_values):
    file = tmp_path / 'f.yaml'
    for arguments, name in (
            (['--ros-args', '-r', '__ns:=/a/b', '--remap', '__node:=c', '-r', '__ns:=/d'],
             '/a/b/c'),
            (['--namespace', 'left', '--ros-args', '-r', 'spinning_top:__name:=c', '-r',
              '__ns:=/e'], '/e/c')):
        file.write_text(f'{name}:\n  ros__parameters: {{seed: 4}}\n'
                        '/another: {ros__parameters: {seed: 5}}\n')
        topic, values = start_values('--scene', str(file), *arguments)
        assert (topic, values['seed']) == (f'{name}/events', 4)


def test_simulation_interfaces_is_offered_where_it_is_installed_and_not_switched_off(
        monkeypatch, start_values):
    offered = []
    monkeypatch.setattr(simulation_handlers, 'offer', offered.append)
    for installed, wanted in ((True, True), (False, True), (True, False)):
        monkeypatch.setattr(sim_node, 'find_spec', lambda name, there=installed: there or None)
        start_values('--ros-args', '-p', f'simulation_interfaces:={str(wanted).lower()}')
    assert len(offered) == 1
