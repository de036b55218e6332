# SPDX-License-Identifier: Apache-2.0
"""Build and install with pip or colcon; has the version ranges of the package and its tests."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'spinning_top_sim'

# Executable: the function that it runs, which returns the exit code.
# `ros2 run` looks in lib/<package>, where pip installs no console scripts.  Therefore each
# executable has a file in scripts/ as well, which pip and colcon install there as data.
EXECUTABLES = {
    'sim_node': 'spinning_top_sim.nodes.sim_node:main',
    'replay_node': 'spinning_top_sim.nodes.replay_node:main',
    'simulate': 'spinning_top_sim.tools.cli:simulate',
    'recover': 'spinning_top_sim.tools.cli:recover',
    'inspect': 'spinning_top_sim.tools.cli:inspect',
    'ensemble': 'spinning_top_sim.tools.cli:ensemble',
    'examine': 'spinning_top_sim.tools.cli:examine',
    'view': 'spinning_top_sim.view.command:main',
}

DATA_FILES = {
    'share/ament_index/resource_index/packages': [f'resource/{NAME}'],
    f'share/{NAME}': ['package.xml'],
    f'share/{NAME}/config': glob('config/*.yaml'),
    f'share/{NAME}/config/imu': glob('config/imu/*.yaml'),
    f'share/{NAME}/launch': glob('launch/*.launch.*'),
    f'share/{NAME}/urdf': glob('urdf/*'),
    f'share/{NAME}/rviz': glob('rviz/*.rviz'),
    f'share/{NAME}/foxglove': glob('foxglove/*.json'),
    f'lib/{NAME}': [f'scripts/{name}' for name in EXECUTABLES],
}

setup(
    name=NAME,
    version='1.0.0',
    description='Real-time simulation of the heavy symmetric top for ROS 2, with exact truth',
    maintainer='spinning_top_sim maintainers',
    maintainer_email='maintainers@spinning-top-sim.example',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[(folder, sorted(files)) for folder, files in DATA_FILES.items() if files],
    entry_points={'console_scripts': [
        f'{name} = {function}' for name, function in EXECUTABLES.items()]},
    zip_safe=True,
    # rclpy and the message packages come from ROS (package.xml), or from the extra `ros` on a
    # machine without ROS.
    install_requires=[
        'numpy>=1.26,<3',
        'mcap>=1.2,<2',             # with zstandard and lz4
        'PyYAML>=6,<7',             # parameter files, QoS in logs
        'scipy>=1.11,<2',           # used by the tools only; sim_node never imports it
        'tqdm>=4.64,<5',            # progress bars of the tools
    ],
    extras_require={
        'ros': [
            'ros-jazzy-rclpy[fastrtps]>=7.1.6,<8',
            'ros-jazzy-common-interfaces>=5.3.6,<6',
        ],
        # Instead of `ros`, never beside it: the wheels of both have the same names.
        'ros-kilted': [
            'ros-kilted-rclpy[fastrtps]>=9.1.2,<10',
            'ros-kilted-common-interfaces>=5.5.1,<6',
        ],
        'test': [
            'ahrs>=0.4,<0.5',
            'catkin_pkg>=1.0,<2',
            'coverage>=7.10,<8',        # make coverage
            'distributed>=2024.5,<2028',
            'docutils>=0.20,<1',
            'google-re2>=1.1,<2',
            'hypothesis>=6.98,<7',
            'imufusion>=1.3,<2',
            'ipykernel>=6.20,<8',       # with nbclient: runs examples/tour.ipynb
            'matplotlib>=3.6,<4',
            'mcap-ros2-support>=0.5.5,<0.7',
            'nbclient>=0.8,<0.12',
            'pyarrow>=18,<30',
            'pytest>=7.4,<10',
            'playwright>=1.45,<2',      # drives the Chromium of the system, and brings none
            'pytest-xdist>=3.5,<4',     # make test: several workers
            'rosbags>=0.10.11,<0.12',
            'viser>=1.1.1,<1.2',
            'vqf>=2.1,<3',
            'xacro>=2.1,<3',
            'yourdfpy>=0.0.60,<0.1',
        ],
        'parquet': ['pyarrow>=14,<30'],
        'plot': ['matplotlib>=3.6,<4'],     # inspect --plot, docs/figures.py
        # Name filters of clients, where ROS has simulation_interfaces.
        'simulation_interfaces': ['google-re2>=1.1,<2'],
        'view': ['viser>=1.1.1,<1.2'],      # a narrow range: the page uses much of it
        # examples/attitude_filter.py
        'examples': ['ahrs>=0.4,<0.5', 'matplotlib>=3.6,<4', 'rosbags>=0.10.11,<0.12',
                     'vqf>=2.1,<3'],
        # Ensembles, and the filters that `examine` knows by name but for gtsam.
        'exam': ['ahrs>=0.4,<0.5', 'distributed>=2024.5,<2028', 'imufusion>=1.3,<2',
                 'pyarrow>=18,<30', 'vqf>=2.1,<3'],
        'docs': ['furo>=2024.8,<2027', 'myst-parser>=4,<7', 'numpydoc>=1.8,<2', 'sphinx>=8.1,<10',
                 'sphinx-mathjax-offline>=0.0.2,<0.1'],
        # Narrow ranges: a new release reports new faults.
        'lint': [
            'mypy>=2.4.1,<2.5',
            'ruff>=0.17.5,<0.18',
        ],
        'mutation': ['mutmut>=3.8,<3.9'],   # make mutation
        # `setup.py install`, which colcon calls, and wheels without a package `wheel`.
        'build': ['setuptools>=70.1,<80'],
        'colcon': [
            'colcon-core>=0.21,<0.22',
            'colcon-ros>=0.5,<0.6',
        ],
    },
)
