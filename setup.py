# SPDX-License-Identifier: Apache-2.0
"""The files that ROS looks for, which pyproject.toml cannot name; pip and colcon install them."""

from glob import glob

from setuptools import setup

NAME = 'spinning_top_sim'

DATA_FILES = {
    'share/ament_index/resource_index/packages': [f'resource/{NAME}'],
    f'share/{NAME}': ['package.xml'],
    f'share/{NAME}/config': glob('config/*.yaml'),
    f'share/{NAME}/config/imu': glob('config/imu/*.yaml'),
    f'share/{NAME}/launch': glob('launch/*.launch.*'),
    f'share/{NAME}/urdf': glob('urdf/*'),
    f'share/{NAME}/rviz': glob('rviz/*.rviz'),
    f'share/{NAME}/foxglove': glob('foxglove/*.json'),
    # `ros2 run` looks here, where pip installs no console scripts.
    f'lib/{NAME}': glob('scripts/*'),
}

setup(
    # Not in pyproject.toml: old and new setuptools want different forms of the one, and colcon
    # cannot read the other.
    license='Apache-2.0',
    python_requires='>=3.11',
    data_files=[(folder, sorted(files)) for folder, files in DATA_FILES.items() if files],
)
