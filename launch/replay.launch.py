# SPDX-License-Identifier: Apache-2.0
"""
Replay a log, with the TF of its top and optionally RViz.

  ros2 launch spinning_top_sim replay.launch.py file:=run.mcap loop:=true rviz:=true
"""

from collections.abc import Mapping
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, Shutdown
from launch_ros.actions import Node

from spinning_top_sim.nodes import launch_helpers
from spinning_top_sim.recording.errors import LogError
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools.recorded_run import ForeignLogError, read_run_description

SHARE = Path(get_package_share_directory('spinning_top_sim'))
SWITCH = ['true', 'false']


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        DeclareLaunchArgument('file', description='Log to replay (.mcap)'),
        DeclareLaunchArgument('rate', default_value='1.0', description='Playback rate'),
        DeclareLaunchArgument(
            'start', default_value='0.0',
            description='Start this many seconds after the start of the log'),
        DeclareLaunchArgument(
            'loop', default_value='false', choices=SWITCH, description='Start again at the end'),
        DeclareLaunchArgument(
            'clock', default_value='false',
            description='true, or a rate [Hz]: publish the time of the log on /clock, for TF and '
            'RViz too'),
        DeclareLaunchArgument(
            'partial', default_value='false', choices=SWITCH,
            description='Play the intact part of a truncated log'),
        DeclareLaunchArgument(
            'tf', default_value='true', choices=SWITCH,
            description='Run robot_state_publisher, if sim_node recorded the log'),
        DeclareLaunchArgument(
            'rviz', default_value='false', choices=SWITCH, description='Run RViz'),
        OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list:
    given = {name: context.launch_configurations[name] for name in (
        'file', 'rate', 'start', 'loop', 'clock', 'partial', 'tf', 'rviz')}
    on = {name: given[name] == 'true' for name in ('loop', 'partial', 'tf', 'rviz')}
    # replay_node refuses what is no number.
    options = [f'--{name}={given[name]}' for name in ('rate', 'start')]
    options += [f'--{name}' for name in ('loop', 'partial') if on[name]]
    clocked = given['clock'].lower() != 'false'
    if clocked:
        options.append('--clock' if given['clock'].lower() == 'true'
                       else f'--clock={given["clock"]}')
    node = Node(package='spinning_top_sim', executable='replay_node', output='screen',
                arguments=[given['file'], *options],
                on_exit=Shutdown(reason='it has ended'))
    actions = [node]
    if not (on['tf'] or on['rviz']):
        return actions
    try:
        with LogReader(Path(given['file'])) as log:
            run = read_run_description(log)
    except (LogError, ForeignLogError, OSError) as error:
        # replay_node reports a log that cannot be played.
        return [*actions, LogInfo(msg=f'neither TF nor RViz: {error}')]
    namespace, values = _namespace(run.topics), run.values_in_effect
    if on['tf'] and 'joint_states' in run.topics:
        actions.append(launch_helpers.state_publisher(
            SHARE, values, namespace, run.topics['joint_states'], clocked))
    if on['rviz']:
        actions.append(launch_helpers.rviz(SHARE, values['world_frame'], namespace, clocked))
    return actions


def _namespace(topics: Mapping[str, str]) -> str:
    """Return the namespace that the node had: what its topics have before their own names."""
    for name, topic in topics.items():
        if not name.startswith(('/', '~')) and topic.endswith(f'/{name}'):
            return topic.removesuffix(name).strip('/')
    return ''
