# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: robot_state_publisher and RViz."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.action import Action
from launch.actions import LogInfo
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from spinning_top_sim.streams.topics import resolve_topic
from spinning_top_sim.tools.urdf import inertia_fault, robot_description

STATE_PUBLISHER = 'robot_state_publisher'


def state_publisher(share: Path, values: Mapping[str, Any], namespace: str, joint_states: str,
                    use_sim_time: bool) -> list[Action]:
    """Return robot_state_publisher, or a warning.  Raises ValueError for impossible frames."""
    try:
        get_package_prefix(STATE_PUBLISHER)
        description = robot_description(values, share / 'urdf')
    except (PackageNotFoundError, ImportError) as error:
        return _missing('TF', 'xacro' if isinstance(error, ImportError) else STATE_PUBLISHER)
    fault = inertia_fault(values)
    warning = LogInfo(msg=f'WARNING: {fault}, so the body is without <inertial>; frames and '
                          'shapes are there')
    return [*([warning] if fault else []), Node(
        package=STATE_PUBLISHER, executable=STATE_PUBLISHER, namespace=namespace,
        remappings=[('joint_states', joint_states)], parameters=[{
            'robot_description': ParameterValue(description, value_type=str),
            'publish_frequency': min(values['joint_states.rate'], 1000.0),      # its highest [Hz]
            'use_sim_time': use_sim_time}])]


def rviz(share: Path, world_frame: str, namespace: str, use_sim_time: bool) -> list[Action]:
    """Return RViz with the topics of a namespace, or a warning that it is not installed."""
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return _missing('RViz', 'rviz2')
    return [Node(
        package='rviz2', executable='rviz2', namespace=namespace,
        arguments=['-d', str(share / 'rviz/spinning_top.rviz'), '-f', world_frame],
        remappings=[(f'/{topic}', resolve_topic(topic, namespace))
                    for topic in ('markers', 'robot_description')],
        parameters=[{'use_sim_time': use_sim_time}])]


def _missing(what: str, package: str) -> list[Action]:
    return [LogInfo(msg=f'WARNING: no {what}: the package {package} is not installed; '
                        f'sudo apt install ros-$ROS_DISTRO-{package.replace("_", "-")}')]
