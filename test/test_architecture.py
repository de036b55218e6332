# SPDX-License-Identifier: Apache-2.0
"""The rooms of the package: imports go one way, in no circle, and to public names only."""

import ast
import functools
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / 'spinning_top_sim'
NAME = PACKAGE.name
# Each room, and those that it may import; docs/architecture.md has the picture.
MAY_IMPORT = {
    'physics': set(),
    'solvers': {'physics'},
    'streams': {'physics', 'solvers'},
    'recording': set(),
    'tools': {'physics', 'solvers', 'streams', 'recording'},
    'exam': {'physics', 'solvers', 'streams', 'recording', 'tools'},
    'grade': {'physics', 'solvers', 'streams', 'recording', 'tools'},
    'nodes': {'physics', 'solvers', 'streams', 'recording', 'tools'},
    'view': {'physics', 'solvers', 'streams', 'recording', 'tools', 'nodes'},
}
ROS = {'rclpy', 'launch', 'launch_ros', 'rcl_interfaces', 'ament_index_python', 'std_msgs',
       'geometry_msgs', 'sensor_msgs', 'diagnostic_msgs', 'std_srvs'}
MAY_NOT_IMPORT = {
    'physics': ROS | {'scipy', 'mcap', 'time', 'os', 'pathlib', 'viser'},
    'solvers': ROS | {'scipy', 'mcap', 'time', 'os', 'pathlib', 'viser'},
    'streams': ROS | {'scipy', 'mcap', 'os', 'pathlib', 'viser'},
    'recording': {'rclpy', 'scipy', 'viser'},
    'tools': {'rclpy', 'viser'},
    'exam': ROS | {'viser'},
    'grade': {'rclpy', 'viser'},
    'nodes': {'scipy', 'viser'},
    'view': ROS | {'scipy'},
}
MAY_IMPORT_ROS = {f'{NAME}.{module}' for module in (
    'exam.live', 'view.node')}
MODULES = {'.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts): path
           for path in sorted(PACKAGE.rglob('*.py'))}


@functools.cache
def imported(path):
    """Return the full names of all that a module imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: a relative import'
            names |= {node.module} | {f'{node.module}.{alias.name}' for alias in node.names}
    return names


def ours(path):
    """Return the modules of the package that a module imports."""
    found = {name for name in imported(path) if name.startswith(NAME)}
    # A package is not a dependency where only a module in it is meant.
    return {name for name in found if name in MODULES} | {
        f'{name}.__init__' for name in found if f'{name}.__init__' in MODULES
        and not any(other.startswith(f'{name}.') for other in found)}


def room(module):
    parts = module.split('.')
    return parts[1] if len(parts) > 2 else None


@pytest.mark.parametrize('name', MAY_IMPORT)
def test_a_room_imports_only_what_it_may(name):
    for module, path in MODULES.items():
        if room(module) != name:
            continue
        others = {room(other) for other in ours(path)} - {name, None}
        assert others <= MAY_IMPORT[name], module
        top_level = {imported_name.split('.')[0] for imported_name in imported(path)}
        allowed = ROS if module in MAY_IMPORT_ROS else set()
        assert not top_level & MAY_NOT_IMPORT[name] - allowed, module


def test_imports_have_no_circles():
    """Imports for types only, and within functions, count too."""
    graph = {module: ours(path) - {module} for module, path in MODULES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(' -> '.join(error.args[1]))
