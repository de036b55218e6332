# SPDX-License-Identifier: Apache-2.0
"""
Write the top of a scene as a model for physics engines (MJCF, URDF, SDF), or
reference trajectories and models of all scenes.

exit codes:
  0    done
  1    a file cannot be written, or a library is missing
  2    wrong arguments or parameters, or a top that no model has
"""

import argparse
import json
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from spinning_top_sim.installation import parameter_files, version
from spinning_top_sim.physics.attitude import Column
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.cdr import NANOSECONDS
from spinning_top_sim.streams.imu import Imu
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.streams.stream import Samples, period_ns
from spinning_top_sim.tools import cli, models, scene_file
from spinning_top_sim.tools.table import UNITS, TrueStates, write_csv, write_parquet

COLUMNS = {**UNITS, **{f'{name}_{axis}': unit for name, unit in (
    ('gyroscope', 'rad/s'), ('accelerometer', 'm/s^2'), ('pivot_acceleration', 'm/s^2'))
    for axis in 'xyz'}}
# The IMU where a scene has one at the pivot: off the axis and turned, so that its readings show
# every term of a simulator's formulas.
MOUNTING = {'imu.lever_arm': (0.03, -0.02, 0.05), 'imu.rpy': (0.3, -0.2, 1.1)}
SUFFIXES = {'mjcf': 'mjcf.xml', 'urdf': 'urdf', 'sdf': 'sdf'}

SCHEMA = """# Reference trajectories of the heavy symmetric top

Written by spinning_top_sim {version}.
Licence: CC0 1.0, https://creativecommons.org/publicdomain/zero/1.0/

Each scene has `NAME.csv` and `NAME.parquet` with the same numbers, and models `NAME.mjcf.xml`,
`NAME.urdf` and `NAME.sdf`. `scenes.json` has the top, the start and the IMU of each, in SI units:
`lambda1` (moment of inertia across the axis, about the pivot), `lambda3` (along the axis), `mass`,
`com_distance` (from the pivot along +z of the body), `gravity` (downwards), and the IMU's
`lever_arm` in the body and its `rpy`, roll, pitch and yaw about fixed axes.

A row is one time; there are {rate:g} a second, for {duration:g} s. The numbers are doubles. In CSV
each has the shortest decimals, 17 at most, that are read back as the same double. The motion is
the exact solution, evaluated in doubles.

The world has z up and its origin at the pivot. The body has its origin there too, and z along the
symmetry axis. R(world <- body) = Rz(phi) Ry(theta) Rz(psi).

| column | unit | meaning |
|---|---|---|
{columns}
Where the pivot moves (`pivot_moves` in scenes.json), theta is in [0, pi], and phi and psi are
within two turns; energy and lz are those in the frame of the pivot about the effective vertical
there, constant as long as the acceleration of the pivot is.
"""
MEANINGS = {
    't': 'time since the start',
    'theta phi psi': 'tilt from the upward vertical, precession and spin angle, unwrapped and '
                     'continued through the poles',
    'theta_dot phi_dot psi_dot': 'their rates',
    'qx qy qz qw': 'attitude q(world <- body), its sign continuous',
    'omega_1 omega_2 omega_3': 'angular velocity in the body',
    'energy': 'kinetic energy + M g R cos(theta)',
    'l3 lz': 'angular momentum along the axis and along the upward vertical',
    'gyroscope_x gyroscope_y gyroscope_z': 'angular velocity in the frame of the IMU',
    'accelerometer_x accelerometer_y accelerometer_z':
        'acceleration minus gravity at the IMU, in its frame: +g upwards at rest',
    'pivot_acceleration_x pivot_acceleration_y pivot_acceleration_z':
        'acceleration of the pivot in the world, of the piece that ends where two meet'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument('--model', choices=models.FORMATS, help='write one model to -o FILE')
    kind.add_argument('--reference', metavar='FOLDER', type=Path,
                      help='write trajectories (CSV, Parquet), models and a description of all '
                      'scenes, or of the one that is given, into a new folder')
    scene_file.add_parameters(parser)
    parser.add_argument('-o', '--output', metavar='FILE', type=Path,
                        help='file of the model; an existing one is never overwritten')
    parser.add_argument('--duration', type=float, default=10.0, metavar='S',
                        help='of the trajectories, default %(default)g s')
    parser.add_argument('--rate', type=float, default=100.0, metavar='HZ',
                        help='of the trajectories, default %(default)g Hz')


def _run(arguments: argparse.Namespace) -> int:
    given = scene_file.given(arguments)
    # An IMU names no scene.
    files = [*([scene_file.file_of('scene', arguments.scene)] if arguments.scene else ()),
             *map(Path, arguments.params)]
    name = files[0].stem if files else 'spinning_top'
    if arguments.model:
        if arguments.output is None:
            raise ValueError('--model: -o FILE must be given')
        text = models.model(parameters.checked(given), arguments.model, name)
        cli.check_output(arguments.output)
        arguments.output.write_text(text, encoding='utf-8')
        return cli.OK
    if arguments.output is not None:
        raise ValueError(f'-o {arguments.output}: must not be given with --reference')
    for option, most in (('duration', parameters.LONGEST), ('rate', parameters.HIGHEST_RATE)):
        if not 0.0 < getattr(arguments, option) <= most:
            raise ValueError(f'--{option} {getattr(arguments, option)!r}: must be > 0 and '
                             f'<= {most:g}')
    scenes = {name: given} if files else {
        stem: {**scene_file.read_scene(path), **given}
        for stem, path in parameter_files('scene').items()}
    cli.check_output(arguments.reference)
    # Whole or not at all.
    with tempfile.TemporaryDirectory(dir=arguments.reference.parent) as temporary:
        folder = Path(temporary) / arguments.reference.name
        _write_reference(folder, {
            name: parameters.checked({**MOUNTING, **values, 'solver.method': 'exact'})
            for name, values in scenes.items()}, arguments.duration, arguments.rate)
        folder.rename(arguments.reference)
    return cli.OK


def _write_reference(folder: Path, scenes: Mapping[str, Mapping[str, Any]], duration: float,
                     rate: float) -> None:
    """Write trajectories, models, scenes.json and README.md into a new folder."""
    folder.mkdir()
    facts = {}
    for name, values in scenes.items():
        table = TrueStates(period_ns(rate), COLUMNS, partial(_imu_and_pivot, Imu(values)))
        rows = [rows for block in Simulation(values).play([table], round(duration * NANOSECONDS))
                for _, _, rows in block.messages]
        write_parquet(folder / f'{name}.parquet', rows, COLUMNS)
        write_csv(folder / f'{name}.csv', rows, COLUMNS)
        for file_format, suffix in SUFFIXES.items():
            (folder / f'{name}.{suffix}').write_text(
                models.model(values, file_format, name), encoding='utf-8')
        start = models.start_of(values)
        facts[name] = {'top': vars(parameters.top_of(values)), 'start': {
            **vars(parameters.start_state(values)),
            'quaternion_xyzw': start.quaternion[0].tolist(),
            'angular_velocity_body': start.angular_velocity[0].tolist()},
            'imu': {'lever_arm': values['imu.lever_arm'], 'rpy': values['imu.rpy']},
            'pivot_moves': parameters.pivot_path(values) is not None}
    (folder / 'scenes.json').write_text(json.dumps(facts, indent=2) + '\n', encoding='utf-8')
    lines = (f'| {", ".join(f"`{name}`" for name in names.split())} | '
             f'{COLUMNS[names.split()[0]]} | {text} |\n' for names, text in MEANINGS.items())
    (folder / 'README.md').write_text(SCHEMA.format(
        version=version(), rate=rate, duration=duration, columns=''.join(lines)), encoding='utf-8')


def _imu_and_pivot(imu: Imu, samples: Samples) -> tuple[Column, ...]:
    """Return the readings of a perfect IMU, and the acceleration of the pivot."""
    rates, force = imu.true(samples.states)
    return (*rates, *force, *samples.pivot.acceleration)


main = partial(cli.run, 'export', __doc__, add_arguments, _run)
