# SPDX-License-Identifier: Apache-2.0
"""
Write the top of a scene as a model for physics engines (MJCF, URDF, SDF).

exit codes:
  0    done
  1    the file cannot be written
  2    wrong arguments or parameters, or a top that no model has
"""

import argparse
import html
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from spinning_top_sim.files import new_file
from spinning_top_sim.installation import needed, read_table, share
from spinning_top_sim.physics import attitude
from spinning_top_sim.shape import Shape
from spinning_top_sim.solvers.solve import solve
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, scene_file

FORMATS = ('mjcf', 'urdf', 'sdf')
# Arguments of the xacro file and the parameters that they are taken from.
ARGUMENTS = {name.removeprefix('top.').replace('.', '_'): name for name in (
    'top.mass', 'top.com_distance', 'top.lambda1', 'top.lambda3', 'imu.lever_arm', 'imu.rpy',
    *parameters.FRAMES)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('--model', choices=FORMATS, required=True, help='format of the model')
    scene_file.add_parameters(parser)
    parser.add_argument('-o', '--output', metavar='FILE', type=Path, required=True,
                        help='file to write; an existing one is never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    text = model(parameters.checked(scene_file.given(arguments)), arguments.model)
    with new_file(arguments.output) as file:
        file.write(text)
    return cli.OK


def model(values: Mapping[str, Any], file_format: str) -> str:
    """
    Return the model `spinning_top` with checked parameters, in one of FORMATS.

    Raises ValueError if no rigid body has the inertia, or, of URDF, if the frames form no tree.
    """
    top, start = parameters.top_of(values), parameters.start_state(values)
    if not (top.mass > 0.0 and top.is_realizable):
        raise ValueError(
            f'{top}: no rigid body has these (mass > 0, lambda3 <= 2 (lambda1 - M R^2))')
    shape = Shape(top)
    # 'rk45' returns the start as it is, the exact motion rounds it.
    states = solve(top, start, [0.0], method='rk45')
    (*xyz, w), rates = states.quaternion[0], states.angular_velocity[0]
    world = attitude.rotated(states.rows_quaternion, tuple(rates))
    numbers = {
        'gravity': (0.0, 0.0, -top.gravity), 'mass': top.mass, 'centre': (0, 0, top.com_distance),
        'across': top.lambda1_at_com, 'along': top.lambda3,
        'radius': shape.radius, 'height': shape.height, 'half_height': 0.5 * shape.height,
        'tip': (0, 0, shape.tip), 'thickness': 0.01 * abs(shape.tip), 'xyz': xyz, 'w': w,
        'rates': rates, 'world_rates': np.concatenate(world),
        'lever_arm': values['imu.lever_arm'], 'rpy': values['imu.rpy'],
        'imu_rate': values['imu.rate'], 'angles': (start.phi, start.theta, start.psi),
        'angle_rates': (*states.phi_dot, *states.theta_dot, *states.psi_dot)}
    # With all the digits that their doubles have.
    words = {key: ' '.join(repr(float(one)) for one in np.atleast_1d(value))
             for key, value in numbers.items()}
    words |= {name: html.escape(values[key]) for name, key in (
        ('body', 'body_frame'), ('imu', 'imu.frame_id'))}
    if file_format == 'urdf':
        with needed('a URDF file', 'xacro'):
            text = robot_description(values, share() / 'urdf')
        words['robot'] = text.partition('\n')[2].strip()
    templates = read_table('tools/models.toml')
    words['facts'] = Template(templates['facts']).substitute(words)
    return Template(templates[file_format]).substitute(words)


def robot_description(values: Mapping[str, Any], folder: Path) -> str:
    """Return the URDF from the xacro file in a folder; ValueError if the frames form no tree."""
    import xacro  # noqa: PLC0415

    body = values['body_frame']
    prefix = body[:body.rfind('/') + 1]         # a/base_link, a/nutation_link
    between = [f'{prefix}precession_link', f'{prefix}nutation_link']
    for name in parameters.FRAMES:  # that these differ from each other is checked before
        if values[name] in between:
            raise ValueError(f'{name} = {values[name]!r}: must not be one of {", ".join(between)}')
    given = {'prefix': prefix, **{name: values[key] for name, key in ARGUMENTS.items()}}
    document = xacro.process_file(str(folder / 'spinning_top.urdf.xacro'), mappings={
        name: ' '.join(map(str, value)) if isinstance(value, tuple) else str(value)
        for name, value in given.items()})
    return '<?xml version="1.0"?>\n' + document.documentElement.toprettyxml(indent='  ')


main = partial(cli.run, 'export', __doc__, add_arguments, _run)
