# SPDX-License-Identifier: Apache-2.0
"""What is installed: the version, the shared files, and how to install what is missing."""

import re
import sys
from importlib import metadata
from pathlib import Path

NAME = 'spinning_top_sim'


def version(distribution: str = NAME) -> str:
    """Return the version of an installed distribution, or 'unknown'."""
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
    raise FileNotFoundError(f'{NAME} is not completely installed: no share/{NAME} beside {package}')


def remedy(wanted: str) -> str:
    """
    Return the command, as it is typed here, that installs what is missing.

    wanted : an extra of the package, or the name of one library that it requires
    """
    lines = [requirement.strip() for requirement, _, condition in
             (line.partition(';') for line in metadata.requires(NAME) or ())
             if re.findall(r'[\w.-]+', condition)[1:] == [wanted]
             or re.match(r'[\w.-]+', requirement)[0] == wanted]
    return f'{sys.executable} -m pip install ' + ' '.join(f"'{line}'" for line in lines or [wanted])


def parameter_file(kind: str, name: str) -> Path:
    """
    Return a parameter file of the package by its name, or the file itself if it is a path.

    kind : 'scene' or 'imu'

    Raises ValueError for a name that is not there.
    """
    if '/' in name or name.endswith('.yaml'):
        return Path(name)
    files = parameter_files(kind)
    if name not in files:
        raise ValueError(f'--{kind} {name}: must be the path of a file, or one of '
                         f'{", ".join(files)}')
    return files[name]


def parameter_files(kind: str) -> dict[str, Path]:
    """Return the scenes or IMUs that are installed, by name."""
    folder = share() / 'config' / {'scene': '', 'imu': 'imu'}[kind]
    return {path.stem: path for path in sorted(folder.glob('*.yaml'))}
