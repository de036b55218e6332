# SPDX-License-Identifier: Apache-2.0
"""The robot description of a scene, from urdf/spinning_top.urdf.xacro."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

XACRO_FILE = 'spinning_top.urdf.xacro'
FRAMES = ('world_frame', 'body_frame', 'imu.frame_id')
# Arguments of the xacro file and the parameters that they are taken from.
ARGUMENTS = {name.removeprefix('top.').replace('.', '_'): name for name in (
    'top.mass', 'top.com_distance', 'top.lambda1', 'top.lambda3', 'imu.lever_arm', 'imu.rpy',
    *FRAMES)}


def arguments(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the arguments of the xacro file.  Raises ValueError if the frames form no tree."""
    body = values['body_frame']
    prefix = body[:body.rfind('/') + 1]         # a/base_link, a/nutation_link
    between = [f'{prefix}precession_link', f'{prefix}nutation_link']
    for name in FRAMES:         # that these differ from each other is checked before
        if values[name] in between:
            raise ValueError(f'{name} = {values[name]!r}: must not be one of {", ".join(between)}')
    given = {'prefix': prefix, **{name: values[key] for name, key in ARGUMENTS.items()}}
    return {name: ' '.join(map(str, value)) if isinstance(value, tuple) else str(value)
            for name, value in given.items()}


def robot_description(values: Mapping[str, Any], folder: str | Path) -> str:
    """Return the URDF from the xacro file in a folder.  Raises ValueError as `arguments` does."""
    import xacro  # noqa: PLC0415

    document = xacro.process_file(str(Path(folder) / XACRO_FILE), mappings=arguments(values))
    return '<?xml version="1.0"?>\n' + document.documentElement.toprettyxml(indent='  ')
