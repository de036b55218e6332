# SPDX-License-Identifier: Apache-2.0
"""What is installed: the version, the shared files, and how to install what is missing."""

import contextlib
import functools
import json
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NAME = 'spinning_top_sim'
# Libraries whose distribution has another name, and those that Ubuntu has as python3-NAME.
DISTRIBUTIONS = {'yaml': 'PyYAML'}
FROM_APT = ('gmpy2', 'matplotlib', 'numpy', 'scipy', 'tqdm', 'yaml')


def version(distribution: str = NAME) -> str:
    """Return the version of an installed distribution, or 'unknown'."""
    from importlib import metadata  # noqa: PLC0415 - it takes 15 ms
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return 'unknown'


def share() -> Path:
    """
    Return the folder with the files that are installed beside the modules, such as config/.

    It is share/spinning_top_sim of the prefix, wherever pip or colcon has installed the package,
    or the checkout.  Raises FileNotFoundError if there is none.
    """
    package = Path(__file__).resolve().parent
    for folder in package.parents:
        for candidate in (folder / 'share' / NAME, folder):
            if (candidate / 'package.xml').is_file() and (candidate / 'config').is_dir():
                return candidate
    raise FileNotFoundError(f'{NAME} is installed without its files: there is no share/{NAME} '
                            f'above {package}')


@functools.cache
def read_table(name: str) -> dict[str, Any]:
    """Return the content of a data file among the modules, such as 'streams/parameters.toml'."""
    text = (Path(__file__).parent / name).read_text('utf-8')
    content: dict[str, Any] = (json.loads if name.endswith('.json') else tomllib.loads)(text)
    return content


@contextlib.contextmanager
def needed(what: str, wanted: str = '') -> Iterator[None]:
    """
    Import what not every user has.  Where it is missing, an ImportError says how to install it.

    what : what needs it
    wanted : as in `remedy`; by default the library that is missing
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library, *_ = str(error.name).split('.')
        raise ImportError(f'{what} needs {library}, which is not installed: '
                          f'{remedy(wanted or library)}') from error


def remedy(wanted: str) -> str:
    """
    Return the command, as it is typed here, that installs what is missing.

    wanted : an extra of the package, or the name of one library that it requires
    """
    from importlib import metadata  # noqa: PLC0415 - it takes 15 ms
    if wanted in FROM_APT and 'ROS_DISTRO' in os.environ and sys.prefix == sys.base_prefix:
        return f'sudo apt install python3-{wanted}'
    wanted = DISTRIBUTIONS.get(wanted, wanted)
    lines = []
    with contextlib.suppress(metadata.PackageNotFoundError):
        for line in metadata.requires(NAME) or []:
            requirement, _, condition = line.partition(';')
            if wanted in (*re.findall('[\\w.-]+', condition)[1:], *re.findall('^[\\w.-]+', line)):
                lines.append(f"'{requirement.strip()}'")
    return f'{sys.executable} -m pip install {" ".join(dict.fromkeys(lines or [wanted]))}'


def parameter_files(kind: str) -> dict[str, Path]:
    """Return the parameter files that are installed, by name: kind 'scene' or 'imu'."""
    folder = share() / 'config' / {'scene': '', 'imu': 'imu'}[kind]
    return {path.stem: path for path in sorted(folder.glob('*.yaml'))}
