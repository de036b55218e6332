# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: robot_state_publisher and RViz."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from spinning_top_sim.streams.topics import resolve_topic
from spinning_top_sim.tools.export import robot_description


def state_publisher(share: Path, values: Mapping[str, Any], namespace: str, joint_states: str,
                    use_sim_time: bool) -> Node:
    """Return robot_state_publisher.  Raises ValueError for impossible frames."""
    description = robot_description(values, share / 'urdf')
    return Node(
        package='robot_state_publisher', executable='robot_state_publisher', namespace=namespace,
        remappings=[('joint_states', joint_states)], parameters=[{
            'robot_description': ParameterValue(description, value_type=str),
            'publish_frequency': min(values['joint_states.rate'], 1000.0),      # its highest [Hz]
            'use_sim_time': use_sim_time}])


def rviz(share: Path, world_frame: str, namespace: str, use_sim_time: bool) -> Node:
    """Return RViz with the topics of a namespace."""
    return Node(
        package='rviz2', executable='rviz2', namespace=namespace,
        arguments=['-d', str(share / 'rviz/spinning_top.rviz'), '-f', world_frame],
        remappings=[(f'/{topic}', resolve_topic(topic, namespace))
                    for topic in ('markers', 'robot_description')],
        parameters=[{'use_sim_time': use_sim_time}])
