# SPDX-License-Identifier: Apache-2.0
"""The package as colcon, pip and `ros2 run` see it: manifest, versions, executables, files."""

import fcntl
import inspect
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
import yaml  # type: ignore[import-untyped]
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package

from spinning_top_sim.streams import parameters

NAME = 'spinning_top_sim'
ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path for path in (ROOT / 'scripts').iterdir() if path.is_file())
SCENES = sorted((ROOT / 'config').glob('*.yaml'))
# What builds, environments and runs leave in a checkout.
NOT_SOURCES = {'build', 'install', 'log', 'logs'}


@pytest.fixture(scope='module')
def setup_py():
    """Return what setup.py says, as setuptools understands it."""
    pytest.importorskip('setuptools')
    from distutils.core import run_setup  # setuptools has it where Python has not

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return run_setup('setup.py', stop_after='init')


@pytest.fixture(scope='module')
def prefix():
    """Return where the package is installed: in a workspace, or by pip in this environment."""
    candidates = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    for candidate in filter(None, candidates):
        if (Path(candidate) / 'share/ament_index/resource_index/packages' / NAME).is_file():
            return Path(candidate)
    pytest.skip(f'{NAME} is not installed here, only importable')


def sources():
    for folder in (ROOT, *ROOT.iterdir()):
        if folder is ROOT or folder.name == '.ci':
            yield from filter(Path.is_file, folder.iterdir())
        elif folder.is_dir() and folder.name not in NOT_SOURCES and folder.name[0] != '.':
            yield from filter(Path.is_file, folder.rglob('*'))


def is_program(path):
    if path.suffix in {'.py', '.sh'} or path.name == 'Makefile':
        return True
    with path.open('rb') as file:
        return file.read(2) == b'#!'


# ------------------------------------------------------------------------------- the manifest


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
    imported = set()
    for path in (*(ROOT / NAME).rglob('*.py'), *(ROOT / 'launch').glob('*.py')):
        for line in path.read_text(encoding='utf-8').splitlines():
            words = line.split()
            if words[:1] in (['import'], ['from']) and len(words) > 1:
                imported.add(words[1].split('.')[0])
    ros = {name for name in imported
           if name in {'rclpy', 'launch', 'launch_ros', 'ament_index_python', 'rcl_interfaces',
                       'xacro'}
           or name.endswith(('_msgs', '_srvs'))}
    assert ros <= declared
    assert {'launch', 'launch_ros', 'xacro'} <= ros


def test_the_manifest_names_every_package_that_is_launched():
    declared = {dependency.name for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends} | {NAME}
    sources = [*(ROOT / 'launch').glob('*.py'), ROOT / NAME / 'nodes/launch_helpers.py']
    named = re.compile(r"(?:package=|STATE_PUBLISHER = )'(\w+)'")
    launched = {name for path in sources for name in named.findall(path.read_text())}
    assert launched == {NAME, 'robot_state_publisher', 'rviz2'}
    assert launched <= declared


def test_versions_agree(setup_py):
    package = parse_package(str(ROOT / 'package.xml'))
    newest = next(get_changelog_from_path(str(ROOT), NAME).foreach_version(reverse=True))[0]
    assert package.version == newest == setup_py.get_version()


def test_manifest_and_setup_py_tell_the_same(setup_py):
    package = parse_package(str(ROOT / 'package.xml'))
    (maintainer,) = package.maintainers
    assert setup_py.get_name() == package.name
    assert setup_py.get_license() == package.licenses[0]
    assert setup_py.get_maintainer() == maintainer.name
    assert setup_py.get_maintainer_email() == maintainer.email


def test_no_private_name_of_rclpy_is_used():
    """What ends with a release of rclpy: `rclpy.impl`, and attributes like `node._parameters`."""
    private = re.compile(r'rclpy\.impl|rclpy_implementation|_rclpy\b|publish_raw'
                         r'|(?<!\bself)(?<!\bcls)\._[a-z]')
    found = [f'{path.name}:{number}: {line.strip()}'
             for path in (*(ROOT / NAME / 'nodes').glob('*.py'), *(ROOT / 'launch').glob('*.py'))
             for number, line in enumerate(path.read_text(encoding='utf-8').splitlines(), 1)
             if private.search(line)]
    assert found == []
    assert private.search('node._parameter_overrides') and private.search('publisher.publish_raw')


def test_nodes_neither_use_nor_replace_what_is_private_in_rclpys_node():
    pytest.importorskip('rclpy')
    from rclpy.node import Node

    from spinning_top_sim.nodes.replayer import Replayer
    from spinning_top_sim.nodes.simulator import Simulator

    theirs = {name for name in vars(Node) if not name.startswith('__')}
    source = inspect.getsource(Node.__init__)
    theirs |= set(re.findall(r'self\.(_[a-z]\w*)', source))
    for kind in (Simulator, Replayer):
        ours = set(vars(kind)) | set(re.findall(r'self\.(_[a-z]\w*)', inspect.getsource(kind)))
        assert not {name for name in ours & theirs if not name.startswith('__')}
    assert '_parameter_overrides' in theirs


# -------------------------------------------------------------------------------- executables


def test_every_script_is_installed_as_data_and_as_a_command(setup_py):
    names = {path.name for path in SCRIPTS}
    assert 'sim_node' in names
    commands = dict(line.split(' = ') for line in setup_py.entry_points['console_scripts'])
    assert set(commands) == names
    assert set(dict(setup_py.data_files)[f'lib/{NAME}']) == {f'scripts/{name}' for name in names}
    for name, target in commands.items():
        module, function = target.split(':')
        assert (ROOT / f'{module.replace(".", "/")}.py').is_file()
        assert f'from {module} import {function}\n' in (ROOT / 'scripts' / name).read_text()


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda path: path.name)
def test_a_script_tells_its_version_and_does_nothing_else(script, tmp_path, setup_py):
    if script.name in {'sim_node', 'replay_node', 'view'}:
        pytest.importorskip('rclpy')
    assert os.access(script, os.X_OK)
    assert script.read_text().startswith('#!/usr/bin/env python3\n')
    paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])
    done = subprocess.run([sys.executable, script, '--version'], cwd=tmp_path, timeout=60,
                          env={**os.environ, 'PYTHONPATH': paths}, capture_output=True, text=True,
                          check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.split() == [script.name, setup_py.get_version()]
    assert list(tmp_path.iterdir()) == []


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
def test_an_installed_executable_helps_where_ros2_run_looks(script, prefix):
    installed = prefix / 'lib' / NAME / script.name
    search_path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ.get("PATH", "")}'
    done = subprocess.run([installed, '--help'], env={**os.environ, 'PATH': search_path},
                          capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith(f'usage: {script.name} ')
    assert len(done.stdout.splitlines()) > 8


# ------------------------------------------------------------------------------ what is there


def test_the_share_folder_is_complete(prefix):
    share = prefix / 'share' / NAME
    assert (share / 'package.xml').read_bytes() == (ROOT / 'package.xml').read_bytes()
    for folder, pattern in (('config', '*.yaml'), ('config/imu', '*.yaml'),
                            ('launch', '*.launch.*'), ('urdf', '*'), ('rviz', '*.rviz'),
                            ('foxglove', '*.json')):
        there = {path.name for path in (share / folder).glob('*') if path.is_file()}
        assert there, folder
        assert there == {path.name for path in (ROOT / folder).glob(pattern)}, folder


def test_the_metadata_ask_for_little():
    try:
        requirements = distribution(NAME).requires or []
    except PackageNotFoundError:
        pytest.skip(f'{NAME} is not installed here, only importable')
    always = [line for line in requirements if 'extra' not in line]
    names = sorted(line.split('<')[0].split('>')[0] for line in always)
    assert names == ['PyYAML', 'mcap', 'numpy', 'scipy', 'tqdm']


def test_manifest_and_setup_py_require_the_same(setup_py):
    keys = {'python3-numpy': 'numpy', 'python3-scipy': 'scipy', 'python3-tqdm': 'tqdm',
            'python3-yaml': 'PyYAML', 'mcap-ros2-support': 'mcap'}
    declared = {keys[dependency.name] for dependency in
                parse_package(str(ROOT / 'package.xml')).exec_depends if dependency.name in keys}
    required = {re.split('[<>]', line)[0] for line in setup_py.install_requires}
    assert declared == required == set(keys.values())


def make(*arguments):
    """Run make without what the `make` that runs the tests was given."""
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('MAKEFLAGS', 'MFLAGS', 'MAKELEVEL', 'PYTHON', 'ROS', 'VENV')}
    return subprocess.run(['make', *arguments], cwd=ROOT, check=False, capture_output=True,
                          text=True, timeout=60, env=environment)


@pytest.mark.parametrize(('ros', 'extra', 'folder'), [
    ('jazzy', 'ros', '.venv'), ('kilted', 'ros-kilted', '.venv-kilted')])
def test_make_run_installs_what_the_tools_draw_with(ros, extra, folder):
    plan = make('--dry-run', '--always-make', 'run', f'ROS={ros}').stdout
    assert f"'{folder}/bin/sim_node'" in plan
    assert re.findall(r"'\.\[build,(ros.*?)\]'", plan) == [extra] and "'.[build,plot]'" in plan


def test_make_refuses_a_ros_that_has_no_wheels_here_and_a_second_one_in_an_environment(tmp_path):
    (tmp_path / '.deps-ros').touch()
    for arguments, said in (
            (('run', 'ROS=humble'), 'ROS=humble is neither jazzy nor kilted'),
            (('dependencies', 'ROS=kilted', f'VENV={tmp_path}'), 'has another ROS than kilted')):
        made = make(*arguments)
        assert made.returncode == 2 and said in made.stderr


def test_the_workflow_calls_what_there_is():
    jobs = yaml.safe_load((ROOT / '.github/workflows/ci.yml').read_text())['jobs']
    matrix = jobs['test']['strategy']['matrix']
    assert matrix['ros'] == ['jazzy', 'kilted']
    for name in matrix['libraries']:
        assert name == 'newest' or (ROOT / f'.ci/constraints-{name}.txt').is_file()
    (run,) = (step['run'] for step in jobs['test']['steps'] if 'run' in step)
    assert run == '.ci/run ' + ' '.join(
        f'${{{{ matrix.{key} }}}}' for key in ('step', 'python', 'ros', 'libraries'))
    steps = {*matrix['step'], *(one['step'] for one in matrix['include'])}
    assert steps == {'test', 'coverage'}
    assert jobs['lint']['strategy']['matrix']['step'] == ['lint', 'docs', 'build']
    cases = re.findall(r'^([\w |]+)\)$', (ROOT / '.ci/run').read_text(), re.MULTILINE)
    assert {*steps, 'lint', 'docs', 'build'} <= set(re.findall(r'\w+', ' '.join(cases)))


@pytest.mark.parametrize(('scene', 'file'), [
    ('wavy', 'config/wavy.yaml'),
    (str(ROOT / 'config/wavy.yaml'), str(ROOT / 'config/wavy.yaml'))])
def test_make_run_takes_a_scene_by_name_or_path(scene, file):
    assert f"--params-file '{file}'" in make('--dry-run', 'run', f'SCENE={scene}').stdout


@pytest.mark.parametrize(('scene', 'said'), [
    ('nothing', 'There is no scene "nothing"'),
    ('config/nothing.yaml', 'There is no scene "config/nothing.yaml"'),
    ('imu/bmi088', 'bmi088.yaml is no scene but an IMU'),
    (str(ROOT / 'config/imu/bmi088.yaml'), "ARGS='--params-file ")])
def test_make_run_refuses_what_is_no_scene_and_names_the_scenes(scene, said):
    made = make('run', f'SCENE={scene}')
    assert made.returncode == 2 and 'Creating' not in made.stdout
    assert said in made.stderr and 'looping' in made.stderr


def test_make_help_fits_into_80_columns_and_names_every_scene():
    told = make('help').stdout
    assert max(map(len, told.splitlines())) <= 80
    assert {path.stem for path in SCENES} <= set(told.split())


def test_a_second_make_run_waits_while_the_first_installs():
    with (ROOT / 'Makefile').open() as makefile:
        fcntl.flock(makefile, fcntl.LOCK_EX)
        second = subprocess.Popen(['make', '--dry-run', 'run'], cwd=ROOT, text=True,
                                  stdout=subprocess.PIPE)
        with pytest.raises(subprocess.TimeoutExpired):
            second.communicate(timeout=1.0)
    assert 'sim_node' in second.communicate(timeout=60)[0]
    assert second.returncode == 0


def test_every_source_says_its_license():
    heads = {path: path.read_text(encoding='utf-8').splitlines()[:2]
             for path in sources() if is_program(path)}
    assert len(heads) > 30
    silent = [str(path.relative_to(ROOT)) for path, head in heads.items()
              if '# SPDX-License-Identifier: Apache-2.0' not in head]
    assert not silent


# ------------------------------------------------------------------------------------- scenes


def flat(values, prefix=''):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}', value


@pytest.mark.parametrize('scene', SCENES, ids=lambda path: path.stem)
def test_a_scene_holds_parameters_that_the_node_takes(scene):
    nodes = yaml.safe_load(scene.read_text(encoding='utf-8'))
    assert nodes
    for node in nodes.values():
        assert set(node) == {'ros__parameters'}
        values = dict(flat(node['ros__parameters'] or {}))
        values.pop('use_sim_time', None)
        parameters.checked({name: value for name, value in values.items()
                            if not name.startswith('qos_overrides.')})


@pytest.mark.parametrize('name', ['sim_node', 'replay_node'])
def test_ctrl_c_during_the_imports_of_a_node_is_quiet(name, tmp_path):
    (tmp_path / NAME).mkdir()
    (tmp_path / NAME / '__init__.py').write_text(
        'import signal\nsignal.raise_signal(signal.SIGINT)\n')
    done = subprocess.run([sys.executable, ROOT / 'scripts' / name], capture_output=True,
                          text=True, check=False, timeout=60,
                          env={**os.environ, 'PYTHONPATH': str(tmp_path)})
    assert done.returncode == -signal.SIGINT
    assert done.stderr == done.stdout == ''
