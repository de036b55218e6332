# SPDX-License-Identifier: Apache-2.0
"""The package as colcon, pip and `ros2 run` see it: manifest, versions, executables, files."""

import os
import re
import runpy
import signal
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
from helpers.reference import ROOT
from test_architecture import imported as module_names

from spinning_top_sim import __main__
from spinning_top_sim.installation import remedy

NAME = 'spinning_top_sim'
SCRIPTS = sorted(path for path in (ROOT / 'scripts').iterdir() if path.is_file())
NO_KEY = {'gmpy2', 'mcap', 'rosbags'}        # of rosdep, or one of PyPI only
SOURCES = ('.ci', 'benchmark', 'docs', 'examples', 'launch', 'scripts', NAME, 'test')


@pytest.fixture(scope='module')
def project():
    return tomllib.loads((ROOT / 'pyproject.toml').read_text(encoding='utf-8'))['project']


@pytest.fixture(scope='module')
def prefix():
    """Return where the package is installed: in a workspace, or by pip in this environment."""
    candidates = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    for candidate in filter(None, candidates):
        if (Path(candidate) / 'share/ament_index/resource_index/packages' / NAME).is_file():
            return Path(candidate)
    pytest.skip(f'{NAME} is not installed here, only importable')


def test_the_manifest_names_every_ros_package_that_is_imported():
    declared = {dependency.name for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends}
    ros = {name.split('.')[0]
           for path in (*(ROOT / NAME).rglob('*.py'), *(ROOT / 'launch').glob('*.py'))
           for name in module_names(path)
           if name.partition('.')[0].endswith(('_msgs', '_srvs')) or name.startswith((
               'rclpy', 'launch', 'ament_index_python', 'rcl_interfaces', 'xacro'))}
    assert {'launch', 'launch_ros', 'xacro'} <= ros <= declared


def test_the_manifest_is_valid_and_versions_and_commands_agree(project):
    warnings = []
    package = parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings and package.get_build_type() == 'ament_python'
    newest = next(get_changelog_from_path(str(ROOT), NAME).foreach_version(reverse=True))[0]
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert package.version == newest == project['version'] == citation['version']
    assert project['scripts'] == {'spinning-top': f'{NAME}.__main__:main'}
    assert len(SCRIPTS) == len(__main__.COMMANDS)


def test_ctrl_c_during_the_imports_of_a_command_ends_it_at_once(monkeypatch):
    ended = []
    signal.signal(signal.SIGINT, signal.default_int_handler)        # a shell may ignore it
    monkeypatch.setattr(os, '_exit', ended.append)
    monkeypatch.setattr(__main__, 'import_module', lambda name: signal.raise_signal(signal.SIGINT))
    with pytest.raises(AttributeError):         # nothing has been imported
        __main__.main(['inspect'])
    assert ended == [130]


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda path: path.name)
def test_an_installed_executable_tells_its_version_where_ros2_run_looks(
        script, prefix, project, monkeypatch, capsys):
    installed = prefix / 'lib' / NAME / script.name
    assert os.access(installed, os.X_OK)
    monkeypatch.setattr(sys, 'argv', [str(installed), '--version'])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(installed), run_name='__main__')
    said = capsys.readouterr()
    assert (ended.value.code, said.err) == (0, '')
    assert said.out.split()[-1] == project['version']


def test_the_share_folder_is_complete(prefix):
    share = prefix / 'share' / NAME
    for pattern in ('package.xml', 'config/*.yaml', 'config/imu/*.yaml', 'launch/*.launch.*',
                    'urdf/*', 'rviz/*.rviz', 'foxglove/*.json'):
        there, ours = ({path.relative_to(folder) for path in folder.glob(pattern)}
                       for folder in (share, ROOT))
        assert there == ours != set(), pattern


def test_the_manifest_requires_what_ubuntu_has_of_what_pip_installs(project):
    keys = {'python3-numpy': 'numpy', 'python3-scipy': 'scipy', 'python3-tqdm': 'tqdm',
            'python3-yaml': 'PyYAML'}
    declared = {keys[dependency.name] for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends if dependency.name in keys}
    required = {re.split('[<>]', line)[0] for line in project['dependencies']}
    assert declared == set(keys.values()) == required - NO_KEY


def test_every_source_says_its_license():
    paths = [path for folder in SOURCES for path in (ROOT / folder).rglob('*') if path.is_file()
             and (path.suffix in ('.py', '.sh') or path.read_bytes().startswith(b'#!'))]
    paths += [ROOT / 'Makefile', ROOT / 'setup.py']
    assert len(paths) > 100
    silent = [path for path in paths if '# SPDX-License-Identifier: Apache-2.0'
              not in path.read_text(encoding='utf-8').splitlines()[:2]]
    assert silent == []


def test_a_remedy_names_the_distribution_or_the_package_of_ubuntu(monkeypatch):
    assert remedy('yaml').startswith(f"{sys.executable} -m pip install 'PyYAML")
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    monkeypatch.setattr(sys, 'prefix', sys.base_prefix)
    assert remedy('gmpy2') == 'sudo apt install python3-gmpy2'
    assert remedy('yaml') == 'sudo apt install python3-yaml'
    assert "pip install 'mcap" in remedy('mcap')
