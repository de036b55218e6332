# SPDX-License-Identifier: Apache-2.0
"""The rooms of the package: imports go one way, in no circle, and to public names only."""

import ast
import functools
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / 'spinning_top_sim'
NAME = PACKAGE.name
ROS = {'rclpy', 'launch', 'launch_ros', 'rcl_interfaces', 'ament_index_python', 'std_msgs',
       'geometry_msgs', 'sensor_msgs', 'diagnostic_msgs', 'std_srvs'}
CORE = {'physics', 'solvers', 'streams', 'recording'}
# Each room: the others that it may import, and what it may not; docs/architecture.md has the
# picture.
ROOMS = {
    'physics': (set(), ROS | {'scipy', 'mcap', 'time', 'os', 'pathlib', 'viser'}),
    'solvers': ({'physics'}, ROS | {'scipy', 'mcap', 'time', 'os', 'pathlib', 'viser'}),
    'streams': ({'physics', 'solvers'}, ROS | {'scipy', 'mcap', 'os', 'pathlib', 'viser'}),
    'recording': (set(), {'rclpy', 'scipy', 'viser'}),
    'tools': (CORE, {'rclpy', 'viser'}),
    'exam': (CORE | {'tools'}, ROS | {'viser'}),
    'grade': (CORE | {'tools'}, {'rclpy', 'viser'}),
    'nodes': (CORE | {'tools'}, {'scipy', 'viser'}),
    'view': (CORE | {'tools', 'nodes'}, ROS | {'scipy'}),
}
MAY_IMPORT_ROS = {f'{NAME}.exam.live', f'{NAME}.view.node'}
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


@pytest.mark.parametrize('name', ROOMS)
def test_a_room_imports_only_what_it_may(name):
    rooms, others = ROOMS[name]
    for module, path in MODULES.items():
        if room(module) == name:
            assert {room(other) for other in ours(path)} <= rooms | {name, None}, module
            allowed = ROS if module in MAY_IMPORT_ROS else set()
            top_level = {one.split('.')[0] for one in imported(path)}
            assert not top_level & others - allowed, module


def test_imports_have_no_circles():
    """Imports for types only, and within functions, count too."""
    graph = {module: ours(path) - {module} for module, path in MODULES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(' -> '.join(error.args[1]))
