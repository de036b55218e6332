# SPDX-License-Identifier: Apache-2.0
"""The files that ROS looks for, which pyproject.toml cannot name; pip and colcon install them."""

import tomllib
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'spinning_top_sim'
# With --symlink-install, colcon runs a link to this file where pyproject.toml is not.
PROJECT = tomllib.loads(
    (Path(__file__).resolve().parent / 'pyproject.toml').read_text('utf-8'))['project']

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
    name=NAME,
    version=PROJECT['version'],
    # Not in pyproject.toml: old and new setuptools want different forms of the one, and colcon
    # cannot read the other.
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'recording/*.json', 'streams/*.toml', 'tools/*.toml',
                         'view/*.css', 'view/*.html', 'view/*.toml']},
    data_files=[(folder, sorted(files)) for folder, files in DATA_FILES.items() if files],
    entry_points={'console_scripts': [
        f'{command} = {function}' for command, function in PROJECT['scripts'].items()]},
)
