# SPDX-License-Identifier: Apache-2.0
"""The wheel, in an environment that has its dependencies and nothing else: no ROS, no extras."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib import metadata

import pytest
from helpers.reference import ROOT
from packaging.requirements import Requirement

from spinning_top_sim.__main__ import COMMANDS, main

NAME = 'spinning_top_sim'
BUILD = 'import sys, setuptools.build_meta as m; getattr(m, sys.argv[1])(sys.argv[2])'


def run(*command, cwd=ROOT, **variables):
    """Run a command in an environment that knows nothing of this one."""
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=120, check=False,
        env={'PATH': '/usr/bin:/bin', 'HOME': tempfile.gettempdir(), **variables})
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope='module')
def wheel(tmp_path_factory):
    """Return the wheel that is made of the source distribution."""
    folder = tmp_path_factory.mktemp('build')
    settings = folder / 'setup.cfg'
    settings.write_text(f'[build]\nbuild_base={folder}/build\n[egg_info]\negg_base={folder}\n')

    def build(what, place):
        code, _, err = run(sys.executable, '-c', BUILD, what, folder, cwd=place,
                           DIST_EXTRA_CONFIG=str(settings))
        assert code == 0, err

    build('build_sdist', ROOT)
    (archive,) = folder.glob('*.tar.gz')
    shutil.unpack_archive(archive, folder)
    build('build_wheel', *folder.glob('spinning_top_sim-*/'))
    (made,) = folder.glob('*.whl')
    return made


def dependencies(name):
    """Yield the distributions that one needs, and itself."""
    yield metadata.distribution(name)
    for requirement in map(Requirement, metadata.requires(name) or ()):
        if requirement.marker is None or requirement.marker.evaluate({'extra': ''}):
            yield from dependencies(requirement.name)


@pytest.fixture(scope='module')
def empty(tmp_path_factory, wheel):
    """Return an environment with the wheel and its dependencies."""
    folder = tmp_path_factory.mktemp('empty')
    code, _, err = run(sys.executable, '-m', 'venv', '--without-pip', folder)
    assert code == 0, err
    code, _, err = run(sys.executable, '-m', 'pip', '--disable-pip-version-check', '--python',
                       folder / 'bin/python', 'install', '--no-deps', '--no-index',
                       '--no-compile', wheel)
    assert code == 0, err
    (packages,) = folder.glob('lib/python*/site-packages')
    for distribution in dependencies('spinning_top_sim'):
        tops = {file.parts[0] for file in distribution.files if file.parts[0] != '..'}
        for top in tops - {'__pycache__'}:
            if not (packages / top).exists():
                (packages / top).symlink_to(distribution.locate_file(top))
    return folder


def test_the_source_distribution_installs_what_the_checkout_does(wheel):
    """Here the package is installed from the checkout."""
    folder = metadata.distribution(NAME).locate_file('')
    with zipfile.ZipFile(wheel) as archive:
        of_sdist = {
            os.path.normpath(folder / re.sub('.*[.]data/data/', '../../../', name)):
            archive.read(name) for name in archive.namelist() if '.dist-info/' not in name}
    of_checkout = {
        os.path.normpath(file.locate()): file.locate().read_bytes()
        for file in metadata.files(NAME) if '.dist-info/' not in str(file)
        and file.suffix != '.pyc' and file.parent.name != 'bin'}
    assert of_sdist == of_checkout
    assert str(folder / NAME / 'py.typed') in of_sdist


RUN_ALL = """
import contextlib, io, json, sys
from spinning_top_sim.__main__ import main
said = []
for arguments in json.loads(sys.argv[1]):
    with (contextlib.redirect_stdout(io.StringIO()) as out,
          contextlib.redirect_stderr(io.StringIO()) as err):
        try:
            code = main(arguments)
        except SystemExit as ended:
            code = ended.code
    said.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(said))
"""


def run_all(empty, folder, lines):
    """Return exit code, output and errors of each command line; one process runs them all."""
    code, out, err = run(empty / 'bin/python', '-c', RUN_ALL, json.dumps(lines), cwd=folder)
    assert (code, err) == (0, '')
    return json.loads(out)


REMEDIES = [
    (['node'], "pip install 'ros-jazzy-rclpy"),
    (['replay', 'a.mcap'], "pip install 'ros-jazzy-rclpy"),
    (['view', '--node'], "pip install 'ros-jazzy-rclpy"),
    (['view'], "pip install 'viser"),
    (['view', 'a.mcap'], "pip install 'viser"),
    (['inspect', 'a.mcap', '--plot', 'a.png'], "pip install 'matplotlib"),
    (['simulate', '--duration', '1', '-o', 'b.parquet'], "pip install 'pyarrow"),
    (['simulate', '--duration', '1', '-o', 'b.mcap', '-p', 'gnss.enabled:=true'],
     "pip install 'pymap3d"),
    (['examine', '--filter', 'vqf'], "pip install 'vqf"),
    (['examine', '--node', 'a', '--topic', 'b'], "pip install 'ros-jazzy-rclpy"),
    (['ensemble', 'e.yaml', '-o', 'runs'], "pip install 'distributed"),
]


@pytest.fixture(scope='module')
def answers(empty, tmp_path_factory):
    """Return what the commands of REMEDIES say, and all --help after it."""
    folder = tmp_path_factory.mktemp('answers')
    assert main(['simulate', '--duration', '0.1', '--quiet', '-o', str(folder / 'a.mcap')]) == 0
    shutil.copy(ROOT / 'examples/ensemble.yaml', folder / 'e.yaml')
    return run_all(empty, folder, [*(arguments for arguments, _ in REMEDIES), ['--help'],
                                   *([name, '--help'] for name in COMMANDS)])


def test_help_needs_nothing(answers):
    for name, (code, out, err) in zip(['', *COMMANDS], answers[len(REMEDIES):], strict=True):
        assert (code, err) == (0, '')
        assert out.startswith(f'usage: spinning-top {name}')


def test_what_is_missing_is_told_with_its_remedy(empty, answers):
    for (arguments, remedy), (code, _, err) in zip(REMEDIES, answers, strict=False):
        assert code in (1, 2)
        assert err.startswith(f'spinning-top {arguments[0]}: ') and err.count('\n') == 1
        assert f'{empty}/bin/python -m {remedy}' in err
        words = err.split()
        assert len(set(words)) == len(words)
