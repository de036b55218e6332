# SPDX-License-Identifier: Apache-2.0
"""
The launch files: what they would start, with a stand-in for `launch`, and really, where it is.

`launch` and `launch_ros` come with ROS only.  The stand-in keeps what it is given; it shows that
executables, files, arguments and parameters are there and fit, not that launch takes them so.
"""

import importlib.util
import re
import shutil
import subprocess
import sys
import types
from argparse import ArgumentParser
from types import SimpleNamespace

import pytest
from helpers.reference import ROOT

from spinning_top_sim import nodes
from spinning_top_sim.nodes import replay_node, sim_node
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import scene_file, simulate

packages = pytest.importorskip('ament_index_python.packages')
pytest.importorskip('xacro')


class Kept:
    """Any class of launch: knows how it was made."""

    def __init__(self, *args, **kwargs):
        self.args, self.__dict__ = args, {'args': args, **kwargs}


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    """Put the stand-in in launch's place."""
    monkeypatch.setattr(packages, 'get_package_share_directory', lambda name: str(ROOT))
    for module, names in {
            'launch': ('LaunchContext', 'LaunchDescription'),
            'launch.actions': ('DeclareLaunchArgument', 'LogInfo', 'OpaqueFunction', 'Shutdown'),
            'launch.substitutions': ('LaunchConfiguration',), 'launch_ros': (),
            'launch_ros.actions': ('Node',),
            'launch_ros.parameter_descriptions': ('ParameterValue',)}.items():
        made = types.ModuleType(module)
        for name in names:
            setattr(made, name, type(name, (Kept,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    name = 'spinning_top_sim.nodes.launch_helpers'      # imports launch; and it is forgotten
    monkeypatch.setitem(sys.modules, name, importlib.util.module_from_spec(
        spec := importlib.util.find_spec(name)))
    spec.loader.exec_module(sys.modules[name])
    monkeypatch.setattr(nodes, 'launch_helpers', sys.modules[name], raising=False)


def started(name, **given):
    """Return the nodes that a launch file starts, by executable."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'launch' / f'{name}.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    ((*arguments, opaque),) = module.generate_launch_description().args
    values = {}
    for argument in arguments:
        key, default = argument.args[0], getattr(argument, 'default_value', None)
        values[key] = given.pop(key, values[default.args[0]] if isinstance(default, Kept)
                                else default)
        assert values[key] in getattr(argument, 'choices', [values[key]])
    assert not given
    actions = opaque.function(SimpleNamespace(launch_configurations=values))
    assert [hasattr(node, 'on_exit') for node in actions] == [True] + (len(actions) - 1) * [False]
    return {node.executable: node for node in actions}


def parameters_of(node):
    """Return what the options of a node set together."""
    parser = ArgumentParser()
    sim_node.add_arguments(parser)
    return parameters.checked(scene_file.given(
        parser.parse_args(node.arguments), f'/{node.namespace}/spinning_top'.replace('//', '/')))


def links_of(node):
    (values,) = node.parameters
    (text,) = values['robot_description'].args
    return re.findall(r'<link name="([^"]*)"', text)


def test_two_namespaces_share_no_frame_but_the_world():
    found = []
    for namespace in ('left', '/right/'):
        run, name = started('sim', namespace=namespace, rviz='true'), namespace.strip('/')
        tf = run['robot_state_publisher']
        assert {node.namespace for node in run.values()} == {name}
        assert tf.remappings == [('joint_states', f'/{name}/joint_states')]
        assert ('/markers', f'/{name}/markers') in run['rviz2'].remappings
        values = parameters_of(run['sim_node'])
        assert values['markers.enabled']
        assert {values['body_frame'], values['imu.frame_id'], 'world'} <= set(links_of(tf))
        found.append(set(links_of(tf)))
    assert found[0] & found[1] == {'world'}


def test_what_is_set_replaces_what_files_say(tmp_path):
    run = started('sim', scene='looping')
    assert parameters_of(run['sim_node']) == parameters.checked(
        scene_file.read_scene(ROOT / 'config/looping.yaml'))
    assert set(run) == {'sim_node', 'robot_state_publisher'} and (
        ROOT / 'scripts/sim_node').exists()
    more = tmp_path / 'more.yaml'
    more.write_text('/**: {ros__parameters: {seed: 3, spin.l3: 1.1, joint_states.rate: 5000.0}}')
    qos = 'qos_overrides./pose.publisher.depth'
    run = started('sim', scene='looping', params_file=str(more), frame_prefix='t/',
                  set=f"spin.l3:=2.5 imu.lever_arm:='[0.1, 0.0, 0.2]' {qos}:=3", record='logs/',
                  markers='true', use_sim_time='true')
    assert run['sim_node'].parameters[-1] == {qos: 3, 'use_sim_time': True}
    values = parameters_of(run['sim_node'])
    expected = {'seed': 3, 'spin.l3': 2.5, 'imu.lever_arm': (0.1, 0.0, 0.2),
                'record.enabled': True, 'record.uri': 'logs/', 'markers.enabled': True,
                'body_frame': 't/base_link', 'imu.frame_id': 't/imu_link', 'world_frame': 'world'}
    assert {name: values[name] for name in expected} == expected
    (tf,) = run['robot_state_publisher'].parameters
    assert (tf['use_sim_time'], tf['publish_frequency']) == (True, 1000.0)
    assert 'xyz="0.1 0.0 0.2"' in tf['robot_description'].args[0]


@pytest.mark.parametrize(('given', 'said'), [
    ({'scene': 'nope'}, "scene = 'nope'.*one of braking"), ({'set': 'spin.l3'}, 'NAME:=VALUE'),
    ({'set': 'top.mass:=-1'}, r'top\.mass = -1'), ({'params_file': 'none.yaml'}, r'none\.yaml'),
    ({'set': 'use_sim_time:=true'}, 'use_sim_time is an argument of its own')])
def test_bad_arguments_of_sim_are_named(given, said):
    with pytest.raises((ValueError, OSError), match=said):
        started('sim', **given)


def test_a_log_is_replayed_with_the_frames_that_it_was_recorded_with(tmp_path):
    log = tmp_path / 'run.mcap'
    assert simulate.main(['-o', str(log), '--quiet', '--duration', '1', '--namespace', '/a/b',
                          '-p', 'body_frame:=wheel', '-p', 'imu.lever_arm:=[0.1,0.2,0.3]']) == 0
    run = started('replay', file=str(log), rate='2', start='0.5', loop='true',
                  clock='40', rviz='true')
    parser = ArgumentParser()
    replay_node.add_arguments(parser)
    options = parser.parse_args(run['replay_node'].arguments)
    assert (options.file, options.rate, options.start, options.loop, options.clock,
            options.partial) == (log, 2.0, 0.5, True, 40.0, False)
    tf = run['robot_state_publisher']
    assert links_of(tf)[:4] == ['world', 'a/b/precession_link', 'a/b/nutation_link', 'a/b/wheel']
    assert 'xyz="0.1 0.2 0.3"' in tf.parameters[0]['robot_description'].args[0]
    assert tf.parameters[0]['use_sim_time'] is True, 'it begins anew with each round'
    assert tf.remappings == [('joint_states', '/a/b/joint_states')]
    assert ('/markers', '/a/b/markers') in run['rviz2'].remappings


@pytest.mark.skipif(shutil.which('ros2') is None, reason='launch comes with ROS only')
def test_a_top_is_launched_recorded_and_replayed(tmp_path):
    for arguments in (('sim', 'namespace:=left', 'record:=left.mcap', 'set:=duration:=1.0'),
                      ('replay', 'file:=left.mcap')):
        said = subprocess.run(
            ['ros2', 'launch', 'spinning_top_sim', f'{arguments[0]}.launch.py', *arguments[1:]],
            cwd=tmp_path, capture_output=True, text=True, timeout=300.0, check=True)
        assert 'finished cleanly' in said.stdout and 'Traceback' not in said.stderr
