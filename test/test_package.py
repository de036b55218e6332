# SPDX-License-Identifier: Apache-2.0
"""The package as colcon, pip and `ros2 run` see it: manifest, versions, executables, files."""

import os
import re
import runpy
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
from helpers.reference import ROOT
from test_architecture import imported as module_names

from spinning_top_sim.__main__ import COMMANDS
from spinning_top_sim.installation import remedy

NAME = 'spinning_top_sim'
SCRIPTS = sorted(path for path in (ROOT / 'scripts').iterdir() if path.is_file())
SCENES = sorted((ROOT / 'config').glob('*.yaml'))
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


def test_the_manifest_is_valid():
    warnings: list[str] = []
    package = parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.name == NAME
    assert package.get_build_type() == 'ament_python'
    assert package.licenses == ['Apache-2.0']
    assert (ROOT / package.licenses[0].file).is_file()


def test_the_manifest_names_every_ros_package_that_is_imported():
    declared = {dependency.name for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends}
    imported = {name.split('.')[0]
                for path in (*(ROOT / NAME).rglob('*.py'), *(ROOT / 'launch').glob('*.py'))
                for name in module_names(path)}
    ros = {name for name in imported
           if name in {'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'rcl_interfaces',
                       'xacro'}
           or name.endswith(('_msgs', '_srvs'))}
    assert ros <= declared
    assert {'launch', 'launch_ros', 'xacro'} <= ros


def test_versions_agree(project):
    package = parse_package(str(ROOT / 'package.xml'))
    newest = next(get_changelog_from_path(str(ROOT), NAME).foreach_version(reverse=True))[0]
    citation = yaml.safe_load((ROOT / 'CITATION.cff').read_text(encoding='utf-8'))
    assert package.version == newest == project['version'] == citation['version']


def test_no_private_name_of_rclpy_is_used():
    """What ends with a release of rclpy: `rclpy.impl`, and attributes like `node._parameters`."""
    private = re.compile(r'rclpy\.impl|rclpy_implementation|_rclpy\b|publish_raw'
                         r'|(?<!\bself)(?<!\bcls)(?<!\bos)\._[a-z]')
    found = [f'{path.name}:{number}: {line.strip()}'
             for path in (*(ROOT / NAME / 'nodes').glob('*.py'), *(ROOT / 'launch').glob('*.py'))
             for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1)
             if private.search(line)]
    assert found == []
    assert private.search('node._parameter_overrides') and private.search('publisher.publish_raw')


def test_one_command_is_on_path_and_every_script_is_a_part_of_it(project):
    assert project['scripts'] == {'spinning-top': f'{NAME}.__main__:main'}
    called = [re.search(r"main\(\['(\w+)', \*sys", path.read_text())[1] for path in SCRIPTS]
    assert sorted(called) == sorted(COMMANDS)


def test_ctrl_c_during_the_imports_of_a_tool_is_quiet():
    code = ('import runpy, signal, sys\n'
            'class Interrupted:\n'
            '    def find_spec(self, name, path=None, target=None):\n'
            "        if name == 'spinning_top_sim.recording.errors':\n"
            '            signal.raise_signal(signal.SIGINT)\n'
            'sys.meta_path.insert(0, Interrupted())\n'
            f'runpy.run_path({str(ROOT / "scripts/inspect")!r}, run_name="__main__")')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          timeout=60, check=False, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert (done.returncode, done.stdout, done.stderr) == (130, '', '')


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda path: path.name)
def test_an_installed_executable_tells_its_version_where_ros2_run_looks(
        script, prefix, project, monkeypatch, capsys):
    installed = prefix / 'lib' / NAME / script.name
    monkeypatch.setattr(sys, 'argv', [str(installed), '--version'])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(installed), run_name='__main__')
    said = capsys.readouterr()
    assert (ended.value.code, said.err) == (0, '')
    assert said.out.split()[-1] == project['version']
    assert os.access(installed, os.X_OK)
    if script.name == 'recover':                # as a process, too
        search_path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ.get("PATH", "")}'
        assert subprocess.check_output(
            [installed, '--version'], env={**os.environ, 'PATH': search_path}, text=True,
            timeout=60) == said.out


def test_the_share_folder_is_complete(prefix):
    share = prefix / 'share' / NAME
    assert (share / 'package.xml').read_bytes() == (ROOT / 'package.xml').read_bytes()
    for folder, pattern in (('config', '*.yaml'), ('config/imu', '*.yaml'),
                            ('launch', '*.launch.*'), ('urdf', '*'), ('rviz', '*.rviz'),
                            ('foxglove', '*.json')):
        there = {path.name for path in (share / folder).glob('*') if path.is_file()}
        assert there, folder
        assert there == {path.name for path in (ROOT / folder).glob(pattern)}, folder


def test_the_manifest_requires_what_ubuntu_has_of_what_pip_installs(project):
    keys = {'python3-numpy': 'numpy', 'python3-scipy': 'scipy', 'python3-tqdm': 'tqdm',
            'python3-yaml': 'PyYAML'}
    declared = {keys[dependency.name] for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends if dependency.name in keys}
    required = {re.split('[<>]', line)[0] for line in project['dependencies']}
    assert declared == set(keys.values()) == required - NO_KEY


def make(*arguments):
    """Run make without what the `make` that runs the tests was given."""
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('MAKEFLAGS', 'MFLAGS', 'MAKELEVEL', 'PYTHON', 'ROS', 'VENV')}
    return subprocess.run(['make', *arguments], cwd=ROOT, check=False, capture_output=True,
                          text=True, timeout=60, env=environment)


def test_make_refuses_a_second_ros_in_an_environment(tmp_path):
    (tmp_path / '.deps-ros-jazzy').touch()
    made = make('dependencies', 'ROS=kilted', f'VENV={tmp_path}')
    assert made.returncode == 2 and 'the wheels of ROS 2 jazzy, not of kilted' in made.stderr


def test_make_help_fits_into_80_columns_and_names_every_scene():
    told = make('help').stdout
    assert max(map(len, told.splitlines())) <= 80
    assert {path.stem for path in SCENES} <= set(told.split())


def test_every_source_says_its_license():
    paths = [path for folder in SOURCES for path in (ROOT / folder).rglob('*') if path.is_file()
             and (path.suffix in ('.py', '.sh') or path.read_bytes().startswith(b'#!'))]
    paths += [ROOT / 'Makefile', ROOT / 'setup.py']
    assert len(paths) > 100
    silent = [path for path in paths if '# SPDX-License-Identifier: Apache-2.0'
              not in path.read_text(encoding='utf-8').splitlines()[:2]]
    assert silent == []


@pytest.mark.parametrize('name, arguments', [
    ('simulate', ['--help']), ('inspect', ['--help']),
    ('examine', ['run.mcap', '--topic', 'imu/data'])])
def test_a_command_whose_library_is_missing_names_it_and_the_remedy(
        name, arguments, monkeypatch, capsys):
    for module in [one for one in sys.modules if one.startswith('spinning_top_sim')]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, 'mcap.exceptions', None)
    monkeypatch.setitem(sys.modules, 'mcap.records', None)
    monkeypatch.setitem(sys.modules, 'mcap.opcode', None)
    assert import_module('spinning_top_sim.__main__').main([name, *arguments]) == 1
    assert re.fullmatch(f'spinning-top {name}: it needs mcap, which is not installed: '
                        rf"\S+ -m pip install 'mcap[^']*'\n", capsys.readouterr().err)


@pytest.mark.parametrize('name', ['node', 'simulate'])
def test_output_that_has_no_encoding_is_escaped_and_a_pager_may_end(name):
    command = [sys.executable, '-m', NAME, name, '--scene', 'help']
    run = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, timeout=60,
                         check=False, env={**os.environ, 'PYTHONIOENCODING': 'ascii'})
    assert (run.returncode, run.stderr) == (0, '')
    assert r'Br\xfcls' in run.stdout
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True) as running:
        running.stdout.close()
        assert (running.wait(60), running.stderr.read()) == (0, '')


def test_a_remedy_names_the_distribution_or_the_package_of_ubuntu(monkeypatch):
    assert remedy('yaml').startswith(f"{sys.executable} -m pip install 'PyYAML")
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    monkeypatch.setattr(sys, 'prefix', sys.base_prefix)
    assert remedy('gmpy2') == 'sudo apt install python3-gmpy2'
    assert remedy('yaml') == 'sudo apt install python3-yaml'
    assert "pip install 'mcap" in remedy('mcap')
