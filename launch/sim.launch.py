# SPDX-License-Identifier: Apache-2.0
"""
Simulate a scene, with TF and optionally RViz.

  ros2 launch spinning_top_sim sim.launch.py scene:=looping rviz:=true
  ros2 launch spinning_top_sim sim.launch.py namespace:=left set:='spin.l3:=2.0 seed:=7'
"""

import json
import shlex
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from spinning_top_sim.nodes import launch_helpers
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.topics import resolve_topic
from spinning_top_sim.tools.scene_file import parse_assignment, read_scene

SHARE = Path(get_package_share_directory('spinning_top_sim'))
SCENES = sorted(path.stem for path in (SHARE / 'config').glob('*.yaml'))
SWITCH = ['true', 'false']


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        DeclareLaunchArgument(
            'scene', default_value='cusp',
            description=f'Scene: one of {", ".join(SCENES)}, or the path of a parameter file'),
        DeclareLaunchArgument(
            'params_file', default_value='',
            description='Second parameter file, whose values override those of the scene'),
        DeclareLaunchArgument(
            'set', default_value='',
            description='Parameters that override those of the files: '
            "'NAME:=VALUE NAME:=VALUE ...'"),
        DeclareLaunchArgument(
            'namespace', default_value='', description='Namespace of all nodes'),
        DeclareLaunchArgument(
            'frame_prefix', default_value='auto',
            description='Prefix of all frame names except world_frame; auto: the namespace and a '
            'slash, so that two tops share one TF tree'),
        DeclareLaunchArgument(
            'record', default_value='false',
            description='true: record into the working directory; or the path of a log (.mcap) '
            'or of a folder'),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', choices=SWITCH,
            description='Use the /clock of another node'),
        DeclareLaunchArgument(
            'tf', default_value='true', choices=SWITCH,
            description='Run robot_state_publisher'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=SWITCH, description='Run RViz'),
        DeclareLaunchArgument(
            'view', default_value='false', choices=SWITCH,
            description='Show the top in the browser'),
        DeclareLaunchArgument(
            'markers', default_value=LaunchConfiguration('rviz'), choices=SWITCH,
            description='Publish markers; default: the value of rviz'),
        OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list:
    given = {name: context.launch_configurations[name] for name in (
        'scene', 'params_file', 'set', 'namespace', 'frame_prefix', 'record', 'use_sim_time',
        'tf', 'rviz', 'view', 'markers')}
    on = {name: given[name] == 'true' for name in (
        'use_sim_time', 'tf', 'rviz', 'view', 'markers')}
    namespace = given['namespace'].strip('/')
    files = [_scene_file(given['scene']), *filter(None, [given['params_file']])]
    asked = dict(map(parse_assignment, shlex.split(given['set'])))
    of_ros = {name: value for name, value in asked.items() if parameters.is_of_ros(name)}
    if 'use_sim_time' in of_ros:
        raise ValueError(f'set = {given["set"]!r}: use_sim_time is an argument of its own, '
                         'use_sim_time:=true')
    changes, values = _parameters(given, namespace, files, asked)
    options = [('--params', str(path)) for path in files] + [
        ('-p', f'{name}:={json.dumps(values[name])}') for name in changes if name in values]
    actions = [Node(
        package='spinning_top_sim', executable='sim_node', namespace=namespace, output='screen',
        sigterm_timeout='15', on_exit=Shutdown(reason='it has ended'),
        arguments=[word for option in options for word in option],
        parameters=[{**of_ros, 'use_sim_time': on['use_sim_time']}])]
    if on['tf']:
        actions.append(launch_helpers.state_publisher(
            SHARE, values, namespace, resolve_topic('joint_states', namespace),
            on['use_sim_time']))
    if on['view']:
        actions.append(Node(package='spinning_top_sim', executable='view', namespace=namespace,
                            arguments=['--node'], output='screen'))
    if on['rviz']:
        actions.append(launch_helpers.rviz(SHARE, values['world_frame'], namespace,
                                           on['use_sim_time']))
    return actions


def _parameters(given: dict, namespace: str, files: list, asked: dict) -> tuple[dict, dict]:
    """Return what changes the parameters of the scene, and all parameters with these changes."""
    node = resolve_topic('spinning_top', namespace)
    scene, *second = (read_scene(path, node) for path in files)
    changes = {name: value for source in (*second, asked) for name, value in source.items()}
    values = parameters.checked({**scene, **changes})
    prefix = given['frame_prefix']
    if prefix == 'auto':
        prefix = f'{namespace}/' if namespace else ''
    changes |= {name: prefix + values[name] for name in parameters.FRAMES[1:]}
    if given['markers'] == 'true':
        changes['markers.enabled'] = True
    if given['record'] != 'false':
        changes['record.enabled'] = True
        if given['record'] != 'true':
            changes['record.uri'] = given['record']
    return changes, parameters.checked({**scene, **changes})


def _scene_file(scene: str) -> Path:
    if scene in SCENES:
        return SHARE / 'config' / f'{scene}.yaml'
    if not Path(scene).is_file():
        raise ValueError(f'scene = {scene!r}: there is no such file; must be a path or one of '
                         f'{", ".join(SCENES)}')
    return Path(scene)
