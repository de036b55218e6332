# SPDX-License-Identifier: Apache-2.0
"""The robot description of a scene, from urdf/spinning_top.urdf.xacro."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spinning_top_sim.streams import parameters

XACRO_FILE = 'spinning_top.urdf.xacro'
FRAMES = ('world_frame', 'body_frame', 'imu.frame_id')
# Arguments of the xacro file and the parameters that they are taken from.
ARGUMENTS = {name.removeprefix('top.').replace('.', '_'): name for name in (
    'top.mass', 'top.com_distance', 'top.lambda1', 'top.lambda3', 'imu.lever_arm', 'imu.rpy',
    *FRAMES)}


def arguments(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the arguments of the xacro file.  Raises ValueError if the frames form no tree."""
    world, body, imu = (values[name] for name in FRAMES)
    prefix = body[:body.rfind('/') + 1]         # a/base_link, a/nutation_link
    between = [f'{prefix}precession_link', f'{prefix}nutation_link']
    others = [world, *between]
    if body in others or imu in others or world in between:
        raise ValueError(f'{", ".join(FRAMES)} = {world!r}, {body!r}, {imu!r}: must be different '
                         f'from each other and from {", ".join(between)}')
    if imu == body and any((*values['imu.lever_arm'], *values['imu.rpy'])):
        raise ValueError(f'imu.frame_id = {imu!r}: must not be the body_frame where '
                         'imu.lever_arm or imu.rpy is not zero')
    given = {'prefix': prefix, **{name: values[key] for name, key in ARGUMENTS.items()}}
    return {name: ' '.join(map(str, value)) if isinstance(value, tuple) else str(value)
            for name, value in given.items()}


def robot_description(values: Mapping[str, Any], folder: str | Path) -> str:
    """Return the URDF from the xacro file in a folder.  Raises ValueError as `arguments` does."""
    import xacro  # noqa: PLC0415

    document = xacro.process_file(str(Path(folder) / XACRO_FILE), mappings=arguments(values))
    return '<?xml version="1.0"?>\n' + document.documentElement.toprettyxml(indent='  ')


def inertia_fault(values: Mapping[str, Any]) -> str:
    """Return why no rigid body has the inertia of a top, '' if one has."""
    top = parameters.top_of(values)
    if top.mass > 0.0 and top.is_realizable:
        return ''
    return (f'top.mass = {top.mass!r} kg, top.com_distance = {top.com_distance!r} m, '
            f'top.lambda1 = {top.lambda1!r} and top.lambda3 = {top.lambda3!r} kg m^2: '
            'no rigid body has these (mass > 0, lambda3 <= 2 (lambda1 - M R^2))')
