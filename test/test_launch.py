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
from spinning_top_sim.tools.scene_file import read_scene

pytest.importorskip('ament_index_python')
pytest.importorskip('xacro')
EXECUTABLES = {path.name for path in (ROOT / 'scripts').iterdir() if path.is_file()}
RSP = 'robot_state_publisher'


class Kept:
    """Any class of launch: knows how it was made."""

    def __init__(self, *args, **kwargs):
        self.args, self.__dict__ = args, {'args': args, **kwargs}


@pytest.fixture
def installed(monkeypatch):
    """Put the stand-in in launch's place; return the names of the other packages installed."""
    from ament_index_python import packages

    there = {RSP, 'rviz2'}

    def prefix(name):
        if name not in there:
            raise packages.PackageNotFoundError(name)
        return '/opt/ros'

    monkeypatch.setattr(packages, 'get_package_prefix', prefix)
    monkeypatch.setattr(packages, 'get_package_share_directory', lambda name: str(ROOT))
    for module, names in {
            'launch': ('LaunchContext', 'LaunchDescription'), 'launch.action': ('Action',),
            'launch.actions': ('DeclareLaunchArgument', 'LogInfo', 'OpaqueFunction', 'Shutdown'),
            'launch.substitutions': ('LaunchConfiguration',), 'launch_ros': (),
            'launch_ros.actions': ('Node',),
            'launch_ros.parameter_descriptions': ('ParameterValue',)}.items():
        made = types.ModuleType(module)
        for name in names:
            setattr(made, name, type(name, (Kept,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    forget_launch_helpers()
    yield there
    forget_launch_helpers()


def forget_launch_helpers():
    """Let what imports launch be imported anew."""
    sys.modules.pop('spinning_top_sim.nodes.launch_helpers', None)
    vars(nodes).pop('launch_helpers', None)


def described(name):
    """Return the arguments of a launch file and the function that makes its nodes."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'launch' / f'{name}.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (entities,) = module.generate_launch_description().args
    *arguments, opaque = entities
    return {argument.args[0]: argument for argument in arguments}, opaque.function


def started(name, **given):
    """Return the nodes that a launch file starts, by package/executable, and all it does."""
    arguments, make = described(name)
    assert set(given) <= set(arguments)
    values = {}
    for key, argument in arguments.items():
        default = getattr(argument, 'default_value', None)
        value = given.get(key, values[default.args[0]] if isinstance(default, Kept) else default)
        assert value is not None, f'{key} is needed'
        assert value in getattr(argument, 'choices', [value])
        values[key] = value
    actions = make(SimpleNamespace(launch_configurations=values))
    nodes = [action for action in actions if type(action).__name__ == 'Node']
    assert [hasattr(node, 'on_exit') for node in nodes] == [True] + (len(nodes) - 1) * [False]
    return SimpleNamespace(
        nodes={f'{node.package}/{node.executable}': node for node in nodes},
        said=[action.msg for action in actions if type(action).__name__ == 'LogInfo'])


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


def test_a_scene_is_started_with_its_parameters(installed):
    scene = 'looping'
    run = started('sim', scene=scene)
    assert set(run.nodes) == {'spinning_top_sim/sim_node', f'{RSP}/{RSP}'}
    node = run.nodes['spinning_top_sim/sim_node']
    assert node.executable in EXECUTABLES
    assert parameters_of(node) == parameters.checked(read_scene(ROOT / f'config/{scene}.yaml'))
    assert links_of(run.nodes[f'{RSP}/{RSP}']) == [
        'world', 'precession_link', 'nutation_link', 'base_link', 'imu_link']
    assert run.said == []
    # Nodes write whole lines for the launch.
    assert not any(getattr(node, 'emulate_tty', False) for node in run.nodes.values())


def test_two_namespaces_share_no_frame_but_the_world(installed):
    found = []
    for namespace in ('left', '/right/'):
        run = started('sim', namespace=namespace, rviz='true')
        name = namespace.strip('/')
        sim, tf, rviz = (run.nodes[key] for key in (
            'spinning_top_sim/sim_node', f'{RSP}/{RSP}', 'rviz2/rviz2'))
        assert {node.namespace for node in (sim, tf, rviz)} == {name}
        assert tf.remappings == [('joint_states', f'/{name}/joint_states')]
        assert ('/markers', f'/{name}/markers') in rviz.remappings
        values = parameters_of(sim)
        assert values['markers.enabled']
        assert {values['body_frame'], values['imu.frame_id'], 'world'} <= set(links_of(tf))
        found.append(set(links_of(tf)))
    assert found[0] & found[1] == {'world'}


def test_what_is_set_replaces_what_files_say(installed, tmp_path):
    more = tmp_path / 'more.yaml'
    more.write_text('/**: {ros__parameters: {seed: 3, spin.l3: 1.1, joint_states.rate: 5000.0}}')
    qos = 'qos_overrides./pose.publisher.depth'
    run = started('sim', scene='looping', params_file=str(more), frame_prefix='t/',
                  set=f"spin.l3:=2.5 imu.lever_arm:='[0.1, 0.0, 0.2]' {qos}:=3", record='logs/',
                  markers='true', use_sim_time='true')
    sim = run.nodes['spinning_top_sim/sim_node']
    assert sim.parameters[-1].pop(qos) == 3       # a parameter of ROS is passed on
    values = parameters_of(sim)
    expected = {'seed': 3, 'spin.l3': 2.5, 'imu.lever_arm': (0.1, 0.0, 0.2),
                'record.enabled': True, 'record.uri': 'logs/', 'markers.enabled': True,
                'body_frame': 't/base_link', 'imu.frame_id': 't/imu_link', 'world_frame': 'world'}
    assert {name: values[name] for name in expected} == expected
    assert sim.parameters[-1]['use_sim_time'] is True
    (tf,) = run.nodes[f'{RSP}/{RSP}'].parameters
    assert (tf['use_sim_time'], tf['publish_frequency']) == (True, 1000.0)
    assert 'xyz="0.1 0.0 0.2"' in tf['robot_description'].args[0]


@pytest.mark.parametrize(('given', 'said'), [
    ({'scene': 'nope'}, "scene = 'nope'.*one of braking"), ({'set': 'spin.l3'}, 'NAME:=VALUE'),
    ({'set': 'top.mass:=-1'}, r'top\.mass = -1'), ({'params_file': 'none.yaml'}, r'none\.yaml'),
    ({'set': 'use_sim_time:=true'}, 'use_sim_time is an argument of its own')])
def test_bad_arguments_of_sim_are_named(installed, given, said):
    with pytest.raises((ValueError, OSError), match=said):
        started('sim', **given)


@pytest.mark.parametrize('missing', [RSP, 'xacro'])
def test_without_the_means_there_is_a_line_and_no_tf(installed, monkeypatch, missing):
    if missing == RSP:
        installed.discard(RSP)
    else:
        monkeypatch.setitem(sys.modules, 'xacro', None)
    run = started('sim')
    assert set(run.nodes) == {'spinning_top_sim/sim_node'}
    (warning,) = run.said
    assert warning.startswith('WARNING: no TF: ')
    assert f'sudo apt install ros-$ROS_DISTRO-{missing.replace("_", "-")}' in warning
    assert started('sim', tf='false').said == []


@pytest.fixture
def log(tmp_path):
    path = tmp_path / 'run.mcap'
    assert simulate.main(['-o', str(path), '--quiet', '--duration', '1', '--namespace', '/a/b',
                          '-p', 'body_frame:=wheel', '-p', 'imu.lever_arm:=[0.1,0.2,0.3]',
                          ]) == 0
    return path


def test_a_log_is_replayed_with_the_frames_that_it_was_recorded_with(installed, log):
    run = started('replay', file=str(log), rate='2', start='0.5', loop='true', clock='50',
                  rviz='true')
    node = run.nodes['spinning_top_sim/replay_node']
    assert node.executable in EXECUTABLES
    parser = ArgumentParser()
    replay_node.add_arguments(parser)
    options = parser.parse_args(node.arguments)
    assert (options.file, options.rate, options.start, options.loop, options.clock,
            options.partial) == (log, 2.0, 0.5, True, 50.0, False)
    tf = run.nodes[f'{RSP}/{RSP}']
    assert links_of(tf) == ['world', 'a/b/precession_link', 'a/b/nutation_link', 'a/b/wheel',
                            'a/b/imu_link']
    assert 'xyz="0.1 0.2 0.3"' in tf.parameters[0]['robot_description'].args[0]
    assert tf.parameters[0]['use_sim_time'] is True
    assert tf.remappings == [('joint_states', '/a/b/joint_states')]
    assert ('/markers', '/a/b/markers') in run.nodes['rviz2/rviz2'].remappings


@pytest.fixture
def launch(tmp_path):
    """Run launch files side by side until each has ended; return what they print."""
    if shutil.which('ros2') is None:
        pytest.skip('launch comes with ROS: it is not on PyPI')
    from helpers.node_harness import LIFETIME_S

    def run(*parts):
        running = [subprocess.Popen(
            ['ros2', 'launch', 'spinning_top_sim', f'{name}.launch.py', *arguments],
            cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
            for name, *arguments in parts]
        try:
            said = [process.communicate(timeout=LIFETIME_S)[0] for process in running]
        finally:
            for process in running:
                process.terminate()         # it ends its nodes
        assert [process.returncode for process in running] == len(parts) * [0], said
        return said

    return run


def test_two_tops_are_launched_recorded_and_replayed(launch, tmp_path):
    from helpers.node_logs import decoded

    names = {'left': 'cusp', 'right': 'looping'}
    for said in launch(*(('sim', f'namespace:={name}', f'scene:={scene}', f'record:={name}.mcap',
                          'set:=duration:=3.0 markers.enabled:=true')
                         for name, scene in names.items())):
        assert 'finished cleanly' in said, said
        assert 'Traceback' not in said, said
    for name in names:
        counts = decoded(tmp_path / f'{name}.mcap')
        assert {topic.split('/')[1] for topic in counts} == {name}
        assert counts[f'/{name}/pose'] == 301
        assert counts[f'/{name}/markers'] == 61
    for said in launch(*(('replay', f'file:={name}.mcap', 'rate:=3.0') for name in names)):
        assert 'finished cleanly' in said, said
        assert 'played' in said, said
